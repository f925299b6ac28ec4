"""learner/league/: kept versions on the disk, plans and policies for actors, other runs as opponents, results."""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from building import EPOCH, identity, joined_fleet, make_rollout, run_context
from hypothesis import given
from hypothesis import strategies as st
from plain import vector_spaces
from processes import LIMIT, until
from saved_runs import save
from test_learner_service import TrainingRun

from daedalus.learner.league.ratings import LeagueState
from daedalus.learner.league.run_league import League
from daedalus.learner.run.resuming import finished_run
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.rollout_intake import RolloutIntake
from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge
from daedalus.learner.training.checkpoint import load_newest
from daedalus.policy.saving.saved_policy import find_policy
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.league import NEWEST, LeagueStatus, MatchCount, Matches
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import LeaguePlan, LeagueRequest, Message, Refusal, Snapshot, StatusReport
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout
from daedalus.transport.memory import MemoryTransport

GAME = {"id": "pettingzoo.classic.tictactoe_v3"}


def game_spec(**league: Any) -> RunSpec:
    return RunSpec.model_validate(
        {
            "environment": GAME,
            "training": {"env_steps": 5000, "algorithm": "impala", "max_policy_lag": 2, "batch_rollouts": 8},
            "collection": {"rollout_length": 6, "actors": 2, "envs_per_actor": 3},
            "league": {"keep_env_steps": 100, **league},
        }
    )


class Policy:
    """What a league needs of a learner: weights that are full of the policy version."""

    policy_version = 0

    def weights(self) -> dict[str, np.ndarray]:
        return {"w": np.full(3, self.policy_version, np.float32)}


class Run:
    """League of one learner process, and its policy after some env_steps."""

    def __init__(self, directory: Path, *, version: int = 0, state: LeagueState | None = None, **league: Any) -> None:
        self.policy = Policy()
        self.policy.policy_version = version
        self.league = League(directory, game_spec(**league), EPOCH, state)
        self.league.load_opponents()
        self.league.open(version)

    def train(self, *env_steps: int) -> None:
        """Go on to each of these env_steps, which are policy versions as well, and keep what is due."""
        for each in env_steps:
            self.policy.policy_version = each
            self.league.advance(self.policy, each, lambda job: job())  # type: ignore[arg-type]

    def plan(self, held: int | None = None) -> LeaguePlan | Refusal:
        plan = decode(self.league.plan(held), Limits())
        assert isinstance(plan, LeaguePlan | Refusal)
        return plan

    @property
    def opponents(self) -> set[str]:
        plan = self.plan()
        assert isinstance(plan, LeaguePlan)
        return {each.player for each in plan.plan.training}

    def snapshot(self, player: str) -> Message:
        return decode(self.league.snapshot(player, "own"), Limits())


def matches(first: str, second: str, wins: int = 1, purpose: Any = "training") -> Matches:
    return Matches(counts=(MatchCount(purpose=purpose, first=first, second=second, side=0, wins=wins),))


def test_the_first_version_is_kept_when_an_actor_asks_and_others_after_so_many_env_steps(tmp_path: Path) -> None:
    run = Run(tmp_path, versions=3)
    run.train(0)
    assert run.league.status() is None  # a game without opponents: nobody asks
    assert not (tmp_path / "league").exists()
    first = run.plan()
    assert isinstance(first, LeaguePlan)
    assert (first.learner_epoch, first.plan.training) == (EPOCH, ())
    assert (first.plan.rating[0].first, first.plan.rating[0].second) == (NEWEST, "random")
    run.train(0, 40, 100, 150, 230, 400)
    assert run.opponents == {"v0", "v230", "v400"}
    assert sorted(each.name for each in (tmp_path / "league").iterdir()) == ["0000000000", "0000000230", "0000000400"]
    snapshot = run.snapshot("v230")
    assert isinstance(snapshot, Snapshot)
    assert (snapshot.policy_version, snapshot.program, snapshot.learner_epoch) == (230, "own", EPOCH)
    assert snapshot.weights["w"].tolist() == [230.0] * 3
    dropped = run.snapshot("v100")
    assert isinstance(dropped, Refusal)
    assert dropped.code == "unknown"
    newest = run.plan()
    assert isinstance(newest, LeaguePlan)
    assert newest.plan.revision > first.plan.revision
    assert isinstance(run.plan(newest.plan.revision), Refusal)


def test_a_resumed_run_has_its_versions_and_ratings_and_none_that_are_newer_than_its_checkpoint(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.plan()
    run.train(0, 100)
    run.league.add(matches(NEWEST, "v0", 30))
    state = run.league.state()
    assert state is not None
    run.train(200, 300)
    saved = LeagueState.model_validate(json.loads(json.dumps(state.model_dump(mode="json"))))
    resumed = Run(tmp_path, version=150, state=saved)
    assert resumed.opponents == {"v0", "v100"}
    assert resumed.league.status() == LeagueStatus(players=state.players, scores=state.scores)
    assert sorted(each.name for each in (tmp_path / "league").iterdir()) == ["0000000000", "0000000100"]
    resumed.train(160, 190)
    assert resumed.opponents == {"v0", "v100"}
    resumed.train(200)  # a hundred env_steps after the last one that is kept
    assert resumed.opponents == {"v0", "v100", "v200"}


def damage(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1] + b"?")


@pytest.mark.parametrize("spoil", [damage, Path.unlink], ids=["damaged", "missing"])
@pytest.mark.parametrize("name", ["parameters.safetensors", "manifest.json"])
def test_a_version_that_cannot_be_read_plays_no_more(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[Path], None], name: str
) -> None:
    run = Run(tmp_path)
    run.plan()
    run.train(0, 100)
    spoil(tmp_path / "league" / "0000000000" / name)
    refusal = run.snapshot("v0")
    assert isinstance(refusal, Refusal)
    assert refusal.code == "unknown"
    assert run.opponents == {"v100"}
    assert isinstance(run.snapshot("v0"), Refusal)
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert line.startswith("version 0 of the league plays no more: ")


def test_a_full_disk_keeps_no_version_and_the_run_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "league").write_text("not a folder")
    run = Run(tmp_path)
    run.plan()
    run.train(0, 50, 99)
    (line,) = caplog.messages
    assert line.startswith("version 0 is not kept for the league: ")
    assert line.endswith("the next version is kept after 100 env_steps more")
    (tmp_path / "league").unlink()
    run.train(100)
    assert run.opponents == {"v100"}
    (tmp_path / "league" / "0000000100" / "parameters.safetensors").unlink()
    run.snapshot("v100")
    run.train(110)  # the league has no version any more
    assert run.opponents == {"v110"}


def test_another_run_is_an_opponent_with_a_program_of_its_own_which_stays(tmp_path: Path) -> None:
    other = save(tmp_path / "other", game_spec().environment, 3, 9)
    name = str(other)
    run = Run(tmp_path / "run", opponents={name: 0.5, "random": 0.0})
    assert run.opponents == {name}
    policy = find_policy(other)
    run.league.check_opponents(policy.spaces)
    snapshot = run.snapshot(name)
    assert isinstance(snapshot, Snapshot)
    assert snapshot.policy_version == 9
    assert run.league.program(snapshot.program) is not None
    save(other, game_spec().environment, 20)
    later = Run(tmp_path / "run", opponents={name: 0.5}).snapshot(name)
    assert isinstance(later, Snapshot)
    assert later.policy_version == 9  # ratings belong to one policy
    with pytest.raises(SettingsError, match=r"^league.opponents: the policy of .*/other is for other spaces: .+"):
        run.league.check_opponents(vector_spaces(3, 4))


@pytest.mark.parametrize("name", ["nowhere/at/all", "runs"])
def test_an_opponent_that_cannot_be_loaded_is_named_in_one_line(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where there are no runs
    with pytest.raises(
        SettingsError, match=rf"^league\.opponents: {name} cannot be loaded: {name} does not exist"
    ) as caught:
        Run(tmp_path, opponents={name: 0.5})
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------- results of rollouts


def judged(spec: RunSpec, results: Matches, league: League | None) -> Rollout | Rejected:
    judge = RolloutJudge(spec, EPOCH, joined_fleet("a"), league)
    verdict = judge.decide("a", judge.read("a", encode(make_rollout(matches=results))), 0, 1.0)
    assert isinstance(verdict, Rollout | Rejected)
    return verdict


@pytest.mark.parametrize(
    ("results", "reason"),
    [
        (matches(NEWEST, "v77"), ""),  # of a version that was dropped, or of a learner before this one
        (matches("v3", "random", purpose="rating"), ""),
        (matches(NEWEST, "a:Bot"), "matches name the player 'a:Bot', who is not in the league"),
        (matches("v03", "random"), "matches name the player 'v03', who is not in the league"),
        (matches(NEWEST, NEWEST), "matches has results of 'newest' against itself"),
        (matches(NEWEST, "random", 10**9), "it reports 1000000000 matches, and 0 before, but has played at most"),
    ],
)
def test_rollouts_with_results_of_others_or_impossible_ones_are_unfit(
    tmp_path: Path, results: Matches, reason: str
) -> None:
    verdict = judged(game_spec(), results, Run(tmp_path).league)
    assert isinstance(verdict, Rejected) == bool(reason)
    if isinstance(verdict, Rejected):
        assert (verdict.cause, reason in verdict.reason) == ("unfit", True)


players = st.sampled_from([NEWEST, "random", "v0", "v7"]) | st.text(min_size=1, max_size=9)
numbers = st.integers(0, 2**63 - 1)
counts = st.builds(
    MatchCount,
    purpose=st.sampled_from(["training", "rating"]),
    first=players,
    second=players,
    side=st.integers(0, 9),
    wins=numbers,
    draws=numbers,
    losses=numbers,
)


@given(st.lists(counts, max_size=4))
def test_whatever_matches_an_actor_sends_the_league_goes_on(results: list[MatchCount]) -> None:
    league = League(Path("nowhere"), game_spec(), EPOCH)
    league.open(0)
    sent = Matches(counts=tuple(results))
    assert isinstance(judged(game_spec(), sent, league), Rollout | Rejected)
    if not league.violation(sent):
        league.add(sent)
    status = league.status()
    assert status is None or all(math.isfinite(each.rating) for each in status.players)


def test_results_of_matches_are_unfit_where_there_is_no_game() -> None:
    verdict = judged(game_spec(), matches(NEWEST, "random"), None)
    assert isinstance(verdict, Rejected)
    assert verdict.reason == "matches is set, but the run plays no game with several agents"


class Sent:
    """Request with a rollout of actor a."""

    key = "rollouts/a"

    def __init__(self, rollout: Rollout) -> None:
        self.payload = encode(rollout)
        self.size = len(self.payload)
        self.answer: Message | None = None

    def reply(self, payload: bytes) -> None:
        self.answer = decode(payload, Limits())


@pytest.mark.parametrize(
    ("algorithm", "rollouts", "counted"),
    [
        ("impala", [(0, 50), (1, 10), (0, 50), (1, 10), (2, 50), (7, 51), (3, 50)], 1111),  # two are too old to learn
        ("a2c", [(0, 50), (1, 50), (0, 50), (1, 50), (2, 10)], 111),  # the batch has room for one
    ],
)
def test_each_rollout_counts_its_results_once_also_if_it_is_not_learned_from(
    tmp_path: Path, algorithm: str, rollouts: list[tuple[int, int]], counted: int
) -> None:
    spec = game_spec()
    training = spec.training.model_copy(update={"algorithm": algorithm})
    context = run_context(
        spec.model_copy(update={"training": training}), tmp_path, fleet=joined_fleet("a"), start_version=50
    )
    assert context.league is not None
    intake = RolloutIntake(context, lambda: 50)
    intake.open()
    try:
        for sequence, version in rollouts:
            results = matches(NEWEST, "random", 10**sequence)
            sent = Sent(make_rollout(identity("a", sequence), version=version, matches=results))
            intake.offer(sent)
            until(lambda sent=sent: sent.answer is not None)
    finally:
        with context.lock:
            intake.end(finished=False)
        intake.close()
    status = context.league.status()
    assert status is not None
    assert status.players[0].matches == counted


# ------------------------------------------------------------------------------------------------- whole runs


def test_an_actor_gets_plans_and_versions_and_the_ratings_are_in_the_status(tmp_path: Path) -> None:
    sections = {"environment": GAME, "policy": {"hidden": [8]}, "league": {"keep_env_steps": 200, "past_share": 0.5}}
    training_run = TrainingRun(tmp_path, **sections)
    reader = MemoryTransport(training_run.network)
    try:

        def status() -> LeagueStatus | None:
            answers = reader.query(keys.status("run"), timeout=LIMIT)
            report = decode(answers[0], Limits()) if answers else None
            return report.status.league if isinstance(report, StatusReport) else None

        def has_results() -> bool:
            league = status()
            return league is not None and sum(each.matches > 0 for each in league.players) > 3

        until(has_results)

        def plan_for(actor: str) -> object:
            request = encode(LeagueRequest(actor=actor))
            return decode(reader.query(keys.snapshots("run"), request, timeout=LIMIT)[0], Limits())

        assert isinstance(plan_for("stranger"), Refusal)  # it has not joined
        report = decode(reader.query(keys.status("run"), timeout=LIMIT)[0], Limits())
        assert isinstance(report, StatusReport)
        plan = plan_for(report.status.actors[0].actor)
        assert isinstance(plan, LeaguePlan)
        assert plan.plan.training[0].player == "v0"
        wanted = encode(LeagueRequest(actor="reader", player="v0"))
        snapshot = decode(reader.query(keys.snapshots("run"), wanted, timeout=LIMIT)[0], Limits())
        assert isinstance(snapshot, Snapshot)
        assert snapshot.policy_version == 0
    finally:
        training_run.end()
    saved = load_newest(training_run.directory).counters["league"]
    assert saved["players"][0]["player"] == NEWEST
    assert saved["players"][0]["matches"] > 0


def test_a_game_with_opponents_needs_openskill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openskill.models", None)
    run = Run(tmp_path)
    run.train(0)  # a game without opponents needs it not
    assert isinstance(run.plan(), Refusal)
    with pytest.raises(SettingsError, match=r'^ratings need openskill: pip install "daedalus-rl\[pettingzoo\]"$'):
        run.train(0)


def test_a_run_is_solved_by_a_win_rate(tmp_path: Path) -> None:
    training_run = TrainingRun(
        tmp_path,
        environment=GAME,
        policy={"hidden": [8]},
        training={"env_steps": 10**9, "algorithm": "impala"},
        league={"opponents": {"random": 0.5}, "past_share": 0, "target_opponent": "random", "target_win_rate": 0.3},
    )
    training_run.finish()
    assert json.loads((training_run.directory / "summary.json").read_text())["solved"]
    finished = finished_run(training_run.directory, training_run.spec)
    assert finished is not None
    assert finished.reason.startswith("the target, win rate 0.3 against random, was reached")
    higher = training_run.spec.league.model_copy(update={"target_win_rate": 0.98})
    assert finished_run(training_run.directory, training_run.spec.model_copy(update={"league": higher})) is None
