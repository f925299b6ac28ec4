"""Which incarnations of actors are present, by their liveliness tokens. State; no I/O, no threads."""

from collections import Counter

from daedalus.protocol import keys

_MAX_OF_ONE_OWNER = 8192  # tokens: twice the actors that one owner may have


class Presence:
    """Set of present incarnations. The number of one owner is bounded: further ones do not count as present."""

    def __init__(self) -> None:
        self._present: set[tuple[str, int]] = set()
        self._of_owner: Counter[str] = Counter()

    def __contains__(self, incarnation: tuple[str, int]) -> bool:
        return incarnation in self._present

    def set(self, name: str, incarnation: int, present: bool) -> None:
        """Record whether the token of an incarnation of the actor `name` is present."""
        key, owner = (name, incarnation), keys.owner(name)
        if present and key not in self._present and self._of_owner[owner] < _MAX_OF_ONE_OWNER:
            self._present.add(key)
            self._of_owner[owner] += 1
        elif not present and key in self._present:
            self._present.remove(key)
            self._of_owner[owner] -= 1
        if not self._of_owner[owner]:
            del self._of_owner[owner]
