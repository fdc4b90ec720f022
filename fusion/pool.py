"""A channel that several takes recorded: one reading from all of them, what they scatter by being noise."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.consistency import fails
from fusion.manifest import ChannelEntry
from fusion.notices import Notice
from fusion.observe import Reading, added_up
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.phasor import Phasors

LEAST_SPREAD = 1e-9  # of the reading: below it, rounding looks like scatter


def pool_readings(takes: Sequence[tuple[str, Sequence[Reading]]]) -> tuple[tuple[Reading, ...], tuple[Notice, ...]]:
    """Return every channel of several takes (name and readings, referred to the first) once.

    The same channel at the same place, and the same output of the sensor, is pooled. Channels of one name that measured
    at different places remain rows of one instrument, each named by its take.
    """
    groups: dict[Hashable, list[tuple[str, Reading]]] = {}
    for name, readings in takes:
        for reading in readings:
            groups.setdefault(_identity(reading.entry), []).append((name, reading))
    names = [group[0][1].entry.name for group in groups.values()]
    found, notices = [], []
    for group in groups.values():
        (take, first), alone = group[0], names.count(group[0][1].entry.name) == 1
        pooled = _Pool.of([reading for _, reading in group])
        found.append(pooled.reading(first.entry if alone else _named(first.entry, take)))
        notices += pooled.notices(first.entry.name)
    return tuple(found), tuple(notices)


def _identity(entry: ChannelEntry) -> Hashable:
    """What makes channels of two takes the same: the sensor's output, or name and place of an instrument."""
    if entry.quantity == "output":
        return entry.channel
    return entry.name, entry.quantity, entry.body, entry.point, entry.direction, entry.common


def _named(entry: ChannelEntry, take: str) -> ChannelEntry:
    """Return a channel by the name of its take; the instrument keeps its name."""
    return entry.model_copy(update={"name": f"{take}: {entry.name}", "common": entry.common or entry.name})


@dataclass(frozen=True)
class _Pool:
    """Readings of one channel in T takes with their weights (T, K) and what they scatter by.

    `spread` (K,): standard deviation of one take's complex value beyond noise and drift; `failed` (K,): the scatter is
    beyond the 99 % quantile of what noise and drift make.
    """

    readings: tuple[Reading, ...]
    weight: FloatArray
    spread: FloatArray
    failed: NDArray[np.bool_]

    @classmethod
    def of(cls, readings: Sequence[Reading]) -> _Pool:
        """Weigh readings by their whole covariance over the takes.

        A complex value has one variance, the sum of those of its parts. Where chi-square is above its degrees of
        freedom, all takes get the variance that makes it equal to them (Paule & Mandel 1982, J. Res. NBS 87, 377).
        """
        lines = len(readings[0].phasors.frequency_hz)
        weight, spread = np.zeros((len(readings), lines)), np.zeros(lines)
        failed = np.zeros(lines, dtype=np.bool_)
        value = np.stack([reading.phasors.value[:, 0] for reading in readings])
        covariance = _between_takes(readings, value)
        for k in range(lines):
            takes = np.flatnonzero(np.isfinite(value[:, k]))
            if len(takes) == 1:
                weight[takes, k] = 1.0
            elif len(takes):
                own = covariance[k][np.ix_(takes, takes)]
                weight[takes, k], spread[k], failed[k] = _weighted(value[takes, k], own)
        return cls(tuple(readings), weight, spread, failed)

    def reading(self, entry: ChannelEntry) -> Reading:
        """Return one reading: noise of its own from noise and scatter, further errors by their names."""
        first = self.readings[0]
        if len(self.readings) == 1:
            return replace(first, entry=entry)
        further = [
            replace(error, relative=weight[:, None] * error.relative)
            for weight, reading in zip(self.weight, self.readings, strict=True)
            for error in reading.further
        ]
        return Reading(entry, self._phasors(entry), first.chain, added_up(further))

    def notices(self, name: str) -> list[Notice]:
        """Say where the takes differ by more than noise and drift make."""
        found = []
        for k in np.flatnonzero(self.failed):
            share = self.spread[k] / np.nanmax([abs(reading.phasors.value[k, 0]) for reading in self.readings])
            text = (
                f"{name} differs from take to take by {100.0 * share:.2g} % at "
                f"{self.readings[0].phasors.frequency_hz[k]:.6g} Hz (standard deviation beyond noise and drift); "
                "the scatter is part of its uncertainty"
            )
            found.append(Notice("warning", text, name))
        return found

    def _phasors(self, entry: ChannelEntry) -> Phasors:
        """Weighted mean with the covariance of noise and scatter, and its degrees of freedom (Welch-Satterthwaite)."""
        parts, square = [reading.phasors for reading in self.readings], self.weight**2
        known = np.any(self.weight != 0.0, axis=0)
        value = np.nansum([w * p.value[:, 0] for w, p in zip(self.weight, parts, strict=True)], axis=0)
        own = np.nan_to_num([s[:, None, None] * p.covariance for s, p in zip(square, parts, strict=True)])
        scatter = square.sum(axis=0) * self.spread**2
        covariance = own.sum(axis=0) + scatter[:, None, None] / 2.0 * np.eye(2)
        noise = np.trace(own, axis1=2, axis2=3)
        weighted = np.sum(noise**2 / np.maximum([p.dof for p in parts], 1.0), axis=0)
        weighted += scatter**2 / np.maximum(np.sum(self.weight != 0.0, axis=0) - 1.0, 1.0)
        total = np.trace(covariance, axis1=1, axis2=2)
        return Phasors(
            frequency_hz=parts[0].frequency_hz,
            value=np.where(known, value, complex(np.nan, np.nan))[:, None],
            covariance=np.where(known[:, None, None], covariance, np.nan),
            channels=(entry.name,),
            unit=parts[0].unit,
            dof=np.divide(total**2, weighted, out=np.full(len(total), np.inf), where=weighted > 0.0),
        )


def _between_takes(readings: Sequence[Reading], value: ComplexArray) -> FloatArray:
    """Return (K, T, T): covariances of the complex values, from noise and from what takes have in common.

    Relative errors count at the median amplitude, never at the reading itself.
    """
    size = np.array([np.median(np.abs(v[np.isfinite(v)])) if np.isfinite(v).any() else 0.0 for v in value.T])
    own = np.array([np.trace(reading.phasors.covariance, axis1=1, axis2=2) for reading in readings])
    own = np.nan_to_num(own) + (LEAST_SPREAD * size) ** 2
    covariance = np.einsum("tk,ts->kts", own, np.eye(len(readings)))
    names = dict.fromkeys(error.name for reading in readings for error in reading.further)
    place = {name: number for number, name in enumerate(names)}
    relative = np.zeros((len(names), len(readings), len(size)), dtype=np.complex128)
    for take, reading in enumerate(readings):
        for error in reading.further:
            relative[place[error.name], take] = error.relative[:, 0]
    shared = np.einsum("ntk,nsk->kts", relative, relative.conj()).real
    return np.asarray(covariance + shared * size[:, None, None] ** 2)


def _weighted(value: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, float, bool]:
    """Return the weights (T,) of complex values, the standard deviation they have beyond their covariance, and whether
    chi-square fails at 1 %."""
    from scipy.optimize import brentq

    dof = 2 * (len(value) - 1)

    def chi2(variance: float) -> float:
        whole = covariance + variance * np.eye(len(value))
        rest = value - _weights(whole) @ value
        return float(2.0 * np.vdot(rest, np.linalg.solve(whole, rest)).real)

    first = chi2(0.0)
    if first <= dof:
        return _weights(covariance), 0.0, False
    high = float(np.var(value)) * len(value)
    while chi2(high) > dof:
        high *= 2.0
    extra = float(brentq(lambda v: chi2(v) - dof, 0.0, high, rtol=1e-3, xtol=1e-12 * high))
    return _weights(covariance + extra * np.eye(len(value))), float(np.sqrt(extra)), fails(first, dof)


def _weights(covariance: FloatArray) -> FloatArray:
    """Weights (T,) of the best linear mean."""
    solved = np.linalg.solve(covariance, np.ones(len(covariance)))
    return np.asarray(solved / solved.sum())
