"""Tables and headlines of a recording's report: sensitivity, acceleration, load, cameras, lines, channels, clocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, prefix, typeset
from fusion.estimation.fuse import Acceleration
from fusion.estimation.uncertainty import Polar, element_covariance, polar
from fusion.phasors.setup import LineStationarity, line_stationarity
from fusion.phasors.stereo_phasors import StereoResult
from fusion.phasors.timing import ClockResult
from fusion.report.table import (
    WEAK,
    Column,
    Headline,
    Table,
    common_exponent,
    degrees_of_freedom,
    fixed,
    half_axes,
    measured,
    microseconds,
    number,
    on_page,
    phase,
    polar_cells,
    sensitivity_unit,
    short,
    table,
    times_ten,
)
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.ratio import Sensitivity
from fusion.sensitivity.ratio import driven_component as driven_load
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shaker.sine.phasor import Phasors

# What a reader wants first: the driven component, the output that belongs to it, and the strongest line.


def driven_component(evaluation: Evaluation) -> int:
    """Place of the driven component among x, y, z, rx, ry, rz.

    The largest element of the excitation's direction, forces and moments in shares of the rated loads; where none is
    stated, the translation that moves most.
    """
    direction, sensor = evaluation.manifest.excitation.direction, evaluation.manifest.rig.sensor
    if direction is not None:
        return driven_load(direction, None if sensor is None else sensor.capacity)
    sizes = [np.abs(result.phasors.value[:, :3]) for result in evaluation.accelerations]
    moves = np.nan_to_num(np.concatenate(sizes)) if sizes else np.zeros((1, 3))
    return int(np.argmax(moves.max(axis=0)))


def driven_channel(evaluation: Evaluation) -> int:
    """Place of the sensor output that belongs to the driven component.

    The largest static sensitivity decides where one is given, else the largest ratio at the main line.
    """
    found = evaluation.sensitivity
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    component = driven_component(evaluation)
    static = static_sensitivity(evaluation)
    sizes = np.abs(found.value[main_line(evaluation), :, component] if static is None else static[:, component])
    usable = np.where(found.observed[:, component] & np.isfinite(sizes), sizes, -1.0)
    return int(np.argmax(usable))


def driven_element(evaluation: Evaluation) -> int:
    """Place of the driven channel and component among the elements of the sensitivity."""
    found = evaluation.sensitivity
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    return found.elements.index((driven_channel(evaluation), driven_component(evaluation)))


def main_line(evaluation: Evaluation) -> int:
    """Place of the strongest line: the largest driven fused acceleration of the load, else the first line."""
    result = acceleration(evaluation, "load", "fused") or next(iter(evaluation.accelerations), None)
    if result is None:
        return 0
    driven = np.abs(result.phasors.value[:, driven_component(evaluation)])
    return int(np.nanargmax(driven)) if np.isfinite(driven).any() else 0


def acceleration(evaluation: Evaluation, body: str, source: str) -> Acceleration | None:
    """Acceleration of one body from one source, None where there is none."""
    for result in evaluation.accelerations:
        if (result.body, result.source) == (body, source):
            return result
    return None


def bodies(evaluation: Evaluation) -> list[str]:
    """Bodies whose acceleration was determined, in order of appearance."""
    return list(dict.fromkeys(result.body for result in evaluation.accelerations))


def by_source(evaluation: Evaluation, body: str) -> list[Acceleration]:
    """Results of one body, fused first; only the fused one where it rests on a single instrument."""
    results = [result for result in evaluation.accelerations if result.body == body]
    fused = acceleration(evaluation, body, "fused")
    return [fused] if fused is not None and len(fused.instruments) < 2 and len(results) < 3 else results


def static_sensitivity(evaluation: Evaluation) -> np.typing.NDArray[np.float64] | None:
    """Static sensitivity (C, 6) of the outputs evaluated, None where the rig states none."""
    sensor, found = evaluation.manifest.rig.sensor, evaluation.sensitivity
    if sensor is None or found is None or sensor.static_sensitivity is None:
        return None
    rows = [list(sensor.channels).index(name) for name in found.channels]
    return np.asarray(sensor.static_sensitivity, dtype=np.float64)[rows]


def static_value(evaluation: Evaluation, channel: int, component: int) -> float | None:
    """One element of the static sensitivity, None where it is not stated or zero."""
    static = static_sensitivity(evaluation)
    return float(static[channel, component]) if static is not None and static[channel, component] != 0.0 else None


def sensitivity_element(sensitivity: Sensitivity, line: int, channel: int, component: int) -> Polar:
    """One element of the sensitivity at one line, as magnitude and phase."""
    place = line, channel, component
    return polar(complex(sensitivity.value[place]), sensitivity.covariance[place], float(sensitivity.dof[place]))


# Headlines and tables of the results.


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


# Tables of signals: lines, channels, what drifted, clocks and triggers.


OTHER_LINES = 30
"""Lines without results that are listed, those that stand out most."""
LEAST_CHANCE = 1e-4
"""Below it, a chance is only said to be smaller."""


def lines_table(evaluation: Evaluation) -> Table:
    """The lines evaluated, the others that stand out most, and why."""
    lines, others = evaluation.lines, evaluation.lines.others
    rows = [
        (float(f), (measured(f, 2.0 * u), f"{nominal:g}", str(int(multiple)), "result", why))
        for f, u, nominal, multiple, why in zip(
            lines.frequency_hz, lines.u_frequency_hz, lines.nominal_hz, lines.multiple, lines.why, strict=True
        )
    ]
    for i in np.argsort(-others.snr, kind="stable")[:OTHER_LINES].tolist():
        f, u = float(others.frequency_hz[i]), float(others.u_frequency_hz[i])
        beside = bool(np.any(np.abs(lines.nuisance_hz - f) <= 6.0 * u))
        use = "fitted beside" if beside else "not fitted"
        rows.append((f, (measured(f, 2.0 * u), DASH, DASH, use, others.why[i])))
    rows.sort(key=lambda row: row[0])
    more = len(others.snr) - OTHER_LINES
    head = ("frequency / Hz", "nominal / Hz", "multiple", "use", "reason")
    caption = "Lines of the record, with U (k = 2)" + (f"; {more} weaker ones are left out" if more > 0 else "")
    return Table(caption, head, "rrrll", tuple(cells for _, cells in rows))


def channels_table(evaluation: Evaluation) -> Table | None:
    """Every DAQ channel at the strongest line."""
    line, rows = main_line(evaluation), []
    for channel in evaluation.channels:
        value = complex(channel.phasors.value[line, 0])
        element = polar(
            value, element_covariance(channel.phasors.covariance[line], 0), float(channel.phasors.dof[line])
        )
        factor, letter = prefix(np.array([abs(value)])) if channel.unit in PREFIXED else (1.0, "")
        amplitude = measured(element.magnitude / factor, element.expanded_magnitude / factor, letter + channel.unit)
        rest = Markup("{} {}").format(short(channel.residual_rms / factor), typeset(letter + channel.unit))
        known = (channel.name, channel.daq, channel.quantity, f"{channel.sample_rate_hz:g}")
        rows.append((*known, amplitude, phase(element), rest))
    head = ("channel", "DAQ", "quantity", "rate / Hz", "amplitude", "phase / rad", "residual rms")
    caption = "Channels at the strongest line; U (95 %) from the scatter alone"
    return Table(caption, head, "lllrrrr", tuple(rows)) if rows else None


def drift_table(evaluation: Evaluation) -> Table | None:
    """Return the changes of the driven lines over the record, one row per instrument; None without any."""
    drifts = line_stationarity(evaluation.channels, evaluation.stereo, evaluation.lines, evaluation.clocks)
    columns: list[Column[LineStationarity]] = [
        on_page("instrument", lambda drift: drift.name, "l"),
        on_page("line / Hz", lambda drift: f"{drift.frequency_hz:.4f}"),
        on_page("blocks", lambda drift: str(drift.blocks)),
        on_page("periods in each", lambda d: f"{d.periods:.0f}" if d.whole else f"{d.periods:.2f}, not whole"),
        on_page("amplitude / %", lambda drift: fixed(100.0 * drift.amplitude, 200.0 * drift.u_amplitude, 0)),
        on_page("phase / mrad", lambda drift: fixed(1e3 * drift.phase_rad, 2e3 * drift.u_phase_rad, 0)),
        on_page(
            "chance of noise",
            lambda d: f"{d.chance:.2g}" if d.chance >= LEAST_CHANCE else f"below {LEAST_CHANCE:g}",
        ),
    ]
    caption = (
        "Change of amplitude and phase over the record, with U (k = 2) that has the rates of the clocks in it, from "
        "blocks of whole periods or beats"
    )
    return table(caption, columns, drifts)


def clocks_table(evaluation: Evaluation) -> Table | None:
    """Triggers and ties of the DAQ blocks, one column each."""
    if not evaluation.clocks:
        return None
    found = ["file", "edges found", "missing, doubled, spurious", "trigger rate / Hz", "jitter beyond sampling / µs"]
    found += ["first edge / s", "pulse width / µs"]
    names = [*found, "offset in the middle / s", "rate − 1 / 10⁻⁶", "edges paired by"]
    columns = [
        (clock.file.name, *_trigger_cells(clock), *_tie_cells(clock, evaluation.clocks[0]))
        for clock in evaluation.clocks
    ]
    rows = tuple((name, *(column[place] for column in columns)) for place, name in enumerate(names))
    head = ("", *(clock.daq for clock in evaluation.clocks))
    return Table("Camera trigger and clocks, U (k = 2)", head, "l" + "r" * len(columns), rows)


def _trigger_cells(clock: ClockResult) -> list[str]:
    """Edges, missing, doubled and spurious ones, rate, jitter, first edge."""
    trigger = clock.trigger
    if trigger is None:
        return ["no trigger", *[DASH] * 5]
    u_start, u_period = 2.0 * np.sqrt(np.diag(trigger.covariance))
    return [
        str(len(trigger.number)),
        f"{len(trigger.missing)}, {trigger.doubled}, {trigger.spurious}",
        measured(1.0 / trigger.period_s, float(u_period) / trigger.period_s**2),
        number(1e6 * trigger.jitter_s),
        measured(trigger.start_s, float(u_start)),
        microseconds(clock.pulse_width_s, clock.u_pulse_width_s),
    ]


def _tie_cells(clock: ClockResult, base: ClockResult) -> list[str]:
    """Offset in the middle of the common edges and rate against the first block, and what paired the edges."""
    tie = clock.tie
    if tie is None:
        return ["time base" if clock is base else "time base of its take", DASH, DASH]
    middle = np.asarray(tie.middle_s)
    offset = measured(float(tie.to_base_s(middle)) - tie.middle_s, 2.0 * float(tie.u_to_base_s(middle)))
    rate = measured(1e6 * (tie.rate - 1.0), 2e6 * float(np.sqrt(tie.covariance[1, 1])))
    return [offset, rate, f"{tie.decided_by} ({tie.pairs})"]
