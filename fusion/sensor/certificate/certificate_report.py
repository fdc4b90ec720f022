"""The certificate as XML (DCC schema 3.3.0, D-SI 2.2.1) and as page, and the command."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from lxml import etree
from lxml.builder import ElementMaker
from markupsafe import Markup

from fusion.base import DASH, PROGRAM, __version__, check_new_file
from fusion.errors import InputError
from fusion.estimation.coverage import COVERAGE
from fusion.recording.dsi import Powers, dsi_unit
from fusion.report.atomic_files import write_atomically, write_files, write_together
from fusion.report.folder import render_page
from fusion.report.summary_pdf import write_requested_pdf
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
    UnderlyingCertificate,
    evaluate_certificate,
)
from fusion.sensor.certificate.certificate_inputs import (
    CERTIFIED_COMMANDS,
    FORM_FILE,
    NEW_FORM,
    CertifiedNumber,
    NumberList,
    Party,
    find_command,
    find_results_folder,
    quantity_types,
)
from fusion.sensor.result_notices import UNIT_WITHOUT_DSI
from shaker.labels import sensitivity_unit

# Digital Calibration Certificate.

DCC, SI, XSI = "https://ptb.de/dcc", "https://ptb.de/si", "http://www.w3.org/2001/XMLSchema-instance"
SCHEMA = "3.3.0"
D = ElementMaker(namespace=DCC, nsmap={"dcc": DCC, "si": SI, "xsi": XSI})
S = ElementMaker(namespace=SI, nsmap={"si": SI})
LANGUAGE = "en"
MAGNITUDE, PHASE, COMPLEX = "force_sensitivityMagnitude", "force_sensitivityPhase", "force_sensitivityComplex"
REF_TYPES = {
    MAGNITUDE: "Magnitude of the complex sensitivity, output per force or moment",
    PHASE: "Phase of the complex sensitivity, of x(t) = Re{X exp(+j omega t)}",
    COMPLEX: "Complex sensitivity with the covariance matrix of its real and imaginary part",
}
"""Types of quantities without a published list, declared in the certificate."""

PREFIX = "force_"
PER_LOAD: Mapping[str, Powers] = {"F": ((r"\newton", -1),), "M": ((r"\newton", -1), (r"\metre", -1))}


def certificate_xml(found: Certificate) -> bytes:
    """Return the certificate as XML; every list has as many numbers as frequencies."""
    root = D.digitalCalibrationCertificate(
        {f"{{{XSI}}}schemaLocation": f"{DCC} {DCC}/v{SCHEMA}/dcc.xsd", "schemaVersion": SCHEMA},
        _administrative(found),
        D.measurementResults(_measured(found)),
    )
    etree.cleanup_namespaces(root, keep_ns_prefixes=["dcc", "si", "xsi"])
    return bytes(etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True))


def _text(tag: str, *words: str) -> etree._Element:
    """Return an element of texts in the language of the certificate."""
    return D(tag, *(D.content(word, lang=LANGUAGE) for word in words))


def _administrative(found: Certificate) -> etree._Element:
    form, sensor = found.form, found.sensor
    administration = form.administration
    days = [
        ("receiptDate", administration.received),
        ("beginPerformanceDate", found.begin),
        ("endPerformanceDate", found.end),
    ]
    core = [D.countryCodeISO3166_1(form.laboratory.country), D.usedLangCodeISO639_1(LANGUAGE)]
    core += [D.mandatoryLangCodeISO639_1(LANGUAGE), D.uniqueIdentifier(administration.number)]
    core += [D(tag, str(day)) for tag, day in days]
    core += [D.performanceLocation(administration.place), D.issueDate(str(administration.issued))]
    numbers = [("manufacturer", sensor.serial, "Serial number"), ("customer", form.item.customer_number, "Number")]
    identifications = [
        D.identification(D.issuer(issuer), D.value(value), _text("name", name))
        for issuer, value, name in numbers
        if value
    ]
    item = D.item(
        {"id": "item"},
        _text("name", sensor.name),
        _text("description", f"Condition as received: {form.item.condition}"),
        D.manufacturer(_text("name", form.item.manufacturer)),
        D.model(form.item.model),
        D.identifications(*identifications),
    )
    code = form.laboratory.accreditation
    statements = [D.statement(_text("name", name), _text("declaration", text)) for name, text in found.statements()]
    laboratory = [D.calibrationLaboratoryCode(code)] if code else []
    persons = [
        ("Operator", administration.operator, "false"),
        ("Responsible for the certificate", administration.authoriser, "true"),
    ]
    return D.administrativeData(
        D.dccSoftware(_software()),
        D.refTypeDefinitions(*(_declared(name, about) for name, about in _types(found).items())),
        D.coreData(*core),
        D.items(item),
        D.calibrationLaboratory(*laboratory, _party("contact", form.laboratory)),
        D.respPersons(
            *(
                D.respPerson(D.person(_text("name", person)), D.role(role), D.mainSigner(main))
                for role, person, main in persons
            )
        ),
        _party("customer", form.customer),
        D.statements(*statements),
    )


def _types(found: Certificate) -> dict[str, str]:
    """Return the types of quantities that a certificate declares."""
    of_numbers = {f"{PREFIX}{kind}": about for kind, about in quantity_types(found.numbers).items()}
    return {**(REF_TYPES if found.elements else {}), **of_numbers}


def _declared(name: str, about: str) -> etree._Element:
    """Return the declaration of a type of quantity."""
    return D.refTypeDefinition(
        _text("name", name),
        _text("description", about),
        D.namespace("force"),
        D.link(f"urn:{PROGRAM}:refType"),
        D.release(f"v{__version__}"),
        D.value(name),
    )


def _software() -> etree._Element:
    return D.software(_text("name", PROGRAM), D.release(f"v{__version__}"))


def _party(tag: str, party: Party) -> etree._Element:
    """Return name and address of a party."""
    address = {"street": party.street, "postCode": party.post_code, "city": party.city, "countryCode": party.country}
    mail = [D.eMail(party.email)] if party.email else []
    location = D.location(*(D(name, text) for name, text in address.items() if text))
    return D(tag, _text("name", party.name), *mail, location)


def _measured(found: Certificate) -> etree._Element:
    administration = found.form.administration
    procedure = [_text("description", found.procedure)] if found.procedure else []
    equipment = [D.measuringEquipments(*(_source(source) for source in found.sources))] if found.sources else []
    return D.measurementResult(
        {"refId": "item"},
        _text("name", found.title),
        D.usedMethods(D.usedMethod(_text("name", administration.method), *procedure)),
        D.usedSoftware(_software()),
        *equipment,
        D.influenceConditions(*_conditions(found)),
        D.results(
            *(_result(found, element) for element in found.elements), *(_listed(found, f) for f in found.numbers)
        ),
    )


def _source(source: UnderlyingCertificate) -> etree._Element:
    """Return an underlying certificate as the measuring equipment to which it belongs."""
    origin = ", ".join(filter(None, (source.laboratory, source.day)))
    number = D.identification(D.issuer("calibrationLaboratory"), D.value(source.certificate or "unnumbered"))
    about = [_text("description", f"Certificate of {origin}")] if origin else []
    return D.measuringEquipment(_text("name", "; ".join(source.inputs)), *about, D.identifications(number))


def _conditions(found: Certificate) -> Iterator[etree._Element]:
    """Yield every condition with its smallest and largest value, or that none is stated."""
    for name, unit, low, high in found.conditions:
        values = " ".join(repr(float(value)) for value in dict.fromkeys((low, high)))
        numbers = S.realListXMLList(S.valueXMLList(values), S.unitXMLList(unit))
        yield D.influenceCondition(_text("name", name), D.data(D.quantity(numbers)))
    if not found.conditions:
        yield D.influenceCondition(_text("name", "Surroundings"), D.data(_text("text", "not stated")))


def _result(found: Certificate, element: CertifiedElement) -> etree._Element:
    """Return one result: frequency, magnitude and phase if determined, and complex value."""
    powers = PER_LOAD[element.component[0]]
    unit, squared = (_dsi_unit(found, element.unit, powers, power) for power in (1, 2))
    values, digits = element.values, _numbers
    frequency = digits(value.frequency_hz for value in values)
    quantities = [_quantity("vib_frequency vib_nominalFrequency basic_tableIndex0", "Frequency", frequency, r"\hertz")]
    if all(value.has_phase for value in values):
        of_magnitude = ([value.expanded_magnitude for value in values], [value.k for value in values])
        of_phase = ([value.expanded_phase_rad for value in values], [value.k_phase for value in values])
        size, turn = (digits(getattr(v.element, name) for v in values) for name in ("magnitude", "phase_rad"))
        label = f"basic_measuredValue {MAGNITUDE}"
        quantities += [
            _quantity(label, f"Magnitude of {element.name}", size, unit, of_magnitude, _limit(element)),
            _quantity(f"vib_phase {PHASE}", f"Phase of {element.name}", turn, r"\radian", of_phase),
        ]
    quantities.append(_complex(element, unit, squared))
    return D.result(_text("name", element.name), D.data(D.list({"refType": "basic_1IndexTable"}, *quantities)))


def _listed(found: Certificate, number_list: NumberList) -> etree._Element:
    """Return one result: a list of single numbers with U."""
    quantities = []
    for number in number_list.numbers:
        unit = _dsi_unit(found, number.unit).replace(r"\kilo\gram", r"\kilogram")
        expanded, factor = S.valueExpandedMU(repr(number.expanded)), S.coverageFactor(repr(number.k))
        stated = S.expandedMU(expanded, factor, S.coverageProbability(repr(COVERAGE)))
        real = S.real(S.value(repr(number.value)), S.unit(unit), S.measurementUncertaintyUnivariate(stated))
        kind = {"refType": f"basic_measuredValue {PREFIX}{number.kind}"}
        quantities.append(D.quantity(kind, _text("name", number.name), real))
    return D.result(_text("name", number_list.name), D.data(D.list(*quantities)))


def _dsi_unit(found: Certificate, unit: str, powers: Powers = (), power: int = 1) -> str:
    """Return a unit of the sensor in D-SI; raise `InputError` for one that has none."""
    try:
        return dsi_unit(unit, powers, power)
    except ValueError as error:
        raise InputError(UNIT_WITHOUT_DSI, found.rig_path, "sensor.unit", found=unit) from error


def _numbers(values: Iterable[float]) -> str:
    """Return numbers with full precision."""
    return " ".join(repr(float(value)) for value in values)


def _quantity(
    kind: str,
    name: str,
    values: str,
    unit: str,
    expanded: tuple[list[float], list[float]] | None = None,
    further: Sequence[etree._Element] = (),
) -> etree._Element:
    """Return a list of real numbers with U and k, if any."""
    stated = []
    if expanded is not None:
        uncertainty = S.expandedMUXMLList(
            S.valueExpandedMUXMLList(_numbers(expanded[0])),
            S.coverageFactorXMLList(_numbers(expanded[1])),
            S.coverageProbabilityXMLList(repr(COVERAGE)),
        )
        stated = [S.measurementUncertaintyUnivariateXMLList(uncertainty)]
    numbers = S.realListXMLList(S.valueXMLList(values), S.unitXMLList(unit), *stated)
    return D.quantity({"refType": kind}, _text("name", name), numbers, *further)


def _limit(element: CertifiedElement) -> list[etree._Element]:
    """Return the conformity of each value of a list."""
    if not element.verdicts:
        return []
    judged = D.conformityXMLList(" ".join(element.verdicts))
    return [D.measurementMetaData(D.metaData(_text("name", "Conformity"), judged))]


def _complex(element: CertifiedElement, unit: str, squared: str) -> etree._Element:
    """Return complex values with their covariance matrices and the factor of the region."""
    values = element.values
    factors = [value.element.region_factor for value in values]
    matrices = [value.element.region_matrix / k**2 for value, k in zip(values, factors, strict=True)]
    rows = np.reshape(matrices, (-1, 4)).T
    cells = [S.covarianceXMLList(S.valueXMLList(_numbers(row)), S.unitXMLList(squared)) for row in rows]
    region = S.ellipsoidalRegionMUXMLList(
        S.covarianceMatrixXMLList(S.columnXMLList(*cells[:2]), S.columnXMLList(*cells[2:])),
        S.coverageFactorXMLList(_numbers(factors)),
        S.coverageProbabilityXMLList(repr(COVERAGE)),
    )
    numbers = S.complexListXMLList(
        S.valueRealXMLList(_numbers(value.element.re for value in values)),
        S.valueImagXMLList(_numbers(value.element.im for value in values)),
        S.unitXMLList(unit),
        S.measurementUncertaintyBivariateXMLList(region),
    )
    return D.quantity({"refType": COMPLEX}, _text("name", f"{element.name}, complex"), numbers)


# The page, and the command that writes page and XML.


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
    write_requested_pdf(folder / PAGE_FILE)
    return found


def write_form(path: Path, results: Path | None = None) -> None:
    """Write a new certificate.toml to be filled in."""
    file = path / FORM_FILE if path.is_dir() else path
    check_new_file(file, force=False)
    command = find_command(find_results_folder(file.parent, results))
    text = NEW_FORM
    if command is not None:
        text = re.sub(r'(?m)^method = ".*"$', f'method = "{CERTIFIED_COMMANDS[command].method}"', text)
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
        page_column("value ± U", lambda f: quantity_html(f.value, f.expanded, "" if f.unit == "1" else f.unit)),
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

        def conforms(value: CertifiedValue) -> str:
            return "yes" if element.verdicts[indices[id(value)]] == "pass" else "no"

        columns += [page_column("from static / %", deviation), page_column("conforms", conforms, "l")]
    return table(element.name, columns, element.values)
