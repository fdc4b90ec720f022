"""The page of a rotation test."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from fusion.campaign.repeats import BETWEEN, WITHIN
from fusion.estimation.uncertainty import DASH, rounded, typeset
from fusion.report.csv_files import Row
from fusion.report.numbers import degrees_of_freedom, factor, measured, short, small
from fusion.report.recording import page_frame
from fusion.report.style import Picture
from fusion.report.tables import Headline, Table, render_page
from fusion.sensor.rotate.figures import Deviations, TurnedReadings, draw_deviations, draw_readings
from fusion.sensor.rotate.masses import UNTOLD
from fusion.sensor.rotate.readings import JOINT, Quantity, RotationEvaluation, RotationRecording
from shaker.arrays import FloatArray
from shaker.labels import AXES, LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.harmonics import turning_sense
from shaker.static_rotation.masses import FORCES

# The numbers of a rotation test as rows and tables: rotation.csv, the page's tables, and what the command prints.


COLUMNS = ["name", "component", "value", "u", "U", "k", "unit", "dof", "recording"]
MILLIMETRE, MILLIRADIAN, GRAM, MILLI = 1e3, 1e3, 1e3, 1e3
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
SCALED = {"kg": (GRAM, "g"), "m": (MILLIMETRE, "mm"), "rad": (MILLIRADIAN, "mrad")}
"""Units in which differences and places are told."""
NONE, ALL = "-", "all"
"""Component of what has none, recording of what rests on all."""
SMALLEST_UNTOLD = 0.01
"""Share in an uncertainty from which what no channel tells is listed."""
CLEAR = 2.0
"""Amplitude over its standard uncertainty from which a harmonic is given a value of its own."""


def quantity_rows(evaluation: RotationEvaluation) -> Iterator[Row]:
    """One row per number; then offset, harmonics and further terms of every channel, whose u is that of the noise."""
    terms = [q for recording in evaluation.recordings for q in _terms(recording)]
    for q in (*evaluation.quantities, *terms):
        numbers: Row = [q.value, q.u, q.expanded, q.k]
        yield [q.name, q.component or NONE, *numbers, q.unit, q.dof, q.recording or ALL]


def headlines(evaluation: RotationEvaluation) -> list[Headline]:
    """Masses by all force channels together, and the load's deviation from the weighed mass."""
    told = []
    for q in _named(evaluation, HEADLINES):
        if q.component == JOINT:
            told.append(Headline(_capital(q.label), _value(q), f"U: k = {factor(q.k)}; {_remark(evaluation, q)}"))
    return told


def masses_table(evaluation: RotationEvaluation) -> Table | None:
    """Internal mass and load mass, by all forces and by each alone."""
    rows = [(_capital(q.label), q.component, _value(q), *_tail(q)) for q in _named(evaluation, MASSES)]
    head = ("quantity", "by", "mass", "U relative / %", "k", "dof")
    return Table("Masses with U", head, "llrrrr", tuple(rows)) if rows else None


def differences_table(evaluation: RotationEvaluation) -> Table | None:
    """How far axes are apart and the load is from what was weighed."""
    rows = []
    for q in _named(evaluation, DIFFERENCES):
        normalised = evaluation.find(NORMALISED, q.component) if q.name == "load_mass_deviation" else None
        over = _signed(normalised.value) if normalised is not None else DASH
        rows.append((_capital(q.label), q.component, _value(q, small_unit=True), factor(q.k), over))
    head = ("difference", "by", "value", "k", "over its U")
    return Table("Differences with U", head, "llrrr", tuple(rows)) if rows else None


def centres_table(evaluation: RotationEvaluation) -> Table | None:
    """Centres of mass in sensor axes, in mm."""
    rows = []
    for name in CENTRES:
        found = {q.component: q for q in _named(evaluation, (name,))}
        if found:
            label = _capital(next(iter(found.values())).label)
            cells = [_scaled_value(found[axis]) if axis in found else DASH for axis in AXES]
            rows.append((f"{label} / mm", *cells))
    head = ("place", *AXES)
    return Table("Centres of mass, sensor axes, with U", head, "lrrr", tuple(rows)) if rows else None


def recordings_table(evaluation: RotationEvaluation) -> Table:
    """Each recording: what was read, what it weighs, how the head stood."""
    by = [
        name
        for name in (JOINT, *LOAD_COMPONENTS[:3])
        if any(q.component == name for q in _named(evaluation, ("weight",)))
    ]
    rows = []
    for recording in evaluation.recordings:
        fit = recording.fit
        weights = [evaluation.find("weight", name, recording.name) for name in by]
        state = "load mounted" if recording.with_load else "without load"
        cells = (DASH if q is None else measured(q.value, q.expanded) for q in weights)
        more = ", ".join(dict.fromkeys(_term_name(name) for name in fit.terms[3:]))
        rows.append((recording.name, state, f"{len(fit.angle_rad)}", *cells, more or "none"))
    heads = ["weight / N" if name == JOINT else f"by {name} / N" for name in by]
    head = ("recording", "state", "readings", *heads, "further terms")
    align = "llr" + "r" * len(by) + "l"
    return Table("Recordings: weight in air with U, terms that the readings show", head, align, tuple(rows))


def repeats_tables(evaluation: RotationEvaluation) -> list[Table]:
    """Recordings of a state that was recorded repeatedly, and what they scatter by beyond what is stated of each."""
    if not evaluation.repeats:
        return []
    rows, scatter = [], []
    for again in evaluation.repeats:
        for name, mounting in zip(again.recordings, again.mountings, strict=True):
            weight, off = (evaluation.find(key, JOINT, name) for key in ("weight", "weight_deviation"))
            if weight is not None and off is not None:
                deviation = measured(MILLI * off.value, MILLI * off.expanded)
                over = _signed(off.value / off.expanded) if off.u > 0.0 else DASH
                rows.append((again.state, mounting, name, measured(weight.value, weight.expanded), deviation, over))
        within, between = ((again.within, again.within_dof), (again.between, again.between_dof))
        cells = [cell for s, dof in (within, between) for cell in (small(MILLI * s) if dof else DASH, f"{dof}")]
        counts = (f"{len(again.recordings)}", f"{len(set(again.mountings))}")
        scatter.append((again.state, *counts, *cells))
    caption = "Repeats: weight in air with U, deviation from the mean"
    head = ("state", "mounting", "recording", "weight / N", "less mean / mN", "over its U")
    beyond = "Scatter of the weight beyond noise and what is stated, of one recording and of one mounting"
    kinds = ("state", "recordings", "mountings", f"{WITHIN} s / mN", "dof", f"{BETWEEN} s / mN", "dof")
    return [Table(caption, head, "lllrrr", tuple(rows)), Table(beyond, kinds, "lrrrrrr", tuple(scatter))]


def harmonics_tables(recording: RotationRecording) -> list[Table]:
    """Offset, harmonics and further terms of forces and moments of a recording, and what turning back changes."""
    groups = [[i for i in recording.told if i < FORCES], [i for i in recording.told if i >= FORCES]]
    return [_harmonics_table(recording, places) for places in groups if places]


def axis_table(evaluation: RotationEvaluation) -> Table | None:
    """How the head stood in every recording."""
    rows = []
    for recording in evaluation.recordings:
        for q in evaluation.quantities:
            if q.recording == recording.name and q.name in STANDING:
                rows.append((recording.name, _capital(q.label), q.component, _scaled_value(q), factor(q.k)))
    head = ("recording", "quantity", "component", "value / mrad", "k")
    return Table("The head as estimated, with U", head, "lllrr", tuple(rows)) if rows else None


def surroundings_table(evaluation: RotationEvaluation) -> Table:
    """Gravity and air, and where they come from."""
    rows = (
        (
            "Local gravity / (m/s²)",
            measured(evaluation.gravity.value, 2.0 * evaluation.gravity.u),
            evaluation.gravity.source,
        ),
        ("Density of the air / (kg/m³)", measured(evaluation.air.value, 2.0 * evaluation.air.u), evaluation.air.source),
    )
    return Table("Surroundings, U: k = 2", ("quantity", "value", "source"), "lrl", rows)


def budget_tables(evaluation: RotationEvaluation) -> list[Table]:
    """What contributes to internal mass, load mass and the load's deviation."""
    wanted = ("internal_mass", "load_mass", "load_mass_deviation")
    found = [q for q in _named(evaluation, wanted) if q.component == JOINT]
    centres = _named(evaluation, CENTRES[:2])
    tables = [_budget("Budgets of the masses, standard uncertainties in g", found)] if found else []
    return tables + (
        [_budget("Budgets of the centres of mass, standard uncertainties in mm", centres)] if centres else []
    )


def printed(evaluation: RotationEvaluation) -> Iterator[str]:
    """Lines for the terminal, U at the coverage factor of each."""
    for recording in evaluation.recordings:
        fit = recording.fit
        names = dict.fromkeys(_term_name(name) for name in fit.terms[3:])
        more = f", also {', '.join(names)}" if names else ""
        weights = [q for q in evaluation.quantities if q.name == "weight" and q.recording == recording.name]
        told = ", ".join(f"{q.component} {_plain(q)}" for q in weights)
        read = f"{len(fit.angle_rad)} readings, offset and first harmonic{more}"
        yield f"{recording.name} ({recording.state}): {read}; weight {told}"
    told_by_label: dict[str, list[str]] = {}
    for q in _named(evaluation, (*MASSES, *DIFFERENCES, *CENTRES)):
        told_by_label.setdefault(q.label, []).append(f"{q.component} {_plain(q)}")
    for label, parts in told_by_label.items():
        yield f"{label}: {', '.join(parts)}"
    normalised = _named(evaluation, (NORMALISED,))
    if normalised:
        told = ", ".join(f"{q.component} {_signed(q.value)}" for q in normalised)
        yield f"normalised deviation of the load mass: {told} (agreement: within ±1)"


def _harmonics_table(recording: RotationRecording, places: Sequence[int]) -> Table:
    """Terms of some load components."""
    fit, components = recording.fit, [LOAD_COMPONENTS[i] for i in places]
    terms = [q for q in _terms(recording) if q.component in components]
    rows = []
    for name, label in dict.fromkeys((q.name, q.label) for q in terms):
        rows.append((_capital(label), *(_term(q) for q in terms if q.name == name)))
    calibration = recording.inverse[places]
    scatter = np.sqrt(np.diag(calibration @ fit.noise @ calibration.T))
    rows.append(("Scatter s of a reading", *(short(float(s)) for s in scatter)))
    back = np.abs(fit.reversal().difference @ calibration.T)
    if len(back):
        rows.append(("Largest difference forward less back", *(short(float(value)) for value in back.max(axis=0))))
    unit = typeset(LOAD_UNITS[places[0]])
    heads = [f"{component} / {unit if '·' not in unit else f'({unit})'}" for component in components]
    caption = f"{recording.name}: readings over the angle, U of the noise alone (dof {fit.dof:.0f})"
    return Table(caption, ("term", *heads), "l" + "r" * len(heads), tuple(rows))


def _named(evaluation: RotationEvaluation, names: Sequence[str]) -> list[Quantity]:
    """Quantities of some names, in the order of the names."""
    return [q for name in names for q in evaluation.quantities if q.name == name]


def _terms(recording: RotationRecording) -> Iterator[Quantity]:
    """Offset, amplitudes of the harmonics, drift and sense of every load component, with the noise's uncertainty."""
    fit = recording.fit
    for i in recording.told:
        row = recording.inverse[i]
        coefficient, noise = fit.coefficient @ row, float(row @ fit.noise @ row)
        u = np.sqrt(noise * np.diag(fit.inverse))
        tail = (fit.dof, LOAD_UNITS[i], recording.name)
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
            yield Quantity(label.replace(" ", "_"), label, LOAD_COMPONENTS[i], value, spread, *tail, {})


def _term_name(name: str) -> str:
    """Name of a term, of cosine and sine together."""
    kind, _, rest = name.partition(" ")
    return f"harmonic {rest}" if kind in ("cos", "sin") else name


def _term(q: Quantity) -> str:
    """A term with U; of an amplitude that may be zero its bound only."""
    if q.label.startswith("harmonic") and q.value < CLEAR * q.u:
        return f"< {short(q.expanded)}"
    return measured(q.value, q.expanded)


def _value(q: Quantity, *, small_unit: bool = False) -> str:
    """Value with U and unit; differences in g."""
    scale, unit = SCALED.get(q.unit, (1.0, q.unit)) if small_unit else (1.0, q.unit)
    return measured(scale * q.value, scale * q.expanded, unit)


def _scaled_value(q: Quantity) -> str:
    """Value with U in mm or mrad, the unit standing elsewhere."""
    scale, _ = SCALED[q.unit]
    return measured(scale * q.value, scale * q.expanded)


def _plain(q: Quantity) -> str:
    """Value with U and unit for the terminal; places, angles and differences in the smaller unit."""
    small_unit = q.unit != "kg" or "difference" in q.name or "deviation" in q.name
    scale, unit = SCALED.get(q.unit, (1.0, q.unit)) if small_unit else (1.0, q.unit)
    text = rounded(scale * q.value, scale * q.expanded, 0)
    if text.expanded == DASH:
        return f"{text.value} {typeset(unit)}"
    return f"({text.value} ± {text.expanded}) {typeset(unit)}"


def _tail(q: Quantity) -> tuple[str, str, str]:
    """Relative U, coverage factor, degrees of freedom."""
    return small(100.0 * q.expanded / abs(q.value)), factor(q.k), degrees_of_freedom(q.dof)


def _remark(evaluation: RotationEvaluation, q: Quantity) -> str:
    """What stands below a headline."""
    if q.unit == "%":
        normalised = evaluation.find(NORMALISED, q.component)
        return "" if normalised is None else f"{abs(normalised.value):.2f} times its U"
    return f"U = {small(100.0 * q.expanded / abs(q.value))} %"


def _signed(value: float) -> str:
    """A normalised deviation with two decimals."""
    return f"{value:.2f}".replace("-", "\N{MINUS SIGN}")


def _capital(text: str) -> str:
    """Text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def _budget(caption: str, found: Sequence[Quantity]) -> Table:
    """Contributions to some quantities, largest first for the last of them."""
    names = sorted(
        {name for q in found for name, u in q.budget.items() if name != UNTOLD or u > SMALLEST_UNTOLD * q.u},
        key=lambda name: -max(q.budget.get(name, 0.0) / q.u for q in found),
    )
    scale = SCALED[found[0].unit][0]
    rows = [(name, *(small(scale * q.budget[name]) if name in q.budget else DASH for q in found)) for name in names]
    rows.append(("combined, k = 1", *(small(scale * q.u) for q in found)))
    heads = [f"{_capital(q.label)} {q.component}" for q in found]
    return Table(caption, ("contribution", *heads), "l" + "r" * len(found), tuple(rows))


# rotation.html: one self-contained page with readings, masses, budgets and origin of a rotation test.


PAGE_FILE = "rotation.html"


def render_rotation_page(evaluation: RotationEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("rotate.html", _context(evaluation))


def _context(evaluation: RotationEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": headlines(evaluation),
        "masses": masses_table(evaluation),
        "differences": differences_table(evaluation),
        "centres": centres_table(evaluation),
        "deviations": _deviations(evaluation),
        "recordings": recordings_table(evaluation),
        "repeats": repeats_tables(evaluation),
        "readings": [picture for recording in evaluation.recordings for picture in _pictures(recording)],
        "harmonics": [table for recording in evaluation.recordings for table in harmonics_tables(recording)],
        "axis": axis_table(evaluation),
        "budgets": budget_tables(evaluation),
        "surroundings": surroundings_table(evaluation),
        **page_frame(evaluation),
    }


def _subject(evaluation: RotationEvaluation) -> list[tuple[str, str]]:
    """What was turned: sensor, rig, recordings."""
    rig = evaluation.recordings[0].manifest.rig
    facts = [("Rig", rig.name)]
    if rig.sensor is not None:
        facts.append(("Sensor", f"{rig.sensor.name} {rig.sensor.serial}".strip()))
    told = [f"{recording.name} ({recording.manifest.name})" for recording in evaluation.recordings]
    facts.append(("Recordings", ", ".join(told)))
    return facts


def _pictures(recording: RotationRecording) -> list[Picture]:
    """Forces and moments of a recording over the angle."""
    fit, found = recording.fit, []
    inverse = recording.inverse
    for kind, unit, wanted in (("forces", LOAD_UNITS[0], slice(0, 3)), ("moments", LOAD_UNITS[3], slice(3, 6))):
        places = [i for i in recording.told if i in range(6)[wanted]]
        if not places:
            continue

        def curve(angle_rad: FloatArray, places: list[int] = places) -> FloatArray:
            return fit.curve(angle_rad) @ inverse[places].T

        found.append(
            draw_readings(
                TurnedReadings(
                    recording=recording.name,
                    kind=kind,
                    unit=unit,
                    components=tuple(LOAD_COMPONENTS[i] for i in places),
                    angle_rad=fit.angle_rad,
                    sense=turning_sense(fit.angle_rad),
                    reading=recording.load[:, places],
                    residual=fit.residual @ inverse[places].T,
                    curve=curve,
                )
            )
        )
    return found


def _deviations(evaluation: RotationEvaluation) -> list[Picture]:
    """Load mass by each axis and by all against the weighed mass."""
    found = [q for q in evaluation.quantities if q.name == "load_mass_relative_deviation"]
    weighed = evaluation.find("weighed_mass", "stated")
    if not found or weighed is None:
        return []
    own = 100.0 * weighed.expanded / weighed.value
    names = tuple(q.component for q in found)
    return [draw_deviations(Deviations(names, [q.value for q in found], [q.expanded for q in found], own))]
