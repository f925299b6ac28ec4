"""Test of the TypeScript actor in examples/node: its own tests, a recording learner, and a real learner."""

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import nested_environment
import node
import numpy as np
import pytest
import torch
from gateways import RunningGateway
from learner_status import actor_status, env_steps, learner_status
from plain import ACTION, NAME, plain
from processes import Running, until
from recording_learner import ONE_AT_A_TIME, SPEC, RecordingLearner

from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.codec import PROTOCOL_VERSION
from daedalus.protocol.messages import Acknowledgement, Refusal
from daedalus.protocol.spec import EnvironmentSpec, RunSpec, TrainingSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

Start = Callable[..., Running]


def test_the_tests_of_the_node_actor_pass() -> None:
    run = subprocess.run([node.program(), "--test"], cwd=node.FOLDER, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.fixture
def network() -> Iterator[tuple[MemoryNetwork, str]]:
    """Memory network and the address of a gateway to it."""
    inside = MemoryNetwork()
    gateway = RunningGateway(inside, follows=False)
    yield inside, f"127.0.0.1:{gateway.port}"
    gateway.close()


@pytest.fixture
def begin() -> Iterator[Callable[..., Running]]:
    """Function that starts an actor with the gateway at HOST:PORT. Actors left are killed at the end."""
    running: list[Running] = []

    def begin_one(address: str, environments: int = 6) -> Running:
        words = [node.program(), "main.ts", "--gateway", address, "--name", "wing-ts", "--envs", str(environments)]
        running.append(Running(words, node.FOLDER))
        return running[-1]

    yield begin_one
    for one in running:
        one.end()


@pytest.fixture
def play(
    network: tuple[MemoryNetwork, str], begin: Callable[[str], Running]
) -> Callable[..., tuple[RecordingLearner, Running]]:
    """Function that starts a recording learner and an actor."""
    inside, address = network

    def begin_both(spec: RunSpec = SPEC, epsilon: float = 0.0) -> tuple[RecordingLearner, Running]:
        torch.manual_seed(0)
        learner = RecordingLearner(MemoryTransport(inside), spec)
        learner.epsilon = epsilon
        return learner, begin(address)

    return begin_both


def gymnasium_step(state: np.ndarray, action: int) -> tuple[np.ndarray, bool]:
    cart = gymnasium.make("CartPole-v1").unwrapped
    cart.reset()
    cart.state = state.astype(np.float64)  # pyright: ignore[reportAttributeAccessIssue]
    seen, _, terminated, _, _ = cart.step(action)
    return seen, bool(terminated)


def test_every_row_agrees_with_the_program_and_with_gymnasium(
    play: Callable[..., tuple[RecordingLearner, Running]],
) -> None:
    learner, process = play(ONE_AT_A_TIME)
    seen, ended, running = None, np.zeros(6, np.bool_), np.zeros(6)
    tail = state = None
    for expected in range(6):
        rollout = learner.next()
        assert (rollout.identity.sequence, rollout.identity.learner_epoch) == (expected, 2**62 + 5)
        assert rollout.identity.incarnation == learner.joins[-1].incarnation
        frames, actions = plain(rollout.frames), plain(rollout.actions)
        assert (frames.shape, frames.dtype, actions.shape) == ((49, 6, 4), np.float32, (48, 6, 1))
        assert tail is None or np.array_equal(frames[0], tail)
        assert state is None or np.allclose(rollout.initial_state, state, atol=1e-5)
        state, finished = rollout.initial_state, []
        for row in range(48):
            seen = frames[row]
            chosen, state = log_prob_and_state(learner.network, seen, actions[row], state)
            assert np.allclose(rollout.behaviour_log_probs[row], chosen, atol=1e-5)
            assert np.array_equal(rollout.valid[row], ~ended)
            assert np.allclose(rollout.rewards[row], 0.05 * ~ended)
            for e in range(6):
                after = frames[row + 1, e]
                if ended[e]:
                    assert (np.abs(after) <= 0.05).all()
                    assert not rollout.terminated[row, e]
                    assert not rollout.truncated[row, e]
                    continue
                expected_frame, terminated = gymnasium_step(seen[e], int(actions[row, e, 0]))
                assert np.allclose(after, expected_frame, atol=1e-4)
                assert rollout.terminated[row, e] == terminated
            running += rollout.valid[row]
            assert np.array_equal(rollout.truncated[row], (running >= 40) & ~ended)
            state = state * rollout.valid[row][:, None]
            ended = rollout.terminated[row] | rollout.truncated[row]
            finished += running[ended].tolist()
            running[ended] = 0
        tail = frames[-1]
        assert rollout.episode_lengths.tolist() == finished
        assert rollout.episode_returns.tolist() == finished
    learner.end_run()
    assert process.wait() == 0, process.output
    process.expect("the run is over: the test is over")


def log_prob_and_state(
    network: ActorCritic, observations: np.ndarray, actions: np.ndarray, state: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return log-probabilities [E] of actions [E, 1] and the next state, as torch computes them."""
    with torch.no_grad():
        parameters, after = network.step({NAME: torch.from_numpy(observations.copy())}, torch.from_numpy(state.copy()))
        chosen = {ACTION: torch.from_numpy(actions.astype(np.int64))}
        return network.distribution.log_prob(parameters, chosen, {}).numpy(), after.numpy()


def test_the_actor_explores_with_the_epsilon_of_its_welcome(
    play: Callable[..., tuple[RecordingLearner, Running]],
) -> None:
    learner, _ = play(SPEC.model_copy(update={"training": TrainingSpec(algorithm="n_step_q")}), epsilon=0.5)
    log_probs = learner.next().behaviour_log_probs
    is_random = np.isclose(log_probs, np.log(0.25), atol=1e-5)
    assert (is_random | np.isclose(log_probs, np.log(0.75), atol=1e-5)).all()
    assert 0.1 < is_random.mean() < 0.4


def test_the_actor_obeys_each_verdict(play: Callable[..., tuple[RecordingLearner, Running]]) -> None:
    learner, process = play(ONE_AT_A_TIME)
    for verdict in ("busy", "busy", "rejected", "fenced"):
        learner.verdicts.put(Acknowledgement(verdict=verdict, policy_version=0))
    again = [learner.next() for _ in range(3)]  # busy: the actor sends the same rollout again
    assert [rollout.identity.sequence for rollout in again] == [0, 0, 0]
    assert all(np.array_equal(plain(rollout.frames), plain(again[0].frames)) for rollout in again)
    assert (
        learner.next().identity.sequence == 1
    )  # a rejected rollout is not sent again; the answer to this one is fenced
    joined = len(learner.joins)
    until(lambda: len(learner.joins) > joined)
    assert learner.next().identity.sequence == 2  # the same learner epoch, so the sequence numbers continue
    learner.verdicts.put(Acknowledgement(verdict="quarantined", reason="not finite"))
    assert process.wait() == 1
    process.expect("the learner quarantined this actor: not finite")


def test_the_actor_uses_the_newest_weights_and_joins_a_restarted_learner(
    play: Callable[..., tuple[RecordingLearner, Running]],
) -> None:
    learner, process = play(ONE_AT_A_TIME)
    learner.next()
    learner.publish()
    learner.await_rollout(lambda rollout: rollout.policy_version == 1)
    learner.epoch += 1
    learner.publish()
    rollout = learner.await_rollout(lambda rollout: rollout.identity.learner_epoch == learner.epoch)
    assert rollout.identity.sequence == 0
    learner.verdicts.put(Acknowledgement(verdict="finished"))
    assert process.wait() == 0, process.output


def test_damaged_snapshots_are_ignored_and_another_protocol_version_is_reported(
    play: Callable[..., tuple[RecordingLearner, Running]],
) -> None:
    learner, process = play(ONE_AT_A_TIME)
    learner.next()
    for damaged in (b"", b"nonsense", learner.snapshot()[:-1], learner.snapshot().replace(b"kind", b"find")):
        learner.push(damaged)
        time.sleep(0.05)  # so that each message is the newest for a while
    learner.publish()
    learner.await_rollout(lambda rollout: rollout.policy_version == 1)
    learner.push(b"DAED" + (99).to_bytes(2, "little") + learner.snapshot()[6:])
    assert process.wait() == 1
    process.expect(f"the other end uses protocol version 99, this one {PROTOCOL_VERSION}")


def test_the_actor_waits_while_its_name_is_taken(
    network: tuple[MemoryNetwork, str], begin: Callable[[str], Running]
) -> None:
    inside, address = network
    learner = RecordingLearner(MemoryTransport(inside))
    for _ in range(2):
        learner.refusals.put(Refusal(code="name_taken", reason="wing-ts takes part already"))
    actor = begin(address)
    actor.expect("wing-ts takes part already; looking")
    actor.expect("joined run 'r'")
    learner.next()
    actor.process.terminate()
    assert actor.wait() == 0, actor.output
    until(lambda: learner.present == {("wing-ts", learner.joins[0].incarnation): False})
    learner.refusals.put(Refusal(code="full", reason="no room"))
    refused = begin(address)
    assert refused.wait() == 1
    refused.expect("refused this actor: no room")


def test_with_a2c_the_actor_sends_one_rollout_of_each_policy_version(
    play: Callable[..., tuple[RecordingLearner, Running]],
) -> None:
    learner, process = play(SPEC.model_copy(update={"training": TrainingSpec(algorithm="a2c")}))
    for version in range(4):
        rollout = learner.next()
        assert rollout.policy_version == version
        learner.publish()
    learner.end_run()
    assert process.wait() == 0, process.output


def test_with_a2c_the_actor_requests_the_next_version_if_its_rollout_is_stale(
    play: Callable[..., tuple[RecordingLearner, Running]],
) -> None:
    """Otherwise it would send stale rollouts for ever if the push of that version was lost."""
    learner, _ = play(ONE_AT_A_TIME.model_copy(update={"training": TrainingSpec(algorithm="a2c")}))
    learner.next()
    learner.verdicts.put(Acknowledgement(verdict="rejected", policy_version=2))
    learner.publish()
    learner.version = 2  # published, but the push is lost
    assert learner.next().policy_version == 1
    assert learner.next().policy_version == 2


def test_the_actor_refuses_an_environment_that_it_cannot_play(
    play: Callable[..., tuple[RecordingLearner, Running]],
) -> None:
    _, process = play(RunSpec(environment=EnvironmentSpec(id="CartPole-v1", action_repeat=2)))
    assert process.wait() == 1
    process.expect(r"CartPole-v1 has unsupported settings \(action_repeat\)")


def test_a_real_learner_trains_on_the_rollouts_of_the_actor(
    start: Start, begin: Callable[[str], Running], address: str
) -> None:
    node.program()
    endless = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)
    learner = start("learner", "cartpole", "--listen", address, "--run-dir", "run", *endless)
    learner.expect("actors join with")
    gateway = start("gateway", "--connect", address, "--listen", "127.0.0.1:0")
    actor = begin(gateway.expect(r"clients connect to ws://(\S+)/actor")[1])

    until(lambda: env_steps(learner_status(address), "wing-ts") > 0)
    before = env_steps(learner_status(address), "wing-ts")
    until(lambda: env_steps(learner_status(address), "wing-ts") > before + 10_000)
    report = learner_status(address)
    (seen,) = report["actors"]
    assert seen["alive"]
    assert seen["environments"] == 6
    assert seen["rollouts_accepted"] > 0
    assert set(seen["rollouts_rejected"]) <= {"stale"}
    assert report["episode_return_mean"] > 5  # the statistics of its episodes arrived
    actor.process.kill()
    until(lambda: actor_status(learner_status(address), "wing-ts").get("alive") is False)
    learner.process.terminate()
    learner.wait()
    gateway.process.terminate()
    assert gateway.wait() == 0, gateway.output


def test_a_real_learner_learns_nested_spaces_with_masks_from_the_actor(
    start: Start, begin: Callable[..., Running], address: str, tmp_path: Path
) -> None:
    """The observation is a nested Dict with an image, the action a Tuple; each part is learned from another part."""
    node.program()
    shutil.copy(nested_environment.__file__, tmp_path)
    settings = (
        *nested_environment.SETTINGS,
        "training.batch_rollouts=2",
        "collection.rollout_length=16",
    )
    words = [word for setting in settings for word in ("--set", setting)]
    environment = ("--env", "nested_environment:NestedMasked-v0", "--env-steps", 400_000)
    learner = start("learner", *environment, *words, "--listen", address, "--run-dir", "run")
    learner.expect("actors join with")
    gateway = start("gateway", "--connect", address, "--listen", "127.0.0.1:0")
    actor = begin(gateway.expect(r"clients connect to ws://(\S+)/actor")[1], environments=32)
    assert learner.wait() == 0, learner.output
    assert actor.wait() == 0, actor.output
    result = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert result["solved"] is True
    assert result["rollouts_rejected"].keys() <= {"stale"}
    gateway.process.terminate()
    assert gateway.wait() == 0, gateway.output
