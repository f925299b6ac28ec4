"""learner/serving/fleet.py: received sequence numbers, against a set of all numbers."""

from hypothesis import given
from hypothesis import strategies as st

from daedalus.learner.serving.actor_state import SequenceWindow

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


def test_given_up_numbers_are_gaps_and_never_accepted() -> None:
    window = SequenceWindow()
    for sequence in (0, 1, 3, 6):
        window.add(sequence)
    window.give_up()
    assert (window.low, window.gaps, 7 in window) == (7, 3, False)
    assert all(sequence in window for sequence in range(7))
    window.give_up()
    assert (window.low, window.gaps) == (7, 3)
