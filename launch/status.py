"""`daedalus status`: the fleet as the learner sees it."""

import argparse
import sys

from protocol import keys
from protocol.codec import Limits, ProtocolError, decode
from protocol.messages import StatusReport
from protocol.spec import RunStatus
from protocol.transport import TransportError
from protocol.zenoh_transport import connect

_EXAMPLES = """\
examples:
  daedalus status --connect tcp/127.0.0.1:7447
  daedalus status --connect tcp/gpu-box:7447 --json"""


def status(arguments: list[str]) -> int:
    """Runs `daedalus status`. Exit status: 0 a learner answered, 1 none did."""
    options = argparse.ArgumentParser(
        prog="daedalus status",
        description="Asks the learners at an address how they and their actors fare.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    options.add_argument(
        "--connect",
        required=True,
        action="append",
        metavar="tcp/HOST:PORT",
        help="where the learner, or its router, listens",
    )
    options.add_argument("--run", default=keys.ANY_RUN, metavar="NAME", help="only this run")
    options.add_argument("--json", action="store_true", help="print each as one JSON object a line")
    parsed = options.parse_args(arguments)
    try:
        transport = connect(parsed.connect)
        try:
            answers = transport.ask(keys.status(parsed.run), timeout=5.0)
        finally:
            transport.close()
        reports = [decode(answer, Limits()) for answer in answers]
    except (TransportError, ProtocolError) as error:
        print(f"daedalus status: {error}", file=sys.stderr)
        return 1
    statuses = [report.status for report in reports if isinstance(report, StatusReport)]
    if not statuses:
        print("daedalus status: no learner answers there", file=sys.stderr)
        return 1
    for status in statuses:
        print(status.model_dump_json() if parsed.json else _table(status))
    return 0


def _table(status: RunStatus) -> str:
    mean = "-" if status.episode_return_mean is None else f"{status.episode_return_mean:.1f}"
    lines = [
        f"run {status.run}: {status.environment}, {status.algorithm}, up {status.uptime_seconds:.0f} s",
        f"  return {mean}, env_steps {status.env_steps:,} of {status.env_steps_budget:,}, updates {status.updates:,}",
        f"  {status.env_steps_per_second:,.0f} env_steps/s, {status.updates_per_second:,.0f} updates/s, "
        f"policy lag {status.policy_lag_mean:.1f}",
        f"  {'actor':<24} {'state':<6} {'seen':>7} {'envs':>5} {'env_steps':>13}"
        f" {'accepted':>9} {'rejected':>9} {'lag':>4}",
    ]
    for actor in status.actors:
        lines.append(
            f"  {actor.actor:<24} {'alive' if actor.alive else 'gone':<6} {actor.seconds_since_seen:>5.1f} s"
            f" {actor.environments:>5} {actor.env_steps:>13,} {actor.rollouts_accepted:>9,}"
            f" {sum(actor.rollouts_rejected.values()):>9,} {actor.policy_lag:>4}"
        )
    return "\n".join(lines)
