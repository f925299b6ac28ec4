"""`daedalus status`: show the state of a learner and its actors, for a person or for a health check."""

import argparse
import json
import threading
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from textwrap import TextWrapper

from daedalus.analysis.run_selection import find_runs
from daedalus.cli.arguments import add_connect, add_tls, command_parser
from daedalus.cli.run_watcher import looks
from daedalus.cli.screen import Screen
from daedalus.launch.logs import print_error, say
from daedalus.launch.process_lifecycle import status_at_start
from daedalus.learner.run.heartbeat import HEARTBEAT, silence
from daedalus.learner.run.run_directory import CONFIG, run_name
from daedalus.learner.run.run_files import RunDataError
from daedalus.learner.run.run_lock import LOCK
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError
from daedalus.protocol.league import NEWEST, LeagueStatus
from daedalus.protocol.messages import ActorStatus, EventsPage, RefusedJoin, RunStatus
from daedalus.protocol.texts import (
    aligned,
    listed,
    one_line,
    policy_lag,
    printable,
    short_duration,
    short_number,
    short_rate,
    short_share,
)
from daedalus.transport.certificate_expiry import WARNING_DAYS
from daedalus.transport.connecting import connect_once
from daedalus.transport.credentials import SECURITY_ERRORS, Credentials, credentials_to_connect, run_for
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.status_query import ask_events, no_answer, survey, waiting_actors

HEALTHY, NO_ANSWER, UNHEALTHY = 0, 1, 3
_MOST_WAITING = 20  # names of actors that wait for a run
_MOST_PLAYERS, _LONGEST_PLAYER = 12, 50  # of a game; characters of a name
_FRAME_SECONDS, _TEXT_SECONDS = 1.0, 5.0  # between two looks
_WIDTH = 100  # characters of a line of the state
_WRAPPER = TextWrapper(_WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)

_DESCRIPTION = """\
Shows the state of the learners at an address and of their actors. The exit status serves as a health check: a learner
is healthy if actors take part, updates are made and checkpoints are saved."""

_EXAMPLES = """\
examples:
  daedalus status --connect tcp/127.0.0.1:7447
  daedalus status --connect tcp/gpu-box:7447 --json
  daedalus status --connect tcp/gpu-box:7447 --events
  daedalus status --connect tcp/gpu-box:7447 --watch
  daedalus status --connect tcp/127.0.0.1:7447 --run runs@paper
  daedalus status --connect tcp/127.0.0.1:7447 --quiet || echo unhealthy
  daedalus status --alive runs/cartpole      on the learner's machine: is the learner alive?

lag is how old the policy of an actor's newest rollout was: the actors play while the learner trains, so a few
batches are normal. epsilon is the probability with which an actor takes a random action, in the end. MB/h up counts
rollouts, down counts snapshots. A c marks an actor that fetches compact snapshots. rollout is how long an actor takes
for one, waits how long it then waits for the learner and the network, trip the round trip of a small request. Of a
game with opponents, players are listed by rating; newest wins counts a draw as half a win.

exit status: 0 healthy, 1 no learner answers, 2 bad usage, 3 unhealthy (the output names the problems); with --alive
0 alive, not begun or ended, 1 not alive or no run directory"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus status`."""
    options = command_parser("status", _DESCRIPTION, _EXAMPLES)
    where = options.add_mutually_exclusive_group(required=True)
    add_connect(where, required=False)
    where.add_argument(
        "--alive",
        type=Path,
        metavar="RUN_DIR",
        help="check only that the learner of this run directory works: it renewed its heartbeat file within the last "
        "two minutes. Needs no network and no router. For a liveness probe",
    )
    options.add_argument(
        "--run",
        default=keys.ANY_RUN,
        metavar="NAME",
        help="show only this run; FOLDER@TAG: only the runs whose directories in FOLDER of this machine have the tag",
    )
    options.add_argument(
        "--events",
        action="store_true",
        help="show the newest events of each run, such as joins, rejections and checkpoints, instead of its state",
    )
    options.add_argument(
        "--watch",
        action="store_true",
        help="show the state again and again, with a curve of the return, until Ctrl-C: a table that is redrawn on a "
        "terminal (needs the package rich), and the lines of each look every 5 s elsewhere",
    )
    output = options.add_mutually_exclusive_group()
    output.add_argument("--json", action="store_true", help="print each run as one JSON object per line")
    output.add_argument("--quiet", action="store_true", help="print only problems")
    add_tls(options)
    return options


def status(arguments: list[str]) -> int:
    """Run `daedalus status` and return its exit status."""
    options = parser()
    parsed = options.parse_args(arguments)
    if parsed.watch and (parsed.alive is not None or parsed.events or parsed.quiet):
        options.error("--watch shows the state of the runs: leave out --alive, --events and --quiet")
    if parsed.alive is not None:
        return _check_alive(parsed.alive)
    try:
        tagged = _tagged(parsed.run)
    except RunDataError as error:
        print_error("status", error)
        return NO_ANSWER
    if tagged is not None:
        parsed.run = keys.ANY_RUN
    try:
        credentials = credentials_to_connect(parsed.connect, parsed.tls, "operator", "learner", "router")
        parsed.run = run_for(credentials, parsed.run)
    except SECURITY_ERRORS as error:
        print_error("status", error)
        return status_at_start(error)
    try:
        if parsed.watch:
            return _watch(parsed, credentials, tagged)
        transport = connect_once(parsed.connect, credentials)
        try:
            found = survey(transport, parsed.run, max_actors=0 if parsed.quiet or parsed.events else None)
            statuses = [status for status in found.statuses if tagged is None or status.run in tagged]
            pages = [ask_events(transport, status) for status in statuses] if parsed.events else []
            unanswered = "" if statuses or found.unread else no_answer(transport, parsed.run)
            if found.statuses and not statuses:
                unanswered = f"no learner of a run with this tag answers; they are {', '.join(sorted(tagged or ()))}"
            waiting = list(waiting_actors(transport))
        finally:
            transport.close()
    except (TransportError, ProtocolError) as error:
        print_error("status", error)
        return NO_ANSWER
    for line in found.left_out:
        print_error("status", line)
    if not statuses:
        if unanswered:
            print_error("status", f"{unanswered}{_waiting(waiting)}")
        return NO_ANSWER
    if parsed.quiet:
        _show_problems(statuses)
    else:
        for shown in filter(None, pages) if parsed.events else statuses:
            say(_json(shown, waiting) if parsed.json else _text(shown))
        if waiting and not (parsed.json or parsed.events):
            say(_waiting(waiting).removeprefix("; "))
    return UNHEALTHY if any(status.problems for status in statuses) else HEALTHY


def _tagged(run: str) -> set[str] | None:
    """Return the names of the runs that FOLDER@TAG stands for, or None for a name. Raises RunDataError."""
    return {run_name(directory) for directory in find_runs([Path(run)])} if "@" in run else None


def _watch(parsed: argparse.Namespace, credentials: Credentials | None, tagged: set[str] | None) -> int:
    screen = Screen()
    frames = screen.shows_frames and not parsed.json
    shown = _json if parsed.json else _text
    connect = partial(connect_once, parsed.connect, credentials)
    watch_status(connect, parsed.run, screen, shown, frames=frames, tagged=tagged)
    return HEALTHY


def watch_status(
    connect: Callable[[], Transport],
    run: str,
    screen: Screen,
    text: Callable[[RunStatus], str],
    *,
    frames: bool,
    tagged: Collection[str] | None,
) -> None:
    """Show the runs until Ctrl-C.

    Args:
      connect: opens the transport. Raises TransportError.
      run: name of the run, or `*` for all runs.
      screen: where to show them.
      text: returns what is printed about a run where no frames are shown.
      frames: redraw one frame.
      tagged: names of the runs to show; None: all.

    Raises TransportError if the learner refuses this process.
    """
    wanted = "no learner" if run == keys.ANY_RUN else f"no learner of run {run!r}"
    nobody = f"{wanted} answers at this address"
    reason, said = nobody, ""  # why no run is shown, and what the user has read of it

    def open_transport() -> Transport:
        nonlocal reason
        try:
            transport = connect()
        except TransportError as error:
            reason = str(error)
            raise
        reason = nobody
        return transport

    with suppress(KeyboardInterrupt):
        try:
            for found in looks(open_transport, run, threading.Event(), _FRAME_SECONDS if frames else _TEXT_SECONDS):
                runs = [each for each in found if tagged is None or each.status.run in tagged]
                waiting = "" if runs else f"{reason}; waiting for one (Ctrl-C ends)"
                if frames and runs:
                    screen.show(runs)
                elif frames:
                    screen.say(waiting)
                elif waiting and waiting != said:
                    screen.err(f"daedalus status: {waiting}")
                for each in runs if not frames else ():
                    screen.out(text(each.status))
                said = waiting
        finally:
            screen.end()


def _check_alive(directory: Path) -> int:
    if not directory.is_dir():
        print_error("status", f"{directory} does not exist: name a run directory")
        return NO_ANSWER
    # A learner that waits for its router has made no more than the directory.
    if not (directory / CONFIG).exists() and any(entry.name != LOCK for entry in directory.iterdir()):
        print_error("status", f"{directory} is not a run directory: it has no {CONFIG}")
        return NO_ANSWER
    if not (directory / HEARTBEAT).exists():
        say(f"no learner works in {directory}: it has ended, or not begun yet")
        return HEALTHY
    silent = silence(directory)
    if silent is None:
        return HEALTHY
    print_error("status", f"the learner of {directory} has been silent for {silent:.0f} s")
    return NO_ANSWER


def _show_problems(statuses: list[RunStatus]) -> None:
    for status in statuses:
        for problem in status.problems:
            say(one_line(f"{status.run}: {problem}"))


def _json(shown: RunStatus | EventsPage, waiting: Sequence[str] = ()) -> str:
    """Return JSON in ASCII: texts of peers cannot command a terminal. `waiting` are actors that wait for a run."""
    more = {"waiting_actors": list(waiting)} if isinstance(shown, RunStatus) else {}
    return json.dumps({**shown.model_dump(mode="json"), **more})


def _waiting(names: Sequence[str]) -> str:
    """Return which actors wait for a run, as the end of a sentence."""
    if not names:
        return ""
    actors = "1 actor waits" if len(names) == 1 else f"{len(names):,} actors wait"
    return f"; {actors} for a run: {listed(names, _MOST_WAITING)}"


def _text(shown: RunStatus | EventsPage) -> str:
    """Return what a person reads; texts of peers can neither begin a line nor command a terminal."""
    lines = _events(shown) if isinstance(shown, EventsPage) else _table(shown)
    lines = [printable(line.replace("\n", " ")) for line in lines]
    if isinstance(shown, RunStatus):
        lines = [part for line in lines for part in ([line] if len(line) <= _WIDTH else _WRAPPER.wrap(line))]
    return "\n".join(lines)


def _events(page: EventsPage) -> list[str]:
    return [
        f"run {page.run}: epoch {page.learner_epoch:x}, the newest events",
        *(
            f"  {event.time} {event.kind:<11} {event.actor or '-':<24} {event.text}"
            f"{f' ({event.count:,} times)' if event.count > 1 else ''}"
            for event in page.events
        ),
    ]


def _table(status: RunStatus) -> list[str]:
    mean = "-" if status.episode_return_mean is None else short_number(status.episode_return_mean)
    league = status.league if status.league and status.league.players else None
    newest = league.newest if league else None
    rating = f"rating {newest.text}, " if newest else ""
    age = status.checkpoint_age_seconds
    skipped = f" ({status.updates_skipped:,} skipped)" if status.updates_skipped else ""
    agents = "" if status.agent_steps is None else f" ({status.agent_steps:,} agent_steps)"
    return [
        f"run {status.run}: {status.environment}, {status.algorithm}, up {status.uptime_seconds:.0f} s, "
        f"epoch {status.learner_epoch:x}{f', {status.software}' if status.software else ''}",
        *(f"  PROBLEM: {problem}" for problem in status.problems),
        *_expiry(status.certificate_days_left),
        f"  {rating}return {mean}, env_steps {status.env_steps:,} of {status.env_steps_budget:,}{agents}, "
        f"updates {status.updates:,}{skipped}",
        *(f"  lesson {name}: {text}" for name, text in status.lessons.items()),
        *([f"  {status.bottleneck}"] if status.bottleneck else []),
        f"  {short_rate(status.env_steps_per_second)} env_steps/s, {short_rate(status.updates_per_second)} updates/s, "
        f"policy lag {policy_lag(status.policy_lag_mean, status.updates_per_batch)}",
        f"  actors: {status.actors_alive:,} alive, {status.actors_quarantined:,} quarantined, {status.actors_gone:,} "
        f"gone; rollouts: {status.rollouts_accepted:,} accepted, {sum(status.rollouts_rejected.values()):,} rejected",
        f"  queue {status.queue_bytes / 2**20:.1f} of {status.queue_bytes_limit / 2**20:.0f} MiB, "
        f"last checkpoint {'not yet' if age is None else f'{age:.0f} s ago'}{_usage(status)}",
        *([f"  last order at {status.last_order}"] if status.last_order else []),
        *(_league_table(league) if league else []),
        *_actor_table(status),
        *_missing_actors(status),
        *(f"  {actor.actor} is quarantined: {actor.quarantined}" for actor in status.actors if actor.quarantined),
        *(f"  {actor.actor} {text}" for actor in status.actors for text in _actor_texts(actor)),
        *_places(status.actors),
        *_releases(status),
        *map(_refused, status.refused_joins),
    ]


def _league_table(league: LeagueStatus) -> list[str]:
    """Return the players of a game by rating, and how often the newest policy wins against each.

    Of many players, the newest policy and the fixed opponents are shown, and the best versions.
    """
    by_rating = sorted(league.players, key=lambda each: -each.rating)
    named = {NEWEST, *league.fixed_opponents}
    first = sorted(by_rating, key=lambda each: each.player not in named)[:_MOST_PLAYERS]
    scores, rows = league.scores_of(NEWEST), [["player", "rating", "+-", "matches", "newest wins"]]
    for each in (player for player in by_rating if player in first):
        wins = short_share(scores[each.player].win_rate) if each.player in scores else "-"
        numbers = f"{round(each.rating):,}", f"{round(each.deviation):,}", f"{each.matches:,}"
        rows.append([one_line(each.player)[:_LONGEST_PLAYER], *numbers, wins])
    more = len(by_rating) - len(first) + league.left_out
    lines = [f"  {line}" for line in aligned(rows, range(1, len(rows[0])))]
    return [*lines, *([f"  ... and {more:,} more players"] if more else [])]


_Cell = Callable[[ActorStatus, RunStatus], str]
# Columns of the table of actors, each with its cell. A column in which no actor has anything is left out: "-" or "".
_COLUMNS: dict[str, _Cell] = {
    "actor": lambda actor, _: printable(actor.actor),
    "state": lambda actor, _: _state(actor),
    "seen": lambda actor, _: f"{actor.seconds_since_seen:.1f} s",
    "lives": lambda actor, _: f"{actor.lives}" if actor.lives > 1 else "-",
    "envs": lambda actor, _: f"{actor.environments}",
    "epsilon": lambda actor, _: f"{actor.epsilon:g}" if actor.epsilon else "-",
    "env_steps": lambda actor, _: f"{actor.env_steps:,}",
    "/s": lambda actor, _: short_rate(actor.env_steps_per_second),
    "lag": lambda actor, run: policy_lag(actor.policy_lag, run.updates_per_batch).partition(" (")[0],
    "rollout": lambda actor, _: _measured(actor.rollout_seconds),
    "waits": lambda actor, _: _measured(actor.waiting_seconds),
    "trip": lambda actor, _: _measured(actor.round_trip_seconds),
    "busy": lambda actor, _: f"{actor.busy_share:.0%}",
    "accepted": lambda actor, _: f"{actor.rollouts_accepted:,}",
    "missed": lambda actor, _: f"{actor.rollouts_missed:,}" if actor.rollouts_missed else "-",
    "cpu": lambda actor, _: f"{actor.processor_share:.0%}" if actor.processor_share else "-",
    "MB": lambda actor, _: f"{actor.memory_bytes / 1e6:,.0f}" if actor.memory_bytes else "-",
    "MB/h up": lambda actor, _: f"{actor.bytes_up_per_hour / 1e6:,.0f}",
    "down": lambda actor, _: f"{actor.bytes_down_per_hour / 1e6:,.0f}{'c' if actor.compact_snapshots else ''}",
}
_LEAST_IMPORTANT = (
    *("down", "MB/h up", "cpu", "MB", "accepted", "envs", "lives", "epsilon", "env_steps", "missed", "busy", "waits"),
)


def _usage(status: RunStatus) -> str:
    """Return what the learner uses of its machine, or an empty text."""
    if not status.memory_bytes:
        return ""
    return f"; the learner uses {status.processor_share:.1f} processors, {status.memory_bytes / 1e6:,.0f} MB"


def _state(actor: ActorStatus) -> str:
    if actor.quarantined:
        return "quarantined"
    return "gone" if not actor.alive else "leaving" if actor.drained_by else "alive"


def _actor_table(status: RunStatus) -> list[str]:
    """Return the table of the actors, with as many columns as fit, and which do not."""
    columns = {name: [cell(actor, status) for actor in status.actors] for name, cell in _COLUMNS.items()}
    columns = {name: cells for name, cells in columns.items() if not set(cells) <= {"-"}}
    dropped = []
    for name in _LEAST_IMPORTANT:
        if sum(2 + max(map(len, (name, *cells))) for name, cells in columns.items()) <= _WIDTH:
            break
        dropped += [name] if columns.pop(name, None) else []
    rows = list(zip(*((name, *cells) for name, cells in columns.items()), strict=True))
    right = [index for index, name in enumerate(columns) if name not in ("actor", "state")]
    lines = [f"  {line}" for line in aligned(rows, right)]
    return [*lines, *([f"  --json has more columns: {', '.join(dropped)}"] if dropped else [])]


def _measured(seconds: float) -> str:
    return short_duration(seconds) if seconds else "-"


def _actor_texts(actor: ActorStatus) -> list[str]:
    rejected = ", ".join(f"{count:,} {cause}" for cause, count in sorted(actor.rollouts_rejected.items()))
    drained = [f"leaves: drained by {actor.drained_by}"] if actor.drained_by and actor.alive else []
    return [*drained, *([f"rejected: {rejected}"] if rejected else []), *_client_texts(actor)]


def _places(actors: Sequence[ActorStatus]) -> list[str]:
    """Return which actors run at which host, under which release, and at which address."""
    by_host: dict[tuple[str, str], list[str]] = {}
    for actor in actors:
        address = f" ({actor.address})" if actor.address else ""
        by_host.setdefault((actor.host, actor.software), []).append(f"{actor.actor}{address}")
    return [
        f"  on {host or 'an unknown host'}{f', {software}' if software else ''}: {', '.join(names)}"
        for (host, software), names in by_host.items()
    ]


def _releases(status: RunStatus) -> list[str]:
    """Return which releases take part, if there are several: the fleet is being upgraded."""
    counts = status.releases
    if len(counts) < 2:
        return []
    named = [
        f"{software or 'unknown'}: {' and '.join(filter(None, ('the learner' * of_learner, _actors(count))))}"
        for software, (of_learner, count) in counts.items()
    ]
    return [f"  releases: {'; '.join(named)}"]


def _actors(count: int) -> str:
    return f"{count:,} actor{'s' * (count > 1)}" if count else ""


def _client_texts(actor: ActorStatus) -> list[str]:
    """Return what a client, whose loop its user owns, reports about itself."""
    # The share of time in which a person, or a safety filter, had to help.
    share = f" ({actor.overridden_actions / actor.rows:.1%})" if actor.rows >= actor.overridden_actions > 0 else ""
    counts = {
        f"of {actor.deadlines:,} deadlines missed": actor.missed_deadlines,
        f"actions overridden{share}": actor.overridden_actions,
        "safe actions": actor.safe_actions,
        "rollouts dropped": actor.rollouts_dropped,
    }
    counted = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count)
    if not counted and actor.deadlines:
        counted = f"0 of {actor.deadlines:,} deadlines missed"
    safe = [f"plays the safe action: {actor.safe_reason}"] if actor.safe_reason and actor.alive else []
    return [*safe, *([f"counts {counted}"] if counted else [])]


def _refused(refused: RefusedJoin) -> str:
    """Return the line of an actor that was refused or failed."""
    where = ", ".join(filter(None, (refused.host, refused.software)))
    return (
        f"  refused: {refused.actor}{f' ({where})' if where else ''}, {refused.count:,} x, last "
        f"{refused.seconds_since_last:,.0f} s ago: {refused.reason}"
    )


def _expiry(days: float | None) -> list[str]:
    if days is None or days > WARNING_DAYS:
        return []
    when = f"expires in {days:.0f} days" if days > 0 else f"expired {-days:.0f} days ago"
    return [f"  the learner's certificate {when}: renew it (daedalus certs renew learner)"]


def _missing_actors(status: RunStatus) -> list[str]:
    missing = status.fleet_size - len(status.actors)
    return [f"  ... and {missing:,} more, which the learner did not report in time"] if missing > 0 else []
