"""Test of failures of actors, learner, router, disk and network, with real processes."""

import random
import resource
import signal
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from faults import Sender, StallingProxy
from learner_status import actor_status, env_steps, learner_status
from processes import ENDLESS, LIMIT, PLAYING_SLOW, SLOW, Running, here, until

from daedalus.protocol import keys

Start = Callable[..., Running]
Status = Callable[[], dict]
SAVING = ("--set", "service.checkpoint_seconds=0.3")


@pytest.fixture
def status(address: str) -> Status:
    """Function that returns the status of the learner, or an empty dict while it does not answer."""
    return lambda: learner_status(address)


@pytest.fixture
def learner(start: Start, address: str) -> Callable[..., Running]:
    """Function that starts a learner with an endless run."""
    words = ("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS)
    return lambda *more: start(*words, *SLOW, *more)


def wait_for_training(status: Status, name: str) -> None:
    """Wait until the learner has trained on new rollouts of an actor."""
    until(status)
    before = env_steps(status(), name)
    until(lambda: env_steps(status(), name) > before)


# --------------------------------------------------------------------------------------------- actors


def test_a_frozen_actor_is_noticed_continues_and_does_not_hold_the_end_of_its_learner(
    start: Start, address: str, tmp_path: Path, status: Status, learner: Callable[..., Running]
) -> None:
    serving = learner("--algorithm", "a2c")  # whose batches have a rollout of each actor
    frozen = start("actor", "--connect", address, "--name", "frozen", *PLAYING_SLOW)
    start("actor", "--connect", address, "--name", "other", *PLAYING_SLOW)
    wait_for_training(status, "frozen")
    frozen.process.send_signal(signal.SIGSTOP)
    try:
        until(lambda: actor_status(status(), "frozen").get("alive") is False)
        wait_for_training(status, "other")
    finally:
        frozen.process.send_signal(signal.SIGCONT)
    wait_for_training(status, "frozen")
    again = actor_status(status(), "frozen")
    assert (again["alive"], again["lives"]) == (True, 1)
    assert set(again["rollouts_rejected"]) <= {"stale", "duplicate"}
    frozen.process.send_signal(signal.SIGSTOP)
    serving.process.terminate()
    serving.process.terminate()
    assert serving.wait() == 0, serving.output
    assert (tmp_path / "run" / "summary.json").exists()


def test_an_actor_continues_after_its_link_stalled_and_arbitrary_bytes_change_nothing(
    start: Start, address: str, status: Status, learner: Callable[..., Running]
) -> None:
    serving = learner()
    with closing(StallingProxy(address)) as proxy:
        actor = start("actor", "--connect", proxy.address, "--name", "remote", *PLAYING_SLOW)
        wait_for_training(status, "remote")
        proxy.stall()
        until(lambda: actor_status(status(), "remote").get("alive") is False)
        proxy.resume()
        wait_for_training(status, "remote")
        assert actor_status(status(), "remote")["lives"] == 1
        with closing(Sender(address, "stranger")) as sender:
            send_arbitrary_bytes(sender, status()["run"], "remote")
            wait_for_training(status, "remote")
        after = status()
        assert {"remote", "stranger"} == {each["actor"] for each in after["actors"]}
        assert after["rollouts_rejected"]["malformed"] > 0
        assert after["rollouts_rejected"]["unknown_actor"] > 0
        for process in (serving, actor):
            assert process.process.poll() is None
            assert "Traceback" not in process.output


def send_arbitrary_bytes(sender: Sender, run: str, actor: str) -> None:
    """Send noise, and parts of a genuine rollout, on all keys of a run, also on those of one of its actors."""
    genuine = sender.rollout(0, 0)
    noise = random.Random(1)
    for attempt in range(60):
        kind = attempt % 4
        if kind == 0:
            payload = noise.randbytes(noise.randrange(200))
        elif kind == 1:
            payload = genuine[: noise.randrange(len(genuine))]
        else:
            damaged = bytearray(genuine)
            for _ in range(kind):
                damaged[noise.randrange(len(damaged))] = noise.randrange(256)
            payload = bytes(damaged)
        for key in (
            keys.join(run, "stranger"),
            keys.program(run, "0" * 64),
            keys.rollouts(run, actor),
            keys.rollouts(run, "stranger"),
            keys.rollouts(run, "nobody"),
            keys.evaluations(run, "e"),
            keys.snapshots(run),
            keys.status(run),
        ):
            assert len(sender.transport.query(key, payload, timeout=LIMIT)) == 1
        sender.transport.publish(keys.snapshots(run), payload)
    sender.transport.declare_presence(keys.presence(run, "nobody-ever-joined", 1))


def test_an_actor_that_sends_nan_rewards_is_quarantined_and_prints_the_reason(
    start: Start, address: str, tmp_path: Path, status: Status
) -> None:
    source = (Path(__file__).parent.parent / "nan_environment.py").read_text()
    (tmp_path / "nan_environment.py").write_text(source)
    learner = start("learner", "--env", "nan_environment:Broken-v0", "--listen", address, "--run-dir", "run", *ENDLESS)
    learner.expect("actors join with: .* --allow-module nan_environment")
    careful = start("actor", "--connect", address, "--name", "careful")
    assert careful.wait() == 1
    assert careful.lines[-1] == (
        "daedalus actor: the learner asks for environment.id=nan_environment:Broken-v0, but the module nan_environment "
        "may not be imported here; if you trust that code, add --allow-module nan_environment"
    )
    shown = here("status", "--connect", address)
    shown.expect("refused: careful .*, 1 x, ")
    shown.expect("add --allow-module nan_environment")
    actor = start("actor", "--connect", address, "--name", "broken", "--allow-module", "nan_environment")
    assert actor.wait() == 1
    assert "quarantined this actor: 3 unfit rollouts in a row, the last: rewards has a value" in actor.output
    report = actor_status(status(), "broken")
    assert report["quarantined"].endswith("rewards has a value that is not finite")
    assert report["rollouts_rejected"]["unfit"] == 3  # rollouts in flight are not counted
    learner.process.terminate()
    assert learner.wait() == 0
    assert "Traceback" not in learner.output


# -------------------------------------------------------------------------------------------- learner


def newest_checkpoint(directory: Path) -> str:
    """Return the name of the newest checkpoint, or an empty string."""
    return max((entry.name for entry in (directory / "checkpoints").glob("0*")), default="")


def test_the_same_command_continues_a_killed_learner_which_trains_while_the_disk_is_full(
    start: Start, address: str, tmp_path: Path, status: Status, learner: Callable[..., Running]
) -> None:
    first = learner("--resume", *SAVING)
    start("actor", "--connect", address, "--name", "loyal", *PLAYING_SLOW)
    wait_for_training(status, "loyal")
    until(lambda: int(newest_checkpoint(tmp_path / "run") or 0) > 0)  # not only that of the first weights
    first.process.kill()
    first.wait()
    second = learner("--resume", *SAVING)
    version = int(second.expect(r"resuming from checkpoint (\d+)").group(1))
    assert version > 0
    wait_for_training(status, "loyal")
    assert status()["updates"] > version
    expect_training_without_checkpoints(second, address, tmp_path / "run", status)
    other = learner("--resume", "--seed", 99)
    assert other.wait() == 2
    assert "has other settings" in other.output


def expect_training_without_checkpoints(serving: Running, address: str, run: Path, status: Status) -> None:
    """Let no file be written for a while: the learner trains on, and warns."""
    until(lambda: status().get("checkpoint_age_seconds") is not None)
    _, hard = resource.prlimit(serving.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(serving.process.pid, resource.RLIMIT_FSIZE, (0, hard))
    serving.expect("checkpoint not saved")
    assert here("status", "--connect", address, "--quiet").status == 3
    assert "checkpoints cannot be saved: File too large" in status()["problems"]
    newest = newest_checkpoint(run)
    wait_for_training(status, "loyal")
    assert newest_checkpoint(run) == newest
    resource.prlimit(serving.process.pid, resource.RLIMIT_FSIZE, (hard, hard))
    serving.expect("checkpoints are saved again")
    until(lambda: newest_checkpoint(run) > newest)
    assert serving.output.count("checkpoint not saved") == 1
    until(lambda: status().get("problems") == [])


# ---------------------------------------------------------------------------------- router and network


@pytest.fixture
def router(start: Start, address: str) -> Callable[[], Running]:
    """Function that starts a router at the address."""

    def start_one() -> Running:
        running = start("router", "--listen", address)
        running.expect("listening")
        return running

    return start_one


def test_learner_and_actors_reconnect_after_a_restart_of_the_router_and_a_stalled_link(
    start: Start, address: str, status: Status, router: Callable[[], Running]
) -> None:
    with closing(StallingProxy(address)) as proxy:
        serving = start("learner", "cartpole", "--connect", proxy.address, "--run-dir", "run", *ENDLESS, *SLOW)
        serving.expect("waiting for it")
        first = router()
        actor = start("actor", "--connect", address, "--name", "loyal", *PLAYING_SLOW)
        wait_for_training(status, "loyal")
        first.process.kill()
        first.wait()
        assert status() == {}
        router()
        wait_for_training(status, "loyal")
        proxy.stall()
        until(lambda: status() == {})
        proxy.resume()
        wait_for_training(status, "loyal")
        assert actor_status(status(), "loyal")["lives"] == 1
        assert (serving.process.poll(), actor.process.poll()) == (None, None)


# ------------------------------------------------------------------------------- hostile senders


def test_a_flooded_learner_answers_busy_and_trains_on_every_accepted_rollout(
    start: Start, address: str, status: Status
) -> None:
    """Send a thousand rollouts at once to a queue that holds some hundred, while an actor plays."""
    small = ("--set", "service.queue_megabytes=0.2", "--set", "training.max_policy_lag=1000000")
    start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS, *small)
    start("actor", "--connect", address, "--name", "good", "--envs", 2)
    wait_for_training(status, "good")
    sender = Sender(address, "flood")
    verdicts: list[bytes | None] = []
    try:
        version = sender.version()
        for sequence in range(1000):
            payload = sender.rollout(sequence, version)
            sender.transport.query_async(sender.key, payload, timeout=LIMIT, on_answer=verdicts.append)
        until(lambda: len(verdicts) == 1000)
        assert None not in verdicts
        report = actor_status(status(), "flood")
        assert report["busy_answers"] > 0
        assert report["rollouts_accepted"] + report["busy_answers"] == 1000
        assert report["rollouts_rejected"] == {}
        rows = sender.welcome.spec.collection.rollout_length * sender.environments
        until(lambda: env_steps(status(), "flood") == actor_status(status(), "flood")["rollouts_accepted"] * rows)
        wait_for_training(status, "good")
    finally:
        sender.close()
