"""Recordings of releases, and quantities pooled over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from fusion.errors import InputError
from fusion.estimation.coverage import NamedQuantity
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.sensor.transfer.transfer_records import AlignedChannels, align
from fusion.sensor.unmodelled_effects import NO_INFLUENCES, ModelInfluences
from shaker.arrays import FloatArray
from shaker.lti.indices import LABELS, SETTLING, find_figure_range, indices, moving_figures, settling_u, unit_of
from shaker.lti.system import ModalModel, coordinate_sizes, from_coordinates, scale_of, to_coordinates
from shaker.release.record import StepRecord
from shaker.timebase.edges import kernel_reach, resample
from shakercal._common.notices import Notice

# What the user chooses of an identification from step responses.

MethodChoice = Literal["pencil", "arx", "all"]
ReleaseChoice = Literal["auto", "step", "ramp", "smooth", "measured"]


@dataclass(frozen=True)
class StepSettings:
    """`method`: what the start of a fit comes from; "all" compares every method beside the default one.

    `modes`, `real_poles`: the structure of the models, chosen by rule where None; `release`: how the load goes, chosen
    by rule for "auto".

    >>> from fusion import StepSettings
    >>> StepSettings(method="arx", modes=2).modes
    2
    """

    method: MethodChoice = "pencil"
    modes: int | None = None
    real_poles: int | None = None
    release: ReleaseChoice = "auto"

    def as_settings(self) -> dict[str, str | float | int]:
        """Return what was chosen, for the results."""
        structure = {"modes": self.modes, "real_poles": self.real_poles}
        by_rule = {name: "by rule" if number is None else number for name, number in structure.items()}
        return {"method": self.method, "release": self.release, **by_rule}


# The record of a release from a recording: outputs and force on one time base, in their units.


@dataclass(frozen=True)
class StepInput:
    """A recording, its record, and what had to be done to read it."""

    manifest: Manifest
    record: StepRecord
    notices: tuple[Notice, ...]


def output_entries(manifest: Manifest) -> dict[str, tuple[str, ChannelEntry]]:
    """Return block and entry of every output of the sensor by the output's name; raises `InputError` without any."""
    outputs: dict[str, tuple[str, ChannelEntry]] = {}
    recorded = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    for block, entry in recorded:
        name = entry.channel or entry.name
        if name in outputs:
            expected = "one record of every output of the sensor"
            raise InputError(manifest.path, "daq.channel", found=f'output "{name}" twice', expected=expected)
        outputs[name] = block, entry
    if not outputs:
        raise InputError(manifest.path, "daq.channel", found="none", expected='a channel with quantity = "output"')
    return outputs


def read_step(manifest: Manifest) -> StepInput:
    """Return every output of a recording of kind step on one time base, and its force where it names one.

    Time is counted on the first block's clock from its earliest sample. Raises `InputError`.
    """
    manifest.check_command("step")
    excitation, outputs = manifest.excitation, output_entries(manifest)
    wanted = [*outputs.values(), *_force(manifest)]
    aligned = _without_delays(align(manifest, read_daqs(manifest), wanted, "daq"))
    if excitation.component is None or excitation.step_amplitude is None:
        raise InputError(manifest.path, "excitation.component", found="nothing", expected="the load of the step")
    record = StepRecord(
        name=manifest.folder.name,
        channels=tuple(outputs),
        unit=manifest.rig.unit_of(next(iter(outputs.values()))[1]),
        samples=np.stack(aligned.values[: len(outputs)]),
        sample_rate_hz=aligned.rate_hz,
        component=excitation.component,
        amplitude=excitation.step_amplitude,
        u_amplitude=excitation.step_uncertainty,
        start_s=aligned.start_s,
        force=aligned.values[-1] if len(wanted) > len(outputs) else None,
        onset_s=excitation.onset,
        release=excitation.release or "",
    )
    last = record.start_s + (record.samples.shape[1] - 1) / record.sample_rate_hz
    if record.onset_s is not None and not record.start_s < record.onset_s < last:
        expected = f"a time within the record, {record.start_s:.6g} s to {last:.6g} s"
        raise InputError(manifest.path, "excitation.onset", found=f"{record.onset_s:g} s", expected=expected)
    notices = [*aligned.notices]
    if chained := ", ".join(channel.entry.name for channel in aligned.channels if channel.entry.response is not None):
        text = f"the stated response of {chained} is not taken off: the model is that of sensor and chain together"
        notices.append(Notice("warning", text, record.name))
    if late := ", ".join(channel.entry.name for channel in aligned.channels if channel.entry.filter_delay_s > 0.0):
        text = f"the delay of {late} may be a low-pass's, of which only the delay is taken off: the model is that of "
        text += 'sensor and filter together; state delay_of = "pure" if it is none'
        notices.append(Notice("warning", text, record.name))
    return StepInput(manifest, record, tuple(notices))


def _force(manifest: Manifest) -> list[tuple[str, ChannelEntry]]:
    """Block and entry of the channel that measured the load along, none where the recording names none."""
    name = manifest.excitation.force
    if name is None:
        return []
    named = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.name == name]
    if len(named) != 1 or named[0][1].quantity != "force":
        told = f'"{name}", of quantity {named[0][1].quantity}' if len(named) == 1 else f'"{name}" {len(named)} times'
        expected = 'the name of one channel with quantity = "force"'
        raise InputError(manifest.path, "excitation.force", found=told, expected=expected)
    return named


def _without_delays(aligned: AlignedChannels) -> AlignedChannels:
    """Take the stated delays off: what all channels share moves the time, what they do not is resampled."""
    delays = np.array([channel.entry.delay for channel in aligned.channels])
    start_s, shift = aligned.start_s - float(delays[0]), (delays - delays[0]) * aligned.rate_hz
    if not shift.any():
        return replace(aligned, start_s=start_s)
    reach, count = kernel_reach(1.0), len(aligned.values[0])
    low = int(np.ceil(max(0.0, reach - shift.min())))
    high = int(np.floor(min(count, count - reach - shift.max())))
    kept = np.arange(low, high, dtype=np.float64)
    values = tuple(
        resample(value, kept + by, 1.0) if by else value[low:high]
        for value, by in zip(aligned.values, shift, strict=True)
    )
    return replace(aligned, values=values, start_s=start_s + low / aligned.rate_hz)


# Models of several releases become one: a weighted mean, with what releases or mountings scatter by.

OF_RELEASES, OF_SCALES = "releases, noise and scatter", "scales of load and output"
OF_SHAPES = "shape of the releases"
"""What a budget calls what the releases show themselves, and what all of them, or all by one rope, share."""
STEP = 1e-2  # standard uncertainties over which coordinates are moved for derivatives
ROUNDING = 1e-9  # part of a coordinate's size that is rounding


class VectorMean(NamedTuple):
    """Weighted mean (P,) of vectors with its covariance (P, P); `weight` (N,) of the vectors, their sum 1.

    `scatter` (P, P): the part of the covariance whose degrees of freedom are those of what the vectors scatter by.
    """

    value: FloatArray
    covariance: FloatArray
    weight: FloatArray
    scatter: FloatArray


@dataclass(frozen=True)
class PooledModel:
    """One model from those of several releases.

    `model` with its whole covariance; `vectors` (N, P), `covariances` (N, P, P), `weights` (N,): of what was averaged
    last, releases or, where there are several, mountings, as parameters, linear about those of the mean. `scale` (P,):
    how the parameters move with one standard uncertainty of the scale that all share, `shapes` (S, P): with that of
    each shape of releases that the records do not tell. `shares` (R,): of each release in the mean. `beside` (E, P):
    how they move with each unknown that no record shows; `scatter` (P, P): what of the covariance rests on `scattered`
    degrees of freedom.
    """

    model: ModalModel
    vectors: FloatArray
    covariances: FloatArray
    weights: FloatArray
    scale: FloatArray
    shapes: FloatArray
    shares: FloatArray
    beside: FloatArray
    scatter: FloatArray

    @property
    def scatter_dof(self) -> int:
        """Degrees of freedom of what the vectors scatter by."""
        return len(self.vectors) - 1

    def spread(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return standard uncertainties (Q,) of numbers with gradients (Q, P), and their degrees of freedom (Q,).

        u² = Σw²·(u_i² + τ²) + u_scale² + Σu_shape² + Σu_beside², τ² = s² - mean u_i² where the vectors scatter by more
        than is stated. Then the degrees of freedom are those of s², with the others by Welch and Satterthwaite
        (JCGM 100, G.4.1), s² enlarged by its relative variance 2/ν as in `fusion.sensor.rotate.rotation_readings`; of two
        vectors, whose s² tells little, only τ² counts as the part with ν = 1, so that k = 12.7 is left to scatter that
        is far beyond what is stated.
        """
        stated = np.einsum("qp,npr,qr->nq", gradient, self.covariances, gradient)
        variance, dof = self.weights**2 @ stated, np.full(len(gradient), np.inf)
        shared = np.concatenate([self.scale[None], self.shapes, self.beside])
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
        """Return what makes the u of numbers with gradients (Q, P), by its words, (Q,) each; squares add up to u²."""
        shared, other = {OF_SCALES: np.abs(gradient @ self.scale)}, gradient @ self.beside.T
        if len(self.shapes):
            shared[OF_SHAPES] = np.linalg.norm(gradient @ self.shapes.T, axis=1)
        shared |= influences.by_cause(lambda places: np.linalg.norm(other[:, places], axis=1))
        whole = self.spread(gradient)[0] ** 2
        rest = whole - np.sum(np.square([*shared.values()]), axis=0)
        return {OF_RELEASES: np.sqrt(np.maximum(rest, 0.0)), **shared}


def effective_dof(variance: FloatArray, of_scatter: FloatArray, dof: float) -> FloatArray:
    """Return degrees of freedom (Q,) of variances (Q,), of which parts have `dof` of them and the rest is known.

    Welch and Satterthwaite, the parts enlarged by their relative variance 2/ν; infinite without such a part.
    """
    wide = of_scatter * (1.0 + 2.0 / dof)
    rest = np.maximum(variance - of_scatter, 0.0)
    return np.asarray(dof * (1.0 + np.divide(rest, wide, out=np.full_like(wide, np.inf), where=wide > 0.0)) ** 2)


class AlternativeModels(NamedTuple):
    """The models of all releases if those of one rope went in the other shape; `far`: standard uncertainties away."""

    models: Sequence[ModalModel]
    distance: float


def pool_models(
    models: Sequence[ModalModel],
    mountings: Sequence[str],
    u_scale: float = 0.0,
    influences: ModelInfluences = NO_INFLUENCES,
    alternatives: Sequence[AlternativeModels] = (),
) -> PooledModel:
    """Return the mean of models (N) of one structure, mode by mode in rising frequency.

    Averaged are the coordinates of `to_coordinates`, in which static gain and lag are linear; a mean of residues and
    frequencies of poles that hardly show would have another static gain. Releases of one mounting are averaged first;
    where there are several mountings, these are then what scatters. `u_scale`: relative standard uncertainty of all
    residues together, of the load's and of the output's scale, which no average makes smaller; `known`: what is stated
    beside the records, likewise; `instead`: other models that the records do not refute.
    """
    ordered = [sorted_modes(model) for model in models]
    scale = scale_of(ordered[0])
    vectors, covariances = _in_coordinates(ordered, scale)
    others = [[to_coordinates(sorted_modes(model), scale) for model in other.models] for other in alternatives]
    moved = [(np.array(own) - vectors) / other.distance for own, other in zip(others, alternatives, strict=True)]
    least = ROUNDING * coordinate_sizes(vectors[0], len(ordered[0].real_hz))
    groups = [np.flatnonzero(np.array(mountings) == name) for name in dict.fromkeys(mountings)]
    within = [random_effects_mean(vectors[group], covariances[group], least) for group in groups]
    mean, shares = within[0], within[0].weight
    if len(groups) > 1:
        vectors, covariances = np.stack([m.value for m in within]), np.stack([m.covariance for m in within])
        mean, shares = random_effects_mean(vectors, covariances, least), np.zeros(len(models))
        for group, own, share in zip(groups, within, mean.weight, strict=True):
            shares[group] = share * own.weight
    value, back = _back(ordered[0], mean, scale)
    modes, reals = len(ordered[0].frequency_hz), len(ordered[0].real_hz)
    common = u_scale * np.repeat([0.0, 1.0, 0.0, 1.0], [2 * modes, 2 * modes, reals, reals]) * value
    model = ordered[0].with_vector(value)
    other = influences.effects(lambda *part: model.altered(*part).vector)
    shapes = np.array([shares @ own for own in moved]).reshape(-1, len(value)) @ back.T
    shared = np.concatenate([common[None], shapes, other])
    covariance = back @ mean.covariance @ back.T + shared.T @ shared
    model, scatter = replace(model, covariance=covariance), back @ mean.scatter @ back.T
    spread = value + (vectors - mean.value) @ back.T
    return PooledModel(model, spread, back @ covariances @ back.T, mean.weight, common, shapes, shares, other, scatter)


def _in_coordinates(models: Sequence[ModalModel], scale: float) -> tuple[FloatArray, FloatArray]:
    """Coordinates (N, P) of models and their covariances (N, P, P), none where it is of rounding alone."""
    vectors, covariances = [], []
    for model in models:
        stated = np.zeros((len(model.vector),) * 2) if model.covariance is None else model.covariance
        coordinates, slope = replace(model, covariance=stated).jacobian(lambda at: to_coordinates(at, scale))
        covariance = slope @ stated @ slope.T
        told = np.sqrt(np.maximum(np.diag(covariance), 0.0)) > ROUNDING * coordinate_sizes(
            coordinates, len(model.real_hz)
        )
        vectors.append(coordinates)
        covariances.append(covariance * np.outer(told, told))
    return np.stack(vectors), np.stack(covariances)


def _back(model: ModalModel, mean: VectorMean, scale: float) -> tuple[FloatArray, FloatArray]:
    """The parameters (P,) of mean coordinates, and their derivatives (P, P) to these, by central differences."""
    modes, reals = len(model.frequency_hz), len(model.real_hz)
    step = np.maximum(STEP * np.sqrt(np.diag(mean.covariance)), 10.0 * ROUNDING * coordinate_sizes(mean.value, reals))
    slope = np.zeros((len(step), len(step)))
    for place, by in enumerate(step):
        move = by * np.eye(len(step))[place]
        up, down = (from_coordinates(mean.value + sign * move, modes, reals, scale) for sign in (1.0, -1.0))
        slope[:, place] = (up - down) / (2.0 * by)
    return from_coordinates(mean.value, modes, reals, scale), slope


def random_effects_mean(vectors: FloatArray, covariances: FloatArray, rounding: FloatArray | float = 0.0) -> VectorMean:
    """Return the mean of vectors (N, P) with covariances (N, P, P) under random effects between them.

    Of the sample covariance S of the vectors, what exceeds the mean of the stated variances is scatter: T = D·S·D with
    D = diag(τ/s), τ² = max(0, s² - mean u²) for each parameter (method of moments; Searle, Casella & McCulloch 1992,
    Variance Components, 3.6); the covariance is Σw²·(C + T). A vector weighs by the geometric mean of its variances
    u² + τ², one number for all parameters, so that the mean stays between the vectors; `least` (P,): standard
    deviations up to which a parameter is rounding and none of these.
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
    known = np.all(variance > rounding**2, axis=0)
    inverse = np.exp(-np.log(variance[:, known]).mean(axis=1)) if known.any() else np.ones(count)
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


# Numbers of a pooled model with uncertainty: its parameters and its indices.

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
    for place, (name, value) in enumerate(zip(model.names, model.vector.tolist(), strict=True)):
        kind, _, number = name.rpartition("_")
        own = "Hz" if "_hz_" in name else f"{unit}/s" if "residue" in name else "1"
        quantities.append(NamedQuantity(value, u[place], dof[place], own, name, f"{PARAMETERS[kind]} {number}"))
    return tuple(quantities)


class IndexResults(NamedTuple):
    """The indices of a pooled model, what is remarked of them, and what makes the u of each, by its words."""

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
    """Return the indices that a pooled model has with uncertainty, and what is remarked of them.

    `nominal`: the gain that the sensor should have, None where nobody states it: then no band against it. Settling
    times jump by half periods: their uncertainty is `settling_u`'s, with the degrees of freedom of the damping.
    """
    found = indices(pooled.model.system, nominal or 1.0, sample_rate_hz)
    names, moving = moving_figures(pooled.model, found)
    slope = pooled.model.jacobian(moving)[1]
    seen = find_figure_range(
        np.asarray(pooled.model.covariance), slope, _figures_of(pooled.model, names, nominal or 1.0)
    )
    u, dof = pooled.spread(slope)
    u, dof = (seen.factor * u).tolist(), dof.tolist()
    told = dict(zip(names, zip(u, dof, strict=True), strict=True))
    of_damping = told.get("damping_ratio", (0.0, np.inf))[1]
    told |= {name: (settling_u(pooled.model, tolerance), of_damping) for name, tolerance in SETTLING.items()}
    quantities = []
    for name, value in found.figures().items():
        if value is not None and np.isfinite(value) and (nominal is not None or "nominal" not in name):
            own = unit if name == "static_gain" else unit_of(name) or "1"
            quantities.append(NamedQuantity(value, *told.get(name, (np.nan, np.inf)), own, name, LABELS[name]))
    parts = pooled.budget(slope, influences)
    budget = {cause: dict(zip(names, (seen.factor * part).tolist(), strict=True)) for cause, part in parts.items()}
    return IndexResults(tuple(quantities), (*found.notices, *seen.notices(names)), budget)


def _figures_of(model: ModalModel, names: Sequence[str], nominal: float) -> Callable[[FloatArray], FloatArray]:
    """Return the function of a move of a model's parameters that gives some figures (Q,), NaN where there is none."""

    def figures(move: FloatArray) -> FloatArray:
        found = indices(model.with_move(move).system, nominal).figures()
        return np.array([found[name] for name in names], dtype=np.float64)

    return figures
