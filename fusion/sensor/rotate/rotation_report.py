"""Files, page and printed lines of rotation tests, and the command."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fusion.base import GRAM, MILLI, prefix
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
    table,
    text_column,
)
from fusion.sensor.rotate.rotation_evaluation import evaluate_rotation
from fusion.sensor.rotate.rotation_poses import draw_poses, matrix_table, over_unit, poses_table
from fusion.sensor.rotate.rotation_readings import (
    JOINT,
    RotationEvaluation,
    RotationQuantity,
    RotationRecording,
    RotationScatter,
)
from shaker.labels import AXES, LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.harmonics import AngleFit, SourcedValue, turning_sense
from shaker.static_rotation.masses import DISAGREEMENT_SOURCE, UNDETERMINED_SOURCE
from shaker.static_rotation.orientations import OrientationFit
from shaker.static_rotation.weight_model import FORCES
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import (
    DASH,
    quantity_text,
    round_to_uncertainty,
    scaled_text,
    signed_text,
    small,
    typeset,
)

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
STANDING = ("zero_angle", "axis_tilt", "frame_tilt", "sensor_in_flange")
NORMALISED = "load_mass_normalised_deviation"
SCALED = {"kg": (GRAM, "g"), "m": (MILLI, "mm"), "rad": (MILLI, "mrad")}
"""Factors and units in which differences and positions are shown."""
MIN_UNDETERMINED_SHARE = 0.01
"""Share of u from which the undetermined part is listed."""
CLEAR = 2.0
"""Amplitude over its standard uncertainty from which a harmonic is shown as a value, otherwise as an upper limit."""


def _named(evaluation: RotationEvaluation, *names: str) -> list[RotationQuantity]:
    """Return the quantities of some names, in the order of the names."""
    return [q for name in names for q in evaluation.quantities if q.name == name]


def _in_small_unit(q: RotationQuantity) -> tuple[float, float, str]:
    """Return value and U in g, mm or mrad, with that unit."""
    scale, unit = SCALED.get(q.unit, (1.0, q.unit))
    return scale * q.value, scale * q.expanded, unit


def _term_name(name: str) -> str:
    """Return the name of a term, of cosine and sine together."""
    kind, _, rest = name.partition(" ")
    return f"harmonic {rest}" if kind in ("cos", "sin") else name


def _further_terms(recording: RotationRecording) -> str:
    """Return the names of the terms in addition to offset and gravity."""
    fit = recording.fit
    always = fit.axes + 1 if isinstance(fit, OrientationFit) else 3
    walk = ["random walk"] if fit.walk.any() else []
    return ", ".join(dict.fromkeys([*(_term_name(name) for name in fit.terms[always:]), *walk]))


def _terms(recording: RotationRecording) -> Iterator[RotationQuantity]:
    """Yield offset, amplitudes, drift and sense of every load component, with u by the noise."""
    fit = recording.fit
    if isinstance(fit, OrientationFit):
        yield from _drifts(recording, fit)
        return
    for i in recording.determined:
        row = recording.inverse[i]
        coefficient, covariance = fit.coefficient @ row, fit.combined(row)
        u = np.sqrt(np.diag(covariance))
        for index, name in enumerate(fit.terms):
            value, spread = float(coefficient[index]), float(u[index])
            if name.startswith("sin "):
                continue
            if name.startswith("cos "):
                pair = coefficient[index : index + 2]
                value = float(np.hypot(*pair))
                along = pair / value if value > 0.0 else np.array([1.0, 0.0])
                spread = float(np.sqrt(along @ covariance[index : index + 2, index : index + 2] @ along))
            label = _term_name(name)
            head = (LOAD_UNITS[i], label.replace(" ", "_"), label, LOAD_COMPONENTS[i], recording.name)
            yield RotationQuantity(value, spread, fit.dof, *head, {})


def _drifts(recording: RotationRecording, fit: OrientationFit) -> Iterator[RotationQuantity]:
    """Yield the drift of every load component over half of a series of poses."""
    if "drift" not in fit.terms:
        return
    own = slice(fit.terms.index("drift") * len(fit.channels), (fit.terms.index("drift") + 1) * len(fit.channels))
    for i in recording.determined:
        row = recording.inverse[i]
        u = float(np.sqrt(row @ fit.combined[own, own] @ row))
        head = (LOAD_UNITS[i], "drift", "drift", LOAD_COMPONENTS[i], recording.name)
        yield RotationQuantity(float(fit.coefficient[fit.terms.index("drift")] @ row), u, fit.dof, *head, {})


# Figures: readings over the angle with fit and residuals, and deviations from the weighed mass.


LOOKS = tuple(zip(COLOURS, ("circle", "square", "triangle"), strict=False))
"""Colours and markers of the three components."""


def draw_readings(recording: RotationRecording, indices: Sequence[int], kind: str) -> Figure:
    """Draw readings of some load components over the angle, with fit and residuals."""
    fit, calibration, unit = recording.fit, recording.inverse[indices], typeset(LOAD_UNITS[indices[0]])
    if isinstance(fit, OrientationFit):
        return draw_poses(recording, indices, kind)
    sense, angle = turning_sense(fit.angle_rad), np.radians(np.linspace(0.0, 360.0, 361))
    residual, fitted = fit.residual @ calibration.T, fit.curve(angle) @ calibration.T
    scale, letter = prefix(residual, coarse=False)
    drawn = empty_figure(f"rotation-{recording.name}-{kind}", 4.6, (2.0, 1.0))
    upper, lower = drawn.panels
    for c, index in enumerate(indices):
        name = LOAD_COMPONENTS[index]
        upper.line(np.degrees(angle), fitted[:, c], name, colour=LOOKS[c][0], width=0.9)
        _draw_points(upper, fit.angle_rad, sense, recording.load[:, index], LOOKS[c], name)
        _draw_points(lower, fit.angle_rad, sense, residual[:, c] / scale, LOOKS[c], name)
    lower.rule(0.0, colour=LIGHT)
    upper.y.label, lower.y.label = over_unit("load", unit), over_unit("residual", f"{letter}{unit}")
    upper.title, lower.title = f"{recording.name}: {kind}, readings and fit", "readings less fit"
    for panel in drawn.panels:
        panel.x.limits, panel.x.ticks = (-8.0, 368.0), tuple(np.arange(0.0, 361.0, 45.0).tolist())
    lower.x.label = "angle of the head / °"
    caption = "Curves: offset and harmonics fitted to all channels in one solve."
    if np.ptp(sense) > 0.0:
        caption += " Filled: reached with ascending angle; open: with descending angle."
    return drawn.with_title(f"{recording.name}, {kind} over the angle of the head", caption, main=True)


def _draw_points(
    panel: Panel, angle_rad: FloatArray, sense: FloatArray, values: FloatArray, look: tuple[str, str], label: str
) -> None:
    """Draw the readings (N,) of one component within a turn, filled for ascending angles."""
    degrees, (colour, marker) = np.degrees(angle_rad), look
    inside = (degrees >= 0.0) & (degrees <= 360.0 + 1e-6)
    degrees = np.where(inside, degrees, np.mod(degrees, 360.0))
    for selected, is_empty in ((sense >= 0.0, False), (sense < 0.0, True)):
        if selected.any():
            panel.points(
                degrees[selected], values[selected], label, colour=colour, marker=marker, size=4.0, open=is_empty
            )


def draw_deviations(evaluation: RotationEvaluation) -> Figure | None:
    """Draw the load mass less the weighed mass in %; None without both."""
    deviations = _named(evaluation, "load_mass_relative_deviation")
    weighed = evaluation.find("weighed_mass", "stated")
    if not deviations or weighed is None:
        return None
    u_weighed = 100.0 * weighed.expanded / weighed.value
    drawn = empty_figure("rotation-deviations", 2.5)
    (panel,) = drawn.panels
    panel.span(-u_weighed, u_weighed, "weighed mass, U", colour=GREY)
    panel.rule(0.0, colour=GREY)
    values, expanded = ([getattr(q, name) for q in deviations] for name in ("value", "expanded"))
    panel.points(np.arange(len(deviations)), values, half_y=expanded, colour=BLACK)
    panel.x.names = tuple(q.component for q in deviations)
    panel.y.label, panel.title = "deviation / %", "load mass minus weighed mass, with U"
    caption = "Bars: expanded uncertainty U of the difference. Grey: U of the weighed mass."
    return drawn.with_title("Load mass against the weighed mass", caption)


# The page, and the lines of the terminal.


def headlines(evaluation: RotationEvaluation) -> list[Headline]:
    """Return the masses by all force channels, and the deviation from the weighed load."""
    lines = []
    for q in _named(evaluation, "internal_mass", "load_mass", "load_mass_relative_deviation"):
        if q.component == JOINT:
            remark = f"U = {small(100.0 * q.expanded / abs(q.value))} %"
            if q.unit == "%":
                normalised = evaluation.find(NORMALISED, q.component)
                remark = "" if normalised is None else f"{abs(normalised.value):.2f} times its U"
            value = quantity_text(q.value, q.expanded, q.unit)
            lines.append(Headline(capitalise(q.label), value, f"U: k = {factor_text(q.k)}; {remark}"))
    return lines


def masses_table(evaluation: RotationEvaluation) -> Table | None:
    """Return the masses of moving part and load, by all forces and by each."""
    columns: list[TableColumn[RotationQuantity]] = [
        page_column("quantity", lambda q: capitalise(q.label), "l"),
        page_column("by", lambda q: q.component, "l"),
        page_column("mass", lambda q: quantity_text(q.value, q.expanded, q.unit)),
        page_column("U relative / %", lambda q: small(100.0 * q.expanded / abs(q.value))),
        page_column("k", lambda q: factor_text(q.k)),
        page_column("dof", lambda q: degrees_of_freedom(q.dof)),
    ]
    return table("Masses with U", columns, _named(evaluation, *MASSES))


def differences_table(evaluation: RotationEvaluation) -> Table | None:
    """Return the differences between axes and between load mass and weighed mass."""

    def over_its_u(q: RotationQuantity) -> str:
        normalised = evaluation.find(NORMALISED, q.component) if q.name == "load_mass_deviation" else None
        return DASH if normalised is None else signed_text(normalised.value)

    columns: list[TableColumn[RotationQuantity]] = [
        page_column("difference", lambda q: capitalise(q.label), "l"),
        page_column("by", lambda q: q.component, "l"),
        page_column("value", lambda q: quantity_text(*_in_small_unit(q))),
        page_column("k", lambda q: factor_text(q.k)),
        page_column("over its U", over_its_u),
    ]
    return table("Differences with U", columns, _named(evaluation, *DIFFERENCES))


def centres_table(evaluation: RotationEvaluation) -> Table | None:
    """Return the centres of mass in sensor axes, in mm."""

    def coordinate(axis: str) -> TableColumn[dict[str, RotationQuantity]]:
        def cell(by_axis: dict[str, RotationQuantity]) -> str:
            return quantity_text(*_in_small_unit(by_axis[axis])[:2]) if axis in by_axis else DASH

        return page_column(axis, cell)

    columns: list[TableColumn[dict[str, RotationQuantity]]] = [
        page_column("position", lambda by_axis: f"{capitalise(next(iter(by_axis.values())).label)} / mm", "l"),
        *map(coordinate, AXES),
    ]
    rows = [{q.component: q for q in _named(evaluation, name)} for name in CENTRES]
    return table("Centres of mass, sensor axes, with U", columns, filter(None, rows))


def recordings_table(evaluation: RotationEvaluation) -> Table | None:
    """Return state, readings and weight of each recording."""

    def weight(by: str) -> TableColumn[RotationRecording]:
        def cell(recording: RotationRecording) -> str:
            q = evaluation.find("weight", by, recording.name)
            return DASH if q is None else quantity_text(q.value, q.expanded)

        return page_column("weight / N" if by == JOINT else f"by {by} / N", cell)

    available = {q.component for q in _named(evaluation, "weight")}
    columns: list[TableColumn[RotationRecording]] = [
        page_column("recording", lambda recording: recording.name, "l"),
        page_column("state", lambda recording: "load mounted" if recording.with_load else "without load", "l"),
        page_column("readings", lambda recording: f"{len(recording.fit.reading)}"),
        *(weight(name) for name in (JOINT, *LOAD_COMPONENTS[:3]) if name in available),
        page_column("further terms", lambda recording: _further_terms(recording) or "none", "l"),
    ]
    return table("Recordings: weight in air with U, terms that the readings show", columns, evaluation.recordings)


def repeats_tables(evaluation: RotationEvaluation) -> list[Table]:
    """Return the recordings of repeated states, and their scatter beyond the stated uncertainties."""
    if not evaluation.repeats:
        return []
    rows = []
    for scatter in evaluation.repeats:
        for name, mounting in zip(scatter.recordings, scatter.mountings, strict=True):
            weight, off = (evaluation.find(key, JOINT, name) for key in ("weight", "weight_deviation"))
            if weight is not None and off is not None:
                deviation = quantity_text(MILLI * off.value, MILLI * off.expanded)
                over = signed_text(off.value / off.expanded) if off.u > 0.0 else DASH
                value = quantity_text(weight.value, weight.expanded)
                rows.append((scatter.state, mounting, name, value, deviation, over))
    caption = "Repeats: weight in air with U, deviation from the mean"
    head = ("state", "mounting", "recording", "weight / N", "minus mean / mN", "over its U")

    def spread(of: Callable[[RotationScatter], float]) -> Callable[[RotationScatter], str]:
        return lambda scatter: small(MILLI * of(scatter)) if np.isfinite(of(scatter)) else DASH

    columns: list[TableColumn[RotationScatter]] = [
        page_column("state", lambda scatter: scatter.state, "l"),
        page_column("recordings", lambda scatter: f"{len(scatter.recordings)}"),
        page_column("mountings", lambda scatter: f"{len(set(scatter.mountings))}"),
        page_column(f"{WITHIN} s / mN", spread(lambda scatter: scatter.within)),
        page_column("dof", lambda scatter: f"{scatter.within_dof}"),
        page_column(f"{BETWEEN} s / mN", spread(lambda scatter: scatter.between)),
        page_column("dof", lambda scatter: f"{scatter.between_dof}"),
    ]
    beyond = "Scatter of the weight beyond noise and stated errors, of one recording and of one mounting"
    scatter_table = table(beyond, columns, evaluation.repeats)
    return [Table(caption, head, "lllrrr", tuple(rows)), *([] if scatter_table is None else [scatter_table])]


def harmonics_table(evaluation: RotationEvaluation, recording: RotationRecording, indices: Sequence[int]) -> Table:
    """Return the terms of some load components with U, small amplitudes as bounds."""
    fit, components = recording.fit, [LOAD_COMPONENTS[i] for i in indices]
    rows: dict[str, list[str]] = {}

    def bound(size: float) -> str:
        return round_to_uncertainty(size, size, 0).expanded

    offsets = [q for q in evaluation.quantities if (q.name, q.recording) == ("offset", recording.name)]
    for q in (*offsets, *_terms(recording)):
        if q.component in components:
            bound_only = q.label.startswith("harmonic") and q.value < CLEAR * q.u
            cell = f"< {bound(q.expanded)}" if bound_only else scaled_text(q.value, q.expanded)
            rows.setdefault(capitalise(q.label), []).append(cell)
    calibration = recording.inverse[indices]
    scatter = np.sqrt(np.diag(calibration @ fit.noise @ calibration.T))
    rows["Scatter s of a reading"] = [bound(float(s)) for s in scatter]
    back = np.zeros((0, len(components)))
    if isinstance(fit, AngleFit):
        back = np.abs(fit.reversal().difference @ calibration.T)
    if len(back):
        rows["Largest difference forward less back"] = [bound(float(value)) for value in back.max(axis=0)]
    heads = [over_unit(component, typeset(LOAD_UNITS[indices[0]])) for component in components]
    caption = f"{recording.name}: readings over the angle, U of the noise alone (dof {fit.dof:.0f})"
    if isinstance(fit, OrientationFit):
        caption = f"{recording.name}: offset and drift over half of the series, with U"
    cells = tuple((label, *row) for label, row in rows.items())
    return Table(caption, ("term", *heads), "l" + "r" * len(heads), cells)


def axis_table(evaluation: RotationEvaluation) -> Table | None:
    """Return the estimated angles of the head of every recording."""
    columns: list[TableColumn[RotationQuantity]] = [
        page_column("recording", lambda q: q.recording, "l"),
        page_column("quantity", lambda q: capitalise(q.label), "l"),
        page_column("component", lambda q: q.component, "l"),
        page_column("value / mrad", lambda q: quantity_text(*_in_small_unit(q)[:2])),
        page_column("k", lambda q: factor_text(q.k)),
    ]
    standing = [q for q in evaluation.quantities if q.name in STANDING]
    stood = [q for recording in evaluation.recordings for q in standing if q.recording == recording.name]
    return table("Head or flange as estimated, with U", columns, stood)


def budget_tables(evaluation: RotationEvaluation) -> list[Table]:
    """Return the budgets of masses, deviation of the load and centres, the largest contribution first."""

    def budget(caption: str, shown: Sequence[RotationQuantity]) -> Table:
        listed = {(name, u / q.u) for q in shown for name, u in q.budget.items()}
        named = {name for name, share in listed if name != UNDETERMINED_SOURCE or share > MIN_UNDETERMINED_SHARE}
        names = sorted(named, key=lambda name: -max(q.budget.get(name, 0.0) / q.u for q in shown))
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
    """Return gravity and air density."""
    columns: list[TableColumn[tuple[str, SourcedValue]]] = [
        page_column("quantity", lambda row: row[0], "l"),
        page_column("value", lambda row: quantity_text(row[1].value, 2.0 * row[1].u)),
        page_column("source", lambda row: row[1].source, "l"),
    ]
    around = [("Local gravity / (m/s²)", evaluation.gravity), ("Density of the air / (kg/m³)", evaluation.air)]
    return table("Surroundings, U: k = 2", columns, around)


def printed(evaluation: RotationEvaluation) -> Iterator[str]:
    """Yield the printed lines; positions, angles and differences in the smaller unit."""

    def number_text(q: RotationQuantity) -> str:
        whole = q.unit == "kg" and "difference" not in q.name and "deviation" not in q.name
        return f"{q.component} {quantity_text(*((q.value, q.expanded, q.unit) if whole else _in_small_unit(q)))}"

    for recording in evaluation.recordings:
        more = _further_terms(recording)
        weights = [q for q in _named(evaluation, "weight") if q.recording == recording.name]
        read = f"{len(recording.fit.reading)} readings, offset and first harmonic"
        if isinstance(recording.fit, OrientationFit):
            read = f"{len(recording.fit.count)} poses of {recording.fit.count.sum()} readings, offset and gravity"
        read += f", also {more}" if more else ""
        yield f"{recording.name} ({recording.state}): {read}; weight {', '.join(map(number_text, weights))}"
        offsets = [q for q in _named(evaluation, "offset") if q.recording == recording.name]
        if offsets:
            yield f"{recording.name}: offset {', '.join(map(number_text, offsets))}"
    by_label: dict[str, list[str]] = {}
    for q in _named(evaluation, *MASSES, *DIFFERENCES, *CENTRES):
        by_label.setdefault(q.label, []).append(number_text(q))
    for label, parts in by_label.items():
        yield f"{label}: {', '.join(parts)}"
    normalised = ", ".join(f"{q.component} {signed_text(q.value)}" for q in _named(evaluation, NORMALISED))
    if normalised:
        yield f"normalised deviation of the load mass: {normalised} (agreement: within ±1)"


def _context(evaluation: RotationEvaluation) -> dict[str, Any]:
    recordings = evaluation.recordings
    names = [f"{recording.name} ({recording.manifest.name})" for recording in recordings]
    kinds = {"forces": range(FORCES), "moments": range(FORCES, len(LOAD_COMPONENTS))}
    groups = [
        (recording, kind, indices)
        for recording in recordings
        for kind, of_kind in kinds.items()
        if (indices := [i for i in recording.determined if i in of_kind])
    ]
    return {
        "subject": [*subject_of(recordings[0].manifest.rig), ("Recordings", ", ".join(names))],
        "masses": masses_table(evaluation),
        "differences": differences_table(evaluation),
        "centres": centres_table(evaluation),
        "deviations": [figure for figure in [draw_deviations(evaluation)] if figure is not None],
        "recordings": recordings_table(evaluation),
        "poses": poses_table(evaluation),
        "matrix": matrix_table(evaluation),
        "repeats": repeats_tables(evaluation),
        "readings": [draw_readings(recording, indices, kind) for recording, kind, indices in groups],
        "harmonics": [harmonics_table(evaluation, recording, indices) for recording, _, indices in groups],
        "axis": axis_table(evaluation),
        "budgets": budget_tables(evaluation),
        "surroundings": surroundings_table(evaluation),
    }


# The files.


STORED_SOURCES = {UNDETERMINED_SOURCE: "what no channel tells", DISAGREEMENT_SOURCE: "channels that disagree"}
"""Names of sources in files of this format, which users' programs read."""
NUMBERS: list[TableColumn[RotationQuantity]] = quantity_columns(lambda q: q)
QUANTITIES: list[TableColumn[RotationQuantity]] = [
    text_column("name", lambda q: q.name),
    text_column("component", lambda q: q.component or "-"),
    *NUMBERS,
    text_column("recording", lambda q: q.recording or "all"),
]


def _fill(file: h5py.File, evaluation: RotationEvaluation) -> None:
    """Fill the HDF5 file with surroundings, recordings, fitted weights, causes of error, scatter and numbers."""
    file.attrs["name"] = evaluation.name
    file.attrs["harmonics"] = "reading = design . coefficient; A exp(+j angle), A = cos - j sin; k = 1"
    for key in ("gravity", "air"):
        value, group = getattr(evaluation, key), file.create_group(key)
        for name in ("value", "u", "source"):
            write_value(group, name, getattr(value, name))
    group = file.create_group("recordings", track_order=True)
    for recording in evaluation.recordings:
        item = group.create_group(group.free_name(recording.name), track_order=True)
        item.attrs["with_load"] = recording.with_load
        write_value(item, "unit", recording.unit)
        write_value(item, "load", recording.load)
        for name in vars(recording.fit):
            if name not in ("rounding", "effects", "estimator", "spread"):
                write_value(item, name, getattr(recording.fit, name))
    weights, group = evaluation.weights, file.create_group("weights", track_order=True)
    for name in ("names", "value", "covariance", "load", "chi_squared", "dof", "departure", "moment_departure"):
        write_value(group, name, getattr(weights, name))
    sources = group.create_group("sources", track_order=True)
    for source in weights.sources:
        item = sources.create_group(sources.free_name(STORED_SOURCES.get(source.name, source.name)))
        item.attrs["type"], item.attrs["dof"] = source.kind, source.dof
        item["effect"] = source.effect
    for scatter in evaluation.repeats:
        write_fields(file.require_group("repeats").create_group(scatter.state), scatter)
    group = file.create_group("quantities", track_order=True)
    for quantity in evaluation.quantities:
        name = " ".join(filter(None, (quantity.name, quantity.component, quantity.recording)))
        item = group.create_group(group.free_name(name))
        for name in ("value", "u", "dof", "unit"):
            item.attrs[name] = getattr(quantity, name)
        budget = {STORED_SOURCES.get(cause, cause): u for cause, u in quantity.budget.items()}
        item.create_group("budget").attrs.update(budget)


def _texts(evaluation: RotationEvaluation) -> dict[str, str | bytes]:
    """Return every number, then offset, harmonics and further terms of every channel."""
    terms = [q for recording in evaluation.recordings for q in _terms(recording)]
    return {"rotation.csv": csv_text(QUANTITIES, [*evaluation.quantities, *terms])}


ROTATE = CommandReport("rotate", "rotation", ("rotation.csv",), _texts, _fill, _context, printed, headlines)


def run_rotate(paths: Sequence[Path], output: Path | None, *, force: bool = False, allow_outside: bool = False) -> None:
    """Evaluate rotation recordings together, write the results and print the summary."""
    manifests = load_for_command(paths, ROTATE.name, allow_outside=allow_outside)
    manifests.sort(key=lambda manifest: bool(manifest.excitation.with_load))
    name = manifests[0].name if len(manifests) == 1 else manifests[0].rig.name
    ROTATE.run_recordings(
        paths, manifests, output, lambda hashes: evaluate_rotation(name, manifests, hashes), force=force
    )
