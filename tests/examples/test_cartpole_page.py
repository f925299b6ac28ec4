"""The physics of /play against gymnasium's CartPole-v1, step by step, in Node."""

import json
import subprocess
from pathlib import Path

import gymnasium
import node
import numpy as np

PAGE = Path(__file__).parents[2] / "daedalus" / "gateway" / "page"
PROGRAM = """
import { fallen, start, stepped } from %s;
import { readFileSync } from "node:fs";
const episodes = JSON.parse(readFileSync(0, "utf8"));
console.log(JSON.stringify({
  episodes: episodes.map(([state, actions]) =>
    actions.map((action) => [(state = stepped(state, action)), fallen(state)])),
  starts: Array.from({ length: 200 }, () => start()),
}));
"""


def test_every_step_is_that_of_gymnasium() -> None:
    environment = gymnasium.make("CartPole-v1").unwrapped
    random = np.random.default_rng(3)
    given, expected = [], []
    for seed in range(30):
        environment.reset(seed=seed)
        begin, actions, steps = [float(number) for number in environment.state], [], []  # type: ignore[union-attr]
        terminated = False
        while not terminated:
            actions.append(int(random.integers(2)))
            _, reward, terminated, _, _ = environment.step(actions[-1])
            steps.append(([float(number) for number in environment.state], bool(terminated)))  # type: ignore[union-attr]
            assert reward == 1.0
        given.append((begin, actions))
        expected.append(steps)
    environment.close()
    program = PROGRAM % json.dumps((PAGE / "cartpole.js").resolve().as_uri())
    command = [node.executable((18, 0), "modules"), "--input-type=module", "--eval", program]
    done = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, check=True)
    answer = json.loads(done.stdout)
    for played, steps in zip(answer["episodes"], expected, strict=True):
        assert [terminated for _, terminated in played] == [terminated for _, terminated in steps]
        np.testing.assert_allclose([state for state, _ in played], [state for state, _ in steps], rtol=1e-12)
    starts = np.array(answer["starts"])
    assert starts.shape == (200, 4)
    assert np.abs(starts).max() <= 0.05
    assert starts.std() > 0.02
