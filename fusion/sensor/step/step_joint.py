"""One model of the releases of a component: sound releases, structure, shapes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from fusion.base import count_text
from fusion.sensor import model_notices as declared
from fusion.sensor.step.step_pool import Contributions, RivalModel, of_joint, of_models
from fusion.sensor.step.step_records import StepSettings
from fusion.sensor.step.step_releases import (
    FAILURES,
    UNNAMED,
    StepRelease,
    choose_releases,
    fit_common_shape,
    fit_release,
)
from shaker.release.joint_fit import ReleasesFit, fit_jointly
from shaker.release.load_response import BlockMeans, every_sample
from shaker.release.model_order import STEEP
from shaker.release.record import ReleaseShape
from shaker.release.step_fit import StepFit, describe_difference
from shakercal._common.fitting import REJECT_CHI2, excess_chi2_sigmas
from shakercal._common.notices import Notice

# Releases whose fits cannot be averaged with the others.

_BAD_FIT = 3.0  # residual over the noise at rest, relative to that of the other releases, of a fit that is rejected
_OTHER_MODE = 0.1  # relative difference of a mode from that of the other releases beyond which it is another mode
_OTHER_MODE_U = 5.0  # the same over the standard uncertainty of the mode


def unsound(releases: Sequence[StepRelease]) -> dict[str, str]:
    """Return why the fits of some releases cannot be averaged with the others, by name.

    A mode grows, a small mode is damped so much that it is drift, or the residual is far above the noise at rest,
    compared with the other releases.
    """
    found = dict[str, str]()
    misfit = {release.name: _misfit(release) for release in releases}
    usual = float(np.median([*misfit.values()])) if misfit else 1.0
    for release in releases:
        model = None if release.fit is None else release.fit.model
        if model is None:
            continue
        small = np.ones(len(model.frequency_hz), dtype=np.bool_)
        small[np.argmax(np.abs(model.residue / model.poles[: len(small)]))] = False
        growing, drift = (
            model.frequency_hz[one] for one in (model.damping_ratio <= 0.0, small & (model.damping_ratio > STEEP))
        )
        if len(growing):
            found[release.name] = f"its mode at {growing[0]:.4g} Hz grows"
        elif len(drift):
            found[release.name] = f"its mode at {drift[0]:.4g} Hz hardly oscillates"
        elif len(releases) > 2 and misfit[release.name] > _BAD_FIT * max(usual, 1.0):
            factors = f"{misfit[release.name]:.2g} times the noise at rest, with {usual:.2g} times in most releases"
            found[release.name] = f"its residual is {factors}"
    return found


def _misfit(release: StepRelease) -> float:
    """Return the residual over the noise at rest, 1 without a fit or noise."""
    noise = release.reading.noise
    return 1.0 if release.fit is None or noise <= 0.0 else float(np.std(release.fit.residual)) / noise


def other_modes(releases: Sequence[StepRelease]) -> dict[str, str]:
    """Return the releases of one structure with a mode that lies elsewhere, by name."""
    models = {r.name: r.fit.model for r in releases if r.fit is not None and r.fit.model is not None}
    if len(models) < 3:
        return {}
    hertz = {name: np.sort(model.frequency_hz) for name, model in models.items()}
    usual, found = np.median([*hertz.values()], axis=0), dict[str, str]()
    for name, model in models.items():
        covariance = model.covariance
        u = np.zeros(len(usual)) if covariance is None else np.sqrt(np.diag(covariance))[np.argsort(model.frequency_hz)]
        off = np.abs(hertz[name] - usual)
        far = np.flatnonzero((off > _OTHER_MODE * usual) & (off > _OTHER_MODE_U * u))
        if len(far):
            found[name] = f"its mode at {hertz[name][far[0]]:.4g} Hz is one at {usual[far[0]]:.4g} Hz in most releases"
    return found


# The model of all releases: structure, and shape by device.

Structure = tuple[int, int]


def fit_together(
    releases: Sequence[StepRelease], shapes: Mapping[str, ReleaseShape], structure: Structure
) -> ReleasesFit | None:
    """Return the model of all releases, None without one; `shapes`: by device."""
    chosen = [_of_shape(release, shapes[release.record.release]) for release in releases]
    solutions = [fit.solution for fit in chosen if fit.solution is not None]
    own = [
        s.problem.structure for s in solutions if (s.problem.structure.modes, s.problem.structure.reals) == structure
    ]
    if len(solutions) < len(releases) or not own:
        return None
    try:
        return fit_jointly(solutions, [_samples(release) for release in releases], own[0])
    except FAILURES:
        return None


def _of_shape(release: StepRelease, shape: ReleaseShape) -> StepFit:
    """Return the fit of a shape, the likeliest if there is none."""
    return next((fit for fit in release.shapes if fit.shape == shape), release.shapes[0])


def _samples(release: StepRelease) -> BlockMeans:
    """Return all samples of the driven output."""
    record = release.record
    value = record.samples[record.channels.index(release.driven)]
    return every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)


def likeliest_structure(releases: Sequence[StepRelease], shapes: Mapping[str, ReleaseShape]) -> ReleasesFit | None:
    """Return the model of all releases with their likeliest structure, None without one."""
    structures = dict.fromkeys(release.structure for release in releases if release.structure is not None)
    joints = [joint for one in structures if (joint := fit_together(releases, shapes, one)) is not None]
    return min(filter(_is_sound, joints), key=lambda joint: joint.cost, default=None)


def _is_sound(joint: ReleasesFit) -> bool:
    """Return whether no mode grows."""
    return bool(np.all(joint.model.damping_ratio > 0.0))


def common_structure(releases: Sequence[StepRelease]) -> Structure:
    """Return the most frequent number of modes, and its largest number of real poles.

    A real pole far above the modes appears in few releases only.
    """
    structures = [release.structure for release in releases if release.structure is not None]
    counts = Counter(modes for modes, _ in structures)
    modes = max(counts, key=lambda number: (counts[number], number))
    return modes, max(reals for number, reals in structures if number == modes)


class Alternative(NamedTuple):
    """The model for another shape of the load by one device, and its notice."""

    model: RivalModel
    notice: Notice | None


class CommonModel(NamedTuple):
    """The contributions of releases to one model, and the models of other release shapes."""

    contributions: Contributions
    alternatives: tuple[Alternative, ...]


def shared_model(releases: Sequence[StepRelease], component: str) -> CommonModel | None:
    """Return the model fitted to all releases, None if they do not share one.

    The shape of the load is that which makes all records the likeliest. Other shapes of a device with χ² larger by less
    than 9 are alternatives.
    """
    devices = dict.fromkeys(release.record.release for release in releases)
    shapes: dict[str, ReleaseShape] = {
        device: next(r.shapes[0].shape for r in releases if r.record.release == device) for device in devices
    }
    best = likeliest_structure(releases, shapes)
    if best is None:
        return None
    structure, others = (
        (len(best.model.frequency_hz), len(best.model.real_hz)),
        list[tuple[str, ReleaseShape, ReleasesFit]](),
    )
    for device in devices:
        of_device = [release for release in releases if release.record.release == device]
        for shape in dict.fromkeys(fit.shape for release in of_device for fit in release.shapes):
            if shape == shapes[device] or not _may_be(of_device, shape, structure):
                continue
            joint = fit_together(releases, shapes | {device: shape}, structure)
            if joint is None or not _is_sound(joint):
                continue
            others.append((device, shape, joint))
            if joint.cost < best.cost:
                others[-1] = (device, shapes[device], best)
                best, shapes[device] = joint, shape
    if not best.consistent:
        return None
    alternatives = []
    for device, shape, joint in others:
        if joint.cost - best.cost < REJECT_CHI2:
            model = RivalModel(joint.model, excess_chi2_sigmas(joint.cost - best.cost))
            first = next(release for release in releases if release.record.release == device)
            pair = (
                replace(_of_shape(first, shapes[device]), model=best.model),
                replace(_of_shape(first, shape), model=joint.model),
            )
            alternatives.append(Alternative(model, _shape_notice(device, component, pair)))
    return CommonModel(of_joint(best), tuple(alternatives))


_HOPELESS = 30.0  # excess of χ² in the releases' own fits from which a shape is not fitted to all releases


def _may_be(releases: Sequence[StepRelease], shape: ReleaseShape, structure: Structure) -> bool:
    """Return whether the fits of releases, if of the structure, permit a shape."""
    same = [release for release in releases if release.structure == structure]
    return sum(fit.excess for release in same for fit in release.shapes if fit.shape == shape) < _HOPELESS


def _shape_notice(device: str, component: str, pair: tuple[StepFit, StepFit]) -> Notice | None:
    """Return the notice of an undetermined shape, None for a small difference."""
    difference = describe_difference(*pair)
    if not difference:
        return None
    return Notice(declared.SHAPE_OF_DEVICE_UNDETERMINED, component, device=device or UNNAMED, shapes=difference)


def averaged_model(releases: Sequence[StepRelease], component: str) -> CommonModel:
    """Return the mean of the models of releases that differ by more than their noise."""
    models = [release.shapes[0].model for release in releases]
    found = of_models([model for model in models if model is not None])
    alternatives = []
    for device in dict.fromkeys(release.record.release for release in releases if release.excess < REJECT_CHI2):
        undetermined = [release.record.release == device and release.excess < REJECT_CHI2 for release in releases]
        others = [release.shapes[int(other)].model for release, other in zip(releases, undetermined, strict=True)]
        mean = of_models([model for model in others if model is not None]).mean_model
        first = releases[undetermined.index(True)]
        notice = _shape_notice(device, component, (first.shapes[0], first.shapes[1]))
        alternatives.append(Alternative(RivalModel(mean, excess_chi2_sigmas(first.excess)), notice))
    return CommonModel(found, tuple(alternatives))


# Fits of the releases of a component, and the model of all of them.


class FittedReleases(NamedTuple):
    """The fitted releases of one component, and the model of those that are selected.

    `notices`: releases that were not fitted, or fitted again; `refitted`: names of the latter; `common`: None without a
    model.
    """

    releases: tuple[StepRelease, ...]
    chosen: tuple[StepRelease, ...]
    reason: str
    notices: tuple[Notice, ...]
    refitted: tuple[str, ...] = ()
    common: CommonModel | None = None


def fit_component(releases: Sequence[StepRelease], settings: StepSettings) -> FittedReleases:
    """Fit all releases of a component, and one model to those that are selected.

    Where the releases do not share a model, those of another structure than most are fitted again with that structure,
    and rejected if this fails.
    """
    fits, of_fits = zip(*(fit_release(release, settings) for release in releases), strict=True)
    sound, refitted, notices = _sound(fits, settings)
    notices = [*chain.from_iterable(of_fits), *notices]
    fitted = fit_common_shape(sound)
    chosen, reason = choose_releases(fitted)
    if not chosen:
        return FittedReleases(_latest(fits, fitted), (), reason, tuple(notices))
    component = releases[0].record.component
    common = shared_model(chosen, component)
    if common is None:
        chosen, refit, of_structure = _of_one_structure(chosen, settings)
        common, refitted = averaged_model(chosen, component), [*refitted, *refit]
        notices += [*of_structure, Notice(declared.RELEASES_AVERAGED, component, count=len(chosen))]
    return FittedReleases(_latest(fits, fitted, chosen), chosen, reason, tuple(notices), tuple(refitted), common)


def _latest(*series: Sequence[StepRelease]) -> tuple[StepRelease, ...]:
    """Return the releases of the first series, each as the last series has it."""
    latest = {release.name: release for releases in series for release in releases}
    return tuple(latest[release.name] for release in series[0])


def _sound(
    releases: Sequence[StepRelease], settings: StepSettings
) -> tuple[list[StepRelease], list[str], list[Notice]]:
    """Return sound releases, names of those fitted again, and notices of the others."""
    reasons, found, refitted, notices = unsound(releases), list[StepRelease](), list[str](), list[Notice]()
    sound = [release for release in releases if release.name not in reasons]
    for release in releases:
        if release.name not in reasons:
            found.append(release)
            continue
        refit = _with_fewer_modes(release, sound, settings)
        if refit is None:
            where, channel, reason = release.name, release.driven, reasons[release.name]
            notices.append(Notice(declared.RELEASE_NOT_AVERAGED, where, channel=channel, reason=reason))
            continue
        found.append(refit)
        refitted.append(release.name)
    return found, refitted, notices


def _with_fewer_modes(release: StepRelease, sound: Sequence[StepRelease], settings: StepSettings) -> StepRelease | None:
    """Return a release with as many modes as make its fit sound, None without any."""
    for modes in range((release.structure or (1, 1))[0] - 1, 0, -1):
        if settings.modes is None:
            refit, _ = fit_release(replace(release, fit=None, shapes=()), replace(settings, modes=modes))
            if refit.fit is not None and refit.name not in unsound([*sound, refit]):
                return refit
    return None


def _of_one_structure(
    releases: Sequence[StepRelease], settings: StepSettings
) -> tuple[tuple[StepRelease, ...], list[str], list[Notice]]:
    """Return releases of the most frequent structure, names of those fitted again, and notices."""
    structure, refitted, notices = common_structure(releases), list[str](), list[Notice]()
    counted = zip(structure, ("mode", "real pole"), strict=True)
    structure_text = " and ".join(count_text(count, kind) if count else f"no {kind}s" for count, kind in counted)
    found = list[StepRelease]()
    for release in releases:
        refit = release
        if release.structure != structure:
            refit, _ = fit_release(replace(release, fit=None, shapes=()), settings, structure)
            if refit.structure != structure or refit.name in unsound([refit]):
                name, channel = release.name, release.driven
                notices.append(Notice(declared.STRUCTURE_NOT_FOUND, name, channel=channel, structure=structure_text))
                continue
            refitted.append(release.name)
        found.append(refit)
    if refitted:
        notices.append(Notice(declared.RELEASES_REFITTED, ", ".join(refitted), structure=structure_text))
    elsewhere = other_modes(found)
    for name, reason in elsewhere.items():
        notices.append(Notice(declared.RELEASE_NOT_AVERAGED, name, channel=releases[0].driven, reason=reason))
    return fit_common_shape([one for one in found if one.name not in elsewhere]), refitted, notices
