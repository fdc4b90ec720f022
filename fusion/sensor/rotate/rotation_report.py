"""What a rotation test leaves: rotation.csv, rotation.h5, the page with its figures, and the lines of the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fusion.base import DASH, GRAM, MILLI, prefix
from fusion.campaign.repeats import BETWEEN, WITHIN
from fusion.recording.load import load_for_command
from fusion.report.figure import BLACK, COLOURS, GREY, LIGHT, Figure, Panel, empty_figure
from fusion.report.folder import CommandReport, subject_of
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    csv_text,
    degrees_of_freedom,
    factor_text,
    page_column,
    quantity_columns,
    quantity_html,
    quantity_text,
    short,
    signed_text,
    small,
    table,
    text_column,
)
from fusion.sensor.rotate.rotation_evaluation import UNDETERMINED, evaluate_rotation
from fusion.sensor.rotate.rotation_readings import (
    JOINT,
    RotationEvaluation,
    RotationQuantity,
    RotationRecording,
    RotationScatter,
)
from shaker.arrays import FloatArray
from shaker.labels import AXES, LOAD_COMPONENTS, LOAD_UNITS, typeset
from shaker.static_rotation.harmonics import SourcedValue, turning_sense
from shaker.static_rotation.masses import FORCES

MASSES = ("internal_mass", "load_mass", "weighed_mass")
DIFFERENCES = (
    "internal_mass_difference",
    "internal_mass_relative_difference",
    "load_mass_difference",
    "load_mass_relative_difference",
    "load_mass_deviation",
    "load_mass_relative_deviation",
)
CENTRES = ("internal_centre_of_mass", "load_centre_of_mass", "load_centre_of_mass_deviation")
NORMALISED = "load_mass_normalised_deviation"
SCALED = {"kg": (GRAM, "g"), "m": (MILLI, "mm"), "rad": (MILLI, "mrad")}
"""Units in which differences and places are told."""
SMALLEST_UNTOLD = 0.01
"""Share in an uncertainty from which what no channel tells is listed."""
CLEAR = 2.0
"""Amplitude over its standard uncertainty from which a harmonic is given a value of its own."""


def _named(evaluation: RotationEvaluation, *names: str) -> list[RotationQuantity]:
    """Quantities of some names, in the order of the names."""
    return [q for name in names for q in evaluation.quantities if q.name == name]


def _in_small_unit(q: RotationQuantity) -> tuple[float, float, str]:
    """Value and U in g, mm or mrad, with that unit."""
    scale, unit = SCALED.get(q.unit, (1.0, q.unit))
    return scale * q.value, scale * q.expanded, unit


def _over(what: str, unit: str) -> str:
    """What is shown, over its unit."""
    return f"{what} / ({unit})" if "·" in unit else f"{what} / {unit}"


def _term_name(name: str) -> str:
    """Name of a term, of cosine and sine together."""
    kind, _, rest = name.partition(" ")
    return f"harmonic {rest}" if kind in ("cos", "sin") else name


def _further_terms(recording: RotationRecording) -> str:
    """Names of the terms beside offset and first harmonic."""
    return ", ".join(dict.fromkeys(_term_name(name) for name in recording.fit.terms[3:]))


def _terms(recording: RotationRecording) -> Iterator[RotationQuantity]:
    """Offset, amplitudes of the harmonics, drift and sense of every load component, with the noise's uncertainty."""
    fit = recording.fit
    for i in recording.determined:
        row = recording.inverse[i]
        coefficient, noise = fit.coefficient @ row, float(row @ fit.noise @ row)
        u = np.sqrt(noise * np.diag(fit.inverse))
        for place, name in enumerate(fit.terms):
            value, spread = float(coefficient[place]), float(u[place])
            if name.startswith("sin "):
                continue
            if name.startswith("cos "):
                pair = coefficient[place : place + 2]
                value = float(np.hypot(*pair))
                along = pair / value if value > 0.0 else np.array([1.0, 0.0])
                spread = float(np.sqrt(noise * along @ fit.inverse[place : place + 2, place : place + 2] @ along))
            label = _term_name(name)
            head = (LOAD_UNITS[i], label.replace(" ", "_"), label, LOAD_COMPONENTS[i], recording.name)
            yield RotationQuantity(value, spread, fit.dof, *head, {})


# Figures: readings over the angle with fit and residuals, masses against what was weighed.


LOOKS = tuple(zip(COLOURS, ("circle", "square", "triangle"), strict=False))
"""Colours and markers of the three components."""


def draw_readings(recording: RotationRecording, places: Sequence[int], kind: str) -> Figure:
    """Readings of some load components over the angle with the harmonics fitted, and what these leave."""
    fit, calibration, unit = recording.fit, recording.inverse[places], typeset(LOAD_UNITS[places[0]])
    sense, angle = turning_sense(fit.angle_rad), np.radians(np.linspace(0.0, 360.0, 361))
    residual, fitted = fit.residual @ calibration.T, fit.curve(angle) @ calibration.T
    scale, letter = prefix(residual, coarse=False)
    drawn = empty_figure(f"rotation-{recording.name}-{kind}", 4.6, (2.0, 1.0))
    upper, lower = drawn.panels
    for c, place in enumerate(places):
        name = LOAD_COMPONENTS[place]
        upper.line(np.degrees(angle), fitted[:, c], name, colour=LOOKS[c][0], width=0.9)
        _draw_points(upper, fit.angle_rad, sense, recording.load[:, place], LOOKS[c], name)
        _draw_points(lower, fit.angle_rad, sense, residual[:, c] / scale, LOOKS[c], name)
    lower.rule(0.0, colour=LIGHT)
    upper.y.label, lower.y.label = _over("load", unit), _over("residual", f"{letter}{unit}")
    upper.title, lower.title = f"{recording.name}: {kind}, readings and fit", "readings less fit"
    for panel in drawn.panels:
        panel.x.limits, panel.x.ticks = (-8.0, 368.0), tuple(np.arange(0.0, 361.0, 45.0).tolist())
    lower.x.label = "angle of the head / °"
    caption = "Curves: offset and harmonics fitted to all channels in one solve."
    if np.ptp(sense) > 0.0:
        caption += " Filled: come to with the angle growing; open: with the angle falling."
    return drawn.with_title(f"{recording.name}, {kind} over the angle of the head", caption, main=True)


def _draw_points(
    panel: Panel, angle_rad: FloatArray, sense: FloatArray, values: FloatArray, look: tuple[str, str], label: str
) -> None:
    """Readings (N,) of one component within a turn, filled where the angle grew and open where it fell."""
    degrees, (colour, marker) = np.degrees(angle_rad), look
    inside = (degrees >= 0.0) & (degrees <= 360.0 + 1e-6)
    degrees = np.where(inside, degrees, np.mod(degrees, 360.0))
    for own, is_open in ((sense >= 0.0, False), (sense < 0.0, True)):
        if own.any():
            panel.points(degrees[own], values[own], label, colour=colour, marker=marker, size=4.0, open=is_open)


def draw_deviations(evaluation: RotationEvaluation) -> Figure | None:
    """Load mass by each axis and by all less the weighed mass in %, with U; None without both."""
    deviations = _named(evaluation, "load_mass_relative_deviation")
    weighed = evaluation.find("weighed_mass", "stated")
    if not deviations or weighed is None:
        return None
    own = 100.0 * weighed.expanded / weighed.value
    drawn = empty_figure("rotation-deviations", 2.5)
    (panel,) = drawn.panels
    panel.span(-own, own, "weighed mass, U", colour=GREY)
    panel.rule(0.0, colour=GREY)
    values, expanded = ([getattr(q, name) for q in deviations] for name in ("value", "expanded"))
    panel.points(np.arange(len(deviations)), values, half_y=expanded, colour=BLACK)
    panel.x.names = tuple(q.component for q in deviations)
    panel.y.label, panel.title = "deviation / %", "load mass less weighed mass, with U"
    caption = "Bars: expanded uncertainty U of the difference. Grey: U of the weighed mass."
    return drawn.with_title("Load mass against the weighed mass", caption)


# The page, and the lines of the terminal.


def headlines(evaluation: RotationEvaluation) -> list[Headline]:
    """Masses by all force channels together, and the load's deviation from the weighed mass."""
    told = []
    for q in _named(evaluation, "internal_mass", "load_mass", "load_mass_relative_deviation"):
        if q.component == JOINT:
            remark = f"U = {small(100.0 * q.expanded / abs(q.value))} %"
            if q.unit == "%":
                normalised = evaluation.find(NORMALISED, q.component)
                remark = "" if normalised is None else f"{abs(normalised.value):.2f} times its U"
            value = quantity_html(q.value, q.expanded, q.unit)
            told.append(Headline(capitalise(q.label), value, f"U: k = {factor_text(q.k)}; {remark}"))
    return told


def masses_table(evaluation: RotationEvaluation) -> Table | None:
    """Masses of the sensor's moving part and of the load, by all forces and by each."""
    columns: list[TableColumn[RotationQuantity]] = [
        page_column("quantity", lambda q: capitalise(q.label), "l"),
        page_column("by", lambda q: q.component, "l"),
        page_column("mass", lambda q: quantity_html(q.value, q.expanded, q.unit)),
        page_column("U relative / %", lambda q: small(100.0 * q.expanded / abs(q.value))),
        page_column("k", lambda q: factor_text(q.k)),
        page_column("dof", lambda q: degrees_of_freedom(q.dof)),
    ]
    return table("Masses with U", columns, _named(evaluation, *MASSES))


def differences_table(evaluation: RotationEvaluation) -> Table | None:
    """How far axes are apart and the load is from what was weighed."""

    def over_its_u(q: RotationQuantity) -> str:
        normalised = evaluation.find(NORMALISED, q.component) if q.name == "load_mass_deviation" else None
        return DASH if normalised is None else signed_text(normalised.value)

    columns: list[TableColumn[RotationQuantity]] = [
        page_column("difference", lambda q: capitalise(q.label), "l"),
        page_column("by", lambda q: q.component, "l"),
        page_column("value", lambda q: quantity_html(*_in_small_unit(q))),
        page_column("k", lambda q: factor_text(q.k)),
        page_column("over its U", over_its_u),
    ]
    return table("Differences with U", columns, _named(evaluation, *DIFFERENCES))


def centres_table(evaluation: RotationEvaluation) -> Table | None:
    """Centres of mass in sensor axes, in mm."""

    def coordinate(axis: str) -> TableColumn[dict[str, RotationQuantity]]:
        return page_column(
            axis, lambda places: quantity_html(*_in_small_unit(places[axis])[:2]) if axis in places else DASH
        )

    columns: list[TableColumn[dict[str, RotationQuantity]]] = [
        page_column("place", lambda places: f"{capitalise(next(iter(places.values())).label)} / mm", "l"),
        *map(coordinate, AXES),
    ]
    rows = [{q.component: q for q in _named(evaluation, name)} for name in CENTRES]
    return table("Centres of mass, sensor axes, with U", columns, filter(None, rows))


def recordings_table(evaluation: RotationEvaluation) -> Table | None:
    """Each recording: what was read, what it weighs, how the head stood."""

    def weight(by: str) -> TableColumn[RotationRecording]:
        def cell(recording: RotationRecording) -> str:
            q = evaluation.find("weight", by, recording.name)
            return DASH if q is None else quantity_html(q.value, q.expanded)

        return page_column("weight / N" if by == JOINT else f"by {by} / N", cell)

    known = {q.component for q in _named(evaluation, "weight")}
    columns: list[TableColumn[RotationRecording]] = [
        page_column("recording", lambda recording: recording.name, "l"),
        page_column("state", lambda recording: "load mounted" if recording.with_load else "without load", "l"),
        page_column("readings", lambda recording: f"{len(recording.fit.angle_rad)}"),
        *(weight(name) for name in (JOINT, *LOAD_COMPONENTS[:3]) if name in known),
        page_column("further terms", lambda recording: _further_terms(recording) or "none", "l"),
    ]
    return table("Recordings: weight in air with U, terms that the readings show", columns, evaluation.recordings)


def repeats_tables(evaluation: RotationEvaluation) -> list[Table]:
    """Recordings of a state that was recorded repeatedly, and what they scatter by beyond what is stated of each."""
    if not evaluation.repeats:
        return []
    rows = []
    for again in evaluation.repeats:
        for name, mounting in zip(again.recordings, again.mountings, strict=True):
            weight, off = (evaluation.find(key, JOINT, name) for key in ("weight", "weight_deviation"))
            if weight is not None and off is not None:
                deviation = quantity_html(MILLI * off.value, MILLI * off.expanded)
                over = signed_text(off.value / off.expanded) if off.u > 0.0 else DASH
                rows.append(
                    (again.state, mounting, name, quantity_html(weight.value, weight.expanded), deviation, over)
                )
    caption = "Repeats: weight in air with U, deviation from the mean"
    head = ("state", "mounting", "recording", "weight / N", "less mean / mN", "over its U")
    columns: list[TableColumn[RotationScatter]] = [
        page_column("state", lambda again: again.state, "l"),
        page_column("recordings", lambda again: f"{len(again.recordings)}"),
        page_column("mountings", lambda again: f"{len(set(again.mountings))}"),
        page_column(f"{WITHIN} s / mN", lambda again: small(MILLI * again.within) if again.within_dof else DASH),
        page_column("dof", lambda again: f"{again.within_dof}"),
        page_column(f"{BETWEEN} s / mN", lambda again: small(MILLI * again.between) if again.between_dof else DASH),
        page_column("dof", lambda again: f"{again.between_dof}"),
    ]
    beyond = "Scatter of the weight beyond noise and what is stated, of one recording and of one mounting"
    scatter = table(beyond, columns, evaluation.repeats)
    return [Table(caption, head, "lllrrr", tuple(rows)), *([] if scatter is None else [scatter])]


def harmonics_table(recording: RotationRecording, places: Sequence[int]) -> Table:
    """Terms of some load components, with U; of an amplitude that may be zero its bound only."""
    fit, components = recording.fit, [LOAD_COMPONENTS[i] for i in places]
    rows: dict[str, list[str]] = {}
    for q in _terms(recording):
        if q.component in components:
            bound_only = q.label.startswith("harmonic") and q.value < CLEAR * q.u
            cell = f"< {short(q.expanded)}" if bound_only else quantity_html(q.value, q.expanded)
            rows.setdefault(capitalise(q.label), []).append(cell)
    calibration = recording.inverse[places]
    scatter = np.sqrt(np.diag(calibration @ fit.noise @ calibration.T))
    rows["Scatter s of a reading"] = [short(float(s)) for s in scatter]
    back = np.abs(fit.reversal().difference @ calibration.T)
    if len(back):
        rows["Largest difference forward less back"] = [short(float(value)) for value in back.max(axis=0)]
    heads = [_over(component, typeset(LOAD_UNITS[places[0]])) for component in components]
    caption = f"{recording.name}: readings over the angle, U of the noise alone (dof {fit.dof:.0f})"
    cells = tuple((label, *row) for label, row in rows.items())
    return Table(caption, ("term", *heads), "l" + "r" * len(heads), cells)


def axis_table(evaluation: RotationEvaluation) -> Table | None:
    """How the head stood in every recording."""
    columns: list[TableColumn[RotationQuantity]] = [
        page_column("recording", lambda q: q.recording, "l"),
        page_column("quantity", lambda q: capitalise(q.label), "l"),
        page_column("component", lambda q: q.component, "l"),
        page_column("value / mrad", lambda q: quantity_html(*_in_small_unit(q)[:2])),
        page_column("k", lambda q: factor_text(q.k)),
    ]
    standing = [q for q in evaluation.quantities if q.name in ("zero_angle", "axis_tilt")]
    stood = [q for recording in evaluation.recordings for q in standing if q.recording == recording.name]
    return table("The head as estimated, with U", columns, stood)


def budget_tables(evaluation: RotationEvaluation) -> list[Table]:
    """What contributes to internal mass, load mass, the load's deviation and the centres, largest first."""

    def budget(caption: str, shown: Sequence[RotationQuantity]) -> Table:
        names = sorted(
            {name for q in shown for name, u in q.budget.items() if name != UNDETERMINED or u > SMALLEST_UNTOLD * q.u},
            key=lambda name: -max(q.budget.get(name, 0.0) / q.u for q in shown),
        )
        scale = SCALED[shown[0].unit][0]
        rows = [(name, *(small(scale * q.budget[name]) if name in q.budget else DASH for q in shown)) for name in names]
        rows.append(("combined, k = 1", *(small(scale * q.u) for q in shown)))
        heads = [f"{capitalise(q.label)} {q.component}" for q in shown]
        return Table(caption, ("contribution", *heads), "l" + "r" * len(shown), tuple(rows))

    masses = _named(evaluation, "internal_mass", "load_mass", "load_mass_deviation")
    groups = {
        "Budgets of the masses, standard uncertainties in g": [q for q in masses if q.component == JOINT],
        "Budgets of the centres of mass, standard uncertainties in mm": _named(evaluation, *CENTRES[:2]),
    }
    return [budget(caption, shown) for caption, shown in groups.items() if shown]


def surroundings_table(evaluation: RotationEvaluation) -> Table | None:
    """Gravity and air."""
    columns: list[TableColumn[tuple[str, SourcedValue]]] = [
        page_column("quantity", lambda row: row[0], "l"),
        page_column("value", lambda row: quantity_html(row[1].value, 2.0 * row[1].u)),
        page_column("source", lambda row: row[1].source, "l"),
    ]
    around = [("Local gravity / (m/s²)", evaluation.gravity), ("Density of the air / (kg/m³)", evaluation.air)]
    return table("Surroundings, U: k = 2", columns, around)


def printed(evaluation: RotationEvaluation) -> Iterator[str]:
    """Lines for the terminal, U at the coverage factor of each; places, angles and differences in the smaller unit."""

    def told(q: RotationQuantity) -> str:
        whole = q.unit == "kg" and "difference" not in q.name and "deviation" not in q.name
        return f"{q.component} {quantity_text(*((q.value, q.expanded, q.unit) if whole else _in_small_unit(q)))}"

    for recording in evaluation.recordings:
        more = _further_terms(recording)
        weights = [q for q in _named(evaluation, "weight") if q.recording == recording.name]
        read = f"{len(recording.fit.angle_rad)} readings, offset and first harmonic{f', also {more}' if more else ''}"
        yield f"{recording.name} ({recording.state}): {read}; weight {', '.join(map(told, weights))}"
    by_label: dict[str, list[str]] = {}
    for q in _named(evaluation, *MASSES, *DIFFERENCES, *CENTRES):
        by_label.setdefault(q.label, []).append(told(q))
    for label, parts in by_label.items():
        yield f"{label}: {', '.join(parts)}"
    normalised = ", ".join(f"{q.component} {signed_text(q.value)}" for q in _named(evaluation, NORMALISED))
    if normalised:
        yield f"normalised deviation of the load mass: {normalised} (agreement: within ±1)"


def _context(evaluation: RotationEvaluation) -> dict[str, Any]:
    recordings = evaluation.recordings
    told = [f"{recording.name} ({recording.manifest.name})" for recording in recordings]
    kinds = {"forces": range(FORCES), "moments": range(FORCES, len(LOAD_COMPONENTS))}
    groups = [
        (recording, kind, places)
        for recording in recordings
        for kind, own in kinds.items()
        if (places := [i for i in recording.determined if i in own])
    ]
    return {
        "subject": [*subject_of(recordings[0].manifest.rig), ("Recordings", ", ".join(told))],
        "masses": masses_table(evaluation),
        "differences": differences_table(evaluation),
        "centres": centres_table(evaluation),
        "deviations": [picture for picture in [draw_deviations(evaluation)] if picture is not None],
        "recordings": recordings_table(evaluation),
        "repeats": repeats_tables(evaluation),
        "readings": [draw_readings(recording, places, kind) for recording, kind, places in groups],
        "harmonics": [harmonics_table(recording, places) for recording, _, places in groups],
        "axis": axis_table(evaluation),
        "budgets": budget_tables(evaluation),
        "surroundings": surroundings_table(evaluation),
    }


# The files.


NUMBERS: list[TableColumn[RotationQuantity]] = quantity_columns(lambda q: q)
QUANTITIES: list[TableColumn[RotationQuantity]] = [
    text_column("name", lambda q: q.name),
    text_column("component", lambda q: q.component or "-"),
    *NUMBERS,
    text_column("recording", lambda q: q.recording or "all"),
]


def _fill(file: h5py.File, evaluation: RotationEvaluation) -> None:
    """Fill the HDF5 file: surroundings, recordings, the fit of weights with each cause of error, scatter, numbers."""
    file.attrs["name"] = evaluation.name
    file.attrs["harmonics"] = "reading = design . coefficient; A exp(+j angle), A = cos - j sin; k = 1"
    for key in ("gravity", "air"):
        known, group = getattr(evaluation, key), file.create_group(key)
        for name in ("value", "u", "source"):
            write_value(group, name, getattr(known, name))
    group = file.create_group("recordings", track_order=True)
    for recording in evaluation.recordings:
        own = group.create_group(group.free_name(recording.name), track_order=True)
        own.attrs["with_load"] = recording.with_load
        write_value(own, "unit", recording.unit)
        write_value(own, "load", recording.load)
        write_fields(own, recording.fit)
    weights, group = evaluation.weights, file.create_group("weights", track_order=True)
    for name in ("names", "value", "covariance", "load", "chi_squared", "dof", "departure"):
        write_value(group, name, getattr(weights, name))
    sources = group.create_group("sources", track_order=True)
    for source in weights.sources:
        own = sources.create_group(sources.free_name(source.name))
        own.attrs["type"], own.attrs["dof"] = source.kind, source.dof
        own["effect"] = source.effect
    for again in evaluation.repeats:
        write_fields(file.require_group("repeats").create_group(again.state), again)
    group = file.create_group("quantities", track_order=True)
    for quantity in evaluation.quantities:
        name = " ".join(filter(None, (quantity.name, quantity.component, quantity.recording)))
        own = group.create_group(group.free_name(name))
        for name in ("value", "u", "dof", "unit"):
            own.attrs[name] = getattr(quantity, name)
        own.create_group("budget").attrs.update(quantity.budget)


def _texts(evaluation: RotationEvaluation) -> dict[str, str | bytes]:
    """Every number; then offset, harmonics and further terms of every channel, whose u is that of the noise."""
    terms = [q for recording in evaluation.recordings for q in _terms(recording)]
    return {"rotation.csv": csv_text(QUANTITIES, [*evaluation.quantities, *terms])}


ROTATE = CommandReport("rotate", "rotation", ("rotation.csv",), _texts, _fill, _context, printed, headlines)


def run_rotate(paths: Sequence[Path], output: Path | None, *, force: bool = False, allow_outside: bool = False) -> None:
    """Evaluate the rotation recordings at some paths together, write the results and print the summary.

    Of a campaign folder those of kind rotation are taken. Results stand in its folder `rotate`, or in that of the only
    recording, or, of several paths, beside rig.toml; or in `output`.
    """
    manifests = load_for_command(paths, ROTATE.name, allow_outside=allow_outside)
    manifests.sort(key=lambda manifest: bool(manifest.excitation.with_load))
    name = manifests[0].name if len(manifests) == 1 else manifests[0].rig.name
    ROTATE.run_recordings(
        paths, manifests, output, lambda hashes: evaluate_rotation(name, manifests, hashes), force=force
    )
