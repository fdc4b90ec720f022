"""Tables of step responses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, rounded, typeset
from fusion.estimation.uncertainty import coverage_factor
from fusion.report.numbers import degrees_of_freedom, factor, measured, number, short
from fusion.report.table import Column, Headline, Table, word
from fusion.sensor.step.records import Figure
from fusion.sensor.step.releases import LABELS, ComponentResult, MethodRow, Release, StaticGain, StepEvaluation
from shaker.release.reading import Spread
from shaker.release.record import Reading, SpectrumPeak
from shaker.release.sim import StepFit


def residual_rms(fit: StepFit) -> float:
    """Root mean square of what a fit leaves, in output units."""
    return float(np.sqrt(np.mean(fit.residual**2)))


def _lowest_mode(fit: StepFit) -> tuple[float, float]:
    """Natural frequency and damping ratio of the lowest mode of a model."""
    if fit.model is None or not len(fit.model.frequency_hz):
        return np.nan, np.nan
    place = int(np.argmin(fit.model.frequency_hz))
    return float(fit.model.frequency_hz[place]), float(fit.model.damping_ratio[place])


class Output(NamedTuple):
    """What one output of one release of a component shows; what rests on a model stands with the driven output."""

    component: ComponentResult
    release: Release
    reading: Reading

    @property
    def driven(self) -> bool:
        """Return whether the load was to act on this output."""
        return self.reading.channel == self.release.driven

    @property
    def fit(self) -> StepFit | None:
        """Return the model of the driven output."""
        return self.release.fit if self.driven else None

    def peak(self, place: int, name: str) -> float:
        """Return a number of a peak of the spectrum, NaN where there is none."""
        return float(getattr(self.reading.peaks[place], name)) if len(self.reading.peaks) > place else np.nan


def _of_reading(name: str) -> Column[Output]:
    """Column of what was read."""
    return Column(name, lambda output: getattr(output.reading, name))


def _of_peak(name: str, place: int, of_peak: str) -> Column[Output]:
    """Column of a peak of the spectrum."""
    return Column(name, lambda output: output.peak(place, of_peak))


def _of_fit(name: str, value: Callable[[StepFit], float]) -> Column[Output]:
    """Column of the model, empty without one."""
    return Column(name, lambda output: None if output.fit is None else value(output.fit))


RELEASES: list[Column[Output]] = [
    word("recording", lambda output: output.release.name),
    word("component", lambda output: output.component.component),
    word("release", lambda output: output.release.input.record.release),
    word("mounting", lambda output: output.release.input.manifest.mounting),
    word("channel", lambda output: output.reading.channel),
    word("driven", lambda output: "yes" if output.driven else "no"),
    word("used", lambda output: "yes" if output.driven and output.release.name in output.component.used else "no"),
    Column("step_amplitude", lambda output: output.release.input.record.amplitude),
    *map(_of_reading, ("onset_s", "u_onset_s", "sign", "baseline", "u_baseline", "steady", "u_steady", "unit")),
    *map(_of_reading, ("rise_s", "u_rise_s", "shape", "release_s", "u_release_s", "static_gain", "u_static_gain")),
    _of_reading("noise"),
    _of_peak("peak_1_hz", 0, "frequency_hz"),
    _of_peak("u_peak_1_hz", 0, "u_frequency_hz"),
    _of_peak("peak_2_hz", 1, "frequency_hz"),
    _of_peak("u_peak_2_hz", 1, "u_frequency_hz"),
    _of_peak("peak_2_share", 1, "share"),
    _of_fit("fit_onset_s", lambda fit: fit.onset_s),
    _of_fit("fit_u_onset_s", lambda fit: fit.u_onset_s),
    _of_fit("fit_release_s", lambda fit: fit.release_s),
    _of_fit("fit_u_release_s", lambda fit: fit.u_release_s),
    _of_fit("fit_frequency_hz", lambda fit: _lowest_mode(fit)[0]),
    _of_fit("fit_damping_ratio", lambda fit: _lowest_mode(fit)[1]),
    _of_fit("fit_residual", residual_rms),
    _of_fit("fit_variance_accounted", lambda fit: fit.variance_accounted),
]


class NumberRow(NamedTuple):
    """One parameter or index of a component's model, or a static gain as it was read, over its recordings."""

    component: str
    channel: str
    name: str
    value: float
    u: float
    U: float
    k: float
    unit: str
    dof: float
    recordings: str


class ByMethod(NamedTuple):
    """What one method made of one release of a component."""

    component: ComponentResult
    row: MethodRow


def _of_method(name: str) -> Column[ByMethod]:
    """Column of an index of a method's system, `nan` where it has none."""

    def value(by: ByMethod) -> float:
        found = None if by.row.indices is None else by.row.indices.figures()[name]
        return np.nan if found is None else float(found)

    return Column(name, value)


BY_METHOD: list[Column[ByMethod]] = [
    word("component", lambda by: by.component.component),
    word("channel", lambda by: by.component.channel),
    word("recording", lambda by: by.row.recording),
    word("method", lambda by: by.row.fit.method),
    Column("sample_rate_hz", lambda by: by.row.fit.sample_rate_hz),
    Column("order", lambda by: by.row.fit.order),
    word("stable", lambda by: "yes" if by.row.fit.system.stable else "no"),
    *map(_of_method, ("natural_hz", "damping_ratio", "static_gain")),
    word("unit", lambda by: by.component.unit),
    *map(_of_method, ("band_5_hz", "band_10_hz", "overshoot", "settling_2_s")),
    Column("residual", lambda by: residual_rms(by.row.fit)),
    Column("variance_accounted", lambda by: by.row.fit.variance_accounted),
    Column("duration_s", lambda by: by.row.fit.duration_s),
]


def outputs(evaluation: StepEvaluation) -> Iterator[Output]:
    """Every output of every recording, the driven output first."""
    for component in evaluation.components:
        for release in component.releases:
            for reading in release.readings:
                yield Output(component, release, reading)


def number_rows(component: ComponentResult, figures: Sequence[Figure]) -> Iterator[NumberRow]:
    """One row per number of a component's model."""
    names = ", ".join(component.used)
    for figure in figures:
        numbers = (figure.value, figure.u, figure.expanded, figure.k, figure.unit, figure.dof)
        yield NumberRow(component.component, component.channel, figure.name, *numbers, names)


def index_rows(evaluation: StepEvaluation) -> Iterator[NumberRow]:
    """One row per index of every model; then the static gain of every output as it was read, over all releases."""
    for component in evaluation.components:
        yield from number_rows(component, component.figures)
        names = ", ".join(release.name for release in component.releases)
        for gain in component.gains:
            numbers = (gain.value, gain.u, gain.expanded, gain.k, component.unit, gain.dof)
            yield NumberRow(component.component, gain.channel, "read_static_gain", *numbers, names)


K2 = 2.0
MILLI, PERCENT = 1e3, 100.0
SUMMARY = ("natural_hz", "damping_ratio", "band_5_hz", "band_10_hz", "overshoot", "settling_2_s")
SCALED = {"s": (MILLI, "ms")}
SHARES = ("damping_ratio", "overshoot")
"""Figures that are shares, told in %."""
MANY_HEADLINES = 6
NATURAL = Markup("f<sub>n</sub> / Hz")


def headlines(evaluation: StepEvaluation) -> list[Headline]:
    """Natural frequency and damping ratio of every driven output."""
    found: list[Headline] = []
    for component in evaluation.components:
        frequency, damping = component.figure("natural_hz"), component.figure("damping_ratio")
        if frequency is not None and damping is not None and len(found) < MANY_HEADLINES:
            releases = "1 release" if len(component.used) == 1 else f"{len(component.used)} releases"
            remark = f"ζ = {_scaled(damping)}; {releases}"
            found.append(Headline(f"{component.channel}: natural frequency", _scaled(frequency), remark))
    return found


def summary_table(evaluation: StepEvaluation) -> Table | None:
    """The main indices of every component, one below the other."""
    rows = []
    for component in evaluation.components:
        found = [component.figure(name) for name in SUMMARY]
        cells = (DASH if figure is None else _scaled(figure, with_unit=False) for figure in found)
        own = component.component == component.channel
        rows.append((component.component if own else f"{component.component} → {component.channel}", *cells))
    head = ("load", NATURAL, "ζ / %", "±5 % to / Hz", "±10 % to / Hz", "overshoot / %", "2 % settling / ms")
    return Table("Models of the driven outputs, with U", head, "lrrrrrr", tuple(rows)) if rows else None


def releases_table(component: ComponentResult) -> Table:
    """What the driven output of every release shows, and its model."""
    rows = []
    for release in component.releases:
        reading, fit = release.reading, release.fit
        gain = _ratio(reading.static_gain, K2 * reading.u_static_gain, component)
        rows.append(
            (
                release.name,
                release.input.record.release or DASH,
                measured(MILLI * reading.rise_s, K2 * MILLI * reading.u_rise_s),
                DASH if fit is None else measured(MILLI * fit.release_s, K2 * MILLI * fit.u_release_s),
                gain,
                *_mode_cells(release),
                DASH if fit is None else f"{PERCENT * fit.variance_accounted:.3f}",
                "yes" if release.name in component.used else "no",
            )
        )
    head = (
        "recording",
        "let go",
        "rise / ms",
        "release / ms",
        f"static gain / {_gain_unit(component)}",
        NATURAL,
        "ζ / %",
        "fit / %",
        "in the model",
    )
    return Table(f"Releases: output {component.channel}, with U (k = 2)", head, "llrrrrrrl", tuple(rows))


def ropes_table(component: ComponentResult) -> Table | None:
    """What lets go how fast, and how well it repeats."""
    if len(component.releases) < 2:
        return None
    rows = []
    for rope in component.ropes:
        kind = rope.kind
        cells = [cell for spread in (kind.rise, kind.length) for cell in _spread_cells(spread)]
        faster = DASH if np.isnan(kind.faster) else f"{PERCENT * kind.faster:.1f}"
        rows.append((rope.name, f"{kind.count}", *cells, faster, "yes" if rope.used else "no"))
    head = (
        "let go",
        "releases",
        "rise / ms",
        "s / ms",
        "release / ms",
        "s / ms",
        "faster than the next / %",
        "in the model",
    )
    caption = "What let go: rise of the output and duration of the release, means with U, scatter s of one release"
    return Table(caption, head, "lrrrrrrl", tuple(rows))


def parameters_table(component: ComponentResult) -> Table | None:
    """Poles and residues of the model."""
    if not component.parameters:
        return None
    rows = tuple(_figure_row(figure) for figure in component.parameters)
    return Table("Parameters of the model, with U", ("parameter", "value", "k", "dof"), "lrrr", rows)


def indices_table(component: ComponentResult) -> Table | None:
    """Resonance, bands, overshoot, rise and settling."""
    if not component.figures:
        return None
    rows = tuple(_figure_row(figure) for figure in component.figures)
    return Table("Indices of the model, with U", ("index", "value", "k", "dof"), "lrrr", rows)


def gains_table(component: ComponentResult) -> Table:
    """Static gain of every output for the load, with the peaks of its spectrum."""
    driven, rows = component.gains[0], []
    for gain in component.gains:
        share = DASH if gain is driven else f"{PERCENT * gain.value / driven.value:.3f}".replace("-", "\N{MINUS SIGN}")
        stated = DASH if gain.stated is None else _ratio(gain.stated, K2 * gain.u_stated, component)
        over = DASH if gain.normalised is None else f"{gain.normalised:.2f}".replace("-", "\N{MINUS SIGN}")
        cells = (_ratio(gain.value, gain.expanded, component), factor(gain.k), share, stated, over)
        rows.append((gain.channel, *cells, *_peak_cells(component, gain.channel)))
    unit = _gain_unit(component)
    head = (
        "output",
        f"static gain / {unit}",
        "k",
        f"of {driven.channel} / %",
        f"stated / {unit}",
        "difference over its U",
        "first peak / Hz",
        "second peak / Hz",
        "its share / %",
    )
    mean = "one release" if driven.releases == 1 else f"mean of {driven.releases} releases"
    caption = f"Every output for the load {component.component}: {mean}, with U"
    return Table(caption, head, "lrrrrrrrr", tuple(rows))


def methods_table(component: ComponentResult) -> Table | None:
    """What every method made of a release."""
    rows = []
    for row in component.methods:
        fit = row.fit
        rows.append(
            (
                LABELS[fit.method],
                row.recording,
                f"{fit.order}",
                _index(row, "natural_hz", "{:.2f}"),
                _index(row, "damping_ratio", "{:.4f}", PERCENT),
                _index(row, "band_5_hz", "{:.1f}"),
                "yes" if fit.system.stable else "no",
                f"{PERCENT * fit.variance_accounted:.3f}".replace("-", "\N{MINUS SIGN}"),
                short(residual_rms(row.fit)),
                number(fit.duration_s),
            )
        )
    head = (
        "method",
        "recording",
        "poles",
        NATURAL,
        "ζ / %",
        "±5 % to / Hz",
        "stable",
        "fit / %",
        f"residual, r.m.s. / ({typeset(component.releases[0].input.record.unit)})",
        "time / s",
    )
    return Table("Methods", head, "llrrrrlrrr", tuple(rows)) if rows else None


def printed(evaluation: StepEvaluation) -> Iterator[str]:
    """Yield the lines that the command prints."""
    for component in evaluation.components:
        told = f"{component.component}: {len(component.used)} of {len(component.releases)} releases in the model"
        found = [component.figure(name) for name in ("natural_hz", "damping_ratio", "band_5_hz", "settling_2_s")]
        words = ("f_n", "damping ratio", "±5 % up to", "2 % settling")
        parts = [f"{word} {_plain(figure)}" for word, figure in zip(words, found, strict=True) if figure is not None]
        yield "; ".join([told, ", ".join(parts)] if parts else [told, "no model"])
        for rope in component.ropes if len(component.ropes) > 1 else ():
            length = rope.kind.length
            text = rounded(MILLI * length.mean, MILLI * coverage_factor(length.dof) * length.u_mean, 0)
            yield f"  {rope.name}: {len(rope.releases)} releases of ({text.value} ± {text.expanded}) ms"


def _figure_row(figure: Figure) -> tuple[str, ...]:
    """A number with U and its coverage factor."""
    known = np.isfinite(figure.u) and figure.u > 0.0
    label = figure.label[:1].upper() + figure.label[1:]
    return (
        label,
        _scaled(figure),
        factor(figure.k) if known else DASH,
        degrees_of_freedom(figure.dof) if known else DASH,
    )


def _scaled(figure: Figure, *, with_unit: bool = True) -> str:
    """Value with U: times in ms, shares in %."""
    scale, unit = (PERCENT, "%") if figure.name.startswith(SHARES) else SCALED.get(figure.unit, (1.0, figure.unit))
    own = "" if unit == "1" or not with_unit else unit
    return measured(scale * figure.value, scale * figure.expanded, own)


def _plain(figure: Figure) -> str:
    """Value with U for the terminal."""
    scale, unit = (PERCENT, "%") if figure.name.startswith(SHARES) else SCALED.get(figure.unit, (1.0, figure.unit))
    text = rounded(scale * figure.value, scale * figure.expanded, 0)
    return f"{text.value} {unit}" if text.expanded == DASH else f"({text.value} ± {text.expanded}) {unit}"


def _mode_cells(release: Release) -> tuple[str, str]:
    """Frequency and damping ratio of the lowest mode of a release's model, with U (k = 2)."""
    model = None if release.fit is None else release.fit.model
    if model is None or not len(model.frequency_hz):
        return DASH, DASH
    place = int(np.argmin(model.frequency_hz))
    u = np.zeros(len(model.vector)) if model.covariance is None else np.sqrt(np.diag(model.covariance))
    f, z = float(model.frequency_hz[place]), float(model.damping_ratio[place])
    u_f, u_z = float(u[place]), float(u[len(model.frequency_hz) + place])
    return measured(f, K2 * u_f), measured(PERCENT * z, K2 * PERCENT * u_z)


def _spread_cells(spread: Spread) -> tuple[str, str]:
    """Mean with U, and the scatter of one release, in ms."""
    expanded = coverage_factor(spread.dof) * spread.u_mean
    scatter = DASH if np.isnan(spread.repeatability) else short(MILLI * spread.repeatability)
    return measured(MILLI * spread.mean, MILLI * expanded), scatter


def _peak_cells(component: ComponentResult, channel: str) -> tuple[str, str, str]:
    """First and second peak of an output's spectrum: mean over the releases of the model, or of all without one."""
    releases = component.chosen or component.releases
    found = [reading.peaks for r in releases for reading in r.readings if reading.channel == channel]
    first = _mean_peak([peaks[0] for peaks in found if peaks])
    seconds = [peaks[1] for peaks in found if len(peaks) > 1]
    if 2 * len(seconds) < len(found) or not seconds:
        return first, DASH, DASH
    return first, _mean_peak(seconds), number(PERCENT * float(np.mean([peak.share for peak in seconds])))


def _mean_peak(peaks: Sequence[SpectrumPeak]) -> str:
    """Mean frequency of peaks with U: of each as it was read, or of what they scatter by where that is more."""
    if not peaks:
        return DASH
    value = np.array([peak.frequency_hz for peak in peaks])
    own = float(np.sqrt(np.mean([peak.u_frequency_hz**2 for peak in peaks])))
    spread = float(np.std(value, ddof=1)) if len(peaks) > 1 else 0.0
    k = coverage_factor(len(peaks) - 1.0) if spread > own else K2
    return measured(float(value.mean()), k * max(own, spread) / len(peaks) ** 0.5)


def _exponent(component: ComponentResult) -> int:
    """Power of ten in which the gains of a component stand."""
    return rounded(_largest(component.gains), 0.0).exponent


def _largest(gains: Sequence[StaticGain]) -> float:
    """The largest gain."""
    return max(abs(gain.value) for gain in gains)


def _ratio(value: float, expanded: float, component: ComponentResult) -> str:
    """A gain with U in the component's power of ten."""
    scale = 10.0 ** -_exponent(component)
    text = rounded(scale * value, scale * expanded, 0)
    return text.value if text.expanded == DASH else f"{text.value} ± {text.expanded}"


def _gain_unit(component: ComponentResult) -> str:
    """Unit of the gains with their power of ten."""
    power = _exponent(component)
    superscript = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    unit = typeset(component.unit)
    return f"(10{superscript} {unit})" if power else f"({unit})"


def _index(row: MethodRow, name: str, form: str, scale: float = 1.0) -> str:
    """One index of a method's system."""
    value = None if row.indices is None else row.indices.figures()[name]
    return DASH if value is None or not np.isfinite(value) else form.format(scale * value)
