"""What an actor uploads: rollouts, or gradients at the weights that played them."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from processes import LIMIT
from scripted_learner import POLICY, SPACES, SPEC, Policy, RunningActor, ScriptedLearner, acknowledge

from daedalus.actor.collecting.client_collector import ClientCollector
from daedalus.actor.errors import ActorError
from daedalus.actor.session.uploading import RolloutUploadMaker, make_upload_maker
from daedalus.algorithms.gradient_inputs import NAME as GRADIENT_INPUTS
from daedalus.algorithms.gradient_inputs import GradientInputs, packed
from daedalus.learner.serving.upload_checks import restored
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.protocol.uploads import Gradient
from daedalus.transport.memory import MemoryNetwork


def spec_of(upload: str = "gradients", algorithm: str = "a3c", **policy: Any) -> RunSpec:
    content = SPEC.model_dump()
    content["collection"]["upload"] = upload
    content["training"]["algorithm"] = algorithm
    content["policy"] |= policy
    return RunSpec.model_validate(content)


def test_an_actor_sends_the_gradient_of_its_rollout_in_its_place(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network, spec_of())
    actor = RunningActor(network)
    learner.extras = {GRADIENT_INPUTS: packed(GradientInputs(0.01, 0.0, 0.0, 0.0))}
    learner.publish(3)
    for sequence in range(2):
        request = learner.rollouts.get(timeout=LIMIT)
        message = decode(request.payload, Limits())
        assert isinstance(message, Gradient)
        assert (message.identity.sequence, message.policy_version, message.env_steps) == (sequence, 3, 8)
        assert message.gradient.keys() == {name for name, _ in POLICY.network.named_parameters()}
        assert any(values.any() for values in message.gradient.values())
        acknowledge(request, "accepted")
    actor.end()


def test_the_gradient_is_that_of_the_snapshot_that_played_the_rollout(network: MemoryNetwork) -> None:
    """A value far too high, which only the snapshot's network has, makes a large gradient."""
    policy = Policy.of(PolicySpec(), SPACES)
    with torch.no_grad():
        dict(policy.network.named_parameters())["value_head.bias"].fill_(1e4)
    learner = ScriptedLearner(network, spec_of(), policy=policy)
    actor = RunningActor(network)
    learner.extras = {GRADIENT_INPUTS: packed(GradientInputs(0.01, 0.0, 0.0, 0.0))}
    learner.publish(3)
    message = decode(learner.rollouts.get(timeout=LIMIT).payload, Limits())
    assert isinstance(message, Gradient)
    assert restored(message).gradient["value_head.bias"].item() > 50.0
    actor.end()


def test_an_actor_that_uploads_rollouts_never_imports_torch() -> None:
    program = """
import sys
sys.modules["torch"] = None  # as if it were not installed
from daedalus.actor.errors import ActorError
from daedalus.actor.session.uploading import make_upload_maker
from daedalus.policy.user_modules import NO_MODULES
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
spaces = Spaces.model_validate({
    "observations": {"o": {"kind": "array", "shape": [4], "dtype": "float32"}},
    "actions": {"a": {"kind": "discrete", "counts": [2]}},
})
for upload in ("rollouts", "gradients"):
    spec = {"environment": {"id": "A-v0"}, "training": {"algorithm": "a3c"}, "collection": {"upload": upload}}
    try:
        print(type(make_upload_maker(RunSpec.model_validate(spec).for_actors(), spaces, NO_MODULES)).__name__)
    except ActorError as error:
        print(error)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines() == [
        "RolloutUploadMaker",
        "this run takes gradients (collection.upload), which an actor computes with torch: install it with "
        "pip install 'daedalus-rl[learner]', or set collection.upload=rollouts",
    ]


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        (spec_of(encoder="nets:Net"), "asks for policy.encoder=nets:Net, but the module nets may not be imported here"),
        (spec_of(algorithm="mine:Own"), "asks for training.algorithm=mine:Own, but the module mine may not be"),
    ],
)
def test_an_actor_imports_modules_for_gradients_only_if_its_command_line_allows_them(
    spec: RunSpec, reason: str
) -> None:
    with pytest.raises(ActorError, match=reason):
        make_upload_maker(spec.for_actors(), SPACES, UserModules(frozenset({"other"}), "the learner"))
    rollouts = spec.model_copy(update={"collection": spec.collection.model_copy(update={"upload": "rollouts"})})
    assert isinstance(make_upload_maker(rollouts.for_actors(), SPACES, NO_MODULES), RolloutUploadMaker)
    assert rollouts.actor_modules == {}
    assert spec.actor_modules == spec.learner_modules


def test_a_network_that_cannot_be_constructed_is_reported_in_one_line() -> None:
    with pytest.raises(ActorError, match="absent_module"):
        make_upload_maker(
            spec_of(encoder="absent_module:Net").for_actors(), SPACES, UserModules(frozenset({"absent_module"}))
        )


def test_a_client_refuses_a_run_that_takes_gradients() -> None:
    from gymnasium.spaces import Box, Discrete

    client = ClientCollector(Box(-1.0, 1.0, (4,), np.float32), Discrete(2), None)
    with pytest.raises(ActorError, match="this run takes gradients"):
        client.prepare(spec_of().for_actors())


@pytest.mark.parametrize(("algorithm", "kind"), [("impala", "corrects"), ("appo", "makes several updates")])
def test_algorithms_that_only_the_learner_can_compute_refuse_gradients(algorithm: str, kind: str) -> None:
    with pytest.raises(ValueError, match=f"collection.upload is gradients, but {algorithm} {kind}"):
        spec_of(algorithm=algorithm)
    assert spec_of("rollouts", algorithm).training.algorithm == algorithm
