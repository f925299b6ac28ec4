"""The process group of a learner: tensors between its ranks, with a time limit. Nothing that it moves can execute.

It uses torch's process groups themselves. The functions of torch.distributed for objects may execute what they
receive.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed
from torch import Tensor

from daedalus.learner.ranks.errors import RankLostError
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_code import message_line

if TYPE_CHECKING:
    from torch._C._distributed_c10d import Store

_distributed: Any = torch.distributed  # its types lack most of what is used here

LIMIT_SECONDS = 120.0  # for a rank to answer; longer than any single update and any save of a checkpoint
_LOOPBACK = "127.0.0.1"
_MOST_TEXT = 4 << 20  # bytes of a text that rank 0 sends
_REPORT = 1024  # bytes of a text that another rank sends


class Group:
    """This process as one of the ranks. Tensors in main memory travel with gloo, those on a GPU with NCCL."""

    def __init__(
        self,
        store: "Store",
        rank: int,
        number: int,
        *,
        on_this_machine: bool,
        seconds: float = LIMIT_SECONDS,
    ) -> None:
        """Connect to all other ranks.

        Args:
          store: where the ranks find each other.
          rank: number of this process, from 0.
          number: of processes.
          on_this_machine: whether all of them are on this machine, and listen on its loopback interface.
          seconds: limit of each operation.

        Raises RankLostError if not all ranks connect in time.
        """
        self.rank, self.number = rank, number
        self.waiting_since: float | None = None  # for other ranks, on the monotonic clock
        self._store, self._limit = store, timedelta(seconds=seconds)
        self._nccl: Any = None
        with self._waiting():
            store.set_timeout(self._limit)
            self._gloo: Any = _gloo(_distributed.PrefixStore("gloo", store), rank, number, self._limit, on_this_machine)

    @property
    def others(self) -> range:
        """The other ranks, for rank 0."""
        return range(1, self.number)

    def use_gpu(self, index: int) -> None:
        """Use a GPU of this machine, and exchange tensors on it. Raises SettingsError if there is no such GPU."""
        count = torch.cuda.device_count()
        if index >= count:
            raise SettingsError(
                f"training.device is cuda, and each process of a learner needs a GPU of its own: there are {count} here"
            )
        torch.cuda.set_device(index)
        with self._waiting():
            self._nccl = _nccl(_distributed.PrefixStore("nccl", self._store), self.rank, self.number, self._limit)

    # ----------------------------------------------------------------------------- of algorithms.ranks.Ranks

    def sum(self, values: Tensor) -> Tensor:
        """Add up the values of all ranks in place. See Ranks."""
        values = values.contiguous()
        self._do(lambda: self._of(values).allreduce(values))
        return values

    def permutation(self, number: int) -> Tensor:
        """See Ranks. Only rank 0 draws, as a learner of one process does."""
        return self.first(torch.zeros(number, dtype=torch.int64) if self.rank else torch.randperm(number))

    def first(self, values: Tensor) -> Tensor:
        """Replace the values, of the same shape on all ranks, by those of rank 0, in place."""
        values = values.contiguous()
        if values.numel():
            self._do(lambda: self._of(values).broadcast(values, 0))
        return values

    # ----------------------------------------------------------------------------- tensors in main memory

    def send(self, tensors: Sequence[Tensor], rank: int) -> None:
        """Send contiguous tensors to a rank, which receives as many of the same sizes."""
        works: list[Any] = []
        with self._waiting():
            works += [self._gloo.send([tensor], rank, 0) for tensor in tensors if tensor.numel()]
            for work in works:
                work.wait()

    def receive(self, tensors: Sequence[Tensor], rank: int) -> None:
        """Receive contiguous tensors in place from a rank. See send."""
        for tensor in tensors:
            if tensor.numel():
                self._do(lambda tensor=tensor: self._gloo.recv([tensor], rank, 0))

    def announce(self, text: str = "") -> str:
        """Return the text of rank 0, to which alone the argument belongs. Raises RankLostError if it is too long."""
        encoded = torch.frombuffer(bytearray(text.encode() or b" "), dtype=torch.uint8)
        size = int(self.first(torch.tensor(len(encoded))))
        if not 0 < size <= _MOST_TEXT:
            raise RankLostError(f"rank 0 sends a text of {size} bytes, {_MOST_TEXT} at most are allowed")
        encoded = encoded if self.rank == 0 else torch.zeros(size, dtype=torch.uint8)
        return self.first(encoded).numpy().tobytes().decode()

    def report(self, text: str = "") -> list[str]:
        """Give rank 0 a short text of each other rank; rank 0 returns them, by rank from 1."""
        if self.rank:
            encoded = text.encode()[:_REPORT].ljust(_REPORT)
            self.send([torch.frombuffer(bytearray(encoded), dtype=torch.uint8)], 0)
            return []
        texts = []
        for rank in self.others:
            received = torch.zeros(_REPORT, dtype=torch.uint8)
            self.receive([received], rank)
            texts.append(received.numpy().tobytes().decode(errors="replace").strip())
        return texts

    # ----------------------------------------------------------------------------- torch's process groups

    def _of(self, values: Tensor) -> Any:
        return self._nccl if self._nccl is not None and values.is_cuda else self._gloo

    def _do(self, begin: Callable[[], Any]) -> None:
        with self._waiting():
            begin().wait()

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        self.waiting_since = time.monotonic()
        try:
            yield
        except RuntimeError as error:  # torch has no narrower error for a closed connection or a time limit
            raise RankLostError(message_line(error)) from None
        finally:
            self.waiting_since = None


def _gloo(store: "Store", rank: int, number: int, limit: timedelta, on_this_machine: bool) -> Any:
    gloo = _distributed.ProcessGroupGloo
    if not on_this_machine:
        return gloo(store, rank, number, limit)  # on the interfaces of GLOO_SOCKET_IFNAME, if it is set
    options = gloo._Options()
    options._devices = [gloo.create_device(hostname=_LOOPBACK)]
    options._timeout = limit
    options._threads = 2
    return gloo(store, rank, number, options)


def _nccl(store: "Store", rank: int, number: int, limit: timedelta) -> Any:
    nccl = _distributed.ProcessGroupNCCL  # only in builds of torch with CUDA
    options = nccl.Options()
    options._timeout = limit
    return nccl(store, rank, number, options)
