"""Inputs of manifests from Digital Calibration Certificates, as a user would type them."""

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
from fusion.instruments.transducer import TRANSDUCERS
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
from fusion.recording.values import ManifestBlock, PathScope, Text, describe
from shakercal._common.notices import DeclaredNotice, Notice

UNIT_OF = {
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
"""SI unit of every key with one number that a certificate may state."""
UNIT_OF_THREE = {
    **dict.fromkeys(("centre_of_mass", "internal_centre_of_mass", "point", "mirror"), "m"),
    "gravity": "m/s^2",
    "cable_stiffness": "N/m",
}
"""The same for keys with three numbers."""
ELECTRICAL = ("1", "V", "A", "C")
"""Units of the outputs of transducers and recorders."""
WIDE_K = 2.1
"""Coverage factor for 95 % above which few degrees of freedom are assumed: 1.96 to 2.0 mean infinitely many."""


Location = tuple[dict[str, Any], list[int | str]]
"""The content of a file, and a key path in it."""


class CertificateReference(ManifestBlock):
    """A table that refers to a certificate: file, result, degrees of freedom, last valid day."""

    dcc: Text
    result: str = ""
    dof: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    valid_until: Date | None = None


@dataclass
class CertifiedInputs:
    """Inputs of one manifest from certificates: its text with their values, their files, response curves.

    `files`: with their identities before reading. `errors`: of every table that cannot be used. `signature_notices`: of
    the files.
    """

    path: Path
    scope: PathScope
    sensor_unit: str
    text: dict[str, Any] = field(default_factory=dict)
    files: dict[Path, FileIdentity | None] = field(default_factory=dict)
    curves: list[UncertainInput] = field(default_factory=list)
    errors: list[InputError] = field(default_factory=list)
    signature_notices: list[Notice] = field(default_factory=list)

    def resolve(self, value: Any, whole: dict[str, Any], path: list[int | str]) -> Any:
        """Return a part of a manifest, with certified values instead of tables with `dcc`."""
        if isinstance(value, list):
            return [self.resolve(item, whole, [*path, number]) for number, item in enumerate(value)]
        if not isinstance(value, dict):
            return value
        out: dict[str, Any] = {}
        for key, item in value.items():
            key_steps = [*path, key]
            table = {"dcc": item} if key == "response" and _is_certificate(item) else item
            if table is not item and isinstance(value.get("response_result"), str):
                table["result"] = value["response_result"]
            named = table.get("dcc") if isinstance(table, dict) else None
            if named is None or named == UNFILLED or isinstance(named, dict):
                out[key] = self.resolve(item, whole, key_steps)
                continue
            try:
                out |= self._table_values(table, (whole, key_steps), value)
            except InputError as error:
                self.errors += error.each
        return out

    def _table_values(self, values: dict[str, Any], location: Location, siblings: Mapping[str, Any]) -> Any:
        """Return the values by key that replace one table."""
        whole, path = location
        table, name = checked_table(CertificateReference, values, self.path, location), str(path[-1])
        key = key_path(whole, path)
        certifiable = name in UNIT_OF or name in UNIT_OF_THREE or name in ("scale", "response", "step_amplitude")
        if not certifiable or (name == "response" and "quantity" not in siblings):
            expected = "no certificate: it can state " + ", ".join((*UNIT_OF, *UNIT_OF_THREE, "scale, step_amplitude"))
            expected += " and a channel's response"
            raise self._error(KEY_TAKES_NO_CERTIFICATE, key, "one", expected)
        if not _is_certificate(table.dcc):
            expected = f"a Digital Calibration Certificate, *{SUFFIX}"
            raise self._error(KEY_TAKES_NO_CERTIFICATE, f"{key}.dcc", describe(table.dcc), expected)
        certificate = self._certificate(table.dcc, key if name == "response" else f"{key}.dcc")
        source: dict[str, Any] = {"certificate": certificate.number, "laboratory": certificate.laboratory}
        last = [day for day in (table.valid_until, certificate.valid_until) if day is not None]
        source |= {"date": certificate.date} if certificate.date is not None else {}
        source |= {"valid_until": min(last)} if last else {}
        if name == "response":
            if table.dof is not None:
                expected = "no such key of a list over frequency"
                raise self._error(KEY_NOT_APPLICABLE, f"{key}.dof", f"{table.dof:g}", expected)
            self._curve(certificate, table, (location, source), siblings)
            return {name: table.dcc} | ({"response_result": table.result} if table.result else {})
        quantity, value, relative = self._quantity(certificate, table, key, siblings)
        k, dof = float(quantity.k[0]), table.dof
        if dof is None and k > WIDE_K and not abs(quantity.probability[0] - 0.95) > 0.01:
            from scipy.special import stdtridf

            dof = max(float(stdtridf(0.975, k)), 1.0)
        source |= {"dof": dof} if dof is not None else {}
        absolute = quantity.expanded.tolist() if len(quantity.expanded) > 1 else float(quantity.expanded[0])
        stated = {"U_relative": relative} if relative is not None else {"U": absolute}
        return {name: {"value": value, **stated, "k": k, **source}}

    def _error(self, declared: DeclaredNotice, key: str, found: str, expected: str) -> InputError:
        return InputError(declared, self.path, key, found=found, expected=expected)

    def _certificate(self, name: str, key: str) -> CalibrationCertificate:
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

    def _dimension(self, siblings: Mapping[str, Any]) -> Dimension | None:
        """Return the dimension of the channel's quantity; None if it has no SI unit."""
        quantity = siblings.get("quantity")
        unit = {"output": self.sensor_unit, "force": "N", "voltage": "V", "trigger": "1"}.get(str(quantity))
        if unit is None and str(quantity) in TRANSDUCERS:
            unit = TRANSDUCERS[str(quantity)].unit.replace("rad", "1")
        try:
            return None if unit is None else parse_unit(unit).dimension
        except ValueError:
            return None

    def _quantity(
        self, certificate: CalibrationCertificate, table: CertificateReference, key: str, siblings: Mapping[str, Any]
    ) -> tuple[CertifiedQuantity, Any, float | None]:
        """Return the quantity of a table, its value, and relative U of a reciprocal."""
        name, reciprocal = key.rsplit(".", 1)[-1], dict[Dimension, bool]()  # whether it is one, by dimension
        if name == "scale":
            mechanical = self._dimension(siblings)
            for unit in ELECTRICAL if mechanical is not None else ():
                electrical = parse_unit(unit).dimension
                over = _over(mechanical or electrical, electrical), _over(electrical, mechanical or electrical)
                for dimension, inverted in zip(over, (False, True), strict=True):
                    if reciprocal.setdefault(dimension, inverted) is not inverted:
                        reciprocal.pop(dimension)
            units = f"V, A or C per {siblings.get('quantity')} (its sensitivity), or the reciprocal of that"
        else:
            moment = str(siblings.get("component", "F")).startswith("M")
            units = {**UNIT_OF, **UNIT_OF_THREE, "step_amplitude": "N m" if moment else "N"}[name]
            reciprocal[parse_unit(units).dimension] = False
        found = self._select(certificate, table, key, (reciprocal, 3 if name in UNIT_OF_THREE else 1, units))
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

    def _select(
        self, certificate: CalibrationCertificate, table: CertificateReference, key: str,
        fits: tuple[Collection[Dimension], int, str],
    ) -> CertifiedQuantity:  # fmt: skip
        """Return the one quantity with U that fits name, dimensions and count."""
        (dimensions, count, units), file = fits, certificate.path.name
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

    def _curve(
        self, certificate: CalibrationCertificate, table: CertificateReference, at: tuple[Location, dict[str, Any]],
        siblings: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Check the frequency response of a channel, and record its source."""
        location, source = at
        key = key_path(*location)
        electrical, mechanical = [parse_unit(unit).dimension for unit in ELECTRICAL], self._dimension(siblings)
        fits = {_over(one, other) for one in electrical for other in (*electrical, mechanical) if other is not None}
        curve, read = curve_named(certificate, table.result), certified_table(certificate, table.result)
        if curve.unit.dimension not in fits:
            found = f'{curve.unit.text} (result "{curve.name}" of {certificate.path.name})'
            expected = f"a response in V, A or C, to each other or per {siblings.get('quantity')}"
            raise self._error(CERTIFIED_UNIT_MISMATCH, key, found, expected)
        relative = read.u_magnitude / read.magnitude
        stated = checked_table(
            UncertaintyStatement, {"U_relative": float(2.0 * relative.max()), "k": 2.0, **source}, self.path, location
        )
        self.curves.append(UncertainInput(self.path, key, None, relative, True, stated))


def _is_certificate(value: object) -> bool:
    """Whether a value is the file name of a certificate."""
    return isinstance(value, str) and value.lower().endswith(SUFFIX)


def _over(one: Dimension, other: Dimension) -> Dimension:
    return tuple(a - b for a, b in zip(one, other, strict=True))


def certified_inputs(text: dict[str, Any], path: Path, scope: PathScope, sensor_unit: str = "1") -> CertifiedInputs:
    """Return a manifest with values of certificates instead of `{ dcc = "file.xml", … }`."""
    found = CertifiedInputs(path, scope, sensor_unit)
    found.text = found.resolve(text, text, [])
    return found
