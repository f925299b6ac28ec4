"""The runtime of a policy at an actor: loads snapshots and chooses actions. OnnxRuntime is the default.

TorchRuntime (policy/acting/torch_runtime.py) runs the network itself, for actors that have torch installed.
"""

import hashlib
import threading
from typing import Any, Protocol

import numpy as np

from daedalus.policy.acting.call_watchdog import CallWatchdog
from daedalus.policy.acting.errors import PolicyError
from daedalus.policy.acting.onnx_initializers import with_initializers
from daedalus.policy.acting.program_check import check_program
from daedalus.policy.acting.program_session import ProgramSession
from daedalus.policy.acting.sampling import SAMPLERS, RandomSource

OBSERVATIONS, STATE = "observations", "state"
NEXT_STATE = "next_state"
_MAX_STATE_SIZE = 1 << 16


class PolicyRuntime(Protocol):
    """Policy that can act. It has one owner and is not safe to share between threads."""

    @property
    def state_size(self) -> int:
        """S, the size of the policy's memory; 0 for a policy without one."""
        ...

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Use these weights in all later calls. Raises PolicyError if names, shapes or dtypes do not fit.

        The arrays are not copied: the caller must not change them afterwards.
        """
        ...

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: RandomSource | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Choose one action for each observation: a sample if `random` is given, otherwise the most probable.

        Args:
          observations: [E, *stacked_shape].
          state: [E, S] float32, the policy's memory before this row; zeros where an episode starts.
          random: source of random numbers, or None for greedy actions.

        Returns: actions [E] int64, their log-probabilities [E] float32, and the state [E, S] float32 for the
        next row.
        """
        ...


def program_hash(model: bytes) -> str:
    """Return the name of a program: the SHA-256 of its bytes, in hexadecimal."""
    return hashlib.sha256(model).hexdigest()


class OnnxRuntime:
    """Runs a program with onnxruntime on one thread.

    Weights are passed as inputs with every call, which is the fastest way for small networks. A program with
    convolutions is instead loaded again for each snapshot, with the weights as constants.
    """

    def __init__(self, model: bytes, stop: threading.Event | None = None) -> None:
        """Raise PolicyError if `model` is not a program as policy/acting/program.py exports it.

        `stop` ends a call that is in progress; it then raises PolicyError.
        """
        check_program(model, (OBSERVATIONS, STATE))
        self._model = model
        self._watchdog = CallWatchdog(stop)
        self._session = ProgramSession(model, self._watchdog)
        inputs = {entry.name: tuple(entry.shape) for entry in self._session.onnx.get_inputs()}
        outputs = {entry.name: entry.type for entry in self._session.onnx.get_outputs()}
        self._parameters = next(iter(outputs), "")  # name of the first output
        expected = [self._parameters, NEXT_STATE] if STATE in inputs else [self._parameters]
        known = OBSERVATIONS in inputs and self._parameters in SAMPLERS
        if not known or list(outputs) != expected or set(outputs.values()) != {"tensor(float)"}:
            raise PolicyError(
                f"the program must compute {' or '.join(map(repr, SAMPLERS))} from {OBSERVATIONS!r}, "
                f"and {NEXT_STATE!r} from {STATE!r} if it has a memory"
            )
        self._sampler = SAMPLERS[self._parameters]
        del inputs[OBSERVATIONS]
        self._state_size = _state_size(inputs.pop(STATE)) if STATE in inputs else 0
        self._shapes = inputs
        self._convolutional = any(len(shape) > 2 for shape in inputs.values())
        self._feed: dict[str, np.ndarray] = {}

    @property
    def state_size(self) -> int:
        """See PolicyRuntime."""
        return self._state_size

    @property
    def weight_names(self) -> tuple[str, ...]:
        """Names of the weights that the program requires."""
        return tuple(self._shapes)

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime."""
        for name, shape in self._shapes.items():
            if name not in weights:
                raise PolicyError(f"the snapshot lacks the weights {name!r} of its program")
            given = weights[name]
            if given.shape != shape or given.dtype != np.float32:
                raise PolicyError(
                    f"weights {name!r} are {given.dtype} {given.shape}, the program requires float32 {shape}"
                )
        bound = {name: weights[name] for name in self._shapes}
        if self._convolutional:
            self._session = ProgramSession(with_initializers(self._model, bound), self._watchdog)
        else:
            self._feed = bound

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: RandomSource | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PolicyRuntime. Raises PolicyError if the program fails, or its outputs have wrong shapes."""
        self._feed[OBSERVATIONS] = observations
        if self._state_size:
            self._feed[STATE] = state
        outputs = self._session.run(self._feed)
        parameters = outputs[0]  # [E, P]
        if parameters.ndim != 2 or parameters.shape[0] != len(observations) or not parameters.shape[1]:
            raise PolicyError(
                f"the program returns {self._parameters!r} {parameters.shape} for {len(observations)} observations"
            )
        if self._state_size:
            if outputs[1].shape != state.shape:
                raise PolicyError(f"the program returns {NEXT_STATE!r} {outputs[1].shape} for {STATE!r} {state.shape}")
            state = outputs[1]
        sampler = self._sampler
        actions, log_probs = sampler.mode(parameters) if random is None else sampler.sample(parameters, random)
        return actions, log_probs, state


def _state_size(shape: tuple[Any, ...]) -> int:
    match shape:
        case (_, int(size)) if 0 < size <= _MAX_STATE_SIZE:
            return size
    raise PolicyError(
        f"the program's {STATE!r} has shape {shape}, it must be [rows, S] with S from 1 to {_MAX_STATE_SIZE}"
    )
