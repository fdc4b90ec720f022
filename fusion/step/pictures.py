"""The figures of step.html, from the evaluation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fusion.plots.step import RopeCurve, StepCurve, draw_ropes, draw_step
from fusion.plots.step_models import BodeCurve, Convergence, draw_bode, draw_convergence
from fusion.plots.style import Picture
from fusion.step.methods import LABELS
from fusion.step.pool import Pooled
from fusion.step.result import ComponentResult, MethodRow, Release
from fusion.step.spectra import measured_response
from shaker._checks import FloatArray
from shaker.models.modal import ModalModel

POINTS = 500
HIGHEST = 6.0
"""Frequencies shown, over the highest mode."""
PERIODS = 12.0
SHOWN_RELEASES = 3
OVER_ORDER = ("sim", "sim_zoh")
OVER_GENERATION = ("evolution", "evolution_coefficients")


def component_pictures(component: ComponentResult) -> Iterator[Picture]:
    """Yield record and fit of the first release of the model, response over frequency, ropes, and convergence."""
    if component.pooled is not None:
        yield draw_step(f"step-{component.component}", _step_curve(component.chosen[0]))
        yield draw_bode(f"bode-{component.component}", _bode_curve(component, component.pooled))
    if len(component.ropes) > 1:
        yield draw_ropes(f"ropes-{component.component}", component.channel, list(_rope_curves(component)))
    curves = list(_convergence(component.methods))
    if curves:
        yield draw_convergence(f"convergence-{component.component}", curves)


def _step_curve(release: Release) -> StepCurve:
    """Record and fit of a release."""
    record, fit = release.input.record, release.fit
    if fit is None:
        raise ValueError("release: expected one with a model, found none")
    return StepCurve(
        recording=release.name,
        channel=release.driven,
        unit=record.unit,
        time_s=fit.time_s,
        measured=fit.fitted + fit.residual,
        fitted=fit.fitted,
        baseline=release.reading.baseline,
        steady=release.reading.steady,
        onset_s=fit.onset_s,
        release_s=fit.release_s,
        period_s=_period_s(fit.model),
    )


def _period_s(model: ModalModel | None) -> float:
    """Period of the lowest mode, of a model without one that of its slowest real pole."""
    if model is None:
        return 1e-3
    return 1.0 / float(np.min(model.frequency_hz if len(model.frequency_hz) else np.abs(model.real_hz)))


def _bode_curve(component: ComponentResult, pooled: Pooled) -> BodeCurve:
    """The pooled model and what its releases show by themselves."""
    model, static = pooled.model, pooled.model.static_gain
    found = [measured_response(release) for release in component.chosen[:SHOWN_RELEASES]]
    rate_hz = min(release.input.record.sample_rate_hz for release in component.chosen)
    highest_hz = float(np.max(model.frequency_hz if len(model.frequency_hz) else np.abs(model.real_hz)))
    top_hz = min(0.4 * rate_hz, HIGHEST * highest_hz)
    low_hz = min(float(one.frequency_hz.min()) for one in found)
    frequency = _around(model, np.geomspace(low_hz, top_hz, POINTS))

    def size(at: ModalModel) -> FloatArray:
        return np.asarray(np.log(np.abs(at.response(frequency) / at.static_gain)))

    u, _ = pooled.spread(model.jacobian(size)[1])
    kept = [one.frequency_hz <= top_hz for one in found]
    measured_hz = np.concatenate([one.frequency_hz[k] for one, k in zip(found, kept, strict=True)])
    ends = [component.figure(name) for name in ("band_5_hz", "band_10_hz")]
    return BodeCurve(
        channel=component.channel,
        component=component.component,
        frequency_hz=frequency,
        value=model.response(frequency) / static,
        u=u,
        measured_hz=measured_hz,
        measured=np.asarray(np.concatenate([one.value[k] for one, k in zip(found, kept, strict=True)]) / static),
        noise=np.concatenate([one.u[k] for one, k in zip(found, kept, strict=True)]) / abs(static),
        model_there=model.response(measured_hz) / static,
        bands_hz=tuple(np.nan if end is None else end.value for end in ends),
    )


def _around(model: ModalModel, frequency_hz: FloatArray) -> FloatArray:
    """Frequencies (K,) with more of them where a mode is narrow."""
    extra = [
        f * (1.0 + z * np.linspace(-8.0, 8.0, 81))
        for f, z in zip(model.frequency_hz, np.maximum(np.abs(model.damping_ratio), 1e-5), strict=True)
    ]
    every = np.unique(np.concatenate([frequency_hz, *extra]))
    return np.asarray(every[(every >= frequency_hz[0]) & (every <= frequency_hz[-1])])


def _rope_curves(component: ComponentResult) -> Iterator[RopeCurve]:
    """The first release by each rope, over the longest of the releases and some periods."""
    periods = [_period_s(r.fit.model) for r in component.releases if r.fit is not None]
    longest = max(rope.kind.length.mean for rope in component.ropes)
    span = 1.5 * longest + PERIODS * float(np.median(periods) if periods else longest)
    for rope in component.ropes:
        release = next(r for r in component.releases if r.name in rope.releases)
        record, reading = release.input.record, release.reading
        onset = reading.onset_s if release.fit is None else release.fit.onset_s
        time = record.time_s - onset
        shown = (time >= -0.1 * span) & (time <= span)
        level = record.samples[record.channels.index(release.driven)]
        share = (level - reading.baseline) / (reading.steady - reading.baseline)
        yield RopeCurve(rope.name, release.name, time[shown], share[shown], rope.kind.length.mean)


def _convergence(rows: Sequence[MethodRow]) -> Iterator[Convergence]:
    """SIM's loss over the order once, and the loss of differential evolution over the generations."""
    for row in rows:
        fit, method = row.fit, row.fit.method
        if method == OVER_ORDER[0] and len(fit.convergence) > 1:
            chosen = fit.order - 1 if 1 <= fit.order <= len(fit.convergence) else None
            yield Convergence(LABELS[method].partition(",")[0], "order", fit.convergence, chosen)
        elif method in OVER_GENERATION and len(fit.convergence) > 1:
            yield Convergence(LABELS[method], "generation", fit.convergence, None)
