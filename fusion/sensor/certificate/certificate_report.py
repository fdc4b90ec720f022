"""The command `shakercal certificate`: XML, page, and a form to fill in."""

from __future__ import annotations

from pathlib import Path

from fusion.base import check_new_file
from fusion.report.atomic_files import write_atomically, write_files, write_together
from fusion.report.summary_pdf import write_requested_pdf
from fusion.sensor.certificate.certificate_content import Certificate
from fusion.sensor.certificate.certificate_evaluation import evaluate_certificate
from fusion.sensor.certificate.certificate_form import FORM_FILE, METHOD, NEW_FORM
from fusion.sensor.certificate.certificate_inputs import CERTIFIED_COMMANDS, find_command, find_results_folder
from fusion.sensor.certificate.certificate_page import certificate_page
from fusion.sensor.certificate.certificate_xml import PAGE_FILE, certificate_xml
from shakercal._common.digits import number_text

XML_FILE = "certificate.xml"


def run_certificate(
    path: Path,
    output: Path | None,
    results: Path | None = None,
    form_path: Path | None = None,
    *,
    force: bool = False,
    allow_outside: bool = False,
    specimen: bool = False,
) -> Certificate:
    """Write certificate.xml and certificate.html of a campaign or a recording, and print a summary."""
    folder = (path if path.is_dir() else path.parent) / "certificate" if output is None else output
    for name in (XML_FILE, PAGE_FILE):
        if (folder / name).exists() and not force:
            check_new_file(folder / name, force=False)
    found = evaluate_certificate(path, results, form_path, allow_outside=allow_outside, specimen=specimen)
    page = certificate_page(found).encode()
    files: dict[str, str | bytes] = {PAGE_FILE: page, XML_FILE: certificate_xml(found, page)}
    write_together(folder, lambda part: write_files(part, files), lambda: list(files))
    print(f"{found.title} of {found.sensor.name} {found.sensor.serial}, certificate {found.number}")
    for element in found.elements:
        first, last = element.values[0].frequency_hz, element.values[-1].frequency_hz
        count = len(element.values)
        where = f"{number_text(first, 6)} Hz"
        where = f"{count} frequencies, {where} to {number_text(last, 6)} Hz" if count > 1 else where
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
    write_requested_pdf(folder / PAGE_FILE)
    return found


def write_form(path: Path, results: Path | None = None) -> None:
    """Write a new certificate.toml to be filled in."""
    file = path / FORM_FILE if path.is_dir() else path
    check_new_file(file, force=False)
    command = find_command(find_results_folder(file.parent, results))
    text = NEW_FORM.replace("METHOD", METHOD if command is None else CERTIFIED_COMMANDS[command].method)
    write_atomically(file, text)
    print(f"{file}: fill in the empty entries, then run shakercal certificate again")
