"""What a rotation test leaves: rotation.csv, rotation.h5, the page, and the lines of the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fusion.base import DASH, GRAM, MILLI, typeset
from fusion.campaign.repeats import BETWEEN, WITHIN
from fusion.recording.load import load_for_command
from fusion.report.folder import Command, subject_of
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import (
    Column,
    Headline,
    Table,
    capital,
    csv_text,
    degrees_of_freedom,
    factor,
    measured,
    on_page,
    plain,
    quantity_columns,
    short,
    signed,
    small,
    table,
    word,
)
from fusion.sensor.rotate.evaluate import UNTOLD, evaluate_rotation
from fusion.sensor.rotate.figures import draw_deviations, draw_readings
from fusion.sensor.rotate.readings import JOINT, Repeats, RotationEvaluation, RotationQuantity, RotationRecording
from shaker.labels import AXES, LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.harmonics import Known
from shaker.static_rotation.masses import FORCES

NONE, ALL = "-", "all"
"""Component of what has none, recording of what rests on all."""
NUMBERS: list[Column[RotationQuantity]] = quantity_columns(lambda q: q)
QUANTITIES: list[Column[RotationQuantity]] = [
    word("name", lambda q: q.name),
    word("component", lambda q: q.component or NONE),
    *NUMBERS,
    word("recording", lambda q: q.recording or ALL),
]
HEADLINES = ("internal_mass", "load_mass", "load_mass_relative_deviation")
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
STANDING = ("zero_angle", "axis_tilt")
NORMALISED = "load_mass_normalised_deviation"
SCALED = {"kg": (GRAM, "g"), "m": (MILLI, "mm"), "rad": (MILLI, "mrad")}
"""Units in which differences and places are told."""
SMALLEST_UNTOLD = 0.01
"""Share in an uncertainty from which what no channel tells is listed."""
CLEAR = 2.0
"""Amplitude over its standard uncertainty from which a harmonic is given a value of its own."""


def _in_small_unit(q: RotationQuantity, *, with_unit: bool = False) -> str:
    """Value with U in g, mm or mrad."""
    scale, unit = SCALED.get(q.unit, (1.0, q.unit))
    return measured(scale * q.value, scale * q.expanded, unit if with_unit else "")


def headlines(evaluation: RotationEvaluation) -> list[Headline]:
    """Masses by all force channels together, and the load's deviation from the weighed mass."""
    told = []
    for q in _named(evaluation, HEADLINES):
        if q.component == JOINT:
            remark = f"U = {small(100.0 * q.expanded / abs(q.value))} %"
            if q.unit == "%":
                normalised = evaluation.find(NORMALISED, q.component)
                remark = "" if normalised is None else f"{abs(normalised.value):.2f} times its U"
            value = measured(q.value, q.expanded, q.unit)
            told.append(Headline(capital(q.label), value, f"U: k = {factor(q.k)}; {remark}"))
    return told


MASS_COLUMNS: list[Column[RotationQuantity]] = [
    on_page("quantity", lambda q: capital(q.label), "l"),
    on_page("by", lambda q: q.component, "l"),
    on_page("mass", lambda q: measured(q.value, q.expanded, q.unit)),
    on_page("U relative / %", lambda q: small(100.0 * q.expanded / abs(q.value))),
    on_page("k", lambda q: factor(q.k)),
    on_page("dof", lambda q: degrees_of_freedom(q.dof)),
]


def differences_table(evaluation: RotationEvaluation) -> Table | None:
    """How far axes are apart and the load is from what was weighed."""

    def over_its_u(q: RotationQuantity) -> str:
        normalised = evaluation.find(NORMALISED, q.component) if q.name == "load_mass_deviation" else None
        return DASH if normalised is None else signed(normalised.value)

    columns: list[Column[RotationQuantity]] = [
        on_page("difference", lambda q: capital(q.label), "l"),
        on_page("by", lambda q: q.component, "l"),
        on_page("value", lambda q: _in_small_unit(q, with_unit=True)),
        on_page("k", lambda q: factor(q.k)),
        on_page("over its U", over_its_u),
    ]
    return table("Differences with U", columns, _named(evaluation, DIFFERENCES))


def centres_table(evaluation: RotationEvaluation) -> Table | None:
    """Centres of mass in sensor axes, in mm."""

    def coordinate(axis: str) -> Column[dict[str, RotationQuantity]]:
        return on_page(axis, lambda places: _in_small_unit(places[axis]) if axis in places else DASH)

    columns: list[Column[dict[str, RotationQuantity]]] = [
        on_page("place", lambda places: f"{capital(next(iter(places.values())).label)} / mm", "l"),
        *map(coordinate, AXES),
    ]
    rows = [{q.component: q for q in _named(evaluation, (name,))} for name in CENTRES]
    return table("Centres of mass, sensor axes, with U", columns, filter(None, rows))


def recordings_table(evaluation: RotationEvaluation) -> Table | None:
    """Each recording: what was read, what it weighs, how the head stood."""

    def weight(by: str) -> Column[RotationRecording]:
        def cell(recording: RotationRecording) -> str:
            q = evaluation.find("weight", by, recording.name)
            return DASH if q is None else measured(q.value, q.expanded)

        return on_page("weight / N" if by == JOINT else f"by {by} / N", cell)

    known = {q.component for q in _named(evaluation, ("weight",))}
    columns: list[Column[RotationRecording]] = [
        on_page("recording", lambda recording: recording.name, "l"),
        on_page("state", lambda recording: "load mounted" if recording.with_load else "without load", "l"),
        on_page("readings", lambda recording: f"{len(recording.fit.angle_rad)}"),
        *(weight(name) for name in (JOINT, *LOAD_COMPONENTS[:3]) if name in known),
        on_page("further terms", lambda recording: ", ".join(_further_terms(recording)) or "none", "l"),
    ]
    return table("Recordings: weight in air with U, terms that the readings show", columns, evaluation.recordings)


def _further_terms(recording: RotationRecording) -> list[str]:
    """Names of the terms beside offset and first harmonic."""
    return list(dict.fromkeys(_term_name(name) for name in recording.fit.terms[3:]))


def repeats_tables(evaluation: RotationEvaluation) -> list[Table]:
    """Recordings of a state that was recorded repeatedly, and what they scatter by beyond what is stated of each."""
    if not evaluation.repeats:
        return []
    rows = []
    for again in evaluation.repeats:
        for name, mounting in zip(again.recordings, again.mountings, strict=True):
            weight, off = (evaluation.find(key, JOINT, name) for key in ("weight", "weight_deviation"))
            if weight is not None and off is not None:
                deviation = measured(MILLI * off.value, MILLI * off.expanded)
                over = signed(off.value / off.expanded) if off.u > 0.0 else DASH
                rows.append((again.state, mounting, name, measured(weight.value, weight.expanded), deviation, over))
    caption = "Repeats: weight in air with U, deviation from the mean"
    head = ("state", "mounting", "recording", "weight / N", "less mean / mN", "over its U")
    scatter = table(
        "Scatter of the weight beyond noise and what is stated, of one recording and of one mounting",
        SCATTER,
        evaluation.repeats,
    )
    return [Table(caption, head, "lllrrr", tuple(rows)), *([] if scatter is None else [scatter])]


SCATTER: list[Column[Repeats]] = [
    on_page("state", lambda again: again.state, "l"),
    on_page("recordings", lambda again: f"{len(again.recordings)}"),
    on_page("mountings", lambda again: f"{len(set(again.mountings))}"),
    on_page(f"{WITHIN} s / mN", lambda again: small(MILLI * again.within) if again.within_dof else DASH),
    on_page("dof", lambda again: f"{again.within_dof}"),
    on_page(f"{BETWEEN} s / mN", lambda again: small(MILLI * again.between) if again.between_dof else DASH),
    on_page("dof", lambda again: f"{again.between_dof}"),
]


def harmonics_tables(recording: RotationRecording) -> list[Table]:
    """Offset, harmonics and further terms of forces and moments of a recording, and what turning back changes."""
    return [_harmonics_table(recording, places) for _, places in _groups(recording)]


def _groups(recording: RotationRecording) -> list[tuple[str, list[int]]]:
    """Load components that the channels tell, forces and moments apart."""
    groups = [("forces", [i for i in recording.told if i < FORCES])]
    groups.append(("moments", [i for i in recording.told if i >= FORCES]))
    return [(kind, places) for kind, places in groups if places]


AXIS: list[Column[RotationQuantity]] = [
    on_page("recording", lambda q: q.recording, "l"),
    on_page("quantity", lambda q: capital(q.label), "l"),
    on_page("component", lambda q: q.component, "l"),
    on_page("value / mrad", _in_small_unit),
    on_page("k", lambda q: factor(q.k)),
]


SURROUNDINGS: list[Column[tuple[str, Known]]] = [
    on_page("quantity", lambda row: row[0], "l"),
    on_page("value", lambda row: measured(row[1].value, 2.0 * row[1].u)),
    on_page("source", lambda row: row[1].source, "l"),
]


def budget_tables(evaluation: RotationEvaluation) -> list[Table]:
    """What contributes to internal mass, load mass and the load's deviation."""
    wanted = ("internal_mass", "load_mass", "load_mass_deviation")
    masses = [q for q in _named(evaluation, wanted) if q.component == JOINT]
    centres = _named(evaluation, CENTRES[:2])
    groups = [
        ("Budgets of the masses, standard uncertainties in g", masses),
        ("Budgets of the centres of mass, standard uncertainties in mm", centres),
    ]
    return [_budget(caption, found) for caption, found in groups if found]


def printed(evaluation: RotationEvaluation) -> Iterator[str]:
    """Lines for the terminal, U at the coverage factor of each."""
    for recording in evaluation.recordings:
        more = ", ".join(_further_terms(recording))
        weights = [q for q in evaluation.quantities if q.name == "weight" and q.recording == recording.name]
        told = ", ".join(f"{q.component} {_printed(q)}" for q in weights)
        read = f"{len(recording.fit.angle_rad)} readings, offset and first harmonic{f', also {more}' if more else ''}"
        yield f"{recording.name} ({recording.state}): {read}; weight {told}"
    told_by_label: dict[str, list[str]] = {}
    for q in _named(evaluation, (*MASSES, *DIFFERENCES, *CENTRES)):
        told_by_label.setdefault(q.label, []).append(f"{q.component} {_printed(q)}")
    for label, parts in told_by_label.items():
        yield f"{label}: {', '.join(parts)}"
    normalised = _named(evaluation, (NORMALISED,))
    if normalised:
        told = ", ".join(f"{q.component} {signed(q.value)}" for q in normalised)
        yield f"normalised deviation of the load mass: {told} (agreement: within ±1)"


def _harmonics_table(recording: RotationRecording, places: Sequence[int]) -> Table:
    """Terms of some load components, with U; of an amplitude that may be zero its bound only."""
    fit, components = recording.fit, [LOAD_COMPONENTS[i] for i in places]
    rows: dict[str, list[str]] = {}
    for q in _terms(recording):
        if q.component in components:
            bound_only = q.label.startswith("harmonic") and q.value < CLEAR * q.u
            cell = f"< {short(q.expanded)}" if bound_only else measured(q.value, q.expanded)
            rows.setdefault(capital(q.label), []).append(cell)
    calibration = recording.inverse[places]
    scatter = np.sqrt(np.diag(calibration @ fit.noise @ calibration.T))
    rows["Scatter s of a reading"] = [short(float(s)) for s in scatter]
    back = np.abs(fit.reversal().difference @ calibration.T)
    if len(back):
        rows["Largest difference forward less back"] = [short(float(value)) for value in back.max(axis=0)]
    unit = typeset(LOAD_UNITS[places[0]])
    heads = [f"{component} / {unit if '·' not in unit else f'({unit})'}" for component in components]
    caption = f"{recording.name}: readings over the angle, U of the noise alone (dof {fit.dof:.0f})"
    cells = tuple((label, *row) for label, row in rows.items())
    return Table(caption, ("term", *heads), "l" + "r" * len(heads), cells)


def _named(evaluation: RotationEvaluation, names: Sequence[str]) -> list[RotationQuantity]:
    """Quantities of some names, in the order of the names."""
    return [q for name in names for q in evaluation.quantities if q.name == name]


def _terms(recording: RotationRecording) -> Iterator[RotationQuantity]:
    """Offset, amplitudes of the harmonics, drift and sense of every load component, with the noise's uncertainty."""
    fit = recording.fit
    for i in recording.told:
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


def _term_name(name: str) -> str:
    """Name of a term, of cosine and sine together."""
    kind, _, rest = name.partition(" ")
    return f"harmonic {rest}" if kind in ("cos", "sin") else name


def _printed(q: RotationQuantity) -> str:
    """Value with U and unit for the terminal; places, angles and differences in the smaller unit."""
    whole = q.unit == "kg" and "difference" not in q.name and "deviation" not in q.name
    scale, unit = (1.0, q.unit) if whole else SCALED.get(q.unit, (1.0, q.unit))
    return plain(scale * q.value, scale * q.expanded, unit)


def _budget(caption: str, found: Sequence[RotationQuantity]) -> Table:
    """Contributions to some quantities, largest first for the last of them."""
    names = sorted(
        {name for q in found for name, u in q.budget.items() if name != UNTOLD or u > SMALLEST_UNTOLD * q.u},
        key=lambda name: -max(q.budget.get(name, 0.0) / q.u for q in found),
    )
    scale = SCALED[found[0].unit][0]
    rows = [(name, *(small(scale * q.budget[name]) if name in q.budget else DASH for q in found)) for name in names]
    rows.append(("combined, k = 1", *(small(scale * q.u) for q in found)))
    heads = [f"{capital(q.label)} {q.component}" for q in found]
    return Table(caption, ("contribution", *heads), "l" + "r" * len(found), tuple(rows))


def _context(evaluation: RotationEvaluation) -> dict[str, Any]:
    """What the page shows."""
    recordings = evaluation.recordings
    told = [f"{recording.name} ({recording.manifest.name})" for recording in recordings]
    standing = [q for q in evaluation.quantities if q.name in STANDING]
    stood = [q for recording in recordings for q in standing if q.recording == recording.name]
    around = [("Local gravity / (m/s²)", evaluation.gravity), ("Density of the air / (kg/m³)", evaluation.air)]
    return {
        "subject": [*subject_of(recordings[0].manifest.rig), ("Recordings", ", ".join(told))],
        "headlines": headlines(evaluation),
        "masses": table("Masses with U", MASS_COLUMNS, _named(evaluation, MASSES)),
        "differences": differences_table(evaluation),
        "centres": centres_table(evaluation),
        "deviations": [picture for picture in [draw_deviations(evaluation)] if picture is not None],
        "recordings": recordings_table(evaluation),
        "repeats": repeats_tables(evaluation),
        "readings": [
            draw_readings(recording, places, kind) for recording in recordings for kind, places in _groups(recording)
        ],
        "harmonics": [shown for recording in recordings for shown in harmonics_tables(recording)],
        "axis": table("The head as estimated, with U", AXIS, stood),
        "budgets": budget_tables(evaluation),
        "surroundings": table("Surroundings, U: k = 2", SURROUNDINGS, around),
    }


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
        own = group.create_group(recording.name, track_order=True)
        own.attrs["with_load"] = recording.with_load
        write_value(own, "unit", recording.unit)
        write_value(own, "load", recording.load)
        write_fields(own, recording.fit)
    weights, group = evaluation.weights, file.create_group("weights", track_order=True)
    for name in ("names", "value", "covariance", "load", "chi_squared", "dof", "departure"):
        write_value(group, name, getattr(weights, name))
    sources = group.create_group("sources", track_order=True)
    for source in weights.sources:
        own = sources.create_group(source.name)
        own.attrs["type"], own.attrs["dof"] = source.kind, source.dof
        own["effect"] = source.effect
    for again in evaluation.repeats:
        write_fields(file.require_group("repeats").create_group(again.state), again)
    group = file.create_group("quantities", track_order=True)
    for quantity in evaluation.quantities:
        own = group.create_group(" ".join(filter(None, (quantity.name, quantity.component, quantity.recording))))
        for name in ("value", "u", "dof", "unit"):
            own.attrs[name] = getattr(quantity, name)
        own.create_group("budget").attrs.update(quantity.budget)


def _texts(evaluation: RotationEvaluation) -> dict[str, str | bytes]:
    """Every number; then offset, harmonics and further terms of every channel, whose u is that of the noise."""
    terms = [q for recording in evaluation.recordings for q in _terms(recording)]
    return {"rotation.csv": csv_text(QUANTITIES, [*evaluation.quantities, *terms])}


ROTATE = Command("rotate", "rotation", ("rotation.csv",), _texts, _fill, _context, printed)


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
