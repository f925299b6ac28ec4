"""The simulation finds nothing in the code as it is, finds what is broken in it, and repeats a seed exactly."""

import hashlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from daedalus.actor.session.snapshots import SnapshotFeed
from daedalus.actor.session.uploading import InFlightRollouts
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.actor_state import SequenceWindow
from daedalus.learner.serving.rollout_judge import RolloutJudge
from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.uploads import Rollout

from .settings import draw
from .simulate import services, simulate

SEEDS = 60
SEEDS_TO_FIND = 1000  # within which a break must be found
ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def test_no_seed_violates_an_invariant() -> None:
    for seed in range(SEEDS):
        result = simulate(seed)
        assert result.failure is None, "\n".join(result.lines[-60:])


def digest(seed: int) -> str:
    return hashlib.sha256("\n".join(simulate(seed).lines).encode()).hexdigest()


def test_a_seed_repeats_exactly() -> None:
    """In another process too, in which sets have another order."""
    kinds = [next(seed for seed in range(1000) if getattr(draw(seed), kind)) for kind in ("fine", "real_codec")]
    seeds = [*range(4), *kinds]
    here = [digest(seed) for seed in seeds]
    assert [digest(seed) for seed in seeds] == here
    code = f"""
import logging
from simulation.test_simulation import digest
logging.disable(logging.CRITICAL)
print(*(digest(seed) for seed in {seeds}))
"""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", "PYTHONHASHSEED": "7"}
    words = [sys.executable, "-c", code]
    process = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert process.stdout.split() == here


def test_services_use_threads_and_time_by_the_names_of_their_modules() -> None:
    """What they import from these modules, the simulation cannot replace."""
    for module in services():
        for name, value in vars(module).items():
            origin = getattr(value, "__module__", None)
            assert origin not in ("threading", "_thread", "time", "queue", "_queue"), f"{module.__name__}: {name}"


# ------------------------------------------------------------------------------------------- broken code


def accepts_duplicates(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(SequenceWindow, "__contains__", lambda _window, _sequence: False)


def does_not_fence(patch: pytest.MonkeyPatch) -> None:
    """Rollouts for another learner epoch, or of another incarnation, are accepted."""
    patch.setattr(RolloutJudge, "_check_identity", lambda _judge, _sender, _rollout: None)


def counts_twice(patch: pytest.MonkeyPatch) -> None:
    counted = RunCounters.accepted

    def accepted(counters: RunCounters, rollout: Rollout, size: int) -> None:
        counted(counters, rollout, size)
        if rollout.identity.sequence % 8 == 7:
            counted(counters, rollout, size)

    patch.setattr(RunCounters, "accepted", accepted)


def does_not_send_again(patch: pytest.MonkeyPatch) -> None:
    acknowledge = InFlightRollouts.acknowledge

    def forgetful(rollouts: InFlightRollouts, sequence: int, answer: Acknowledgement | None, now: float) -> None:
        if answer is not None:
            acknowledge(rollouts, sequence, answer, now)

    patch.setattr(InFlightRollouts, "acknowledge", forgetful)


def drops_without_an_answer(patch: pytest.MonkeyPatch) -> None:
    acknowledge = InFlightRollouts.acknowledge

    def forgetful(rollouts: InFlightRollouts, sequence: int, answer: Acknowledgement | None, now: float) -> None:
        if answer is None:
            rollouts.rollouts.pop(sequence, None)
        else:
            acknowledge(rollouts, sequence, answer, now)

    patch.setattr(InFlightRollouts, "acknowledge", forgetful)


def requests_no_lost_snapshot(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(SnapshotFeed, "request_newest", lambda _feed: ())


@pytest.mark.parametrize(
    ("break_code", "needed", "finding"),
    [
        (accepts_duplicates, "", "twice"),
        (does_not_fence, "twin", "is accepted"),
        (counts_twice, "", "a counter is wrong"),
        (does_not_send_again, "", "no progress"),
        (drops_without_an_answer, "", "lost:"),
        (requests_no_lost_snapshot, "", "no progress"),
    ],
)
def test_broken_code_is_found(
    break_code: Callable[[pytest.MonkeyPatch], None], needed: str, finding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To save time, only seeds with the `needed` fault run."""
    break_code(monkeypatch)
    for seed in range(SEEDS_TO_FIND):
        if needed and needed not in [fault for _, fault, _ in draw(seed).faults]:
            continue
        failure = simulate(seed).failure
        if failure is not None and finding in str(failure):
            print(f"{break_code.__name__}: seed {seed}: {failure}")
            return
    pytest.fail(f"not found in {SEEDS_TO_FIND} seeds")
