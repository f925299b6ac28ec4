"""Attack: an authorised actor sends rollouts that no environment produces.

    python -m benchmarks.attack.false_rollouts

The learner must reject each kind with its reason, and train on with the rollouts of the others. Rollouts that only a
gradient can unmask cost a few updates; then their sender is quarantined.
"""

import sys
from contextlib import closing

import numpy as np

from benchmarks.attack._hostile_actor import HostileActor
from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, Scene, scene

_MOST_SKIPPED = 10
_MOST_SENT = 200  # rollouts until the quarantine: those that are on their way count too


def false_rollouts() -> Verdict:
    """Send the rollouts, and return whether none of them counted."""
    with scene() as here:
        relu = ("--set", "policy.activation=relu")  # has no finite gradient for huge observations
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *relu, *ENDLESS)
        here.start("actor", "--connect", here.address, "--name", "honest")
        here.wait_for_training("honest")
        with closing(HostileActor(here.address, "hostile")) as hostile:
            accepted = [name for name in _kinds(hostile) if _is_accepted(hostile, name)]
            hostile.join()
            sent = _sent_until_quarantine(hostile)
        here.wait_for_training("honest")
        here.wait("a learner without problems", lambda: (status := here.status()) and not status.problems)
        skipped = _skipped(here)
    held = not accepted and sent <= _MOST_SENT and skipped <= _MOST_SKIPPED
    return Verdict(
        held,
        f"accepted of invented rollouts: {', '.join(accepted) or 'none'}; huge observations: quarantined after {sent} "
        f"rollouts and {skipped} skipped updates; no problems afterwards",
    )


def _kinds(hostile: HostileActor) -> dict[str, dict[str, np.ndarray]]:
    """Return what each kind of rollout replaces."""
    cells = (hostile.rows, 1)
    no, yes = np.zeros(cells, np.bool_), np.ones(cells, np.bool_)
    every: dict[str, np.ndarray] = {"episode_returns": np.full(hostile.rows, 500, np.float32)}
    every["episode_lengths"] = np.full(hostile.rows, 500, np.int32)
    return {
        "returns of episodes that did not end": every,
        "no valid row": {"valid": no},
        "ends everywhere": {"terminated": yes, "truncated": yes, **every},
        "ends in reset rows": {"terminated": yes, "valid": no, **every},
        "rewards of 3e38": {"rewards": np.full(cells, 3e38, np.float32)},
        "observations of 3e38": {"frames": np.full((hostile.rows + 1, 1, 4), 3e38, np.float32)},
        "log-probabilities of -3e38": {"behaviour_log_probs": np.full(cells, -3e38, np.float32)},
    }


def _is_accepted(hostile: HostileActor, name: str) -> bool:
    hostile.join()
    return hostile.send(**_kinds(hostile)[name]).verdict == "accepted"


def _sent_until_quarantine(hostile: HostileActor) -> int:
    """Send rollouts within all bounds that have no finite gradient; return how many until the quarantine."""
    frames = np.full((hostile.rows + 1, 1, 4), 1e15, np.float32)
    actions = (np.arange(hostile.rows, dtype=np.uint8) % 2)[:, None]  # one of them has a probability above 0
    for sent in range(_MOST_SENT):
        if hostile.send(frames=frames, actions=actions).verdict == "quarantined":
            return sent
    return _MOST_SENT + 1


def _skipped(here: Scene) -> int:
    status = here.status()
    assert status is not None
    return status.updates_skipped


if __name__ == "__main__":
    verdict = false_rollouts()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
