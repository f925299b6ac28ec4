"""What an actor asks of a policy: load a snapshot, act. OnnxRuntime is the one for everywhere.

TorchRuntime (policy/torch_runtime.py) does the same with the network itself, for those who have torch
at the actor anyway.
"""

import hashlib
from typing import Protocol, cast

import numpy as np
import onnxruntime

from policy.sampling import greedy_categorical, sample_categorical

OBSERVATIONS = "observations"
LOGITS = "logits"


class PolicyError(Exception):
    """A program or weights that do not fit together, or not the spaces; the sender's fault."""


class PolicyRuntime(Protocol):
    """A policy that can act. One owner, no threads."""

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Binds weights for all later calls; raises PolicyError if they do not fit."""
        ...

    def act(self, observations: np.ndarray, random: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """Chooses one action for each observation: sampled with `random`, the most probable without.

        Args:
          observations: [E, *observation_shape].
          random: source of the samples, or None for greedy actions.

        Returns: actions [E] int64 and their log-probabilities [E] float32.
        """
        ...


def program_hash(model: bytes) -> str:
    """The name of a program: SHA-256 of its bytes, hexadecimal."""
    return hashlib.sha256(model).hexdigest()


class OnnxRuntime:
    """Runs a program with onnxruntime on one thread; weights are fed as inputs with every call."""

    def __init__(self, model: bytes) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = (
            1  # an actor has a core at most; threads that spin would cost the learner its own
        )
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions share no base of their own
            raise PolicyError(f"the program cannot be run: {str(error).splitlines()[0][:200]}") from None
        inputs = {entry.name: tuple(entry.shape) for entry in self._session.get_inputs()}
        outputs = [entry.name for entry in self._session.get_outputs()]
        if OBSERVATIONS not in inputs or outputs != [LOGITS]:
            raise PolicyError(f"the program must turn {OBSERVATIONS!r} into {LOGITS!r}")
        del inputs[OBSERVATIONS]
        self._shapes = inputs
        self._feed: dict[str, np.ndarray] = {}

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime."""
        for name, shape in self._shapes.items():
            if name not in weights:
                raise PolicyError(f"the snapshot lacks the weights {name!r} of its program")
            if weights[name].shape != shape or weights[name].dtype != np.float32:
                raise PolicyError(f"weights {name!r} are {weights[name].shape}, the program wants {shape}")
        self._feed = {name: weights[name] for name in self._shapes}

    def act(self, observations: np.ndarray, random: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        """See PolicyRuntime."""
        self._feed[OBSERVATIONS] = observations
        logits = cast(np.ndarray, self._session.run(None, self._feed)[0])  # [E, A]
        return greedy_categorical(logits) if random is None else sample_categorical(logits, random)

    @property
    def weight_names(self) -> tuple[str, ...]:
        """The weights that the program wants bound."""
        return tuple(self._shapes)
