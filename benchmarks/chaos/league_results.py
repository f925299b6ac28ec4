"""Results of matches while actors of a game are killed and its learner is restarted: each counts once."""

import random
import signal
from collections import defaultdict

from benchmarks.chaos.scene import ENDLESS, FailedError, JournalActors, say, scene

_ACTORS = 8
# Answers that mean that the results of a rollout were counted: now, or when it arrived before.
_COUNTED = ("accepted", "rejected policy lag", "rejected the rollout was received before")
# Answers that leave it open: the rollout may have been counted before this answer, at another arrival.
_OPEN = ("busy", "fenced")


def league(kills: int) -> list[tuple[str, str]]:
    """Kill eight actors of tic-tac-toe, one of which sends all rollouts twice, and restart the learner once.

    The matches that the ratings have counted must be those of the rollouts that the journals call received. An actor
    that is killed does not learn what became of its rollouts in flight: their matches may be counted or not.
    """
    choose = random.Random(9)
    with scene() as here:
        here.router()
        # The budget is so large that only one version is kept: matches of dropped versions would leave the status.
        command = ("learner", "tic_tac_toe", "--resume", "--run-dir", "run", "--connect", here.address, *ENDLESS)
        learner = here.start(*command)
        actors = JournalActors(here, _ACTORS)
        for number in range(kills):
            if number == kills // 2:
                learner.process.send_signal(signal.SIGTERM)
                learner.wait()
                learner = here.start(*command)
                say("the learner is restarted")
            name = actors.kill_one(choose)
            say(f"kill {number + 1} of {kills}: {name} is back")
        actors.end()
        status = here.status()
        if status is None or status.league is None or status.league.left_out:
            raise FailedError("the status has no complete league")
        players = status.league.players
        lines = actors.lines()
    matches, answers = dict[str, int](), defaultdict[str, list[str]](list)
    for kind, name, rest in (line.split(" ", 2) for line in lines):
        if kind == "sent":
            matches[name] = int(rest)
        else:
            answers[name].append(rest)
    twice = [name for name, given in answers.items() if sum(each.startswith("accepted") for each in given) > 1]
    other = {each for given in answers.values() for each in given if not each.startswith((*_COUNTED, *_OPEN))}
    if twice or other:
        raise FailedError(f"accepted twice: {twice[:5]}; other answers: {sorted(other)[:5]}")
    received = {name for name, given in answers.items() if any(each.startswith(_COUNTED) for each in given)}
    least = sum(matches[name] for name in received)
    most = sum(matches.values())
    counted, odd = divmod(sum(each.matches for each in players), 2)  # each match counts for two players
    again = sum(len(given) > 1 for given in answers.values())
    if odd or not least <= counted <= most:
        raise FailedError(f"{counted} matches are counted; {least} were received, {most} sent, by {players}")
    return [
        (
            "matches sent = counted + lost in flight",
            f"{most:,} = {counted:,} + {most - counted:,}, {least:,} of them received for sure, in {len(matches):,} "
            f"rollouts over {kills} kills of {_ACTORS} actors and a restart of the learner",
        ),
        ("rollouts with more than one answer, of which none was accepted twice", f"{again:,}"),
    ]
