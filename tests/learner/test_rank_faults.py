"""learner/ranks: ranks that die, hang, or were started for another run."""

import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

import pytest
import torch
from building import POLICY, SPACES, make_rollouts, run_spec
from processes import free_address
from ranked import SECONDS, Rank, connected, ranked_learner, spec_of
from torch._C._distributed_c10d import HashStore

from daedalus.cli import ranks
from daedalus.cli.ranks import LaunchedRanks, StartedRanks, follow
from daedalus.launch.process_lifecycle import RANK_LOST
from daedalus.learner.ranks import agreement
from daedalus.learner.ranks.agreement import Options, this_run
from daedalus.learner.ranks.commands import CommandKind, give, receive
from daedalus.learner.ranks.errors import RankLostError, RanksDisagreeError
from daedalus.learner.ranks.follower import Follower
from daedalus.learner.ranks.leader import Leader
from daedalus.learner.ranks.meeting import Meeting, meeting_of
from daedalus.learner.ranks.opening import lead
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.learner import Learner
from daedalus.policy.user_modules import NO_MODULES
from daedalus.protocol.spec import RunSpec


def lead_with(
    work: Any = Follower.run, *, seconds: float = SECONDS, spec: RunSpec | None = None, **rank: Any
) -> tuple[Leader, Rank]:
    """Return rank 0 of two, and the other rank, which does `work`."""
    store = HashStore()
    other = Rank(store, 1, 2, work=work, **rank)
    return Leader(connected(store, 0, 2, seconds), this_run(spec or run_spec(), rank.get("options"))), other


def test_a_rank_that_dies_in_an_update_is_noticed_at_once() -> None:
    died = threading.Event()

    def work(follower: Follower) -> None:
        receive(follower._group)
        follower._begin()
        died.set()  # and its connections close

    spec = spec_of(POLICY)
    leader, other = lead_with(work, spec=spec)
    learner = Learner(spec.training, POLICY, SPACES, other_ranks=leader)
    leader.begin(SPACES, learner.shared_state)
    assert died.wait(SECONDS)
    other.ended()
    other.follower = None
    before = learner._flat.values.clone()
    with pytest.raises(RankLostError):
        learner.step(make_rollouts(1), 0.0)
    assert torch.equal(learner._flat.values, before)  # the checkpoint at the end has no half an update
    leader.close()


def test_a_rank_that_hangs_is_noticed_after_the_limit() -> None:
    release = threading.Event()
    leader, _ = lead_with(lambda _: release.wait(SECONDS), seconds=5.0)
    try:
        with pytest.raises(RankLostError):
            leader.begin(SPACES, tuple)
    finally:
        release.set()


def test_the_others_end_with_rank_0() -> None:
    leader, other = lead_with()
    del leader  # closes its connections
    other.ended()
    assert isinstance(other.error, RankLostError)


OPTIONS: Options = {"preset": "cartpole", "--seed": 1, "--set": ["training.learning_rate=0.001"], "--resume": False}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"--seed": 2}, "--seed is 2, and that of rank 0 1: start all ranks with the same command"),
        ({"--set": []}, "--set is [], and that of rank 0 ['training.learning_rate=0.001']: start all"),
        ({"--resume": True}, "--resume is True, and that of rank 0 False: start all"),
    ],
)
def test_ranks_with_other_options_are_refused(changed: Options, message: str) -> None:
    store = HashStore()
    other = Rank(store, 1, 2, options=OPTIONS | changed)
    with pytest.raises(RanksDisagreeError) as refused:
        Leader(connected(store, 0, 2), this_run(run_spec(), OPTIONS))
    other.ended()
    assert str(refused.value) == str(other.error)
    assert str(refused.value).startswith("rank 1 on ")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_rank_of_another_release_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    run = this_run(run_spec(), None)
    announced = agreement.described(run)
    monkeypatch.setattr(agreement, "_versions", lambda: run.versions | {"daedalus": "99.0"})
    with pytest.raises(RanksDisagreeError, match=r"daedalus 99.0 is installed, and rank 0 has .*: install the same"):
        agreement.checked(announced, None)
    with pytest.raises(RanksDisagreeError, match="rank 0 is of another release"):
        agreement.checked("[]", None)


def test_a_module_that_a_rank_may_not_import_is_named() -> None:
    spec = spec_of(POLICY.model_copy(update={"encoder": "elsewhere:Encoder"}))
    leader, other = lead_with(spec=spec)
    with pytest.raises(RanksDisagreeError, match=r"rank 1 on .*elsewhere.* may not be imported"):
        leader.begin(SPACES, tuple)
    other.ended()
    assert isinstance(other.error, RanksDisagreeError)


def test_connecting_ends_when_the_run_is_stopped_or_a_rank_has_died(tmp_path: Any) -> None:
    meeting = Meeting(rank=0, number=2, local_rank=0, folder=tmp_path, on_this_machine=True)  # nobody else comes
    stop = threading.Event()

    def died() -> None:
        raise RankLostError("process 1")

    with pytest.raises(RankLostError, match="process 1"):
        lead(meeting, None, run_spec(), stop, died, lambda: None)
    stop.set()
    assert lead(meeting, None, run_spec(), stop, lambda: None, lambda: None) is None


def test_a_rank_that_hangs_does_not_delay_the_end_of_a_stopped_run(tmp_path: Any) -> None:
    """`give_up` is called, which kills the other ranks."""
    release, given_up, stop = threading.Event(), threading.Event(), threading.Event()

    def other_rank() -> None:
        group = Meeting(rank=1, number=2, local_rank=1, folder=tmp_path, on_this_machine=True).connect()
        assert group is not None
        follower = Follower(group)
        release.wait(SECONDS)
        del follower

    def give_up() -> None:
        given_up.set()
        release.set()

    thread = threading.Thread(target=other_rank, daemon=True)
    thread.start()
    meeting = Meeting(rank=0, number=2, local_rank=0, folder=tmp_path, on_this_machine=True)
    leader = lead(meeting, None, run_spec(), stop, lambda: None, give_up)
    assert leader is not None
    stop.set()
    with pytest.raises(RankLostError):
        leader.begin(SPACES, tuple)
    assert given_up.is_set()
    thread.join(SECONDS)


TORCHRUN = {"RANK": "1", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}
TORCHRUN |= {"TORCHELASTIC_USE_AGENT_STORE": "True", "TORCHELASTIC_RESTART_COUNT": "2"}


def test_torchrun_arranges_the_meeting() -> None:
    meeting = meeting_of(TORCHRUN, insecure=False)
    assert meeting == Meeting(
        rank=1, number=4, local_rank=1, on_this_machine=True, address=("127.0.0.1", 29500), is_served=True, attempt=2
    )
    assert meeting_of({}, insecure=False) is None
    assert meeting_of(TORCHRUN | {"RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0"}, insecure=False) is None
    elsewhere = meeting_of(TORCHRUN | {"MASTER_ADDR": "10.0.0.1"}, insecure=True)
    assert elsewhere is not None
    assert not elsewhere.on_this_machine


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"MASTER_ADDR": "10.0.0.1"}, "without encryption; .* add --insecure"),
        ({"RANK": "4"}, "RANK is '4', it must be a number from 0 to 3: unset it, or start"),
        ({"WORLD_SIZE": "many"}, "WORLD_SIZE is 'many'"),
    ],
)
def test_a_wrong_meeting_is_refused_in_one_line(changed: dict[str, str], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        meeting_of(TORCHRUN | changed, insecure=False)


def test_an_idle_rank_0_shows_that_it_is_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daedalus.learner.ranks.leader._WAIT_SECONDS", 0.0)
    given: list[CommandKind] = []
    with ranked_learner(2, run_spec(), SPACES) as (learner, _):
        leader = learner._other_ranks
        monkeypatch.setattr(
            "daedalus.learner.ranks.leader.give",
            lambda group, command: given.append(command.kind) or give(group, command),
        )
        for _ in range(3):
            leader.wait()
        assert given == [CommandKind.WAIT] * 3
        assert learner.step(make_rollouts(1), 0.0) == []


class Launched:
    """Rank 0 and another rank of `daedalus learner`, as torchrun starts them; the other is a thread."""

    def __init__(self, first: Options, other: Options) -> None:
        port = int(free_address().rpartition(":")[2])
        self._other_options = other
        meetings = [
            Meeting(rank=rank, number=2, local_rank=rank, on_this_machine=True, address=("127.0.0.1", port))
            for rank in range(2)
        ]
        self.ranks, self._meeting = LaunchedRanks(meetings[0], first), meetings[1]
        self.status: int | None = None
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        self.status = follow(self._meeting, self._other_options, NO_MODULES, threading.Event())

    def other_status(self) -> int | None:
        self._thread.join(SECONDS)
        return self.status


def test_a_run_that_is_over_ends_the_other_ranks_that_were_launched() -> None:
    launched = Launched(OPTIONS, OPTIONS)
    launched.ranks.dismiss(run_spec(), threading.Event())
    assert launched.other_status() == 0


def test_launched_ranks_that_disagree_fail_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    launched = Launched(OPTIONS, OPTIONS | {"--seed": 3})
    with pytest.raises(RanksDisagreeError, match="--seed is 3") as error:
        launched.ranks.open(run_spec(), threading.Event())
    assert launched.other_status() == 1
    assert capsys.readouterr().err == f"daedalus learner: {error.value}\n"


@pytest.mark.parametrize(
    ("program", "text", "status"),
    [
        ("import os; os.kill(os.getpid(), 9)", "process 1 of the learner was killed by signal 9", RANK_LOST),
        ("raise SystemExit(1)", "process 1 of the learner failed; see the error above", 1),
        ("import time; time.sleep(1000)", "a process of the learner does not answer: the time is over", RANK_LOST),
    ],
)
def test_the_fault_of_a_lost_rank_is_named(
    program: str, text: str, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(*_arguments: object, **_options: object) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-S", "-c", program], stdin=subprocess.PIPE)

    monkeypatch.setattr(ranks, "start", start)
    started = StartedRanks(2, [])
    error = RankLostError("the time is over")
    with suppress(RankLostError), started:
        if "sleep" not in program:
            started._processes[0].wait(SECONDS)
        raise error
    assert started.fault(error) == (text, status)
    assert started._processes[0].poll() is not None
