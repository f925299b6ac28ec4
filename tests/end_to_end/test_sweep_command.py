"""`daedalus sweep` with real runs: it is stopped and continues."""

import signal
from pathlib import Path

from processes import processes_mentioning, starting, until

SETTINGS = (
    "--env-steps",
    2000,
    "--actors",
    1,
    "--set",
    "collection.envs_per_actor=16",
    "--set",
    "service.log_seconds=0.1",
)
LAST = ("--set", "evaluation.final_episodes=1", "--set", "service.checkpoint_seconds=0.2")


def test_a_sweep_that_is_stopped_continues(tmp_path: Path) -> None:
    words = ("sweep", "cartpole", "--over", "collection.rollout_length=8", "--seeds", 1)
    with starting(tmp_path) as start:
        first = start(*words, *SETTINGS, *LAST)
        folder = tmp_path / "sweeps" / "cartpole-rollout_length"
        until(lambda: list(folder.glob("*/config.toml")) or first.process.poll() is not None)
        first.process.send_signal(signal.SIGTERM)
        assert first.wait() == 1, first.output
        assert "of 1 runs have ended; continue with: daedalus sweep cartpole --over collection" in first.lines[-1]
        until(lambda: not processes_mentioning("rollout_length-8_seed-1"))
        second = start(*words, *SETTINGS, *LAST)
        assert second.wait() == 0, second.output
        assert any(line.endswith(": continues") for line in second.lines), second.output
        assert second.expect(r"^rollout_length=8 +1 +\d")
