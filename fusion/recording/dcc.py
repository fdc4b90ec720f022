"""Digital Calibration Certificates read: quantities with U and k, number, laboratory, dates.

DCC (PTB's schema, versions 2.4 to 3.3) with the D-SI in it. Everything is converted to coherent SI units. A quantity
that cannot be used is refused when a key names it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date as Date
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import FileIdentity
from fusion.errors import InputError
from fusion.recording.dsi import CELSIUS_AT_0_K, LEVEL, NONE, Dimension, Unit, parse_unit
from fusion.recording.recording_notices import (
    CERTIFICATE_CHANGED,
    CERTIFIED_VALUE_NOT_USABLE,
    INVALID_CERTIFICATE_FILE,
    SIGNATURE_NOT_CHECKED,
    SIGNER_NOT_VERIFIED,
)
from fusion.recording.toml import read_text
from fusion.recording.values import describe, wrong_size
from shaker.arrays import ComplexArray, FloatArray
from shakercal._common.notices import DeclaredNotice, Notice

SUFFIX = ".xml"
ROOT = "{https://ptb.de/dcc}digitalCalibrationCertificate"
LARGEST = 20_000_000  # bytes
MOST_QUANTITIES, MOST_KEPT = 10_000, 32
KINDS = ("real", "realList", "realListXMLList", "complex", "complexListXMLList", "hybrid", "list", "constant")
"""Elements of the D-SI that hold the values of a quantity."""
LIST_UNCERTAINTY = ("listMeasurementUncertaintyUnivariate", "listUnivariateUnc")
SIGNED = ("{*}administrativeData", "{*}measurementResults")
"""Of a certificate: what a signature has to cover."""
NO_UNIT = Unit(np.nan, (), "")
SAME_VALUE = 0.01
"""Relative difference up to which rounding explains that two units of one quantity state different values."""
RECALIBRATION = re.compile(r"recalibration|valid_?until", re.IGNORECASE)
"""Types of a statement whose date is the last on which the certificate holds."""


@dataclass(frozen=True)
class CertifiedQuantity:
    """N values of a quantity in the coherent SI unit `unit` stands for, complex where it is; NaN U where there is none.

    `expanded`, `k`, `probability` (N,) each; `covariance` (N, 2, 2) of real and imaginary part, standard, of a complex
    one; `types`: the words of its `refType`; `where`: result and quantity for people; `listed`: it stands in a list;
    `ids`: of the quantity, its result and its data; `names`: in every language; `about`: its description. `problem`:
    why its numbers cannot be used, None where they can; then it has no values, and `NO_UNIT` where its unit is none.
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
    names: tuple[str, ...] = ()
    description: str = ""
    problem: InputError | None = None

    @property
    def where(self) -> str:
        """Return what it is for people."""
        return ", ".join(filter(None, (f'result "{self.result}"', f'quantity "{self.name}"' if self.name else "")))

    @property
    def is_real(self) -> bool:
        """Whether it has real numbers; unknown of one that cannot be used, which counts as such."""
        return self.covariance is None and not np.any(np.nan_to_num(self.value.imag))

    @property
    def words(self) -> str:
        """Return types and names, in small letters, `phaseLag` as `phase lag`."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])|_", " ", " ".join((*self.types, *self.names))).lower()

    def is_named(self, name: str) -> bool:
        """Whether a name or type that a user gives is this quantity's or its result's."""
        return name in (self.result, self.name, *self.names, *self.types, *self.ids)

    def in_one_of(self, dimensions: Collection[Dimension]) -> CertifiedQuantity | None:
        r"""Return the quantity if its unit has one of some dimensions, by its other reading of `\per` if need be."""
        if self.unit.dimension in dimensions:
            return self
        other = self.unit.other
        if other is None or other.dimension not in dimensions:
            return None
        factor = other.factor / self.unit.factor
        return replace(self, unit=other, value=self.value * factor, expanded=self.expanded * factor)

    def usable(self) -> CertifiedQuantity:
        """Return the quantity; raise what is wrong with its numbers."""
        if self.problem is not None:
            raise self.problem
        return self


@dataclass(frozen=True)
class CalibrationCertificate:
    """What a DCC states: number, laboratory, day, last valid day, quantities; `signed`: notices of its signatures."""

    path: Path
    number: str
    laboratory: str
    date: Date | None
    valid_until: Date | None
    quantities: tuple[CertifiedQuantity, ...]
    signature_notices: tuple[Notice, ...] = ()

    def refusal(
        self, key: str, found: str, expected: str, declared: DeclaredNotice = CERTIFIED_VALUE_NOT_USABLE
    ) -> InputError:
        """Return the error of an element of this file."""
        return InputError(declared, self.path, key, found=found, expected=expected)


def read_dcc(path: Path) -> CalibrationCertificate:
    """Read a Digital Calibration Certificate; `InputError` naming file and element for what cannot be used.

    A file that is what it was is parsed once, however many channels and recordings name it; one that was changed so
    shortly before that another change may not show, every time.
    """
    now = FileIdentity.of(path)
    return _parsed(path, now) if now is not None and now.is_settled else _parsed.__wrapped__(path, now)


@lru_cache(maxsize=MOST_KEPT)
def _parsed(path: Path, _: FileIdentity | None) -> CalibrationCertificate:
    """Parse a certificate."""
    root = _root(path)
    administrative = root.find("{*}administrativeData")
    if administrative is None:
        raise InputError(
            INVALID_CERTIFICATE_FILE,
            path,
            "dcc:administrativeData",
            found="no such element",
            expected="the administrative data of a certificate",
        )
    number = _text(administrative.find("{*}coreData/{*}uniqueIdentifier"))
    if not number:
        raise InputError(
            INVALID_CERTIFICATE_FILE,
            path,
            "dcc:uniqueIdentifier",
            found="no such key",
            expected="the number of the certificate",
        )
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
        signature_notices=tuple(_signatures(path)),
    )


def _signatures(path: Path) -> Iterator[Notice]:
    """Yield notices of a certificate's signatures; `InputError` if it was changed after it was signed."""
    if b"xmldsig#" not in path.read_bytes():
        return
    from fusion.recording.signature import check_signatures

    found = check_signatures(_root(path, whole=True), SIGNED)
    if found.changed:
        raise InputError(
            CERTIFICATE_CHANGED, path, "ds:Signature", found=found.changed, expected="the content that was signed"
        )
    if found.unchecked:
        yield Notice(SIGNATURE_NOT_CHECKED, path.name, reason=found.unchecked)
    elif found.count:
        yield Notice(SIGNER_NOT_VERIFIED, path.name)


def _root(path: Path, *, whole: bool = False) -> Any:
    """Return the root of a file of XML, in which no entity is defined and nothing is fetched from elsewhere.

    `whole`: with comments and processing instructions.
    """
    from lxml import etree

    text = read_text(path, LARGEST, "a Digital Calibration Certificate")
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(
            INVALID_CERTIFICATE_FILE,
            path,
            found="a document type declaration",
            expected="XML without one, as a certificate has",
        )
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False,
        remove_comments=not whole, remove_pis=not whole, encoding="utf-8",
    )  # fmt: skip
    try:
        root = etree.fromstring(text.encode(), parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        told = describe(" ".join(str(error).split()), plain=True)
        raise InputError(
            INVALID_CERTIFICATE_FILE, path, found=f"damaged XML ({told})", expected="a Digital Calibration Certificate"
        ) from error
    if root.tag != ROOT:
        found = f"the element {describe(str(root.tag), plain=True)}"
        raise InputError(
            INVALID_CERTIFICATE_FILE, path, found=found, expected="dcc:digitalCalibrationCertificate, the root of a DCC"
        )
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
        raise InputError(
            INVALID_CERTIFICATE_FILE, path, key, found=f'"{_text(element)}"', expected="a day as YYYY-MM-DD"
        ) from error


def _quantities(path: Path, root: Any) -> Iterator[CertifiedQuantity]:
    """Yield every quantity with numbers of every result; those of one `group` stand in one list."""
    count, group = 0, 0
    for result in root.iterfind("{*}measurementResults/{*}measurementResult/{*}results/{*}result"):
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
                    raise InputError(
                        INVALID_CERTIFICATE_FILE,
                        path,
                        "dcc:results",
                        found="more",
                        expected=f"at most {MOST_QUANTITIES} quantities",
                    )
                for values in [child for child in element if _tag(child) in KINDS][:1]:
                    found = _quantity(path, result, element, values)
                    places = (result, data, element, *element.iterfind("{*}name/{*}content"))
                    ids = tuple(own for own in (place.get("id") for place in places) if own)
                    yield replace(found, group=own_group, ids=ids)
        group += 1


def _quantity(path: Path, result: Any, element: Any, values: Any) -> CertifiedQuantity:
    """Read one quantity; numbers that cannot be used become its `problem`."""
    about, name = _name(result), _name(element)
    reader = _Numbers(path, ", ".join(filter(None, (f'result "{about}"', f'quantity "{name}"' if name else ""))))
    try:
        found = reader.quantity(values)
    except InputError as error:
        none = np.empty(0)
        matrix = np.empty((0, 2, 2)) if _tag(values).startswith("complex") else None
        listed = _tag(values) not in ("real", "constant", "complex")
        value, unit = np.empty(0, dtype=np.complex128), _unit_of(values)
        found = CertifiedQuantity("", "", (), value, unit, none, none, none, "", matrix, 0, listed, problem=error)
    return replace(
        found,
        result=about,
        name=name,
        types=tuple(dict.fromkeys(f"{result.get('refType') or ''} {element.get('refType') or ''}".split())),
        names=tuple(dict.fromkeys(filter(None, map(_text, element.iterfind("{*}name/{*}content"))))),
        description=" ".join(filter(None, map(_text, element.iterfind("{*}description/{*}content")))),
    )


def _unit_of(values: Any) -> Unit:
    """Return the unit of a quantity whose numbers cannot be read."""
    for element in values.iter():
        if _tag(element) in ("unit", "unitXMLList", "listUnit"):
            with suppress(ValueError, IndexError):
                return parse_unit((element.text or "").split()[0])
    return NO_UNIT


@dataclass(frozen=True)
class _Numbers:
    """Reads the numbers of one quantity of a file."""

    path: Path
    where: str

    def refusal(self, tag: str, found: str, expected: str) -> InputError:
        return InputError(
            CERTIFIED_VALUE_NOT_USABLE, self.path, f"{self.where}: si:{tag}", found=found, expected=expected
        )

    def numbers(self, parent: Any, tag: str, count: int | None = None) -> FloatArray:
        """Read a list of numbers; one number stands for all `count`."""
        element = parent.find(f"{{*}}{tag}")
        texts = [] if element is None or not element.text else element.text.split()
        if not texts:
            raise self.refusal(tag, "no element", "numbers" if tag.endswith("List") else "a number")
        try:
            found = np.array([float(text) for text in texts])
        except ValueError as error:
            raise self.refusal(tag, f'"{describe(" ".join(texts), plain=True)[:60]}"', "numbers") from error
        # NaN was not measured, which is refused where it is needed.
        wrong = [value for value in found.tolist() if np.isinf(value) or (not np.isnan(value) and wrong_size(value))]
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
            raise self.refusal(tag, f"{len(texts)} units" if texts else "no unit", f"one unit, or {count}")
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
        if tag == "hybrid":
            return self._hybrid(inner)
        if tag in ("list", "realList"):
            if not inner:
                raise self.refusal(tag, "no element", "values")
            parts = [self.quantity(child) if tag == "list" else self._real(child, "", values) for child in inner]
            if len({part.unit.dimension for part in parts}) > 1:
                raise self.refusal(tag, "units of different quantities", "units that convert into each other")
            return parts[0] if len(parts) == 1 else _joined(parts)
        suffix = "XMLList" if tag.endswith("XMLList") else ""
        return self._complex(values, suffix) if tag.startswith("complex") else self._real(values, suffix)

    def _hybrid(self, inner: Sequence[Any]) -> CertifiedQuantity:
        """Read one quantity stated in several units: in the coherent SI unit, else in the first known one.

        All that can be read have to say the same.
        """
        found, wrong = list[CertifiedQuantity](), list[InputError]()
        for child in inner:
            try:
                found.append(self.quantity(child))
            except InputError as error:
                wrong.append(error)
        found = [own for own in found if own.unit.dimension != LEVEL] or found
        if not found:
            raise next(iter(wrong), self.refusal("hybrid", "no element", "values"))
        best = min(found, key=lambda own: own.unit.factor != 1.0 or own.unit.celsius)
        for own in found:
            if own.unit.dimension != best.unit.dimension or own.value.shape != best.value.shape:
                raise self.refusal("hybrid", f"{own.unit.text} and {best.unit.text}", "one quantity in several units")
            apart = np.abs(own.value - best.value) - SAME_VALUE * np.abs(best.value)
            if np.any(apart > np.nan_to_num(best.expanded)):
                row = int(np.nanargmax(apart))
                values = " and ".join(f"{abs(one.value[row]):g}" for one in (best, own))
                raise self.refusal("hybrid", f"{values} (in SI, by {best.unit.text} and {own.unit.text})", "one value")
        return best

    def _real(self, values: Any, suffix: str, around: Any = None) -> CertifiedQuantity:
        """Read `si:real`, `si:constant` or a list of real numbers; of one in a list, also what the list states."""
        value = self.numbers(values, f"value{suffix}")
        own_unit = around is None or values.find("{*}unit") is not None
        unit, factor = self.units(*((values, f"unit{suffix}") if own_unit else (around, "listUnit")), len(value))
        expanded, k, probability, shape = self._uncertainty(values, suffix, len(value))
        if around is not None and not np.any(np.isfinite(expanded)):
            shared = [child for child in around if _tag(child) in LIST_UNCERTAINTY]
            if shared:
                expanded, k, probability, shape = self._uncertainty(shared[0], suffix, len(value))
        shift = -CELSIUS_AT_0_K if unit.celsius else 0.0
        total = np.asarray(value * factor + shift, dtype=np.complex128)
        own = expanded * factor, k, probability, shape
        return CertifiedQuantity("", "", (), total, unit, *own, None, 0, bool(suffix) or len(value) > 1)

    def _uncertainty(self, values: Any, suffix: str, count: int) -> tuple[FloatArray, FloatArray, FloatArray, str]:
        """Read U with k, probability and distribution in all ways in which the D-SI states them; NaN where none is."""
        nothing = np.full(count, np.nan)
        places: tuple[tuple[str, tuple[str, ...]], ...] = (
            (f"expandedMU{suffix}", ("valueExpandedMU", "coverageFactor")),
            (f"standardMU{suffix}", ("valueStandardMU",)),
            (f"coverageIntervalMU{suffix}", ("valueStandardMU",)),
            (f"expandedUnc{suffix}", ("uncertainty", "coverageFactor")),
            (f"coverageInterval{suffix}", ("standardUnc",)),
            ("", ("valueStandardMU",)),  # of a constant
            ("", ("uncertainty",)),
        )
        # measurementUncertaintyUnivariate, which the schema misspells in lists
        holders = [values, *(child for child in values if _tag(child).startswith("measurementUncertaintyUniv"))]
        for holder, (place, tags) in ((holder, place) for place in places for holder in holders):
            element = holder.find("{*}" + place) if place else holder
            if element is None or (not place and element.find(f"{{*}}{tags[0]}") is None):
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
            if turn.dimension != NONE or not (turn.angle or turn.factor == 1.0):
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
