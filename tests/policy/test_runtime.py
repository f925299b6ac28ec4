"""All runtimes choose the same actions; faulty programs and weights raise PolicyError."""

import functools
import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from plain import ACTION, NAME, act, choices
from policies import CARTPOLE, POLICIES, Policy, make_policy, spaces

from daedalus.policy.acting.noise import neutral_noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import (
    LOG_PROB,
    NEXT_STATE,
    STATE,
    UNIFORM,
    OnnxRuntime,
    PolicyError,
    PolicyRuntime,
    action_name,
    observation_name,
    with_initializers,
)
from daedalus.policy.acting.torch_runtime import TorchRuntime
from daedalus.protocol.messages import program_hash
from daedalus.protocol.spec import PolicySpec

OBSERVATIONS, ACTIONS = observation_name(NAME), action_name(ACTION)


def act_without_memory(
    runtime: PolicyRuntime, observations: np.ndarray, random: np.random.Generator | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return act(runtime, observations, np.zeros((len(observations), 0), np.float32), random)


@pytest.fixture(scope="module", params=POLICIES)
def policy(request: pytest.FixtureRequest) -> Policy:
    return make_policy(*POLICIES[request.param])


@pytest.fixture(scope="module")
def one_policy() -> Policy:
    return make_policy(*CARTPOLE)


@pytest.fixture(params=[0, 1, 2], ids=["onnx", "torch", "onnx, few rows"])
def runtime(request: pytest.FixtureRequest, one_policy: Policy) -> PolicyRuntime:
    return one_policy.runtimes()[request.param]


def generator() -> np.random.Generator:
    return np.random.default_rng(5)


def learner_outputs(policy: Policy, observations: np.ndarray, states: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the logits and values of one step."""
    with torch.no_grad():
        return policy.network(
            {NAME: torch.from_numpy(observations)[None]},
            torch.from_numpy(states),
            torch.zeros(1, len(observations), dtype=torch.bool),
        )


def tolerance(logits: torch.Tensor) -> float:
    """Return the tolerance of log-probabilities: processors round differently, relative to the size of the logits."""
    return 1e-5 * max(5.0, float(logits.abs().max()))


# -------------------------------------------------------------------------------------------- agreement


def test_all_runtimes_choose_the_same_actions(policy: Policy) -> None:
    with_onnx, with_torch, for_few_rows = policy.runtimes()
    for seed in (0, 1):  # also after weights are replaced
        for runtime in (with_torch, with_onnx, for_few_rows):
            runtime.load(policy.weights(seed))
        policy.load(policy.weights(seed))
        for rows, random in itertools.product((1, 17), (generator, lambda: None)):  # sampled and greedy
            seen, states = policy.observations(rows), policy.states(rows)
            logits, _ = learner_outputs(policy, seen, states)
            torch_actions, torch_log_probs, torch_state = act(with_torch, seen, states, random())
            for runtime in (with_onnx, for_few_rows):
                actions, log_probs, state = act(runtime, seen, states, random())
                assert (actions.shape, actions.dtype) == ((rows,), np.int64)
                assert (log_probs.shape, log_probs.dtype) == ((rows,), np.float32)
                assert (state.shape, state.dtype) == ((rows, policy.network.state_size), np.float32)
                np.testing.assert_array_equal(actions, torch_actions)
                np.testing.assert_allclose(log_probs, torch_log_probs, atol=tolerance(logits), rtol=0)
                np.testing.assert_allclose(state, torch_state, atol=5e-5, rtol=0)


def test_state_is_carried_from_row_to_row(policy: Policy) -> None:
    rows = 5
    for runtime in policy.runtimes():
        runtime.load(policy.weights())
        given = policy.states(rows)
        before = given.copy()
        _, log_probs, state = act(runtime, policy.observations(rows), given)
        _, again, _ = act(runtime, policy.observations(rows), state)
        np.testing.assert_array_equal(given, before)
        if policy.network.state_size:
            assert runtime.state_size == policy.spec.memory_units
            assert (state != before).any()
            assert (log_probs != again).any()
        else:
            assert runtime.state_size == 0
            assert state is given


def test_acting_matches_the_policy_of_learning(policy: Policy) -> None:
    rows, weights = 16, policy.weights()
    policy.load(weights)
    observations, states = policy.observations(rows), policy.states(rows)
    logits, values = learner_outputs(policy, observations, states)
    assert (logits.shape, values.shape) == ((1, rows, choices(policy.spaces)), (1, rows))
    assert (logits.std() > 0.05) | (choices(policy.spaces) == 1)  # otherwise the comparison below would prove nothing
    for runtime in policy.runtimes():
        runtime.load(weights)
        actions, log_probs, _ = act(runtime, observations, states, generator())
        expected = logits[0].log_softmax(-1).numpy()[np.arange(rows), actions]
        np.testing.assert_allclose(log_probs, expected, atol=tolerance(logits), rtol=0)


def test_samples_depend_only_on_the_generator(runtime: PolicyRuntime, one_policy: Policy) -> None:
    runtime.load(one_policy.weights())
    observations = one_policy.observations(256)
    first, again, other = (
        act_without_memory(runtime, observations, np.random.default_rng(seed))[0] for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_call_of_another_thread_does_not_change_the_inputs(
    one_policy: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = one_policy.runtimes()[0]
    assert isinstance(runtime, OnnxRuntime)
    runtime.load(one_policy.weights())
    ones, twos = np.ones((3, 4), np.float32), np.full((3, 4), 2.0, np.float32)
    expected, run = act_without_memory(runtime, ones), runtime._session.run

    def run_after_another(feed: dict[str, np.ndarray]) -> list[Any]:
        monkeypatch.undo()
        act_without_memory(runtime, twos)
        return run(feed)

    monkeypatch.setattr(runtime._session, "run", run_after_another)
    for given, wanted in zip(act_without_memory(runtime, ones), expected, strict=True):
        np.testing.assert_array_equal(given, wanted)


def test_bytes_are_scaled_to_the_unit_interval() -> None:
    policy = make_policy({"hidden": (4,), "activation": "relu"}, spaces((1,), actions=2))
    weights = {name: np.zeros_like(array) for name, array in policy.weights().items()}
    weights["encoder.layers.0.weight"][0, 0] = 1.0
    weights["policy_head.weight"][0, 0] = 1.0  # logits are (observation / 255, 0)
    for runtime in policy.runtimes():
        runtime.load(weights)
        _, log_probs, _ = act_without_memory(runtime, np.array([[255], [0]], np.uint8))
        np.testing.assert_allclose(log_probs, [-np.log1p(np.exp(-1)), -np.log(2)], atol=1e-6)


@pytest.mark.parametrize("name", ["my_module:Net", "os:system"])
def test_torch_runtime_imports_no_module_named_on_the_wire(name: str) -> None:
    with pytest.raises(PolicyError, match="use --runtime onnx"):
        TorchRuntime(PolicySpec(encoder=name), spaces((84, 84)))


def test_torch_runtime_rejects_an_encoder_that_does_not_fit_the_space() -> None:
    with pytest.raises(PolicyError, match="'nature'"):
        TorchRuntime(PolicySpec(encoder="nature"), spaces((4,), "float32"))


# ------------------------------------------------------------------------------------------ the program


def test_inputs_of_a_program_are_the_acting_parameters(policy: Policy) -> None:
    inputs = [entry.name for entry in onnx.load_model_from_string(policy.program).graph.input]
    assert len(set(inputs)) == len(inputs)
    assert set(inputs) & dict(policy.network.named_parameters()).keys() == policy.acting_names()


def test_program_contains_no_weights(policy: Policy) -> None:
    graph = onnx.load_model_from_string(policy.program).graph
    remembers = policy.network.state_size > 0
    inputs = [entry.name for entry in graph.input if entry.name not in policy.acting_names()]
    assert inputs == [OBSERVATIONS, *([STATE] if remembers else []), UNIFORM]
    assert [entry.name for entry in graph.output] == [ACTIONS, LOG_PROB, *([NEXT_STATE] if remembers else [])]
    assert not graph.initializer
    assert len(policy.program) < 32_768


def test_size_of_a_program_is_independent_of_the_network_size(one_policy: Policy) -> None:
    wide = make_policy({"hidden": (1024, 1024)}, spaces((4,), "float32", actions=2))
    assert abs(len(wide.program) - len(one_policy.program)) < 64


def test_program_depends_only_on_the_architecture(policy: Policy) -> None:
    for value in (0.0, 1.0, None):  # also for parameters with equal values
        for parameter in policy.network.parameters():
            torch.nn.init.normal_(parameter) if value is None else torch.nn.init.constant_(parameter, value)
        again = export_program(policy.network, policy.spaces)
        assert program_hash(again) == program_hash(policy.program)
    assert program_hash(another_program()) != program_hash(policy.program)


@functools.cache
def another_program() -> bytes:
    return make_policy({"hidden": (5,)}, spaces((2,), "float32")).program


def test_hash_of_a_program_is_sha256() -> None:
    assert program_hash(b"abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


Shapes = dict[str, list[int | None] | None]


def model(nodes: list[onnx.NodeProto], inputs: Shapes, outputs: Shapes, *initializers: TensorProto) -> bytes:
    """Return a model with float32 inputs and outputs."""
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in side.items()]
        for side in (inputs, outputs)
    ]
    graph = helper.make_graph(nodes, "other", ends[0], ends[1], initializers)
    opset = helper.make_opsetid("", 17)
    return helper.make_model(graph, opset_imports=[opset], ir_version=8).SerializeToString()


def acting(nodes: list[onnx.NodeProto], inputs: Shapes, outputs: Shapes | None = None, **changed: Any) -> bytes:
    """Return a model whose `nodes` compute "sum" [N, 2]: the action, and by its columns' sum the log-probability."""
    ends = [
        helper.make_node("Identity", ["sum"], [changed.get("actions", ACTIONS)]),
        helper.make_node("ReduceSum", ["sum", "axis"], [LOG_PROB], keepdims=changed.get("keepdims", 0)),
    ]
    axis = helper.make_tensor("axis", TensorProto.INT64, [1], [1])
    shapes: Shapes = {changed.get("actions", ACTIONS): [None, None], LOG_PROB: None}
    return model([*nodes, *ends], inputs, shapes | (outputs or {}), axis, *changed.get("initializers", ()))


def other_program(inputs: tuple[str, ...], **changed: Any) -> bytes:
    """Return a program that acts by the sum of its inputs."""
    node = helper.make_node("Sum", list(inputs), ["sum"])
    return acting([node], {name: [None, 2] for name in inputs}, **changed)


def test_foreign_program_runs_if_its_names_are_right() -> None:
    runtime = OnnxRuntime(other_program((OBSERVATIONS,)))
    runtime.load({})
    seen = np.array([[1, 2], [2, 1]], np.float32)
    noise = neutral_noise(runtime.noise_size, 2)
    choice = runtime.act({NAME: seen}, np.zeros((2, 0), np.float32), noise, {})
    np.testing.assert_array_equal(choice.actions[ACTION], seen)
    np.testing.assert_array_equal(choice.log_probs, [3, 3])


def test_program_with_wrong_outputs_is_rejected() -> None:
    for name in ("logits", "actions", LOG_PROB.upper()):
        with pytest.raises(PolicyError, match="must compute 'actions/NAME' and 'log_prob'"):
            OnnxRuntime(other_program((OBSERVATIONS,), actions=name))


def remembering(state: list[int | None] | None, made_of_it: str = "Identity") -> bytes:
    """Return a model with a memory of this shape."""
    nodes = [
        helper.make_node("Identity", [OBSERVATIONS], ["sum"]),
        helper.make_node(made_of_it, [STATE], [NEXT_STATE]),
    ]
    return acting(nodes, {OBSERVATIONS: [None, 2], STATE: state}, {NEXT_STATE: None})


def test_state_size_is_read_from_the_program() -> None:
    runtime = OnnxRuntime(remembering([None, 3]))
    runtime.load({})
    state = np.arange(6, dtype=np.float32).reshape(2, 3)
    assert runtime.state_size == 3
    choice = runtime.act({NAME: np.ones((2, 2), np.float32)}, state, neutral_noise(runtime.noise_size, 2), {})
    np.testing.assert_array_equal(choice.state, state)


@pytest.mark.parametrize("shape", [[None, None], [None, -1], [None, 1 << 40], [3], [None, 3, 3], []])
def test_memory_of_invalid_size_is_rejected(shape: list[int | None]) -> None:
    with pytest.raises(PolicyError, match=r"'state'|cannot be run"):
        OnnxRuntime(remembering(shape))


def test_next_state_of_another_shape_is_rejected() -> None:
    runtime = OnnxRuntime(remembering([None, 3], "Transpose"))
    runtime.load({})
    seen, state = {NAME: np.ones((2, 2), np.float32)}, np.zeros((2, 3), np.float32)
    with pytest.raises(PolicyError, match=r"'next_state' \(3, 2\)"):
        runtime.act(seen, state, neutral_noise(runtime.noise_size, 2), {})


@pytest.mark.parametrize("operation", ["Transpose", "Size"])
def test_actions_of_another_shape_are_rejected(operation: str) -> None:
    nodes = [
        helper.make_node(operation, [OBSERVATIONS], ["own"]),
        helper.make_node("Identity", [OBSERVATIONS], ["sum"]),
    ]
    nodes.append(helper.make_node("ReduceSum", ["sum", "axis"], [LOG_PROB], keepdims=0))
    kind = TensorProto.INT64 if operation == "Size" else TensorProto.FLOAT
    outputs = [
        helper.make_tensor_value_info("own", kind, None),
        helper.make_tensor_value_info(LOG_PROB, TensorProto.FLOAT, None),
    ]
    nodes[0].output[0] = outputs[0].name = ACTIONS
    source = helper.make_tensor_value_info(OBSERVATIONS, TensorProto.FLOAT, [None, None])
    axis = helper.make_tensor("axis", TensorProto.INT64, [1], [1])
    graph = helper.make_graph(nodes, "other", [source], outputs, [axis])
    program = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()
    with pytest.raises(PolicyError, match="returns 'action'"):
        act_without_memory(OnnxRuntime(program), np.ones((2, 3), np.float32))


def test_log_probability_of_another_shape_is_rejected() -> None:
    runtime = OnnxRuntime(other_program((OBSERVATIONS,), keepdims=1))
    with pytest.raises(PolicyError, match=r"returns 'log_prob' float32 \(2, 1\)"):
        act_without_memory(runtime, np.ones((2, 2), np.float32))


def test_program_that_fails_while_acting_raises_policy_error(one_policy: Policy) -> None:
    runtime = OnnxRuntime(one_policy.program)
    with pytest.raises(PolicyError, match="the program failed"):  # nothing is loaded yet
        act_without_memory(runtime, one_policy.observations(1))
    runtime.load(one_policy.weights())
    with pytest.raises(PolicyError, match="the program failed"):
        act_without_memory(runtime, np.zeros((1, 9), np.float32))


def test_program_reads_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.arange(2, dtype=np.float32).tofile("secret")
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[2], data_location=TensorProto.EXTERNAL)
    for key, value in (("location", "secret"), ("offset", "0"), ("length", "8")):
        tensor.external_data.add(key=key, value=value)
    node = helper.make_node("Max", [OBSERVATIONS, "w"], ["sum"])
    program = acting([node], {OBSERVATIONS: [None, 2]}, initializers=(tensor,))
    with pytest.raises(PolicyError, match="External data path"):
        OnnxRuntime(program)
    assert os.listdir() == ["secret"]


def test_weights_without_a_fixed_shape_are_rejected() -> None:
    runtime = OnnxRuntime(other_program((OBSERVATIONS, "w")))
    with pytest.raises(PolicyError, match="'w'"):
        runtime.load({"w": np.zeros((1, 2), np.float32)})


@pytest.mark.parametrize("garbage", [b"", b"\0", b"garbage", bytes(1000), np.random.default_rng(0).bytes(1000)])
def test_garbage_is_rejected(garbage: bytes) -> None:
    with pytest.raises(PolicyError):
        OnnxRuntime(garbage)


def test_truncated_program_is_rejected(one_policy: Policy) -> None:
    for length in range(1, len(one_policy.program), 37):
        with pytest.raises(PolicyError):
            OnnxRuntime(one_policy.program[:length])


# ---------------------------------------------------------------------------------------- the constants


def test_constants_give_the_same_results_as_inputs(policy: Policy) -> None:
    weights = {name: array for name, array in policy.weights().items() if name in policy.acting_names()}
    merged = onnx.load_model_from_string(with_initializers(policy.program, weights))
    assert {tensor.name for tensor in merged.graph.initializer} == policy.acting_names()
    for tensor in merged.graph.initializer:
        array = onnx.numpy_helper.to_array(tensor)
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, weights[tensor.name])
    before = onnx.load_model_from_string(policy.program)
    assert list(merged.graph.node) == list(before.graph.node)
    assert list(merged.graph.input) == list(before.graph.input)


@pytest.mark.parametrize("rows", [None, 1000, 20])
def test_only_programs_with_convolutions_use_constants_unless_for_few_rows(policy: Policy, rows: int | None) -> None:
    runtime = OnnxRuntime(policy.program, rows=rows)
    runtime.load(policy.weights())
    weights = policy.acting_names()
    fed = {entry.name for entry in runtime._session.onnx.get_inputs()} & weights
    assert fed == (set() if policy.network.convolutional and rows != 20 else weights)
    # onnxruntime does not arrange constants that an input could override.
    assert not runtime._session.onnx.get_overridable_initializers()


# ------------------------------------------------------------------------------------------ the weights


def test_missing_weight_is_named(runtime: PolicyRuntime, one_policy: Policy) -> None:
    for name in one_policy.acting_names():
        weights = one_policy.weights()
        del weights[name]
        with pytest.raises(PolicyError, match=f"lacks the weights '{name}'"):
            runtime.load(weights)


def test_acting_does_not_need_the_value_head(runtime: PolicyRuntime, one_policy: Policy) -> None:
    observations = one_policy.observations(32)
    runtime.load(one_policy.weights())
    _, with_head, _ = act_without_memory(runtime, observations)
    acting = {name: array for name, array in one_policy.weights().items() if name in one_policy.acting_names()}
    runtime.load(acting)
    np.testing.assert_array_equal(act_without_memory(runtime, observations)[1], with_head)
    runtime.load({**acting, "unheard.of": np.zeros(3, np.float32)})
    np.testing.assert_array_equal(act_without_memory(runtime, observations)[1], with_head)


@pytest.mark.parametrize("shape", [(64, 5), (63, 4), (4, 64), (256,), (64, 4, 1), (0, 4), ()])
def test_weights_of_another_shape_are_rejected_by_name(
    runtime: PolicyRuntime, one_policy: Policy, shape: tuple[int, ...]
) -> None:
    name = "encoder.layers.0.weight"
    with pytest.raises(PolicyError, match=name):
        runtime.load(one_policy.weights() | {name: np.zeros(shape, np.float32)})


def test_onnx_runtime_requires_float32_weights(one_policy: Policy) -> None:
    weights = one_policy.weights()
    weights["policy_head.bias"] = weights["policy_head.bias"].astype(np.int64)
    with pytest.raises(PolicyError, match=r"policy_head\.bias"):
        OnnxRuntime(one_policy.program).load(weights)


def test_rejected_weights_leave_the_loaded_ones_in_use(policy: Policy) -> None:
    observations, states = policy.observations(8), policy.states(8)
    for runtime in policy.runtimes():
        runtime.load(policy.weights())
        _, before, _ = act(runtime, observations, states)
        with pytest.raises(PolicyError):
            runtime.load(policy.weights(seed=2) | {"policy_head.bias": np.zeros(9, np.float32)})
        np.testing.assert_array_equal(act(runtime, observations, states)[1], before)


def test_new_weights_change_the_actions_and_old_ones_restore_them(runtime: PolicyRuntime, one_policy: Policy) -> None:
    observations, outputs = one_policy.observations(64), []
    for seed in (0, 1, 0):
        runtime.load(one_policy.weights(seed))
        outputs.append(act_without_memory(runtime, observations, generator()))
    assert (outputs[0][1] != outputs[1][1]).any()
    assert (outputs[0][0] != outputs[1][0]).any()
    np.testing.assert_array_equal(outputs[0][:2], outputs[2][:2])


def test_weights_may_be_read_only(runtime: PolicyRuntime, one_policy: Policy) -> None:
    weights = one_policy.weights()
    for array in weights.values():
        array.flags.writeable = False
    runtime.load(weights)
    assert act_without_memory(runtime, one_policy.observations(2))[0].shape == (2,)


def test_onnxruntime_sends_no_telemetry() -> None:
    """With telemetry enabled, onnxruntime warns that it cannot store the identity of this machine."""
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    environment |= {"HOME": "/proc", "XDG_CACHE_HOME": "/proc"}
    command = [sys.executable, "-c", "import daedalus.policy.acting.runtime"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert "elemetry" not in result.stderr
