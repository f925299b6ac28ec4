"""A hint for the user where no episode ends. State; no I/O."""

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.fleet import Fleet

# env_steps in each environment without the end of an episode after which a hint is given; the least in a small budget.
_LONG_EPISODE, _USUAL_EPISODE = 10_000, 2_000


class EpisodeHint:
    """Hint that no episode has ended after many steps, or after half of a small budget; given once."""

    def __init__(self, budget: int) -> None:
        """`budget` is in env_steps."""
        self._budget, self._given = budget, False

    def take(self, counters: RunCounters, fleet: Fleet) -> str:
        """Return the hint if it is due, else an empty string."""
        environments = max(sum(fleet.actors[name].environments for name in fleet.live), 1)
        length = min(_LONG_EPISODE, max(_USUAL_EPISODE, self._budget // (2 * environments)))
        if self._given or counters.episodes or counters.env_steps < environments * length:
            return ""
        self._given = True
        return (
            f"no episode has ended after {length:,} env_steps in each environment: "
            "if the environment never ends them, set environment.max_episode_steps"
        )
