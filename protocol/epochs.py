"""Learner epochs: 62 bits, of which the upper 22 count the starts of a run's learner and the lower 40 are random.

A learner that resumes from a checkpoint has a larger epoch than each learner before that checkpoint, whatever the
clocks of their hosts say. Of two learners of one run, the one with the larger epoch is the newer: so a run that was
continued from a copy goes on there, and not where it was copied from. Pure functions.
"""

import secrets

_RANDOM_BITS = 40
_MOST_STARTS = (1 << 22) - 1


def new_epoch(starts: int) -> int:
    """Return an epoch for the learner process number `starts` of a run; the first is 1."""
    return min(starts, _MOST_STARTS) << _RANDOM_BITS | secrets.randbits(_RANDOM_BITS)


def starts_of(epoch: int) -> int:
    """Return how many learner processes the run had, as far as the learner with this epoch knows."""
    return epoch >> _RANDOM_BITS
