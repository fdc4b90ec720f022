"""Models of several releases become one: a weighted mean, with what releases or mountings scatter by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fusion.step.coordinates import from_coordinates, scale_of, sizes, to_coordinates
from shaker._checks import FloatArray
from shaker.models.modal import ModalModel

STEP = 1e-2
"""Standard uncertainties over which coordinates are moved for derivatives."""
ROUNDING = 1e-9
"""Part of a coordinate's size that is rounding."""


class Mean(NamedTuple):
    """Weighted mean (P,) of vectors with its covariance (P, P); `weight` (N,) of the vectors, their sum 1."""

    value: FloatArray
    covariance: FloatArray
    weight: FloatArray


@dataclass(frozen=True)
class Pooled:
    """One model from those of several releases.

    `model` with its whole covariance; `vectors` (N, P), `covariances` (N, P, P), `weights` (N,): of what was averaged
    last, releases or, where there are several, mountings, as parameters, linear about those of the mean. `scale` (P,):
    how the parameters move with one standard uncertainty of the scale that all share. `shares` (R,): of each release in
    the mean.
    """

    model: ModalModel
    vectors: FloatArray
    covariances: FloatArray
    weights: FloatArray
    scale: FloatArray
    shares: FloatArray

    @property
    def scattered(self) -> int:
        """Degrees of freedom of what the vectors scatter by."""
        return len(self.vectors) - 1

    def spread(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return standard uncertainties (Q,) of numbers with gradients (Q, P), and their degrees of freedom (Q,).

        u² = Σw²·(u_i² + τ²) + u_scale², τ² = s² - mean u_i² where the vectors scatter by more than is stated. Then
        the degrees of freedom are those of s², with the scale by Welch and Satterthwaite (JCGM 100, G.4.1), s² enlarged
        by its relative variance 2/ν as in `fusion.rotate.scatter`; of two vectors, whose s² tells little, only τ²
        counts as the part with ν = 1, so that k = 12.7 is left to scatter that is far beyond what is stated.
        """
        stated = np.einsum("qp,npr,qr->nq", gradient, self.covariances, gradient)
        variance, dof = self.weights**2 @ stated, np.full(len(gradient), np.inf)
        common = (gradient @ self.scale) ** 2
        if self.scattered:
            off = (self.vectors - self.vectors.mean(axis=0)) @ gradient.T
            square = np.sum(off**2, axis=0) / self.scattered
            beyond = np.maximum(square - stated.mean(axis=0), 0.0)
            by_square = float(np.sum(self.weights**2))
            variance = variance + by_square * beyond
            part = beyond if self.scattered == 1 else np.where(beyond > 0.0, square, 0.0)
            of_scatter = np.minimum(by_square * part, variance)
            dof = effective_dof(variance + common, of_scatter, self.scattered)
        return np.asarray(np.sqrt(variance + common)), np.asarray(dof)


def effective_dof(variance: FloatArray, of_scatter: FloatArray, dof: int) -> FloatArray:
    """Return degrees of freedom (Q,) of variances (Q,), of which parts have `dof` of them and the rest is known.

    Welch and Satterthwaite, the parts enlarged by their relative variance 2/ν; infinite without such a part.
    """
    wide = of_scatter * (1.0 + 2.0 / dof)
    rest = np.maximum(variance - of_scatter, 0.0)
    return np.asarray(dof * (1.0 + np.divide(rest, wide, out=np.full(len(wide), np.inf), where=wide > 0.0)) ** 2)


def pool_models(models: Sequence[ModalModel], mountings: Sequence[str], u_scale: float = 0.0) -> Pooled:
    """Return the mean of models (N) of one structure, mode by mode in rising frequency.

    Averaged are the coordinates of `to_coordinates`, in which static gain and lag are linear; a mean of residues and
    frequencies of poles that hardly show would have another static gain. Releases of one mounting are averaged first;
    where there are several mountings, these are then what scatters. `u_scale`: relative standard uncertainty of all
    residues together, of the load's and of the output's scale, which no average makes smaller.
    """
    ordered = [sorted_modes(model) for model in models]
    scale = scale_of(ordered[0])
    vectors, covariances = _in_coordinates(ordered, scale)
    groups = [np.flatnonzero(np.array(mountings) == name) for name in dict.fromkeys(mountings)]
    within = [weighted_mean(vectors[group], covariances[group]) for group in groups]
    if len(groups) > 1:
        vectors, covariances = np.stack([m.value for m in within]), np.stack([m.covariance for m in within])
    mean = weighted_mean(vectors, covariances) if len(groups) > 1 else within[0]
    shares = np.zeros(len(models))
    for group, own, share in zip(groups, within, mean.weight if len(groups) > 1 else [1.0], strict=True):
        shares[group] = share * own.weight
    value, back = _back(ordered[0], mean, scale)
    common = u_scale * _residues(ordered[0], value)
    model = replace(
        ordered[0].with_vector(value), covariance=back @ mean.covariance @ back.T + np.outer(common, common)
    )
    spread = value + (vectors - mean.value) @ back.T
    return Pooled(model, spread, back @ covariances @ back.T, mean.weight, common, shares)


def _in_coordinates(models: Sequence[ModalModel], scale: float) -> tuple[FloatArray, FloatArray]:
    """Coordinates (N, P) of models and their covariances (N, P, P), none where it is of rounding alone."""
    vectors, covariances = [], []
    for model in models:
        known = model if model.covariance is not None else replace(model, covariance=_covariance(model))
        found, slope = known.jacobian(lambda at: to_coordinates(at, scale))
        covariance = slope @ _covariance(known) @ slope.T
        told = np.sqrt(np.maximum(np.diag(covariance), 0.0)) > ROUNDING * sizes(found, len(model.real_hz))
        vectors.append(found)
        covariances.append(covariance * np.outer(told, told))
    return np.stack(vectors), np.stack(covariances)


def _back(model: ModalModel, mean: Mean, scale: float) -> tuple[FloatArray, FloatArray]:
    """The parameters (P,) of mean coordinates, and their derivatives (P, P) to these, by central differences."""
    modes, reals = len(model.frequency_hz), len(model.real_hz)
    step = np.maximum(STEP * np.sqrt(np.diag(mean.covariance)), 10.0 * ROUNDING * sizes(mean.value, reals))
    slope = np.zeros((len(step), len(step)))
    for place, by in enumerate(step):
        move = by * np.eye(len(step))[place]
        up, down = (from_coordinates(mean.value + sign * move, modes, reals, scale) for sign in (1.0, -1.0))
        slope[:, place] = (up - down) / (2.0 * by)
    return from_coordinates(mean.value, modes, reals, scale), slope


def weighted_mean(vectors: FloatArray, covariances: FloatArray) -> Mean:
    """Return the mean of vectors (N, P) with covariances (N, P, P) under random effects between them.

    Of the sample covariance S of the vectors, what exceeds the mean of the stated variances is scatter: T = D·S·D with
    D = diag(τ/s), τ² = max(0, s² - mean u²) for each parameter (method of moments; Searle, Casella & McCulloch 1992,
    Variance Components, 3.6); the covariance is Σw²·(C + T). A vector weighs by the geometric mean of its variances
    u² + τ², one number for all parameters, so that the mean stays between the vectors.
    """
    count, size = vectors.shape
    stated = np.einsum("npp->np", covariances)
    between: FloatArray = np.zeros((size, size))
    if count > 1:
        sample = np.cov(vectors, rowvar=False, ddof=1).reshape(size, size)
        square = np.diag(sample)
        excess = np.sqrt(np.maximum(square - stated.mean(axis=0), 0.0))
        share = np.divide(excess, np.sqrt(square), out=np.zeros(size), where=square > 0.0)
        between = share[:, None] * sample * share
    variance = stated + np.diag(between)
    known = np.all(variance > 0.0, axis=0)
    inverse = np.exp(-np.log(variance[:, known]).mean(axis=1)) if known.any() else np.ones(count)
    weight = inverse / inverse.sum()
    return Mean(weight @ vectors, np.einsum("n,npq->pq", weight**2, covariances + between), weight)


def sorted_modes(model: ModalModel) -> ModalModel:
    """Return the same model with modes and real poles in rising frequency."""
    modes, reals = np.argsort(model.frequency_hz), np.argsort(model.real_hz)
    count = len(modes)
    order = np.concatenate([*(part * count + modes for part in range(4)), 4 * count + reals])
    order = np.concatenate([order, 4 * count + len(reals) + reals])
    covariance = None if model.covariance is None else model.covariance[np.ix_(order, order)]
    return replace(model, covariance=covariance).with_vector(model.vector[order])


def _covariance(model: ModalModel) -> FloatArray:
    """The covariance of a model, nothing where it is not known."""
    return np.zeros((len(model.vector),) * 2) if model.covariance is None else model.covariance


def _residues(model: ModalModel, vector: FloatArray) -> FloatArray:
    """The residues' part of a vector (P,), zero elsewhere: how it moves with the scale of the output."""
    modes, reals = len(model.frequency_hz), len(model.real_hz)
    mask = np.repeat([0.0, 0.0, 1.0, 1.0, 0.0, 1.0], [modes, modes, modes, modes, reals, reals])
    return np.asarray(mask * vector)
