"""ActorService against a scripted learner, over the memory transport: joining and uploading."""

import numpy as np
from plain import array_space, choices, plain, plain_spaces
from processes import LIMIT
from scripted_learner import SPACES, SPEC, SYNCHRONOUS_SPEC, Policy, RunningActor, ScriptedLearner, acknowledge

from daedalus.protocol.spec import PolicySpec
from daedalus.transport.memory import MemoryNetwork


def test_actor_joins_without_spaces_and_then_with_them(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    actor = RunningActor(network)
    asked, counted_in = learner.joins.get(timeout=LIMIT), learner.joins.get(timeout=LIMIT)
    assert asked.spaces is None
    assert (counted_in.spaces, counted_in.environments) == (SPACES, 2)
    actor.end()


def test_actor_keeps_a_window_of_numbered_rollouts_in_flight(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(3)
    first, second = learner.receive(), learner.receive()
    assert [first[0].identity.sequence, second[0].identity.sequence] == [0, 1]
    assert first[0].policy_version == 3
    assert learner.rollouts.empty()  # two are not acknowledged: there is no third, however long this test takes
    acknowledge(first[1], "accepted")
    assert learner.receive()[0].identity.sequence == 2


def test_frame_stack_and_memory_follow_the_run(network: MemoryNetwork) -> None:
    policy = PolicySpec(hidden=(8,), memory="gru", memory_units=5)
    environment = SPEC.environment.model_copy(update={"frame_stack": 3})
    spec = SPEC.model_copy(update={"environment": environment, "policy": policy})
    spaces = plain_spaces(array_space(SPACES).model_copy(update={"frames": 3}), choices(SPACES))
    learner = ScriptedLearner(network, spec, policy=Policy.of(policy, spaces))
    actor = RunningActor(network)
    learner.publish(0)
    received = []
    for _ in range(2):
        rollout, request = learner.receive()
        acknowledge(request, "accepted")
        received.append(rollout)
    actor.end()
    assert [learner.joins.get(timeout=LIMIT).spaces for _ in range(2)] == [None, spaces]
    first, second = received
    frames, later = plain(first.frames), plain(second.frames)
    assert frames.shape == later.shape == (3 + 4, 2, 4)
    np.testing.assert_array_equal(frames[4:], later[:3])
    assert first.initial_state.shape == (2, 5)
    assert not first.initial_state.any()
    assert second.initial_state.any()


def test_busy_rollout_is_sent_again(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    rollout, request = learner.receive()
    assert learner.receive()[0].identity.sequence == 1
    acknowledge(request, "busy")
    again, _ = learner.receive()
    assert again.identity == rollout.identity
    np.testing.assert_equal(again.frames, rollout.frames)


def test_actor_fenced_by_the_same_learner_epoch_continues_its_sequence(
    network: MemoryNetwork, actor: RunningActor
) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    _, request = learner.receive()
    acknowledge(request, "rejected")
    _, request = learner.receive()
    acknowledge(request, "fenced")
    sequences = []
    for _ in range(3):
        rollout, request = learner.receive()
        acknowledge(request, "accepted")
        sequences.append(rollout.identity.sequence)
    assert sequences[-1] >= 3  # the learner knows the earlier ones


def test_synchronous_actor_replaces_a_rejected_rollout_under_the_same_version(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network, SYNCHRONOUS_SPEC)
    actor = RunningActor(network)
    learner.publish(0)
    _, request = learner.receive()
    acknowledge(request, "rejected")
    again, _ = learner.receive()
    assert (again.identity.sequence, again.policy_version) == (1, 0)
    actor.end()
