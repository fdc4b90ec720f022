"""Reader of Digital Calibration Certificates: quantities with U and k, number, laboratory, dates.

DCC (PTB's schema, versions 2.4 to 3.3) with D-SI. All values are converted to coherent SI units. An unusable quantity
is refused when a key names it.
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
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import DeclaredNotice, Notice

SUFFIX = ".xml"
ROOT = "{https://ptb.de/dcc}digitalCalibrationCertificate"
LARGEST = 20_000_000  # bytes
MOST_QUANTITIES = 10_000  # certificates have some 100
CACHE_SIZE = 32  # certificates
KINDS = ("real", "realList", "realListXMLList", "complex", "complexListXMLList", "hybrid", "list", "constant")
"""Elements of the D-SI with the values of a quantity."""
TABLE_INDEX = re.compile(r"\bbasic_tableIndex\d+")
"""Type of a quantity that numbers the rows of a table."""
LIST_UNCERTAINTY = ("listMeasurementUncertaintyUnivariate", "listUnivariateUnc")
SIGNED = ("{*}administrativeData", "{*}measurementResults")
"""Parts of a certificate that a signature has to cover."""
NO_UNIT = Unit(np.nan, (), "")
SAME_VALUE = 0.01
"""Relative difference that rounding explains between values of one quantity in two units."""
RECALIBRATION = re.compile(r"recalibration|valid_?until", re.IGNORECASE)
"""Types of statements with the last valid day of the certificate."""


@dataclass(frozen=True)
class CertifiedQuantity:
    """N values of a quantity in the coherent SI unit of `unit`, real or complex.

    `expanded`, `k`, `probability`: (N,) each, NaN if not stated. `covariance` (N, 2, 2): of real and imaginary part of
    complex values. `types`: words of its `refType`. `where`: result and quantity as text. `listed`: part of a list.
    `ids`: of the quantity, its result and its data. `names`: in every language. `rows` (N,): of a table with names as
    indices, joined by "per"; else empty. `problem`: the error of unusable numbers, else None. Such a quantity has no
    values, and `NO_UNIT` if its unit is not recognised.
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
    rows: tuple[str, ...] = ()
    problem: InputError | None = None

    @property
    def where(self) -> str:
        """Result and quantity as text."""
        return ", ".join(filter(None, (f'result "{self.result}"', f'quantity "{self.name}"' if self.name else "")))

    @property
    def is_real(self) -> bool:
        """Whether it has real numbers; unusable ones are treated as real."""
        return self.covariance is None and not np.any(np.nan_to_num(self.value.imag))

    @property
    def words(self) -> str:
        """Types and names, in small letters, `phaseLag` as `phase lag`."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])|_", " ", " ".join((*self.types, *self.names))).lower()

    def is_named(self, name: str) -> bool:
        """Whether a name is one of this quantity or of its result."""
        return name in (self.result, self.name, *self.names, *self.types, *self.ids)

    def in_one_of(self, dimensions: Collection[Dimension]) -> CertifiedQuantity | None:
        r"""Return the quantity if either reading of its unit has one of some dimensions."""
        if self.unit.dimension in dimensions:
            return self
        other = self.unit.other
        if other is None or other.dimension not in dimensions:
            return None
        factor = other.factor / self.unit.factor
        return replace(self, unit=other, value=self.value * factor, expanded=self.expanded * factor)

    def at_row(self, row: str) -> CertifiedQuantity:
        """Return the quantity in the rows of a name; its result has this name, too."""
        if len(self.rows) != len(self.value):
            return self
        rows = np.array(self.rows) == row
        cut = {name: getattr(self, name)[rows] for name in ("value", "expanded", "k", "probability")}
        covariance = None if self.covariance is None else self.covariance[rows]
        return replace(self, **cut, covariance=covariance, rows=(), result=f"{self.result}, {row}")

    def usable(self) -> CertifiedQuantity:
        """Return the quantity; raise the error of its numbers."""
        if self.problem is not None:
            raise self.problem
        return self


@dataclass(frozen=True)
class CalibrationCertificate:
    """The content of a DCC: number, laboratory, date, last valid day, quantities, notices of signatures."""

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
    """Read a Digital Calibration Certificate; `InputError` with file and element for errors.

    An unchanged file is parsed once for all channels and recordings. A file that changed within the resolution of file
    times is parsed every time.
    """
    now = FileIdentity.of(path)
    return _parsed(path, now) if now is not None and now.is_settled else _parsed.__wrapped__(path, now)


@lru_cache(maxsize=CACHE_SIZE)
def _parsed(path: Path, _: FileIdentity | None) -> CalibrationCertificate:
    """Return the content of a certificate."""
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
            found="no number",
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
    """Yield notices of a certificate's signatures; `InputError` if it was changed after signing."""
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
    """Return the root of an XML file without entity definitions and external references.

    `whole`: with comments and processing instructions.
    """
    from lxml import etree

    text = read_text(path, LARGEST, "a Digital Calibration Certificate")
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(
            INVALID_CERTIFICATE_FILE,
            path,
            found="a document type declaration",
            expected="XML without one",
        )
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False,
        remove_comments=not whole, remove_pis=not whole, encoding="utf-8",
    )  # fmt: skip
    try:
        root = etree.fromstring(text.encode(), parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        reason = describe(" ".join(str(error).split()), plain=True)
        raise InputError(
            INVALID_CERTIFICATE_FILE,
            path,
            found=f"damaged XML ({reason})",
            expected="a Digital Calibration Certificate",
        ) from error
    if root.tag != ROOT:
        found = f"the element {describe(str(root.tag), plain=True)}"
        raise InputError(
            INVALID_CERTIFICATE_FILE, path, found=found, expected="dcc:digitalCalibrationCertificate, the root of a DCC"
        )
    return root


def _text(element: Any) -> str:
    """Return the text of an element, empty if there is none."""
    return "" if element is None else describe(" ".join((element.text or "").split()), plain=True)


def _name(element: Any) -> str:
    """Return the name of an element in English, else in its first language."""
    contents = element.findall("{*}name/{*}content")
    english = [content for content in contents if content.get("lang") == "en"]
    return next(filter(None, map(_text, english + contents)), "")


def _tag(element: Any) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _day(path: Path, element: Any) -> Date | None:
    """Return the date of an element, None if there is none."""
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
    """Yield every quantity with numbers of every result; those of one list have one `group`."""
    count, group = 0, 0
    for result in root.iterfind("{*}measurementResults/{*}measurementResult/{*}results/{*}result"):
        data = result.find("{*}data")
        waiting = [] if data is None else [(child, group) for child in data]
        while waiting:
            element, element_group = waiting.pop(0)
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
                    sources = (result, data, element, *element.iterfind("{*}name/{*}content"))
                    ids = tuple(name for name in (source.get("id") for source in sources) if name)
                    rows = _rows(element.getparent()) if element_group else ()
                    yield replace(found, group=element_group, ids=ids, rows=rows)
        group += 1


def _rows(table: Any) -> tuple[str, ...]:
    """Return the names of a table's rows by its indices of texts, if any."""
    indices = [
        (match[0], (texts.text or "").split())
        for quantity in table.iterfind("{*}quantity")
        if (match := TABLE_INDEX.search(quantity.get("refType") or "")) is not None
        and (texts := quantity.find("{*}charsXMLList")) is not None
    ]
    named = [texts for _, texts in sorted(indices)]
    return tuple(map(" per ".join, zip(*named, strict=True))) if len(set(map(len, named))) == 1 else ()


def _quantity(path: Path, result: Any, element: Any, values: Any) -> CertifiedQuantity:
    """Read one quantity; errors of its numbers become its `problem`."""
    title, name = _name(result), _name(element)
    reader = _Numbers(path, ", ".join(filter(None, (f'result "{title}"', f'quantity "{name}"' if name else ""))))
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
        result=title,
        name=name,
        types=tuple(dict.fromkeys(f"{result.get('refType') or ''} {element.get('refType') or ''}".split())),
        names=tuple(dict.fromkeys(filter(None, map(_text, element.iterfind("{*}name/{*}content"))))),
        description=" ".join(filter(None, map(_text, element.iterfind("{*}description/{*}content")))),
    )


def _unit_of(values: Any) -> Unit:
    """Return the unit of a quantity with unreadable numbers."""
    for element in values.iter():
        if _tag(element) in ("unit", "unitXMLList", "listUnit"):
            with suppress(ValueError, IndexError):
                return parse_unit((element.text or "").split()[0])
    return NO_UNIT


@dataclass(frozen=True)
class _Numbers:
    """Reader of the numbers of one quantity."""

    path: Path
    where: str

    def refusal(self, tag: str, found: str, expected: str) -> InputError:
        return InputError(
            CERTIFIED_VALUE_NOT_USABLE, self.path, f"{self.where}: si:{tag}", found=found, expected=expected
        )

    def numbers(self, parent: Any, tag: str, count: int | None = None) -> FloatArray:
        """Read a list of numbers; one number represents all `count`."""
        element = parent.find(f"{{*}}{tag}")
        texts = [] if element is None or not element.text else element.text.split()
        if not texts:
            raise self.refusal(tag, "no element", "numbers" if tag.endswith("List") else "a number")
        try:
            found = np.array([float(text) for text in texts])
        except ValueError as error:
            raise self.refusal(tag, f'"{describe(" ".join(texts), plain=True)[:60]}"', "numbers") from error
        # NaN was not measured; it is refused if it is used.
        wrong = [value for value in found.tolist() if np.isinf(value) or (not np.isnan(value) and wrong_size(value))]
        if wrong:
            raise self.refusal(tag, f"{wrong[0]:g}", wrong_size(wrong[0]) or "finite numbers")
        if count is not None and len(found) not in (1, count):
            raise self.refusal(tag, f"{len(found)} numbers", f"{count} numbers, one per value")
        return found if count is None or len(found) == count else np.full(count, found[0])

    def units(self, parent: Any, tag: str, count: int) -> tuple[Unit, FloatArray]:
        """Return the unit of `count` values, and the factor of each to SI."""
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
        """Read one quantity stated in several units, preferably in the coherent SI unit.

        All readable values must agree.
        """
        found, wrong = list[CertifiedQuantity](), list[InputError]()
        for child in inner:
            try:
                found.append(self.quantity(child))
            except InputError as error:
                wrong.append(error)
        found = [one for one in found if one.unit.dimension != LEVEL] or found
        if not found:
            raise next(iter(wrong), self.refusal("hybrid", "no element", "values"))
        best = min(found, key=lambda one: one.unit.factor != 1.0 or one.unit.celsius)
        for other in found:
            if other.unit.dimension != best.unit.dimension or other.value.shape != best.value.shape:
                raise self.refusal("hybrid", f"{other.unit.text} and {best.unit.text}", "one quantity in several units")
            excess = np.abs(other.value - best.value) - SAME_VALUE * np.abs(best.value)
            if np.any(excess > np.nan_to_num(best.expanded)):
                row = int(np.nanargmax(excess))
                values = " and ".join(f"{abs(one.value[row]):g}" for one in (best, other))
                raise self.refusal(
                    "hybrid", f"{values} (in SI, by {best.unit.text} and {other.unit.text})", "one value"
                )
        return best

    def _real(self, values: Any, suffix: str, around: Any = None) -> CertifiedQuantity:
        """Read `si:real`, `si:constant` or a list of real numbers, with the statements `around` it."""
        value = self.numbers(values, f"value{suffix}")
        has_unit = around is None or values.find("{*}unit") is not None
        unit, factor = self.units(*((values, f"unit{suffix}") if has_unit else (around, "listUnit")), len(value))
        expanded, k, probability, shape = self._uncertainty(values, suffix, len(value))
        if around is not None and not np.any(np.isfinite(expanded)):
            shared = [child for child in around if _tag(child) in LIST_UNCERTAINTY]
            if shared:
                expanded, k, probability, shape = self._uncertainty(shared[0], suffix, len(value))
        shift = -CELSIUS_AT_0_K if unit.celsius else 0.0
        total = np.asarray(value * factor + shift, dtype=np.complex128)
        stated = expanded * factor, k, probability, shape
        return CertifiedQuantity("", "", (), total, unit, *stated, None, 0, bool(suffix) or len(value) > 1)

    def _uncertainty(self, values: Any, suffix: str, count: int) -> tuple[FloatArray, FloatArray, FloatArray, str]:
        """Read U, k, probability and distribution of any form, NaN if not stated."""
        none = np.full(count, np.nan)
        forms: tuple[tuple[str, tuple[str, ...]], ...] = (
            (f"expandedMU{suffix}", ("valueExpandedMU", "coverageFactor")),
            (f"standardMU{suffix}", ("valueStandardMU",)),
            (f"coverageIntervalMU{suffix}", ("valueStandardMU",)),
            (f"expandedUnc{suffix}", ("uncertainty", "coverageFactor")),
            (f"coverageInterval{suffix}", ("standardUnc",)),
            ("", ("valueStandardMU",)),  # of a constant
            ("", ("uncertainty",)),
        )
        # measurementUncertaintyUnivariate, misspelt by the schema in lists
        holders = [values, *(child for child in values if _tag(child).startswith("measurementUncertaintyUniv"))]
        for holder, (name, tags) in ((holder, form) for form in forms for holder in holders):
            element = holder.find("{*}" + name) if name else holder
            if element is None or (not name and element.find(f"{{*}}{tags[0]}") is None):
                continue
            expanded = self.numbers(element, f"{tags[0]}{suffix}", count)
            k = self.numbers(element, f"{tags[1]}{suffix}", count) if len(tags) > 1 else np.ones(count)
            if np.any(expanded < 0.0) or np.any(k < 1.0):
                tag, limit = (tags[0], "0") if np.any(expanded < 0.0) else (tags[1], "1")
                found = expanded.min() if limit == "0" else k.min()
                raise self.refusal(f"{tag}{suffix}", f"{found:g}", f"numbers of at least {limit}")
            stated = len(tags) > 1 and element.find(f"{{*}}coverageProbability{suffix}") is not None
            probability = self.numbers(element, f"coverageProbability{suffix}", count) if stated else none
            return expanded, k, probability, _text(element.find(f"{{*}}distribution{suffix}"))
        return none, none, none, ""

    def _complex(self, values: Any, suffix: str) -> CertifiedQuantity:
        """Read complex numbers, Cartesian with their covariance, or polar."""
        polar = values.find(f"{{*}}valueMagnitude{suffix}") is not None
        tags = ("valueMagnitude", "valuePhase") if polar else ("valueReal", "valueImag")
        first = self.numbers(values, tags[0] + suffix)
        second = self.numbers(values, tags[1] + suffix)
        if len(first) != len(second):
            raise self.refusal(tags[1] + suffix, f"{len(second)} numbers", f"{len(first)}, the number of {tags[0]}")
        unit, factor = self.units(values, f"unit{suffix}", len(first))
        if polar:
            turn, radian = self.units(values, f"unitPhase{suffix}", len(first))
            if turn.dimension != NONE or not (turn.angle or turn.factor == 1.0):
                raise self.refusal(f"unitPhase{suffix}", turn.text, "a unit of an angle")
            value = first * np.exp(1j * second * radian)
        else:
            value = first + 1j * second
        covariance, none = (
            None if polar else self._covariance(values, suffix, len(first), unit),
            np.full(len(first), np.nan),
        )
        return CertifiedQuantity(
            "", "", (), np.asarray(value * factor), unit, none, none, none, "",
            covariance, 0, bool(suffix),
        )  # fmt: skip

    def _covariance(self, values: Any, suffix: str, count: int, unit: Unit) -> FloatArray | None:
        """Read covariance matrices (N, 2, 2) in SI, None for other units."""
        matrix = values.find(f".//{{*}}covarianceMatrix{suffix}")
        if matrix is None:
            return None
        cells = matrix.findall(f"{{*}}column{suffix}/{{*}}covariance{suffix}")
        if len(cells) != 4:
            raise self.refusal(f"covarianceMatrix{suffix}", f"{len(cells)} elements", "2 columns of 2")
        units = [self.units(cell, f"unit{suffix}", count) for cell in cells]
        if any(cell.dimension != tuple(2 * power for power in unit.dimension) for cell, _ in units):
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
