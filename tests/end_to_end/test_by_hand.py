"""Test of learner and actors that are started separately, in any order."""

import json
import re
from collections.abc import Callable
from pathlib import Path

from learner_status import env_steps, learner_status
from processes import ENDLESS, PLAYING_SLOW, SLOW, Running, here, until

Start = Callable[..., Running]
TRACKER = """
class Nowhere:
    def __init__(self, run): pass
    def write(self, row, details): pass
    def close(self): pass
"""


def test_an_actor_that_starts_before_the_learner_waits_for_it(start: Start, address: str, tmp_path: Path) -> None:
    (tmp_path / "metrics.py").write_text(TRACKER)
    actor = start("actor", "--connect", address, "--name", "early")
    actor.expect("waiting for it")
    logged = ("--log", "metrics:Nowhere")
    learner = start("learner", "cartpole", "--listen", address, "--run-dir", "run", "--env-steps", 8000, *logged)
    actor.expect("joined run 'run' as 'early': 128 x CartPole-v1")
    assert learner.wait() == 3, learner.output
    assert actor.wait() == 0, actor.output
    actor.expect("the run is over")
    time = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z"
    for line in learner.lines:
        line = re.sub(r" tracker run=run: (?=metrics:Nowhere: metrics go to )", " learner run=run: ", line)
        assert re.match(rf"{time} (info|warning) learner run=run( epoch=[0-9a-f]+)?( actor=early)?: ", line), line
    for line in actor.lines:
        assert re.match(rf"{time} (info|warning) actor actor=early( run=run epoch=[0-9a-f]+)?: ", line), line
    epochs = {match[1] for line in learner.lines + actor.lines if (match := re.search("epoch=([0-9a-f]+)", line))}
    assert len(epochs) == 1
    learner.expect(" tracker run=run: metrics:Nowhere: metrics go to metrics:Nowhere")
    learner.expect(r"epoch=\w+ actor=early: joined with 128 environments \(.*daedalus-rl ")


def test_an_actor_loads_no_torch_and_uses_little_memory_and_another_that_joins_late_is_trained_on(
    start: Start, address: str
) -> None:
    learner = start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS, *SLOW)
    first = start("actor", "--connect", address, "--name", "first", *PLAYING_SLOW)
    learner.expect(r"updates .*/s")
    maps = Path(f"/proc/{first.process.pid}/maps").read_text()
    assert "onnxruntime" in maps
    assert "libtorch" not in maps
    status = Path(f"/proc/{first.process.pid}/status").read_text()
    assert int(re.search(r"VmRSS:\s+(\d+)", status)[1]) <= 150 * 1024  # type: ignore[index]
    start("actor", "--connect", address, "--name", "late", "--envs", 3, "--runtime", "torch", *PLAYING_SLOW)
    until(lambda: env_steps(learner_status(address), "late") > 0)
    here("status", "--connect", address, "--events").expect("joined  *late  *joined with 3 environments")
    asked = here("status", "--connect", address, "--json")
    assert asked.status == 0
    report = json.loads(asked.lines[-1])
    assert {entry["actor"]: entry["environments"] for entry in report["actors"]} == {"first": 2, "late": 3}
    learner.process.terminate()
    assert learner.wait() == 0


def test_sigterm_ends_a_waiting_actor_with_status_0(start: Start, address: str) -> None:
    waiting = start("actor", "--connect", address, "--name", "waiting")
    waiting.expect("waiting for it")
    waiting.process.terminate()
    assert waiting.wait() == 0
