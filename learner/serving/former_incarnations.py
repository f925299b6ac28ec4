"""What the learner remembers of incarnations that are no longer current. State; no I/O, no threads."""

from dataclasses import dataclass

_MAX_FORMER = 65_536  # 20 MB; 50 MB if all were quarantined


@dataclass(frozen=True, slots=True, kw_only=True)
class Former:
    """One incarnation of an actor that was forgotten or replaced."""

    next_sequence: int = 0  # all numbers below were received or given up
    replaced: bool = False  # whether another incarnation joined under the name: this one cannot join again
    quarantined: str = ""  # the reason, if it was quarantined


_UNKNOWN = Former()


class FormerIncarnations:
    """Record of former incarnations, so that none of their rollouts is accepted a second time.

    An incarnation that was replaced never becomes current again, and one that was forgotten continues above the highest
    sequence number that was received from it. The record is bounded: the oldest entry makes room for the newest. What
    protects from a second use of its rollouts is then the bound on the policy lag alone.
    """

    def __init__(self) -> None:
        self._former: dict[tuple[str, int], Former] = {}  # by name and incarnation, the newest entry last

    def __getitem__(self, key: tuple[str, int]) -> Former:
        return self._former.get(key, _UNKNOWN)

    def __len__(self) -> int:
        return len(self._former)

    def add(self, name: str, incarnation: int, former: Former) -> None:
        """Remember an incarnation of the actor `name`."""
        self._former.pop((name, incarnation), None)
        while len(self._former) >= _MAX_FORMER:
            del self._former[next(iter(self._former))]
        self._former[name, incarnation] = former
