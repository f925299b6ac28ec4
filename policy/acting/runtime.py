"""The runtime of a policy at an actor: loads snapshots and chooses actions. OnnxRuntime is the default.

TorchRuntime (policy/acting/torch_runtime.py) runs the network itself, for actors that have torch installed.
"""

import copy
import threading
from typing import Any, NamedTuple, Protocol

import numpy as np

from daedalus.policy.acting.noise import Noise, NoiseSize, no_exploration
from daedalus.policy.acting.program_check import PolicyError, check_program
from daedalus.policy.acting.program_session import CallWatchdog, ProgramSession

# Field numbers of ONNX's messages (onnx.proto). A field of bytes is its tag, the number of bytes and the bytes.
_MODEL_IR_VERSION, _MODEL_GRAPH, _GRAPH_INITIALIZER = 1, 7, 5
_TENSOR_DIMS, _TENSOR_DATA_TYPE, _TENSOR_NAME, _TENSOR_RAW_DATA = 1, 2, 8, 9
_FLOAT = 1
_VARINT, _BYTES = 0, 2  # protobuf's wire types
# Before IR version 4 an initializer with the name of an input is that input's value; from 4 on only its default.
_IR_VERSION = 3


# A program declares its weights as inputs. If they are constants, onnxruntime arranges convolution kernels for the
# processor when it loads the program: convolutions are then nearly twice as fast, at a cost of milliseconds for each
# snapshot. onnxruntime's `add_initializer` does not help: it arranges the values in the model, not the added ones. An
# actor does not have the `onnx` package.
def with_initializers(model: bytes, weights: dict[str, np.ndarray]) -> bytes:
    """Return the program with constants for some of its inputs.

    Concatenating two serialized protobuf messages merges them: repeated fields are joined, other fields overwritten.

    Args:
      model: a serialized ONNX model.
      weights: float32 arrays of the inputs' shapes, by the inputs' names.
    """
    tensors = [_chunk(_GRAPH_INITIALIZER, _tensor(name, array)) for name, array in weights.items()]
    graph = [part for tensor in tensors for part in tensor]
    return b"".join([model, *_number(_MODEL_IR_VERSION, _IR_VERSION), *_chunk(_MODEL_GRAPH, graph)])


def _tensor(name: str, array: np.ndarray) -> list[bytes]:
    dimensions = [part for side in array.shape for part in _number(_TENSOR_DIMS, side)]
    data = array.astype("<f4", copy=False).tobytes()
    return [
        *dimensions,
        *_number(_TENSOR_DATA_TYPE, _FLOAT),
        *_chunk(_TENSOR_NAME, [name.encode()]),
        *_chunk(_TENSOR_RAW_DATA, [data]),
    ]


def _chunk(field: int, parts: list[bytes]) -> list[bytes]:
    """Encode a field of bytes or of a message, in parts, so that weights are copied only once."""
    return [_varint(field << 3 | _BYTES), _varint(sum(map(len, parts))), *parts]


def _number(field: int, value: int) -> list[bytes]:
    return [_varint(field << 3 | _VARINT), _varint(value)]


def _varint(value: int) -> bytes:
    """Encode an integer with seven bits a byte, lowest first; the top bit marks that more bytes follow."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


STATE, UNIFORM, NORMAL, EPSILON = "state", "uniform", "normal", "epsilon"
LOG_PROB, NEXT_STATE = "log_prob", "next_state"
_OBSERVATIONS, _MASKS, _ACTIONS = "observations/", "masks/", "actions/"
_MAX_STATE_SIZE = _MAX_NOISE_SIZE = 1 << 16
# Loading a program with convolutions again takes 3 to 10 ms, and each row then a third to a half less time. Both ways
# took equally long with 23 rows (impala), 44 (article), 89 (small, 84 x 84 x 4), 107 (nature), 400 (small, 20 x 20).
_FEW_ROWS = 32


class Choice(NamedTuple):
    """What a policy chose for one row of E environments."""

    actions: dict[str, np.ndarray]  # of each component [E, D], int64 or float32, as in a rollout
    log_probs: np.ndarray  # [E] float32, of the whole actions
    state: np.ndarray  # [E, S] float32, the policy's memory for the next row


class PolicyRuntime(Protocol):
    """Policy that can act. It has one owner and is not safe to share between threads."""

    @property
    def state_size(self) -> int:
        """S, the size of the policy's memory; 0 for a policy without one."""
        ...

    @property
    def noise_size(self) -> NoiseSize:
        """How many random numbers the choice of one action takes."""
        ...

    @property
    def explores(self) -> bool:
        """Whether the policy takes random actions with the probability `epsilon` of `act`."""
        ...

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Use these weights in all later calls. Raises PolicyError if names, shapes or dtypes do not fit.

        The arrays are not copied: the caller must not change them afterwards.
        """
        ...

    def act(
        self,
        observations: dict[str, np.ndarray],
        state: np.ndarray,
        noise: Noise,
        masks: dict[str, np.ndarray],
        epsilon: np.ndarray | None = None,
    ) -> Choice:
        """Choose one action for each environment: a sample, or the greedy one if the noise is neutral.

        Args:
          observations: of each component [E, *stacked_shape].
          state: [E, S] float32, the policy's memory before this row; zeros where an episode starts.
          noise: for E rows.
          masks: of the masked actions [E, choices] bool, True for a legal choice.
          epsilon: [E, 1] float32, the final epsilon of each row, for a policy that `explores`; None: no exploration.
        """
        ...


def observation_name(component: str) -> str:
    """Return the name of a program's input for one component of the observation."""
    return _OBSERVATIONS + component


def mask_name(component: str) -> str:
    """Return the name of a program's input for the mask of one component of the action."""
    return _MASKS + component


def action_name(component: str) -> str:
    """Return the name of a program's output for one component of the action."""
    return _ACTIONS + component


class OnnxRuntime:
    """Runs a program with onnxruntime, on one thread by default.

    Weights are passed as inputs with every call, which is the fastest way for small networks. A program with
    convolutions is instead loaded again for each snapshot, with the weights as constants, unless a snapshot is used for
    few rows.
    """

    def __init__(
        self, model: bytes, stop: threading.Event | None = None, rows: int | None = None, threads: int = 1
    ) -> None:
        """Raise PolicyError if `model` is not a program as policy/acting/program.py exports it.

        Args:
          model: the program.
          stop: ends a call that is in progress; it then raises PolicyError.
          rows: for how many rows each snapshot is used, at least; None: many.
          threads: of a call.
        """
        check_program(model, _is_input)
        self._model, self._stop, self._threads = model, stop, threads
        self._watchdog = CallWatchdog(stop)
        self._session = ProgramSession(model, self._watchdog, threads)
        onnx_inputs, onnx_outputs = self._session.onnx.get_inputs(), self._session.onnx.get_outputs()
        inputs = {entry.name: tuple(entry.shape) for entry in onnx_inputs}
        self._actions = _action_components([entry.name for entry in onnx_outputs], STATE in inputs)
        # Discrete observations, which messages hold in fewer bits.
        self._integers = {entry.name for entry in onnx_inputs if entry.type == "tensor(int64)"}
        self._components = {name for name in inputs if name.startswith((_OBSERVATIONS, _MASKS))}
        self._state_size = _size(inputs, STATE, _MAX_STATE_SIZE)
        self._noise_size = NoiseSize(_size(inputs, UNIFORM, _MAX_NOISE_SIZE), _size(inputs, NORMAL, _MAX_NOISE_SIZE))
        self._explores = _size(inputs, EPSILON, 1) == 1
        others = self._components | {STATE, UNIFORM, NORMAL, EPSILON}
        self._shapes = {name: shape for name, shape in inputs.items() if name not in others}
        convolutional = any(len(shape) > 2 for shape in self._shapes.values())
        self._loads_again = convolutional and (rows is None or rows > _FEW_ROWS)
        self._weights: dict[str, np.ndarray] = {}  # which each call passes

    def fork(self) -> "OnnxRuntime":
        """Return another runtime of the same program, which loads weights of its own.

        Several versions of a policy can so act in turn, on one thread, without loading weights again.
        """
        other = copy.copy(self)
        other._weights = {}
        if self._loads_again:  # it will have a session of its own, and may load it on another thread
            other._watchdog = CallWatchdog(self._stop)
        return other

    @property
    def state_size(self) -> int:
        """See PolicyRuntime."""
        return self._state_size

    @property
    def noise_size(self) -> NoiseSize:
        """See PolicyRuntime."""
        return self._noise_size

    @property
    def explores(self) -> bool:
        """See PolicyRuntime."""
        return self._explores

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
        if self._loads_again:
            self._session = ProgramSession(with_initializers(self._model, bound), self._watchdog, self._threads)
        else:
            self._weights = bound

    def act(
        self,
        observations: dict[str, np.ndarray],
        state: np.ndarray,
        noise: Noise,
        masks: dict[str, np.ndarray],
        epsilon: np.ndarray | None = None,
    ) -> Choice:
        """See PolicyRuntime. Raises PolicyError if the program fails, or its outputs have wrong shapes."""
        feed = self._weights.copy()  # calls of several threads do not see the inputs of each other
        for name, values in observations.items():
            self._set(feed, _OBSERVATIONS + name, values)
        for name, mask in masks.items():
            self._set(feed, _MASKS + name, mask)
        if self._state_size:
            feed[STATE] = state
        if self._noise_size.uniform:
            feed[UNIFORM] = noise.uniform
        if self._noise_size.normal:
            feed[NORMAL] = noise.normal
        if self._explores:
            feed[EPSILON] = no_exploration(len(state)) if epsilon is None else epsilon
        return self._checked(self._session.run(feed), state)

    def _set(self, feed: dict[str, np.ndarray], name: str, values: np.ndarray) -> None:
        """Set an input. One that the network does not use, such as by an encoder of the user, is not in the program."""
        if name in self._integers:
            feed[name] = values.astype(np.int64)
        elif name in self._components:
            feed[name] = values

    def _checked(self, outputs: list[np.ndarray], state: np.ndarray) -> Choice:
        rows = len(state)
        actions = dict(zip(self._actions, outputs, strict=False))
        for name, values in actions.items():
            if values.ndim != 2 or len(values) != rows or values.dtype not in (np.int64, np.float32):
                raise PolicyError(f"the program returns {name!r} {values.dtype} {values.shape} for {rows} observations")
        log_probs = outputs[len(actions)]
        if log_probs.shape != (rows,) or log_probs.dtype != np.float32:
            raise PolicyError(
                f"the program returns {LOG_PROB!r} {log_probs.dtype} {log_probs.shape} for {rows} observations"
            )
        if not self._state_size:
            return Choice(actions, log_probs, state)
        next_state = outputs[-1]
        if next_state.shape != state.shape or next_state.dtype != np.float32:
            raise PolicyError(f"the program returns {NEXT_STATE!r} {next_state.shape} for {STATE!r} {state.shape}")
        return Choice(actions, log_probs, next_state)


def _action_components(outputs: list[str], remembers: bool) -> tuple[str, ...]:
    """Return the components of the actions that a program computes. Raises PolicyError for unknown outputs."""
    names = tuple(name.removeprefix(_ACTIONS) for name in outputs if name.startswith(_ACTIONS))
    if not names or outputs != [*map(action_name, names), LOG_PROB, *([NEXT_STATE] if remembers else [])]:
        raise PolicyError(
            f"the program must compute {action_name('NAME')!r} and {LOG_PROB!r}, and {NEXT_STATE!r} from {STATE!r} if "
            f"it has a memory, but it computes {', '.join(outputs)[:200]}"
        )
    return names


def _is_input(name: str) -> bool:
    """Return whether an input changes from call to call. All others are weights."""
    return name in (STATE, UNIFORM, NORMAL, EPSILON) or name.startswith((_OBSERVATIONS, _MASKS))


def _size(inputs: dict[str, tuple[Any, ...]], name: str, largest: int) -> int:
    """Return the second dimension of an input, or 0 if the program does not have it."""
    match inputs.get(name, (None, 0)):
        case (_, int(size)) if 0 <= size <= largest:
            return size
        case shape:
            raise PolicyError(
                f"the program's {name!r} has shape {shape}, it must be [rows, size] with size up to {largest}"
            )
