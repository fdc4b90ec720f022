"""Influence of single views: calibration without each view, and its prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from photogram.calibration.adjust import AdjustedBundle, RigPrior, adjust, residuals
from photogram.calibration.bundle import Bundle, ImageObservations
from photogram.calibration.initial_bundle import refine_pose
from photogram.camera import StereoRig
from shakercal._common.arrays import FloatArray

_LEAST = 1e-9  # of the largest variance: smaller ones are rounding


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Changes of a calibration when each view is left out in turn.

    Attributes
    ----------
    steps : (V, 32), change of the rig's parameters, by one Gauss–Newton step from the normal equations of the whole
        fit.
    drift_steps : (V, D), change of the focal drift.
    expected : (32, 32), covariance of the sum of these changes by point noise alone: Σ (Hᵥ)⁻¹ − H⁻¹ of the normal
        equations without and with the view.
    prediction_residuals : Residuals (N, 2) of each image, in the order of the fit, predicted by the other views with
        only the target's pose fitted.
    """

    steps: FloatArray
    drift_steps: FloatArray
    expected: FloatArray
    prediction_residuals: tuple[FloatArray, ...]


def leave_views_out(adjusted: AdjustedBundle, images: Sequence[ImageObservations] = ()) -> LeaveOneOut:
    """Return the fit without each of its views in turn.

    `images` are predicted, with the weights of the fit.
    """
    normal, bundle = adjusted.normal, adjusted.bundle
    block, common, free = (
        np.ix_(normal.parameter_index, normal.parameter_index),
        len(normal.prior),
        len(normal.parameter_index),
    )
    steps, drifts, expected = [], [], np.zeros_like(adjusted.covariance)
    prediction: list[FloatArray] = [np.empty((0, 2))] * len(images)
    for view in range(len(bundle.poses)):
        reduced = normal.reduced(without=view)
        side = np.zeros(len(reduced.matrix))
        side[:common] = normal.common_side.sum(axis=0) + normal.prior_side - normal.common_side[view]
        side[common:] = np.delete(normal.pose_side, view, axis=0).ravel()
        point_side = normal.point_side.sum(axis=0) + normal.point_prior_side - normal.point_side[view]
        step, pose_steps = normal.spread(*reduced.solve(side, point_side))
        steps.append(step[: len(expected)])
        drifts.append(step[len(step) - normal.drifts :])
        expected[block] += reduced.covariance()[:free, :free] - adjusted.covariance[block]
        members = [n for n, image in enumerate(images) if image.view == view]
        if members:
            others = bundle.with_step(step, np.insert(pose_steps, view, 0.0, axis=0))
            for n, residual in zip(members, predict_view(others, [images[n] for n in members]), strict=True):
                prediction[n] = residual
    return LeaveOneOut(np.array(steps), np.array(drifts), expected, tuple(prediction))


def drift_uncertainty(adjusted: AdjustedBundle, left_out: LeaveOneOut, factor: float) -> FloatArray:
    """Return the standard uncertainties (D,) of a drift.

    The larger one of that by residuals and that by the jackknife over the views.
    """
    views = len(left_out.drift_steps)
    by_views = (views - 1) / views * (left_out.drift_steps**2).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(adjusted.drift_variance * factor, by_views)))


def predict_view(bundle: Bundle, images: Sequence[ImageObservations]) -> list[FloatArray]:
    """Return the residuals (N, 2) of one view's images with only the target's pose fitted."""
    single = [replace(image, view=0) for image in images]
    one = bundle.of_views([images[0].view])
    pose, _, _ = refine_pose(one, single)
    return residuals(replace(one, poses=(pose,)), single)


def stated_covariance(covariance: FloatArray, left_out: LeaveOneOut, factor: float) -> FloatArray:
    """Return the covariance (32, 32) of the rig, including the scatter of its views.

    `covariance` of the fit times the reduced χ² `factor` is the contribution of the residuals. The delete-one-view
    jackknife (Efron and Stein 1981, Annals of Statistics 9, 586; clusters: Cameron and Miller 2015, Journal of Human
    Resources 50, 317) gives that of the views, whatever their errors have in common. Its principal variances are
    expressed in units of the covariance by point noise alone. V samples of N parameters reach (1 + √(N/V))² by chance
    (Marčenko and Pastur 1967, Mathematics of the USSR-Sbornik 1, 457). Larger variances replace the noise. They are
    reduced by the contribution of the others to the largest of few samples (Baik and Silverstein 2006, Journal of
    Multivariate Analysis 97, 1382). The factor (V − 1)/(V − 3) covers the few views (JCGM 101:2008, 6.4.9), so that k =
    2 covers 95 %.
    """
    free = np.flatnonzero(np.diagonal(covariance) > 0)
    views, block = len(left_out.steps), np.ix_(free, free)
    fit = covariance[block] * factor
    expected = left_out.expected[block] * factor * (views - 1) / views
    scale = np.sqrt(np.maximum(np.diagonal(expected), _LEAST * np.diagonal(fit)))
    size, axes = np.linalg.eigh(expected / np.outer(scale, scale))
    size = np.sqrt(np.maximum(size, _LEAST * size[-1]))
    white = (left_out.steps[:, free] / scale) @ axes / size * np.sqrt(views - 1)  # unit variances by noise alone
    variance, turn = np.linalg.eigh(white.T @ white / views)
    few, ratio = (views - 1) / max(views - 3, 1), len(free) / views
    sum_ = variance + 1 - ratio  # a variance v among unit variances is estimated as v + v·ratio/(v − 1)
    true = (sum_ + np.sqrt(np.maximum(sum_**2 - 4 * variance, 0.0))) / 2
    more = np.where(variance > (1 + np.sqrt(ratio)) ** 2, few * true - 1, 0.0)
    root = scale[:, None] * (axes * size) @ turn * np.sqrt(more)
    stated = covariance * factor
    stated[block] += root @ root.T
    return stated


def split_half(
    adjusted: AdjustedBundle, images: Sequence[ImageObservations], prior: RigPrior
) -> tuple[StereoRig, StereoRig]:
    """Return the rigs of every second view and of the others."""
    bundle = adjusted.bundle
    views, rigs = len(bundle.poses), []
    for first in (0, 1):
        number = {view: row for row, view in enumerate(range(first, views, 2))}
        half = [replace(image, view=number[image.view]) for image in images if image.view in number]
        rigs.append(adjust(bundle.of_views(list(number)), half, prior, near=True).bundle.rig)
    return rigs[0], rigs[1]
