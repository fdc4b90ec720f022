"""Recordings of releases, and quantities pooled over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from fusion.errors import InputError
from fusion.estimation.coverage import NamedQuantity
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.response import read_response
from fusion.sensor import model_notices as declared
from fusion.sensor.transfer.transfer_records import AlignedChannels, align
from fusion.sensor.unmodelled_effects import NO_INFLUENCES, ModelInfluences
from shaker.lti.indices import LABELS, SETTLING, find_figure_range, indices, moving_figures, settling_u, unit_of
from shaker.lti.system import ModalModel, coordinate_sizes, from_coordinates, scale_of, to_coordinates
from shaker.release.record import StepRecord, locate_change, peaks_hz
from shaker.timebase.edges import kernel_reach, resample
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice
from shakercal._common.propagation import derivatives

# Choices of an identification from step responses.

MethodChoice = Literal["pencil", "arx", "all"]
ReleaseChoice = Literal["auto", "step", "ramp", "smooth", "exponential", "measured"]


@dataclass(frozen=True)
class StepSettings:
    """Choices of an identification from step responses.

    Attributes
    ----------
    method : method that starts a fit, "pencil" or "arx"; "all" compares every method in addition. Default "pencil".
    modes : number of modes; None selects it by rule.
    real_poles : number of real poles; None selects it by rule.
    release : course of the load: "step", "ramp", "smooth", "exponential" or "measured"; "auto" (default): by rule.

    Examples
    --------
    >>> from fusion import StepSettings
    >>> StepSettings(method="arx", modes=2).modes
    2
    """

    method: MethodChoice = "pencil"
    modes: int | None = None
    real_poles: int | None = None
    release: ReleaseChoice = "auto"

    def as_settings(self) -> dict[str, str | float | int]:
        """Return the choices for the results."""
        structure = {"modes": self.modes, "real_poles": self.real_poles}
        by_rule = {name: "by rule" if number is None else number for name, number in structure.items()}
        return {"method": self.method, "release": self.release, **by_rule}


# The record of a release: outputs and force on one time base, in their units.


@dataclass(frozen=True)
class StepInput:
    """A recording with its record and the notices of its reading."""

    manifest: Manifest
    record: StepRecord
    notices: tuple[Notice, ...]


def output_entries(manifest: Manifest) -> dict[str, tuple[str, ChannelEntry]]:
    """Return block and entry of every output by name; `InputError` without or twice."""
    outputs: dict[str, tuple[str, ChannelEntry]] = {}
    recorded = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    for block, entry in recorded:
        name = entry.channel or entry.name
        if name in outputs:
            raise InputError(declared.DUPLICATE_OUTPUT, manifest.path, "daq.channel", output=name)
        outputs[name] = block, entry
    if not outputs:
        expected = 'a channel with quantity = "output"'
        raise InputError(declared.MISSING_STEP_ENTRY, manifest.path, "daq.channel", expected=expected)
    return outputs


def read_step(manifest: Manifest) -> StepInput:
    """Return all outputs of a step recording on one time base.

    With its force channel if it names one. The origin of time is the earliest sample of the first block. Raises
    `InputError`.
    """
    manifest.check_command("step")
    excitation, outputs = manifest.excitation, output_entries(manifest)
    selected = [*outputs.values(), *_force(manifest)]
    aligned = _without_delays(align(manifest, read_daqs(manifest), selected, "daq"))
    if excitation.component is None or excitation.step_amplitude is None:
        raise InputError(
            declared.MISSING_STEP_ENTRY, manifest.path, "excitation.component", expected="the load of the step"
        )
    record = StepRecord(
        name=manifest.folder.name,
        channels=tuple(outputs),
        unit=manifest.rig.unit_of(next(iter(outputs.values()))[1].quantity),
        samples=np.stack(aligned.values[: len(outputs)]),
        sample_rate_hz=aligned.rate_hz,
        component=excitation.component,
        amplitude=excitation.step_amplitude,
        u_amplitude=excitation.step_uncertainty,
        start_s=aligned.start_s,
        force=aligned.values[-1] if len(selected) > len(outputs) else None,
        onset_s=excitation.onset,
        release=excitation.release or "",
    )
    driven = record.channels.index(record.component) if record.component in record.channels else 0
    record = with_stated_lag(record, driven, [*outputs.values()][driven][1])
    end_s = record.start_s + (record.samples.shape[1] - 1) / record.sample_rate_hz
    if record.onset_s is not None and not record.start_s < record.onset_s < end_s:
        path, start_s, found_s = manifest.path, record.start_s, record.onset_s
        raise InputError(
            declared.ONSET_OUTSIDE_RECORD, path, "excitation.onset", start_s=start_s, end_s=end_s, found_s=found_s
        )
    notices, entries = [*aligned.notices], [channel.entry for channel in aligned.channels]
    if chained := ", ".join(entry.name for entry in entries if entry.response is not None):
        notices.append(Notice(declared.CHAIN_IN_MODEL, record.name, channels=chained))
    if late := ", ".join(entry.name for entry in entries if entry.filter_delay_s > 0.0):
        notices.append(Notice(declared.FILTER_IN_MODEL, record.name, channels=late))
    return StepInput(manifest, record, tuple(notices))


_FAR_BELOW = 10.0  # ratio of the frequencies between which the magnitude of a chain gives its lag


def with_stated_lag(record: StepRecord, driven: int, entry: ChannelEntry) -> StepRecord:
    """Return a record with the lag of its driven output's stated response.

    |H| = 1/√(1 + ω²τ²) at the frequency of the ringing relative to a tenth of it.
    """
    if entry.response is None:
        return record
    samples = record.samples[driven]
    try:
        rings = samples[int(np.ceil(locate_change(samples).index_90)) :]
        hertz = float(peaks_hz(rings, 1.0 / record.sample_rate_hz, 1)[0])
        at = np.array([hertz / _FAR_BELOW, hertz])
        chain = read_response(entry.response, at, entry.response_result, entry.response_columns)
    except (InputError, ValueError, IndexError):  # no ringing, or a table that ends below it
        return record
    below, omega = np.abs(chain.value[0] / chain.value[1]) ** 2, 2.0 * np.pi * hertz
    per_omega = omega**2 * (1.0 - below / _FAR_BELOW**2)
    square, u_square = max(0.0, (below - 1.0) / per_omega), 2.0 * below / per_omega
    u_square *= float(np.linalg.norm((chain.errors[:, 1] - chain.errors[:, 0]).real))
    lag = float(np.sqrt(square))
    return replace(record, lag_s=lag, u_lag_s=float(u_square / (2.0 * max(lag, np.sqrt(u_square), 1e-12))))


def _force(manifest: Manifest) -> list[tuple[str, ChannelEntry]]:
    """Return block and entry of the channel that measured the load, if named."""
    name = manifest.excitation.force
    if name is None:
        return []
    named = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.name == name]
    if len(named) != 1 or named[0][1].quantity != "force":
        found = f'"{name}", of quantity {named[0][1].quantity}' if len(named) == 1 else f'"{name}" {len(named)} times'
        raise InputError(declared.WRONG_FORCE_CHANNEL, manifest.path, "excitation.force", found=found)
    return named


def _without_delays(aligned: AlignedChannels) -> AlignedChannels:
    """Correct the stated delays: a common delay shifts the time, individual differences are resampled."""
    delays = np.array([channel.entry.delay for channel in aligned.channels])
    start_s, shift = aligned.start_s - float(delays[0]), (delays - delays[0]) * aligned.rate_hz
    if not shift.any():
        return replace(aligned, start_s=start_s)
    reach, count = kernel_reach(1.0), len(aligned.values[0])
    low = int(np.ceil(max(0.0, reach - shift.min())))
    high = int(np.floor(min(count, count - reach - shift.max())))
    position = np.arange(low, high, dtype=np.float64)
    values = tuple(
        resample(value, position + by, 1.0) if by else value[low:high]
        for value, by in zip(aligned.values, shift, strict=True)
    )
    return replace(aligned, values=values, start_s=start_s + low / aligned.rate_hz)


# The weighted mean of models of several releases, with the scatter of releases or mountings.

OF_RELEASES, OF_SCALES = "releases, noise and scatter", "scales of load and output"
OF_SHAPES = "shape of the releases"
"""Causes in a budget: scatter and noise of the releases, common scales, and release shapes common to one device."""
STEP = 1e-2  # standard uncertainties over which coordinates are moved for derivatives
ROUNDING = 1e-9  # part of a coordinate's size that is rounding


class VectorMean(NamedTuple):
    """Weighted mean (P,) of N vectors with covariance (P, P) and weights (N,).

    The weights have the sum 1. `scatter` (P, P) is the part of the covariance with the degrees of freedom of the
    scatter between vectors.
    """

    value: FloatArray
    covariance: FloatArray
    weight: FloatArray
    scatter: FloatArray


@dataclass(frozen=True)
class PooledModel:
    """One model from those of several releases, with its whole covariance.

    Attributes
    ----------
    vectors, covariances, weights : (N, P), (N, P, P), (N,) of the last mean, over releases or mountings, as parameters
        linearised about those of the mean.
    scale : (P,), change of the parameters by one standard uncertainty of the common scale.
    shapes : (S, P), change by each release shape that the records do not determine.
    shares : (R,), weight of each release in the mean.
    external_changes : (E, P), change by each unknown that the records do not determine.
    scatter : (P, P), part of the covariance with `scatter_dof` degrees of freedom.
    """

    model: ModalModel
    vectors: FloatArray
    covariances: FloatArray
    weights: FloatArray
    scale: FloatArray
    shapes: FloatArray
    shares: FloatArray
    external_changes: FloatArray = field(metadata={"dataset": "beside"})
    scatter: FloatArray

    @property
    def scatter_dof(self) -> int:
        """Degrees of freedom of the scatter between the vectors."""
        return len(self.vectors) - 1

    def spread(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return standard uncertainties and degrees of freedom, (Q,) each, of numbers with gradients (Q, P).

        u² = Σw²·(u_i² + τ²) + u_scale² + Σu_shape² + Σu_unobserved². τ² = s² - mean u_i² is the scatter beyond the
        stated uncertainties. The degrees of freedom are those of s², combined by Welch and Satterthwaite (JCGM 100,
        G.4.1). There, s² is enlarged by its relative variance 2/ν as in `rotation_readings`. Two vectors determine s²
        poorly. For them only τ² counts as the part with ν = 1, so that k = 12.7 remains for scatter far beyond the
        stated uncertainties.
        """
        stated = np.einsum("qp,npr,qr->nq", gradient, self.covariances, gradient)
        variance, dof = self.weights**2 @ stated, np.full(len(gradient), np.inf)
        shared = np.concatenate([self.scale[None], self.shapes, self.external_changes])
        common = np.sum((gradient @ shared.T) ** 2, axis=1)
        if self.scatter_dof:
            off = (self.vectors - self.vectors.mean(axis=0)) @ gradient.T
            square = np.sum(off**2, axis=0) / self.scatter_dof
            beyond = np.maximum(square - stated.mean(axis=0), 0.0)
            by_square = float(np.sum(self.weights**2))
            variance = variance + by_square * beyond
            part = beyond if self.scatter_dof == 1 else np.where(beyond > 0.0, square, 0.0)
            of_scatter = np.minimum(by_square * part, variance)
            dof = effective_dof(variance + common, of_scatter, self.scatter_dof)
        return np.asarray(np.sqrt(variance + common)), np.asarray(dof)

    def budget(self, gradient: FloatArray, influences: ModelInfluences) -> dict[str, FloatArray]:
        """Return contributions to u (Q,) by cause, with squares that add up to u²."""
        shared, other = {OF_SCALES: np.abs(gradient @ self.scale)}, gradient @ self.external_changes.T
        if len(self.shapes):
            shared[OF_SHAPES] = np.linalg.norm(gradient @ self.shapes.T, axis=1)
        shared |= influences.by_cause(lambda indices: np.linalg.norm(other[:, indices], axis=1))
        whole = self.spread(gradient)[0] ** 2
        rest = whole - np.sum(np.square([*shared.values()]), axis=0)
        return {OF_RELEASES: np.sqrt(np.maximum(rest, 0.0)), **shared}


def effective_dof(variance: FloatArray, of_scatter: FloatArray, dof: float) -> FloatArray:
    """Return degrees of freedom (Q,) of variances (Q,), of which the part `of_scatter` has `dof`.

    Welch and Satterthwaite, with this part enlarged by its relative variance 2/ν; infinite without such a part.
    """
    wide = of_scatter * (1.0 + 2.0 / dof)
    rest = np.maximum(variance - of_scatter, 0.0)
    return np.asarray(dof * (1.0 + np.divide(rest, wide, out=np.full_like(wide, np.inf), where=wide > 0.0)) ** 2)


class AlternativeModels(NamedTuple):
    """All releases' models if one device had the other shape; distance in u."""

    models: Sequence[ModalModel]
    distance: float


def pool_models(
    models: Sequence[ModalModel],
    mountings: Sequence[str],
    u_scale: float = 0.0,
    influences: ModelInfluences = NO_INFLUENCES,
    alternatives: Sequence[AlternativeModels] = (),
) -> PooledModel:
    """Return the mean of N models of one structure, mode by mode in ascending frequency.

    The mean is taken in the coordinates of `to_coordinates`, in which static gain and lag are linear. A mean of
    residues and frequencies of weak poles would change the static gain. Releases of one mounting are averaged first.
    Several mountings then determine the scatter. `u_scale`: relative standard uncertainty of all residues together, by
    the scales of load and output, which averaging does not reduce. `influences`: influences that no record shows, which
    averaging does not reduce either. `alternatives`: other models that the records do not reject.
    """
    ordered = [sorted_modes(model) for model in models]
    scale = scale_of(ordered[0])
    vectors, covariances = _in_coordinates(ordered, scale)
    moved = []
    for alternative in alternatives:
        there = np.array([to_coordinates(sorted_modes(model), scale) for model in alternative.models])
        moved.append((there - vectors) / alternative.distance)
    least = ROUNDING * coordinate_sizes(vectors[0], len(ordered[0].real_hz))
    groups = [np.flatnonzero(np.array(mountings) == name) for name in dict.fromkeys(mountings)]
    within = [random_effects_mean(vectors[group], covariances[group], least) for group in groups]
    mean, shares = within[0], within[0].weight
    if len(groups) > 1:
        vectors, covariances = np.stack([m.value for m in within]), np.stack([m.covariance for m in within])
        mean, shares = random_effects_mean(vectors, covariances, least), np.zeros(len(models))
        for group, inner, share in zip(groups, within, mean.weight, strict=True):
            shares[group] = share * inner.weight
    value, back = _back(ordered[0], mean, scale)
    modes, reals = len(ordered[0].frequency_hz), len(ordered[0].real_hz)
    common = u_scale * np.repeat([0.0, 1.0, 0.0, 1.0], [2 * modes, 2 * modes, reals, reals]) * value
    model = ordered[0].with_vector(value)
    other = influences.effects(lambda *part: model.altered(*part).vector)
    shapes = np.array([shares @ change for change in moved]).reshape(-1, len(value)) @ back.T
    shared = np.concatenate([common[None], shapes, other])
    covariance = back @ mean.covariance @ back.T + shared.T @ shared
    model, scatter = replace(model, covariance=covariance), back @ mean.scatter @ back.T
    spread = value + (vectors - mean.value) @ back.T
    return PooledModel(model, spread, back @ covariances @ back.T, mean.weight, common, shapes, shares, other, scatter)


def _in_coordinates(models: Sequence[ModalModel], scale: float) -> tuple[FloatArray, FloatArray]:
    """Return coordinates (N, P) and covariances (N, P, P), 0 where they are rounding."""
    vectors, covariances = [], []
    for model in models:
        stated = np.zeros((len(model.vector),) * 2) if model.covariance is None else model.covariance
        coordinates, slope = replace(model, covariance=stated).jacobian(lambda at: to_coordinates(at, scale))
        covariance, least = slope @ stated @ slope.T, ROUNDING * coordinate_sizes(coordinates, len(model.real_hz))
        determined = np.sqrt(np.maximum(np.diag(covariance), 0.0)) > least
        vectors.append(coordinates)
        covariances.append(covariance * np.outer(determined, determined))
    return np.stack(vectors), np.stack(covariances)


def _back(model: ModalModel, mean: VectorMean, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return the parameters (P,) of mean coordinates and their derivatives (P, P) by central differences."""
    modes, reals = len(model.frequency_hz), len(model.real_hz)
    step = np.maximum(STEP * np.sqrt(np.diag(mean.covariance)), 10.0 * ROUNDING * coordinate_sizes(mean.value, reals))

    def parameters(move: FloatArray) -> FloatArray:
        return from_coordinates(mean.value + move, modes, reals, scale)

    return parameters(np.zeros(len(step))), derivatives(parameters, step)


def random_effects_mean(vectors: FloatArray, covariances: FloatArray, rounding: FloatArray | float = 0.0) -> VectorMean:
    """Return the mean of vectors (N, P) with random effects between them.

    `covariances` (N, P, P): of the vectors. The part of the sample covariance S beyond the mean of the stated variances
    is scatter. T = D·S·D with D = diag(τ/s) and τ² = max(0, s² - mean u²) for each parameter (method of moments;
    Searle, Casella & McCulloch 1992, Variance Components, 3.6). The covariance is Σw²·(C + T). The weight of a vector
    is the geometric mean of its variances u² + τ², one number for all parameters, so that the mean lies between the
    vectors. `rounding` (P,): standard deviations up to which a parameter is rounding only.
    """
    count, size = vectors.shape
    stated = np.einsum("npp->np", covariances)
    between: FloatArray = np.zeros((size, size))
    counted = between
    if count > 1:
        sample = np.cov(vectors, rowvar=False, ddof=1).reshape(size, size)
        square = np.diag(sample)
        excess = np.sqrt(np.maximum(square - stated.mean(axis=0), 0.0))
        share = np.divide(excess, np.sqrt(square), out=np.zeros(size), where=square > 0.0)
        between = share[:, None] * sample * share
        counted = between if count == 2 else np.outer(excess > 0.0, excess > 0.0) * sample
    variance = stated + np.diag(between)
    informative = np.all(variance > rounding**2, axis=0)
    log_variance = np.log(variance[:, informative])
    inverse = np.exp(-log_variance.mean(axis=1)) if informative.any() else np.ones(count)
    weight = inverse / inverse.sum()
    spread = np.einsum("n,npq->pq", weight**2, covariances + between)
    return VectorMean(weight @ vectors, spread, weight, float(np.sum(weight**2)) * counted)


def sorted_modes(model: ModalModel) -> ModalModel:
    """Return the same model with modes and real poles in rising frequency."""
    modes, reals = np.argsort(model.frequency_hz), np.argsort(model.real_hz)
    count = len(modes)
    order = np.concatenate([*(part * count + modes for part in range(4)), 4 * count + reals])
    order = np.concatenate([order, 4 * count + len(reals) + reals])
    covariance = None if model.covariance is None else model.covariance[np.ix_(order, order)]
    return replace(model, covariance=covariance).with_vector(model.vector[order])


# Parameters and indices of a pooled model with uncertainty.

PARAMETERS = {
    "frequency_hz": "natural frequency of mode",
    "damping_ratio": "damping ratio of mode",
    "residue_re": "residue, real part, of mode",
    "residue_im": "residue, imaginary part, of mode",
    "real_hz": "real pole",
    "real_residue": "residue of real pole",
}


def parameter_quantities(pooled: PooledModel, unit: str) -> tuple[NamedQuantity, ...]:
    """Return the parameters of a pooled model, its residues in `unit` per second."""
    model = pooled.model
    u, dof = (part.tolist() for part in pooled.spread(np.eye(len(model.vector))))
    quantities = []
    for index, (name, value) in enumerate(zip(model.names, model.vector.tolist(), strict=True)):
        kind, _, number = name.rpartition("_")
        value_unit = "Hz" if "_hz_" in name else f"{unit}/s" if "residue" in name else "1"
        label = f"{PARAMETERS[kind]} {number}"
        quantities.append(NamedQuantity(value, u[index], dof[index], value_unit, name, label))
    return tuple(quantities)


class IndexResults(NamedTuple):
    """The indices of a pooled model, their notices, and their budget by cause."""

    quantities: tuple[NamedQuantity, ...]
    notices: tuple[Notice, ...]
    budget: dict[str, dict[str, float]]


def index_quantities(
    pooled: PooledModel,
    nominal: float | None,
    unit: str,
    sample_rate_hz: float,
    influences: ModelInfluences = NO_INFLUENCES,
) -> IndexResults:
    """Return the indices of a pooled model with uncertainty, and their notices.

    `nominal`: nominal gain of the sensor; without one (None) there is no band relative to it. Settling times are
    discontinuous in steps of half periods. Their uncertainty is that of `settling_u` with the degrees of freedom of the
    damping ratio.
    """
    model = pooled.model
    found = indices(model.system, nominal or 1.0, sample_rate_hz)
    names, moving = moving_figures(model, found)
    slope = model.jacobian(moving)[1]

    def figures(move: FloatArray) -> FloatArray:  # NaN for an index that is not defined
        moved = indices(model.with_move(move).system, nominal or 1.0).figures()
        return np.array([moved[name] for name in names], dtype=np.float64)

    seen = find_figure_range(np.asarray(model.covariance), slope, figures)
    u, dof = pooled.spread(slope)
    u, dof = (seen.factor * u).tolist(), dof.tolist()
    estimated = dict(zip(names, zip(u, dof, strict=True), strict=True))
    of_damping = estimated.get("damping_ratio", (0.0, np.inf))[1]
    estimated |= {name: (settling_u(model, tolerance), of_damping) for name, tolerance in SETTLING.items()}
    quantities = []
    for name, value in found.figures().items():
        if value is not None and np.isfinite(value) and (nominal is not None or "nominal" not in name):
            index_unit = unit if name == "static_gain" else unit_of(name) or "1"
            uncertainty = estimated.get(name, (np.nan, np.inf))
            quantities.append(NamedQuantity(value, *uncertainty, index_unit, name, LABELS[name]))
    parts = pooled.budget(slope, influences)
    budget = {cause: dict(zip(names, (seen.factor * part).tolist(), strict=True)) for cause, part in parts.items()}
    return IndexResults(tuple(quantities), (*found.notices, *seen.notices(names)), budget)
