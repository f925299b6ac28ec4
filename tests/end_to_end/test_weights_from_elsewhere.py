"""Weights of another run, and a policy that goes to the Hub and back."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hub_server import TOKEN, serving
from processes import Running
from recorded_runs import record
from saved_runs import CARTPOLE, save

from daedalus.learner.run import run_directory
from daedalus.protocol.spec import RunSpec

Start = Callable[..., Running]
SPEC = RunSpec.model_validate(
    {
        "environment": CARTPOLE,
        "policy": {"hidden": (16,)},
        "collection": {"actors": 1, "envs_per_actor": 2, "rollout_length": 8},
    }
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder that is not that of the runs: `first`, and `second`, which begins with its weights."""
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "first", CARTPOLE, 7)
    run_directory.create_locked(tmp_path / "second", SPEC, init_from=Path("first")).close()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    return elsewhere


def test_a_resumed_run_without_checkpoints_begins_with_the_weights_of_the_other_run(folder: Path, start: Start) -> None:
    running = start("resume", "../second", directory=folder)
    running.expect(r"initial weights: policy version 7 of .*/first")
    running.process.terminate()
    running.wait()
    shutil.rmtree(folder.parent / "first")
    shutil.rmtree(folder.parent / "second" / "checkpoints", ignore_errors=True)
    refused = start("resume", "../second", directory=folder)
    assert refused.wait() == 2
    refused.expect(
        r"daedalus resume: the run in \S*/second has no checkpoint, and begins with the weights of another run, "
        r"but /.*/first does not exist"
    )
    assert "Traceback" not in refused.output


pytest.importorskip("huggingface_hub")


def test_a_policy_goes_to_the_hub_and_back(
    tmp_path: Path, start: Callable[..., Running], monkeypatch: pytest.MonkeyPatch
) -> None:
    save(record(tmp_path / "run"), CARTPOLE, 4)
    with serving() as hub:
        for name, value in {
            "HF_ENDPOINT": hub.address,
            "HF_HOME": str(tmp_path / "home"),
            "HF_TOKEN": TOKEN,
            "HF_HUB_DISABLE_XET": "1",
        }.items():
            monkeypatch.setenv(name, value)
        pushed = start("push", "run", "ada/cart")
        assert pushed.wait() == 0, pushed.output
        assert pushed.lines[-1].startswith(f"pushed to {hub.address}/ada/cart/commit/")
        evaluated = start("evaluate", "--from-hub", "ada/cart", "--episodes", 2, "--json")
        assert evaluated.wait() == 0, evaluated.output
        assert json.loads(evaluated.lines[-1])["policy_version"] == 4
