"""examples/node/policy.ts with a program of nested spaces and masks, against the network that the program came from."""

import json
import subprocess
from pathlib import Path

import node
import numpy as np
import torch
from nested_environment import NestedEnvironment

from daedalus.actor.environments.transforms import Transforms
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import program_hash
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec

ROWS = 200
SCRIPT = """
import { readFileSync } from "node:fs";
import { Policy } from "./policy.ts";
import { seeded } from "./random.ts";
import { decode } from "./wire.ts";

const [folder, hash] = process.argv.slice(1);
const policy = await Policy.load(readFileSync(`${folder}/program`), hash);
// The names of a snapshot's arrays begin with `weights/`.
const read = (name) => Object.entries(decode(readFileSync(`${folder}/${name}`)).arrays)
  .map(([key, array]) => [key.slice("weights/".length), array]);
policy.bind(Object.fromEntries(read("snapshot")));
const observations = {}, masks = {};
for (const [name, array] of read("observations")) {
  const [kind, component] = name.split("/");
  (kind === "seen" ? observations : masks)[component] = array;
}
const { actions, logProbs } = await policy.act(observations, new Float32Array(0), masks, seeded(1));
const plain = Object.entries(actions).map(([name, values]) => [name, [...values]]);
console.log(JSON.stringify({ actions: Object.fromEntries(plain), logProbs: [...logProbs] }));
"""


def test_actions_are_legal_and_have_the_networks_log_probabilities(tmp_path: Path) -> None:
    program = node.program()
    robot = NestedEnvironment(masked=True)
    mask = {"0": np.ones((1, 4), np.int8)}
    transforms = Transforms(EnvironmentSpec(id="A"), robot.observation_space, robot.action_space, mask)
    torch.manual_seed(1)
    network = ActorCritic(PolicySpec(encoder="small"), transforms.spaces)
    model = export_program(network, transforms.spaces)
    rows = [robot.reset(seed=seed) for seed in range(ROWS)]
    observed = [transforms.observe_one(observation, info["action_mask"]) for observation, info in rows]
    frames = {name: np.concatenate([each.frames[name] for each in observed]) for name in observed[0].frames}
    masks = {name: np.concatenate([each.masks[name] for each in observed]) for name in observed[0].masks}
    frames["sensors.code"] = frames["sensors.code"].astype(np.uint8)  # as messages hold it
    weights = {name: parameter.detach().numpy() for name, parameter in network.named_parameters()}
    # A snapshot holds any arrays: the second one carries the observations and the masks.
    given = {f"seen/{name}": values for name, values in frames.items()}
    given |= {f"legal/{name}": values for name, values in masks.items()}
    (tmp_path / "program").write_bytes(model)
    for name, arrays in (("snapshot", weights), ("observations", given)):
        message = Snapshot(learner_epoch=1, policy_version=0, program=program_hash(model), weights=arrays)
        (tmp_path / name).write_bytes(encode(message))
    words = [program, "--input-type=module", "-e", SCRIPT, str(tmp_path), program_hash(model)]
    run = subprocess.run(words, cwd=node.FOLDER, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    chosen = json.loads(run.stdout)
    actions = {name: np.reshape(values, (ROWS, -1)) for name, values in chosen["actions"].items()}
    assert {name: values.shape[1] for name, values in actions.items()} == {"0": 1, "1": 1, "2": 2}
    assert masks["0"][np.arange(ROWS), actions["0"][:, 0].astype(int)].all()
    with torch.no_grad():
        tensors = {name: torch.from_numpy(values) for name, values in frames.items()}
        parameters, _ = network.step(tensors, torch.zeros(ROWS, 0))
        taken = {
            name: torch.from_numpy(values.astype(np.float32 if name == "1" else np.int64))
            for name, values in actions.items()
        }
        expected = network.distribution.log_prob(
            parameters, taken, {name: torch.from_numpy(values) for name, values in masks.items()}
        )
    np.testing.assert_allclose(chosen["logProbs"], expected.numpy(), atol=1e-4)
