"""`python -m actor.evaluator`: plays a run's newest checkpoint, or a given one, and prints how it does."""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from actor.environments import UnplayableError, make_environments
from actor.evaluation import Evaluation, environments_for, play_episodes
from policy.runtime import OnnxRuntime, PolicyError
from policy.saved_policy import SavedPolicy, checkpoints, read_policy
from policy.sealed import DamagedError

DESCRIPTION = """\
Plays episodes with the policy of a run and reports their returns: true rewards, greedy actions, episodes that
training never saw. Takes the newest checkpoint, or the one whose folder is named."""

EXAMPLES = """\
examples:
  daedalus evaluate runs/cartpole-impala-s1-20261121-101500
  daedalus evaluate RUN_DIR --episodes 1000 --seed 7 --sampled
  daedalus evaluate RUN_DIR/checkpoints/0000000143"""


def parser() -> argparse.ArgumentParser:
    """Parses what `daedalus evaluate` takes."""
    options = argparse.ArgumentParser(
        prog="daedalus evaluate",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    options.add_argument("directory", type=Path, metavar="RUN_DIR", help="a run directory, or one of its checkpoints")
    options.add_argument(
        "--episodes", type=int, default=100, metavar="N", help="episodes to play (default: %(default)s)"
    )
    options.add_argument(
        "--seed", type=int, metavar="S", help="of the environments (default: one that training never used)"
    )
    options.add_argument(
        "--sampled",
        action="store_true",
        help="sample the actions, as training does, instead of the most probable",
    )
    options.add_argument("--json", action="store_true", help="print the result as one JSON object")
    return options


def main() -> int:
    """Runs `daedalus evaluate`. Exit status: 0 done, 1 failed, 2 bad usage."""
    arguments = parser().parse_args()
    if arguments.episodes < 1:
        print(f"daedalus evaluate: --episodes must be at least 1, not {arguments.episodes}", file=sys.stderr)
        return 2
    try:
        policy = _newest(arguments.directory)
        seed = policy.spec.training.seed + 2**32 if arguments.seed is None else arguments.seed
        evaluation = _evaluate(policy, arguments.episodes, seed, arguments.sampled)
    except (DamagedError, UnplayableError, PolicyError) as error:
        print(f"daedalus evaluate: {error}", file=sys.stderr)
        return 1
    result = {
        "policy_version": policy.policy_version,
        "episodes": len(evaluation.returns),
        "seed": seed,
        "actions": "sampled" if arguments.sampled else "greedy",
        "return_mean": float(evaluation.returns.mean(dtype=np.float64)),
        "return_std": float(evaluation.returns.std(dtype=np.float64)),
        "return_min": float(evaluation.returns.min()),
        "return_max": float(evaluation.returns.max()),
        "length_mean": float(evaluation.lengths.mean()),
    }
    if arguments.json:
        print(json.dumps(result))
    else:
        print(
            f"{policy.spec.environment.id}, policy version {policy.policy_version}: "
            f"return {result['return_mean']:.1f} +- {result['return_std']:.1f} "
            f"(from {result['return_min']:.1f} to {result['return_max']:.1f}) "
            f"over {result['episodes']} {result['actions']} episodes"
        )
    return 0


def _newest(directory: Path) -> SavedPolicy:
    """The policy in a checkpoint, or in the newest whole one of a run."""
    if (directory / "manifest.json").exists():
        return read_policy(directory)
    candidates = checkpoints(directory)
    if not candidates:
        raise DamagedError(f"{directory} has no checkpoints: is it a run directory?")
    for candidate in candidates:
        try:
            return read_policy(candidate)
        except DamagedError as error:
            print(f"daedalus evaluate: passed over: {error}", file=sys.stderr)
    raise DamagedError(f"{directory} has no checkpoint that can be read")


def _evaluate(policy: SavedPolicy, episodes: int, seed: int, sampled: bool) -> Evaluation:
    environments = make_environments(policy.spec.environment, environments_for(episodes))
    try:
        if environments.spaces != policy.spaces:
            raise UnplayableError(
                f"environment {policy.spec.environment.id} has {environments.spaces}; "
                f"the policy was trained on {policy.spaces}: install the version that the run used (versions.json)"
            )
        runtime = OnnxRuntime(policy.program)
        runtime.load(policy.weights)
        return play_episodes(runtime, environments, episodes, seed, sampled=sampled)
    finally:
        environments.close()


if __name__ == "__main__":
    sys.exit(main())
