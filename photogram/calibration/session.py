"""Calibration of a stereo pair, with covariance and tests, from target views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Literal

import numpy as np

from photogram.calibration.adjust import (
    AdjustedBundle,
    LeaveOneOut,
    RigPrior,
    adjust,
    drift_uncertainty,
    leave_views_out,
    residuals,
    split_half,
    stated_covariance,
)
from photogram.calibration.bundle import DRIFT_SPREAD, Bundle, FocalDrift, ImageObservations, ShapeKind
from photogram.calibration.calibration_result import (
    AlternativeModel,
    CalibratedImage,
    CalibratedView,
    Calibration,
    CrossValidation,
    Rejection,
    check_focal_lengths,
    coverage_share,
    rig_parameters,
    session_notices,
)
from photogram.calibration.initial_bundle import (
    FEWEST_VIEWS,
    START_NOISE_PX,
    LensKind,
    ViewPair,
    image_observations,
    lens_prior,
    start_bundle,
)
from photogram.calibration.view_clusters import pose_clusters, reject_copies, repeated_variance
from photogram.camera import LEFT, RIGHT, TRANSLATION, StereoRig
from photogram.targets.target_view import Target, TargetView
from shakercal._common.arrays import BoolArray, FloatArray, IntArray

_ROUNDS = 12  # limit of the rounds; some four are usual
_REJECTED = 25.0  # squared distance of an outlier, in standard deviations
_MEDIAN_CHI2 = 2 * np.log(2.0)  # median of χ² with two degrees of freedom
_REJECTED_SHARE = 0.3  # share of rejected points beyond which the whole image is rejected
_SCATTER = 5.0  # times the upper quartile of the images' scatter, beyond which an image is rejected
_WORTH = 1.0  # added variance over that of the points above which other models are tried
_VIEWS_FOR_MORE = 5  # least number of poses for a comparison of models
_VIEWS_TO_HALVE = 8  # least number of poses for two halves
_CHANCE = 0.01  # level of the test for a drift
_SETTLED = 0.01  # relative change of the added noise that ends the rounds
_SETTLED_SPREAD = 0.1  # and of the spread of free points, which converges slowly if it is small


def calibrate_pair(
    pairs: Sequence[ViewPair],
    target: Target,
    shape: ShapeKind | Literal["auto"] = "auto",
    scale_u: float = 0.0,
    lens: LensKind | Literal["auto"] = "auto",
) -> Calibration:
    """Calibrate a stereo pair from views of a target.

    Parameters
    ----------
    pairs
        Views (left, right) of each target pose; None for an image without a target. Without any right view, the
        result is a single camera, the left one; the values of the right one are meaningless.
    target
        The target, with its spacing in m.
    shape
        "flat", "bowed", "free" or, by default, "auto".
    scale_u
        Relative standard uncertainty of the target's spacing; default 0.
    lens
        "polynomial" (OpenCV's five coefficients), "rational" (three more) or, by default, "auto".

    Returns
    -------
    The pair with the covariance of all its parameters, its views and notices.

    Raises
    ------
    ValueError : The views do not determine a calibration.

    Notes
    -----
    Maximum likelihood over all images at once. The residuals determine a noise common to all points of a camera (print,
    paper, blooming), in addition to the points' covariance. Points beyond five standard deviations are rejected, then
    images with too many such points, until the selection is stable. The covariance is that of the fit times the reduced
    χ², or that of the leave-one-view-out changes if it is larger. `scale_u` is added along the baseline: all lengths
    grow with the spacing. "auto" is flat and polynomial. A model with free points or a rational lens replaces it if it
    predicts the points of a view better from the other views. A drift of the focal lengths beyond the scatter of the
    views is estimated; the result is that of the middle of the session, and its covariance includes the drift.

    Examples
    --------
    >>> from photogram.synthetic.board import random_poses, random_rig, simulate_session
    >>> rng, board, size = np.random.default_rng(1), Board(Target("chessboard", 9e-3, (8, 6))), np.array([1280, 1024])
    >>> rig = random_rig(rng, size, field_m=0.12)
    >>> pairs = simulate_session(rng, rig, random_poses(rng, rig, board, 8), board, noise_px=0.02)
    >>> calibration = calibrate_pair(pairs, board.target, shape="flat")
    >>> calibration.rms_px < 0.03
    True
    """
    single = all(right is None for _, right in pairs)
    pairs, copies = reject_copies(pairs)
    first = _Model("flat" if shape == "auto" else shape, "polynomial" if lens == "auto" else lens, single)
    best = _calibrated(pairs, target, first)
    others: list[_Fit] = []
    if best.unexplained > _WORTH and best.session.poses >= _VIEWS_FOR_MORE:
        for step in ("free", "rational", "free", "flat"):
            model = best.model
            if step in ("free", "flat") and shape == "auto":
                model = replace(model, shape="free" if step == "free" else "flat")
            elif step == "rational" and lens == "auto":
                model = replace(model, lens="rational")
            if model in (best.model, *(other.model for other in others)):
                continue
            try:
                tried = _calibrated(pairs, target, model)
            except ValueError:  # a model that the views do not determine
                continue
            better = _predicts_better(tried, best) if step != "flat" else not _predicts_better(best, tried)
            others.append(best if better else tried)
            best = tried if better else best
    if best.session.poses >= _VIEWS_FOR_MORE and _drifting(best):
        best = _calibrated(pairs, target, replace(best.model, drifts=True))
    return _result(replace(best, dropped=(*copies, *best.dropped)), others, target, scale_u)


@dataclass(frozen=True)
class _Model:
    """Target geometry and lens model, single camera or pair, with or without focal drift."""

    shape: ShapeKind
    lens: LensKind
    single: bool = False
    drifts: bool = False

    def prior(self, rig: StereoRig) -> RigPrior:
        """Return the prior of the cameras."""
        return lens_prior(rig, self.lens, self.single)


def _calibrated(pairs: Sequence[ViewPair], target: Target, model: _Model) -> _Fit:
    """Return the fit with all rejections, including images inconsistent with the others."""
    dropped: tuple[Rejection, ...] = ()
    while True:
        bundle, pairs, dropped_at_start = start_bundle(pairs, target, model.shape)
        session = _Session.of(bundle, pairs, target)
        if model.lens == "rational":  # starts at the best polynomial: its curved valley is short there
            bundle = adjust(bundle, session.weighted(), replace(model, lens="polynomial").prior(bundle.rig)).bundle
        if model.drifts:
            bundle = replace(bundle, drift=FocalDrift.initial(len(bundle.poses)))
        fit = _settle(bundle, session, model)
        bad = _bad_images(fit)
        dropped += (*dropped_at_start, *bad)
        if not bad:
            prior = model.prior(fit.rig)
            left_out = leave_views_out(fit.adjusted, fit.session.weighted(), fit.session.cluster, prior)
            return replace(fit, dropped=dropped, left_out=left_out)
        names = [None, *(item.name for item in bad)]
        remaining = [[view if view and view.name not in names else None for view in pair] for pair in pairs]
        pairs = [(left, right) for left, right in remaining if left is not None or right is not None]


def _drifting(fit: _Fit) -> bool:
    """Return whether the focal lengths of a camera drift significantly with the order of views.

    Student's t of both drifts, with the scatter of single views, at a level of 1 % for both together.
    """
    start = replace(fit.adjusted.bundle, drift=FocalDrift.initial(len(fit.adjusted.bundle.poses)))
    adjusted = adjust(start, fit.session.weighted(), fit.model.prior(start.rig), near=True)
    assert adjusted.bundle.drift is not None
    u = drift_uncertainty(adjusted, leave_views_out(adjusted, (), fit.session.cluster), fit.factor)
    t = float((np.abs(adjusted.bundle.drift.value) / u).max())
    if t < NormalDist().inv_cdf(1 - _CHANCE / 4):  # Student's quantiles are larger; SciPy is not needed
        return False
    from scipy.special import stdtrit

    return bool(t > stdtrit(fit.session.poses - 1, 1 - _CHANCE / 4))


def _predicts_better(fit: _Fit, other: _Fit) -> bool:
    """Return whether this fit predicts left-out views significantly better than the other.

    The criterion is the logarithm of the ratio of the residuals' mean squares, for the points used in both fits. Its
    mean over the poses has to be below minus its standard uncertainty.
    """
    theirs = dict(zip((view.name for view in other.session.views), other.predictions, strict=True))
    squares: dict[int, list[FloatArray]] = {}
    for view, image, (residual_first, used) in zip(fit.session.views, fit.session.images, fit.predictions, strict=True):
        if view.name in theirs:
            both = used & theirs[view.name][1]
            pair = [(residual[both] ** 2).sum(axis=1) for residual in (residual_first, theirs[view.name][0])]
            squares.setdefault(int(fit.session.cluster[image.view]), []).append(np.array(pair))
    sums = [np.concatenate(parts, axis=1).sum(axis=1) for parts in squares.values()]
    ratio = np.log([squares_first / their for squares_first, their in sums if squares_first > 0 and their > 0])
    return len(ratio) > 1 and bool(ratio.mean() < -ratio.std(ddof=1) / np.sqrt(len(ratio)))


@dataclass(frozen=True, eq=False)
class _Session:
    """The images with the points (N,) used and the added noise (left, right).

    `cluster` (V,): number of the pose that each view shows. `repeated_px2` (I,): variance added to each image as one of
    several of its pose.
    """

    views: tuple[TargetView, ...]
    images: tuple[ImageObservations, ...]
    used: tuple[BoolArray, ...]
    added_px: tuple[float, float]
    cluster: IntArray
    repeated_px2: FloatArray

    @property
    def poses(self) -> int:
        """Number of different poses."""
        return int(self.cluster.max()) + 1

    @staticmethod
    def of(bundle: Bundle, pairs: Sequence[ViewPair], target: Target) -> _Session:
        """Return the session before the first round."""
        views, images = [], []
        radius = float(np.median([view.radius for pair in pairs for view in pair if view is not None]))
        for number, pair in enumerate(pairs):
            for side, view in enumerate(pair):
                if view is not None:
                    same = replace(view, radius=radius)
                    views.append(same)
                    images.append(image_observations(same, number, side, bundle.shape.index, target.spacing_m))
        used = tuple(np.ones(len(view.index), np.bool_) for view in views)
        start, cluster = (START_NOISE_PX, START_NOISE_PX), pose_clusters(bundle)
        if cluster.max() + 1 < FEWEST_VIEWS:
            raise ValueError(
                f"the {len(cluster)} views show {cluster.max() + 1} different poses of the target, at least "
                f"{FEWEST_VIEWS} are needed"
            )
        return _Session(tuple(views), tuple(images), used, start, cluster, np.zeros(len(images)))

    def weighted(self, alone: bool = False) -> tuple[ImageObservations, ...]:
        """Return the images weighted for this round, rejected points by 0.

        `alone`: with the precision of each without the others of its pose, also of rejected points.
        """
        weighted = []
        for view, image, used, more in zip(self.views, self.images, self.used, self.repeated_px2, strict=True):
            added = self.added_px[image.side] ** 2 + (0.0 if alone else more)
            precision = np.asarray(np.linalg.inv(view.covariance_px2 + added * np.eye(2)), dtype=np.float64)
            weighted.append(replace(image, precision=precision * (used | alone)[:, None, None]))
        return tuple(weighted)

    def repetition(self) -> float:
        """Return how many images determine as much as one pose, averaged over the points."""
        every, effective = 0.0, 0.0
        for view, image, used, more in zip(self.views, self.images, self.used, self.repeated_px2, strict=True):
            alone = float(np.einsum("nii->n", view.covariance_px2).mean()) / 2 + self.added_px[image.side] ** 2
            every += float(used.sum())
            effective += float(used.sum()) * alone / (alone + more)
        return every / effective


@dataclass(frozen=True, eq=False)
class _Fit:
    """Converged fit with residuals (N, 2) and whitened squares (N,) of every point.

    `parameters`: effective number of those of rig, drift and target geometry.
    """

    session: _Session
    adjusted: AdjustedBundle
    model: _Model
    residuals: tuple[FloatArray, ...]
    squares: tuple[FloatArray, ...]
    dof: float
    parameters: float
    dropped: tuple[Rejection, ...] = ()
    left_out: LeaveOneOut | None = None

    @property
    def unexplained(self) -> float:
        """Added variance over the variance of the points."""
        point_variance = np.median(
            [np.median(np.einsum("nii->n", view.covariance_px2) / 2) for view in self.session.views]
        )
        return float(np.mean(np.square(self.session.added_px)) / point_variance)

    @property
    def factor(self) -> float:
        """Reduced χ²."""
        taken = zip(self.squares, self.session.used, strict=True)
        return sum(float(squares[used].sum()) for squares, used in taken) / self.dof

    @property
    def drift(self) -> FloatArray | None:
        """Relative focal drift and its standard uncertainty (2, 2): left, right."""
        drift = self.adjusted.bundle.drift
        if drift is None:
            return None
        assert self.left_out is not None
        return np.column_stack([drift.value, drift_uncertainty(self.adjusted, self.left_out, self.factor)])

    @property
    def predictions(self) -> list[tuple[FloatArray, BoolArray]]:
        """Residuals (N, 2) predicted by the other views, and the used points (N,)."""
        assert self.left_out is not None
        return list(zip(self.left_out.prediction_residuals, self.session.used, strict=True))

    @property
    def covariance(self) -> FloatArray:
        """Covariance (32, 32) of the rig, including the scatter of the views."""
        assert self.left_out is not None
        stated = stated_covariance(self.adjusted.covariance, self.left_out, self.factor)
        drift = self.adjusted.bundle.drift
        if drift is not None:  # in use, the drift may be anywhere in the range of the session
            change = np.zeros(len(stated))
            for camera, indices, value in zip((self.rig.left, self.rig.right), (LEFT, RIGHT), drift.value, strict=True):
                change[indices[:2]] = camera.parameters[:2] * value
            stated += np.outer(change, change) / 12
        return stated

    @property
    def rig(self) -> StereoRig:
        """The fitted pair, without covariance."""
        return self.adjusted.bundle.rig


def _settle(bundle: Bundle, session: _Session, model: _Model) -> _Fit:
    """Adjust, estimate the noise and reject points until the selection is stable."""
    for number in range(_ROUNDS):
        fit = _fit(bundle, session, model, near=number > 0)
        bundle = fit.adjusted.bundle
        shape = bundle.shape.with_prior_from(fit.adjusted.shape_variance)
        after = _select_points(fit)
        same = all(np.array_equal(a, b) for a, b in zip(after.used, session.used, strict=True))
        change = np.abs(np.subtract(after.added_px, session.added_px)) / np.maximum(session.added_px, 1e-3)
        spread = np.abs(shape.prior_m / bundle.shape.prior_m - 1)
        weight = np.abs(after.repetition() / session.repetition() - 1)
        if same and max(*change, weight) < _SETTLED and (spread < _SETTLED_SPREAD).all():
            return fit
        bundle, session = replace(bundle, shape=shape), after
    return _fit(bundle, session, model, near=True)


def _fit(bundle: Bundle, session: _Session, model: _Model, near: bool) -> _Fit:
    """Adjust once with the session's weights."""
    adjusted = adjust(bundle, session.weighted(), model.prior(bundle.rig), near)
    images = session.weighted(alone=True)
    differences = residuals(adjusted.bundle, images)
    both = zip(differences, images, strict=True)
    squares = tuple(np.einsum("ni,nij,nj->n", residual, each.precision, residual) for residual, each in both)
    # Number of coordinates minus effective number of parameters, which priors reduce
    drift = np.full(len(adjusted.drift_variance), DRIFT_SPREAD)
    prior = np.concatenate([model.prior(adjusted.bundle.rig).sigma, adjusted.bundle.shape.prior_m, drift])
    variance = np.concatenate([np.diagonal(adjusted.covariance), adjusted.shape_variance, adjusted.drift_variance])
    determined = variance[prior > 0] / prior[prior > 0] ** 2
    parameters = float(np.sum(1 - determined))
    coordinates = 2 * sum(int(used.sum()) for used in session.used)
    dof = coordinates - parameters * session.repetition() - 6 * len(adjusted.bundle.poses)
    if dof < 1:
        raise ValueError("the images have fewer points than a calibration has unknowns; add views")
    return _Fit(session, adjusted, model, tuple(differences), squares, dof, parameters)


def _select_points(fit: _Fit) -> _Session:
    """Return the session with the noise of the residuals and without outliers.

    The noise is from the median, which outliers do not change. All points are tested again, so rejected ones may
    return. In an image with larger residuals the limit is relative to that image's median. A smaller limit or weight
    there would make the remaining images agree on a wrong result.
    """
    session = fit.session
    share = 2 * sum(len(used) for used in session.used) / fit.dof
    added = []
    for side in (0, 1):
        mine = [n for n, image in enumerate(session.images) if image.side == side]
        if not mine:
            added.append(0.0)
            continue
        length2 = np.concatenate([(fit.residuals[n][session.used[n]] ** 2).sum(axis=1) for n in mine])
        variance = np.concatenate([np.einsum("nii->n", session.views[n].covariance_px2)[session.used[n]] for n in mine])
        added.append(float(np.sqrt(max(np.median(length2) / _MEDIAN_CHI2 * share - np.median(variance) / 2, 0.0))))
    repeated = repeated_variance(session.cluster, session.images, fit.residuals, session.used, fit.parameters)
    anew = replace(session, added_px=(added[0], added[1]), repeated_px2=repeated)
    precision = [image.precision for image in anew.weighted(alone=True)]
    squares = [np.einsum("ni,nij,nj->n", r, p, r) for r, p in zip(fit.residuals, precision, strict=True)]
    scale = max(1.0, float(np.median(np.concatenate(squares))) / _MEDIAN_CHI2)
    limits = [_REJECTED * max(scale, float(np.median(square)) / _MEDIAN_CHI2) for square in squares]
    return replace(anew, used=tuple(square <= limit for square, limit in zip(squares, limits, strict=True)))


def _bad_images(fit: _Fit) -> list[Rejection]:
    """Return the images whose points scatter much more than the others, or are mostly rejected."""
    session, bad = fit.session, []
    spread = np.array([np.sqrt(np.median((residual**2).sum(axis=1))) for residual in fit.residuals])
    typical = float(np.quantile(spread, 0.75))
    for view, used, scatter in zip(session.views, session.used, spread, strict=True):
        share = 1 - used.mean()
        if share > _REJECTED_SHARE:
            reason = (
                f"{100 * share:.0f} % of its points deviate by more than {np.sqrt(_REJECTED):.0f} standard deviations"
            )
            bad.append(Rejection(view.name, 0, reason))
        elif scatter > _SCATTER * typical:
            reason = f"its points scatter by {scatter:.2f} px, those of the others by {typical:.2f} px"
            bad.append(Rejection(view.name, 0, reason))
    return bad


def _result(fit: _Fit, others: Sequence[_Fit], target: Target, scale_u: float) -> Calibration:
    """Return the calibration of a converged fit."""
    bundle, session, factor = fit.adjusted.bundle, fit.session, fit.factor
    prior = fit.model.prior(bundle.rig)
    covariance = fit.covariance
    baseline = np.zeros(len(covariance))
    baseline[TRANSLATION] = bundle.rig.right_from_left.translation_m
    rig = replace(bundle.rig, covariance=covariance + scale_u**2 * np.outer(baseline, baseline))
    images = [
        CalibratedImage(view.name, view.index, view.position_px, residual, np.sqrt(squares / factor), used)
        for view, residual, squares, used in zip(session.views, fit.residuals, fit.squares, session.used, strict=True)
    ]
    left_out = [
        Rejection(image.name, int((~image.used).sum()), "more than five standard deviations away")
        for image in images
        if not image.used.all()
    ]
    views = []
    for number, pose in enumerate(bundle.poses):
        sides = {p.side: seen for p, seen in zip(session.images, images, strict=True) if p.view == number}
        covariance = fit.adjusted.pose_covariance[number] * factor
        views.append(CalibratedView(pose, covariance, sides.get(0), sides.get(1), int(session.cluster[number])))
    by_side = [[seen for p, seen in zip(session.images, images, strict=True) if p.side == s] for s in (0, 1)]
    off, off_left, off_right = ([(seen.residual_px, seen.used) for seen in each] for each in (images, *by_side))
    parameters = rig_parameters(rig, prior.sigma)
    check_focal_lengths(parameters)
    calibration = Calibration(
        rig=rig,
        target=target,
        views=tuple(views),
        parameters=parameters,
        rms_px=_rms(off),
        rms_sides_px=(_rms(off_left), _rms(off_right)),
        added_px=session.added_px,
        sigma_factor=float(np.sqrt(factor)),
        dof=fit.dof,
        shape_index=bundle.shape.index,
        shape_m=bundle.shape.points_m,
        scale_u=scale_u,
        image_coverage=(
            coverage_share(by_side[0], rig.left.size_px),
            coverage_share(by_side[1], rig.right.size_px) if by_side[1] else float("nan"),
        ),
        rejections=(*fit.dropped, *left_out),
        notices=(),
        cross_validation=_judgement(fit, others, prior),
        shape_u_m=np.sqrt(factor * fit.adjusted.shape_variance[:-2]).reshape(-1, 3) if bundle.shape.free else None,
    )
    return replace(calibration, notices=session_notices(calibration))


def _judgement(fit: _Fit, others: Sequence[_Fit], prior: RigPrior) -> CrossValidation:
    """Return the cross-validation of the views and of alternative models."""
    session, enough = fit.session, fit.session.poses >= _VIEWS_TO_HALVE
    u_fit = np.sqrt(np.diagonal(fit.adjusted.covariance) * fit.factor)
    tried = [
        AlternativeModel(other.model.shape, other.model.lens, other.adjusted.bundle.rig, _rms(other.predictions))
        for other in others
    ]
    return CrossValidation(
        fit.model.shape,
        fit.model.lens,
        _rms(fit.predictions),
        u_fit,
        split_half(fit.adjusted, session.weighted(), prior, session.cluster) if enough else None,
        tuple(tried),
        fit.drift,
    )


def _rms(residuals: Sequence[tuple[FloatArray, BoolArray]]) -> float:
    """Return the rms length of the residuals (N, 2) of the points used (N,)."""
    squares = [(residual[used] ** 2).sum(axis=1) for residual, used in residuals]
    every = np.concatenate(squares) if squares else np.empty(0)
    return float(np.sqrt(every.mean())) if every.size else float("nan")
