"""The page of a certificate, and the command that writes page and XML."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, check_new_file
from fusion.report.atomic_files import write_atomically, write_files, write_together
from fusion.report.folder import render_page
from fusion.report.table import (
    WEAK,
    Table,
    TableColumn,
    common_exponent,
    factor_text,
    half_axes,
    magnitude_phase_text,
    page_column,
    quantity_html,
    scaled_html,
    signed_text,
    small,
    table,
    times_ten,
)
from fusion.sensor.certificate.certificate_evaluation import (
    Certificate,
    CertifiedElement,
    CertifiedValue,
    evaluate_certificate,
)
from fusion.sensor.certificate.certificate_form import FORM_FILE, NEW_FORM, Party
from fusion.sensor.certificate.certificate_xml import certificate_xml
from fusion.sensor.certificate.certified_numbers import (
    CERTIFIED_COMMANDS,
    CertifiedNumber,
    NumberList,
    find_command,
    find_results_folder,
)
from shaker.labels import sensitivity_unit

XML_FILE, PAGE_FILE = "certificate.xml", "certificate.html"


def run_certificate(
    path: Path,
    output: Path | None,
    results: Path | None = None,
    form_path: Path | None = None,
    *,
    force: bool = False,
    allow_outside: bool = False,
) -> Certificate:
    """Write certificate.xml and certificate.html of a campaign or a recording, and print a summary."""
    folder = (path if path.is_dir() else path.parent) / "certificate" if output is None else output
    for name in (XML_FILE, PAGE_FILE):
        if (folder / name).exists() and not force:
            check_new_file(folder / name, force=False)
    found = evaluate_certificate(path, results, form_path, allow_outside=allow_outside)
    files: dict[str, str | bytes] = {PAGE_FILE: certificate_page(found), XML_FILE: certificate_xml(found)}
    write_together(folder, lambda part: write_files(part, files), lambda: list(files))
    print(f"{found.title} of {found.sensor.name} {found.sensor.serial}, certificate {found.form.administration.number}")
    for element in found.elements:
        first, last = element.values[0].frequency_hz, element.values[-1].frequency_hz
        count = len(element.values)
        where = f"{count} frequencies, {first:.6g} to {last:.6g} Hz" if count > 1 else f"{first:.6g} Hz"
        failed = element.verdicts.count("fail")
        judged = "" if not element.verdicts else ", conforms" if not failed else f", does not conform at {failed}"
        if element.main:
            print(f"{element.name}: {where}{judged}")
    for number_list in found.numbers:
        print(f"{number_list.name}: {len(number_list.numbers)} numbers")
    further = sum(not element.main for element in found.elements)
    if further:
        print(f"and {further} further elements")
    print(f"certificate: {folder / XML_FILE}, for people {folder / PAGE_FILE} (any browser prints it on A4)")
    return found


def write_form(path: Path, results: Path | None = None) -> None:
    """Write a new certificate.toml to be filled in."""
    file = path / FORM_FILE if path.is_dir() else path
    check_new_file(file, force=False)
    command = find_command(find_results_folder(file.parent, results))
    text = (
        NEW_FORM
        if command is None
        else re.sub(r'(?m)^method = ".*"$', f'method = "{CERTIFIED_COMMANDS[command].method}"', NEW_FORM)
    )
    write_atomically(file, text)
    print(f"{file}: fill in the empty entries, then run shakercal certificate again")


def certificate_page(found: Certificate) -> str:
    """Return the certificate as HTML with its style and without external resources."""
    form = found.form
    context = {
        "name": f"Calibration certificate {form.administration.number}",
        "found": found,
        "form": form,
        "laboratory": _address(form.laboratory),
        "customer": _address(form.customer),
        "period": f"{found.begin}" if found.begin == found.end else f"{found.begin} to {found.end}",
        "conditions": [_condition(*row) for row in found.conditions],
        "sources": _sources_table(found),
        "results": [*map(_element_table, found.elements), *map(_numbers_table, found.numbers)],
        "statements": list(found.statements()),
        "software": ", ".join(f"{name} {version}" for name, version in found.versions.items()),
    }
    return render_page("certificate.html", context)


def _address(party: Party) -> list[str]:
    """Return the lines of name and address."""
    city = " ".join(filter(None, (party.post_code, party.city)))
    return [line for line in (party.name, party.street, f"{city}, {party.country}", party.email) if line]


def _condition(name: str, unit: str, low: float, high: float) -> str:
    """Return a condition as text."""
    text = {r"\degreecelsius": "°C", r"\percent": "%", r"\hecto\pascal": "hPa"}[unit]
    return f"{name}: {low:g} {text}" if low == high else f"{name}: {low:g} {text} to {high:g} {text}"


def _sources_table(found: Certificate) -> Table | None:
    """Return the certificates of the inputs."""
    head = ("stated for", "certificate", "laboratory", "date")
    rows = tuple(
        ("; ".join(s.inputs), s.certificate or DASH, s.laboratory or DASH, s.day or DASH) for s in found.sources
    )
    return Table("Underlying certificates", head, "llll", rows) if rows else None


def _numbers_table(number_list: NumberList) -> Table | None:
    """Return one list of single numbers."""
    columns: list[TableColumn[CertifiedNumber]] = [
        page_column("quantity", lambda figure: figure.name, "l"),
        page_column(
            "value ± U",
            lambda figure: quantity_html(figure.value, figure.expanded, "" if figure.unit == "1" else figure.unit),
        ),
        page_column("k", lambda figure: factor_text(figure.k)),
    ]
    return table(number_list.name, columns, number_list.numbers)


def _element_table(element: CertifiedElement) -> Table | None:
    """Return one element over frequency, magnitudes with a common power of ten."""
    unit = sensitivity_unit(element.unit, element.component)
    exponent = common_exponent(np.array([complex(value.element.re, value.element.im) for value in element.values]))

    def magnitude(value: CertifiedValue) -> Markup:
        polar = value.element
        if polar.region.holds_zero:
            return half_axes(polar.region, exponent)
        return scaled_html(polar.magnitude, value.expanded_magnitude, exponent)

    def phase(value: CertifiedValue) -> Markup:
        if value.has_phase:
            return quantity_html(value.element.phase_rad, value.expanded_phase_rad)
        return Markup(WEAK if value.element.region.holds_zero else DASH)

    def factors(value: CertifiedValue) -> str:
        if value.element.region.holds_zero:
            return factor_text(value.element.region_factor)
        return magnitude_phase_text(factor_text(value.k), factor_text(value.k_phase))

    columns: list[TableColumn[CertifiedValue]] = [
        page_column("frequency / Hz", lambda value: f"{value.frequency_hz:.4f}"),
        page_column(Markup("magnitude ± U / {}").format(times_ten(exponent, unit)), magnitude),
        page_column("phase ± U / rad", phase),
        page_column("k", factors),
    ]
    if element.verdicts:
        indices = {id(value): index for index, value in enumerate(element.values)}

        def deviation(value: CertifiedValue) -> str:
            size, expanded = element.deviation[indices[id(value)]]
            return f"{signed_text(100.0 * size, '.3g')} ± {small(100.0 * expanded)}"

        columns += [
            page_column("from static / %", deviation),
            page_column(
                "conforms", lambda value: "yes" if element.verdicts[indices[id(value)]] == "pass" else "no", "l"
            ),
        ]
    return table(element.name, columns, element.values)
