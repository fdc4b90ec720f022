"""The certificate as XML (DCC schema 3.3.0, D-SI 2.2.1)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from hashlib import sha256

import numpy as np
from lxml import etree
from lxml.builder import ElementMaker

from fusion.base import PROGRAM, __version__
from fusion.errors import InputError
from fusion.estimation.coverage import COVERAGE
from fusion.recording.dsi import Powers, dsi_unit
from fusion.sensor.certificate.certificate_content import (
    Certificate,
    CertifiedElement,
    CertifiedValue,
    UnderlyingCertificate,
    input_words,
)
from fusion.sensor.certificate.certificate_form import CertifiedEquipment, Party
from fusion.sensor.certificate.certificate_inputs import NumberList, quantity_types
from fusion.sensor.result_notices import UNIT_WITHOUT_DSI

DCC, SI, XSI = "https://ptb.de/dcc", "https://ptb.de/si", "http://www.w3.org/2001/XMLSchema-instance"
SCHEMA = "3.3.0"
D = ElementMaker(namespace=DCC, nsmap={"dcc": DCC, "si": SI, "xsi": XSI})
S = ElementMaker(namespace=SI, nsmap={"si": SI})
LANGUAGE = "en"
MAGNITUDE, PHASE, COMPLEX = "force_sensitivityMagnitude", "force_sensitivityPhase", "force_sensitivityComplex"
OUTPUT, LOAD, AMPLITUDE, DEVIATION = (
    *("force_outputChannel", "force_loadComponent"),
    *("force_loadAmplitude", "force_sensitivityDeviation"),
)
EQUIPMENT = {"reference": "basic_normalUsed", "measuring": "force_measuringInstrument"}
AMPLIFIER, MOUNTING = "force_bridgeAmplifier", "force_mounting"
PAGE_FILE = "certificate.html"
PAGE_HASH = f"{PAGE_FILE}, SHA-256 "
REF_TYPES = {
    MAGNITUDE: "Magnitude of the complex sensitivity, output per force or moment",
    PHASE: "Phase of the complex sensitivity, of x(t) = Re{X exp(+j omega t)}",
    COMPLEX: "Complex sensitivity with the covariance matrix of its real and imaginary part",
    OUTPUT: "Output of the sensor, the row of its matrix",
    LOAD: "Component of the load, the column of the matrix",
    AMPLITUDE: "Amplitude of the load, smallest and largest of the recordings",
    DEVIATION: "Deviation of the magnitude from the static sensitivity, relative to it",
}
RIG_TYPES = {
    EQUIPMENT["measuring"]: "Measuring instrument of the calibration",
    AMPLIFIER: "Amplifier of the sensor's bridge, with its supply",
    MOUNTING: "Mounting of the sensor, with the torque of its screws",
}
"""Types of quantities without a published list, declared in the certificate."""

CONDITIONS = {"Temperature": "basic_temperature", "humidity": "basic_humidityRelative"}
"""Published types of influence conditions by a word of their names."""
PREFIX = "force_"
PER_LOAD: Mapping[str, Powers] = {"F": ((r"\newton", -1),), "M": ((r"\newton", -1), (r"\metre", -1))}


def certificate_xml(found: Certificate, page: bytes) -> bytes:
    """Return the certificate as XML, with the hash of its `page`.

    Every list has one number per row of its table.
    """
    root = D.digitalCalibrationCertificate(
        {f"{{{XSI}}}schemaLocation": f"{DCC} {DCC}/v{SCHEMA}/dcc.xsd", "schemaVersion": SCHEMA},
        _administrative(found, page),
        D.measurementResults(_measured(found)),
    )
    etree.cleanup_namespaces(root, keep_ns_prefixes=["dcc", "si", "xsi"])
    return bytes(etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True))


def _text(tag: str, *words: str) -> etree._Element:
    """Return an element of texts in the language of the certificate."""
    return D(tag, *(D.content(word, lang=LANGUAGE) for word in words))


def _administrative(found: Certificate, page: bytes) -> etree._Element:
    form, sensor = found.form, found.sensor
    administration = form.administration
    days = [
        ("receiptDate", administration.received),
        ("beginPerformanceDate", found.begin),
        ("endPerformanceDate", found.end),
    ]
    core = [D.countryCodeISO3166_1(form.laboratory.country), D.usedLangCodeISO639_1(LANGUAGE)]
    core += [D.mandatoryLangCodeISO639_1(LANGUAGE), D.uniqueIdentifier(found.number)]
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
        _text("description", f"Condition as received: {form.item.condition}; axes: {form.item.axes}"),
        D.manufacturer(_text("name", form.item.manufacturer)),
        D.model(form.item.model),
        D.identifications(*identifications),
    )
    code = form.laboratory.accreditation
    stated = [*found.statements(), ("Page for people", f"{PAGE_HASH}{sha256(page).hexdigest()}")]
    statements = [D.statement(_text("name", name), _text("declaration", text)) for name, text in stated]
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
    return {**(REF_TYPES if found.elements else {}), **RIG_TYPES, **of_numbers}


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
    return D.measurementResult(
        {"refId": "item"},
        _text("name", found.title),
        D.usedMethods(D.usedMethod(_text("name", administration.method), *procedure)),
        D.usedSoftware(_software()),
        D.measuringEquipments(*_equipment(found)),
        D.influenceConditions(*_conditions(found)),
        D.results(*_results(found), *(_listed(found, f) for f in found.numbers)),
    )


def _equipment(found: Certificate) -> Iterator[etree._Element]:
    """Yield references, instruments and the bridge amplifier, and what inputs name in addition."""
    for one in found.form.equipment:
        yield _instrument(EQUIPMENT[one.use], one)
    amplifier = found.form.amplifier
    about = [f"Supply of the bridge: {amplifier.supply}"] + [f"Filter: {amplifier.filter}"] * bool(amplifier.filter)
    yield D.measuringEquipment(
        {"refType": AMPLIFIER}, _text("name", amplifier.name), _text("description", "; ".join(about))
    )
    named = {one.certificate for one in found.form.equipment}
    yield from (_source(source) for source in found.sources if source.certificate not in named)


def _instrument(kind: str, one: CertifiedEquipment) -> etree._Element:
    """Return a reference or an instrument with its certificate."""
    until = "" if one.valid_until is None else f"valid until {one.valid_until}"
    origin = ", ".join(filter(None, (one.laboratory, str(one.date or ""), until)))
    description = _text("description", f"{one.identification}; certificate of {origin}")
    return D.measuringEquipment(
        {"refType": kind}, _text("name", one.name), description, D.identifications(_numbered(one.certificate))
    )


def _numbered(certificate: str) -> etree._Element:
    """Return the number of an underlying certificate."""
    value = D.value(certificate or "unnumbered")
    return D.identification(D.issuer("calibrationLaboratory"), value, _text("name", "Certificate"))


def _source(source: UnderlyingCertificate) -> etree._Element:
    """Return an underlying certificate as the measuring equipment to which it belongs."""
    origin = ", ".join(filter(None, (source.laboratory, source.day)))
    about = [_text("description", f"Certificate of {origin}")] if origin else []
    name = _text("name", "; ".join(input_words(source.inputs)))
    return D.measuringEquipment(name, *about, D.identifications(_numbered(source.certificate)))


def _conditions(found: Certificate) -> Iterator[etree._Element]:
    """Yield every condition with its smallest and largest value, the masses and the mounting."""
    for name, unit, low, high in found.conditions:
        kind = next((kind for word, kind in CONDITIONS.items() if word in name), "")
        ends = [
            D.quantity(
                {"refType": f"{kind}{end}"} if kind else {},
                _text("name", f"{name}, {word}"),
                S.real(S.value(repr(value)), S.unit(unit)),
            )
            for end, word, value in (("Min", "smallest", low), ("Max", "largest", high))
        ]
        yield D.influenceCondition({"refType": kind} if kind else {}, _text("name", name), D.data(*ends))
    for load in found.loads:
        numbers = [
            D.quantity(_text("name", one.name), _real(one.mass_kg, r"\kilogram", one.expanded_kg, 2.0))
            for one in load.masses
        ]
        yield D.influenceCondition(_text("name", f"Masses, {', '.join(load.recordings)}"), D.data(*numbers))
    mounting = found.form.mounting
    text = _text("text", f"{mounting.description}; torque {mounting.torque}")
    yield D.influenceCondition({"refType": MOUNTING}, _text("name", "Mounting"), D.data(text))


def _results(found: Certificate) -> Iterator[etree._Element]:
    """Yield one table per element; of matrices one per kind of load."""
    if not found.is_matrix:
        yield from (_result(found, element.name, [element]) for element in found.elements)
        return
    for letter, name in (("F", "force"), ("M", "moment")):
        elements = [element for element in found.elements if element.component[0] == letter]
        if elements:
            yield _result(found, f"Sensitivity matrix per {name}", elements)


def _result(found: Certificate, name: str, elements: Sequence[CertifiedElement]) -> etree._Element:
    """Return one table: its indices, magnitude and phase where they are determined, and complex value."""
    powers = PER_LOAD[elements[0].component[0]]
    unit, squared = (_dsi_unit(found, elements[0].unit, powers, power) for power in (1, 2))
    rows = sorted(
        ((value, element) for element in elements for value in element.values), key=lambda row: row[0].frequency_hz
    )
    values, several = [value for value, _ in rows], len(elements) > 1
    frequency = _numbers(value.frequency_hz for value in values)
    quantities = [_quantity("vib_frequency vib_nominalFrequency basic_tableIndex0", "Frequency", frequency, r"\hertz")]
    if several:
        outputs, loads = ([getattr(one, key) for _, one in rows] for key in ("channel", "component"))
        quantities.append(_names(f"{OUTPUT} basic_tableIndex1", "Output", outputs))
        quantities.append(_names(f"{LOAD} basic_tableIndex2", "Load", loads))
    if any(value.has_phase for value in values):
        quantities += _magnitude_and_phase(name, values, unit)
    quantities.append(_complex(name, values, unit, squared))
    mains = [element for element in elements if element.main]
    loaded = [element for element in mains if np.isfinite([value.amplitude for value in element.values]).all()]
    further = [D.influenceConditions(*map(_amplitudes, loaded))] if loaded else []
    checks = [_deviation(element) for element in mains if element.deviation]
    further += [D.measurementMetaData(*checks)] if checks else []
    table = {"refType": f"basic_{3 if several else 1}IndexTable"}
    return D.result(_text("name", name), D.data(D.list(table, *quantities, *further)))


def _magnitude_and_phase(name: str, values: Sequence[CertifiedValue], unit: str) -> list[etree._Element]:
    """Return the lists of magnitude and phase with U, NaN where they are not determined."""

    def column(key: str, source: str = "") -> list[float]:
        pairs = ((getattr(one, source) if source else one, one.has_phase) for one in values)
        return [getattr(owner, key) if determined else np.nan for owner, determined in pairs]

    sizes, turns = _numbers(column("magnitude", "element")), _numbers(column("phase_rad", "element"))
    of_size = column("expanded_magnitude"), [value.k for value in values]
    of_turn = column("expanded_phase_rad"), [value.k_phase for value in values]
    return [
        _quantity(f"basic_measuredValue {MAGNITUDE}", f"Magnitude of {name}", sizes, unit, of_size),
        _quantity(f"vib_phase {PHASE}", f"Phase of {name}", turns, r"\radian", of_turn),
    ]


def _names(kind: str, name: str, texts: Sequence[str]) -> etree._Element:
    """Return an index of a table: one name per row, without spaces, which separate them."""
    words = ("_".join(text.split()) for text in texts)
    return D.quantity({"refType": kind}, _text("name", name), D.charsXMLList(" ".join(words)))


def _amplitudes(element: CertifiedElement) -> etree._Element:
    """Return the amplitudes of the load over frequency, smallest and largest."""
    unit = r"\newton" if element.component[0] == "F" else r"\newton\metre"
    ends = [
        _quantity(AMPLITUDE, f"{word} amplitude", _numbers(value.amplitude[end] for value in element.values), unit)
        for end, word in enumerate(("Smallest", "Largest"))
    ]
    return D.influenceCondition({"refType": AMPLITUDE}, _text("name", f"Load {element.component}"), D.data(*ends))


def _deviation(element: CertifiedElement) -> etree._Element:
    """Return the deviation from the static sensitivity over frequency with U, and its conformity."""
    sizes, expanded, factors = (list(column) for column in zip(*element.deviation, strict=True))
    numbers = _quantity(DEVIATION, "Deviation", _numbers(sizes), r"\one", (expanded, factors))
    judged = [D.conformityXMLList(" ".join(element.verdicts))] if element.verdicts else []
    name = _text("name", f"{element.name}: deviation of the magnitude from the static sensitivity")
    return D.metaData(name, *judged, D.data(numbers))


def _listed(found: Certificate, number_list: NumberList) -> etree._Element:
    """Return one result: a list of single numbers with U."""
    quantities = []
    for number in number_list.numbers:
        unit = _dsi_unit(found, number.unit).replace(r"\kilo\gram", r"\kilogram")
        real = _real(number.value, unit, number.expanded, number.k)
        kind = {"refType": f"basic_measuredValue {PREFIX}{number.kind}"}
        quantities.append(D.quantity(kind, _text("name", number.name), real))
    return D.result(_text("name", number_list.name), D.data(D.list(*quantities)))


def _real(value: float, unit: str, expanded: float, k: float) -> etree._Element:
    """Return a number with U and k."""
    about = S.valueExpandedMU(repr(expanded)), S.coverageFactor(repr(k)), S.coverageProbability(repr(COVERAGE))
    return S.real(S.value(repr(value)), S.unit(unit), S.measurementUncertaintyUnivariate(S.expandedMU(*about)))


def _dsi_unit(found: Certificate, unit: str, powers: Powers = (), power: int = 1) -> str:
    """Return a unit of the sensor in D-SI; raise `InputError` for one that has none."""
    try:
        return dsi_unit(unit, powers, power)
    except ValueError as error:
        raise InputError(UNIT_WITHOUT_DSI, found.rig_path, "sensor.unit", found=unit) from error


def _numbers(values: Iterable[float]) -> str:
    """Return numbers with full precision, NaN as D-SI writes it."""
    return " ".join(repr(float(value)).replace("nan", "NaN") for value in values)


def _quantity(
    kind: str,
    name: str,
    values: str,
    unit: str,
    expanded: tuple[list[float], list[float]] | None = None,
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
    return D.quantity({"refType": kind}, _text("name", name), numbers)


def _complex(name: str, values: Sequence[CertifiedValue], unit: str, squared: str) -> etree._Element:
    """Return complex values with their covariance matrices and the factor of the region."""
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
    return D.quantity({"refType": COMPLEX}, _text("name", f"{name}, complex"), numbers)
