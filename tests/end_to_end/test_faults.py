"""What the service promises when actors, learner, router, disk and network fail: real processes, a real router."""

import json
import os
import random
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.numpy
from faults import Sender, StallingProxy
from processes import LIMIT, Running, processes_mentioning, until

from daedalus.protocol import keys

Start = Callable[..., Running]
Status = Callable[..., dict]
ENDLESS = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)
SAVING = ("--set", "service.checkpoint_seconds=0.3")


@pytest.fixture
def status(start: Start, address: str) -> Status:
    """Asks the learner for its status; empty while it does not answer."""

    def ask(at: str = address) -> dict:
        running = start("status", "--connect", at, "--json")
        return json.loads(running.output) if running.wait() in (0, 3) else {}

    return ask


@pytest.fixture
def learner(start: Start, address: str) -> Callable[..., Running]:
    """Starts a learner that never ends by itself."""
    return lambda *more: start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS, *more)


def actor_status(status: dict, name: str) -> dict:
    """What a status tells of one actor; empty if it does not know it."""
    return next((actor for actor in status.get("actors", ()) if actor["actor"] == name), {})


def env_steps(status: dict, name: str) -> int:
    return actor_status(status, name).get("env_steps", 0)


def plays_on(status: Status, name: str, at: str = "") -> None:
    """Waits until rollouts of an actor are trained on that it has still to send."""
    ask = (lambda: status(at)) if at else status
    until(ask)
    before = env_steps(ask(), name)
    until(lambda: env_steps(ask(), name) > before)


# --------------------------------------------------------------------------------------------- actors


def test_a_frozen_actor_is_missed_and_goes_on_where_it_was(
    start: Start, address: str, status: Status, learner: Callable[..., Running]
) -> None:
    learner()
    frozen = start("actor", "--connect", address, "--name", "frozen")
    start("actor", "--connect", address, "--name", "other")
    plays_on(status, "frozen")
    frozen.process.send_signal(signal.SIGSTOP)
    try:
        until(lambda: actor_status(status(), "frozen")["alive"] is False)
        plays_on(status, "other")
    finally:
        frozen.process.send_signal(signal.SIGCONT)
    plays_on(status, "frozen")
    again = actor_status(status(), "frozen")
    assert (again["alive"], again["lives"]) == (True, 1)
    assert set(again["rollouts_rejected"]) <= {"stale", "duplicate"}


def test_a2c_waits_for_a_frozen_actor_no_longer_than_it_is_there(
    start: Start, address: str, status: Status, learner: Callable[..., Running]
) -> None:
    learner("--algorithm", "a2c")
    frozen = start("actor", "--connect", address, "--name", "frozen")
    start("actor", "--connect", address, "--name", "other")
    plays_on(status, "frozen")
    frozen.process.send_signal(signal.SIGSTOP)
    try:
        plays_on(status, "other")
        assert actor_status(status(), "frozen")["alive"] is False
    finally:
        frozen.process.send_signal(signal.SIGCONT)
    plays_on(status, "frozen")


def test_an_actor_whose_link_was_dead_goes_on_without_a_restart(
    start: Start, address: str, status: Status, learner: Callable[..., Running]
) -> None:
    learner()
    proxy = StallingProxy(address)
    try:
        start("actor", "--connect", proxy.address, "--name", "remote")
        plays_on(status, "remote")
        proxy.stall()
        until(lambda: actor_status(status(), "remote")["alive"] is False)
        proxy.resume()
        plays_on(status, "remote")
        assert actor_status(status(), "remote")["lives"] == 1
    finally:
        proxy.close()


def test_an_actor_that_sends_what_no_healthy_one_would_is_shut_out_and_says_why(
    start: Start, address: str, tmp_path: Path, status: Status
) -> None:
    source = (Path(__file__).parent.parent / "nan_environment.py").read_text()
    (tmp_path / "nan_environment.py").write_text(source)
    learner = start("learner", "--env", "nan_environment:Broken-v0", "--listen", address, "--run-dir", "run", *ENDLESS)
    actor = start("actor", "--connect", address, "--name", "broken")
    assert actor.wait() == 1
    assert "takes nothing more of this actor: 3 unfit rollouts in a row, the last: rewards has a value" in actor.output
    told = actor_status(status(), "broken")
    assert told["quarantined"].endswith("rewards has a value that is not finite")
    assert told["rollouts_rejected"]["unfit"] == 3  # beside what was in flight and not looked at
    learner.process.terminate()
    assert learner.wait() == 1
    assert "Traceback" not in learner.output


def test_poisoned_rollouts_harm_nobody_but_their_sender(
    start: Start, address: str, tmp_path: Path, status: Status, learner: Callable[..., Running]
) -> None:
    serving = learner()
    start("actor", "--connect", address, "--name", "good")
    plays_on(status, "good")
    sender = Sender(address, "rogue")
    try:
        answers = [sender.send(sender.poison(sequence, sender.version())) for sequence in range(4)]
    finally:
        sender.close()
    assert [answer.verdict for answer in answers] == ["rejected", "rejected", "quarantined", "quarantined"]
    assert "rewards" in answers[0].reason
    plays_on(status, "good")
    serving.process.terminate()
    assert serving.wait() == 1
    newest = max((tmp_path / "run" / "checkpoints").iterdir())
    weights = safetensors.numpy.load_file(newest / "parameters.safetensors")
    assert all((abs(array) < 1e6).all() for array in weights.values())


# -------------------------------------------------------------------------------------------- learner


def newest_checkpoint(directory: Path) -> str:
    """Its name; empty if there is none yet."""
    return max((entry.name for entry in (directory / "checkpoints").glob("0*")), default="")


def learners(run: str) -> list[int]:
    """The learner's process, as `daedalus train` starts it."""
    return sorted(set(processes_mentioning("--prepared")) & set(processes_mentioning(run)))


def test_a_killed_learner_comes_back_and_training_reaches_its_end(start: Start, tmp_path: Path) -> None:
    training = start("train", "cartpole", "--run-dir", "fallen-run", *ENDLESS[:2], "--env-steps", 3_000_000, *SAVING)
    for _ in range(2):
        saved = newest_checkpoint(tmp_path / "fallen-run")
        until(lambda saved=saved: newest_checkpoint(tmp_path / "fallen-run") > saved)
        (victim,) = learners("fallen-run")
        os.kill(victim, signal.SIGKILL)
        until(lambda victim=victim: set(learners("fallen-run")) - {victim})
    assert training.wait() == 0, training.output
    assert training.output.count("the learner was killed by signal 9; started again") == 2
    assert training.output.count("resuming from checkpoint") == 2
    assert "Traceback" not in training.output
    summary = json.loads((tmp_path / "fallen-run" / "summary.json").read_text())
    assert summary["env_steps"] >= 3_000_000
    assert not processes_mentioning("fallen-run")


def test_a_supervised_learner_goes_on_by_the_same_command(
    start: Start, address: str, status: Status, learner: Callable[..., Running]
) -> None:
    first = learner("--resume", *SAVING)
    start("actor", "--connect", address, "--name", "loyal")
    plays_on(status, "loyal")
    until(lambda: status().get("checkpoint_age_seconds") is not None)
    first.process.kill()
    first.wait()
    second = learner("--resume", *SAVING)
    version = int(second.expect(r"resuming from checkpoint (\d+)").group(1))
    assert version > 0
    plays_on(status, "loyal")
    assert status()["updates"] > version
    other = learner("--resume", "--seed", 99)
    assert other.wait() == 2
    assert "has other settings" in other.output


def test_a_learner_leaves_in_good_order_beside_a_frozen_actor(
    start: Start, address: str, tmp_path: Path, status: Status, learner: Callable[..., Running]
) -> None:
    leaving = learner()
    frozen = start("actor", "--connect", address, "--name", "frozen")
    plays_on(status, "frozen")
    frozen.process.send_signal(signal.SIGSTOP)
    leaving.process.terminate()
    leaving.process.terminate()
    assert leaving.wait() == 1
    assert (tmp_path / "run" / "summary.json").exists()


# ---------------------------------------------------------------------------------- router and network


@pytest.fixture
def router(start: Start, address: str) -> Callable[[], Running]:
    """Starts a router of its own at the address."""

    def start_one() -> Running:
        running = start("router", "--listen", address)
        running.expect("listening")
        return running

    return start_one


def test_learner_and_actors_find_each_other_again_when_the_router_returns(
    start: Start, address: str, status: Status, router: Callable[[], Running]
) -> None:
    serving = start("learner", "cartpole", "--connect", address, "--run-dir", "run", *ENDLESS)
    serving.expect("waiting for it")
    first = router()
    actor = start("actor", "--connect", address, "--name", "loyal")
    plays_on(status, "loyal")
    first.process.kill()
    first.wait()
    assert status() == {}
    router()
    plays_on(status, "loyal")
    assert actor_status(status(), "loyal")["lives"] == 1
    assert (serving.process.poll(), actor.process.poll()) == (None, None)


def test_a_learner_whose_link_to_the_router_was_dead_serves_again(
    start: Start, address: str, status: Status, router: Callable[[], Running]
) -> None:
    router()
    proxy = StallingProxy(address)
    try:
        start("learner", "cartpole", "--connect", proxy.address, "--run-dir", "run", *ENDLESS)
        start("actor", "--connect", address, "--name", "loyal")
        plays_on(status, "loyal")
        proxy.stall()
        until(lambda: status() == {})
        proxy.resume()
        plays_on(status, "loyal")
    finally:
        proxy.close()


# ------------------------------------------------------------------------------- what anybody may send


def test_bytes_of_any_kind_on_any_key_change_nothing(
    start: Start, address: str, status: Status, learner: Callable[..., Running]
) -> None:
    serving = learner()
    actor = start("actor", "--connect", address, "--name", "good")
    plays_on(status, "good")
    run = status()["run"]
    sender = Sender(address, "stranger")
    genuine = sender.rollout(0, 0)
    noise = random.Random(1)
    try:
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
                keys.join(run),
                keys.program(run, "0" * 64),
                keys.rollouts(run, "good"),
                keys.rollouts(run, "stranger"),
                keys.rollouts(run, "nobody"),
                keys.evaluations(run, "e"),
                keys.snapshots(run),
                keys.status(run),
            ):
                assert len(sender.transport.query(key, payload, timeout=LIMIT)) == 1
            sender.transport.publish(keys.snapshots(run), payload)
        sender.transport.declare_presence(keys.presence(run, "nobody-ever-joined", 1))
        plays_on(status, "good")
    finally:
        sender.close()
    after = status()
    assert {"good", "stranger"} == {each["actor"] for each in after["actors"]}
    assert after["rollouts_rejected"]["malformed"] > 0
    assert after["rollouts_rejected"]["unknown_actor"] > 0
    for process in (serving, actor):
        assert process.process.poll() is None
        assert "Traceback" not in process.output


def test_more_than_the_learner_can_take_is_answered_busy_and_nothing_accepted_is_lost(
    start: Start, address: str, status: Status, learner: Callable[..., Running]
) -> None:
    """Two hundred at once into a queue that holds a few, while an actor goes on playing."""
    learner("--set", "service.queue_megabytes=0.02", "--set", "training.max_policy_lag=1000000")
    start("actor", "--connect", address, "--name", "good")
    plays_on(status, "good")
    sender = Sender(address, "flood")
    verdicts: list[bytes | None] = []
    try:
        version = sender.version()
        for sequence in range(200):
            payload = sender.rollout(sequence, version)
            sender.transport.query_async(sender.key, payload, timeout=LIMIT, on_answer=verdicts.append)
        until(lambda: len(verdicts) == 200)
        assert None not in verdicts
        told = actor_status(status(), "flood")
        assert told["busy_answers"] > 0
        assert told["rollouts_accepted"] + told["busy_answers"] == 200
        assert told["rollouts_rejected"] == {}
        rows = sender.welcome.spec.collection.rollout_length * sender.environments
        until(lambda: env_steps(status(), "flood") == actor_status(status(), "flood")["rollouts_accepted"] * rows)
        plays_on(status, "good")
    finally:
        sender.close()


# ----------------------------------------------------------------------------------------------- disk


def test_a_disk_that_takes_nothing_costs_a_warning_and_no_training(
    start: Start, address: str, tmp_path: Path, status: Status, learner: Callable[..., Running]
) -> None:
    serving = learner(*SAVING)
    start("actor", "--connect", address, "--name", "good")
    plays_on(status, "good")
    until(lambda: status().get("checkpoint_age_seconds") is not None)
    _, hard = resource.prlimit(serving.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(serving.process.pid, resource.RLIMIT_FSIZE, (0, hard))
    serving.expect("no checkpoint could be saved")
    assert start("status", "--connect", address, "--quiet").wait() == 3
    assert "checkpoints cannot be saved: File too large" in status()["problems"]
    newest = newest_checkpoint(tmp_path / "run")
    plays_on(status, "good")
    assert newest_checkpoint(tmp_path / "run") == newest
    resource.prlimit(serving.process.pid, resource.RLIMIT_FSIZE, (hard, hard))
    serving.expect("checkpoints are saved again")
    until(lambda: newest_checkpoint(tmp_path / "run") > newest)
    assert serving.output.count("no checkpoint could be saved") == 1
    assert status()["problems"] == []


def test_a_service_without_actors_says_so_by_its_exit_status(start: Start, address: str) -> None:
    start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS).expect("actors join with")

    def unhealthy() -> bool:
        asked = start("status", "--connect", address, "--quiet")
        return asked.wait() == 3 and "no actor has taken part for" in asked.output

    until(unhealthy)
