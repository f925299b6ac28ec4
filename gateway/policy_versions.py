"""The versions of a policy that clients use side by side. State without threads or I/O."""

import weakref
from dataclasses import dataclass

from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.lessons import LessonPlan
from daedalus.protocol.messages import Welcome

# Versions that are in use at the same time: at least so many, and as many as fit these bytes.
_MIN_VERSIONS, _VERSION_BYTES = 8, 512 << 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class PolicyVersion:
    """Weights in a runtime. Several versions act in turn: a client keeps one for a whole rollout."""

    session: Welcome  # of the learner epoch that it belongs to
    version: int
    runtime: OnnxRuntime
    size: int  # of the weights, in bytes
    lessons: LessonPlan | None  # in a run with lessons


class PolicyVersions:
    """The version that new rollouts use, and a limit on the memory of all that are in use."""

    def __init__(self) -> None:
        self._current: PolicyVersion | None = None
        self._newest: PolicyVersion | None = None  # that waits for an older one to be released
        self._in_use: weakref.WeakSet[PolicyVersion] = weakref.WeakSet()

    def of(self, session: Welcome | None) -> PolicyVersion | None:
        """Return the current version if it belongs to a session, or None."""
        return self._current if self._current is not None and self._current.session is session else None

    @property
    def current(self) -> PolicyVersion:
        """The version that new rollouts use. Call only when there has been one."""
        assert self._current is not None  # nobody is admitted before
        return self._current

    def offer(self, version: PolicyVersion) -> None:
        """Note a newer version. Call `adopt` next."""
        self._newest = version
        if self._current is not None and self._current.session is not version.session:
            self._current = None

    def adopt(self) -> bool:
        """Let new rollouts use the newest version, if there is one and room for it; return whether that changed."""
        version = self._newest
        if version is None or self.is_full:
            return False
        self._current, self._newest = version, None
        self._in_use.add(version)
        return True

    @property
    def is_full(self) -> bool:
        """Whether a newer version waits until clients release an older one."""
        if self._newest is None or self._current is None:
            return False
        return len(self._in_use) >= max(_MIN_VERSIONS, _VERSION_BYTES // self._newest.size)

    def clear(self) -> None:
        """Forget the versions of a run that has ended."""
        self._current = self._newest = None
