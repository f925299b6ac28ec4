"""benchmarks/game_opponents.py: the solved tic-tac-toe, and the search of Connect Four against a plain one."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from daedalus.actor.environments.bots import make_bot
from daedalus.actor.environments.games import make_games
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spec import EnvironmentSpec

sys.path.append(str(Path(__file__).parents[2]))  # where benchmarks/ is
opponents = importlib.import_module("benchmarks.game_opponents")
STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
PLAYERS = {1: opponents.ConnectFourDepth1, 2: opponents.ConnectFourDepth2, 4: opponents.ConnectFourDepth4}


def winner(board: np.ndarray) -> int:
    """Return the stone that has four in a line on a board of 0, 1 and -1, or 0."""
    for row, column in np.ndindex(6, 7):
        for down, right in STEPS:
            end = row + 3 * down, column + 3 * right
            if end[0] < 6 and 0 <= end[1] < 7:
                line = [board[row + step * down, column + step * right] for step in range(4)]
                if line[0] and len(set(line)) == 1:
                    return int(line[0])
    return 0


def legal(board: np.ndarray) -> list[int]:
    return [column for column in range(7) if not board[0, column]]


def after(board: np.ndarray, column: int) -> np.ndarray:
    """Return the board after a move, as the other player sees it: own stones are 1."""
    moved = board.copy()
    moved[np.flatnonzero(board[:, column] == 0)[-1], column] = 1
    return -moved


def worth(board: np.ndarray, depth: int) -> int:
    """Return what a player to move who sees `depth` moves can reach: 100 - n for a win with the n-th move from now."""
    if winner(board):
        return -101
    if depth == 0 or not legal(board):
        return 0
    value = max(-worth(after(board, column), depth - 1) for column in legal(board))
    return value - (value > 0) + (value < 0)


def planes(board: np.ndarray) -> np.ndarray:
    return np.stack([board == 1, board == -1], axis=2).astype(np.int8)


def moves(board: np.ndarray, depth: int) -> set[int]:
    """Return the moves that a player of this depth draws from."""
    values = PLAYERS[depth]().values(planes(board), legal(board))
    return {column for column in values if values[column] == max(values.values())}


def test_search_takes_the_moves_of_a_plain_search() -> None:
    random, compared = np.random.default_rng(7), 0
    while compared < 25:
        board = np.zeros((6, 7), np.int8)
        for _ in range(random.integers(8, 41)):
            if not winner(board) and len(legal(board)) > 1:
                board = after(board, int(random.choice(legal(board))))
        if winner(board):
            continue
        compared += 1
        for depth in (1, 2, 4) if len(legal(board)) < 4 else (1, 2):
            values = {column: -worth(after(board, column), depth - 1) for column in legal(board)}
            assert moves(board, depth) == {column for column in values if values[column] == max(values.values())}


def test_each_depth_sees_as_far_as_its_name_says() -> None:
    board = np.zeros((6, 7), np.int8)
    board[5, 2:4] = 1  # two in the middle of the lowest row: a third makes a double threat
    assert moves(board, 1) == moves(board, 2) == set(range(7))
    assert moves(board, 4) == {1, 4}
    assert moves(-board, 4) == {1, 4}  # the only moves that prevent both
    board[5, 4] = 1
    board[5, 5] = -1
    assert moves(board, 1) == {1}
    assert moves(-board, 2) == {1}


@pytest.mark.parametrize(("stones", "is_four"), [((0, 1, 2, 3), True), ((3, 4, 5, 7), False), ((5, 6, 7, 8), True)])
def test_lines_end_at_the_border(stones: tuple[int, ...], is_four: bool) -> None:
    assert opponents.has_four(sum(1 << cell for cell in stones)) is is_four
    own, other = opponents.connect_four_board(np.ones((6, 7, 2), np.int8))
    assert own == other == sum(1 << column * 7 + row for column in range(7) for row in range(6))


def results(first: str, second: str, matches: int) -> list[float]:
    """Return the returns of the first player of tic-tac-toe."""
    spec = EnvironmentSpec(id="pettingzoo.classic.tictactoe_v3", backend="pettingzoo")
    games = make_games(spec, 1, NO_MODULES)
    for seat, name in enumerate((first, second)):
        games.seat_bot(seat, make_bot(name, games.action_space, UserModules(frozenset({"benchmarks.game_opponents"}))))
    games.reset(3)
    returns, total = list[float](), 0.0
    while len(returns) < matches:
        total += games.step(np.zeros(2, np.int64))[1][0]
        if games.over[0]:
            returns.append(total)
            total = 0.0
    games.close()
    return returns


def test_perfect_tic_tac_toe_never_loses_and_beats_random_moves() -> None:
    perfect = "benchmarks.game_opponents:PerfectTicTacToe"
    assert set(results(perfect, perfect, 20)) == {0.0}
    as_first, as_second = results(perfect, "random", 60), results("random", perfect, 60)
    assert min(as_first) >= 0.0
    assert max(as_second) <= 0.0
    assert sum(as_first) > 40
    assert sum(as_second) < -30
