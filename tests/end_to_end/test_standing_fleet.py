"""A standing fleet: an actor process that serves one run after another, until an operator drains it."""

from collections.abc import Callable

from processes import Running

Start = Callable[..., Running]


def test_an_actor_that_stays_serves_the_next_run_until_it_is_drained(start: Start, address: str) -> None:
    router = start("router", "--listen", address)
    router.expect("listening")
    actor = start("actor", "--connect", address, "--name", "standing", "--envs", 8, "--stay")
    first = start("learner", "cartpole", "--connect", address, "--run-dir", "first", "--env-steps", 3000)
    actor.expect("joined run 'first'")
    assert first.wait() == 3, first.output
    actor.expect("waiting for the next run")
    endless = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)
    second = start("learner", "cartpole", "--connect", address, "--run-dir", "second", *endless)
    actor.expect("joined run 'second'")
    second.expect(r"updates .*/s")
    unknown = start("drain", "other", "--connect", address)
    assert unknown.wait() == 1
    unknown.expect("daedalus drain: no actor 'other' takes part")
    drained = start("drain", "standing", "--connect", address)
    assert drained.wait() == 0, drained.output
    drained.expect("actor standing has left")
    assert actor.wait() == 0, actor.output
    actor.expect("an operator drained this actor")
    second.expect("actor standing is drained: it leaves after its current rollout")
