"""One model of the releases of a component: sound releases, structure, shapes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from fusion.base import count_text
from fusion.sensor import model_notices as declared
from fusion.sensor.step.step_pool import Contributions, HypothesisModel, of_joint, of_models
from fusion.sensor.step.step_records import StepSettings
from fusion.sensor.step.step_releases import (
    FAILURES,
    UNNAMED,
    StepRelease,
    choose_releases,
    fit_common_shape,
    fit_release,
)
from shaker.lti.system import ModalModel
from shaker.release.amplitude_dependence import EVENLY, SIGNIFICANT, amplitude_dependence
from shaker.release.joint_fit import ReleasesFit, fit_jointly
from shaker.release.load_response import BlockMeans, every_sample
from shaker.release.model_order import STEEP
from shaker.release.shape_hypotheses import OtherHypothesis, with_both_lags
from shaker.release.step_fit import (
    BOTH_IN_CHAIN,
    PREFERENCE,
    SLOW_CHAIN,
    StepFit,
    alternative_fits,
    describe_difference,
    lag_notice,
)
from shakercal._common.fitting import REJECT_CHI2
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


def fit_together(releases: Sequence[StepRelease], kinds: Mapping[str, str], structure: Structure) -> ReleasesFit | None:
    """Return the model of all releases, None without one; `kinds`: hypotheses by device."""
    chosen = [_of_kind(release, kinds[release.record.release]) for release in releases]
    solutions = [fit.solution for fit in chosen if fit.solution is not None]
    own = [
        s.problem.structure for s in solutions if (s.problem.structure.modes, s.problem.structure.reals) == structure
    ]
    if len(solutions) < len(releases) or not own:
        return None
    try:
        return fit_jointly(
            solutions, [_samples(release) for release in releases], own[0], [_noise(r) for r in releases]
        )
    except FAILURES:
        return None


def _noise(release: StepRelease) -> float:
    """Return the variance of a sample that the best fit of a release leaves."""
    return min(fit.solution.variance for fit in release.shapes if fit.solution is not None)


def _of_kind(release: StepRelease, kind: str) -> StepFit:
    """Return the fit of a hypothesis, the likeliest if there is none."""
    return next((fit for fit in release.shapes if fit.hypothesis == kind), release.shapes[0])


def _samples(release: StepRelease) -> BlockMeans:
    """Return all samples of the driven output."""
    record = release.record
    value = record.samples[record.channels.index(release.driven)]
    return every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)


def likeliest_structure(releases: Sequence[StepRelease], kinds: Mapping[str, str]) -> ReleasesFit | None:
    """Return the model of all releases with their likeliest structure, None without one."""
    structures = dict.fromkeys(release.structure for release in releases if release.structure is not None)
    joints = [joint for one in structures if (joint := fit_together(releases, kinds, one)) is not None]
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


class OtherModel(NamedTuple):
    """The model for another shape of the load by one device, and its notice."""

    model: HypothesisModel
    notice: Notice | None


class CommonModel(NamedTuple):
    """The contributions of releases to one model, and the models of other release shapes."""

    contributions: Contributions
    alternatives: tuple[OtherModel, ...]


class _Rival(NamedTuple):
    """The model of all releases for another hypothesis of a device's releases."""

    device: str
    kind: str
    joint: ReleasesFit

    @property
    def cost(self) -> float:
        """χ² and what its unknowns count; lags that are attributed otherwise count as less likely."""
        return self.joint.cost + _LESS_LIKELY.get(self.kind, 0.0)


_LESS_LIKELY = {"exponential": PREFERENCE, f"exponential, {SLOW_CHAIN}": 2.0 * PREFERENCE}


def shared_model(releases: Sequence[StepRelease], component: str) -> CommonModel | None:
    """Return the model fitted to all releases, None if they do not share one.

    The hypothesis on the load is that which makes all records the likeliest. Others of a device with χ² larger by less
    than 9 are alternatives.
    """
    kinds = {release.record.release: release.shapes[0].hypothesis for release in reversed(releases)}
    joint = likeliest_structure(releases, kinds)
    if joint is None:
        return None
    structure, others = (len(joint.model.frequency_hz), len(joint.model.real_hz)), list[_Rival]()
    for device in dict.fromkeys(release.record.release for release in releases):
        of_device = [release for release in releases if release.record.release == device]
        best = _Rival(device, kinds[device], joint)
        for kind in dict.fromkeys(f.hypothesis for r in of_device for f in r.shapes if f.solution is not None):
            if kind == kinds[device] or not _may_be(of_device, kind, structure):
                continue
            found = fit_together(releases, kinds | {device: kind}, structure)
            if found is None or not _is_sound(found):
                continue
            rival = _Rival(device, kind, found)
            if rival.cost < best.cost:
                best, rival = rival, best
                joint, kinds[device] = best.joint, best.kind
            others.append(rival)
    if not joint.consistent:
        return None
    alternatives = [one for device in kinds for one in _alternatives(releases, component, kinds, joint, device, others)]
    return CommonModel(of_joint(joint), (*alternatives, *_amplitudes(releases, component, joint.model)))


def _alternatives(
    releases: Sequence[StepRelease],
    component: str,
    kinds: Mapping[str, str],
    joint: ReleasesFit,
    device: str,
    rivals: Sequence[_Rival],
) -> Iterator[OtherModel]:
    """Yield the models of other hypotheses of a device, each with its notice."""
    release = next(release for release in releases if release.record.release == device)
    fits = [replace(_of_kind(release, kinds[device]), model=joint.model, excess=0.0)]
    for rival in rivals:
        if rival.device == device and rival.joint.cost - joint.cost < REJECT_CHI2:
            excess = max(0.0, rival.joint.cost - joint.cost)
            fits.append(replace(_of_kind(release, rival.kind), model=rival.joint.model, excess=excess))
    lags = [fit for fit in fits if fit.shape == "exponential"]
    if len(lags) == 2:  # either attribution of the lags is possible, and so is that of both to the chain
        both = with_both_lags(lags[0].model or joint.model, lags[0].release_s)
        excess = max(fit.excess for fit in lags)
        fits.append(replace(lags[0], model=both, attribution=BOTH_IN_CHAIN, excess=excess))
    yield from _with_notices(fits, component, device, lambda fit, end: HypothesisModel(end.model, end.distance))


def _with_notices(
    fits: Sequence[StepFit], component: str, device: str, made: Callable[[StepFit, OtherHypothesis], HypothesisModel]
) -> Iterator[OtherModel]:
    """Yield the models that `made` returns for fits that are not rejected."""
    lag = lag_notice(fits, component)
    for fit, end in alternative_fits(fits):
        notice, lag = lag, None
        if notice is None and fit.shape not in ("exponential", fits[0].shape):
            text = describe_difference(fits[0], fit)
            shapes = Notice(declared.SHAPE_OF_DEVICE_UNDETERMINED, component, device=device or UNNAMED, shapes=text)
            notice = shapes if text else None
        yield OtherModel(made(fit, end), notice)


def _amplitudes(releases: Sequence[StepRelease], component: str, model: ModalModel) -> Iterator[OtherModel]:
    """Yield the models of small and of the first amplitudes, if they may differ."""
    fits = [(fit.model, fit.solution) for fit in (release.shapes[0] for release in releases)]
    solutions = [solution for of_fit, solution in fits if solution is not None and of_fit is not None]
    found = amplitude_dependence(solutions, _DOUBTFUL)
    if found is None:
        return
    hertz = float(np.exp(solutions[0].vector[found.mode])) / (2.0 * np.pi)
    change = replace(found, mode=int(np.argmin(np.abs(model.frequency_hz - hertz))))
    notice = change.notice(model, releases[0].record.unit, component) if found.chi_squared > SIGNIFICANT else None
    for moved, one in zip(change.changes(model), (notice, None), strict=True):
        yield OtherModel(HypothesisModel(model.with_vector(model.vector + moved), EVENLY), one)


_DOUBTFUL = 4.0  # χ² of a dependence on the amplitude that the records do not exclude and U includes
_HOPELESS = 30.0  # excess of χ² in the releases' own fits from which a hypothesis is not fitted to all releases


def _may_be(releases: Sequence[StepRelease], kind: str, structure: Structure) -> bool:
    """Return whether the fits of releases, if of the structure, permit a hypothesis."""
    same = [release for release in releases if release.structure == structure]
    return sum(fit.excess for release in same for fit in release.shapes if fit.hypothesis == kind) < _HOPELESS


def averaged_model(releases: Sequence[StepRelease], component: str) -> CommonModel:
    """Return the mean of the models of releases that differ by more than their noise."""
    found = of_models([model for release in releases if (model := release.shapes[0].model) is not None])
    alternatives = list[OtherModel]()
    for device in dict.fromkeys(release.record.release for release in releases if release.excess < REJECT_CHI2):
        ends = [
            {fit.hypothesis: end for fit, end in alternative_fits(r.shapes)} if r.record.release == device else {}
            for r in releases
        ]

        def mean(
            fit: StepFit, end: OtherHypothesis, ends: Sequence[dict[str, OtherHypothesis]] = ends
        ) -> HypothesisModel:
            models = [
                of_release[fit.hypothesis].model if fit.hypothesis in of_release else release.shapes[0].model
                for of_release, release in zip(ends, releases, strict=True)
            ]
            return HypothesisModel(of_models([model for model in models if model is not None]).mean_model, end.distance)

        first = next(r for r in releases if r.record.release == device and r.excess < REJECT_CHI2)
        alternatives += _with_notices(first.shapes, component, device, mean)
    return CommonModel(found, (*alternatives, *_amplitudes(releases, component, found.mean_model)))


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
