"""What an actor asks of a policy: load a snapshot, act. OnnxRuntime is the one for everywhere.

TorchRuntime (policy/torch_runtime.py) does the same with the network itself, for those who have torch
at the actor anyway.
"""

import hashlib
import json
import math
from typing import Any, Protocol, cast

import numpy as np
import onnxruntime

from policy.sampling import greedy_categorical, sample_categorical

OBSERVATIONS, STATE = "observations", "state"
LOGITS, NEXT_STATE = "logits", "next_state"
WEIGHTS = "weights"  # in a program's metadata: {name: [offset, shape]} of the weights that are constants of it

_MAX_STATE = 65_536


class PolicyError(Exception):
    """A program or weights that do not fit together, or not the spaces; the sender's fault."""


class PolicyRuntime(Protocol):
    """A policy that can act. One owner, no threads."""

    @property
    def state_size(self) -> int:
        """S, how many numbers the policy remembers from row to row; 0 without a memory."""
        ...

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Binds weights for all later calls; raises PolicyError if they do not fit."""
        ...

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Chooses one action for each observation: sampled with `random`, the most probable without.

        Args:
          observations: [E, *stacked_shape].
          state: [E, S] float32, what is remembered; zeros where an episode starts.
          random: source of the samples, or None for greedy actions.

        Returns: actions [E] int64, their log-probabilities [E] float32, and the next state [E, S] float32.
        """
        ...


def program_hash(model: bytes) -> str:
    """The name of a program: SHA-256 of its bytes, hexadecimal."""
    return hashlib.sha256(model).hexdigest()


class OnnxRuntime:
    """Runs a program with onnxruntime on one thread.

    Weights are fed as inputs with every call, or, where the program has them as constants, make a new session with
    every `load`: that takes 10 ms, and convolutions of constants half the time.
    """

    def __init__(self, model: bytes) -> None:
        """Raises PolicyError if the program cannot be run or is not one of ours."""
        self._session = _session(model)
        inputs = {entry.name: tuple(entry.shape) for entry in self._session.get_inputs()}
        outputs = [entry.name for entry in self._session.get_outputs()]
        recurrent = STATE in inputs
        if OBSERVATIONS not in inputs or outputs != ([LOGITS, NEXT_STATE] if recurrent else [LOGITS]):
            raise PolicyError(f"the program must turn {OBSERVATIONS!r} into {LOGITS!r}")
        self._state_size = _state_size(inputs.pop(STATE)) if recurrent else 0
        del inputs[OBSERVATIONS]
        self._places = _places(self._session, len(model))
        self._model = bytearray(model) if self._places else bytearray()
        self._shapes = {**inputs, **{name: shape for name, (_, shape) in self._places.items()}}
        self._feed: dict[str, np.ndarray] = {}

    @property
    def state_size(self) -> int:
        """See PolicyRuntime."""
        return self._state_size

    @property
    def weight_names(self) -> tuple[str, ...]:
        """The weights that the program wants bound."""
        return tuple(self._shapes)

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime."""
        for name, shape in self._shapes.items():
            if name not in weights:
                raise PolicyError(f"the snapshot lacks the weights {name!r} of its program")
            if weights[name].shape != shape or weights[name].dtype != np.float32:
                raise PolicyError(f"weights {name!r} are {weights[name].shape}, the program wants {shape}")
        for name, (start, _) in self._places.items():
            self._model[start : start + weights[name].nbytes] = weights[name].astype("<f4", copy=False).tobytes()
        if self._places:
            self._session = _session(bytes(self._model))
        self._feed = {name: weights[name] for name in self._shapes if name not in self._places}

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PolicyRuntime."""
        self._feed[OBSERVATIONS] = observations
        if self._state_size:
            self._feed[STATE] = state
        results = cast(list[np.ndarray], self._session.run(None, self._feed))
        logits = results[0]  # [E, A]
        actions, log_probs = greedy_categorical(logits) if random is None else sample_categorical(logits, random)
        return actions, log_probs, results[1] if self._state_size else state


def _session(model: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    # An actor has a core at most; threads that spin would cost the learner its own.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base of their own
        raise PolicyError(f"the program cannot be run: {str(error).splitlines()[0][:200]}") from None


def _state_size(shape: tuple[Any, ...]) -> int:
    if len(shape) != 2 or not isinstance(shape[1], int) or not 1 <= shape[1] <= _MAX_STATE:
        raise PolicyError(f"the program's {STATE!r} must be [rows, 1 to {_MAX_STATE}], not {list(shape)}")
    return shape[1]


def _places(session: onnxruntime.InferenceSession, size: int) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Offset and shape of the weights that are constants of a program of `size` bytes; none where they are inputs."""
    listed = session.get_modelmeta().custom_metadata_map.get(WEIGHTS)
    if listed is None:
        return {}
    try:
        places = {
            str(name): (int(start), tuple(int(side) for side in shape))
            for name, (start, shape) in json.loads(listed).items()
        }
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        raise PolicyError("the program's list of weights cannot be read") from None
    for name, (start, shape) in places.items():
        if start < 0 or min(shape, default=1) < 0 or start + 4 * math.prod(shape) > size:
            raise PolicyError(f"the program's weights {name!r} do not lie within it")
    return places
