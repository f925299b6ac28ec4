"""An actor in Python for a Daedalus gateway: the standard library and websockets, no other package.

    python client.py ws://127.0.0.1:8080/actor NAME [EPISODES]

It plays CartPole, whose equations are below. Start the run with `daedalus learner cartpole`.
"""

import json
import math
import random
import sys

from websockets.sync.client import connect

SPACES = {
    "observations": {"observation": {"kind": "array", "shape": [4], "dtype": "float32"}},
    "actions": {"action": {"kind": "discrete", "counts": [2]}},
}


def cartpole(state: list[float], action: int) -> tuple[list[float], bool]:
    """Return the state of the cart 0.02 s later, and whether the pole has fallen."""
    x, speed, angle, spin = state
    force = (10.0 if action else -10.0) + 0.05 * spin * spin * math.sin(angle)
    turn = 9.8 * math.sin(angle) - math.cos(angle) * force / 1.1
    turn /= 0.5 * (4.0 / 3.0 - 0.1 * math.cos(angle) ** 2 / 1.1)
    push = force / 1.1 - 0.05 * turn * math.cos(angle) / 1.1
    state = [x + 0.02 * speed, speed + 0.02 * push, angle + 0.02 * spin, spin + 0.02 * turn]
    return state, abs(state[0]) > 2.4 or abs(state[2]) > 0.2095


def main(address: str, name: str, episodes: int) -> None:
    with connect(address) as socket:

        def ask(message: dict) -> dict:
            socket.send(json.dumps(message))
            answer = json.loads(socket.recv())
            if answer["type"] not in ("welcome", "action"):
                raise SystemExit(answer["reason"])
            return answer

        print("joined", ask({"type": "hello", "version": 1, "name": name, **SPACES})["run"], flush=True)
        for _ in range(episodes):
            state, fallen, steps = [random.uniform(-0.05, 0.05) for _ in range(4)], False, 0
            while not fallen and steps < 500:
                reward = {"reward": 1.0} if steps else {}  # of the last action
                state, fallen = cartpole(state, ask({"type": "act", "observation": state, **reward})["action"])
                steps += 1
            end = {"type": "end_episode", "terminated": fallen, "observation": state, "reward": 1.0}
            socket.send(json.dumps(end))
            print("return", steps, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 1_000_000)
