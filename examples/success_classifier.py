"""A classifier that was learned from recordings tells a client when it has succeeded: for goals that no sensor sees.

In the folder `examples`, record successes and failures of the arm in robot.py, and start the learner:

    daedalus record --env robot:Arm --by robot:Person --episodes 20 --out ./successes
    daedalus record --env robot:Arm --by random --episodes 20 --out ./failures
    daedalus learner --env robot:Arm --algorithm sac --demonstrations ./successes --actors 1 \
        --set training.updates_per_env_step=2 --set training.n_step=5 --set training.discount_factor=0.98 \
        --set policy.hidden=[64,64] --set training.minibatch_rows=128 --set training.replay_begin=200

In another terminal:

    python success_classifier.py tcp/127.0.0.1:7447

The last observation of each successful episode is a success, and all others are none, but for the few just before it.
With `robot:Camera`, and `--camera` of this program, the classifier sees pictures. The program also asks the arm, which
a client could not do where a classifier is needed, and prints how often the classifier was wrong: a policy soon finds
what a classifier mistakes for success, so look at what it calls success, and record those as failures.
"""

import argparse
from pathlib import Path

import minari
import numpy as np
import torch
from robot import HALF_WIDTH, RATE, REWARD, Arm, Camera
from torch import Tensor, nn

from daedalus import Client

SURE = 0.9  # probability of success from which on it is one
BEFORE = 3  # observations before a success, which are neither
UPDATES, HALF = 1000, 64  # of the classifier; rows of each kind in a minibatch


def observations_of(folder: str) -> list[np.ndarray]:
    """Return the observations [L+1, ...] of each episode of a dataset."""
    return [np.asarray(episode.observations) for episode in minari.MinariDataset(Path(folder) / "data")]


class Classifier(nn.Module):
    """Logits of success [N] of observations [N, ...]: vectors, or pictures with the colours last."""

    def __init__(self, example: np.ndarray) -> None:
        super().__init__()
        self.is_picture = example.ndim > 1
        layers: list[nn.Module] = [nn.Flatten(), nn.LazyLinear(64), nn.ReLU(), nn.Linear(64, 1)]
        if self.is_picture:
            convolutions = [nn.LazyConv2d(16, 5, stride=2), nn.ReLU(), nn.Conv2d(16, 32, 5, stride=2), nn.ReLU()]
            layers = [*convolutions, *layers]
        self.layers = nn.Sequential(*layers)
        self.mean = nn.Parameter(torch.zeros(example.shape), requires_grad=False)
        self.scale = nn.Parameter(torch.ones(example.shape), requires_grad=False)

    def forward(self, observations: Tensor) -> Tensor:
        """Return the logits."""
        values = (observations.float() - self.mean) / self.scale
        return self.layers(values.movedim(-1, 1) if self.is_picture else values).squeeze(-1)

    def is_success(self, observation: np.ndarray) -> bool:
        """Return whether one observation shows success."""
        with torch.no_grad():
            return bool(self(torch.from_numpy(observation)[None]).sigmoid() > SURE)


def fitted(successes: list[np.ndarray], failures: list[np.ndarray]) -> Classifier:
    """Return a classifier of episodes that end with success, and of others."""
    shown = torch.from_numpy(np.stack([episode[-1] for episode in successes]))
    others = torch.from_numpy(np.concatenate([*(episode[: -1 - BEFORE] for episode in successes), *failures]))
    classifier = Classifier(successes[0][0])
    seen = torch.cat([shown, others]).float()
    classifier.mean.copy_(seen.mean(0))
    classifier.scale.copy_(seen.std() if classifier.is_picture else seen.std(0).clamp(min=1e-3))
    classifier(shown[:1])
    optimizer = torch.optim.Adam(classifier.parameters(), 1e-3, weight_decay=1e-4)
    labels = torch.cat([torch.ones(HALF), torch.zeros(HALF)])
    for _ in range(UPDATES):
        drawn = [kind[torch.randint(len(kind), (HALF,))] for kind in (shown, others)]
        optimizer.zero_grad()
        nn.functional.binary_cross_entropy_with_logits(classifier(torch.cat(drawn)), labels).backward()
        optimizer.step()
    return classifier


def judged(classifier: Classifier, successes: list[np.ndarray], failures: list[np.ndarray]) -> tuple[int, int]:
    """Return in how many episodes success is found at the end, and in how many before or where there is none."""
    found = sum(classifier.is_success(episode[-1]) for episode in successes)
    early = [episode[: -1 - BEFORE] for episode in successes]
    return found, sum(any(map(classifier.is_success, episode)) for episode in [*early, *failures])


def drive(address: str, arm: Arm, classifier: Classifier, seconds: float) -> None:
    """Let a client play on the arm's clock, and reward what the classifier takes for success."""
    episodes = called = right = missed = 0
    client = Client(address, observation_space=arm.observation_space, action_space=arm.action_space)
    with client, client.clock(RATE) as clock:
        observation, _ = arm.reset()
        while clock.wait() and clock.deadlines < seconds * RATE:
            observation, reward, is_over, is_late, _ = arm.step(client.act(observation))
            if classifier.is_success(observation):
                client.success(REWARD, observation)
                called, right = called + 1, right + (abs(arm.peg[0] - arm.hole) < HALF_WIDTH and arm.peg[1] < 0.0)
            elif is_over or is_late:
                client.end_episode(terminated=is_over, observation=observation)
                missed += reward > 0.0
            else:
                continue
            observation, _ = arm.reset()
            episodes += 1
            if episodes % 20 == 0:
                print(
                    f"{episodes} episodes: {called} called a success, in {right} of them the peg was in the hole; "
                    f"{missed} successes missed",
                    flush=True,
                )


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("address", nargs="?", default="tcp/127.0.0.1:7447", help="default: %(default)s")
    options.add_argument("--successes", default="./successes", help="dataset (default: %(default)s)")
    options.add_argument("--failures", default="./failures", help="dataset (default: %(default)s)")
    options.add_argument("--seconds", type=float, default=300.0, help="of driving (default: %(default)s)")
    options.add_argument("--camera", action="store_true", help="the arm sees a picture")
    parsed = options.parse_args()
    torch.set_num_threads(1)
    successes, failures = observations_of(parsed.successes), observations_of(parsed.failures)
    kept = max(len(successes) * 4 // 5, 1), max(len(failures) * 4 // 5, 1)
    test = successes[kept[0] :], failures[kept[1] :]
    found, wrong = judged(fitted(successes[: kept[0]], failures[: kept[1]]), *test)
    print(
        f"of episodes that were held out, success is found in {found} of {len(test[0])}, and too early or where there "
        f"is none in {wrong} of {len(test[0]) + len(test[1])}",
        flush=True,
    )
    arm = Camera() if parsed.camera else Arm()
    drive(parsed.address, arm, fitted(successes, failures), parsed.seconds)


if __name__ == "__main__":
    main()
