"""A standing fleet: an actor process that serves one run after another, until an operator drains it."""

import json
import os
import re
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from processes import ENDLESS, PLAYING_SLOW, SLOW, Running, here, until

from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Refusal
from daedalus.transport.status_query import waiting_actors
from daedalus.transport.zenoh_transport import connect, listen

Start = Callable[..., Running]


def test_an_actor_that_stays_serves_the_next_run_until_it_is_drained(
    start: Start, address: str, tmp_path: Path
) -> None:
    router = start("router", "--listen", address)
    router.expect("listening")
    actor = start("actor", "--connect", address, "--name", "standing", "--envs", 8, "--stay", *PLAYING_SLOW)
    first = start("learner", "cartpole", "--connect", address, "--run-dir", "first", "--env-steps", 3000)
    actor.expect("joined run 'first'")
    assert first.wait() == 3, first.output
    actor.expect("waiting for the next run")
    second = start("learner", "cartpole", "--connect", address, "--run-dir", "second", *ENDLESS, *SLOW)
    actor.expect("joined run 'second'")
    second.expect(r"updates .*/s")
    start("actor", "--connect", address, "--name", "idle", "--run", "third", "--stay")
    operator = connect([address])
    until(lambda: "idle" in waiting_actors(operator))
    operator.close()
    here("status", "--connect", address).expect("1 actor waits for a run: idle")
    unknown = here("drain", "standing", "other", "--connect", address)
    assert unknown.status == 1
    unknown.expect("daedalus drain: no actor 'other' takes part or waits for a run")
    drained = start("drain", "standing", "idle", "--connect", address)
    assert drained.wait() == 0, drained.output
    drained.expect("actor standing has left")
    drained.expect("actor idle has left")
    author = "the operator at .*, without an operator's certificate"
    assert actor.wait() == 0, actor.output
    actor.expect(f"drained by {author}: this actor leaves the run")
    second.expect(f"actor=standing: drained by {author}: it leaves after its current rollout")
    saved = here("checkpoint", "second", "--connect", address)
    assert saved.status == 0, saved
    saved.expect("run 'second': checkpoint saved at .* env_steps")
    stopped = start("stop", "second", "--connect", address)
    assert stopped.wait() == 0, stopped.output
    stopped.expect("run 'second': the learner has ended")
    assert second.wait() == 0, second.output
    second.expect(f"stopped by {author}")
    assert re.fullmatch(author, json.loads((tmp_path / "second" / "summary.json").read_text())["stopped_by"])


def test_of_two_learners_of_one_run_the_one_continued_from_a_copy_keeps_the_actors(
    start: Start, address: str, tmp_path: Path
) -> None:
    """The older learner is cut off from the router while the copy starts, and returns."""
    start("router", "--listen", address).expect("listening")
    learner = ("learner", "cartpole", "--connect", address, "--resume", "--run-dir")
    often = (*ENDLESS, *SLOW, "--set", "service.checkpoint_seconds=0.2")
    older = start(*learner, "one/sb", *often)
    actors = [start("actor", "--connect", address, "--name", "leaves", "--envs", 4, *PLAYING_SLOW)]
    actors.append(start("actor", "--connect", address, "--name", "stays", "--run", "sb", "--stay", *PLAYING_SLOW))
    older.expect("joined with 4 environments")
    until(lambda: list((tmp_path / "one/sb/checkpoints").glob("0*")))
    os.kill(older.process.pid, signal.SIGSTOP)
    shutil.copytree(tmp_path / "one/sb", tmp_path / "two/sb", ignore=shutil.ignore_patterns(".*", "learner.lock"))
    time.sleep(3.0)  # the router ends the connection of a silent peer after 2 s
    newer = start(*learner, "two/sb", *often)
    newer.expect("resuming from checkpoint")
    newer.expect("actor=leaves: joined with")
    newer.expect("actor=stays: joined with")
    os.kill(older.process.pid, signal.SIGCONT)
    assert older.wait() == 7, older.output
    older.expect("a newer learner of run 'sb' answers .*: this learner steps down")
    older.expect("stopped; checkpoint saved at")
    for actor in actors:
        assert actor.process.poll() is None, actor.output
    (line,) = here("status", "--connect", address, "--json").lines
    assert json.loads(line)["actors_alive"] == 2
    for actor in actors:
        os.kill(actor.process.pid, signal.SIGUSR1)  # as their hosts do that end
        assert actor.wait() == 0, actor.output
        actor.expect("asked by a signal to leave: no rollout is lost")
    again = start(*learner, "one/sb", *often)  # as by a supervisor
    assert again.wait() == 7
    again.expect(r"one/sb: a newer learner of this run \(epoch [0-9a-f]+\) took over: .* remove \S*one/sb/summary.json")


def test_a_standing_actor_outlives_a_run_that_it_cannot_play_and_another_release(
    start: Start, address: str, tmp_path: Path
) -> None:
    with closing(listen([address])):
        (tmp_path / "elsewhere").mkdir()  # without the module of the run
        asked = ("actor", "--connect", address, "--name", "standing", "--envs", 4, "--stay")
        actor = start(*asked, directory=tmp_path / "elsewhere")
        newer = bytearray(encode(Refusal(code="not_ready", reason="")))
        newer[4] += 1  # the version
        with closing(connect([address])) as foreign:
            foreign.serve(keys.join("foreign", "*"), lambda request: request.reply(bytes(newer)))
            actor.expect("the other end uses protocol version .*; trying again")
        theirs = ("--env", "slow_environment:Slow-v0", "--set", "environment.package=slow-games==1.2")
        first = start("learner", *theirs, "--connect", address, "--run-dir", "theirs")
        actor.expect('slow_environment is not installed here; .*: pip install "slow-games==1.2"; trying again')
        first.expect("failed .*slow_environment")
        first.end()
        second = start("learner", "cartpole", "--connect", address, "--run-dir", "ours", "--env-steps", 3000)
        actor.expect("joined run 'ours'")
        assert second.wait() == 3, second.output
        actor.expect("waiting for the next run")
        assert actor.process.poll() is None
        os.kill(actor.process.pid, signal.SIGUSR1)
        assert actor.wait() == 0, actor.output
