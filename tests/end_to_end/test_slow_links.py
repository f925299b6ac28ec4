"""Actors on a slow link, and with slow environments."""

from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
from faults import SlowProxy
from learner_status import actor_status, env_steps, learner_status
from processes import ENDLESS, PLAYING_SLOW, Running, free_address, starting, until

Start = Callable[..., Running]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a learner with an endless run."""
    address = free_address()
    with starting(tmp_path_factory.mktemp("learner")) as start:
        start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS)
        yield address


def test_an_actor_measures_that_its_link_is_slow_and_is_trained_on(start: Start, served: str) -> None:
    def far() -> dict:
        return actor_status(learner_status(served), "far")

    with closing(SlowProxy(served, up=125e3, down=500e3, delay=0.1)) as proxy:
        actor = start("actor", "--connect", proxy.address, "--name", "far")
        actor.expect("slow link: .* fetching compact snapshots")
        until(lambda: far().get("rollouts_accepted", 0) > 20)
        report = far()
        assert report["compact_snapshots"]
        assert report["rollouts_missed"] == 0
        assert "unfit" not in report["rollouts_rejected"]
        until(lambda: 0 < far().get("bytes_down_per_hour", 0) < 3600 * 500e3)


def test_an_actor_with_link_wan_keeps_receiving_new_weights(start: Start, served: str) -> None:
    start("actor", "--connect", served, "--name", "wan", "--link", "wan")
    until(lambda: env_steps(learner_status(served), "wan") > 50_000)
    # The actor received new weights: rollouts of its first weights would be stale by now.
    report = actor_status(learner_status(served), "wan")
    assert report["compact_snapshots"]
    assert sum(report["rollouts_rejected"].values()) < report["rollouts_accepted"]


def test_slow_actors_wait_for_a_stopped_learner_and_leave_a_finished_run(start: Start, address: str) -> None:
    # An actor's rollout of 64 env_steps takes 0.26 s.
    sizes = ("collection.envs_per_actor=2", "collection.rollout_length=32", "service.log_seconds=0.1")
    settings = [word for each in sizes for word in ("--set", each)]
    words = ("learner", "--env", "slow_environment:Slow-v0", "--listen", address, *settings, "--run-dir", "run")
    learner = start(*words, "--env-steps", 10**9)
    actors = [start("actor", "--connect", address, "--name", name, *PLAYING_SLOW) for name in ("a", "b")]
    for actor in actors:
        actor.expect("joined run")
    learner.expect(r"updates .*/s")
    learner.process.terminate()
    assert learner.wait() == 0, learner.output
    saved = learner.expect(r"stopped; checkpoint saved at ([\d,]+) env_steps: run/checkpoints/0").group(1)
    for actor in actors:  # what the learner says last is lost if its router ends before a busy machine has sent it
        actor.expect("the learner was stopped; waiting for it to return|the learner went away; looking for it again")
    resumed = start(*words, "--env-steps", int(saved.replace(",", "")) + 600, "--resume")
    resumed.expect("resuming from checkpoint")
    assert resumed.wait() == 0, resumed.output
    for actor in actors:
        assert actor.wait() == 0, actor.output
        actor.expect("the run is over")
