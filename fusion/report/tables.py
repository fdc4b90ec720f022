"""Tables and headlines of a recording's report, and the frame of every page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, prefix, typeset
from fusion.estimation.fuse import Acceleration
from fusion.estimation.uncertainty import Polar, element_covariance, polar
from fusion.phasors.stereo_phasors import StereoResult
from fusion.report.csv_files import sensitivity_element, sensitivity_unit
from fusion.report.numbers import (
    WEAK,
    acceleration,
    bodies,
    by_source,
    common_exponent,
    degrees_of_freedom,
    driven_channel,
    driven_component,
    fixed,
    half_axes,
    main_line,
    measured,
    microseconds,
    number,
    polar_cells,
    signed,
    static_value,
    times_ten,
)
from fusion.report.table import Headline, Table
from fusion.sensitivity.analyse import Evaluation
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shaker.sine.phasor import Phasors

# The tables of the report: every number rounded to its expanded uncertainty, whose coverage factor stands with it.


PREFIXED = ("m", "m/s", "m/s^2", "rad/s", "N")
"""Units that take an SI prefix."""


def headlines(evaluation: Evaluation) -> list[Headline]:
    """The results to remember: sensitivity and phase, deviation from static, acceleration, load."""
    component, line = driven_component(evaluation), main_line(evaluation)
    found = []
    if evaluation.sensitivity is not None:
        found += _sensitivity_headlines(evaluation, line, component)
    result = acceleration(evaluation, "load", "fused") or next(iter(evaluation.accelerations), None)
    if result is not None and result.observed[line, component]:
        dof = float(result.uncertainty.dof()[line, component])
        found.append(
            _phasor_headline(result.phasors, dof, line, component, f"Acceleration {MOTION_COMPONENTS[component]}")
        )
    if evaluation.load is not None and evaluation.load.observed[line, component]:
        load, dof = evaluation.load, float(evaluation.load.uncertainty.dof()[line, component])
        found.append(_phasor_headline(load.phasors, dof, line, component, f"Load {LOAD_COMPONENTS[component]}"))
    return found


def sensitivity_table(evaluation: Evaluation) -> Table | None:
    """All outputs at the driven lines, the driven output at harmonics; a ratio has one load, hence one unit."""
    found = evaluation.sensitivity
    if found is None:
        return None
    rows = []
    exponent, driven = common_exponent(found.value), driven_channel(evaluation)
    for k, frequency in enumerate(found.frequency_hz):
        for c, j in found.elements:
            other = found.kind[k] == "harmonic" and c != driven
            if other or not np.isfinite(found.value[k, c, j]):
                continue
            element = sensitivity_element(found, k, c, j)
            name = f"{found.channels[c]} per {found.components[j]}"
            dof = degrees_of_freedom(element.dof)
            rows.append((f"{frequency:.4f}", name, *polar_cells(element, exponent), dof, found.kind[k]))
    unit = times_ten(exponent, sensitivity_unit(found.unit, LOAD_COMPONENTS[driven_component(evaluation)]))
    magnitude = Markup("magnitude / ({})").format(unit)
    head = ("frequency / Hz", "output per load", magnitude, "phase / rad", "k", "dof", "kind")
    return Table("Complex sensitivity with U = k·u (95 %)", head, "rlrrrrl", tuple(rows))


def source_tables(evaluation: Evaluation) -> list[Table]:
    """Per body: six components at the strongest line, one column pair per source."""
    line = main_line(evaluation)
    tables = []
    for body in bodies(evaluation):
        results = by_source(evaluation, body)
        rows = tuple(_source_row(results, line, c) for c in range(6))
        head = ("", "unit", *(result.source for result in results))
        frequency = float(results[0].phasors.frequency_hz[line])
        caption = f"Acceleration of the {body} at the sensor origin, {frequency:.4f} Hz, with U = k·u (95 %)"
        tables.append(Table(caption, head, "ll" + "r" * (len(head) - 2), rows))
    return tables


def load_table(evaluation: Evaluation) -> Table | None:
    """Load at the strongest line, and its driven component at the others."""
    if evaluation.load is None:
        return None
    phasors, dof = evaluation.load.phasors, evaluation.load.uncertainty.dof()
    rows, strongest, driven = [], main_line(evaluation), driven_component(evaluation)
    for k, frequency in enumerate(phasors.frequency_hz):
        for c, name in enumerate(phasors.channels):
            if np.isfinite(phasors.value[k, c]) and (k == strongest or c == driven):
                pair = element_covariance(phasors.covariance[k], c)
                element = polar(complex(phasors.value[k, c]), pair, float(dof[k, c]))
                amplitude, turn, factor = polar_cells(element)
                unit, freedom = typeset(phasors.unit[c]), degrees_of_freedom(element.dof)
                rows.append((f"{frequency:.4f}", name, amplitude, unit, turn, factor, freedom))
    head = ("frequency / Hz", "component", "amplitude", "unit", "phase / rad", "k", "dof")
    return Table("Load at the sensor origin with U = k·u (95 %)", head, "rlrlrrr", tuple(rows))


def consistency_table(evaluation: Evaluation) -> Table | None:
    """How each instrument agrees with the others."""
    rows = []
    for result in evaluation.accelerations:
        for entry in result.consistency:
            amplitude = signed(100.0 * (abs(entry.ratio) - 1.0), "+.3f")
            turn = signed(1e3 * float(np.angle(entry.ratio)), "+.2f")
            use = ("fused, suspect" if entry.suspect else "fused") if entry.used else "compared only"
            who = (result.body, result.source, entry.instrument, str(entry.channels))
            rows.append((*who, signed(entry.normalised_deviation), amplitude, turn, use))
    head = ("body", "result", "instrument", "channels", "normalised deviation", "amplitude / %", "phase / mrad", "use")
    caption = "Each instrument against the prediction of all others (normalised deviation: 1 is expected)"
    return Table(caption, head, "lllrrrrl", tuple(dict.fromkeys(rows))) if rows else None


def chi_square_table(evaluation: Evaluation) -> Table | None:
    """Agreement of all instruments of a result together."""
    rows = tuple(
        (result.body, result.source, ", ".join(result.instruments), f"{result.chi2:.1f}", str(result.dof))
        for result in evaluation.accelerations
        if result.dof > 0
    )
    head = ("body", "result", "instruments", "χ²", "degrees of freedom")
    return Table("Agreement of the instruments", head, "lllrr", rows) if rows else None


def stereo_table(stereo: Sequence[StereoResult]) -> Table | None:
    """Key figures of the stereo pairs, one column each."""
    if not stereo:
        return None
    lost = [(item, int(np.sum(~np.isfinite(item.motion.pose).all(axis=1)))) for item in stereo]
    rows = [
        ("body", *(item.body for item in stereo)),
        ("frames, of which without a result", *(f"{len(item.time_s)}, {failed}" for item, failed in lost)),
        ("first exposure / s", *(f"{item.time_s[0]:.6f}" for item in stereo)),
        ("exposure / µs", *(_exposure(item) for item in stereo)),
        ("subsets", *(str(len(item.subsets_px)) if item.subsets_px is not None else DASH for item in stereo)),
        ("points per frame, median", *(f"{np.median(item.motion.points):.0f}" for item in stereo)),
        ("reprojection rms / px", *(number(item.reprojection_px) for item in stereo)),
        (
            "rigid residual, median / µm",
            *(number(1e6 * float(np.nanmedian(item.motion.residual_m))) for item in stereo),
        ),
        ("correlation ZNCC, median", *(number(item.median_zncc) for item in stereo)),
        ("speckle size / px", *(number(item.speckle_px) for item in stereo)),
        ("σ of a subset, predicted, found / px", *(_sigmas(item) for item in stereo)),
        ("read noise / grey values", *(_noise(item, "read_variance_grey2", 0.5) for item in stereo)),
        ("electrons per grey value", *(_noise(item, "variance_per_grey", -1.0) for item in stereo)),
        ("image noise / grey values", *(number(item.noise_grey) for item in stereo)),
        ("condition of the sine fit", *(number(item.fit.condition) for item in stereo)),
        ("lines told apart", *(f"{int(np.sum(item.usable))} of {len(item.usable)}" for item in stereo)),
    ]
    head = ("", *(f"“{item.name}”" for item in stereo))
    return Table("Stereo pairs", head, "l" + "r" * len(stereo), tuple(rows))


def _exposure(stereo: StereoResult) -> str:
    """The exposure in µs as stated, or as measured with U."""
    if stereo.u_exposure_s == 0.0:
        return f"{1e6 * stereo.exposure_s:g}"
    return microseconds(stereo.exposure_s, stereo.u_exposure_s)


def _sigmas(stereo: StereoResult) -> str:
    """Predicted and found standard deviation of a subset's coordinate; a dash where there are no images."""
    return DASH if stereo.sigma_px is None else ", ".join(number(float(value)) for value in stereo.sigma_px)


def _noise(stereo: StereoResult, name: str, power: float) -> str:
    """A power of one parameter of the noise models, left and right camera; a dash where there is none."""
    values = [getattr(model, name) for model in stereo.noise]
    return ", ".join(number(value**power) for value in values) if values and min(values) > 0.0 else DASH


def _sensitivity_headlines(evaluation: Evaluation, line: int, component: int) -> list[Headline]:
    """Magnitude with its deviation from the static value, and phase."""
    found = evaluation.sensitivity
    channel = driven_channel(evaluation)
    if found is None or not np.isfinite(found.value[line, channel, component]):
        return []
    element = sensitivity_element(found, line, channel, component)
    unit = sensitivity_unit(found.unit, LOAD_COMPONENTS[component])
    static = static_value(evaluation, channel, component)
    remark = _relative(element)
    if static is not None:
        sensor, relative = evaluation.manifest.rig.sensor, element.magnitude / abs(static)
        u_static = 0.0 if sensor is None else sensor.static_sensitivity_uncertainty
        share = 100.0 * (relative - 1.0)
        u_share = 100.0 * element.k * float(np.hypot(element.u_magnitude / abs(static), relative * u_static))
        remark += f"; from static: {measured(share, u_share, '%').striptags()}"
    where = f"{found.channels[channel]} per {LOAD_COMPONENTS[component]}, {found.frequency_hz[line]:.4f} Hz"
    size = measured(element.magnitude, element.expanded_magnitude, unit)
    turn = measured(element.phase_rad, element.expanded_phase_rad, "rad")
    degrees = measured(np.degrees(element.phase_rad), np.degrees(element.expanded_phase_rad), "°").striptags()
    return [Headline(f"Sensitivity {where}", size, remark), Headline("Phase of the output to the load", turn, degrees)]


def _phasor_headline(phasors: Phasors, dof: float, line: int, component: int, label: str) -> Headline:
    """Amplitude of one component."""
    pair = element_covariance(phasors.covariance[line], component)
    element = polar(complex(phasors.value[line, component]), pair, dof)
    if element.region.holds_zero:
        return Headline(f"{label}, amplitude", WEAK, f"95 % {half_axes(element.region)}")
    value = measured(element.magnitude, element.expanded_magnitude, phasors.unit[component])
    return Headline(f"{label}, amplitude", value, _relative(element))


def _relative(element: Polar) -> str:
    """Relative expanded uncertainty of a magnitude, with its coverage factor."""
    return f"U = {100.0 * element.expanded_magnitude / element.magnitude:.2g} % (k = {element.k:.2f})"


def _source_row(results: Sequence[Acceleration], line: int, component: int) -> tuple[str, ...]:
    """One component of all sources in one unit."""
    values = np.array([abs(result.phasors.value[line, component]) for result in results])
    scale, letter = prefix(values)
    cells: list[str] = [MOTION_COMPONENTS[component], letter + typeset(results[0].phasors.unit[component])]
    for result in results:
        value = complex(result.phasors.value[line, component])
        if not result.observed[line, component] or not np.isfinite(value):
            cells.append(DASH)
            continue
        pair = element_covariance(result.phasors.covariance[line], component)
        element = polar(value / scale, pair / scale**2, float(result.uncertainty.dof()[line, component]))
        amplitude, turn, factor = polar_cells(element, 0)
        below = turn if turn in (WEAK, DASH) else Markup("{} rad").format(turn)
        cells.append(Markup('{}<br><span class="below">{}<br>k = {}</span>').format(amplitude, below, factor))
    return tuple(cells)


# The report's table of takes: how far the reference channel tied them, and what drifted between them.


def takes_table(evaluation: Evaluation) -> Table | None:
    """Return frequency, amplitude and phase of the reference at the driven lines of every take; None without takes."""
    takes = evaluation.set_ups
    if not takes:
        return None
    rows = []
    for k in np.flatnonzero(evaluation.lines.multiple == 1):
        for take in takes:
            drift = fixed(100.0 * take.drift[k], 200.0 * take.u_drift[k], 0) if take is not takes[0] else "0"
            ppm = 1e6 * (take.frequency_hz[k] / takes[0].frequency_hz[k] - 1.0)
            phase = np.angle(take.factor[k])
            rows.append((take.name, f"{take.frequency_hz[k]:.5f}", f"{ppm:+.2f}", drift, f"{phase:+.4f}"))
    head = ("take", "line / Hz", "frequency − first / 10⁻⁶", "amplitude − first / %", "turned by / rad")
    caption = (
        f"Takes, referred to the first by the channel {takes[0].reference}: its line, amplitude with U (k = 2) from "
        "noise, and the angle by which all phasors of the take were turned"
    )
    return Table(caption, head, "lrrrr", tuple(rows))
