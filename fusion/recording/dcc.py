"""Digital Calibration Certificates read: quantities with U and k, lists over frequency, number, laboratory, dates.

DCC (PTB's schema, versions 2.4 to 3.3) with the D-SI in it. Everything is turned into coherent SI units.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date as Date
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import Identity, InputError
from fusion.recording.dsi import CELSIUS_AT_0_K, NONE, Unit, parse_unit
from fusion.recording.toml import read_text
from fusion.recording.values import describe, wrong_size
from shaker.arrays import ComplexArray, FloatArray

SUFFIX = ".xml"
ROOT = "{https://ptb.de/dcc}digitalCalibrationCertificate"
LARGEST = 20_000_000  # bytes
MOST_QUANTITIES, MOST_KEPT = 10_000, 32
HERTZ = parse_unit(r"\hertz").dimension
KINDS = ("real", "realListXMLList", "complex", "complexListXMLList", "hybrid", "list", "constant")
"""Elements of the D-SI that hold the values of a quantity."""
RECALIBRATION = re.compile(r"recalibration|valid_?until", re.IGNORECASE)
"""Types of a statement whose date is the last on which the certificate holds."""


@dataclass(frozen=True)
class CertifiedQuantity:
    """N values of a quantity in the coherent SI unit `unit` stands for, complex where it is; NaN U where there is none.

    `expanded`, `k`, `probability` (N,) each; `covariance` (N, 2, 2) of real and imaginary part, standard, of a complex
    one; `types`: the words of its `refType`; `where`: result and quantity for people; `listed`: it stands in a list;
    `ids`: of the quantity, its result and its data.
    """

    result: str
    name: str
    types: tuple[str, ...]
    value: ComplexArray
    unit: Unit
    expanded: FloatArray
    k: FloatArray
    probability: FloatArray
    distribution: str
    covariance: FloatArray | None
    group: int
    listed: bool
    ids: tuple[str, ...] = ()

    @property
    def where(self) -> str:
        """Return what it is for people."""
        return ", ".join(filter(None, (f'result "{self.result}"', f'quantity "{self.name}"' if self.name else "")))

    def called(self, name: str) -> bool:
        """Whether a name or type that a user gives is this quantity's or its result's."""
        return name in (self.result, self.name, *self.types, *self.ids)


@dataclass(frozen=True)
class CertifiedCurve:
    """A complex quantity over N frequencies (Hz): magnitude and phase (rad) with standard uncertainties, SI.

    u = U/k with k no larger than 2, so that 2·u stays the stated U. `phase_rad` with its u is NaN where the certificate
    has none; `value` (N,) and `covariance` (N, 2, 2) where it states the complex values.
    """

    name: str
    types: tuple[str, ...]
    ids: tuple[str, ...]
    unit: Unit
    frequency_hz: FloatArray
    magnitude: FloatArray
    u_magnitude: FloatArray
    phase_rad: FloatArray
    u_phase_rad: FloatArray
    value: ComplexArray | None = None
    covariance: FloatArray | None = None


@dataclass(frozen=True)
class CalibrationCertificate:
    """What a DCC states: its number, laboratory, day, last day of validity, quantities."""

    path: Path
    number: str
    laboratory: str
    date: Date | None
    valid_until: Date | None
    quantities: tuple[CertifiedQuantity, ...]

    def refusal(self, key: str, found: str, expected: str) -> InputError:
        """Return the mistake of an element of this file."""
        return InputError(self.path, key, found, expected)


def read_dcc(path: Path) -> CalibrationCertificate:
    """Read a Digital Calibration Certificate; `InputError` naming file and element for what cannot be used.

    A file that is what it was is parsed once, however many channels and recordings name it; one that was changed so
    shortly before that another change may not show, every time.
    """
    now = Identity.of(path)
    return _parsed(path, now) if now is not None and now.settled else _parsed.__wrapped__(path, now)


@lru_cache(maxsize=MOST_KEPT)
def _parsed(path: Path, _: Identity | None) -> CalibrationCertificate:
    """Parse a certificate."""
    root = _root(path)
    administrative = root.find("{*}administrativeData")
    if administrative is None:
        raise InputError(path, "dcc:administrativeData", "no such element", "the administrative data of a certificate")
    number = _text(administrative.find("{*}coreData/{*}uniqueIdentifier"))
    if not number:
        raise InputError(path, "dcc:uniqueIdentifier", "nothing", "the number of the certificate")
    core = administrative.find("{*}coreData")
    days = [_day(path, core.find(f"{{*}}{name}")) for name in ("endPerformanceDate", "beginPerformanceDate")]
    statements = [
        _day(path, statement.find("{*}date"))
        for statement in administrative.iterfind("{*}statements/{*}statement")
        if RECALIBRATION.search(statement.get("refType") or "")
    ]
    return CalibrationCertificate(
        path=path,
        number=number,
        laboratory=_text(administrative.find("{*}calibrationLaboratory/{*}contact/{*}name/{*}content")),
        date=next((day for day in days if day is not None), None),
        valid_until=min((day for day in statements if day is not None), default=None),
        quantities=tuple(_quantities(path, root)),
    )


def _root(path: Path) -> Any:
    """Return the root of a file of XML, in which no entity is defined and nothing is fetched from elsewhere."""
    from lxml import etree

    text = read_text(path, LARGEST, "a Digital Calibration Certificate")
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(path, "", "a document type declaration", "XML without one, as a certificate has")
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, remove_comments=True, remove_pis=True,
        encoding="utf-8",
    )  # fmt: skip
    try:
        root = etree.fromstring(text.encode(), parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        told = describe(" ".join(str(error).split()), plain=True)
        raise InputError(path, "", f"damaged XML ({told})", "a Digital Calibration Certificate") from error
    if root.tag != ROOT:
        found = f"the element {describe(str(root.tag), plain=True)}"
        raise InputError(path, "", found, "dcc:digitalCalibrationCertificate, the root of a DCC")
    return root


def _text(element: Any) -> str:
    """Return the text of an element, empty where there is none."""
    return "" if element is None else describe(" ".join((element.text or "").split()), plain=True)


def _name(element: Any) -> str:
    """Return the name of something in English, else in its first language."""
    contents = element.findall("{*}name/{*}content")
    english = [content for content in contents if content.get("lang") == "en"]
    return next(filter(None, map(_text, english + contents)), "")


def _tag(element: Any) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _day(path: Path, element: Any) -> Date | None:
    """Return a date, None where there is no such element."""
    if element is None:
        return None
    try:
        return Date.fromisoformat(_text(element)[:10])
    except ValueError as error:
        key = f"dcc:{_tag(element)}"
        raise InputError(path, key, f'"{_text(element)}"', "a day as YYYY-MM-DD") from error


def _quantities(path: Path, root: Any) -> Iterator[CertifiedQuantity]:
    """Yield every quantity with numbers of every result; those of one `group` stand in one list."""
    count, group = 0, 0
    for result in root.iterfind("{*}measurementResults/{*}measurementResult/{*}results/{*}result"):
        name, types = _name(result), (result.get("refType") or "").split()
        data = result.find("{*}data")
        waiting = [] if data is None else [(child, group) for child in data]
        while waiting:
            element, own_group = waiting.pop(0)
            if _tag(element) == "list":
                group += 1
                waiting = [(child, group) for child in element] + waiting
            elif _tag(element) == "quantity":
                count += 1
                if count > MOST_QUANTITIES:
                    raise InputError(path, "dcc:results", "more", f"at most {MOST_QUANTITIES} quantities")
                for values in [child for child in element if _tag(child) in KINDS][:1]:
                    found = _quantity(path, (name, types, own_group), element, values)
                    places = (result, data, element, *element.iterfind("{*}name/{*}content"))
                    yield replace(found, ids=tuple(own for own in (place.get("id") for place in places) if own))
        group += 1


def _quantity(path: Path, inside: tuple[str, list[str], int], element: Any, values: Any) -> CertifiedQuantity:
    """Read one quantity."""
    result, types, group = inside
    name = _name(element)
    reader = _Numbers(path, ", ".join(filter(None, (f'result "{result}"', f'quantity "{name}"' if name else ""))))
    found = reader.quantity(values)
    own = tuple(dict.fromkeys([*types, *(element.get("refType") or "").split()]))
    return replace(found, result=result, name=name, types=own, group=group)


@dataclass(frozen=True)
class _Numbers:
    """Reads the numbers of one quantity of a file."""

    path: Path
    where: str

    def refusal(self, tag: str, found: str, expected: str) -> InputError:
        return InputError(self.path, f"{self.where}: si:{tag}", found, expected)

    def numbers(self, parent: Any, tag: str, count: int | None = None) -> FloatArray:
        """Read a list of numbers; one number stands for all `count`."""
        element = parent.find(f"{{*}}{tag}")
        texts = [] if element is None or not element.text else element.text.split()
        if not texts:
            raise self.refusal(tag, "nothing", "numbers" if tag.endswith("List") else "a number")
        try:
            found = np.array([float(text) for text in texts])
        except ValueError as error:
            raise self.refusal(tag, f'"{describe(" ".join(texts), plain=True)[:60]}"', "numbers") from error
        wrong = [value for value in found.tolist() if not np.isfinite(value) or wrong_size(value)]
        if wrong:
            raise self.refusal(tag, f"{wrong[0]:g}", wrong_size(wrong[0]) or "finite numbers")
        if count is not None and len(found) not in (1, count):
            raise self.refusal(tag, f"{len(found)} numbers", f"{count} of them, as there are values")
        return found if count is None or len(found) == count else np.full(count, found[0])

    def units(self, parent: Any, tag: str, count: int) -> tuple[Unit, FloatArray]:
        """Read the unit of `count` values, or one for each; return the first, and the factor of each to SI."""
        element = parent.find(f"{{*}}{tag}")
        texts = (element.text or "").split() if element is not None else []
        if len(texts) not in (1, count):
            raise self.refusal(tag, f"{len(texts)} units" if texts else "nothing", f"one unit, or {count}")
        try:
            units = [parse_unit(text) for text in texts]
        except ValueError as error:
            expected, _, found = str(error).removeprefix("expected ").rpartition(", found ")
            raise self.refusal(tag, found, expected) from error
        if len({(unit.dimension, unit.celsius) for unit in units}) > 1:
            raise self.refusal(tag, "units of different quantities", "units that convert into each other")
        return units[0], np.full(count, [unit.factor for unit in units])

    def quantity(self, values: Any) -> CertifiedQuantity:
        """Read the numbers of a quantity of any kind."""
        tag = _tag(values)
        inner = [child for child in values if _tag(child) in KINDS]
        if tag in ("hybrid", "list"):
            if not inner:
                raise self.refusal(tag, "nothing", "values")
            parts = [self.quantity(child) for child in (inner[:1] if tag == "hybrid" else inner)]
            if len({part.unit.dimension for part in parts}) > 1:
                raise self.refusal(tag, "units of different quantities", "units that convert into each other")
            return parts[0] if len(parts) == 1 else _joined(parts)
        suffix = "XMLList" if tag.endswith("XMLList") else ""
        return self._complex(values, suffix) if tag.startswith("complex") else self._real(values, suffix)

    def _real(self, values: Any, suffix: str) -> CertifiedQuantity:
        """Read `si:real`, `si:constant` or a list of real numbers."""
        value = self.numbers(values, f"value{suffix}")
        unit, factor = self.units(values, f"unit{suffix}", len(value))
        expanded, k, probability, shape = self._uncertainty(values, suffix, len(value))
        shift = -CELSIUS_AT_0_K if unit.celsius else 0.0
        total = np.asarray(value * factor + shift, dtype=np.complex128)
        own = expanded * factor, k, probability, shape
        return CertifiedQuantity("", "", (), total, unit, *own, None, 0, bool(suffix) or len(value) > 1)

    def _uncertainty(self, values: Any, suffix: str, count: int) -> tuple[FloatArray, FloatArray, FloatArray, str]:
        """Read U with k, probability and distribution in all ways in which the D-SI states them; NaN where none is."""
        nothing = np.full(count, np.nan)
        places: tuple[tuple[str, tuple[str, ...]], ...] = (
            (
                f"measurementUncertaintyUnivariate{suffix}/{{*}}expandedMU{suffix}",
                ("valueExpandedMU", "coverageFactor"),
            ),
            (f"measurementUncertaintyUnivariate{suffix}/{{*}}standardMU{suffix}", ("valueStandardMU",)),
            (f"measurementUncertaintyUnivariate{suffix}/{{*}}coverageIntervalMU{suffix}", ("valueStandardMU",)),
            (f"expandedUnc{suffix}", ("uncertainty", "coverageFactor")),
            (f"coverageInterval{suffix}", ("standardUnc",)),
        )
        for place, tags in places:
            element = values.find("{*}" + place)
            if element is None:
                continue
            expanded = self.numbers(element, f"{tags[0]}{suffix}", count)
            k = self.numbers(element, f"{tags[1]}{suffix}", count) if len(tags) > 1 else np.ones(count)
            if np.any(expanded < 0.0) or np.any(k < 1.0):
                tag, least = (tags[0], "0") if np.any(expanded < 0.0) else (tags[1], "1")
                found = expanded.min() if least == "0" else k.min()
                raise self.refusal(f"{tag}{suffix}", f"{found:g}", f"numbers of at least {least}")
            stated = len(tags) > 1 and element.find(f"{{*}}coverageProbability{suffix}") is not None
            probability = self.numbers(element, f"coverageProbability{suffix}", count) if stated else nothing
            return expanded, k, probability, _text(element.find(f"{{*}}distribution{suffix}"))
        return nothing, nothing, nothing, ""

    def _complex(self, values: Any, suffix: str) -> CertifiedQuantity:
        """Read complex numbers, Cartesian with their covariance, or polar."""
        polar = values.find(f"{{*}}valueMagnitude{suffix}") is not None
        tags = ("valueMagnitude", "valuePhase") if polar else ("valueReal", "valueImag")
        first = self.numbers(values, tags[0] + suffix)
        second = self.numbers(values, tags[1] + suffix)
        if len(first) != len(second):
            raise self.refusal(tags[1] + suffix, f"{len(second)} numbers", f"{len(first)}, as there are of {tags[0]}")
        unit, factor = self.units(values, f"unit{suffix}", len(first))
        if polar:
            turn, radian = self.units(values, f"unitPhase{suffix}", len(first))
            if turn.dimension != NONE:
                raise self.refusal(f"unitPhase{suffix}", turn.text, "a unit of an angle")
            value = first * np.exp(1j * second * radian)
        else:
            value = first + 1j * second
        covariance, nothing = (
            None if polar else self._covariance(values, suffix, len(first), unit),
            np.full(len(first), np.nan),
        )
        return CertifiedQuantity(
            "", "", (), np.asarray(value * factor), unit, nothing, nothing, nothing, "",
            covariance, 0, bool(suffix),
        )  # fmt: skip

    def _covariance(self, values: Any, suffix: str, count: int, unit: Unit) -> FloatArray | None:
        """Read the covariance matrices (N, 2, 2) of complex values in SI, None where their unit is not that squared."""
        matrix = values.find(f".//{{*}}covarianceMatrix{suffix}")
        if matrix is None:
            return None
        cells = matrix.findall(f"{{*}}column{suffix}/{{*}}covariance{suffix}")
        if len(cells) != 4:
            raise self.refusal(f"covarianceMatrix{suffix}", f"{len(cells)} elements", "2 columns of 2")
        units = [self.units(cell, f"unit{suffix}", count) for cell in cells]
        if any(own.dimension != tuple(2 * power for power in unit.dimension) for own, _ in units):
            return None
        numbers = [self.numbers(cell, f"value{suffix}", count) for cell in cells]
        found = np.stack([n * factor for n, (_, factor) in zip(numbers, units, strict=True)], axis=1).reshape(-1, 2, 2)
        scale = np.trace(found, axis1=1, axis2=2)[:, None, None]
        if np.any(np.abs(found - found.swapaxes(1, 2)) > 1e-6 * scale) or np.any(
            np.linalg.det(found) < -1e-9 * scale[:, 0, 0] ** 2
        ):
            raise self.refusal(
                f"covarianceMatrix{suffix}", "another matrix", "a symmetric one without negative variances"
            )
        return found


def _joined(parts: Sequence[CertifiedQuantity]) -> CertifiedQuantity:
    """Return the values of an `si:list` as one list."""
    matrices = [part.covariance for part in parts if part.covariance is not None]
    covariance = np.concatenate(matrices) if len(matrices) == len(parts) else None
    return replace(
        parts[0],
        value=np.concatenate([part.value for part in parts]),
        expanded=np.concatenate([part.expanded for part in parts]),
        k=np.concatenate([part.k for part in parts]),
        probability=np.concatenate([part.probability for part in parts]),
        covariance=covariance,
        listed=True,
    )


# What users take from a certificate: lists over frequency, single values.


def _kind(quantity: CertifiedQuantity, *words: str) -> bool:
    """Whether one of some words stands in a quantity's types or, where these say nothing, in its name."""
    told = " ".join((*quantity.types, quantity.name)).lower()
    return any(word in told for word in words)


def curves(certificate: CalibrationCertificate) -> tuple[CertifiedCurve, ...]:
    """Return every list of a certificate that gives something over frequency; `InputError` for one that lacks U."""
    groups: dict[int, list[CertifiedQuantity]] = {}
    for quantity in certificate.quantities:
        groups.setdefault(quantity.group, []).append(quantity)
    found = [_curve(certificate, members) for members in groups.values()]
    return tuple(curve for curve in found if curve is not None)


def _curve(certificate: CalibrationCertificate, members: Sequence[CertifiedQuantity]) -> CertifiedCurve | None:
    """Return the list over frequency that quantities make, None where they make none."""
    frequencies = [q for q in members if q.unit.dimension == HERTZ and _kind(q, "frequen", "tableindex")]
    if not frequencies:
        return None
    frequency, rest = frequencies[0], [q for q in members if q not in frequencies]
    real = [q for q in rest if q.covariance is None and not np.any(q.value.imag)]
    turns = [q for q in real if q.unit.dimension == NONE and _kind(q, "phase")]
    sizes = [q for q in real if not any(q is turn for turn in turns)]
    sizes = [q for q in sizes if _kind(q, "magnitude")] or [q for q in sizes if _kind(q, "measuredvalue")] or sizes
    whole = next((q for q in rest if not any(q is own for own in real)), None)
    if not sizes and whole is None:
        return None
    main = sizes[0] if sizes else whole
    assert main is not None
    used = [q for q in (frequency, *sizes[:1], *turns[:1], whole) if q is not None]
    short = next((q for q in used if len(q.value) != len(main.value)), None)
    if short is not None:
        expected = f"{len(main.value)}, as there are of {main.name or 'the values'}"
        raise certificate.refusal(short.where, f"{len(short.value)} numbers", expected)
    nothing = np.full(len(main.value), np.nan)
    if sizes:
        magnitude, u_magnitude = main.value.real, _standard(certificate, main)
        phase, u_phase = (turns[0].value.real, _standard(certificate, turns[0])) if turns else (nothing, nothing)
    else:
        if main.covariance is None:
            raise certificate.refusal(main.where, "no uncertainty", "their covariance, in their unit squared")
        magnitude, phase = np.abs(main.value), np.angle(main.value)
        along = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        across = np.stack([-np.sin(phase), np.cos(phase)], axis=1)
        u_magnitude = np.sqrt(np.einsum("ni,nij,nj->n", along, main.covariance, along))
        u_phase = np.sqrt(np.einsum("ni,nij,nj->n", across, main.covariance, across)) / np.where(
            magnitude, magnitude, 1
        )
    exact = whole is not None and whole.covariance is not None and whole.unit.dimension == main.unit.dimension
    types = tuple(dict.fromkeys(word for q in used for word in q.types))
    return CertifiedCurve(
        name=main.result or main.name, types=types,
        ids=tuple(i for q in used for i in q.ids), unit=main.unit, frequency_hz=np.asarray(frequency.value.real),
        magnitude=np.asarray(magnitude), u_magnitude=u_magnitude, phase_rad=phase, u_phase_rad=u_phase,
        value=whole.value if exact and whole is not None else None,
        covariance=whole.covariance if exact and whole is not None else None,
    )  # fmt: skip


def _standard(certificate: CalibrationCertificate, quantity: CertifiedQuantity) -> FloatArray:
    """Return u of every value; `InputError` where no U is stated."""
    if not np.all(np.isfinite(quantity.expanded)):
        raise certificate.refusal(quantity.where, "no uncertainty", "U with its coverage factor")
    return np.asarray(quantity.expanded / np.minimum(quantity.k, 2.0))


def curve_named(certificate: CalibrationCertificate, result: str) -> CertifiedCurve:
    """Return the list over frequency of a name, or the only one; `InputError` where none or several are that."""
    every = curves(certificate)
    fitting = [curve for curve in every if not result or result in (curve.name, *curve.types, *curve.ids)]
    if len(fitting) != 1:
        known = ", ".join(f'"{curve.name}"' for curve in every[:8])
        found = f"{len(fitting)} of {known}" if every else "no list over frequency"
        key = f'result "{describe(result, plain=True)}"' if result else "dcc:results"
        raise certificate.refusal(key, found, "one result over frequency, by its id, name or type")
    return fitting[0]
