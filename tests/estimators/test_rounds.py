"""When rounds with plausible cameras end: stand-ins for the parts tell what each round finds."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from fmtorch.estimators.verbs import FocalParts, Verbs

ROUNDS = 6


@dataclasses.dataclass
class Rows:
    """Pairs by number; `same_size` of each."""

    number: list[int]

    def __len__(self) -> int:
        return len(self.number)

    @property
    def same_size(self) -> list[bool]:
        return [True] * len(self)

    def only(self, rows: list[int]) -> Rows:
        return Rows([self.number[i] for i in rows])


@dataclasses.dataclass
class Found:
    """The candidates of rounds, of which `again` (pairs, rounds) says whether each finds the best of those before."""

    rows: list[int]
    turn: int
    again: np.ndarray
    one_model: np.ndarray
    rounds: dict[int, int]

    def same_best(self, other: Found) -> list[bool]:
        return [bool(self.again[row, other.turn]) for row in self.rows]

    def joined(self, other: Found) -> Found:
        return other

    def only(self, rows: list[int]) -> Found:
        return dataclasses.replace(self, rows=[self.rows[i] for i in rows])

    def best_alone(self) -> Found:
        return self

    def replaced(self, rows: list[int], other: Found) -> Found:
        return self

    def selection(self, draws: int) -> SimpleNamespace:
        for row in self.rows:
            self.rounds[row] = self.turn + 1
        chosen = SimpleNamespace(F=None)
        chosen.replaced = lambda rows, other: chosen
        return chosen

    def unambiguous(self) -> list[bool]:
        return [bool(self.one_model[row, self.turn]) for row in self.rows]


def rounds_made(again: np.ndarray, one_model: np.ndarray, **options: int) -> list[int]:
    """How many rounds each pair has, all pairs together."""
    made: dict[int, int] = {}
    selection = SimpleNamespace(
        of_pool=lambda pool, pairs, refine: Found(pairs.number, pool.turn, again, one_model, made)
    )
    search = lambda pairs, start: SimpleNamespace(turn=start, draws=start)  # noqa: E731
    focal = FocalParts(selection, search, 1, ROUNDS, confident=lambda F, draws, pairs: [True] * len(pairs), **options)
    Verbs(None, None, None, focal).plausible(focal, Rows(list(range(len(again)))))
    return [made[row] for row in range(len(again))]


def expected(again: np.ndarray, one_model: np.ndarray, least: int, confirmations: int) -> int:
    """Rounds of one pair, one after the other."""
    confirmed = 0
    for turn in range(ROUNDS):
        if turn:
            confirmed += again[turn]
        if turn + 1 >= least and (one_model[turn] or confirmed >= confirmations):
            return turn + 1
    return ROUNDS


@pytest.mark.parametrize("confirmations", [1, 2, 3])
@pytest.mark.parametrize("least", [1, 3])
def test_rounds_end_when_enough_of_them_confirm_the_best(least: int, confirmations: int) -> None:
    rng = np.random.default_rng(confirmations)
    again, one_model = rng.random((200, ROUNDS)) < 0.4, rng.random((200, ROUNDS)) < 0.05
    options = {"min_rounds": least, "confirmations": confirmations}
    each = [expected(a, o, least, confirmations) for a, o in zip(again, one_model, strict=True)]
    assert rounds_made(again, one_model, **options) == each
    assert [rounds_made(again[i : i + 1], one_model[i : i + 1], **options)[0] for i in range(20)] == each[:20]
    assert len(set(each)) > 2
