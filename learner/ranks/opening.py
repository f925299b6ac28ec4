"""Connection of rank 0 with the other ranks, which can be interrupted."""

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from daedalus.learner.ranks.meeting import Meeting
from daedalus.protocol.spec import RunSpec

if TYPE_CHECKING:
    from daedalus.learner.ranks.agreement import Options
    from daedalus.learner.ranks.group import Group
    from daedalus.learner.ranks.leader import OtherRanks

_POLL_SECONDS = 0.1
_GRACE_SECONDS = 2.0  # for the other ranks to answer after a signal has stopped this one

OpenRanks = Callable[[RunSpec, threading.Event], "OtherRanks | None"]  # None: stopped before all had connected


def no_other_ranks(_spec: RunSpec, _stop: threading.Event) -> "OtherRanks | None":
    """Return the null object for a learner without other ranks."""
    from daedalus.learner.ranks.leader import NO_OTHER_RANKS

    return NO_OTHER_RANKS


def lead(
    meeting: Meeting,
    options: "Options | None",
    spec: RunSpec,
    stop: threading.Event,
    check: Callable[[], None],
    give_up: Callable[[], None],
) -> "OtherRanks | None":
    """Connect rank 0 with all others. Return None if `stop` is set before.

    Args:
      meeting: where they meet.
      options: of the command line, if that has started the other ranks too.
      spec: settings of the run.
      stop: ends the run.
      check: raises RankLostError if a rank has died; called again and again until all have connected.
      give_up: called, on another thread, if a rank still keeps this one waiting after `stop` was set.

    Raises RankLostError, RanksDisagreeError, or SettingsError if there is no GPU for this rank.
    """
    from daedalus.learner.ranks.agreement import this_run
    from daedalus.learner.ranks.leader import Leader

    def is_over() -> bool:
        check()
        return stop.is_set()

    group = meeting.connect(is_over)
    if group is None:
        return None
    threading.Thread(target=_watch, args=(group, stop, give_up), name="ranks-watch", daemon=True).start()
    if spec.training.device == "cuda":
        group.use_gpu(meeting.local_rank)
    return Leader(group, this_run(spec, options))


def _watch(group: "Group", stop: threading.Event, give_up: Callable[[], None]) -> None:
    stop.wait()
    while True:
        time.sleep(_POLL_SECONDS)
        since = group.waiting_since
        if since is not None and time.monotonic() > since + _GRACE_SECONDS:
            give_up()
            return
