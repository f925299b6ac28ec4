"""Attack: an authorised actor states experience that it has not had, to end a run.

    python -m benchmarks.attack.claimed_experience

In a run of gradients it joins with 4,096 environments, then with as many as the run admits, and sends gradients of
zeros with the most env_steps that one may state: the budget of 20 million must not be used up within seconds. In a run
of rollouts it reports episodes of 500 env_steps, at first more of them than it has sent rows, then as slowly as a
client could have played them: `daedalus learner` must not end the run as solved.
"""

import sys
import time
from contextlib import closing

import numpy as np

from benchmarks.attack._hostile_actor import HostileActor
from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import scene
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.uploads import LOSS_TERMS, Gradient

_BUDGET, _MESSAGES, _MOST = 20_000_000, 305, 256
_EPISODES = 100  # that the target is a mean of


def claimed_experience() -> Verdict:
    """Attack both runs, and return whether they go on."""
    refusal, stated, seconds = _gradients()
    accepted, solved = _episodes()
    held = "must be from 1 to" in refusal and stated < _BUDGET / 4 and not accepted and not solved
    return Verdict(
        held,
        f"4,096 environments: {'refused' if refusal else 'accepted'}; {stated:,} of {_BUDGET:,} env_steps used up in "
        f"{seconds:.1f} s; invented episodes {'accepted' if accepted else 'rejected'}, and slow ones "
        f"{'end the run' if solved else 'not confirmed'}",
    )


def _gradients() -> tuple[str, int, float]:
    """Return why the many environments are refused, and how many env_steps were used up within some seconds."""
    with scene() as here:
        settings = ("collection.upload=gradients", "training.stop_when_solved=false")
        words = [word for each in settings for word in ("--set", each)]
        here.start(
            "learner", "cartpole", "--algorithm", "a3c", "--listen", here.address, "--run-dir", "run", *words,
            "--env-steps", _BUDGET,
        )  # fmt: skip
        here.start("actor", "--connect", here.address, "--name", "honest", "--envs", 1)
        here.wait_for_training("honest")
        refusal = ""
        try:
            HostileActor(here.address, "many", environments=4096).close()
        except RuntimeError as error:
            refusal = str(error)
        with closing(HostileActor(here.address, "hostile", environments=_MOST)) as hostile:
            spec = hostile.spec
            learning = spec.learning_settings
            network = ActorCritic(learning.policy, hostile.spaces, training=learning.training)
            parameters = {name: each for name, each in network.named_parameters() if each.requires_grad}
            rows = spec.collection.rollout_length * _MOST
            moments: dict[str, np.ndarray] = {"returns": np.zeros(2)} if learning.training.normalize_rewards else {}
            if learning.policy.normalize_observations:
                moments["observations/observation"] = np.zeros((2, 4))
            began = time.monotonic()
            for _ in range(_MESSAGES):
                hostile.upload(
                    lambda identity, version: Gradient(
                        identity=identity,
                        policy_version=version,
                        gradient={name: np.zeros(each.shape, np.float32) for name, each in parameters.items()},
                        env_steps=rows,
                        metrics={name: np.zeros((), np.float32) for name in LOSS_TERMS},
                        moments=moments,
                        action_counts={"action": np.zeros(2, np.int64)},
                        episode_returns=np.zeros(0, np.float32),
                        episode_lengths=np.zeros(0, np.int32),
                    ),
                    wait=False,
                )
            seconds = time.monotonic() - began
            return refusal, here.env_steps(), seconds


def _episodes() -> tuple[bool, bool]:
    """Return whether invented episodes are accepted, and whether plausible ones end the run."""
    with scene() as here:
        never = ("--set", "training.learning_rate=1e-9")  # learns: only invented episodes reach the target
        learner = here.start(
            "learner", "cartpole", "--listen", here.address, "--run-dir", "run", *never, "--env-steps", 10**9
        )
        honest = here.start("actor", "--connect", here.address, "--name", "honest", "--envs", 1)
        here.wait_for_training("honest")
        honest.process.terminate()
        with closing(HostileActor(here.address, "hostile", environments=_MOST)) as hostile:
            accepted = hostile.send(**_ending(hostile)).verdict == "accepted"
        with closing(HostileActor(here.address, "slow")) as hostile:
            for _ in range(_EPISODES):
                if learner.process.poll() is not None or hostile.send(**_ending(hostile)).verdict == "fenced":
                    break
            here.wait("a confirmation", lambda: learner.process.poll() is not None or "not there yet" in learner.output)
        return accepted, learner.process.poll() is not None


def _ending(hostile: HostileActor) -> dict[str, np.ndarray]:
    """Return a rollout in which an episode of 500 env_steps ends in each environment."""
    cells = (hostile.rows, hostile.environments)
    ends = np.zeros(cells, np.bool_)
    ends[-1] = True
    count = hostile.environments
    episodes = {
        "episode_returns": np.full(count, 500, np.float32),
        "episode_lengths": np.full(count, 500, np.int32),
    }
    return {"terminated": ends, **episodes}


if __name__ == "__main__":
    verdict = claimed_experience()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
