"""The unknowns of an identification in one vector, and the whitened residuals of every recording with derivatives."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray, IntArray
from shaker.models.identification.mechanics import Mechanics, Parameter, Structure, respond
from shaker.models.identification.sights import Sights, acting, sights
from shaker.models.measured import MeasuredTransfer

DELAY_UNIT_S = 1e-6  # in which free delays are unknown


@dataclass(frozen=True)
class Curve:
    """One recording ready to be compared: which unknowns act on it and how.

    `terms` (P+E,): places of the weights of `mechanics` among the unknowns; `factors` (F,) those of what multiplies the
    ratios by exp(z · `relative` (K, C, F)); `sights`: what transducers elsewhere than stated change; `clock`: place of
    the clock's error, -1 without. `whitening` (K, 2C, 2C).
    """

    record: MeasuredTransfer
    mechanics: Mechanics
    terms: IntArray
    factors: IntArray
    relative: ComplexArray
    sights: Sights
    clock: int
    whitening: FloatArray

    def weights(self, vector: FloatArray) -> FloatArray:
        """Return the weights (1+P+E,) of the mechanics' terms."""
        return np.concatenate([[1.0], vector[self.terms]])

    @property
    def places(self) -> IntArray:
        """Places of the columns of `modelled` among the unknowns."""
        clock = [self.clock] if self.clock >= 0 else []
        return np.concatenate([self.terms, self.factors, self.sights.places, np.array(clock, dtype=np.int64)])

    def modelled(self, vector: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the ratios (K, C) that unknowns lead to, and their derivatives (K, C, L) by those at `places`."""
        u_clock = self.record.u_clock if self.clock >= 0 else 0.0
        s = self.record.s * (1.0 + u_clock * vector[self.clock])
        found = respond(self.sights.moved(self.mechanics, vector), self.weights(vector), s)
        factor = np.exp(self.relative @ vector[self.factors])
        value = found.value * factor
        seen = self.sights.derivatives(found) * factor[:, :, None]
        columns = [found.by_term * factor[:, :, None], value[:, :, None] * self.relative, seen]
        if self.clock >= 0:
            columns.append((u_clock * found.by_log_s * factor)[:, :, None])
        return value, np.concatenate(columns, axis=2)

    def whitened(self, deviation: ComplexArray) -> FloatArray:
        """Return complex deviations (K, C, L) as independent real ones of variance one, (K, 2C, L)."""
        return np.asarray(self.whitening @ np.concatenate([deviation.real, deviation.imag], axis=1))


@dataclass(frozen=True)
class Problem:
    """All recordings and all unknowns (N,): parameters first, then free factors, then named errors.

    `parameters`: what is fitted, with `kind` (P,) the place in the structure. `names` (N,). A priori an unknown is
    `expected` (N,) with `precision` (N,) = 1/u², zero without knowledge; `fixed` (N,) ones stay there.
    """

    curves: tuple[Curve, ...]
    parameters: tuple[Parameter, ...]
    kind: IntArray
    names: tuple[str, ...]
    expected: FloatArray
    precision: FloatArray
    fixed: BoolArray

    def weighed(self, factors: Sequence[FloatArray]) -> Problem:
        """Return the problem with the covariances of its lines times `factors` (K,) per recording."""
        curves = [
            replace(curve, whitening=curve.whitening / np.sqrt(factor)[:, None, None])
            for curve, factor in zip(self.curves, factors, strict=True)
        ]
        return replace(self, curves=tuple(curves))


def build(
    records: Sequence[MeasuredTransfer],
    structure: Structure,
    known: Mapping[str, tuple[float, float]],
    each_recording: Collection[str],
    gain: Collection[str],
    delay: Collection[str],
) -> Problem:
    """Return recordings and unknowns in the form that is solved."""
    _check(records, structure, known, each_recording, [*gain, *delay])
    parameters, kinds, places = _parameters(records, structure, each_recording)
    names = {parameter.name: place for place, parameter in enumerate(parameters)}
    factors = [_free(record, gain, delay) for record in records]
    for free in factors:
        for name in free:
            names[name] = len(names)
    first_error = len(names)
    for record in records:
        causes = [error.name for error in record.errors] + [error.name for error in record.inertia_errors]
        causes += [error.name for error in acting(record, structure.body)]
        for name in [*causes, record.clock] if record.u_clock > 0.0 else causes:
            names.setdefault(f"error: {name}", len(names))
    curves = tuple(
        _curve(record, structure, place, free, names)
        for record, place, free in zip(records, places, factors, strict=True)
    )
    count = len(names)
    expected, precision, fixed = np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.bool_)
    precision[first_error:] = 1.0
    for place, kind in enumerate(kinds):
        if (stated := known.get(structure.parameters[kind].name)) is not None:
            expected[place], fixed[place] = stated[0], stated[1] == 0.0
            precision[place] = 0.0 if fixed[place] else 1.0 / stated[1] ** 2
    return Problem(curves, parameters, np.array(kinds), tuple(names), expected, precision, fixed)


def _check(
    records: Sequence[MeasuredTransfer],
    structure: Structure,
    known: Mapping[str, tuple[float, float]],
    each_recording: Collection[str],
    channels: Sequence[str],
) -> None:
    """Refuse names that do not exist and recordings that cannot be told apart."""
    if not records:
        raise ValueError("records: expected one recording or more, found none")
    if len({record.name for record in records}) < len(records):
        raise ValueError(f"records: expected different names, found {', '.join(r.name for r in records)}")
    have = [parameter.name for parameter in structure.parameters]
    measured = {channel for record in records for channel in record.ratio.channels}
    wanted = (("known", known, have), ("each_recording", each_recording, have), ("gain, delay", channels, measured))
    for argument, names, allowed in wanted:
        for name in names:
            if name not in allowed:
                raise ValueError(f"{argument}: expected some of {', '.join(allowed)}, found {name}")
    for name, (_, u) in known.items():
        if not u >= 0.0:
            raise ValueError(f"known: expected an uncertainty of 0 or more for {name}, found {u}")
    for record in records:
        if abs(float(record.base.row @ record.drive)) < 1e-9 * float(np.abs(record.drive).max()):
            raise ValueError(f"records: expected a reference that sees the drive of {record.name}, found one across it")


def _parameters(
    records: Sequence[MeasuredTransfer], structure: Structure, each_recording: Collection[str]
) -> tuple[tuple[Parameter, ...], list[int], list[IntArray]]:
    """Return the parameters fitted, the structure's they stand for, and the places (P,) that each recording uses."""
    fitted: list[Parameter] = []
    kinds: list[int] = []
    places = np.zeros((len(records), len(structure.parameters)), dtype=np.int64)
    for kind, parameter in enumerate(structure.parameters):
        if parameter.name not in each_recording:
            places[:, kind] = len(fitted)
            fitted.append(parameter)
            kinds.append(kind)
            continue
        for row, record in enumerate(records):
            places[row, kind] = len(fitted)
            label = f"{parameter.label}, {record.name}"
            fitted.append(Parameter(f"{parameter.name}: {record.name}", label, parameter.unit))
            kinds.append(kind)
    return tuple(fitted), kinds, list(places)


def factor_name(kind: str, record: MeasuredTransfer, channel: str) -> str:
    """Return the name of a free factor among the unknowns."""
    return f"{kind}: {record.name}: {channel}"


def _free(record: MeasuredTransfer, gain: Collection[str], delay: Collection[str]) -> dict[str, ComplexArray]:
    """Return what one unit of every free factor changes of the logarithm of a recording's ratios (K, C)."""
    found: dict[str, ComplexArray] = {}
    for c, channel in enumerate(record.ratio.channels):
        column = np.zeros(record.ratio.value.shape, dtype=np.complex128)
        column[:, c] = 1.0
        if channel in gain:
            found[factor_name("ln gain", record, channel)] = column
            found[factor_name("gain phase", record, channel)] = 1j * column
        if channel in delay:
            found[factor_name("delay", record, channel)] = -DELAY_UNIT_S * record.s[:, None] * column
    return found


def _curve(
    record: MeasuredTransfer,
    structure: Structure,
    parameters: IntArray,
    free: Mapping[str, ComplexArray],
    names: Mapping[str, int],
) -> Curve:
    """Return a recording with the places of its unknowns."""
    try:
        lower = np.linalg.cholesky(record.ratio.covariance)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"records: expected positive definite covariances in {record.name}, found others") from error
    relative = [*free.values(), *(error.relative for error in record.errors)]
    inertia = [names[f"error: {error.name}"] for error in record.inertia_errors]
    factors = [*(names[name] for name in free), *(names[f"error: {error.name}"] for error in record.errors)]
    return Curve(
        record=record,
        mechanics=structure.mechanics(record),
        terms=np.concatenate([parameters, np.array(inertia, dtype=np.int64)]),
        factors=np.array(factors, dtype=np.int64),
        relative=np.stack(relative, axis=2) if relative else np.zeros((*record.ratio.value.shape, 0), np.complex128),
        sights=sights(record, structure.body, names),
        clock=names[f"error: {record.clock}"] if record.u_clock > 0.0 else -1,
        whitening=np.linalg.inv(lower),
    )
