"""Exploitability in small poker games: self-play against the newest policy only, and with a league of past versions.

    pip install open_spiel openskill
    python -m benchmarks.poker --file build/poker.csv --games kuhn --seeds 11 12 13 14 15
    python -m benchmarks.poker --file build/poker.csv --table

Exploitability is OpenSpiel's: the mean over both seats of what a best response wins against the policy, in chips a
match. The equilibrium has 0, uniform play 0.458 in Kuhn poker and 2.374 in Leduc poker. `newest` is that of the last
policy, `average` that of the kept versions of the run together: one of them is drawn before each match. Both kinds of
runs keep as many versions.
"""

import argparse
import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyspiel  # pyright: ignore[reportMissingImports]
from open_spiel.python.algorithms.exploitability import exploitability  # pyright: ignore[reportMissingImports]
from open_spiel.python.policy import TabularPolicy  # pyright: ignore[reportMissingImports]

from benchmarks.recorded_runs import RecordedRuns
from benchmarks.running import machine, table, train_in
from daedalus.analysis.comparison import estimate, written
from daedalus.learner.league.versions import VersionFolder
from daedalus.policy.acting.value_estimator import ValueEstimator
from daedalus.policy.saving.saved_policy import SavedPolicy, find_policy
from daedalus.policy.user_modules import NO_MODULES

_GAMES = {"kuhn": "kuhn_poker", "leduc": "leduc_poker"}
_VARIANTS = {"newest only": ("league.past_share=0",), "league": ()}
_IDENTITY, _RESULTS = ("game", "env_steps", "variant", "seed"), ("newest", "average", "versions", "seconds")


def tabular(saved: SavedPolicy, game: Any) -> TabularPolicy:
    """Return the probabilities that a policy gives the actions in all information states of both players."""
    policy = TabularPolicy(game)
    known = np.array([s.information_state_tensor(s.current_player()) for s in policy.states], np.float32)
    (observation,), (action,) = saved.spaces.observations, saved.spaces.actions
    masks = {action: policy.legal_actions_mask.astype(np.bool_)}
    outputs = ValueEstimator(saved, NO_MODULES).outputs({observation: known}, masks)
    assert outputs is not None
    policy.action_probability_array = outputs.probabilities[action][:, 0, :].astype(np.float64)
    return policy


def average(policies: Sequence[TabularPolicy], game: Any) -> TabularPolicy:
    """Return the policy that plays as one of these, drawn before each match.

    In an information state, each counts as often as its own actions lead there.
    """
    result = TabularPolicy(game)
    total = np.zeros_like(result.action_probability_array)

    def visit(state: Any, reaches: np.ndarray, seen: set[int]) -> None:
        """`reaches` [policies, 2]: the probability of the actions of each player on the way."""
        if state.is_terminal():
            return
        if state.is_chance_node():
            for outcome, _ in state.chance_outcomes():
                visit(state.child(outcome), reaches, seen)
            return
        player, row = state.current_player(), result.state_index(state)
        rows = np.stack([policy.action_probability_array[row] for policy in policies])
        if row not in seen:  # other histories of the same information state have the same own reach
            seen.add(row)
            total[row] = reaches[:, player] @ rows
        for action in state.legal_actions():
            after = reaches.copy()
            after[:, player] *= rows[:, action]
            visit(state.child(action), after, seen)

    visit(game.new_initial_state(), np.ones((len(policies), 2)), set())
    sums = total.sum(1, keepdims=True)
    result.action_probability_array = np.where(
        sums > 0.0, total / np.maximum(sums, 1e-30), result.action_probability_array
    )
    return result


def measured(game_name: str, variant: str, seed: int, env_steps: int) -> dict[str, str]:
    """Train once, and return the results."""
    game = pyspiel.load_game(_GAMES[game_name])
    name = f"environment.kwargs.game={_GAMES[game_name]}"
    settings = ("environment.backend=pettingzoo", name, *_VARIANTS[variant], "evaluation.final_episodes=1")
    words = [word for setting in settings for word in ("--set", setting)]
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        summary = train_in(
            run, "--env", "examples.open_spiel_game:OpenSpielGame", "--seed", seed, "--env-steps", env_steps, *words
        )
        newest = find_policy(run, newest=True)
        kept = VersionFolder(run / "league")
        versions = [dataclasses.replace(newest, weights=kept.read(each.policy_version)) for each in kept.versions()]
    tables = [tabular(each, game) for each in versions[1:]]  # without the first, which has learnt nothing
    return {
        "newest": f"{exploitability(game, tabular(newest, game)):.4f}",
        "average": f"{exploitability(game, average(tables, game)):.4f}",
        "versions": str(len(tables)),
        "seconds": f"{summary['wall_seconds']:.0f}",
    }


def results(runs: RecordedRuns) -> str:
    """Return the table of the runs so far: interquartile means with 95 % intervals."""
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for line in runs.read():
        groups.setdefault((line["game"], line["env_steps"], line["variant"]), []).append(line)
    rows = [
        [*group, len(lines)]
        + [
            written(estimate([np.array([float(line[name]) for line in lines])]), "{:.3f}".format)
            for name in _RESULTS[:2]
        ]
        for group, lines in sorted(groups.items())
    ]
    return table(("game", "env_steps", "variant", "runs", "exploitability of the newest", "of the average"), rows)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--file", type=Path, required=True, help="CSV file of the runs")
    options.add_argument("--games", nargs="+", choices=_GAMES, default=list(_GAMES))
    options.add_argument("--seeds", nargs="+", type=int, default=list(range(11, 21)))
    options.add_argument("--env-steps", type=int, default=500_000)
    options.add_argument("--table", action="store_true", help="only print the table of the runs so far")
    parsed = options.parse_args()
    runs = RecordedRuns(parsed.file, _IDENTITY, _RESULTS)
    for seed in () if parsed.table else parsed.seeds:
        for game in parsed.games:
            wanted = [
                {"game": game, "env_steps": parsed.env_steps, "variant": variant, "seed": seed} for variant in _VARIANTS
            ]
            for run in runs.missing(wanted):
                line = {**run, **measured(game, run["variant"], seed, parsed.env_steps)}
                runs.add(line)
                print(", ".join(str(value) for value in line.values()), flush=True)
    print(machine())
    print(results(runs))


if __name__ == "__main__":
    main()
