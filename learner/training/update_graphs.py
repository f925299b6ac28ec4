"""All updates of a batch as one launch: CUDA graphs, and the copies to the device beside them."""

import contextlib
import logging
import traceback
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.learner.run.settings import DeviceError, DeviceLostError, SettingsError
from daedalus.policy.user_code import first_line

_EARLIER_CALLS = 8  # with the shapes of a graph: they may be rare, and libraries of CUDA prepare at the first calls
_MOST_GRAPHS = 4  # each has a batch and all intermediate results of its updates in the memory of the device
_MOST_SHAPES = 1000  # that are counted

_logger = logging.getLogger(__name__)

Result = TypeVar("Result")


def check_device(precision: str) -> None:
    """Raise DeviceError if there is no CUDA device, SettingsError if it cannot compute in the precision of the run."""
    if not torch.cuda.is_available():
        raise DeviceError(
            "training.device is cuda, but torch finds no CUDA device: install the NVIDIA driver and a CUDA build of "
            "torch, or set training.device=cpu"
        )
    if precision == "bfloat16" and not torch.cuda.is_bf16_supported(including_emulation=False):
        raise SettingsError(
            f"training.precision is bfloat16, which {torch.cuda.get_device_name()} does not multiply: leave "
            "training.precision=auto, which takes float32 here"
        )


@contextlib.contextmanager
def memory_faults(
    rows: int, fitting: Callable[[], int], remedy: str = "training.batch_rollouts, or more training.minibatches,"
) -> Iterator[None]:
    """Raise DeviceError if a GPU lacks memory in the block.

    Args:
      rows: of the batch.
      fitting: returns the number of rows that fit into its memory.
      remedy: the settings that choose the number of rows.
    """
    try:
        yield
    except torch.OutOfMemoryError as error:
        traceback.clear_frames(error.__traceback__)  # they hold the tensors of the attempt
        fit = fitting()
        advice = (
            f"{fit:,} rows fit: set {remedy} accordingly"
            if fit
            else "nor do fewer: use smaller observations or a smaller network"
        )
        raise DeviceError(
            f"the updates of a batch of {rows:,} rows do not fit into the memory of the GPU; {advice}"
        ) from None


@contextlib.contextmanager
def driver_faults() -> Iterator[None]:
    """Raise DeviceLostError if a GPU fails in the block: any operation that waits for it may be the first to notice."""
    try:
        yield
    except RuntimeError as error:
        if not _is_of_driver(error):
            raise
        raise DeviceLostError(
            f"the GPU has failed: {first_line(error)}. What was learned since the last checkpoint is lost: repair the "
            "driver, then resume the run"
        ) from error


def _is_of_driver(error: RuntimeError) -> bool:
    return isinstance(error, torch.AcceleratorError) or str(error).startswith(("CUDA error", "CUDA driver"))


class UpdateGraphs:
    """Calls a function of batches; on a GPU it is recorded for each shape of batches, and repeated with one launch.

    A small network on a GPU takes most of its time between launches. A recording repeats the operations at the same
    places in memory: the function must not depend on a value of a tensor on the CPU, what it uses besides the batch
    must stay in its place, and its results are overwritten by its next call.
    See https://docs.pytorch.org/docs/stable/notes/cuda.html#cuda-graphs.
    """

    def __init__(self, device: torch.device, *, can_record: bool) -> None:
        """Construct it. `can_record`: whether the function is as the class demands; else it is called as it is."""
        self._device = device
        self.is_enabled = can_record and device.type == "cuda"
        self.records = False  # whether a function is being recorded now, so that it must read no value
        self._calls: dict[tuple[Any, ...], int] = {}
        self._graphs: dict[tuple[Any, ...], tuple[Any, Batch, Any]] = {}  # the graph, its batch, and its results
        self._copies: Any = torch.cuda.Stream(device) if device.type == "cuda" else None

    def moved(self, batch: Batch) -> Batch:
        """Return the batch on the device, without stacks of frames. It is copied while the device computes.

        Its memory may be released when the call with this batch has ended on the device.
        """
        if self._copies is None:
            return batch
        with torch.cuda.stream(self._copies):
            return batch.moved(lambda values: values.to(self._device, non_blocking=True))

    def call(self, function: Callable[[Batch, int], Result], batch: Batch, number: int) -> Result:
        """Return the result of a function of a batch, which `moved` has returned, and a number."""
        if self._copies is not None:
            torch.cuda.current_stream(self._device).wait_stream(self._copies)
            for values in batch.tensors():
                values.record_stream(torch.cuda.current_stream(self._device))
        if not self.is_enabled:
            return function(batch, number)
        key = (number, *((each.shape, each.dtype) for each in batch.tensors()))
        if key not in self._graphs:
            if len(self._calls) == _MOST_SHAPES:
                self._calls.clear()
            self._calls[key] = self._calls.get(key, 0) + 1
            if self._calls[key] <= _EARLIER_CALLS:
                return self._beside(function, batch, number)
            if not self._record(key, function, batch, number):
                return function(batch, number)
        graph, inputs, result = self._graphs[key] = self._graphs.pop(key)  # the most recently used is the last
        for place, values in zip(inputs.tensors(), batch.tensors(), strict=True):
            place.copy_(values, non_blocking=True)
        graph.replay()
        return result

    def forget(self) -> None:
        """Release the memory of all recordings."""
        self._graphs.clear()
        if self._copies is not None:
            torch.cuda.empty_cache()

    def begin_copy(self, tensors: dict[str, Tensor]) -> Callable[[], dict[str, Tensor]]:
        """Begin to copy tensors from a GPU, beside what it computes; return what waits for them, in any thread."""
        copies = torch.cuda.Stream(self._device)  # not that of the next batch, which need not wait for the updates
        now = {name: values.clone() for name, values in tensors.items()}  # the next update changes them in place
        copies.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(copies):
            copied = {name: values.to("cpu", non_blocking=True) for name, values in now.items()}  # in pinned memory
            done = copies.record_event()

        def wait() -> dict[str, Tensor]:
            done.synchronize()
            now.clear()  # not before: its memory would be used again
            return copied

        return wait

    def _beside(self, function: Callable[[Batch, int], Result], batch: Batch, number: int) -> Result:
        """Call the function on a stream of its own, as CUDA's libraries want it before a recording."""
        stream, current = torch.cuda.Stream(self._device), torch.cuda.current_stream(self._device)
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            result = function(batch, number)
        current.wait_stream(stream)
        torch.cuda.current_stream(self._device).synchronize()  # before anything that it made is released
        return result

    def _record(self, key: tuple[Any, ...], function: Callable[[Batch, int], Any], batch: Batch, number: int) -> bool:
        """Record the function, which computes nothing now. Return False if it cannot be recorded."""
        torch.cuda.synchronize(self._device)
        del self._calls[key]
        if len(self._graphs) == _MOST_GRAPHS:
            del self._graphs[next(iter(self._graphs))]
        inputs = batch.moved(torch.clone)
        graph = torch.cuda.CUDAGraph()
        self.records = True
        try:
            # Other threads may use the device meanwhile: a snapshot may be on its way.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                result = function(inputs, number)
        except RuntimeError as error:  # also for want of memory: the updates alone fit, as they did before
            self.is_enabled = False
            _logger.warning("updates are launched one by one, and take longer: %s", first_line(error))
            torch.cuda.synchronize(self._device)
            self.forget()
            return False
        finally:
            self.records = False
        self._graphs[key] = graph, inputs, result
        return True
