"""What an actor asks of a policy: load a snapshot, act. OnnxRuntime is the one for everywhere.

TorchRuntime (policy/acting/torch_runtime.py) does the same with the network itself, for those who have torch
at the actor anyway.
"""

import hashlib
import os
from typing import Any, Protocol

import numpy as np
import onnxruntime

from daedalus.policy.acting.onnx_initializers import with_initializers
from daedalus.policy.acting.sampling import greedy_categorical, sample_categorical

OBSERVATIONS, STATE = "observations", "state"
LOGITS, NEXT_STATE = "logits", "next_state"
_MAX_STATE_SIZE = 1 << 16


class PolicyError(Exception):
    """A program or weights that do not fit together, or not the spaces; the sender's fault."""


class PolicyRuntime(Protocol):
    """A policy that can act. One owner, no threads."""

    @property
    def state_size(self) -> int:
        """S, how many numbers the policy remembers from row to row; 0 for most."""
        ...

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Binds weights for all later calls; raises PolicyError if they do not fit.

        They are not copied: whoever gives them away does not change them any more.
        """
        ...

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Chooses one action for each observation: sampled with `random`, the most probable without.

        Args:
          observations: [E, *stacked_shape].
          state: [E, S] float32, the policy's memory before this row, zeros where an episode starts.
          random: source of the samples, or None for greedy actions.

        Returns: actions [E] int64, their log-probabilities [E] float32, and the state [E, S] float32 for the
        next row.
        """
        ...


def program_hash(model: bytes) -> str:
    """The name of a program: SHA-256 of its bytes, hexadecimal."""
    return hashlib.sha256(model).hexdigest()


class OnnxRuntime:
    """Runs a program with onnxruntime on one thread.

    Weights are fed as inputs with every call, which costs less than anything that could be done beforehand; except
    where there are convolutions: their program is made anew with the weights of each snapshot as constants.
    """

    def __init__(self, model: bytes) -> None:
        """Raises PolicyError if it is no program."""
        self._model = model
        self._session = _session(model)
        inputs = {entry.name: tuple(entry.shape) for entry in self._session.get_inputs()}
        outputs = {entry.name: entry.type for entry in self._session.get_outputs()}
        ends = [LOGITS, NEXT_STATE] if STATE in inputs else [LOGITS]
        if OBSERVATIONS not in inputs or list(outputs) != ends or set(outputs.values()) != {"tensor(float)"}:
            raise PolicyError(
                f"the program must turn {OBSERVATIONS!r} into {LOGITS!r}, and {STATE!r} into {NEXT_STATE!r} "
                "if it has a memory"
            )
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
        """The weights that the program wants bound."""
        return tuple(self._shapes)

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime."""
        for name, shape in self._shapes.items():
            if name not in weights:
                raise PolicyError(f"the snapshot lacks the weights {name!r} of its program")
            given = weights[name]
            if given.shape != shape or given.dtype != np.float32:
                raise PolicyError(
                    f"weights {name!r} are {given.dtype} {given.shape}, the program wants float32 {shape}"
                )
        bound = {name: weights[name] for name in self._shapes}
        if self._convolutional:
            self._session = _session(with_initializers(self._model, bound))
        else:
            self._feed = bound

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PolicyRuntime. Raises PolicyError if the program fails, or does not make what it should."""
        self._feed[OBSERVATIONS] = observations
        if self._state_size:
            self._feed[STATE] = state
        try:
            outputs: Any = self._session.run(None, self._feed)
        except Exception as error:  # onnxruntime's exceptions share no base of their own
            raise PolicyError(f"the program failed: {_first_line(error)}") from None
        logits = outputs[0]  # [E, A]
        if logits.ndim != 2 or logits.shape[0] != len(observations) or not logits.shape[1]:
            raise PolicyError(f"the program makes {LOGITS!r} {logits.shape} of {len(observations)} observations")
        if self._state_size:
            if outputs[1].shape != state.shape:
                raise PolicyError(f"the program makes {NEXT_STATE!r} {outputs[1].shape} of {STATE!r} {state.shape}")
            state = outputs[1]
        actions, log_probs = greedy_categorical(logits) if random is None else sample_categorical(logits, random)
        return actions, log_probs, state


def _session(model: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    # An actor has a core at most; threads that spin would cost the learner its own.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # A model may name files to take weights from. None lie here: whoever sends a program shall not read with it.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base of their own
        raise PolicyError(f"the program cannot be run: {_first_line(error)}") from None


def _state_size(shape: tuple[Any, ...]) -> int:
    match shape:
        case (_, int(size)) if 0 < size <= _MAX_STATE_SIZE:
            return size
    raise PolicyError(f"the program's {STATE!r} is {shape}, it must be [rows, S] with S from 1 to {_MAX_STATE_SIZE}")


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)[:200]
