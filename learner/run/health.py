"""Health of a learner process: what its status reports as problems. State; no I/O."""

from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field

_STALLED_SECONDS = 60.0  # without an update for so long, the service has a problem
_FAR_SECONDS = 60.0  # so long after a rollout far outside what others send, its sender is a problem
SLOW_DISK_SECONDS = 10.0  # in which a disk has written a checkpoint, or a row of metrics
_NO_ACTOR_SECONDS = 10.0  # without a live actor for so long, the service has a problem


@dataclass(slots=True)
class Health:
    """Health of the learner process. Times are on the monotonic clock, in seconds."""

    started: float
    updated: float  # time of the last update, or the start
    actor_seen: float  # last time with a live actor, or the start
    directory: str = ""  # of the run, as the problems name it
    saved: float | None = None  # time of the last checkpoint
    saving_since: float | None = None  # since when a checkpoint is being written, if one is
    save_fault: str = ""  # error of the last checkpoint, if it failed
    left_out: Set[str] = frozenset()  # names of the live actors that no batch waits for
    # By actor whose rollouts were left out because their numbers are far outside: which numbers, and the last time.
    far_outside: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    gradient_fault: bool = False  # whether the last update was skipped
    # Since when metrics and events are being written, or None if they are not.
    recording_since: Callable[[], float | None] = lambda: None
    # Days until the certificate of this process expires, or None without one.
    certificate_days_left: Callable[[], float | None] = lambda: None

    def note_far_outside(self, components: Mapping[str, str], now: float) -> None:
        """Note actors whose rollouts were left out because numbers are far outside, and their components."""
        recent = {name: each for name, each in self.far_outside.items() if now - each[1] < _FAR_SECONDS}
        self.far_outside = recent | {name: (component, now) for name, component in components.items()}

    def problems(self, now: float, live: int) -> tuple[str, ...]:
        """Return descriptions of the problems, most severe first; empty if the service is healthy.

        Args:
          now: time on the monotonic clock, in seconds.
          live: number of live actors.
        """
        found = []
        if not live and now - self.actor_seen > _NO_ACTOR_SECONDS:
            found.append(f"no live actor for {now - self.actor_seen:.0f} s")
        elif now - self.updated > _STALLED_SECONDS:
            found.append(f"no update for {now - self.updated:.0f} s")
        if self.left_out:
            names = sorted(self.left_out)
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            found.append(f"batches do not wait for {', '.join(names[:5])}{more}: connected, but without rollouts")
        far = {name: each for name, (each, last) in self.far_outside.items() if now - last < _FAR_SECONDS}
        if far:
            names = [f"{name} ({component})" for name, component in sorted(far.items())]
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            found.append(f"rollouts with numbers far outside those of other actors: {', '.join(names[:5])}{more}")
        if self.gradient_fault:
            found.append("updates are skipped: the gradient is not finite")
        if self.save_fault:
            found.append(f"checkpoints cannot be saved: {self.save_fault}")
        for what, since in (("the checkpoint has", self.saving_since), ("metrics have", self.recording_since())):
            if since is not None and now - since > SLOW_DISK_SECONDS:
                waited = f"{what} been writing for {now - since:.0f} s"
                found.append(f"{waited}: the disk of {self.directory} is slow; training continues")
        return tuple(found)
