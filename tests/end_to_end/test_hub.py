"""The Hub from the command line: the address of a stand-in is in HF_ENDPOINT, as for any program that uses the Hub."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from hub_server import TOKEN, serving
from processes import Running
from recorded_runs import record
from saved_runs import CARTPOLE, save

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
