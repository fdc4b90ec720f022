"""The numbers of a rotation test as rows and tables: rotation.csv, the page's tables, and what the command prints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fusion.polar import DASH, rounded, typeset
from fusion.report_numbers import degrees_of_freedom, factor, measured, number, short, small
from fusion.report_tables import Headline, Table
from fusion.results_csv import Row
from fusion.rotate.result import JOINT, Quantity, RotationEvaluation, RotationRecording

COLUMNS = ["name", "component", "value", "u", "U", "k", "unit", "dof", "recording"]
MILLIMETRE, MILLIRADIAN, GRAM = 1e3, 1e3, 1e3
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
        over = number(normalised.value) if normalised is not None else DASH
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
            cells = [_scaled_value(found[axis]) if axis in found else DASH for axis in ("x", "y", "z")]
            rows.append((f"{label} / mm", *cells))
    head = ("place", "x", "y", "z")
    return Table("Centres of mass, sensor axes, with U", head, "lrrr", tuple(rows)) if rows else None


def recordings_table(evaluation: RotationEvaluation) -> Table:
    """Each recording: what was read, what it weighs, how the head stood."""
    rows = []
    for recording in evaluation.recordings:
        fit = recording.fit
        weights = [evaluation.find("weight", name, recording.name) for name in (JOINT, "Fx", "Fy", "Fz")]
        zero = evaluation.find("zero_angle", "", recording.name)
        rows.append(
            (
                recording.name,
                "load mounted" if recording.with_load else "without load",
                f"{len(fit.angle_rad)}",
                *(DASH if q is None else measured(q.value, q.expanded) for q in weights),
                DASH if zero is None else _scaled_value(zero),
                ", ".join(fit.terms[3:]) or "none",
            )
        )
    head = (
        "recording",
        "state",
        "readings",
        "weight / N",
        "Fx / N",
        "Fy / N",
        "Fz / N",
        "zero angle / mrad",
        "more terms",
    )
    return Table("Recordings: weight in air with U, terms that the readings show", head, "llrrrrrrl", tuple(rows))


def harmonics_table(recording: RotationRecording) -> Table:
    """Offset, harmonics and further terms of every channel of a recording, and what turning back changes."""
    fit = recording.fit
    reversal = fit.reversal()
    rows = []
    for c, channel in enumerate(fit.channels):
        own = [q for q in _terms(recording) if q.component == channel]
        back = np.abs(reversal.difference[:, c])
        rows.append(
            (
                channel,
                typeset(recording.unit[c]) or "1",
                *(_term(q) for q in own),
                short(float(np.sqrt(fit.noise[c, c]))),
                short(float(back.max())) if len(back) else DASH,
            )
        )
    names = [_heading(q.name) for q in _terms(recording) if q.component == fit.channels[0]]
    head = ("channel", "unit", *names, "scatter s", "largest difference forward–back")
    caption = f"{recording.name}: readings over the angle, U of the noise alone (dof {fit.dof:.0f})"
    return Table(caption, head, "ll" + "r" * (len(head) - 2), tuple(rows))


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
        state = "with load" if recording.with_load else "without load"
        more = f", also {', '.join(fit.terms[3:])}" if fit.terms[3:] else ""
        weights = [q for q in evaluation.quantities if q.name == "weight" and q.recording == recording.name]
        told = ", ".join(f"{q.component} {_plain(q)}" for q in weights)
        read = f"{len(fit.angle_rad)} readings, offset and first harmonic{more}"
        yield f"{recording.name} ({state}): {read}; weight {told}"
    for name in (*MASSES, *DIFFERENCES, *CENTRES):
        found = _named(evaluation, (name,))
        if found:
            told = ", ".join(f"{q.component} {_plain(q)}" for q in found)
            yield f"{found[0].label}: {told}"
    normalised = _named(evaluation, (NORMALISED,))
    if normalised:
        told = ", ".join(f"{q.component} {rounded(q.value, 0.1).value}" for q in normalised)
        yield f"normalised deviation of the load mass: {told} (agreement: within ±1)"


def _named(evaluation: RotationEvaluation, names: Sequence[str]) -> list[Quantity]:
    """Quantities of some names, in the order of the names."""
    return [q for name in names for q in evaluation.quantities if q.name == name]


def _terms(recording: RotationRecording) -> Iterator[Quantity]:
    """Offset, amplitudes of the harmonics, drift and sense of every channel, with the noise's uncertainty."""
    fit = recording.fit
    u = fit.u_coefficient()
    for c, channel in enumerate(fit.channels):
        unit = recording.unit[c] or recording.manifest.rig.sensor.unit if recording.manifest.rig.sensor else ""
        tail = (fit.dof, unit, recording.name)
        for place, name in enumerate(fit.terms):
            if name.startswith("cos "):
                order = int(name[4:])
                size = abs(complex(fit.amplitude(order)[c]))
                spread = float(np.hypot(u[place, c], u[place + 1, c]) / np.sqrt(2.0))
                yield Quantity(f"harmonic_{order}", f"harmonic {order}", channel, size, spread, *tail, {})
            elif not name.startswith("sin "):
                label = name.replace(" ", "_")
                yield Quantity(label, name, channel, float(fit.coefficient[place, c]), float(u[place, c]), *tail, {})


def _heading(name: str) -> str:
    """Column head of a term."""
    return name.replace("harmonic_", "harmonic ").replace("_", " ")


def _term(q: Quantity) -> str:
    """A term with U; of an amplitude that may be zero its bound only."""
    if q.name.startswith("harmonic") and q.value < CLEAR * q.u:
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
    return f"({text.value} ± {text.expanded}) {typeset(unit)}"


def _tail(q: Quantity) -> tuple[str, str, str]:
    """Relative U, coverage factor, degrees of freedom."""
    return small(100.0 * q.expanded / abs(q.value)), factor(q.k), degrees_of_freedom(q.dof)


def _remark(evaluation: RotationEvaluation, q: Quantity) -> str:
    """What stands below a headline."""
    if q.unit == "%":
        normalised = evaluation.find(NORMALISED, q.component)
        return "" if normalised is None else f"{abs(normalised.value):.2f} of its U"
    return f"U = {small(100.0 * q.expanded / abs(q.value))} %"


def _capital(text: str) -> str:
    """Text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def _budget(caption: str, found: Sequence[Quantity]) -> Table:
    """Contributions to some quantities, largest first for the last of them."""
    names = sorted(
        {name for q in found for name in q.budget},
        key=lambda name: -max(q.budget.get(name, 0.0) / q.u for q in found),
    )
    scale = SCALED[found[0].unit][0]
    rows = [(name, *(small(scale * q.budget[name]) if name in q.budget else DASH for q in found)) for name in names]
    rows.append(("combined, k = 1", *(small(scale * q.u) for q in found)))
    heads = [f"{_capital(q.label)} {q.component}" for q in found]
    return Table(caption, ("contribution", *heads), "l" + "r" * len(found), tuple(rows))
