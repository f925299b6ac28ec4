"""The result of an attack."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the service held, and what was measured."""

    held: bool
    measured: str

    def __str__(self) -> str:
        return f"{'held' if self.held else 'BROKEN'}: {self.measured}"
