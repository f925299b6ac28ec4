"""A program of another process cannot loop, allocate without limit, or run longer than the watchdog allows."""

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from daedalus.policy.acting import program_check, program_session
from daedalus.policy.acting.noise import neutral_noise
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.program_session import CallWatchdog, ProgramSession
from daedalus.policy.acting.runtime import OnnxRuntime

OBSERVATIONS = np.ones((2, 2), np.float32)
NO_STATE = np.zeros((2, 0), np.float32)
SEEN = "observations/observation"
INPUT = helper.make_tensor_value_info(SEEN, TensorProto.FLOAT, [None, 2])
ACTIONS = helper.make_tensor_value_info("actions/action", TensorProto.FLOAT, [None, 2])
LOG_PROB = helper.make_tensor_value_info("log_prob", TensorProto.FLOAT, [None])
COPY = helper.make_node("Identity", [SEEN], ["y"])


def model(nodes: Sequence[onnx.NodeProto], *initializers: TensorProto) -> onnx.ModelProto:
    """Return a program whose `nodes` compute y [N, 2]: the action, and by its columns' sum the log-probability."""
    ends = [
        helper.make_node("Identity", ["y"], ["actions/action"]),
        constant("axis", 1),
        helper.make_node("ReduceSum", ["y", "axis"], ["log_prob"], keepdims=0),
    ]
    graph = helper.make_graph([*nodes, *ends], "program", [INPUT], [ACTIONS, LOG_PROB], initializers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def constant(name: str, *numbers: int) -> onnx.NodeProto:
    return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.array(numbers, np.int64)))


def endless() -> onnx.ModelProto:
    """Return a model that repeats a loop of 2^63 - 1 iterations, in about 320 bytes."""
    value = [helper.make_tensor_value_info(name, kind, []) for name, kind in (("i", 7), ("c", 9), ("x", 1))]
    body = helper.make_graph(
        [helper.make_node("Identity", ["c"], ["c_out"]), helper.make_node("Neg", ["x"], ["x_out"])],
        "body",
        value,
        [helper.make_tensor_value_info("c_out", 9, []), helper.make_tensor_value_info("x_out", 1, [])],
    )
    scalars = (np.array(2**63 - 1), np.array(True), np.array(1, np.float32))
    tensors = [numpy_helper.from_array(scalar, name) for scalar, name in zip(scalars, ("n", "go", "x0"), strict=True)]
    loop = helper.make_node("Loop", ["n", "go", "x0"], ["z"], body=body)
    return model([loop, helper.make_node("Mul", [SEEN, "z"], ["y"])], *tensors)


def huge(*, constant_shape: bool) -> list[onnx.NodeProto]:
    """Return nodes that compute y by way of a tensor of 4 GiB, or of 256 MiB if its shape is a constant."""
    shape = [constant("shape", 1 << 26)]
    if not constant_shape:
        shape = [
            helper.make_node("Shape", [SEEN], ["rows_columns"]),
            constant("factor", 1 << 14, 1 << 14),
            helper.make_node("Mul", ["rows_columns", "factor"], ["shape"]),
        ]
    return [
        *shape,
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("ReduceSum", ["zeros"], ["sum"], keepdims=0),
        helper.make_node("Add", [SEEN, "sum"], ["y"]),
    ]


# ------------------------------------------------------------------------------------------------ operators


def nested_in_an_allowed_operator() -> onnx.ModelProto:
    inner = helper.make_graph([COPY], "inner", [INPUT], [ACTIONS])
    return model([helper.make_node("Identity", [SEEN], ["y"], body=inner)])


def function() -> onnx.ModelProto:
    result = model([COPY])
    opset = helper.make_opsetid("", 17)
    result.functions.append(helper.make_function("d", "f", ["x"], ["y"], [COPY], [opset]))
    return result


def sparse() -> onnx.ModelProto:
    result = model([COPY])
    indices = helper.make_tensor("i", TensorProto.INT64, [1], [0])
    values = helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0])
    result.graph.sparse_initializer.append(helper.make_sparse_tensor(values, indices, [1 << 40]))
    return result


def heavy_constant() -> onnx.ModelProto:
    """Return a model whose operator takes 4 TiB for itself, and whose result is one number."""
    ones = [numpy_helper.from_array(np.ones(1000, np.float32), name) for name in "abcd"]
    einsum = helper.make_node("Einsum", [*"abcd", *"abcd"], ["z"], equation="i,j,k,l,i,j,k,l->")
    return model([einsum, helper.make_node("Add", [SEEN, "z"], ["y"])], *ones)


def heavy_constant_of_a_shape() -> onnx.ModelProto:
    """Return a model in which onnxruntime replaces the shape of an input by a constant."""
    shape = [helper.make_node("Shape", [SEEN], ["s"]), helper.make_node("ConstantOfShape", ["s"], ["x"])]
    einsum = helper.make_node("Einsum", ["x"], ["z"], equation="ij->")
    return model([*shape, einsum, helper.make_node("Add", [SEEN, "z"], ["y"])])


def constant_observations() -> onnx.ModelProto:
    return model([COPY], numpy_helper.from_array(OBSERVATIONS, SEEN))


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (endless(), "the operator 'Loop', which is not allowed"),
        (model([helper.make_node("RandomNormalLike", [SEEN], ["y"])]), "'RandomNormalLike'"),
        (
            model([helper.make_node("Identity", [SEEN], ["y"], domain="com.microsoft")]),
            "only those of ONNX",
        ),
        (nested_in_an_allowed_operator(), "nested graphs"),
        (function(), "functions"),
        (sparse(), "sparse tensors"),
        (heavy_constant(), "Einsum from constants alone"),
        (heavy_constant_of_a_shape(), "Einsum from constants alone"),
        (constant_observations(), "constants in place of its inputs"),
        (model([COPY] * 4997), "5000 nodes, the limit is 4096: declare one MultiDiscrete or Box in place of many"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_program_with_what_no_policy_needs_is_refused(program: onnx.ModelProto, reason: str) -> None:
    with pytest.raises(PolicyError, match=reason):
        OnnxRuntime(program.SerializeToString())


def test_program_is_refused_wherever_its_graph_is_split() -> None:
    """Protobuf merges the occurrences of a message, and takes the last of a text: all of them are checked."""
    bomb, harmless = endless().SerializeToString(), model([COPY]).SerializeToString()
    for program in (bomb + harmless, harmless + bomb):
        with pytest.raises(PolicyError, match="'Loop'"):
            OnnxRuntime(program)


def test_large_program_is_refused_unread() -> None:
    with pytest.raises(PolicyError, match="the limit is"):
        OnnxRuntime(bytes(program_check.MAX_PROGRAM_BYTES + 1))


def test_program_in_the_format_of_onnxruntime_is_refused() -> None:
    with pytest.raises(PolicyError, match="No graph was found in the protobuf"):
        OnnxRuntime(b"\x0a\x06\x00\x00ORTM\x12\x00")  # protobuf to the checks, onnxruntime's own format by its mark


@pytest.mark.parametrize(
    "garbage",
    [b"\x3a\xff\xff\xff\xff\x0f", b"\x3a" + b"\xff" * 11, b"\x3b", b"\xba\x80\x80\x80\x80\x01\x00", b"\x3a\x05a"],
    ids=["field too long", "endless integer", "group", "tag of more than 32 bits", "truncated"],
)
def test_bytes_that_parsers_could_read_differently_are_refused(garbage: bytes) -> None:
    with pytest.raises(PolicyError, match="not an ONNX model"):
        program_check.check_program(garbage, lambda _: False)


# --------------------------------------------------------------------------------------------------- memory


def test_memory_of_a_program_is_limited() -> None:
    runtime = OnnxRuntime(model(huge(constant_shape=False)).SerializeToString())
    runtime.load({})
    with pytest.raises(PolicyError, match="the program failed"):
        runtime.act({"observation": OBSERVATIONS}, NO_STATE, neutral_noise(runtime.noise_size, 2), {})
    assert len(model(huge(constant_shape=False)).SerializeToString()) < 500


def test_large_constants_are_not_computed_when_a_program_is_loaded() -> None:
    """The limit on memory is one of calls: it does not cover what onnxruntime computes to optimise a program."""
    program = model(huge(constant_shape=True)).SerializeToString()
    ProgramSession(model([COPY]).SerializeToString(), CallWatchdog(None))
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = peak()
    ProgramSession(program, CallWatchdog(None))
    assert peak() - before < 100 << 20


def peak() -> int:
    """Return the largest memory of this process so far, in bytes."""
    (line,) = [each for each in Path("/proc/self/status").read_text().splitlines() if each.startswith("VmHWM")]
    return int(line.split()[1]) << 10


# ----------------------------------------------------------------------------------------------------- time


def started(stop: threading.Event | None = None) -> ProgramSession:
    """Return a session of the endless program, as if it had passed the checks."""
    return ProgramSession(endless().SerializeToString(), CallWatchdog(stop))


def test_call_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program_session, "CALL_SECONDS", 0.3)
    with pytest.raises(PolicyError, match="took too long"):
        started().run({SEEN: OBSERVATIONS})


def test_stop_ends_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program_session, "STOP_SECONDS", 0.1)
    stop = threading.Event()
    timer = threading.Timer(0.2, stop.set)
    timer.start()
    with pytest.raises(PolicyError, match="took too long"):
        started(stop).run({SEEN: OBSERVATIONS})
    assert stop.is_set()
    timer.join()


def test_calls_within_the_limit_are_not_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program_session, "CALL_SECONDS", 30.0)
    stop = threading.Event()
    stop.set()
    session = ProgramSession(model([COPY]).SerializeToString(), CallWatchdog(stop))
    for _ in range(3):
        np.testing.assert_array_equal(session.run({SEEN: OBSERVATIONS})[0], OBSERVATIONS)
        threading.Event().wait(0.3)  # the watchdog has looked between two calls


def test_time_in_which_the_process_was_frozen_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    watchdog, cancelled = CallWatchdog(None), threading.Event()
    watchdog.begin(cancelled.set)
    monkeypatch.setattr(time, "monotonic", lambda: 1e9)
    watchdog.tick()
    assert not cancelled.is_set()
    for _ in range(round(program_session.CALL_SECONDS / 0.2) + 1):
        watchdog.tick()
    assert cancelled.is_set()


def test_watchdog_ends_with_its_owner() -> None:
    watchdog = CallWatchdog(None)
    thread = [each for each in threading.enumerate() if each.name == "call-watchdog"][-1]
    del watchdog
    thread.join(60.0)
    assert not thread.is_alive()
