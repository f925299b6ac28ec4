"""An onnxruntime session for a program that another process wrote: its operators, memory and time are bounded."""

import contextlib
import functools
import os
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime

from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.user_code import message_line

CALL_SECONDS = 60.0  # a policy needs milliseconds
STOP_SECONDS = 1.0  # for a call that is running when the process is asked to stop
_TICK_SECONDS = 0.2


class CallWatchdog:
    """Cancels a call that takes longer than `CALL_SECONDS`, or than `STOP_SECONDS` after `stop`.

    Time is counted in wake-ups of the watchdog's thread: while the process is frozen, no time passes. The thread ends
    when the watchdog is garbage-collected.
    """

    def __init__(self, stop: threading.Event | None) -> None:
        self._stop, self._stopped_at = stop, float("inf")
        self._lock = threading.Lock()  # guards the next three attributes
        self._now = 0.0
        self._began = 0.0
        self._cancel: Callable[[], None] | None = None
        threading.Thread(target=_watch, args=(weakref.ref(self),), name="call-watchdog", daemon=True).start()

    def begin(self, cancel: Callable[[], None]) -> None:
        """Note that a call begins; `cancel` makes it fail soon."""
        with self._lock:
            self._cancel, self._began = cancel, self._now

    def end(self) -> None:
        """Note that the call ended: `cancel` will not be called any more."""
        with self._lock:
            self._cancel = None

    def tick(self) -> None:
        """Let one tick pass, and cancel the call in progress if it is late."""
        with self._lock:
            self._now += _TICK_SECONDS
            if self._stop is not None and self._stop.is_set():
                self._stopped_at = min(self._stopped_at, self._now)
            deadline = min(self._began + CALL_SECONDS, max(self._stopped_at, self._began) + STOP_SECONDS)
            if self._cancel is not None and self._now > deadline:
                self._cancel()


def _watch(reference: weakref.ref[CallWatchdog]) -> None:
    while (watchdog := reference()) is not None:
        watchdog.tick()
        del watchdog
        time.sleep(_TICK_SECONDS)


MAX_MEMORY_BYTES = 1 << 30  # of all tensors that the programs of this process compute
# onnxruntime computes constants when it loads a program, in memory that the limit above does not cover.
_MAX_CONSTANT_BYTES = 256 << 10  # each; a program has at most MAX_NODES
_CONFIGURATION = {
    "session.intra_op.allow_spinning": "0",  # spinning threads would take time from other processes
    "session.use_env_allocators": "1",
    "session.load_model_format": "ONNX",  # not onnxruntime's own format, which the checks do not read
    # A model may name files to read weights from. A received program must not read files: no such file exists here.
    "session.model_external_initializers_file_folder_path": os.devnull,
    "optimization.constant_folding_max_output_size_in_bytes": str(_MAX_CONSTANT_BYTES),
}


class ProgramSession:
    """A loaded program. The caller has checked it (policy/acting/program_check.py)."""

    def __init__(self, model: bytes, watchdog: CallWatchdog, threads: int = 1) -> None:
        """Raise PolicyError if onnxruntime cannot load the program."""
        _bound_memory()
        options = onnxruntime.SessionOptions()
        # An actor has one core at most.
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        for name, value in _CONFIGURATION.items():
            options.add_session_config_entry(name, value)
        self._watchdog = watchdog
        self._run_options = onnxruntime.RunOptions()
        watchdog.begin(lambda: options.set_load_cancellation_flag(True))
        try:
            self.onnx = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
            self._outputs = [output.name for output in self.onnx.get_outputs()]
        except Exception as error:  # onnxruntime's exceptions share no base of their own
            raise PolicyError(f"the program cannot be run: {_first_line(error)}") from None
        finally:
            watchdog.end()

    def run(self, feed: dict[str, np.ndarray]) -> list[Any]:
        """Return the program's outputs. Raises PolicyError if it fails or does not end in time."""
        self._watchdog.begin(self._terminate)
        try:
            return list(self.onnx.run(self._outputs, feed, self._run_options))
        except Exception as error:  # onnxruntime's exceptions share no base of their own
            late = "it took too long: " if self._run_options.terminate else ""
            raise PolicyError(f"the program failed: {late}{_first_line(error)}") from None
        finally:
            self._watchdog.end()

    def _terminate(self) -> None:
        """Make the running call fail after its present node; later calls fail too."""
        self._run_options.terminate = True


@functools.cache
def _bound_memory() -> None:
    """Limit the memory of all sessions of this process that use its common allocator."""
    information = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    with contextlib.suppress(Exception):  # the user's own code has registered an allocator: it is used instead
        onnxruntime.create_and_register_allocator(information, onnxruntime.OrtArenaCfg({"max_mem": MAX_MEMORY_BYTES}))


def _first_line(error: Exception) -> str:
    return message_line(error)[:200]
