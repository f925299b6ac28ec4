"""Test of `daedalus settings`."""

import pytest

from daedalus.cli.commands.settings_command import settings
from daedalus.protocol.spec import RunSpec


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("training.clip_range", ["training.clip_range"]),
        ("service", [f"service.{key}" for key in ("checkpoint_seconds", "keep_checkpoints", "log_seconds")]),
        ("backend", ["environment.backend", "evaluation.final_backend"]),
    ],
)
def test_settings_are_found_by_name_section_or_part(
    name: str, expected: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert settings([name]) == 0
    printed = [line.partition(" = ")[0] for line in capsys.readouterr().out.splitlines() if not line.startswith(" ")]
    assert printed[: len(expected)] == expected
    assert all(name in path for path in printed)


def test_every_setting_is_printed_with_its_default_limits_and_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    assert settings([]) == 0
    printed = capsys.readouterr().out
    assert "training.clip_range = 0.2  (float, > 0)\n    Clip range of the ratio between" in printed
    assert "training.value_loss = mse  (one of mse, huber)\n" in printed
    for section, model in RunSpec.model_fields.items():
        assert all(f"{section}.{key} = " in printed for key in getattr(model.annotation, "model_fields", ()))


def test_an_unknown_name_is_refused_with_what_its_user_may_have_meant(capsys: pytest.CaptureFixture[str]) -> None:
    assert settings(["training.learning_rat"]) == 2
    assert capsys.readouterr().err == (
        "daedalus settings: no setting is named 'training.learning_rat': did you mean training.learning_rate or "
        "training.learning_rate_final?\n"
    )
