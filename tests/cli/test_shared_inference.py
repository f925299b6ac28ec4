"""Actors whose policy runs in one process of their machine: launch/inference_process.py, SharedRuntime."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learner_status import env_steps, learner_status
from plain import act, plain_spaces
from processes import ENDLESS, PLAYING_SLOW, SLOW, Running, processes_mentioning, until

from daedalus.launch.supervision import Supervised, stop, supervised_inference
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyError
from daedalus.policy.acting.shared_runtime import Region, Shape, SharedRuntime
from daedalus.policy.acting.torch_runtime import TorchRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import LearningSpec, PolicySpec

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="this system cannot share a policy")
Start = Callable[..., Running]
ROWS = 3

SPACES = plain_spaces(ArraySpace(shape=(20, 20), dtype="uint8", frames=4), 5)
LEARNING = LearningSpec(policy=PolicySpec(encoder="small", memory="gru", hidden=(16,)))
SETUP: dict[str, Any] = {"learning": LEARNING.model_dump(mode="json"), "spaces": SPACES.model_dump(mode="json")}
NETWORK = ActorCritic(LEARNING.policy, SPACES)
PROGRAM = export_program(NETWORK, SPACES)


def weights(seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    return {
        name: random.normal(0, 0.1, tuple(values.shape)).astype(np.float32)
        for name, values in NETWORK.named_parameters()
    }


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Supervised]]:
    folder = str(tmp_path_factory.mktemp("i"))
    (process,), options = supervised_inference("shared", folder, ())
    try:
        yield options[1], process
    finally:
        stop([process.process])


def shared(path: str, *, program: bytes = PROGRAM, spaces: Spaces = SPACES) -> SharedRuntime:
    return SharedRuntime(path, {} if program else SETUP, program, spaces, threading.Event())


def inputs(seed: int, rows: int = ROWS) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    random = np.random.default_rng(seed)
    observations = random.integers(0, 256, (rows, 4, 20, 20), np.uint8)
    state = random.uniform(-1, 1, (rows, NETWORK.state_size)).astype(np.float32)
    return observations, state, random


@pytest.mark.parametrize("program", [PROGRAM, b""], ids=["onnx", "torch"])
def test_actors_with_several_versions_choose_as_local_ones_do(served: tuple[str, Supervised], program: bytes) -> None:
    """Their calls are joined: the actions are those of their own weights, inputs and noise."""
    actors = [shared(served[0], program=program) for _ in range(4)]
    local = OnnxRuntime(PROGRAM) if program else TorchRuntime(LEARNING.policy, SPACES, LEARNING.training)
    assert actors[0].noise_size == local.noise_size
    for turn in range(2):
        chosen: dict[int, Any] = {}

        def play(number: int, turn: int = turn, chosen: dict[int, Any] = chosen) -> None:
            actors[number].load(weights(turn + number // 2))
            chosen[number] = [act(actors[number], *inputs(each * 10 + number, ROWS + turn)) for each in range(8)]

        threads = [threading.Thread(target=play, args=(number,)) for number in range(len(actors))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for number in range(len(actors)):
            local.load(weights(turn + number // 2))
            for each, (actions, log_probs, state) in enumerate(chosen[number]):
                expected = act(local, *inputs(each * 10 + number, ROWS + turn))
                np.testing.assert_array_equal(actions, expected[0])
                np.testing.assert_allclose(log_probs, expected[1], atol=1e-5)
                np.testing.assert_allclose(state, expected[2], atol=1e-5)


def test_an_actor_goes_on_when_the_process_has_died_and_started_again(
    served: tuple[str, Supervised], caplog: pytest.LogCaptureFixture
) -> None:
    path, process = served
    actor = shared(path)
    actor.load(weights(1))
    before = act(actor, *inputs(1))
    process.process.kill()
    process.process.wait()
    assert process.check() == "the inference process was killed by signal 9; started again"
    for one, other in zip(act(actor, *inputs(1)), before, strict=True):
        np.testing.assert_array_equal(one, other)
    assert "the inference process of this machine has ended" in caplog.text


def test_an_actor_that_is_stopped_does_not_wait_for_a_process_that_does_not_answer(
    served: tuple[str, Supervised],
) -> None:
    path, process = served
    stopping = threading.Event()
    actor = SharedRuntime(path, {}, PROGRAM, SPACES, stopping)
    actor.load(weights(1))
    os.kill(process.process.pid, signal.SIGSTOP)
    try:
        stopping.set()
        with pytest.raises(PolicyError, match="does not answer"):
            act(actor, *inputs(1))
    finally:
        os.kill(process.process.pid, signal.SIGCONT)


def test_faulty_requests_are_refused_and_others_served(served: tuple[str, Supervised]) -> None:
    with pytest.raises(PolicyError, match="the inference process: the program is not an ONNX model"):
        shared(served[0], program=b"no program")
    actor = shared(served[0])
    faulty = weights(1)
    faulty[next(iter(faulty))] = np.zeros((1, 1), np.float32)
    with pytest.raises(PolicyError, match="the program requires float32"):
        actor.load(faulty)
    with pytest.raises(PolicyError, match="finds no GPU"):
        TorchRuntime(LEARNING.policy, SPACES, device="cuda")


def test_what_fails_for_one_actor_does_not_fail_for_those_that_share_its_call(served: tuple[str, Supervised]) -> None:
    """A run whose spaces do not fit its program; a signal for actors that their supervisor sends to all processes."""
    path, process = served
    name = "\U0001f600" * 1000  # more than an answer can carry
    unfit = SPACES.model_copy(update={"actions": {name: DiscreteSpace(counts=(5,))}})
    actors, chosen = [shared(path), shared(path, spaces=unfit)], []
    for actor in actors:
        actor.load(weights(1))

    def play(actor: SharedRuntime) -> None:
        try:
            chosen.append(len(act(actor, *inputs(1))[0]))
        except PolicyError as error:
            chosen.append(str(error))

    threads = [threading.Thread(target=play, args=(actor,)) for actor in actors]
    os.kill(process.process.pid, signal.SIGSTOP)
    try:
        for thread in threads:
            thread.start()
        time.sleep(0.5)  # so that both wait; on a very slow machine their calls may not be joined
        os.kill(process.process.pid, signal.SIGUSR1)
    finally:
        os.kill(process.process.pid, signal.SIGCONT)
    for thread in threads:
        thread.join()
    chose, failed = sorted(map(str, chosen))
    assert chose == str(ROWS)
    assert failed.startswith(f"the inference process: 'actions/{name[:100]}")
    assert process.process.poll() is None


@pytest.mark.parametrize("damage", ["cut", "described", "dtype"])
def test_shared_memory_that_is_not_as_described_is_refused(damage: str) -> None:
    region = Region.create([Shape("in/state", "float64" if damage == "dtype" else "float32", (2, 3))])
    if damage == "cut":
        os.truncate(region.descriptor, os.fstat(region.descriptor).st_size - 1)
    elif damage == "described":
        os.pwrite(region.descriptor, (1 << 40).to_bytes(8, "little"), 0)
    with pytest.raises(ValueError, match="shared memory"):
        Region.open(region.descriptor)


def test_actors_of_one_command_share_a_policy_and_survive_its_process(
    start: Start, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS, *SLOW)
    folder = tmp_path / ("too long for a socket" * 5)
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    group = start(
        *("actor", "--connect", address, "--name", "g", "--actors", 2, "--inference", "shared", *PLAYING_SLOW)
    )
    names = ["g.1", "g.2"]
    for name in names:
        until(lambda name=name: env_steps(learner_status(address), name) > 0)
    (inference,) = [
        pid for pid in processes_mentioning("daedalus.launch.inference_process") if parent(pid) == group.process.pid
    ]
    assert "libtorch" not in Path(f"/proc/{inference}/maps").read_text()
    os.kill(inference, signal.SIGKILL)
    group.expect("the inference process was killed by signal 9; started again")
    before = {name: env_steps(learner_status(address), name) for name in names}
    for name in names:
        until(lambda name=name: env_steps(learner_status(address), name) > before[name])
    group.process.terminate()
    assert group.wait() == 0, group.output


def test_a_group_goes_on_without_an_actor_that_crashes_and_leaves_although_one_just_starts(
    start: Start, address: str
) -> None:
    group = start("actor", "--connect", address, "--name", "g", "--actors", 2)

    crashed: list[int] = []
    for _ in range(3):
        crashed.append(child(group, "g.1", crashed))
        os.kill(crashed[-1], signal.SIGSEGV)
    group.expect(r"daedalus actor: g.1 failed 3 times: a fault of native code \(signal 11\)")
    os.kill(child(group, "g.2"), signal.SIGKILL)
    group.expect("g.2 was killed by signal 9; started again")
    group.process.send_signal(signal.SIGUSR1)  # which kills an actor that has no handler yet
    assert group.wait() == 1, group.output
    assert "started again" not in group.output.rpartition("signal 9; started again")[2]


def child(group: Running, name: str, besides: Sequence[int] = ()) -> int:
    found: list[int] = []

    def find() -> list[int]:
        pids = set(processes_mentioning(f"\0{name}\0")).difference(besides)
        found.extend(pid for pid in pids if parent(pid) == group.process.pid)
        return found

    until(find)
    return found[0]


def parent(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
    except OSError:  # it has ended
        return 0
