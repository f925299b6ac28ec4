"""The end of a learner process, as actor processes with slow environments see it."""

import shutil
from collections.abc import Callable
from pathlib import Path

from processes import Running

Start = Callable[..., Running]


def test_slow_actors_wait_for_a_stopped_learner_and_leave_a_finished_run(
    start: Start, address: str, tmp_path: Path
) -> None:
    shutil.copy(Path(__file__).parent.parent / "slow_environment.py", tmp_path)
    # An actor's rollout of 64 env_steps takes 0.26 s.
    sizes = ("collection.envs_per_actor=2", "collection.rollout_length=32", "service.log_seconds=0.1")
    settings = [word for each in sizes for word in ("--set", each)]
    words = ("learner", "--env", "slow_environment:Slow-v0", "--listen", address, *settings, "--run-dir", "run")
    allowing = ("--allow-module", "slow_environment")
    learner = start(*words, "--env-steps", 10**9)
    actors = [start("actor", "--connect", address, "--name", name, *allowing) for name in ("a", "b")]
    for actor in actors:
        actor.expect("joined run")
    learner.expect(r"updates .*/s")
    learner.process.terminate()
    assert learner.wait() == 0, learner.output
    saved = learner.expect(r"stopped; checkpoint saved at ([\d,]+) env_steps: run/checkpoints/0").group(1)
    for actor in actors:
        actor.expect("the learner was stopped; waiting for it to return")
    resumed = start(*words, "--env-steps", int(saved.replace(",", "")) + 600, "--resume")
    resumed.expect("resuming from checkpoint")
    assert resumed.wait() == 0, resumed.output
    for actor in actors:
        assert actor.wait() == 0, actor.output
        actor.expect("the run is over")
