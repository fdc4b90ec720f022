"""Comparison of what lets go: which release is fastest, and which repeats best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray
from shaker.models.step.reading import Reading


@dataclass(frozen=True)
class Spread:
    """Mean of one quantity over releases with its standard uncertainty, and the standard deviation of a single one.

    `u_mean` has `dof` degrees of freedom: infinite where the readings' own uncertainties are all that is known of one
    release, whose `repeatability` is NaN. `u_repeatability` is s/√(2(n - 1)).
    """

    mean: float
    u_mean: float
    repeatability: float
    u_repeatability: float
    dof: float


@dataclass(frozen=True)
class ReleaseKind:
    """Releases by one means, `release`: how many, their rise time and the length of the release in s.

    `rank` 1 has the shortest rise time. `faster`: probability that it rises faster than the next rank does, from
    Welch's t; NaN of the last one and where one release alone does not tell how it repeats.
    """

    release: str
    count: int
    rise: Spread
    length: Spread
    rank: int
    faster: float


def compare_releases(readings: Sequence[Reading]) -> tuple[ReleaseKind, ...]:
    """Return the kinds of release among readings of one output and one component, by rank."""
    places = {(reading.channel, reading.component) for reading in readings}
    if len(places) != 1:
        found = ", ".join(f"{channel} under {component}" for channel, component in sorted(places)) or "none"
        raise ValueError(f"readings: expected those of one output under one component, found {found}")
    names = dict.fromkeys(reading.release for reading in readings)
    spreads = {}
    for name in names:
        own = [reading for reading in readings if reading.release == name]
        rise = _spread([r.rise_s for r in own], [r.u_rise_s for r in own])
        spreads[name] = len(own), rise, _spread([r.release_s for r in own], [r.u_release_s for r in own])
    order = sorted(names, key=lambda name: spreads[name][1].mean)
    following: list[str | None] = [*order[1:], None]
    return tuple(
        ReleaseKind(
            name, *spreads[name], rank, np.nan if other is None else _faster(spreads[name][1], spreads[other][1])
        )
        for rank, (name, other) in enumerate(zip(order, following, strict=True), 1)
    )


def _spread(values: Sequence[float], u: Sequence[float]) -> Spread:
    """Return mean and scatter of values; the mean is no better known than the values' own uncertainties allow."""
    value: FloatArray = np.asarray(values, dtype=np.float64)
    count = len(value)
    own = float(np.sqrt(np.sum(np.square(u)))) / count
    if count == 1:
        return Spread(float(value[0]), own, np.nan, np.nan, np.inf)
    scatter = float(np.std(value, ddof=1))
    u_mean = scatter / np.sqrt(count)
    dof = float(count - 1) if u_mean >= own else np.inf
    return Spread(float(value.mean()), max(u_mean, own), scatter, scatter / np.sqrt(2.0 * (count - 1)), dof)


def _faster(one: Spread, other: Spread) -> float:
    """Return the probability that one mean is below another (Welch 1947), NaN where one release has no scatter."""
    from scipy.stats import t

    if np.isnan(one.repeatability) or np.isnan(other.repeatability):
        return float("nan")
    parts = np.array([one.u_mean**2, other.u_mean**2])
    dofs = np.array([one.dof, other.dof])
    total = float(parts.sum())
    if total == 0.0:
        return 1.0 if other.mean > one.mean else 0.5
    inverse = float(np.sum(parts**2 / dofs)) / total**2
    dof = 1.0 / inverse if inverse > 0.0 else np.inf
    return float(t.cdf((other.mean - one.mean) / np.sqrt(total), dof))
