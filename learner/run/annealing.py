"""How far annealed settings are on the way to their final values. Pure."""

from typing import Any

from pydantic import BaseModel


class Annealing(BaseModel, frozen=True, strict=True, extra="forbid"):
    """Progress of the annealed settings over the budget of a run, from 0 to 1.

    The progress grows linearly from `progress` at `env_steps` to 1 at `budget`. A new run begins at 0. A run that is
    resumed with another budget goes on from the progress that it had, so that no setting jumps back.
    """

    budget: int  # env_steps
    env_steps: int = 0
    progress: float = 0.0

    def at(self, env_steps: int) -> float:
        """Return the progress after so many env_steps of the run."""
        remaining = self.budget - self.env_steps
        if env_steps >= self.budget or remaining <= 0:
            return 1.0
        return self.progress + (1.0 - self.progress) * ((env_steps - self.env_steps) / remaining)

    def resumed(self, env_steps: int, budget: int) -> "Annealing":
        """Return the annealing of a run that is resumed after `env_steps` with a budget."""
        if budget == self.budget:
            return self
        return Annealing(budget=budget, env_steps=env_steps, progress=self.at(env_steps))

    def state(self) -> dict[str, Any]:
        """Return the fields as plain JSON values."""
        return self.model_dump()
