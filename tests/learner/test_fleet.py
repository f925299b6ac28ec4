"""learner/serving/fleet.py: joins, presence, incarnations and sequence numbers."""

import pytest
from building import SPACES, identity, joined_fleet
from hypothesis import given
from hypothesis import strategies as st

from daedalus.learner.serving.fleet import Fleet, SequenceWindow
from daedalus.protocol.messages import Join, Refusal
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces

WINDOW = 1024
HUGE = 2**62


class NaiveWindow:
    """Reference implementation: one set of all received numbers."""

    def __init__(self) -> None:
        self.taken: set[int] = set()

    @property
    def low(self) -> int:
        """All numbers below were received or given up."""
        return max(0, max(self.taken, default=-1) - WINDOW + 1)

    def __contains__(self, sequence: int) -> bool:
        return sequence in self.taken or sequence < self.low

    @property
    def gaps(self) -> int:
        return self.low - sum(sequence < self.low for sequence in self.taken)


NEAR = st.integers(0, 40)
ANYWHERE = st.one_of(NEAR, NEAR, st.integers(0, 3000), st.sampled_from([HUGE, HUGE - 1, HUGE - WINDOW, 2**63 - 1]))


@given(st.lists(st.tuples(ANYWHERE, st.booleans()), max_size=60))
def test_sequence_window_equals_a_set_of_all_numbers(steps: list[tuple[int, bool]]) -> None:
    window, naive, last = SequenceWindow(), NaiveWindow(), 0
    for number, from_here in steps:
        sequence = min(last + number if from_here else number, 2**63 - 1)
        last = sequence
        assert (sequence in window) == (sequence in naive)
        if sequence not in window:
            window.add(sequence)
            naive.taken.add(sequence)
        assert sequence in window
        assert window.gaps == naive.gaps
    for probe in {probe for taken in naive.taken for probe in (taken - WINDOW, taken - 1, taken + 1) if probe >= 0}:
        assert (probe in window) == (probe in naive)


def test_sequence_window_is_bounded_by_the_reordering_distance() -> None:
    window = SequenceWindow()
    for sequence in range(0, 20 * WINDOW, 2):  # every second number is lost
        window.add(sequence)
    assert len(window._above) <= WINDOW
    in_order = SequenceWindow()
    for sequence in range(20 * WINDOW):
        in_order.add(sequence)
    assert (in_order.low, in_order.gaps, len(in_order._above)) == (20 * WINDOW, 0, 0)


def test_large_jump_counts_all_skipped_numbers_as_gaps() -> None:
    window = SequenceWindow()
    window.add(3)
    window.add(HUGE)
    assert window.gaps == HUGE - WINDOW + 1 - 1
    assert HUGE - WINDOW in window
    assert HUGE - WINDOW + 1 not in window


# --------------------------------------------------------------------------------------------- joining

OTHER = Spaces(
    observations={"observation": ArraySpace(shape=(5,), dtype="uint8")}, actions={"action": DiscreteSpace(counts=(2,))}
)


def test_join_without_spaces_changes_nothing() -> None:
    fleet = Fleet(1, None)
    assert fleet.join(Join(actor="a", incarnation=1), 0.0) is None
    assert (fleet.spaces, fleet.actors) == (None, {})
    fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=2), 3.0)
    assert fleet.join(Join(actor="a", incarnation=2), 9.0) is None
    actor = fleet.actors["a"]
    assert (actor.incarnation, actor.incarnations, actor.last_seen, actor.environments) == (1, 1, 3.0, 2)


def test_first_join_with_spaces_sets_the_spaces_of_the_run() -> None:
    fleet = Fleet(1, None)
    assert fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=2), 0.0) is None
    assert fleet.spaces == SPACES


def test_join_with_other_spaces_is_refused_with_both_spaces_named() -> None:
    fleet = joined_fleet("a")
    refusal = fleet.join(Join(actor="b", incarnation=1, spaces=OTHER, environments=1), 0.0)
    assert refusal is not None
    assert refusal.code == "mismatch"
    assert str(OTHER) in refusal.reason
    assert str(SPACES) in refusal.reason
    assert fleet.spaces == SPACES
    assert "b" not in fleet.actors


def test_join_with_other_spaces_than_the_checkpoint_is_refused() -> None:
    refusal = Fleet(1, SPACES).join(Join(actor="a", incarnation=1, spaces=OTHER, environments=1), 0.0)
    assert refusal is not None
    assert refusal.code == "mismatch"


def test_join_with_number_of_environments_out_of_range_is_refused() -> None:
    for environments in (0, 4097, 2**62):
        fleet = Fleet(1, None)
        refusal = fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=environments), 0.0)
        assert refusal is not None
        assert refusal.code == "malformed"
        assert (fleet.spaces, fleet.actors) == (None, {})


def test_new_incarnation_replaces_an_absent_one_and_starts_without_sequence_numbers() -> None:
    fleet = joined_fleet("a")
    actor = fleet.actors["a"]
    assert fleet.find(identity("a")) is actor
    actor.sequences.add(0)
    fleet.set_present("a", 1, False)
    assert fleet.join(Join(actor="a", incarnation=2), 0.0) is None
    assert fleet.find(identity("a")) is actor  # a Join without spaces replaces no incarnation
    assert fleet.find(identity("a", incarnation=2)) is None
    assert fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=3), 0.0) is None
    assert fleet.find(identity("a")) is None
    assert fleet.find(identity("a", incarnation=2)) is actor
    assert 0 not in actor.sequences
    assert actor.incarnations == 2


def test_second_join_of_an_incarnation_keeps_its_sequence_numbers() -> None:
    fleet = joined_fleet("a")
    fleet.actors["a"].sequences.add(0)
    assert fleet.join(Join(actor="a", incarnation=1), 1.0) is None
    assert 0 in fleet.actors["a"].sequences
    assert fleet.actors["a"].incarnations == 1
    assert fleet.find(identity("a")) is not None


def test_number_of_remembered_incarnations_is_bounded() -> None:
    fleet = joined_fleet("a")
    for incarnation in range(1000):
        fleet.join(Join(actor="a", incarnation=incarnation, spaces=SPACES, environments=3), 0.0)
        fleet.actors["a"].sequences.add(0)
    assert len(fleet.actors["a"].windows) <= 8


def test_find_returns_none_for_an_unknown_actor() -> None:
    assert joined_fleet("a").find(identity("b")) is None


def test_live_actors_are_present_and_have_joined_with_spaces() -> None:
    fleet = joined_fleet("a", "b")
    fleet.join(Join(actor="c", incarnation=1), 0.0)
    fleet.set_present("c", 1, True)
    fleet.set_present("d", 1, True)
    fleet.join(Join(actor="e", incarnation=1, spaces=SPACES, environments=1), 0.0)
    assert fleet.live == {"a", "b"}
    fleet.set_present("a", 1, False)
    assert fleet.live == {"b"}


@pytest.mark.parametrize("name", ["", "a b", "a/b", "*", "x" * 65, "-a", "é"])
def test_join_with_an_invalid_name_is_refused(name: str) -> None:
    fleet = Fleet(1, None)
    refusal = fleet.join(Join(actor=name, incarnation=1, spaces=SPACES, environments=1), 0.0)
    assert refusal is not None
    assert refusal.code == "malformed"
    assert "actor name" in refusal.reason
    assert not fleet.actors


def test_actor_absent_longest_is_evicted_at_capacity() -> None:
    fleet = Fleet(1, None)

    def join(number: int) -> Refusal | None:
        return fleet.join(Join(actor=f"a{number}", incarnation=1, spaces=SPACES, environments=1), float(number))

    most = 16_384
    for number in range(most):
        assert join(number) is None
        fleet.set_present(f"a{number}", 1, True)
    refusal = join(most)
    assert refusal is not None
    assert (refusal.code, refusal.reason) == ("full", f"{most} actors have already joined")
    for away in (7, 5, 9):
        fleet.set_present(f"a{away}", 1, False)
    assert join(most) is None
    assert len(fleet.actors) == most
    assert "a5" not in fleet.actors
    assert {"a7", "a9"} < fleet.actors.keys()


def test_name_is_refused_while_its_incarnation_is_live() -> None:
    fleet = joined_fleet("a")
    other = Join(actor="a", incarnation=2, spaces=SPACES, environments=1)
    for asking in (other, Join(actor="a", incarnation=2)):
        refusal = fleet.join(asking, 1.0)
        assert refusal is not None
        assert (refusal.code, "'a'" in refusal.reason) == ("name_taken", True)
    assert (
        fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=5), 2.0) is None
    )  # the same incarnation
    fleet.set_present("a", 2, True)  # its token may be present before it joins
    assert fleet.join(other, 3.0) is not None
    fleet.set_present("a", 1, False)
    assert fleet.join(other, 4.0) is None
    assert fleet.live == {"a"}
    assert fleet.actors["a"].incarnations == 2


def test_name_of_a_quarantined_actor_can_be_reused() -> None:
    fleet = joined_fleet("a")
    fleet.actors["a"].quarantined = "nonsense"
    assert fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=1), 0.0) is None


def test_presence_of_another_incarnation_does_not_make_an_actor_live() -> None:
    fleet = joined_fleet("a")
    fleet.set_present("a", 2, True)
    fleet.set_present("a", 1, False)
    assert not fleet.live
    assert [status.alive for status in fleet.statuses(0.0)] == [False]


def test_presence_without_join_does_not_create_an_actor() -> None:
    fleet = Fleet(1, None)
    fleet.set_present("a", 1, True)
    assert not fleet.actors
    fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=1), 0.0)
    assert fleet.live == {"a"}


def test_missed_rollouts_are_counted_and_fit_the_wire_integer() -> None:
    fleet = joined_fleet("a")
    fleet.actors["a"].sequences.add(WINDOW + 4)
    assert fleet.statuses(0.0)[0].rollouts_missed == 5
    fleet.actors["a"].sequences.add(2**63 - 1)
    fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=1), 0.0)
    fleet.actors["a"].sequences.add(2**63 - 1)
    assert fleet.statuses(0.0)[0].rollouts_missed < 2**63


def test_seeds_depend_on_actor_incarnation_start_version_and_run_seed() -> None:
    def seeds(run_seed: int) -> dict[tuple[str, int, int], int]:
        fleet = Fleet(run_seed, None)
        found = {}
        for incarnation in (1, 2):
            for name in ("a", "b"):
                fleet.join(Join(actor=name, incarnation=incarnation, spaces=SPACES, environments=1), 0.0)
                for start in (0, 500):
                    found[name, incarnation, start] = fleet.seed_for(name, start)
        return found

    assert seeds(1) == seeds(1)
    assert len({*seeds(1).values(), *seeds(2).values()}) == 16


def test_statuses_are_sorted_by_actor_name() -> None:
    fleet = joined_fleet("b", "a")
    fleet.actors["b"].rejected["stale"] += 2
    fleet.actors["b"].accepted = 5
    fleet.set_present("b", 1, False)
    first, second = fleet.statuses(3.0)
    assert (first.actor, first.alive, first.seconds_since_seen, first.environments) == ("a", True, 3.0, 3)
    assert (second.actor, second.alive, second.rollouts_accepted) == ("b", False, 5)
    assert second.rollouts_rejected == {"stale": 2}
