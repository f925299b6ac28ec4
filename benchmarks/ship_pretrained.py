"""`python -m benchmarks.ship_pretrained RUN_DIR NAME`: add the best policy of a run to the package.

Writes policy/pretrained/NAME: the policy without the state of the learner, config.toml, the learning curve and a README
with the commands. Commit the folder; then `daedalus evaluate --pretrained NAME` plays the policy.
"""

import argparse
import math
import shutil
import sys
from pathlib import Path

from daedalus.learner.run.run_directory import CONFIG, METRICS, SUMMARY, read_json
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import PRETRAINED, NoPolicyError, export_policy, find_policy
from daedalus.policy.saving.sealed import DamagedError

_MOST_ROWS = 1000  # of the learning curve

_README = """\
# {name}

{environment}, {algorithm}, policy version {version} of a run of {env_steps:,} env_steps.
{score}

    daedalus evaluate --pretrained {name}
    daedalus evaluate --pretrained {name} --video {name}.gif
    daedalus train config.toml              # train with the same settings
"""


def main() -> int:
    options = argparse.ArgumentParser(prog="python -m benchmarks.ship_pretrained", description=__doc__)
    options.add_argument("run", type=Path, metavar="RUN_DIR")
    options.add_argument("name", metavar="NAME")
    arguments = options.parse_args()
    try:
        target = ship(arguments.run, PRETRAINED / arguments.name)
    except (DamagedError, NoPolicyError, SettingsError, OSError) as error:
        print(f"ship_pretrained: {error}", file=sys.stderr)
        return 1
    size = sum(entry.stat().st_size for entry in target.iterdir())
    print(f"{target}: {size / 1e6:.1f} MB")
    return 0


def ship(run: Path, target: Path) -> Path:
    """Write the best or newest policy of `run` with its settings and learning curve to `target`; return `target`."""
    policy = find_policy(run)
    summary = read_json(run / SUMMARY)
    export_policy(policy.directory, target)
    shutil.copyfile(run / CONFIG, target / CONFIG)
    header, *rows = (run / METRICS).read_text("utf-8").splitlines()
    every = max(math.ceil(len(rows) / _MOST_ROWS), 1)
    # Counted from the end, so that the last row is kept.
    (target / METRICS).write_text("\n".join([header, *rows[::-1][::every][::-1], ""]), "utf-8")
    (target / "README.md").write_text(
        _README.format(
            name=target.name,
            environment=policy.spec.environment.id,
            algorithm=policy.spec.training.algorithm,
            version=policy.policy_version,
            env_steps=summary["env_steps"],
            score=_score(summary.get("evaluation"), policy.policy_version),
        ),
        "utf-8",
    )
    return target


def _score(evaluation: dict | None, policy_version: int) -> str:
    if not evaluation or evaluation["policy_version"] != policy_version:
        return "Not evaluated."
    return (
        f"Return {evaluation['return_mean']:.1f} +- {evaluation['return_std']:.1f} over {evaluation['episodes']} "
        f"{evaluation['actions']} episodes on {evaluation['backend']}'s {evaluation['environment']}."
    )


if __name__ == "__main__":
    sys.exit(main())
