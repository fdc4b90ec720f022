"""The page of an identification."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, rounded, typeset
from fusion.estimation.uncertainty import coverage_factor
from fusion.report.numbers import capital, measured, small, times_ten
from fusion.report.table import Headline, Table
from fusion.sensor.identify.evaluate import LABELS, ComponentResult, IdentifyEvaluation, Reading, of_curve
from fusion.sensor.identify.figures import curve_pictures, sensitivity_pictures
from shaker.identification.measured import ParameterEstimate
from shaker.identification.sensitivity import CHAIN_WORDS
from shaker.identification.sensor import UsableBand
from shaker.labels import LOAD_COMPONENTS

K = coverage_factor(np.inf)


class NumberRow(NamedTuple):
    """One number of parameters.csv, and the method that found it."""

    component: str
    name: str
    value: float
    u: float
    k: float
    U: float
    unit: str
    method: str


def numbers(component: ComponentResult) -> Iterator[tuple[ParameterEstimate, str]]:
    """Every number found of a component, and the method that found it."""
    fit = component.fit
    how = f"joint fit, {fit.model}"
    for estimate in fit.identification.estimates:
        stated = estimate.name == component.internal_mass.name and not fit.mass_is_free
        yield estimate, f"{how}, stated beforehand" if stated else how
    for estimate in (*fit.identification.derived, *_modes(component)):
        yield estimate, how
    if component.sensitivity is not None:
        best = component.sensitivity.comparison.best
        for estimate in best.estimates:
            yield estimate, f"sensitivity over frequency, {CHAIN_WORDS[best.chain.kind]}"
    for load, band in zip(component.loads, component.bands, strict=True):
        place = f"load {load:.6g}"
        name, label = f"usable_band: {place}", f"usable band, {place}"
        yield ParameterEstimate(name, label, band.upper_hz, band.u_upper_hz, "Hz"), "sensor model"


def parameter_rows(evaluation: IdentifyEvaluation) -> Iterator[NumberRow]:
    """One row per number."""
    for component in evaluation.components:
        for estimate, method in numbers(component):
            values = (estimate.value, estimate.u, K, K * estimate.u, plain(estimate.unit))
            yield NumberRow(component.name, estimate.name, *values, method)


def plain(unit: str) -> str:
    """ASCII form of a unit for files: `N·m/rad` becomes `N.m/rad`."""
    return unit.replace("·", ".").replace("²", "^2")


def _modes(component: ComponentResult) -> Iterator[ParameterEstimate]:
    """Frequency and damping ratio of every mode of every recording that shows a curve."""
    curves = {reading.recording for reading in component.readings}
    for mode in component.fit.identification.modes:
        if mode.record not in curves:
            continue
        place = f"{mode.record}, mode {mode.number + 1}"
        frequency = (f"frequency: {place}", f"resonance f₀, {place}")
        yield ParameterEstimate(*frequency, mode.frequency_hz, mode.u_frequency_hz, "Hz")
        ratio = (f"damping_ratio: {place}", f"damping ratio ζ, {place}")
        yield ParameterEstimate(*ratio, mode.damping_ratio, mode.u_damping_ratio, "1")


LIMITS = {"rise": "resonance", "drop": "fall of the output", "phase": "phase", "nothing": "nothing"}
_LARGEST_CAUSES = 12


def parameters_table(component: ComponentResult) -> Table:
    """Parameters, lags and modes of a component with U."""
    rows = []
    for estimate, method in numbers(component):
        if not estimate.name.startswith("usable_band"):
            relative = DASH if estimate.value == 0.0 else _percent(K * estimate.u / abs(estimate.value))
            cell = measured(estimate.value, K * estimate.u, "" if estimate.unit == "1" else typeset(estimate.unit))
            rows.append((_label(estimate.label), cell, relative, method))
    head = ("parameter", "value ± U", "U / %", "method")
    return Table(f"Parameters of {component.name}, U = k·u with k = {K:.2f} (95 %)", head, "lrrl", tuple(rows))


def correlation_table(component: ComponentResult) -> Table:
    """Correlation of the parameters of the joint fit."""
    found = component.fit.identification
    labels = [_label(estimate.label) for estimate in found.estimates]
    rows = tuple(
        (label, *(f"{value:+.3f}".replace("-", "\N{MINUS SIGN}") for value in row))
        for label, row in zip(labels, found.correlation.tolist(), strict=True)
    )
    return Table("Correlation of the parameters", ("", *labels), "l" + "r" * len(labels), rows)


def budget_table(component: ComponentResult) -> Table:
    """What every cause adds to the uncertainty of the parameters, largest first."""
    found = component.fit.identification
    value = np.array([estimate.value for estimate in found.estimates])
    share = {cause: np.abs(change) / np.abs(value) for cause, change in found.budget.items()}
    ordered = sorted(share.items(), key=lambda item: -float(np.max(item[1])))
    largest = float(np.max(ordered[0][1])) if ordered else 0.0
    kept = [item for item in ordered if float(np.max(item[1])) > 1e-3 * largest][:_LARGEST_CAUSES]
    rows = [(cause, *(_share(float(part)) for part in parts)) for cause, parts in kept]
    total = [_share(estimate.u / abs(estimate.value)) for estimate in found.estimates]
    rows.append(("combined, k = 1", *total))
    head = ("contribution", *(Markup("u({}) / %").format(_label(estimate.label)) for estimate in found.estimates))
    return Table("Budget, relative to each parameter", head, "l" + "r" * len(total), tuple(rows))


def readings_tables(component: ComponentResult) -> list[Table]:
    """What every method reads from every curve."""
    curves = dict.fromkeys((reading.recording, reading.response) for reading in component.readings)
    return [_readings_table(component, *curve) for curve in curves]


def explanations_table(component: ComponentResult) -> Table | None:
    """The explanations of the sensitivity side by side."""
    if component.sensitivity is None:
        return None
    comparison = component.sensitivity.comparison
    rows = []
    for fit, weight, verdict in zip(comparison.fits, comparison.weight, comparison.verdict, strict=True):
        told = [
            f"{estimate.label} {measured(*_scaled(estimate))}"
            for estimate in fit.estimates
            if estimate.name in ("delay_s", "lag_s", "corner_hz")
        ]
        rows.append(
            (
                CHAIN_WORDS[fit.chain.kind],
                Markup("; ").join(Markup(text) for text in told) if told else DASH,
                f"{fit.chi_squared:.1f} / {fit.dof}",
                small(fit.probability),
                small(float(weight)),
                verdict,
            )
        )
    head = ("explanation beside b/k of the resonance", "found", "χ² / dof", "probability", "Akaike weight", "verdict")
    return Table("What makes the sensitivity change with frequency", head, "llrrrl", tuple(rows))


def bands_table(component: ComponentResult) -> Table | None:
    """Usable band without correction for each load mass, None where there is none."""
    if not component.bands:
        return None
    permitted = component.bands[0].permitted
    unit = "kg" if component.fit.component < 3 else "kg·m²"
    rows = tuple(
        (f"{load:.6g}", *_band_cells(band)) for load, band in zip(component.loads, component.bands, strict=True)
    )
    caption = (
        f"Frequencies up to which the uncorrected output stays within ±{100.0 * permitted:g} % of its static value"
    )
    head = (f"load / {unit}", "up to", "U / %", "ends by")
    return Table(caption, head, "rrrl", rows)


def recordings_table(component: ComponentResult) -> Table:
    """The recordings behind the joint fit."""
    rows = []
    for item in component.fit.prepared:
        frequency = item.measured.ratio.frequency_hz
        unit = "kg" if component.fit.component < 3 else "kg·m²"
        rows.append(
            (
                item.measured.name,
                item.manifest.excitation.kind,
                measured(item.load_kg, K * item.u_load_kg, unit),
                ", ".join(item.measured.ratio.channels),
                f"{len(frequency)}",
                f"{frequency.min():.6g} to {frequency.max():.6g}",
            )
        )
    head = ("recording", "kind", "load", "load over base", "lines", "band / Hz")
    return Table("Recordings of the joint fit", head, "llrlrr", tuple(rows))


def headlines(evaluation: IdentifyEvaluation) -> list[Headline]:
    """Stiffness, damping, internal mass and lag of the chain."""
    found = []
    for component in evaluation.components:
        for estimate in _main(component):
            share = _percent(K * estimate.u / abs(estimate.value)) if estimate.value else DASH
            cell = measured(estimate.value, K * estimate.u, typeset(estimate.unit))
            found.append(Headline(_label(capital(estimate.label)), cell, f"U (k = {K:.2f}) = {share} %"))
        found += _chain_headline(component)
    return found


def printed(evaluation: IdentifyEvaluation) -> Iterator[str]:
    """Lines for the terminal: parameters with U at 95 %, then bands."""
    for component in evaluation.components:
        fit = component.fit
        yield f"{component.name}: {fit.model} ({fit.reason}), {len(fit.prepared)} recordings"
        for estimate in (*fit.identification.estimates, *fit.identification.derived):
            yield f"  {estimate.label}: {_plain_number(estimate)}"
        if component.sensitivity is not None:
            for estimate in component.sensitivity.comparison.best.estimates:
                if estimate.name != "spring_time_s":
                    yield f"  {estimate.label}: {_plain_number(estimate)}"
        for load, band in zip(component.loads, component.bands, strict=True):
            text = rounded(band.upper_hz, K * band.u_upper_hz, 0)
            yield f"  usable up to ({band.permitted:.2%}, load {load:.6g}): {text.value} ± {text.expanded} Hz"


def _main(component: ComponentResult) -> list[ParameterEstimate]:
    """Stiffness and damping along the component, and the internal mass."""
    found, axis = component.fit.identification.estimates, component.name
    own = (f"stiffness_{axis}", f"damping_{axis}", component.internal_mass.name)
    return [estimate for estimate in found if estimate.name.partition(": ")[0] in own]


def _plain_number(estimate: ParameterEstimate) -> str:
    """A number with U as plain text."""
    text = rounded(estimate.value, K * estimate.u)
    power = f"e{text.exponent}" if text.exponent else ""
    return f"({text.value} ± {text.expanded}){power} {typeset(estimate.unit)}"


def _readings_table(component: ComponentResult, recording: str, response: str) -> Table:
    """All methods on one curve."""
    turning = component.fit.component >= 3
    own = of_curve(component.readings, recording, response)
    exponent = rounded(max(reading.stiffness for reading in own), 0.0).exponent
    rows = [_reading_row(reading, exponent) for reading in own]
    unit = times_ten(exponent, "N·m/rad" if turning else "N/m")
    damper = "b / (N·m·s/rad)" if turning else "b / (N·s/m)"
    head = ("method", "f / Hz", "width / Hz", "ζ / %", Markup("k / ({})").format(unit), damper)
    return Table(f"{recording}: {response}", head, "lrrrrr", tuple(rows))


def _reading_row(reading: Reading, exponent: int) -> tuple[str, ...]:
    """One method, its stiffness in units of a power of ten."""
    words = LABELS[reading.method]
    if reading.note:
        words = Markup('{}<br><span class="below">{}</span>').format(words, reading.note)
    damping = f"{reading.damping:.5g}" if np.isfinite(reading.damping) else DASH
    return (
        words,
        measured(reading.frequency_hz, K * reading.u_frequency_hz),
        measured(reading.width_hz, K * reading.u_width_hz),
        measured(100.0 * reading.damping_ratio, 100.0 * K * reading.u_damping_ratio),
        f"{reading.stiffness / 10.0**exponent:.5f}",
        damping,
    )


def _band_cells(band: UsableBand) -> tuple[str, str, str]:
    """Edge of a band with U, and what ends it."""
    if not np.isfinite(band.upper_hz):
        return "no limit", DASH, LIMITS[band.limit]
    relative = _percent(K * band.u_upper_hz / band.upper_hz)
    return measured(band.upper_hz, K * band.u_upper_hz, "Hz"), relative, LIMITS[band.limit]


def _scaled(estimate: ParameterEstimate) -> tuple[float, float, str]:
    """Value and U of a time in µs, of other numbers in their unit."""
    if estimate.unit == "s":
        return 1e6 * estimate.value, 1e6 * K * estimate.u, "µs"
    return estimate.value, K * estimate.u, estimate.unit


def _chain_headline(component: ComponentResult) -> list[Headline]:
    """Delay or lag of the chain where the sensitivity supports one."""
    if component.sensitivity is None:
        return []
    best = component.sensitivity.comparison.best
    shown: Sequence[ParameterEstimate] = [e for e in best.estimates if e.name in ("delay_s", "lag_s")]
    where = f"of {LOAD_COMPONENTS[component.fit.component]}"
    return [
        Headline(capital(f"{estimate.label} {where}"), measured(*_scaled(estimate)), "from S(f), with U")
        for estimate in shown
    ]


def _percent(share: float) -> str:
    """A relative uncertainty in per cent."""
    return small(100.0 * share) if np.isfinite(share) else DASH


def _label(text: str) -> Markup:
    """A label with its index typeset."""
    return Markup("{}m<sub>i</sub>{}").format(*text.split("m_i", 1)) if "m_i" in text else Markup("{}").format(text)


def _share(share: float) -> str:
    """A relative contribution in per cent to two digits, far below the last place of interest only bounded."""
    return f"{100.0 * share:.2g}" if share >= 1e-7 else "< 10⁻⁵"


def sentences(component: ComponentResult) -> list[str]:
    """Which explanation the data support, and whether the damping contradicts the resonance."""
    if component.sensitivity is None:
        return ["No sensitivity over frequency was evaluated: whether the chain has a lag remains open."]
    comparison = component.sensitivity.comparison
    return [comparison.text, *([] if comparison.damping is None else [comparison.damping.text])]


def page_context(evaluation: IdentifyEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "subject": _subject(evaluation),
        "headlines": headlines(evaluation),
        "components": [
            {
                "name": component.name,
                "reason": f"{component.fit.model}: {component.fit.reason}",
                "parameters": parameters_table(component),
                "correlation": correlation_table(component),
                "recordings": recordings_table(component),
                "curves": curve_pictures(component),
                "readings": readings_tables(component),
                "sentences": sentences(component),
                "explanations": explanations_table(component),
                "sensitivity": sensitivity_pictures(component),
                "bands": bands_table(component),
                "budget": budget_table(component),
            }
            for component in evaluation.components
        ],
    }


def _subject(evaluation: IdentifyEvaluation) -> list[tuple[str, str]]:
    """What was measured: sensor, rigs, recordings."""
    facts, sensor = [], evaluation.sensor
    if sensor is not None:
        facts.append(("Sensor", f"{sensor.name}, serial number {sensor.serial}" if sensor.serial else sensor.name))
    prepared = [item for component in evaluation.components for item in component.fit.prepared]
    facts.append(("Rigs", "; ".join(dict.fromkeys(item.manifest.rig.name for item in prepared))))
    facts.append(("Recordings", f"{len(prepared)} with load over base"))
    return facts
