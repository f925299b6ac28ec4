"""Where the ranks of a learner find each other. Without torch, so that a command can import it early."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_code import message_line

if TYPE_CHECKING:
    from torch._C._distributed_c10d import Store

    from daedalus.learner.ranks.group import Group

_LOOPBACK = {"localhost", "127.0.0.1", "::1"}
_VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
_MOST_RANKS = 256
_MEET_SECONDS = 300.0  # for all ranks to start
_POLL_SECONDS = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Meeting:
    """One rank's knowledge of the others before they are connected."""

    rank: int
    number: int  # of ranks
    local_rank: int  # number of this rank among those of its machine: which GPU it uses
    on_this_machine: bool  # whether all ranks are
    folder: Path | None = None  # private folder of this machine where they meet; None: they meet at `address`
    address: tuple[str, int] | None = None  # host and port
    is_served: bool = False  # whether the launcher listens there; else rank 0 does
    attempt: int = 0  # number of the launcher's start of all ranks, from 0

    def connect(self, is_over: Callable[[], bool] = lambda: False) -> "Group | None":
        """Wait for all other ranks, and connect. Return None if `is_over`, which is called again and again, is true.

        Raises RankLostError if they do not come in time.
        """
        from daedalus.learner.ranks.errors import RankLostError
        from daedalus.learner.ranks.group import Group

        # Not in torch's own functions: they wait in native code, where no signal is handled.
        try:
            store = self._store()
            store.set(f"here/{self.rank}", "")
            deadline = time.monotonic() + _MEET_SECONDS
            while not store.check([f"here/{rank}" for rank in range(self.number)]):
                if is_over():
                    return None
                if time.monotonic() > deadline:
                    raise RankLostError(f"not all {self.number} processes have started within {_MEET_SECONDS:g} s")
                time.sleep(_POLL_SECONDS)
        except RuntimeError as error:  # of torch, which has no narrower one
            first_line = message_line(error)
            raise RankLostError(f"no connection to the meeting point of the processes: {first_line}") from None
        return Group(store, self.rank, self.number, on_this_machine=self.on_this_machine)

    def _store(self) -> "Store":
        """Return torch's store of the meeting."""
        from torch._C._distributed_c10d import FileStore, PrefixStore, TCPStore

        if self.folder is not None:
            return FileStore(str(self.folder / "ranks"), self.number)
        assert self.address is not None
        store = TCPStore(
            *self.address,
            self.number,
            is_master=self.rank == 0 and not self.is_served,
            timeout=timedelta(seconds=_MEET_SECONDS),
            wait_for_workers=False,
        )
        return PrefixStore(f"attempt-{self.attempt}", store)


def meeting_of(environment: Mapping[str, str], *, insecure: bool) -> Meeting | None:
    """Return the meeting that torchrun, or another launcher, describes in environment variables, or None.

    Args:
      environment: variables by name.
      insecure: whether ranks may exchange data over a network. They use no encryption and no authentication.

    Raises SettingsError for invalid variables, and for another machine without `insecure`.
    """
    if not all(name in environment for name in _VARIABLES):
        return None
    number = _number(environment, "WORLD_SIZE", 1, _MOST_RANKS)
    rank = _number(environment, "RANK", 0, number - 1)
    local_rank = _number(environment, "LOCAL_RANK", 0, number - 1, otherwise=rank)
    port = _number(environment, "MASTER_PORT", 1, 65535)
    on_this_machine = environment["MASTER_ADDR"] in _LOOPBACK
    if number == 1:
        return None
    if not on_this_machine and not insecure:
        raise SettingsError(
            f"MASTER_ADDR is {environment['MASTER_ADDR']}: processes of a learner on several hosts exchange their data "
            "without encryption; if nobody else can reach that network, add --insecure"
        )
    return Meeting(
        rank=rank,
        number=number,
        local_rank=local_rank,
        on_this_machine=on_this_machine,
        address=(environment["MASTER_ADDR"], port),
        is_served=environment.get("TORCHELASTIC_USE_AGENT_STORE") == "True",
        attempt=_number(environment, "TORCHELASTIC_RESTART_COUNT", 0, 10**9, otherwise=0),
    )


def _number(environment: Mapping[str, str], name: str, least: int, most: int, otherwise: int | None = None) -> int:
    """Return the number in a variable; `otherwise` if there is none."""
    if otherwise is not None and name not in environment:
        return otherwise
    text = environment[name]
    if not text.isdecimal() or not least <= int(text) <= most:
        raise SettingsError(
            f"the environment variable {name} is {text!r}, it must be a number from {least} to {most}: "
            "unset it, or start the processes with torchrun"
        )
    return int(text)
