"""The certificate as a page on A4."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from markupsafe import Markup

from fusion.base import PROGRAM
from fusion.campaign.campaign_figures import draw_curve
from fusion.report.figure import COLOURS, Figure, empty_figure
from fusion.report.folder import render_page
from fusion.report.table import (
    Table,
    TableColumn,
    capitalise,
    common_exponent,
    degrees_of_freedom,
    factor_text,
    half_axes,
    magnitude_phase_text,
    page_column,
    table,
)
from fusion.sensitivity.load_phasors import BudgetEntry
from fusion.sensor.certificate.certificate_content import (
    SPECIMEN,
    Certificate,
    CertifiedBudget,
    CertifiedElement,
    CertifiedLoad,
    CertifiedMass,
    CertifiedValue,
    UnderlyingCertificate,
    input_words,
)
from fusion.sensor.certificate.certificate_form import CertifiedEquipment, Party
from fusion.sensor.certificate.certificate_inputs import CertifiedNumber, NumberList
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, sensitivity_unit
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import (
    DASH,
    number_text,
    quantity_text,
    round_to_uncertainty,
    scaled_text,
    small,
    times_ten,
    typeset,
)
from shakercal._common.notices import Notice

MARKERS = ("circle", "square", "diamond", "triangle", "inverted_triangle", "cross")
SMALLEST_SHARE = 0.05
"""Share of the variance from which a contribution has a separate row."""
SMALLEST_SLOPE = 1e-6
"""Share of the variance below which a sensitivity coefficient is a rounding error."""
SIDE_PX, REACH_PX = 150, 52
"""Side of the sketch of the axes, and length of an axis in it."""
TIP = Markup(
    '<marker id="tip" viewBox="0 0 6 6" refX="5" refY="3" markerWidth="6" markerHeight="6" orient="auto">'
    '<path d="M0 0 L6 3 L0 6 z"/></marker>'
)
REGION = (
    "A value so small that its phase is not determined is stated as real and imaginary part with its 95 % region: an "
    "ellipse around the value in the complex plane, with these half-axes."
)


def certificate_page(found: Certificate) -> str:
    """Return the certificate as HTML with its style and without external resources."""
    form = found.form
    context = {
        "name": f"Calibration certificate {found.number}",
        "found": found,
        "form": form,
        "watermark": SPECIMEN if found.specimen else "",
        "laboratory": _address(form.laboratory),
        "customer": _address(form.customer),
        "period": f"{found.begin}" if found.begin == found.end else f"{found.begin} to {found.end}",
        "conditions": capitalise("; ".join(_condition(*row) for row in found.conditions)),
        "equipment": _equipment_table(found),
        "loads": _loads_table(found.loads),
        "axes": _axes(found),
        "results": [*_driven(found), *_matrices(found), *_other_outputs(found), *map(_numbers_table, found.numbers)],
        "figures": list(_figures(found)),
        "budgets": [_budget_table(e, e.budget) for e in found.elements if e.budget is not None],
        "region": REGION if any(not v.has_phase for e in found.elements for v in e.values) else "",
        "acknowledged": _acknowledged_table(found),
        "statements": [(name, text) for name, text in found.statements() if name != "Acknowledged"],
        "software": f"{PROGRAM} {found.versions.get(PROGRAM, '')}".strip(),
    }
    return render_page("certificate.html", context)


# Item, equipment and conditions.


def _address(party: Party) -> list[str]:
    """Return the lines of name and address."""
    city = " ".join(filter(None, (party.post_code, party.city)))
    return [line for line in (party.name, party.street, f"{city}, {party.country}", party.email) if line]


def _condition(name: str, unit: str, low: float, high: float) -> str:
    """Return a condition as text."""
    text = {r"\degreecelsius": "°C", r"\percent": "%", r"\hecto\pascal": "hPa"}[unit]
    name = name[:1].lower() + name[1:]
    ends = dict.fromkeys(f"{number_text(end, 6)} {text}" for end in (low, high))
    return f"{name} {' to '.join(ends)}"


def _equipment_table(found: Certificate) -> Table | None:
    """Return references and instruments with their certificates, then those that only inputs name."""
    named = {one.certificate for one in found.form.equipment}
    rows: list[CertifiedEquipment | UnderlyingCertificate] = [*found.form.equipment]
    rows += [source for source in found.sources if source.certificate not in named]
    columns: list[TableColumn[CertifiedEquipment | UnderlyingCertificate]] = [
        page_column("use", lambda one: one.use if isinstance(one, CertifiedEquipment) else "input", "l"),
        page_column("equipment", _equipment, "l"),
        page_column("certificate", lambda one: one.certificate or DASH, "l"),
        page_column("laboratory", lambda one: one.laboratory or DASH, "l"),
        page_column("date", _dates, "l"),
    ]
    return table("References and measuring equipment", columns, rows)


def _equipment(one: CertifiedEquipment | UnderlyingCertificate) -> str:
    if isinstance(one, CertifiedEquipment):
        return ", ".join(filter(None, (one.name, one.identification)))
    return "; ".join(input_words(one.inputs))


def _dates(one: CertifiedEquipment | UnderlyingCertificate) -> str:
    if isinstance(one, UnderlyingCertificate):
        return one.day or DASH
    until = "" if one.valid_until is None else f"valid until {one.valid_until}"
    return ", ".join(filter(None, (str(one.date or ""), until))) or DASH


def _loads_table(loads: Sequence[CertifiedLoad]) -> Table | None:
    """Return the masses above the sensor."""
    columns: list[TableColumn[tuple[CertifiedMass, CertifiedLoad]]] = [
        page_column("mass", lambda row: row[0].name, "l"),
        page_column("value ± U (k = 2) / kg", lambda row: scaled_text(row[0].mass_kg, row[0].expanded_kg, 0)),
        page_column("certificate", lambda row: row[0].certificate or DASH, "l"),
        page_column("recordings", lambda row: _recordings(row[1].recordings), "l"),
    ]
    rows = [(mass, load) for load in loads for mass in load.masses]
    return table("Masses above the elastic element of the item", columns, rows)


def _recordings(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 2 else f"{len(names)}, {names[0]} to {names[-1]}"


def _axes(found: Certificate) -> Markup:
    """Return a sketch of the sensor's axes, its load and gravity as SVG."""
    directions = np.array([[-0.80, 0.42], [0.80, 0.42], [0.0, -1.0]])  # x towards the reader, z up
    origin = np.array([SIDE_PX / 2.0, 0.52 * SIDE_PX])

    def at(vector: Sequence[float], length: float) -> tuple[float, ...]:
        return tuple((origin + length * (np.asarray(vector, dtype=np.float64) @ directions)).round(1).tolist())

    def arrow(vector: Sequence[float], name: str, style: str) -> Markup:
        line = Markup('<line class="{}" x1="{}" y1="{}" x2="{}" y2="{}" marker-end="url(#tip)"/>')
        text = Markup('<text x="{}" y="{}" dy="4">{}</text>').format(*at(vector, REACH_PX + 11.0), name)
        return line.format(style, *origin, *at(vector, REACH_PX)) + text

    parts = [arrow(unit, name, "axis") for unit, name in zip(np.eye(3).tolist(), "xyz", strict=True)]
    parts += [arrow(vector, "g", "gravity") for vector in found.down]
    x, y = origin.tolist()
    disc = Markup(
        '<path class="body" d="M{0} {1} v14 a24 11 0 0 0 48 0 v-14"/><ellipse cx="{2}" cy="{1}" rx="24" ry="11"/>'
    )
    distance = float(np.linalg.norm(found.centre_m)) if found.centre_m else 0.0
    if distance:
        towards = [coordinate / distance for coordinate in found.centre_m]
        parts.append(Markup('<circle cx="{}" cy="{}" r="5"/>').format(*at(towards, 0.5 * REACH_PX)))
    return Markup(
        '<svg class="axes" viewBox="0 0 {0} {0}" role="img" aria-label="Axes of the item">{1}{2}{3}</svg>'
    ).format(SIDE_PX, TIP, disc.format(x - 24.0, y, x), Markup("").join(parts))


# Values: one matrix per frequency, driven elements, other outputs, single numbers.


def _matrices(found: Certificate) -> Iterator[Table | None]:
    """Yield one table per frequency: outputs in rows, loads in columns."""
    if not found.is_matrix:
        return
    exponents = {letter: _exponent([e for e in found.elements if e.component[0] == letter]) for letter in "FM"}
    elements = {(element.channel, element.component): element for element in found.elements}
    outputs = [channel for channel in found.sensor.channels if any(channel == name for name, _ in elements)]
    loads = [load for load in LOAD_COMPONENTS if any(load == name for _, name in elements)]
    for frequency in sorted({value.frequency_hz for e in found.elements for value in e.values}):

        def cell(output: str, load: str, frequency: float = frequency) -> str:
            values = elements[output, load].values if (output, load) in elements else ()
            value = next((one for one in values if one.frequency_hz == frequency), None)
            return DASH if value is None else _cell(value, exponents[load[0]])

        columns = [page_column("", lambda output: output, "l"), *(_load_column(load, cell) for load in loads)]
        units = " and ".join(
            times_ten(exponents[letter], sensitivity_unit(found.sensor.unit, f"{letter}x"))
            for letter in dict.fromkeys(load[0] for load in loads)
        )
        caption = Markup("Sensitivity matrix at {} Hz: magnitude ± U in {}; phase ± U in rad; k").format(
            f"{frequency:.4f}", Markup(units)
        )
        yield table(caption, columns, outputs)


def _load_column(load: str, cell: Callable[[str, str], str]) -> TableColumn[str]:
    """Return the column of a load."""
    return page_column(f"per {load}", lambda output: cell(output, load))


def _exponent(elements: Sequence[CertifiedElement]) -> int:
    """Return the power of ten of the largest value of some elements."""
    every = [value.element for element in elements for value in element.values]
    return common_exponent(np.array([complex(one.re, one.im) for one in every]))


def _cell(value: CertifiedValue, exponent: int) -> Markup:
    """Return the lines of a value: magnitude, phase, k, or complex value, region, k."""
    factor = Markup('<span class="below">{}</span>').format(_factors(value))
    return Markup("<br>").join([*_magnitude_and_phase(value, exponent), factor])


def _magnitude_and_phase(value: CertifiedValue, exponent: int) -> tuple[str, str]:
    """Return magnitude and phase with U; without a phase complex value and region."""
    polar = value.element
    if value.has_phase:
        size = scaled_text(polar.magnitude, value.expanded_magnitude, exponent)
        return size, scaled_text(polar.phase_rad, value.expanded_phase_rad, 0)
    re = round_to_uncertainty(polar.re, polar.region_re, exponent).value
    im = round_to_uncertainty(polar.im, polar.region_im, exponent).value
    sign, part = ("\N{MINUS SIGN}", im[1:]) if im.startswith("\N{MINUS SIGN}") else ("+", im)
    return f"{re} {sign} {part} j", half_axes(polar.region, exponent)


def _factors(value: CertifiedValue) -> str:
    """Return the coverage factors of a value."""
    if not value.has_phase:
        return factor_text(value.element.region_factor)
    return magnitude_phase_text(factor_text(value.k), factor_text(value.k_phase))


Row = tuple[CertifiedElement, int]
"""An element, and the index of one of its values."""


def _driven(found: Certificate) -> Iterator[Table | None]:
    """Yield the main elements with load, deviation from static and conformity."""
    mains = [element for element in found.elements if element.main]
    if found.is_matrix:
        yield _driven_of_matrix(mains)
        return
    for element in mains:
        columns: list[TableColumn[Row]] = [
            page_column("frequency / Hz", lambda row: f"{_value(row).frequency_hz:.4f}"),
            page_column("amplitude of the load", _amplitude),
            *_value_columns(element),
        ]
        columns += [page_column("from static / %", _deviation)] if element.deviation else []
        columns += [page_column("conforms", _verdict, "l")] if element.verdicts else []
        yield table(element.name, columns, [(element, index) for index in range(len(element.values))])


def _driven_of_matrix(mains: Sequence[CertifiedElement]) -> Table | None:
    """Return the main elements in rows and frequencies in columns: load, deviation from static, conformity."""

    def column(frequency: float) -> TableColumn[CertifiedElement]:
        def cell(element: CertifiedElement) -> str:
            index = next((k for k, one in enumerate(element.values) if one.frequency_hz == frequency), None)
            return DASH if index is None else _checks((element, index))

        return page_column(f"{frequency:.4f} Hz", cell)

    frequencies = sorted({value.frequency_hz for element in mains for value in element.values})
    name: TableColumn[CertifiedElement] = page_column("", lambda one: f"{one.channel} per {one.component}", "l")
    caption = "Driven elements: amplitude of the load"
    caption += "; deviation from the static sensitivity ± U" if any(element.deviation for element in mains) else ""
    caption += "; whether it conforms" if any(element.verdicts for element in mains) else ""
    return table(caption, [name, *map(column, frequencies)], mains)


def _checks(row: Row) -> str:
    """Return load, deviation from static and conformity of a value in one line."""
    parts = [_amplitude(row)]
    parts += [f"({_deviation(row)}) %"] if row[0].deviation else []
    parts += [_verdict(row)] if row[0].verdicts else []
    return "; ".join(parts)


def _value(row: Row) -> CertifiedValue:
    return row[0].values[row[1]]


def _amplitude(row: Row) -> str:
    """Return the amplitude of the load with its unit, smallest and largest if they differ."""
    low, high = map(number_text, _value(row).amplitude)
    unit = typeset(LOAD_UNITS[LOAD_COMPONENTS.index(row[0].component)])
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def _deviation(row: Row) -> str:
    size, expanded, _ = row[0].deviation[row[1]]
    return scaled_text(100.0 * size, 100.0 * expanded, 0)


def _verdict(row: Row) -> str:
    return "yes" if row[0].verdicts[row[1]] == "pass" else "no"


def _value_columns(element: CertifiedElement) -> list[TableColumn[Row]]:
    """Return the columns of magnitude, phase and k of one element."""
    unit, exponent = sensitivity_unit(element.unit, element.component), _exponent([element])
    head = Markup("magnitude ± U / {}").format(Markup(times_ten(exponent, unit)))
    return [
        page_column(head, lambda row: _magnitude_and_phase(_value(row), exponent)[0]),
        page_column("phase ± U / rad", lambda row: _magnitude_and_phase(_value(row), exponent)[1]),
        page_column("k", lambda row: _factors(_value(row))),
    ]


def _other_outputs(found: Certificate) -> Iterator[Table | None]:
    """Yield the other outputs under each load: frequencies in rows, outputs in columns."""
    if found.is_matrix:
        return
    for component in dict.fromkeys(element.component for element in found.elements):
        others = [e for e in found.elements if e.component == component and not e.main]
        if not others:
            continue
        exponent = _exponent(others)
        frequencies = sorted({value.frequency_hz for element in others for value in element.values})
        columns = [
            page_column("frequency / Hz", lambda frequency: f"{frequency:.4f}"),
            *(_output_column(element, exponent) for element in others),
        ]
        unit = Markup(times_ten(exponent, sensitivity_unit(found.sensor.unit, component)))
        caption = Markup("Other outputs per {}: magnitude ± U in {}; phase ± U in rad; k").format(component, unit)
        yield table(caption, columns, frequencies)


def _output_column(element: CertifiedElement, exponent: int) -> TableColumn[float]:
    """Return the column of one output over frequency."""
    values = {value.frequency_hz: _cell(value, exponent) for value in element.values}
    return page_column(element.channel, lambda frequency: values.get(frequency, DASH))


def _numbers_table(number_list: NumberList) -> Table | None:
    """Return one list of single numbers."""
    columns: list[TableColumn[CertifiedNumber]] = [
        page_column("quantity", lambda figure: figure.name, "l"),
        page_column("value ± U", lambda f: quantity_text(f.value, f.expanded, "" if f.unit == "1" else f.unit)),
        page_column("k", lambda figure: factor_text(figure.k)),
    ]
    return table(number_list.name, columns, number_list.numbers)


# Figures and budgets.


def _figures(found: Certificate) -> Iterator[Figure]:
    """Yield a figure of magnitude and phase of the main elements over frequency."""
    mains = [element for element in found.elements if element.main and len(element.values) > 1]
    if len(mains) == 1:
        caption = "Magnitude and phase over frequency; bars: U."
        yield draw_curve(mains[0].points, ()).with_title(mains[0].name, caption, main=True)
    elif mains:
        yield _joint_figure(mains)


def _joint_figure(mains: Sequence[CertifiedElement]) -> Figure:
    """Draw the magnitudes of several elements relative to a reference, and their phases."""
    static = all(element.deviation for element in mains)
    drawn = empty_figure("driven-elements", 3.0, [1.0, 1.0])
    upper, lower = drawn.panels
    for number, element in enumerate(mains):
        frequency = np.array([value.frequency_hz for value in element.values])
        size, expanded = np.array([(v.element.magnitude, v.expanded_magnitude) for v in element.values]).T
        ratio, half = size / size[0] - 1.0, expanded / size[0]
        if static:
            ratio, half, _ = np.array(element.deviation).T
        turn, u_turn = np.array([(v.element.phase_rad, v.expanded_phase_rad) for v in element.values]).T
        look = {
            "colour": COLOURS[number % len(COLOURS)],
            "marker": MARKERS[number % len(MARKERS)],
        }
        label = f"{element.channel} per {element.component}"
        shift = 1.0 + 0.004 * (number - (len(mains) - 1) / 2.0)
        upper.points(shift * frequency, 100.0 * ratio, label, half_y=100.0 * half, **look)
        lower.points(shift * frequency, turn, label, half_y=u_turn, **look)
    reference = "the static sensitivity" if static else "the value at the lowest frequency"
    upper.y.label, lower.y.label = f"from {'static' if static else 'first'} / %", "phase / rad"
    lower.x.label = "frequency / Hz"
    caption = f"Deviation of the magnitudes from {reference}, and phases; bars: U. Markers are shifted in frequency."
    return drawn.with_title("Driven elements over frequency", caption, main=True)


def _budget_table(element: CertifiedElement, found: CertifiedBudget) -> Table | None:
    """Return the budget of one value in the form of EA-4/02.

    The estimate of every input is its deviation from the stated value, 0. The last row is the value itself.
    """
    share = _shares(found.entries)
    order = sorted(range(len(share)), key=lambda index: -share[index].max())
    shown = [index for index in order if share[index].max() >= SMALLEST_SHARE]
    rows = [_budget_row(found.entries[index], share[index]) for index in shown]
    if len(shown) < len(order):
        rest = [found.entries[index] for index in order[len(shown) :]]
        u = [np.sqrt(sum(float(part.u_relative[0, 0]) ** 2 for part in rest))]
        u.append(np.sqrt(sum(float(part.u_phase_rad[0, 0]) ** 2 for part in rest)))
        rows.append((f"{len(rest)} smaller ones together", "", "", "", small(100.0 * u[0]), "", small(1e3 * u[1])))
    polar = found.value
    whole = 100.0 * polar.u_magnitude / polar.magnitude, 1e3 * polar.u_phase_rad
    bold = [Markup("<b>{}</b>").format(small(u)) for u in whole]
    rows.append((f"{element.channel} per {element.component}", "", "", "", bold[0], "", bold[1]))
    head = (
        *("quantity, estimate 0", "evaluation, ν", "u of the quantity", "c, magnitude"),
        *("u(magnitude) / %", "c, phase / rad", "u(phase) / mrad"),
    )
    caption = f"Budget: {element.name} at {found.frequency_hz:.4f} Hz, where the relative U is largest"
    return Table(caption, head, "llrrrrr", tuple(rows))


def _shares(entries: Sequence[BudgetEntry]) -> list[FloatArray]:
    """Return the shares (2,) of every entry in the variances of magnitude and phase."""
    u = np.array([[entry.u_relative[0, 0], entry.u_phase_rad[0, 0]] for entry in entries]) ** 2
    return list(np.divide(u, u.sum(axis=0), out=np.zeros_like(u), where=u.sum(axis=0) > 0.0))


def _budget_row(entry: BudgetEntry, share: FloatArray) -> tuple[str, ...]:
    """Return a contribution with its input and sensitivity coefficients."""
    u, slopes = DASH, [DASH, DASH]
    if np.isfinite(entry.u):
        u = Markup("{} {}").format(number_text(entry.u, 2), "" if entry.unit == "1" else typeset(entry.unit)).strip()
        slopes = [
            number_text(float(part[0, 0]), 2) if of_variance >= SMALLEST_SLOPE else "≈ 0"
            for part, of_variance in zip(entry.coefficient, share, strict=True)
        ]
    label = f"{entry.label} ({entry.count} times)" if entry.count > 1 else entry.label
    return (
        label,
        f"{entry.type}, {degrees_of_freedom(float(entry.dof[0]))}",
        u,
        slopes[0],
        small(100.0 * float(entry.u_relative[0, 0])),
        slopes[1],
        small(1e3 * float(entry.u_phase_rad[0, 0])),
    )


def _acknowledged_table(found: Certificate) -> Table | None:
    """Return the acknowledged notices with their reasons."""
    columns: list[TableColumn[tuple[Notice, int]]] = [
        page_column("code", lambda row: Markup('<span class="code">{}</span>').format(row[0].code), "l"),
        page_column("number", lambda row: str(row[1])),
        page_column("notice, the first of its kind", lambda row: row[0].text, "l"),
        page_column("reason (by, date)", lambda row: row[0].acknowledged, "l"),
    ]
    return table("Acknowledged notices of the evaluation", columns, found.acknowledged)
