"""The two runtimes hold each other to the same actions; faults of programs and weights are PolicyErrors."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from policy.network import ActorCritic
from policy.program import export_program
from policy.runtime import LOGITS, OBSERVATIONS, OnnxRuntime, PolicyError, PolicyRuntime, program_hash
from policy.torch_runtime import TorchRuntime
from protocol.spec import ArraySpace, ChoiceSpace, PolicySpec, Spaces

Weights = dict[str, np.ndarray]


class Policy(NamedTuple):
    """A network in all its forms."""

    network: ActorCritic
    spec: PolicySpec
    spaces: Spaces
    program: bytes

    def weights(self, seed: int = 0) -> Weights:
        """Weights that make for decided policies, the value head's among them."""
        random = np.random.default_rng(seed)
        named = self.network.named_parameters()
        return {name: random.normal(0, 0.5, tuple(p.shape)).astype(np.float32) for name, p in named}

    def acting_names(self) -> set[str]:
        return {name for name, _ in self.network.named_parameters() if not name.startswith("value_head")}

    def observations(self, count: int, seed: int = 1) -> np.ndarray:
        random, space = np.random.default_rng(seed), self.spaces.observation
        if space.dtype == "uint8":
            return random.integers(0, 256, (count, *space.shape), np.uint8)
        return random.normal(size=(count, *space.shape)).astype(np.float32)

    def runtimes(self) -> tuple[PolicyRuntime, PolicyRuntime]:
        return OnnxRuntime(self.program), TorchRuntime(self.spec, self.spaces)


def make_policy(hidden: tuple[int, ...], activation: str, shape: tuple[int, ...], dtype: str, actions: int) -> Policy:
    spec = PolicySpec.model_validate({"hidden": hidden, "activation": activation})
    observation = ArraySpace.model_validate({"shape": shape, "dtype": dtype})
    spaces = Spaces(observation=observation, action=ChoiceSpace(count=actions))
    network = ActorCritic(spec, spaces)
    return Policy(network, spec, spaces, export_program(network, observation))


POLICIES: dict[str, tuple[tuple[int, ...], str, tuple[int, ...], str, int]] = {
    "tanh": ((64, 64), "tanh", (4,), "float32", 2),
    "relu": ((32,), "relu", (8,), "float32", 6),
    "planes": ((16, 8, 16), "relu", (2, 3, 4), "float32", 3),
    "bytes": ((24, 24), "tanh", (5, 5), "uint8", 4),
    "one action": ((3,), "tanh", (1,), "float32", 1),
}


@pytest.fixture(scope="module", params=POLICIES)
def policy(request: pytest.FixtureRequest) -> Policy:
    return make_policy(*POLICIES[request.param])


@pytest.fixture(scope="module")
def one_policy() -> Policy:
    return make_policy(*POLICIES["tanh"])


@pytest.fixture(params=[0, 1], ids=["onnx", "torch"])
def runtime(request: pytest.FixtureRequest, one_policy: Policy) -> PolicyRuntime:
    return one_policy.runtimes()[request.param]


def generator() -> np.random.Generator:
    return np.random.default_rng(5)


# -------------------------------------------------------------------------------------------- agreement


@pytest.mark.parametrize("random", [generator, lambda: None], ids=["sampled", "greedy"])
@pytest.mark.parametrize("rows", [1, 256])
def test_both_runtimes_act_alike(policy: Policy, rows: int, random: Callable[[], np.random.Generator | None]) -> None:
    results = []
    for runtime in policy.runtimes():
        runtime.load(policy.weights())
        results.append(runtime.act(policy.observations(rows), random()))
    (actions, log_probs), (torch_actions, torch_log_probs) = results
    assert (actions.shape, actions.dtype) == ((rows,), np.int64)
    assert (log_probs.shape, log_probs.dtype) == ((rows,), np.float32)
    np.testing.assert_array_equal(actions, torch_actions)
    np.testing.assert_allclose(log_probs, torch_log_probs, atol=1e-5, rtol=0)


def test_acting_is_the_policy_half_of_learning(policy: Policy) -> None:
    weights = policy.weights()
    policy.network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    observations = policy.observations(64)
    with torch.no_grad():
        logits, values = policy.network(torch.from_numpy(observations))
    assert (logits.shape, values.shape) == ((64, policy.spaces.action.count), (64,))
    for runtime in policy.runtimes():
        runtime.load(weights)
        actions, log_probs = runtime.act(observations, generator())
        expected = logits.log_softmax(-1).numpy()[np.arange(64), actions]
        np.testing.assert_allclose(log_probs, expected, atol=1e-5, rtol=0)


def test_samples_follow_the_generator_alone(runtime: PolicyRuntime, one_policy: Policy) -> None:
    runtime.load(one_policy.weights())
    observations = one_policy.observations(256)
    first, again, other = (runtime.act(observations, np.random.default_rng(seed))[0] for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_bytes_are_scaled_to_the_unit_interval() -> None:
    policy = make_policy((4,), "relu", (1,), "uint8", 2)
    weights = {name: np.zeros_like(array) for name, array in policy.weights().items()}
    weights["encoder.layers.0.weight"][0, 0] = 1.0
    weights["policy_head.weight"][0, 0] = 1.0  # logits are (observation / 255, 0)
    for runtime in policy.runtimes():
        runtime.load(weights)
        _, log_probs = runtime.act(np.array([[255], [0]], np.uint8), None)
        np.testing.assert_allclose(log_probs, [-np.log1p(np.exp(-1)), -np.log(2)], atol=1e-6)


# ------------------------------------------------------------------------------------------ the program


def test_a_program_wants_the_acting_parameters_by_their_names(policy: Policy) -> None:
    names = OnnxRuntime(policy.program).weight_names
    assert len(set(names)) == len(names)
    assert set(names) == policy.acting_names()


def test_a_program_holds_no_weights(policy: Policy) -> None:
    graph = onnx.load_model_from_string(policy.program).graph
    assert [entry.name for entry in graph.input if entry.name not in policy.acting_names()] == [OBSERVATIONS]
    assert [entry.name for entry in graph.output] == [LOGITS]
    assert not graph.initializer
    assert len(policy.program) < 8192


def test_a_program_does_not_grow_with_its_network(one_policy: Policy) -> None:
    wide = make_policy((1024, 1024), "tanh", (4,), "float32", 2)
    assert abs(len(wide.program) - len(one_policy.program)) < 64


def test_a_program_depends_on_the_architecture_and_not_on_the_weights(policy: Policy) -> None:
    for value in (0.0, 1.0, None):  # parameters that are alike must stay apart, too
        for parameter in policy.network.parameters():
            torch.nn.init.normal_(parameter) if value is None else torch.nn.init.constant_(parameter, value)
        again = export_program(policy.network, policy.spaces.observation)
        assert program_hash(again) == program_hash(policy.program)
    assert program_hash(make_policy((5,), "tanh", (2,), "float32", 2).program) != program_hash(policy.program)


def test_the_hash_of_a_program_is_sha256() -> None:
    assert program_hash(b"abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def other_program(inputs: tuple[str, ...], output: str) -> bytes:
    """A model that adds its inputs up."""
    entries = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [None, 2]) for name in inputs]
    result = helper.make_tensor_value_info(output, TensorProto.FLOAT, [None, 2])
    graph = helper.make_graph([helper.make_node("Sum", list(inputs), [output])], "other", entries, [result])
    opset = helper.make_opsetid("", 17)
    return helper.make_model(graph, opset_imports=[opset], ir_version=8).SerializeToString()


def test_a_program_from_elsewhere_runs_if_its_names_are_right() -> None:
    runtime = OnnxRuntime(other_program((OBSERVATIONS,), LOGITS))
    runtime.load({})
    actions, _ = runtime.act(np.array([[1, 2], [2, 1]], np.float32), None)
    np.testing.assert_array_equal(actions, [1, 0])


@pytest.mark.parametrize(("inputs", "output"), [(("pixels",), LOGITS), ((OBSERVATIONS,), "values")])
def test_a_program_with_other_ends_is_refused(inputs: tuple[str, ...], output: str) -> None:
    with pytest.raises(PolicyError, match="must turn 'observations' into 'logits'"):
        OnnxRuntime(other_program(inputs, output))


def test_a_program_whose_weights_have_no_fixed_shape_takes_none() -> None:
    runtime = OnnxRuntime(other_program((OBSERVATIONS, "w"), LOGITS))
    with pytest.raises(PolicyError, match="'w'"):
        runtime.load({"w": np.zeros((1, 2), np.float32)})


@pytest.mark.parametrize("garbage", [b"", b"\0", b"garbage", bytes(1000), np.random.default_rng(0).bytes(1000)])
def test_garbage_is_no_program(garbage: bytes) -> None:
    with pytest.raises(PolicyError):
        OnnxRuntime(garbage)


def test_a_program_cut_short_is_refused(one_policy: Policy) -> None:
    for length in range(1, len(one_policy.program), 37):
        with pytest.raises(PolicyError):
            OnnxRuntime(one_policy.program[:length])


# ------------------------------------------------------------------------------------------ the weights


def test_every_acting_weight_is_needed_and_named(runtime: PolicyRuntime, one_policy: Policy) -> None:
    for name in one_policy.acting_names():
        weights = one_policy.weights()
        del weights[name]
        with pytest.raises(PolicyError, match=f"lacks the weights '{name}'"):
            runtime.load(weights)


def test_the_value_head_plays_no_part_in_acting(runtime: PolicyRuntime, one_policy: Policy) -> None:
    observations = one_policy.observations(32)
    runtime.load(one_policy.weights())
    _, with_head = runtime.act(observations, None)
    acting = {name: array for name, array in one_policy.weights().items() if name in one_policy.acting_names()}
    runtime.load(acting)
    np.testing.assert_array_equal(runtime.act(observations, None)[1], with_head)
    runtime.load({**acting, "unheard.of": np.zeros(3, np.float32)})
    np.testing.assert_array_equal(runtime.act(observations, None)[1], with_head)


@pytest.mark.parametrize("shape", [(64, 5), (63, 4), (4, 64), (256,), (64, 4, 1), (0, 4), ()])
def test_weights_of_another_shape_are_refused_by_name(
    runtime: PolicyRuntime, one_policy: Policy, shape: tuple[int, ...]
) -> None:
    name = "encoder.layers.0.weight"
    with pytest.raises(PolicyError, match=name):
        runtime.load(one_policy.weights() | {name: np.zeros(shape, np.float32)})


def test_onnx_takes_float32_weights_alone(one_policy: Policy) -> None:
    weights = one_policy.weights()
    weights["policy_head.bias"] = weights["policy_head.bias"].astype(np.int64)
    with pytest.raises(PolicyError, match=r"policy_head\.bias"):
        OnnxRuntime(one_policy.program).load(weights)


def test_refused_weights_leave_the_loaded_ones_in_force(runtime: PolicyRuntime, one_policy: Policy) -> None:
    observations = one_policy.observations(64)
    runtime.load(one_policy.weights())
    _, before = runtime.act(observations, None)
    with pytest.raises(PolicyError):
        runtime.load(one_policy.weights(seed=2) | {"policy_head.bias": np.zeros(9, np.float32)})
    np.testing.assert_array_equal(runtime.act(observations, None)[1], before)


def test_new_weights_change_what_is_done_and_old_ones_bring_it_back(runtime: PolicyRuntime, one_policy: Policy) -> None:
    observations, outputs = one_policy.observations(64), []
    for seed in (0, 1, 0):
        runtime.load(one_policy.weights(seed))
        outputs.append(runtime.act(observations, generator()))
    assert (outputs[0][1] != outputs[1][1]).any()
    assert (outputs[0][0] != outputs[1][0]).any()
    np.testing.assert_array_equal(outputs[0], outputs[2])


def test_weights_may_be_read_only(runtime: PolicyRuntime, one_policy: Policy) -> None:
    weights = one_policy.weights()
    for array in weights.values():
        array.flags.writeable = False
    runtime.load(weights)
    runtime.act(one_policy.observations(2), None)
