"""The model of several releases: its mean, scatter and indices, with uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from fusion.estimation.coverage import NamedQuantity, coverage_factor
from fusion.sensor.unmodelled_effects import NO_INFLUENCES, ModelInfluences
from shaker.lti.indices import LABELS, SETTLING, find_figure_range, indices, moving_figures, settling_interval, unit_of
from shaker.lti.system import CoordinateFrame, ModalModel, coordinate_sizes, frame_of, from_coordinates, to_coordinates
from shaker.release.joint_fit import ReleasesFit
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice
from shakercal._common.propagation import derivatives

# The mean of models of several releases, with the scatter of releases or mountings.

OF_RELEASES, OF_SCALES = "releases, noise and scatter", "scales of load and output"
OF_SHAPES = "shape of the releases, lags, amplitude"
"""Causes in a budget: scatter and noise of the releases, common scales, and release shapes common to one device."""
STEP = 1e-2  # standard uncertainties over which coordinates are moved for derivatives
ROUNDING = 1e-9  # part of a coordinate's size that is rounding


class Contributions(NamedTuple):
    """What each of R releases contributes to one model, in the coordinates of `to_coordinates`.

    `model`: one with their structure. `vectors` (R, 2P) with `covariances` (R, 2P, 2P): the models of single releases,
    or, if `joint`, values whose mean is the model fitted to all releases. `frame` is that of the coordinates.
    """

    model: ModalModel
    vectors: FloatArray
    covariances: FloatArray
    frame: CoordinateFrame
    joint: bool = False

    @property
    def mean_model(self) -> ModalModel:
        """The model of the mean of all vectors."""
        modes, reals = len(self.model.frequency_hz), len(self.model.real_hz)
        return self.model.with_vector(from_coordinates(self.vectors.mean(axis=0), modes, reals, self.frame))


def of_models(models: Sequence[ModalModel]) -> Contributions:
    """Return the contributions of models of single releases, mode by mode in ascending frequency."""
    ordered = [sorted_modes(model) for model in models]
    frame, vectors, covariances = frame_of(ordered[0]), [], []
    for model in ordered:
        stated = np.zeros((len(model.vector),) * 2) if model.covariance is None else model.covariance
        coordinates, slope = replace(model, covariance=stated).jacobian(lambda at: to_coordinates(at, frame))
        vectors.append(coordinates)
        covariances.append(_without_rounding(slope @ stated @ slope.T, coordinates, len(model.real_hz)))
    return Contributions(ordered[0], np.stack(vectors), np.stack(covariances), frame)


def of_joint(joint: ReleasesFit) -> Contributions:
    """Return the contributions of releases to the model fitted to all of them."""
    model, frame, reals = joint.model, frame_of(joint.model), len(joint.model.real_hz)
    coordinates, slope = model.jacobian(lambda at: to_coordinates(at, frame))
    by = (joint.moves - joint.moves.mean(axis=0)) @ slope.T
    by[np.abs(by) < ROUNDING * coordinate_sizes(coordinates, reals)] = 0.0
    covariances = [_without_rounding(slope @ one @ slope.T, coordinates, reals) for one in joint.covariances]
    return Contributions(model, coordinates + by, np.stack(covariances), frame, joint=True)


def _without_rounding(covariance: FloatArray, coordinates: FloatArray, reals: int) -> FloatArray:
    """Return a covariance (2P, 2P) that is 0 where it is rounding."""
    determined = np.sqrt(np.maximum(np.diag(covariance), 0.0)) > ROUNDING * coordinate_sizes(coordinates, reals)
    return np.asarray(covariance * np.outer(determined, determined))


class VectorMean(NamedTuple):
    """Mean (P,) of vectors with covariance (P, P).

    `scatter` (P, P) is the part of the covariance with the degrees of freedom of the scatter between vectors.
    """

    value: FloatArray
    covariance: FloatArray
    scatter: FloatArray


@dataclass(frozen=True)
class PooledModel:
    """One model from those of several releases, with its whole covariance.

    Attributes
    ----------
    vectors, covariances : (N, P), (N, P, P) of the last mean, over releases or mountings, as parameters linearised
        about those of the mean.
    scale : (P,), change of the parameters by one standard uncertainty of the common scale.
    shapes : (S, P), change by each release shape that the records do not determine.
    external_changes : (E, P), change by each unknown that the records do not determine.
    scatter : (P, P), part of the covariance with `scatter_dof` degrees of freedom.
    """

    model: ModalModel
    vectors: FloatArray
    covariances: FloatArray
    scale: FloatArray
    shapes: FloatArray
    external_changes: FloatArray = field(metadata={"dataset": "beside"})
    scatter: FloatArray

    @property
    def scatter_dof(self) -> int:
        """Degrees of freedom of the scatter between the vectors."""
        return len(self.vectors) - 1

    def spread(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return standard uncertainties and degrees of freedom, (Q,) each, of numbers with gradients (Q, P).

        u² = Σ(u_i² + τ²)/N² + u_scale² + Σu_shape² + Σu_unobserved². τ² = s² - mean u_i² is the scatter beyond the
        stated uncertainties. The degrees of freedom are those of s², combined by Welch and Satterthwaite (JCGM 100,
        G.4.1). There, s² is enlarged by its relative variance 2/ν as in `rotation_readings`. Two vectors determine s²
        poorly. For them only τ² counts as the part with ν = 1, so that k = 12.7 remains for scatter far beyond the
        stated uncertainties.
        """
        stated = np.einsum("qp,npr,qr->nq", gradient, self.covariances, gradient)
        variance, dof = stated.mean(axis=0) / len(stated), np.full(len(gradient), np.inf)
        shared = np.concatenate([self.scale[None], self.shapes, self.external_changes])
        common = np.sum((gradient @ shared.T) ** 2, axis=1)
        if self.scatter_dof:
            off = (self.vectors - self.vectors.mean(axis=0)) @ gradient.T
            square = np.sum(off**2, axis=0) / self.scatter_dof
            beyond = np.maximum(square - stated.mean(axis=0), 0.0)
            variance = variance + beyond / len(stated)
            part = beyond if self.scatter_dof == 1 else np.where(beyond > 0.0, square, 0.0)
            of_scatter = np.minimum(part / len(stated), variance)
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


class HypothesisModel(NamedTuple):
    """The model if one device released the load in another shape; its distance in u."""

    model: ModalModel
    distance: float


def pool_models(
    found: Contributions,
    mountings: Sequence[str],
    u_scale: float = 0.0,
    influences: ModelInfluences = NO_INFLUENCES,
    alternatives: Sequence[HypothesisModel] = (),
) -> PooledModel:
    """Return the model of R releases with the scatter between them.

    The mean is taken in the coordinates of `to_coordinates`, in which static gain and lag are linear. A mean of
    residues and frequencies of weak poles would change the static gain. Several mountings determine the scatter; the
    releases of a mounting then count as one. `u_scale`: relative standard uncertainty of all residues together, by the
    scales of load and output, which averaging does not reduce. `influences`: influences that no record shows, which
    averaging does not reduce either. `alternatives`: other models that the records do not reject.
    """
    vectors, covariances, modes, reals = *found[1:3], len(found.model.frequency_hz), len(found.model.real_hz)
    groups = [np.flatnonzero(np.array(mountings) == name) for name in dict.fromkeys(mountings)]
    if len(groups) > 1:
        count, middle, within = len(vectors), vectors.mean(axis=0), []
        for group in groups:
            share = len(groups) * len(group) / count if found.joint else 1.0
            apart = vectors[group] if not found.joint else middle + share * (vectors[group] - middle)
            within.append(random_effects_mean(apart, share**2 * covariances[group]))
        vectors, covariances = np.stack([m.value for m in within]), np.stack([m.covariance for m in within])
    mean = random_effects_mean(vectors, covariances)
    step = np.maximum(STEP * np.sqrt(np.diag(mean.covariance)), 10.0 * ROUNDING * coordinate_sizes(mean.value, reals))

    def parameters(move: FloatArray) -> FloatArray:
        return from_coordinates(mean.value + move, modes, reals, found.frame)

    value, back = parameters(np.zeros(len(step))), derivatives(parameters, step)
    common = u_scale * np.repeat([0.0, 1.0, 0.0, 1.0], [2 * modes, 2 * modes, reals, reals]) * value
    model = found.model.with_vector(value)
    other = influences.effects(lambda *part: model.altered(*part).vector)
    there = [(to_coordinates(one.model, found.frame) - mean.value) / one.distance for one in alternatives]
    shapes = np.array(there).reshape(-1, len(value)) @ back.T
    shared = np.concatenate([common[None], shapes, other])
    covariance = back @ mean.covariance @ back.T + shared.T @ shared
    model, scatter = replace(model, covariance=covariance), back @ mean.scatter @ back.T
    spread = value + (vectors - mean.value) @ back.T
    return PooledModel(model, spread, back @ covariances @ back.T, common, shapes, other, scatter)


def random_effects_mean(vectors: FloatArray, covariances: FloatArray) -> VectorMean:
    """Return the mean of vectors (N, P) with random effects between them.

    `covariances` (N, P, P): of the vectors. The part of the sample covariance S beyond the mean of the stated variances
    is scatter. T = D·S·D with D = diag(τ/s) and τ² = max(0, s² - mean u²) for each parameter (method of moments;
    Searle, Casella & McCulloch 1992, Variance Components, 3.6). The covariance is Σ(C + T)/N². All vectors weigh
    alike: a weight by the variance that a vector states depends on its value, and would shift the mean.
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
    return VectorMean(vectors.mean(axis=0), (covariances.mean(axis=0) + between) / count, counted / count)


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
    discontinuous in steps of half periods. They have the interval of `settling_interval` with the degrees of freedom of
    the damping ratio, and U is its longer side.
    """
    model = pooled.model
    found = indices(model.system, nominal or 1.0, sample_rate_hz)
    names, moving = moving_figures(model, found)
    slope = model.jacobian(moving)[1]
    dominant = None if found.dominant is None else found.dominant.pole

    def figures(move: FloatArray) -> FloatArray:  # NaN for an index that is not defined
        moved = indices(model.with_move(move).system, nominal or 1.0, dominant=dominant).figures()
        return np.array([moved[name] for name in names], dtype=np.float64)

    seen = find_figure_range(np.asarray(model.covariance), slope, figures)
    u, dof = pooled.spread(slope)
    u, dof = (seen.factor * u).tolist(), dof.tolist()
    estimated = dict(zip(names, zip(u, dof, strict=True), strict=True))
    of_damping = estimated.get("damping_ratio", (0.0, np.inf))[1]
    quantities = []
    for name, value in found.figures().items():
        if value is not None and np.isfinite(value) and (nominal is not None or "nominal" not in name):
            index_unit = unit if name == "static_gain" else unit_of(name) or "1"
            if name in SETTLING:
                quantities.append(_settling(model, name, value, of_damping))
                continue
            uncertainty = estimated.get(name, (np.nan, np.inf))
            quantities.append(NamedQuantity(value, *uncertainty, index_unit, name, LABELS[name]))
    parts = pooled.budget(slope, influences)
    budget = {cause: dict(zip(names, (seen.factor * part).tolist(), strict=True)) for cause, part in parts.items()}
    return IndexResults(tuple(quantities), (*found.notices, *seen.notices(names)), budget)


def _settling(model: ModalModel, name: str, value: float, dof: float) -> NamedQuantity:
    """Return a settling time with its interval; U is the longer side."""
    k = coverage_factor(dof)
    ends = settling_interval(model, SETTLING[name], k)
    low, high = (np.nan, np.nan) if ends is None else ends
    u = max(value - low, high - value) / k
    return NamedQuantity(value, u, dof, unit_of(name), name, LABELS[name], low=low, high=high)
