"""Pulses of a trigger that come twice: the first edge counts, and what cannot be told apart is refused."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest

from shaker.timebase.edges import find_edges
from shaker.timebase.trigger import fit_trigger
from shakercal._common.arrays import FloatArray

RATE_HZ, START_S, PERIOD_S, PULSES = 25_600.0, 0.01234, 1.0 / 21.3, 24
Pulse = Sequence[tuple[float, float]]


def _signal(pulses: Sequence[Pulse], edge: str) -> FloatArray:
    """Sample pulses that are each high from and to some times after its true edge."""
    time = np.arange(int((START_S + PULSES * PERIOD_S + 0.05) * RATE_HZ)) / RATE_HZ
    high = np.zeros(len(time), dtype=np.bool_)
    for k, pulse in enumerate(pulses):
        for begin, end in pulse:
            high |= (time >= START_S + k * PERIOD_S + begin) & (time < START_S + k * PERIOD_S + end)
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(time))
    return np.asarray(noise + np.where(high == (edge == "rising"), 5.0, 0.0))


def _some(share: float, bounced: Pulse) -> list[Pulse]:
    chosen = np.random.default_rng(7).permutation(PULSES) < share * PULSES
    return [bounced if one else [(0.0, 2e-3)] for one in chosen]


TWICE: Pulse = [(0.0, 2e-4), (3.5e-4, 2e-3)]


@pytest.mark.parametrize("edge", ["rising", "falling"])
@pytest.mark.parametrize(
    ("pulses", "doubled"),
    [
        ([TWICE] * PULSES, 24),
        ([[(0.0, 1e-3), (0.12 * PERIOD_S, 0.12 * PERIOD_S + 1e-3)]] * PULSES, 24),
        ([[(0.0, 3e-4), (6e-4, 8e-4), (9.5e-4, 2e-3)]] * PULSES, 48),
        ([[(0.0, 2e-3), (2.3e-3, 2.6e-3)]] * PULSES, 24),
        ([[(0.0, 0.5 * PERIOD_S), (0.5 * PERIOD_S + 3e-4, 0.5 * PERIOD_S + 6e-4)]] * PULSES, 24),
        ([[(0.0, 0.95 * PERIOD_S)]] * PULSES, 0),
        *((_some(share, TWICE), round(share * PULSES)) for share in (0.125, 0.25, 0.5, 0.75)),
    ],
)
def test_the_first_edge_of_bouncing_pulses_counts(
    pulses: list[Pulse], doubled: int, edge: Literal["rising", "falling"]
) -> None:
    fit = fit_trigger(find_edges(_signal(pulses, edge), RATE_HZ, edge=edge))
    assert (fit.edges, fit.doubled, fit.spurious, fit.missing) == (PULSES, doubled, 0, ())
    assert abs(fit.start_s - START_S) < 3.0 * float(fit.u_time_s(np.asarray(0))) < 1e-5
    assert fit.period_s == pytest.approx(PERIOD_S, rel=1e-5)


@pytest.mark.parametrize("distance", [0.22, 0.3, 0.4])
def test_two_pulses_at_comparable_distances_are_refused(distance: float) -> None:
    """Of two cameras on one line, or of pulses that come twice, no distance says which edges are meant."""
    gap_s = distance * PERIOD_S
    edges = find_edges(_signal([[(0.0, 1e-3), (gap_s, gap_s + 1e-3)]] * PULSES, "rising"), RATE_HZ)
    with pytest.raises(ValueError, match=r"^edges: .*alternate") as refused:
        fit_trigger(edges)
    distances = [float(number) for number in re.findall(r"\d+\.\d+", str(refused.value))]
    assert distances == pytest.approx([gap_s, PERIOD_S - gap_s], abs=1.0 / RATE_HZ)


def test_bursts_and_lost_pulses_are_no_bounces() -> None:
    pulse: Pulse = [(0.0, 1e-3)]
    for present in (lambda k: k % 10 < 5, lambda k: k not in (5, 9)):
        fit = fit_trigger(find_edges(_signal([pulse if present(k) else [] for k in range(PULSES)], "rising"), RATE_HZ))
        assert (fit.doubled, fit.spurious) == (0, 0)
        assert fit.period_s == pytest.approx(PERIOD_S, rel=1e-4)
