"""Manifests with the values of Digital Calibration Certificates instead of references to them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import date as Date
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydantic_core import PydanticCustomError

from fusion.base import FileIdentity
from fusion.errors import InputError
from fusion.recording.dcc import SUFFIX, CalibrationCertificate, CertifiedQuantity, read_dcc
from fusion.recording.dcc_curves import curve_named, in_hertz
from fusion.recording.dsi import CELSIUS_AT_0_K, Dimension, parse_unit
from fusion.recording.recording_notices import (
    CERTIFIED_RESULT_NOT_FOUND,
    CERTIFIED_UNIT_MISMATCH,
    CONTRADICTING_VALUES,
    KEY_NOT_APPLICABLE,
    KEY_TAKES_NO_CERTIFICATE,
    MISSING_FILE,
    UNREADABLE_FILE,
)
from fusion.recording.response import certified_table
from fusion.recording.toml import UNFILLED, UncertainInput, UncertaintyStatement, checked_table, key_path
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.values import ManifestBlock, PathScope, Text, describe
from shakercal._common.notices import DeclaredNotice, Notice

SCALAR_UNITS = {
    **dict.fromkeys(("mass", "internal_mass", "tip_mass"), "kg"),
    **dict.fromkeys(("length", "diameter", "inner_diameter", "thickness", "clamped_diameter"), "m"),
    **dict.fromkeys(("frequency", "axial_frequency", "bending_frequency"), "Hz"),
    **dict.fromkeys(("damping", "poisson_ratio"), "1"),
    "young_modulus": "Pa",
    "density": "kg/m^3",
    "delay": "s",
    "temperature_coefficient": "1/K",
    "sensor_temperature": "K",
}
"""SI unit of each key with one number that a certificate can state."""
VECTOR_UNITS = {
    **dict.fromkeys(("centre_of_mass", "internal_centre_of_mass", "point", "mirror"), "m"),
    "gravity": "m/s^2",
    "cable_stiffness": "N/m",
}
"""SI unit of each key with three numbers (x, y, z) that a certificate can state."""
ELECTRICAL_UNITS = ("1", "V", "A", "C")
"""Units of the electrical outputs of transducers and of recorders; 1 for a normalised output."""
MAX_NORMAL_K = 2.1
"""Largest coverage factor for 95 % with infinite degrees of freedom; those of a larger k follow from Student's t."""


KeyLocation = tuple[dict[str, Any], list[int | str]]
"""The parsed content of a file, and the steps of a key path in it."""


class CertificateReference(ManifestBlock):
    """A table that refers to a certificate: file, result, degrees of freedom, last valid day."""

    dcc: Text
    result: str = ""
    dof: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    valid_until: Date | None = None


@dataclass
class CertifiedInputs:
    """One manifest with the values of certificates instead of references to them.

    `path`, `scope`, `sensor_unit`: file of the manifest, folder of its certificates, unit of the sensor's output.
    `text`: parsed content with the values. `files`: certificates with their identities before reading. `curves`:
    sources and uncertainties of frequency responses. `errors`: of each table that cannot be used. `signature_notices`:
    of the certificates.
    """

    path: Path
    scope: PathScope
    sensor_unit: str
    text: dict[str, Any] = field(default_factory=dict)
    files: dict[Path, FileIdentity | None] = field(default_factory=dict)
    curves: list[UncertainInput] = field(default_factory=list)
    errors: list[InputError] = field(default_factory=list)
    signature_notices: list[Notice] = field(default_factory=list)

    def resolve(self, value: Any, content: dict[str, Any], steps: list[int | str]) -> Any:
        """Return a part of the manifest with certified values instead of tables with `dcc`.

        `value`: the part, at the key path `steps` of `content`.
        """
        if isinstance(value, list):
            return [self.resolve(item, content, [*steps, number]) for number, item in enumerate(value)]
        if not isinstance(value, dict):
            return value
        out: dict[str, Any] = {}
        for key, item in value.items():
            key_steps = [*steps, key]
            table = {"dcc": item} if key == "response" and _is_certificate(item) else item
            if table is not item and isinstance(value.get("response_result"), str):
                table["result"] = value["response_result"]
            named = table.get("dcc") if isinstance(table, dict) else None
            if named is None or named == UNFILLED or isinstance(named, dict):
                out[key] = self.resolve(item, content, key_steps)
                continue
            try:
                out |= self._table_values(table, (content, key_steps), value)
            except InputError as error:
                self.errors += error.each
        return out

    def _table_values(
        self, values: dict[str, Any], location: KeyLocation, siblings: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the certified values, by key, that replace one table with `dcc`."""
        table, name = checked_table(CertificateReference, values, self.path, location), str(location[1][-1])
        key = key_path(*location)
        certifiable = name in SCALAR_UNITS or name in VECTOR_UNITS or name in ("scale", "response", "step_amplitude")
        if not certifiable or (name == "response" and "quantity" not in siblings):
            keys = ", ".join((*SCALAR_UNITS, *VECTOR_UNITS, "scale", "step_amplitude"))
            expected = f"a number without certificate (certificates can state {keys} and a channel's response)"
            raise self._error(KEY_TAKES_NO_CERTIFICATE, key, "a certificate", expected)
        if not _is_certificate(table.dcc):
            expected = f"a Digital Calibration Certificate, *{SUFFIX}"
            raise self._error(KEY_TAKES_NO_CERTIFICATE, f"{key}.dcc", describe(table.dcc), expected)
        certificate = self._read_certificate(table.dcc, key if name == "response" else f"{key}.dcc")
        source: dict[str, Any] = {"certificate": certificate.number, "laboratory": certificate.laboratory}
        last_days = [day for day in (table.valid_until, certificate.valid_until) if day is not None]
        source |= {"date": certificate.date} if certificate.date is not None else {}
        source |= {"valid_until": min(last_days)} if last_days else {}
        if name == "response":
            if table.dof is not None:
                expected = "no dof of a response over frequency"
                raise self._error(KEY_NOT_APPLICABLE, f"{key}.dof", f"{table.dof:g}", expected)
            self._add_curve(certificate, table, (location, source), siblings)
            return {name: table.dcc} | ({"response_result": table.result} if table.result else {})
        quantity, value, relative = self._find_quantity(certificate, table, key, siblings)
        k, dof = float(quantity.k[0]), table.dof
        if dof is None and k > MAX_NORMAL_K and not abs(quantity.probability[0] - 0.95) > 0.01:
            from scipy.special import stdtridf

            dof = max(float(stdtridf(0.975, k)), 1.0)
        source |= {"dof": dof} if dof is not None else {}
        absolute = quantity.expanded.tolist() if len(quantity.expanded) > 1 else float(quantity.expanded[0])
        stated = {"U_relative": relative} if relative is not None else {"U": absolute}
        return {name: {"value": value, **stated, "k": k, **source}}

    def _error(self, declared: DeclaredNotice, key: str, found: str, expected: str) -> InputError:
        return InputError(declared, self.path, key, found=found, expected=expected)

    def _read_certificate(self, name: str, key: str) -> CalibrationCertificate:
        """Read the certificate at a path, and record the identity of its file before reading."""
        try:
            path = self.scope.file(name)
        except PydanticCustomError as error:
            context = error.context or {}
            found, expected = str(context.get("found")), str(context.get("expected"))
            raise self._error(context.get("declared", MISSING_FILE), key, found, expected) from error
        except OSError as error:
            raise self._error(UNREADABLE_FILE, key, error.strerror or str(error), "a path that can be read") from error
        self.files.setdefault(path, FileIdentity.of(path))
        certificate = read_dcc(path)
        self.signature_notices += certificate.signature_notices
        return certificate

    def _mechanical_dimension(self, siblings: Mapping[str, Any]) -> Dimension | None:
        """Return the dimension of the quantity that a channel measures; None without SI unit."""
        quantity = siblings.get("quantity")
        unit = {"output": self.sensor_unit, "force": "N", "voltage": "V", "trigger": "1"}.get(str(quantity))
        if unit is None and str(quantity) in TRANSDUCERS:
            unit = TRANSDUCERS[str(quantity)].unit.replace("rad", "1")
        try:
            return None if unit is None else parse_unit(unit).dimension
        except ValueError:
            return None

    def _find_quantity(
        self, certificate: CalibrationCertificate, table: CertificateReference, key: str, siblings: Mapping[str, Any]
    ) -> tuple[CertifiedQuantity, Any, float | None]:
        """Return the certified quantity, the key's value in SI, and relative U if inverted.

        A `scale` is a mechanical quantity over an electrical one. A sensitivity is the reciprocal of that.
        """
        name = key.rsplit(".", 1)[-1]
        reciprocal = dict[Dimension, bool]()  # whether a certified quantity of this dimension is to be inverted
        if name == "scale":
            mechanical = self._mechanical_dimension(siblings)
            for unit in ELECTRICAL_UNITS if mechanical is not None else ():
                electrical = parse_unit(unit).dimension
                over = _quotient(mechanical or electrical, electrical), _quotient(electrical, mechanical or electrical)
                for dimension, inverted in zip(over, (False, True), strict=True):
                    if reciprocal.setdefault(dimension, inverted) is not inverted:
                        reciprocal.pop(dimension)
            units = f"V, A or C per {siblings.get('quantity')} (sensitivity), or its reciprocal"
        else:
            moment = str(siblings.get("component", "F")).startswith("M")
            units = {**SCALAR_UNITS, **VECTOR_UNITS, "step_amplitude": "N m" if moment else "N"}[name]
            reciprocal[parse_unit(units).dimension] = False
        found = self._select_quantity(certificate, table, key, (reciprocal, 3 if name in VECTOR_UNITS else 1, units))
        found = in_hertz(certificate, found) if units == "Hz" else found
        conventional = "conventional" in " ".join((*found.types, found.name)).lower()
        if name == "mass" and conventional and siblings.get("mass_kind", "true") != "conventional":
            expected = f'mass_kind = "conventional" and the density, or a true mass in {certificate.path.name}'
            raise self._error(CONTRADICTING_VALUES, key, f"a conventional mass ({found.where})", expected)
        value = found.value.real - (-CELSIUS_AT_0_K if name == "sensor_temperature" else 0.0)
        if not reciprocal[found.unit.dimension]:
            return found, value.tolist() if len(value) > 1 else float(value[0]), None
        if value[0] == 0.0:
            raise certificate.refusal(found.where, "0", "a sensitivity other than 0")
        return found, float(1.0 / value[0]), float(found.expanded[0] / abs(value[0]))

    def _select_quantity(
        self, certificate: CalibrationCertificate, table: CertificateReference, key: str,
        required: tuple[Collection[Dimension], int, str],
    ) -> CertifiedQuantity:  # fmt: skip
        """Return the only quantity with U and with required name, dimension and count."""
        (dimensions, count, units), file = required, certificate.path.name
        real = [q for q in certificate.quantities if q.is_real]
        named = [q for q in real if not table.result or q.is_named(table.result)]
        if not named:
            available = ", ".join(dict.fromkeys(f'"{q.result or q.name}"' for q in real[:8])) or "none"
            found = f'"{table.result}"' if table.result else "no result with numbers"
            expected = f"a result of {file}, which has {available}"
            raise self._error(CERTIFIED_RESULT_NOT_FOUND, f"{key}.result", found, expected)
        fitting = [converted for q in named if (converted := q.in_one_of(dimensions)) is not None]
        if not fitting:
            unusable = [q for q in named if q.problem is not None]
            if unusable and (table.result or len(unusable) == len(named)):
                unusable[0].usable()
            stated = ", ".join(dict.fromkeys(q.unit.text for q in named[:8] if q.unit.text))
            found = f"{stated} ({named[0].where} of {file})"
            raise self._error(CERTIFIED_UNIT_MISMATCH, key, found, f"a quantity in {units}")
        sized = [q for q in fitting if len(q.value) == count or q.problem is not None]
        if not sized:
            found = f"a list of {len(fitting[0].value)} ({fitting[0].where} of {file})"
            expected = f"{count} numbers" if count > 1 else "a result with one value"
            raise self._error(CERTIFIED_UNIT_MISMATCH, key, found, expected)
        if len(sized) > 1:
            where = "; ".join(q.where for q in sized[:4])
            expected = f"the id, name or type of one of the {len(sized)} results in {units} of {file} ({where})"
            found = f'"{table.result}"' if table.result else "no name"
            raise self._error(CERTIFIED_RESULT_NOT_FOUND, f"{key}.result", found, expected)
        selected = sized[0].usable()
        if np.any(np.isnan(selected.value)):
            raise certificate.refusal(selected.where, "nan", "finite numbers" if count > 1 else "a finite number")
        if not np.all(np.isfinite(selected.expanded / selected.k)):
            raise certificate.refusal(selected.where, "no uncertainty", "U with its coverage factor")
        if np.ptp(selected.k) > 0.0:
            raise certificate.refusal(selected.where, "several coverage factors", "one for all three numbers")
        return selected

    def _add_curve(
        self, certificate: CalibrationCertificate, table: CertificateReference, at: tuple[KeyLocation, dict[str, Any]],
        siblings: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Add source and uncertainty of a channel's frequency response to `curves`."""
        location, source = at
        key = key_path(*location)
        electrical = [parse_unit(unit).dimension for unit in ELECTRICAL_UNITS]
        mechanical = self._mechanical_dimension(siblings)
        divisors = electrical if mechanical is None else [*electrical, mechanical]
        valid = {_quotient(one, other) for one in electrical for other in divisors}
        curve, read = curve_named(certificate, table.result), certified_table(certificate, table.result)
        if curve.unit.dimension not in valid:
            found = f'{curve.unit.text} (result "{curve.name}" of {certificate.path.name})'
            expected = f"a response in V, A or C per {siblings.get('quantity')}, or a ratio of two of these units"
            raise self._error(CERTIFIED_UNIT_MISMATCH, key, found, expected)
        relative = read.u_magnitude / read.magnitude
        stated = checked_table(
            UncertaintyStatement, {"U_relative": float(2.0 * relative.max()), "k": 2.0, **source}, self.path, location
        )
        self.curves.append(UncertainInput(self.path, key, None, relative, True, stated))


def _is_certificate(value: object) -> bool:
    """Return whether a value is the file name of a certificate."""
    return isinstance(value, str) and value.lower().endswith(SUFFIX)


def _quotient(numerator: Dimension, denominator: Dimension) -> Dimension:
    return tuple(a - b for a, b in zip(numerator, denominator, strict=True))


def resolve_certificates(text: dict[str, Any], path: Path, scope: PathScope, sensor_unit: str = "1") -> CertifiedInputs:
    """Return a manifest with certified values instead of `{ dcc = "file.xml", … }`."""
    found = CertifiedInputs(path, scope, sensor_unit)
    found.text = found.resolve(text, text, [])
    return found
