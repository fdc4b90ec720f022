"""Tables and headlines of a recording's report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
from markupsafe import Markup

from fusion.base import prefix
from fusion.estimation.coverage import Polar, polar
from fusion.estimation.fuse import Acceleration
from fusion.estimation.uncertainty import Contribution, Uncertainty, over_static, polar_elements
from fusion.phasors.broadband import line_spacing_hz
from fusion.phasors.steadiness import LineStationarity, line_stationarity
from fusion.phasors.stereo_phasors import StereoResult
from fusion.phasors.timing import ClockResult
from fusion.recording.transducer import TRANSDUCERS
from fusion.report.table import (
    WEAK,
    Headline,
    R,
    Table,
    TableColumn,
    capitalise,
    common_exponent,
    half_axes,
    microseconds,
    page_column,
    phase,
    polar_cells,
    polar_freedom,
    table,
)
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.ratio import Sensitivity, StatedMatrix
from shaker.frf.sampled_motion import SampledFit
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, MOTION_COMPONENTS, sensitivity_unit
from shaker.timebase.tie import ClockTie
from shaker.timebase.trigger import TriggerFit
from shakercal._common.digits import DASH, number_text, quantity_text, scaled_text, times_ten, typeset

# The driven component, its output, and the strongest line.


def driven_component(evaluation: Evaluation) -> int:
    """Return the index of the driven component among x, y, z, rx, ry, rz.

    It is the largest element of the excitation's direction, forces and moments relative to the rated loads; if no
    direction is stated, the largest translation.
    """
    if evaluation.stated_component is not None:
        return evaluation.stated_component
    sizes = [np.abs(result.phasors.value[:, :3]) for result in evaluation.accelerations]
    moves = np.nan_to_num(np.concatenate(sizes)) if sizes else np.zeros((1, 3))
    return int(np.argmax(moves.max(axis=0)))


def driven_channel(evaluation: Evaluation) -> int:
    """Return the index of the sensor output of the driven component.

    It has the largest static sensitivity if that is stated, else it is the only element, else it has the largest ratio
    at the main line.
    """
    found, element = evaluation.sensitivity, evaluation.element
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    if element is not None and len(element.elements) == 1:
        return element.elements[0][0]
    component = driven_component(evaluation)
    static = static_sensitivity(evaluation)
    sizes = np.abs(found.value[main_line(evaluation), :, component] if static is None else static[:, component])
    usable = np.where(found.observed[:, component] & np.isfinite(sizes), sizes, -1.0)
    return int(np.argmax(usable))


def main_result(evaluation: Evaluation) -> tuple[Sensitivity, int] | None:
    """Return the result closest to the sensor's sensitivity, and the driven output's index.

    It is the sensor's element if the main line has one, else the ratio; None without any.
    """
    if evaluation.sensitivity is None:
        return None
    element_index = driven_channel(evaluation), driven_component(evaluation)
    element = evaluation.element
    if (
        element is not None
        and element_index in element.elements
        and np.isfinite(element.value[main_line(evaluation), *element_index])
    ):
        return element, element.elements.index(element_index)
    return evaluation.sensitivity, evaluation.sensitivity.elements.index(element_index)


def result_name(kind: str, channel: str, component: str, *, main: bool) -> str:
    """Return the name of a row of sensitivities.

    Only elements of the sensor are named as such.

    `kind` as in sensitivity.csv; `main`: whether the output belongs to the load.
    """
    if kind in ("element", "matrix"):
        return f"{channel} per {component}"
    return f"ratio {channel} output / {component} load" if main else f"response of {channel} to load {component}"


def main_line(evaluation: Evaluation) -> int:
    """Return the index of the line with the strongest driven acceleration."""
    result = acceleration(evaluation, "load", "fused") or next(iter(evaluation.accelerations), None)
    if result is None:
        return 0
    driven = np.abs(result.phasors.value[:, driven_component(evaluation)])
    return int(np.nanargmax(driven)) if np.isfinite(driven).any() else 0


def equivalent_sine(evaluation: Evaluation) -> str:
    """Return what amplitudes of a chirp, noise or blows mean, "" for sines."""
    if not evaluation.manifest.is_broadband or not evaluation.channels:
        return ""
    channel = evaluation.channels[0]
    width_hz = line_spacing_hz(channel.sample_rate_hz, channel.samples)
    return f"; amplitudes of a sine with the power within {number_text(width_hz, 2)} Hz"


def acceleration(evaluation: Evaluation, body: str, source: str) -> Acceleration | None:
    """Return the acceleration of one body from one source, or None."""
    for result in evaluation.accelerations:
        if (result.body, result.source) == (body, source):
            return result
    return None


def bodies(evaluation: Evaluation) -> list[str]:
    """Return the bodies with an acceleration, in order of appearance."""
    return list(dict.fromkeys(result.body for result in evaluation.accelerations))


def by_source(evaluation: Evaluation, body: str) -> list[Acceleration]:
    """Return the results of one body, fused first.

    With a single instrument only the fused one.
    """
    results = [result for result in evaluation.accelerations if result.body == body]
    fused = acceleration(evaluation, body, "fused")
    return [fused] if fused is not None and len(fused.instruments) < 2 and len(results) < 3 else results


def static_sensitivity(evaluation: Evaluation) -> np.typing.NDArray[np.float64] | None:
    """Return the static sensitivity (C, 6) of the evaluated outputs, or None."""
    sensor, found = evaluation.manifest.rig.sensor, evaluation.sensitivity
    if sensor is None or found is None or sensor.static_sensitivity is None:
        return None
    rows = [list(sensor.channels).index(name) for name in found.channels]
    return np.asarray(sensor.static_sensitivity, dtype=np.float64)[rows]


def static_value(evaluation: Evaluation, channel: int, component: int) -> float | None:
    """Return one element of the static sensitivity, None if it is not stated or zero."""
    static = static_sensitivity(evaluation)
    return float(static[channel, component]) if static is not None and static[channel, component] != 0.0 else None


def sensitivity_element(sensitivity: Sensitivity, line: int, channel: int, component: int) -> Polar:
    """Return one element of the sensitivity at one line as magnitude and phase."""
    element = sensitivity.polar[line][sensitivity.elements.index((channel, component))]
    if element is None:
        raise ValueError(f"line {line}: expected a value of element ({channel}, {component}), found none")
    return element


# Headlines and tables of the results.


PREFIXED = {*(transducer.unit for transducer in TRANSDUCERS.values()), "N", "V"}
"""Units that take an SI prefix."""
Facts: TypeAlias = dict[str, Callable[[R], str]]
"""Texts about an item, by the name of the row."""


MANY_LINES = 6
"""Driven lines from which on the curve over frequency is the main result of a recording."""


def curve_lines(evaluation: Evaluation) -> list[int]:
    """Return the driven lines with the driven element, [] of fewer than `MANY_LINES`."""
    main = main_result(evaluation)
    if main is None:
        return []
    found, at = main[0], main[0].elements[main[1]]
    lines = [k for k, kind in enumerate(found.kind) if kind != "harmonic" and np.isfinite(found.value[k, *at])]
    return lines if len(lines) >= MANY_LINES else []


def _curve_headlines(evaluation: Evaluation, found: Sensitivity) -> Iterator[Headline]:
    """Yield the range of U over the lines of a curve."""
    lines, at = curve_lines(evaluation), (driven_channel(evaluation), driven_component(evaluation))
    if not lines:
        return
    points = [sensitivity_element(found, k, *at) for k in lines]
    relative = [100.0 * point.expanded_magnitude / point.magnitude for point in points]
    first, last = (number_text(float(found.frequency_hz[k]), 4) for k in (lines[0], lines[-1]))
    element = f"output {found.channels[at[0]]} per load {LOAD_COMPONENTS[at[1]]}"
    label = f"Sensitivity, {element}, {len(lines)} lines from {first} to {last} Hz"
    turns = [1e3 * point.expanded_phase_rad for point in points]
    remark = f"U of the phase: {number_text(min(turns), 2)} to {number_text(max(turns), 2)} mrad"
    yield Headline(label, f"U = {number_text(min(relative), 2)} to {number_text(max(relative), 2)} %", remark)


def headlines(evaluation: Evaluation) -> list[Headline]:
    """Return the main results: sensitivity, phase, deviation from static, acceleration, load."""
    component, line = driven_component(evaluation), main_line(evaluation)
    main = main_result(evaluation)
    found = list[Headline]()
    if main is not None:
        found += [*_curve_headlines(evaluation, main[0]), *_sensitivity_headlines(evaluation, main[0], line)]
    if found and evaluation.manifest.is_broadband:  # the amplitudes are those of equivalent sines
        return found
    moved = acceleration(evaluation, "load", "fused") or next(iter(evaluation.accelerations), None)
    labels = f"Acceleration {MOTION_COMPONENTS[component]}", f"Load {LOAD_COMPONENTS[component]}"
    for result, label in zip((moved, evaluation.load), labels, strict=True):
        element = None if result is None else result.polar[line][component]
        if result is None or element is None:
            continue
        size, remark = WEAK, f"95 % {half_axes(element.region)}"
        if not element.region.holds_zero:
            unit = result.phasors.unit[component]
            size, remark = quantity_text(element.magnitude, element.expanded_magnitude, unit), _relative(element)
        found.append(Headline(f"{label}, amplitude{equivalent_sine(evaluation)}", size, remark))
    return [*found, *_deformation_headlines(evaluation, line)]


def _deformation_headlines(evaluation: Evaluation, line: int) -> Iterator[Headline]:
    """Yield the largest deformation at a line of every pair that shows one."""
    for pair in evaluation.stereo:
        lines = np.flatnonzero(pair.usable).tolist()
        if pair.shapes is None or line not in lines or not pair.shapes.deforms[lines.index(line)]:
            continue
        k, shapes = lines.index(line), pair.shapes
        largest = int(np.argmax(np.abs(shapes.phasors.value[k])))
        size, u = float(np.abs(shapes.phasors.value[k, largest])), float(shapes.u_size[k, largest])
        label = f"Bending of the {pair.body}, {shapes.phasors.channels[largest]}"
        yield Headline(label, quantity_text(1e9 * size, 2e9 * u, "nm"), f"seen by stereo pair {pair.name}")


def sensitivity_table(evaluation: Evaluation) -> Table | None:
    """Return elements and ratios at the driven lines, and the driven output at harmonics."""
    ratios = evaluation.sensitivity
    if ratios is None:
        return None
    rows = []
    exponent, driven = common_exponent(ratios.value), driven_channel(evaluation)
    results = [found for found in (evaluation.element, ratios) if found is not None]
    for k, frequency in enumerate(ratios.frequency_hz):
        for found in results:
            for c, j in found.elements:
                other = found.kind[k] == "harmonic" and c != driven
                if other or not np.isfinite(found.value[k, c, j]):
                    continue
                element = sensitivity_element(found, k, c, j)
                name = result_name(found.kind[k], found.channels[c], found.components[j], main=c == driven)
                dof = polar_freedom(element)
                rows.append((f"{frequency:.4f}", name, *polar_cells(element, exponent), dof, found.kind[k]))
    unit = times_ten(exponent, sensitivity_unit(ratios.unit, LOAD_COMPONENTS[driven_component(evaluation)]))
    magnitude = Markup("magnitude / ({})").format(unit)
    head = ("frequency / Hz", "quantity", magnitude, "phase / rad", "k", "dof", "kind")
    title = "Output over load" if len(results) == 1 else "Sensitivity, and ratios of output and load,"
    return Table(f"{title} with U = k·u (95 %)", head, "rlrrrrl", tuple(rows)) if rows else None


def source_tables(evaluation: Evaluation) -> list[Table]:
    """Return one table per body: six components at the strongest line, one column per source."""
    line = main_line(evaluation)
    tables = []
    for body in bodies(evaluation):
        results = by_source(evaluation, body)
        found = [result.polar[line] for result in results]
        rows = []
        sizes = np.abs([result.phasors.value[line] for result in results])
        for component, name in enumerate(MOTION_COMPONENTS):
            scale, letter = prefix(sizes[:, :3] if component < 3 else sizes[:, 3:])
            unit = letter + typeset(results[0].phasors.unit[component])
            rows.append(
                (name, unit, *(_source_cell(elements[component], round(np.log10(scale))) for elements in found))
            )
        head = ("", "unit", *(result.source for result in results))
        frequency = float(results[0].phasors.frequency_hz[line])
        caption = f"Acceleration of the {body} at the sensor origin, {frequency:.4f} Hz, with U = k·u (95 %)"
        caption += equivalent_sine(evaluation)
        tables.append(Table(caption, head, "ll" + "r" * len(results), tuple(rows)))
    return tables


def _source_cell(element: Polar | None, exponent: int) -> str:
    """Return amplitude, phase and factor in one cell, or a dash."""
    if element is None:
        return DASH
    amplitude, turn, k_factor = polar_cells(element, exponent)
    below = turn if turn in (WEAK, DASH) else Markup("{} rad").format(turn)
    return Markup('{}<br><span class="below">{}<br>k = {}</span>').format(amplitude, below, k_factor)


def load_table(evaluation: Evaluation) -> Table | None:
    """Return the load at the strongest line, and its driven component at the others."""
    load, rows = evaluation.load, []
    if load is None:
        return None
    strongest, driven = main_line(evaluation), driven_component(evaluation)
    for k, row in enumerate(load.polar):
        for c, element in enumerate(row):
            if element is not None and (k == strongest or c == driven):
                amplitude, turn, k_factor = polar_cells(element)
                unit, freedom = typeset(LOAD_UNITS[c]), polar_freedom(element)
                frequency = f"{load.frequency_hz[k]:.4f}"
                rows.append((frequency, LOAD_COMPONENTS[c], amplitude, unit, turn, k_factor, freedom))
    head = ("frequency / Hz", "component", "amplitude", "unit", "phase / rad", "k", "dof")
    caption = f"Load at the sensor origin with U = k·u (95 %){equivalent_sine(evaluation)}"
    return Table(caption, head, "rlrlrrr", tuple(rows))


def side_by_side(caption: str, heads: Sequence[str], facts: Facts[R], items: Sequence[R]) -> Table:
    """Return a table of facts in rows with one column per item."""
    rows = tuple((name, *(text(item) for item in items)) for name, text in facts.items())
    return Table(caption, ("", *heads), "l" + "r" * len(items), rows)


def stereo_table(stereo: Sequence[StereoResult]) -> Table | None:
    """Return key figures of the stereo pairs, one column each."""

    def frames(pair: StereoResult) -> str:
        return f"{len(pair.time_s)}, {np.sum(~np.isfinite(pair.motion.pose).all(axis=1))}"

    def exposure(pair: StereoResult) -> str:
        """Return the exposure as stated, or as measured with U."""
        stated = pair.u_exposure_s == 0.0
        return number_text(1e6 * pair.exposure_s, 6) if stated else microseconds(pair.exposure_s, pair.u_exposure_s)

    def noise(pair: StereoResult, name: str, power: float) -> str:
        """Return a power of one parameter of the noise models, left and right camera."""
        values = [getattr(model, name) for model in pair.noise]
        return ", ".join(number_text(value**power) for value in values) if values and min(values) > 0.0 else DASH

    facts: Facts[StereoResult] = {
        "body": lambda pair: pair.body,
        "frames, of which without a result": frames,
        "first exposure / s": lambda pair: f"{pair.time_s[0]:.6f}",
        "exposure / µs": exposure,
        "subsets": lambda pair: DASH if pair.subsets_px is None else str(len(pair.subsets_px)),
        "points per frame, median": lambda pair: f"{np.median(pair.motion.points[pair.motion.points > 0]):.0f}",
        "reprojection rms / px": lambda pair: number_text(pair.reprojection_px),
        "rigid residual, median / µm": lambda pair: number_text(1e6 * float(np.nanmedian(pair.motion.residual_m))),
        "correlation ZNCC, median": lambda pair: number_text(pair.median_zncc),
        "speckle size / px": lambda pair: number_text(pair.speckle_px),
        "σ of a subset, predicted, found / px": lambda pair: (
            DASH if pair.sigma_px is None else ", ".join(number_text(float(value)) for value in pair.sigma_px)
        ),
        "read noise / grey values": lambda pair: noise(pair, "read_variance_grey2", 0.5),
        "electrons per grey value": lambda pair: noise(pair, "variance_per_grey", -1.0),
        "image noise / grey values": lambda pair: number_text(pair.noise_grey),
        "fixed pattern, PRNU ± u / %": lambda pair: (
            DASH if pair.prnu is None else ", ".join(f"{100.0 * size:.2f} ± {100.0 * u:.2f}" for size, u in pair.prnu)
        ),
    }
    if not any(isinstance(pair.fit, SampledFit) for pair in stereo):
        facts["condition of the sine fit"] = lambda pair: number_text(pair.fit.condition)
        facts["resolved lines"] = lambda pair: f"{int(np.sum(pair.usable))} of {len(pair.usable)}"
    heads = [f"“{pair.name}”" for pair in stereo]
    return side_by_side("Stereo pairs", heads, facts, stereo) if stereo else None


def shape_tables(evaluation: Evaluation) -> list[Table]:
    """Return tables of deformation shapes at the strongest line and where they are significant.

    There is one table for each set of shapes: the plain ones, and the modes that a pair measures.
    """
    rows, line = dict[tuple[str, ...], list[tuple[str, ...]]](), main_line(evaluation)
    for pair in evaluation.stereo:
        found = pair.shapes
        if found is None:
            continue
        for k, line_index in enumerate(np.flatnonzero(pair.usable)):
            if line_index == line or found.deforms[k]:
                sizes = zip(np.abs(found.phasors.value[k]), found.u_size[k], strict=True)
                amplitudes = (quantity_text(1e9 * float(size), 2e9 * float(u)) for size, u in sizes)
                cells = pair.name, f"{found.phasors.frequency_hz[k]:.4f}", *amplitudes, number_text(found.chance[k], 1)
                rows.setdefault(found.phasors.channels, []).append(cells)
    caption = (
        "Deformation fitted to the grey values: amplitudes in nm with U = 2u, and probability of more for a rigid body"
    )
    return [
        Table(caption, ("pair", "frequency / Hz", *names, "chance"), "lr" + "r" * (len(names) + 1), tuple(cells))
        for names, cells in rows.items()
    ]


def _sensitivity_headlines(evaluation: Evaluation, found: Sensitivity, line: int) -> list[Headline]:
    """Return magnitude with its deviation from the static value, and phase."""
    channel, component = driven_channel(evaluation), driven_component(evaluation)
    if not np.isfinite(found.value[line, channel, component]):
        return []
    element = sensitivity_element(found, line, channel, component)
    unit = sensitivity_unit(found.unit, LOAD_COMPONENTS[component])
    relative = _over_static(evaluation, found, line, (channel, component))
    remark = _relative(element) + ("" if relative is None else f"; {verdict(relative)}")
    name = result_name(found.kind[line], found.channels[channel], LOAD_COMPONENTS[component], main=True)
    load = LOAD_COMPONENTS[component]
    of_sensor = f"Sensitivity, output {found.channels[channel]} per load {load}"
    label = of_sensor if found.kind[line] == "element" else capitalise(name)
    size = quantity_text(element.magnitude, element.expanded_magnitude, unit)
    turn = quantity_text(element.phase_rad, element.expanded_phase_rad, "rad")
    degrees = quantity_text(np.degrees(element.phase_rad), np.degrees(element.expanded_phase_rad), "°")
    label = f"{label}, {found.frequency_hz[line]:.1f} Hz"
    return [Headline(label, size, remark), Headline("Phase of the output to the load", turn, degrees)]


def _over_static(evaluation: Evaluation, found: Sensitivity, line: int, element: tuple[int, int]) -> Polar | None:
    """Return an element of a line over its static value; None if none is stated."""
    sensor, static = evaluation.manifest.rig.sensor, static_sensitivity(evaluation)
    if sensor is None or static is None or static[element] == 0.0:
        return None
    channel, component = element
    u, name = StatedMatrix.of(sensor).u_elements(static), f"{found.channels[channel]}/{LOAD_COMPONENTS[component]}"
    uncertainty = found.uncertainty.at([found.elements.index(element)]).at_lines([line])
    value, stated = found.value[line, channel, component].reshape(1, 1), (static[element][None], u[element][None])
    ((relative,),) = polar_elements(*over_static(value, uncertainty, *stated, [name]))
    return relative


def verdict(relative: Polar) -> str:
    """Return whether a magnitude agrees with its static value, and the deviation."""
    agrees = abs(relative.magnitude - 1.0) <= relative.expanded_magnitude
    words = "agrees with the static value" if agrees else "differs from the static value"
    return f"{words}, difference {deviation(relative)}"


def deviation(relative: Polar) -> str:
    """Return the deviation of a magnitude from static in per cent."""
    return quantity_text(100.0 * (relative.magnitude - 1.0), 100.0 * relative.expanded_magnitude, "%")


def _relative(element: Polar) -> str:
    """Return the relative expanded uncertainty of a magnitude with its coverage factor."""
    return f"U = {number_text(100.0 * element.expanded_magnitude / element.magnitude, 2)} % (k = {element.k:.2f})"


def takes_table(evaluation: Evaluation) -> Table | None:
    """Return the reference at the driven lines of every take; None without takes."""
    takes = evaluation.set_ups
    if not takes:
        return None
    rows = []
    for k in np.flatnonzero(evaluation.lines.multiple == 1):
        for take in takes:
            drift = scaled_text(100.0 * take.drift[k], 200.0 * take.u_drift[k], 0) if take is not takes[0] else "0"
            ppm = 1e6 * (take.frequency_hz[k] / takes[0].frequency_hz[k] - 1.0)
            phase = np.angle(take.factor[k])
            rows.append((take.name, f"{take.frequency_hz[k]:.5f}", f"{ppm:+.2f}", drift, f"{phase:+.4f}"))
    head = ("take", "line / Hz", "frequency − first / 10⁻⁶", "amplitude − first / %", "phase rotation / rad")
    caption = (
        f"Takes, referred to the first by the channel {takes[0].reference}: its line, amplitude with U (k = 2) from "
        "noise, and the phase by which all phasors of the take were rotated"
    )
    return Table(caption, head, "lrrrr", tuple(rows))


def supports_table(evaluation: Evaluation) -> Table | None:
    """Return the measured motion of the supports of cameras and lasers, or None."""
    rows = []
    for moved in evaluation.supports:
        spread = Uncertainty((Contribution("", "A", moved.phasors.covariance, moved.phasors.dof),))
        found = polar_elements(moved.phasors.value, spread)
        for k, c in np.argwhere(moved.observed & np.isfinite(moved.phasors.value)).tolist():
            one, unit = found[k][c], moved.phasors.unit[c]
            if one is not None:
                percent = 100.0 / moved.measured_mps2[k]
                share = scaled_text(percent * one.magnitude, percent * one.expanded_magnitude, 0) if c < 3 else DASH
                names = (moved.name, ", ".join(moved.references), f"{moved.phasors.frequency_hz[k]:.4f}")
                size = quantity_text(one.magnitude, one.expanded_magnitude, unit)
                rows.append((*names, MOTION_COMPONENTS[c], size, share))
    support = ("support", "determined by", "line / Hz", "component")
    head = (*support, "acceleration at the origin", "of the motion measured / %")
    caption = "Motion of the supports of cameras and lasers, subtracted from their readings, with U (95 %)"
    return Table(caption, head, "llrlrr", tuple(rows)) if rows else None


# Tables of signals: lines, channels, drifts, clocks and triggers.


OTHER_LINES = 30
"""Largest number of lines without results in the table, by signal-to-noise ratio."""
LEAST_CHANCE = 1e-4
"""Smallest probability that is printed; below it only this bound."""


def lines_table(evaluation: Evaluation) -> Table:
    """Return the evaluated lines, and the strongest other lines with the reason."""
    lines, others = evaluation.lines, evaluation.lines.others
    rows = [
        (float(f), (quantity_text(f, 2.0 * u), number_text(nominal, 6), str(int(multiple)), "result", why))
        for f, u, nominal, multiple, why in zip(
            lines.frequency_hz, lines.u_frequency_hz, lines.nominal_hz, lines.multiple, lines.why, strict=True
        )
    ]
    for i in np.argsort(-others.snr, kind="stable")[:OTHER_LINES].tolist():
        f, u = float(others.frequency_hz[i]), float(others.u_frequency_hz[i])
        fitted = bool(np.any(np.abs(lines.nuisance_hz - f) <= 6.0 * u))
        use = "fitted in addition" if fitted else "not fitted"
        rows.append((f, (quantity_text(f, 2.0 * u), DASH, DASH, use, others.why[i])))
    rows.sort(key=lambda row: row[0])
    more = len(others.snr) - OTHER_LINES
    head = ("frequency / Hz", "nominal / Hz", "multiple", "use", "reason")
    caption = "Lines of the record, with U (k = 2)" + (f"; {more} weaker ones are left out" if more > 0 else "")
    return Table(caption, head, "rrrll", tuple(cells for _, cells in rows))


def channels_table(evaluation: Evaluation) -> Table | None:
    """Return every DAQ channel at the strongest line; a sweep leaves no residual."""
    line, rows = main_line(evaluation), []
    fitted = not evaluation.manifest.is_broadband
    for channel in evaluation.channels:
        value = complex(channel.phasors.value[line, 0])
        element = polar(value, channel.phasors.covariance[line], float(channel.phasors.dof[line]))
        amplitudes = [abs(one.phasors.value[line, 0]) for one in evaluation.channels if one.unit == channel.unit]
        factor, letter = prefix(np.array(amplitudes)) if channel.unit in PREFIXED else (1.0, "")
        amplitude = quantity_text(
            element.magnitude / factor, element.expanded_magnitude / factor, letter + channel.unit
        )
        rest = Markup("{} {}").format(number_text(channel.residual_rms / factor, 2), typeset(letter + channel.unit))
        texts = (channel.name, channel.daq, channel.quantity, number_text(channel.sample_rate_hz, 6))
        rows.append((*texts, amplitude, phase(element), *([rest] * fitted)))
    head = ("channel", "DAQ", "quantity", "rate / Hz", "amplitude", "phase / rad", *(["residual rms"] * fitted))
    frequency = f"{evaluation.lines.frequency_hz[line]:.4f} Hz"
    caption = f"Channels at {frequency}; U (95 %) from the scatter alone{equivalent_sine(evaluation)}"
    return Table(caption, head, "lllrrrr"[: len(head)], tuple(rows)) if rows else None


def drift_table(evaluation: Evaluation) -> Table | None:
    """Return the changes of the driven lines over the record, one row per instrument."""
    drifts = line_stationarity(evaluation.channels, evaluation.stereo, evaluation.lines, evaluation.clocks)
    columns: list[TableColumn[LineStationarity]] = [
        page_column("instrument", lambda drift: drift.name, "l"),
        page_column("line / Hz", lambda drift: f"{drift.frequency_hz:.4f}"),
        page_column("blocks", lambda drift: str(drift.blocks)),
        page_column("periods in each", lambda d: f"{d.periods:.0f}" if d.whole else f"{d.periods:.2f}, not whole"),
        page_column("amplitude / %", lambda drift: scaled_text(100.0 * drift.amplitude, 200.0 * drift.u_amplitude, 0)),
        page_column("phase / mrad", lambda drift: scaled_text(1e3 * drift.phase_rad, 2e3 * drift.u_phase_rad, 0)),
        page_column(
            "probability by noise",
            lambda d: f"below {LEAST_CHANCE:g}" if d.chance < LEAST_CHANCE else number_text(d.chance, 2),
        ),
    ]
    caption = (
        "Change of amplitude and phase over the record, with U (k = 2) including the rates of the clocks, from "
        "blocks of whole periods or beats"
    )
    return table(caption, columns, drifts)


def clocks_table(evaluation: Evaluation) -> Table | None:
    """Return triggers and ties of the DAQ blocks, one column each."""

    def of_trigger(text: Callable[[TriggerFit], str], none: str = DASH) -> Callable[[ClockResult], str]:
        return lambda clock: none if clock.trigger is None else text(clock.trigger)

    def of_tie(text: Callable[[ClockTie], str]) -> Callable[[ClockResult], str]:
        return lambda clock: DASH if clock.tie is None else text(clock.tie)

    def u_of(trigger: TriggerFit, parameter: int) -> float:
        return 2.0 * float(np.sqrt(trigger.covariance[parameter, parameter]))

    def offset(clock: ClockResult) -> str:
        """Return the offset from the first block, at the middle of the common edges."""
        tie = clock.tie
        if tie is None:
            return "time base" if clock is evaluation.clocks[0] else "time base of its take"
        middle = np.asarray(tie.middle_s)
        return quantity_text(float(tie.to_base_s(middle)) - tie.middle_s, 2.0 * float(tie.u_to_base_s(middle)))

    facts: Facts[ClockResult] = {
        "file": lambda clock: clock.file.name,
        "edges found": of_trigger(lambda t: str(len(t.number)), "no trigger"),
        "missing, doubled, spurious": of_trigger(lambda t: f"{len(t.missing)}, {t.doubled}, {t.spurious}"),
        "trigger rate / Hz": of_trigger(lambda t: quantity_text(1.0 / t.period_s, u_of(t, 1) / t.period_s**2)),
        "jitter beyond sampling / µs": of_trigger(lambda t: number_text(1e6 * t.jitter_s)),
        "first edge / s": of_trigger(lambda t: quantity_text(t.start_s, u_of(t, 0))),
        "pulse width / µs": lambda clock: microseconds(clock.pulse_width_s, clock.u_pulse_width_s),
        "offset in the middle / s": offset,
        "rate − 1 / 10⁻⁶": of_tie(
            lambda t: quantity_text(1e6 * (t.rate - 1.0), 2e6 * float(np.sqrt(t.covariance[1, 1])))
        ),
        "edges paired by": of_tie(lambda t: f"{t.decided_by} ({t.pairs})"),
    }
    heads = [clock.daq for clock in evaluation.clocks]
    return side_by_side("Camera trigger and clocks, U (k = 2)", heads, facts, evaluation.clocks) if heads else None
