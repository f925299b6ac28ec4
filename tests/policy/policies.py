"""Networks of every kind, for tests."""

from typing import Any, NamedTuple

import numpy as np
import torch
from plain import NAME, array_space, plain_spaces

from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.policy.acting.torch_runtime import TorchRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import PolicySpec

Weights = dict[str, np.ndarray]


class Policy(NamedTuple):
    """A network with its specification and program."""

    network: ActorCritic
    spec: PolicySpec
    spaces: Spaces
    program: bytes

    def weights(self, seed: int = 0) -> Weights:
        """Return weights with which the policies are far from uniform, including the value head's."""
        random = np.random.default_rng(seed)
        return {
            name: random.normal(0, 1.5 / np.sqrt(max(4, parameter[0].numel())), tuple(parameter.shape)).astype(
                np.float32
            )
            for name, parameter in self.network.named_parameters()
        }

    def load(self, weights: Weights) -> None:
        """Copy these weights into the network."""
        self.network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})

    def acting_names(self) -> set[str]:
        return {name for name, _ in self.network.named_parameters() if not name.startswith("value_head")}

    def observations(self, count: int, seed: int = 1) -> np.ndarray:
        return observations(array_space(self.spaces), (count,), seed)

    def states(self, count: int, seed: int = 2) -> np.ndarray:
        return np.random.default_rng(seed).uniform(-1, 1, (count, self.network.state_size)).astype(np.float32)

    def runtimes(self) -> tuple[PolicyRuntime, PolicyRuntime, PolicyRuntime]:
        few_rows = OnnxRuntime(self.program, rows=1)  # differs for programs with convolutions
        return OnnxRuntime(self.program), TorchRuntime(self.spec, self.spaces), few_rows


def observations(space: ArraySpace, leading: tuple[int, ...], seed: int = 1) -> np.ndarray:
    """Return random observations [*leading, *stacked_shape] of the space."""
    random, shape = np.random.default_rng(seed), (*leading, *space.stacked_shape)
    if space.dtype == "uint8":
        return random.integers(0, 256, shape, np.uint8)
    return random.normal(size=shape).astype(np.float32)


def spaces(shape: tuple[int, ...], dtype: str = "uint8", frames: int = 1, actions: int = 4) -> Spaces:
    space = ArraySpace.model_validate({"shape": shape, "dtype": dtype, "frames": frames})
    return plain_spaces(space, actions)


def make_policy(spec: dict[str, Any], where: Spaces) -> Policy:
    checked = PolicySpec.model_validate(spec)
    network = ActorCritic(checked, where, UserModules(frozenset({"users_own"})))
    return Policy(network, checked, where, export_program(network, where))


_GRU = {"memory": "gru", "memory_units": 24}
CARTPOLE: tuple[dict[str, Any], Spaces] = {"hidden": (64, 64)}, spaces((4,), "float32", actions=2)
POLICIES: dict[str, tuple[dict[str, Any], Spaces]] = {
    "tanh": CARTPOLE,
    "relu": ({"hidden": (32,), "activation": "relu"}, spaces((8,), "float32", actions=6)),
    "planes": ({"hidden": (16, 8, 16), "activation": "relu"}, spaces((2, 3, 4), "float32", actions=3)),
    "bytes": ({"hidden": (24, 24)}, spaces((5, 5))),
    "stacked numbers": ({"hidden": (24,)}, spaces((3,), "float32", frames=3)),
    "one action": ({"hidden": (3,)}, spaces((1,), "float32", actions=1)),
    "grid": ({"encoder": "grid", "hidden": (24,), "activation": "relu"}, spaces((6, 5, 9), "float32", actions=3)),
    "grid, stacked": ({"encoder": "grid", "hidden": (8,)}, spaces((4, 7, 2), "float32", frames=2)),
    "bytes, grid, gru": ({"encoder": "grid", "hidden": (8,)} | _GRU, spaces((3, 3, 4))),
    "codes": ({"codes": {NAME: (256,)}, "hidden": (16,)}, spaces((3, 2), frames=2)),
    "codes, grid": ({"codes": {NAME: (256, 256)}, "encoder": "grid", "hidden": (8,)}, spaces((6, 5, 2))),
    "mlp, gru": ({"hidden": (16,)} | _GRU, spaces((4,), "float32")),
    "gru alone": ({"hidden": ()} | _GRU, spaces((4,), "float32")),
    "small": ({"encoder": "small"}, spaces((84, 84), frames=4, actions=6)),
    "nature": ({"encoder": "nature"}, spaces((84, 84), frames=4, actions=6)),
    "nature, gru": ({"encoder": "nature"} | _GRU, spaces((40, 44), frames=2)),
    "nature, floats": ({"encoder": "nature"}, spaces((40, 44, 3), "float32")),
    "impala": ({"encoder": "impala"}, spaces((21, 30, 3))),
    "impala, gru": ({"encoder": "impala"} | _GRU, spaces((17, 17), frames=4)),
    "article": ({"encoder": "article"}, spaces((33, 48, 3), frames=2)),
    "article, gru": ({"encoder": "article"} | _GRU, spaces((96, 96), frames=4)),
    "article, floats": ({"encoder": "article"}, spaces((3, 20, 20), "float32")),
}
