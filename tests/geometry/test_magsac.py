"""The tables of MAGSAC++: right, and the same bits on every processor."""

from __future__ import annotations

import hashlib

import numpy as np
from scipy.special import gamma, gammainc

from fmtorch.geometry.robust_losses import ENTRIES, GAIN_TABLE, LOSS_TABLE, QUANTILE

END = QUANTILE**2 / 2


def lower(s: float, x: np.ndarray | float) -> np.ndarray:
    return gammainc(s, x) * gamma(s)


def test_the_table_of_weights_and_losses() -> None:
    u = np.arange(ENTRIES + 1) / ENTRIES
    # Some forty roundings of numbers up to 1, here and in the reference.
    np.testing.assert_allclose(LOSS_TABLE[0, :-1], 1 - lower(1.5, u * END) / lower(1.5, END), rtol=0, atol=40 * 2**-53)
    assert (LOSS_TABLE[0, 0], LOSS_TABLE[0, -2], LOSS_TABLE[0, -1]) == (1, 0, 0)
    sums = np.concatenate([[0], np.cumsum((LOSS_TABLE[0, :-2] + LOSS_TABLE[0, 1:-1]) / 2)]) / ENTRIES
    np.testing.assert_allclose(LOSS_TABLE[1, :-1], sums, rtol=ENTRIES * 2**-53)


def test_the_table_of_gains() -> None:
    u = (np.arange(ENTRIES) + 0.5) / ENTRIES
    x = np.append(u, 1) * END
    loss = lower(2.5, x) / 2 + x / 2 * (lower(1.5, END) - lower(1.5, x))
    table = GAIN_TABLE
    np.testing.assert_allclose(table[:-1], 1 - loss[:-1] / loss[-1], rtol=0, atol=2**-24 + 40 * 2**-53)
    assert table[-1] == 0


def test_the_tables_have_the_same_bits_everywhere() -> None:
    assert digest(LOSS_TABLE) == "deeedca20dc708b5"
    assert digest(GAIN_TABLE) == "e7fdff710ef5cc3d"


def digest(table: np.ndarray) -> str:
    return hashlib.sha256(table.tobytes()).hexdigest()[:16]
