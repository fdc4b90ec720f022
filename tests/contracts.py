"""What every estimator owes: its regions hold the truth as often as they say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.stats import binom, chi2

from photogram.device import resolve_device

LEVEL = 0.95
CHANCE = 1e-3
"""Chance that a perfect estimator fails a contract."""

NEEDS_GPU = pytest.mark.skipif(resolve_device("auto") == "cpu", reason="no GPU that torch can use")


def acceptance(trials: int, values: int = 1) -> tuple[int, int]:
    """Return the fewest and the most of `trials` that a perfect estimator's regions hold, over several values."""
    tail = 0.5 * CHANCE / values
    return int(binom.ppf(tail, trials, LEVEL)), int(binom.isf(tail, trials, LEVEL))


def coverage_contract(
    estimate: Callable[[int], tuple[ArrayLike, ArrayLike]], truth: ArrayLike, trials: int, *, cautious: bool = False
) -> np.ndarray:
    """Assert that 95 % regions hold the truth as often as those of a perfect estimator, and return how often (Q,).

    `estimate(trial)` returns the values (Q,) of one trial with their expanded uncertainties U (Q,), or with their
    covariance (Q, Q): then the one region is the ellipsoid of all of them. Complex values count as Re and Im.
    `cautious`: regions may hold the truth more often, as those do that cover what one trial cannot tell.
    """
    true, inside = _real(truth), []
    for trial in range(trials):
        value, spread = estimate(trial)
        off, size = _real(value) - true, np.asarray(spread, dtype=np.float64)
        if size.ndim == 2:
            inside.append([off @ np.linalg.solve(size, off) <= chi2.ppf(LEVEL, len(off))])
        else:
            inside.append(np.abs(off) <= np.atleast_1d(size))
    covered = np.sum(inside, axis=0)
    fewest, most = acceptance(trials, len(covered))
    counts = f"{covered.tolist()} of {trials} trials, expected {fewest} to {most}"
    assert np.all(covered >= fewest), f"regions too small: they contain the truth in {counts}"
    assert cautious or np.all(covered <= most), f"regions too large: they contain the truth in {counts}"
    return np.asarray(covered / trials)


def _real(values: ArrayLike) -> np.ndarray:
    """Return values as real ones (Q,)."""
    flat = np.atleast_1d(np.asarray(values)).ravel()
    return np.concatenate([flat.real, flat.imag]) if np.iscomplexobj(flat) else flat.astype(np.float64)


def refused(words: str, call: Callable[..., object], /, *arguments: Any, error: Any = ValueError, **named: Any) -> Any:
    """Return the error of a call with these arguments; its text matches `words`, a regular expression."""
    with pytest.raises(error, match=words) as caught:
        call(*arguments, **named)
    return caught.value


def slow(*cases: Any) -> list[Any]:
    """Return further cases of a parametrisation, values or tuples of them, that only `make validate` tries."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow) for case in cases]
