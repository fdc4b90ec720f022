"""The rows of releases.csv, models.csv, indices.csv and methods.csv, in SI and with full precision."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fusion.results_csv import Row
from fusion.step.figures import Figure
from fusion.step.result import ComponentResult, MethodRow, Release, StepEvaluation
from shaker.models.step.reading import Reading

RELEASE_COLUMNS = [
    "recording",
    "component",
    "release",
    "mounting",
    "channel",
    "driven",
    "used",
    "step_amplitude",
    "onset_s",
    "u_onset_s",
    "sign",
    "baseline",
    "u_baseline",
    "steady",
    "u_steady",
    "unit",
    "rise_s",
    "u_rise_s",
    "shape",
    "release_s",
    "u_release_s",
    "static_gain",
    "u_static_gain",
    "noise",
    "peak_1_hz",
    "u_peak_1_hz",
    "peak_2_hz",
    "u_peak_2_hz",
    "peak_2_share",
    "fit_onset_s",
    "fit_u_onset_s",
    "fit_release_s",
    "fit_u_release_s",
    "fit_frequency_hz",
    "fit_damping_ratio",
    "fit_residual",
    "fit_variance_accounted",
]
NUMBER_COLUMNS = ["component", "channel", "name", "value", "u", "U", "k", "unit", "dof", "recordings"]
METHOD_COLUMNS = [
    "component",
    "channel",
    "recording",
    "method",
    "sample_rate_hz",
    "order",
    "stable",
    "natural_hz",
    "damping_ratio",
    "static_gain",
    "unit",
    "band_5_hz",
    "band_10_hz",
    "overshoot",
    "settling_2_s",
    "residual",
    "variance_accounted",
    "duration_s",
]
NO_PEAK = (float("nan"), float("nan"))


def release_rows(evaluation: StepEvaluation) -> Iterator[Row]:
    """One row per recording and output, the driven output first; what rests on a model stands with that one."""
    for component in evaluation.components:
        for release in component.releases:
            for reading in release.readings:
                yield _release_row(component, release, reading)


def model_rows(evaluation: StepEvaluation) -> Iterator[Row]:
    """One row per parameter of every model."""
    for component in evaluation.components:
        yield from _number_rows(component, component.parameters)


def index_rows(evaluation: StepEvaluation) -> Iterator[Row]:
    """One row per index of every model; then the static gain of every output as it was read, over all releases."""
    for component in evaluation.components:
        yield from _number_rows(component, component.figures)
        names = ", ".join(release.name for release in component.releases)
        for gain in component.gains:
            numbers: Row = [gain.value, gain.u, gain.expanded, gain.k]
            unit = component.unit
            yield [component.component, gain.channel, "read_static_gain", *numbers, unit, gain.dof, names]


def method_rows(evaluation: StepEvaluation) -> Iterator[Row]:
    """One row per method and release."""
    for component in evaluation.components:
        for row in component.methods:
            yield _method_row(component, row)


def residual_rms(row: MethodRow) -> float:
    """Root mean square of what a fit leaves, in output units."""
    return float(np.sqrt(np.mean(row.fit.residual**2)))


def _release_row(component: ComponentResult, release: Release, reading: Reading) -> Row:
    """What one output of one release shows."""
    driven = reading.channel == release.driven
    record, fit = release.input.record, release.fit if driven else None
    first, second = [
        (reading.peaks[n].frequency_hz, reading.peaks[n].u_frequency_hz) if len(reading.peaks) > n else NO_PEAK
        for n in (0, 1)
    ]
    share = reading.peaks[1].share if len(reading.peaks) > 1 else float("nan")
    of_load: Row = ["", "", "", "", "", "", "", ""]
    if fit is not None:
        mode = _first_mode(release)
        rest = float(np.sqrt(np.mean(fit.residual**2)))
        times = [fit.onset_s, fit.u_onset_s, fit.release_s, fit.u_release_s]
        of_load = [*times, *mode, rest, fit.variance_accounted]
    return [
        release.name,
        component.component,
        record.release,
        release.input.manifest.mounting,
        reading.channel,
        "yes" if driven else "no",
        "yes" if driven and release.name in component.used else "no",
        record.amplitude,
        reading.onset_s,
        reading.u_onset_s,
        reading.sign,
        reading.baseline,
        reading.u_baseline,
        reading.steady,
        reading.u_steady,
        reading.unit,
        reading.rise_s,
        reading.u_rise_s,
        reading.shape,
        reading.release_s,
        reading.u_release_s,
        reading.static_gain,
        reading.u_static_gain,
        reading.noise,
        *first,
        *second,
        share,
        *of_load,
    ]


def _first_mode(release: Release) -> tuple[float, float]:
    """Natural frequency and damping ratio of the lowest mode of a release's model."""
    model = None if release.fit is None else release.fit.model
    if model is None or not len(model.frequency_hz):
        return float("nan"), float("nan")
    place = int(np.argmin(model.frequency_hz))
    return float(model.frequency_hz[place]), float(model.damping_ratio[place])


def _number_rows(component: ComponentResult, figures: Sequence[Figure]) -> Iterator[Row]:
    """One row per number of a component's model."""
    names = ", ".join(component.used)
    for figure in figures:
        numbers: Row = [figure.value, figure.u, figure.expanded, figure.k]
        yield [component.component, component.channel, figure.name, *numbers, figure.unit, figure.dof, names]


def _method_row(component: ComponentResult, row: MethodRow) -> Row:
    """What one method made of one release."""
    fit, found = row.fit, None if row.indices is None else row.indices.figures()
    names = ("natural_hz", "damping_ratio", "static_gain")
    after = ("band_5_hz", "band_10_hz", "overshoot", "settling_2_s")
    values = {name: np.nan if found is None else found[name] for name in (*names, *after)}
    known = {name: float(np.nan) if value is None else float(value) for name, value in values.items()}
    stable = "yes" if fit.system.stable else "no"
    head: Row = [component.component, component.channel, row.recording, fit.method, fit.sample_rate_hz, fit.order]
    main: Row = [stable, *(known[name] for name in names), component.unit, *(known[name] for name in after)]
    return [*head, *main, residual_rms(row), fit.variance_accounted, fit.duration_s]
