"""Opponents of known strength for board games, as bots.

    daedalus evaluate RUN --against benchmarks.game_opponents:PerfectTicTacToe --allow-module benchmarks.game_opponents

`PerfectTicTacToe` takes one of the best moves of the solved game. The Connect Four players search a fixed number of
moves ahead; a position without a forced end within these moves is worth nothing to them. All draw uniformly from moves
of the same worth. A win counts more the sooner it comes, and a loss the later.

A board is the pair of the stones of the player to move and of the other, each an integer with one bit for each cell.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np

_WIN = 100  # beyond the number of moves of any game here
_LINES = tuple(sum(1 << cell for cell in line) for line in (
    (0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6),
))  # fmt: skip
_ROWS, _COLUMNS = 6, 7
_HEIGHT = _ROWS + 1  # bits of a column, the uppermost of which is always empty: lines do not run into the next column
_MIDDLE_FIRST = (3, 2, 4, 1, 5, 0, 6)  # good moves first: the search cuts off more


@cache
def tic_tac_toe_value(own: int, other: int) -> int:
    """Return what perfect play from both sides gives the player to move: more than 0 is a win, 0 a draw."""
    if any(line & other == line for line in _LINES):
        return -_WIN
    moves = [move for move in range(9) if not (own | other) >> move & 1]
    return max((tic_tac_toe_move_value(own, other, move) for move in moves), default=0)


def tic_tac_toe_move_value(own: int, other: int, move: int) -> int:
    """Return the same for one move; an end that is one move further away is worth one less."""
    after = -tic_tac_toe_value(other, own | 1 << move)
    return after - (after > 0) + (after < 0)


class _BoardPlayer:
    """Bot that draws from the legal moves of the largest worth."""

    def __init__(self) -> None:
        self._random = np.random.default_rng()

    def reset(self, agent: str, seed: int) -> None:
        """Begin a match."""
        self._random = np.random.default_rng(seed)

    def act(self, observation: Any, action_mask: Any) -> int:
        """Return a move. The observation is PettingZoo's: [rows, columns, 2], the own stones first."""
        planes = observation["observation"] if isinstance(observation, Mapping) else observation
        moves = [int(move) for move in np.flatnonzero(action_mask)]
        values = self.values(np.asarray(planes), moves)
        return int(self._random.choice([move for move in moves if values[move] == max(values.values())]))

    def values(self, planes: np.ndarray, moves: list[int]) -> dict[int, int]:
        """Return the worth of each move; below the largest, it may be an upper bound."""
        raise NotImplementedError


class PerfectTicTacToe(_BoardPlayer):
    """Player that never loses, and wins if it can."""

    def values(self, planes: np.ndarray, moves: list[int]) -> dict[int, int]:
        """See _BoardPlayer."""
        own, other = (_bits(planes[:, :, side].reshape(-1)) for side in (0, 1))
        return {move: tic_tac_toe_move_value(own, other, move) for move in moves}


class _ConnectFourPlayer(_BoardPlayer):
    depth: ClassVar[int]  # moves ahead, of both players together

    def values(self, planes: np.ndarray, moves: list[int]) -> dict[int, int]:
        """See _BoardPlayer."""
        own, other = connect_four_board(planes)
        best, values = -_WIN, dict[int, int]()
        for move in moves:
            values[move] = _move_value(own, other, move, self.depth, best - 1, _WIN)  # exact from `best` on
            best = max(best, values[move])
        return values


class ConnectFourDepth1(_ConnectFourPlayer):
    """Player that wins at once where it can, and else moves at random."""

    depth = 1


class ConnectFourDepth2(_ConnectFourPlayer):
    """Player that also prevents the opponent's win with the next move."""

    depth = 2


class ConnectFourDepth4(_ConnectFourPlayer):
    """Player that searches two moves of each side: it makes and prevents double threats."""

    depth = 4


def connect_four_board(planes: np.ndarray) -> tuple[int, int]:
    """Return the stones of the player to move and of the other, bit `column * 7 + height`, from [6, 7, 2] of 0 and 1.

    The first row of the observation is the uppermost of the board.
    """
    padded = np.zeros((2, _COLUMNS, _HEIGHT), np.bool_)
    padded[:, :, :_ROWS] = planes[::-1].transpose(2, 1, 0)
    return _bits(padded[0].reshape(-1)), _bits(padded[1].reshape(-1))


def has_four(stones: int) -> bool:
    """Return whether there are four in a line: vertical, horizontal, or diagonal."""
    for step in (1, _HEIGHT, _HEIGHT - 1, _HEIGHT + 1):
        pairs = stones & stones >> step
        if pairs & pairs >> 2 * step:
            return True
    return False


def _move_value(own: int, other: int, column: int, depth: int, low: int, high: int) -> int:
    """Return the worth of a move by alpha-beta search, exact between `low` and `high`."""
    taken = own | other
    moved = own | ((taken + (1 << column * _HEIGHT)) & ~taken & _column(column))
    if has_four(moved):
        return _WIN
    if depth == 1:
        return 0
    if taken | moved == _FULL:
        return 0
    best, enough = -_further(high), -_further(low)  # of the reply, which is one move further away
    for reply in _MIDDLE_FIRST:
        if not (taken | moved) >> (reply * _HEIGHT + _ROWS - 1) & 1:
            best = max(best, _move_value(other, moved, reply, depth - 1, best, enough))
            if best >= enough:
                break
    return -best + (best > 0) - (best < 0)


def _further(value: int) -> int:
    """Return the bound of a reply's worth for a bound of the move's: the worth of the reply counts one less."""
    return value + (value > 0) - (value < 0)


def _column(column: int) -> int:
    return ((1 << _ROWS) - 1) << column * _HEIGHT


_FULL = sum(_column(column) for column in range(_COLUMNS))


def _bits(cells: np.ndarray) -> int:
    """Return an integer with a bit for each cell [n], the first of them the lowest."""
    return int.from_bytes(np.packbits(cells.astype(np.bool_), bitorder="little").tobytes(), "little")
