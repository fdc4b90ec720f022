"""Inputs that manifests take from Digital Calibration Certificates, put into the words in which a user types them."""

from __future__ import annotations

from collections.abc import Mapping
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
from fusion.recording.response import certified_table
from fusion.recording.toml import UNFILLED, UncertainInput, UncertaintyStatement, checked_table, key_path
from fusion.recording.values import ManifestBlock, PathScope, Text, describe
from shakercal._common.notices import Notice

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
"""What a certificate may state of a key with one number, in SI."""
UNIT_OF_THREE = {
    **dict.fromkeys(("centre_of_mass", "internal_centre_of_mass", "point", "mirror"), "m"),
    "gravity": "m/s^2",
    "cable_stiffness": "N/m",
}
"""The same of three numbers."""
ELECTRICAL = ("1", "V", "A", "C")
"""In what a recorder's or a transducer's output may be."""
WIDE_K = 2.1
"""Above it a coverage factor of 95 % tells of few degrees of freedom."""


At = tuple[dict[str, Any], list[int | str]]
"""A whole file, and a place in it."""


class CertificateReference(ManifestBlock):
    """A table at a key whose value stands in a certificate: which file, which of its results, until when it holds."""

    dcc: Text
    result: str = ""
    dof: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    valid_until: Date | None = None


@dataclass
class CertifiedInputs:
    """What the certificates of one manifest say: its text without them, their files, the curves that channels follow.

    `files`: with what they were before they were read. `wrong`: every table that cannot be used. `signed`: notices of
    the signatures of the files.
    """

    path: Path
    scope: PathScope
    sensor_unit: str
    text: dict[str, Any] = field(default_factory=dict)
    files: dict[Path, FileIdentity | None] = field(default_factory=dict)
    curves: list[UncertainInput] = field(default_factory=list)
    errors: list[InputError] = field(default_factory=list)
    signature_notices: list[Notice] = field(default_factory=list)

    def replaced(self, value: Any, whole: dict[str, Any], place: list[int | str]) -> Any:
        """Return a part of a manifest, tables with `dcc` replaced by what the certificate states."""
        if isinstance(value, list):
            return [self.replaced(item, whole, [*place, number]) for number, item in enumerate(value)]
        if not isinstance(value, dict):
            return value
        out: dict[str, Any] = {}
        for key, item in value.items():
            here = [*place, key]
            own = {"dcc": item} if key == "response" and _is_certificate(item) else item
            if own is not item and isinstance(value.get("response_result"), str):
                own["result"] = value["response_result"]
            named = own.get("dcc") if isinstance(own, dict) else None
            if named is None or named == UNFILLED or isinstance(named, dict):
                out[key] = self.replaced(item, whole, here)
                continue
            try:
                out |= self._taken(own, (whole, here), value)
            except InputError as error:
                self.errors += error.each
        return out

    def _taken(self, own: dict[str, Any], at: At, beside: Mapping[str, Any]) -> Any:
        """Return what stands in the place of one table, by key."""
        whole, place = at
        table, name = checked_table(CertificateReference, own, self.path, at), str(place[-1])
        key = key_path(whole, place)
        known = name in UNIT_OF or name in UNIT_OF_THREE or name in ("scale", "response", "step_amplitude")
        if not known or (name == "response" and "quantity" not in beside):
            expected = "no certificate: it can state " + ", ".join((*UNIT_OF, *UNIT_OF_THREE, "scale, step_amplitude"))
            raise InputError(self.path, key, "one", expected + " and a channel's response")
        if not _is_certificate(table.dcc):
            raise InputError(
                self.path, f"{key}.dcc", describe(table.dcc), f"a Digital Calibration Certificate, *{SUFFIX}"
            )
        certificate = self._certificate(table.dcc, key if name == "response" else f"{key}.dcc")
        source: dict[str, Any] = {"certificate": certificate.number, "laboratory": certificate.laboratory}
        last = [day for day in (table.valid_until, certificate.valid_until) if day is not None]
        source |= {"date": certificate.date} if certificate.date is not None else {}
        source |= {"valid_until": min(last)} if last else {}
        if name == "response":
            if table.dof is not None:
                raise InputError(self.path, f"{key}.dof", f"{table.dof:g}", "no such key of a list over frequency")
            self._curve(certificate, table, (at, source), beside)
            return {name: table.dcc} | ({"response_result": table.result} if table.result else {})
        quantity, value, relative = self._quantity(certificate, table, key, beside)
        k, dof = float(quantity.k[0]), table.dof
        if dof is None and k > WIDE_K and not abs(quantity.probability[0] - 0.95) > 0.01:
            from scipy.special import stdtridf

            dof = max(float(stdtridf(0.975, k)), 1.0)
        source |= {"dof": dof} if dof is not None else {}
        own_u = quantity.expanded.tolist() if len(quantity.expanded) > 1 else float(quantity.expanded[0])
        stated = {"U_relative": relative} if relative is not None else {"U": own_u}
        return {name: {"value": value, **stated, "k": k, **source}}

    def _certificate(self, name: str, key: str) -> CalibrationCertificate:
        """Read the certificate that a path leads to, and keep what it was before."""
        try:
            path = self.scope.file(name)
        except PydanticCustomError as error:
            told = error.context or {}
            raise InputError(self.path, key, str(told.get("found")), str(told.get("expected"))) from error
        except OSError as error:
            raise InputError(self.path, key, error.strerror or str(error), "a path that can be read") from error
        self.files.setdefault(path, FileIdentity.of(path))
        certificate = read_dcc(path)
        self.signature_notices += certificate.signature_notices
        return certificate

    def _dimension(self, beside: Mapping[str, Any]) -> Dimension | None:
        """Return of what a channel's scale or response makes electrical quantities; None where that is no SI unit."""
        quantity = beside.get("quantity")
        unit = {"output": self.sensor_unit, "force": "N", "voltage": "V", "trigger": "1"}.get(str(quantity))
        if unit is None and str(quantity) in TRANSDUCERS:
            unit = TRANSDUCERS[str(quantity)].unit.replace("rad", "1")
        try:
            return None if unit is None else parse_unit(unit).dimension
        except ValueError:
            return None

    def _quantity(
        self, certificate: CalibrationCertificate, table: CertificateReference, key: str, beside: Mapping[str, Any]
    ) -> tuple[CertifiedQuantity, Any, float | None]:
        """Return the quantity that a table means, its value for the key, and U relative to it where it is inverted."""
        name, ways = key.rsplit(".", 1)[-1], dict[Dimension, bool]()  # by dimension: whether it is the reciprocal
        if name == "scale":
            across = self._dimension(beside)
            for unit in ELECTRICAL if across is not None else ():
                below = parse_unit(unit).dimension
                for way, inverted in ((_over(across or below, below), False), (_over(below, across or below), True)):
                    if ways.setdefault(way, inverted) is not inverted:
                        ways.pop(way)
            told = f"V, A or C per {beside.get('quantity')} (its sensitivity), or the reciprocal of that"
        else:
            moment = str(beside.get("component", "F")).startswith("M")
            told = {**UNIT_OF, **UNIT_OF_THREE, "step_amplitude": "N m" if moment else "N"}[name]
            ways[parse_unit(told).dimension] = False
        found = self._picked(certificate, table, key, (ways, 3 if name in UNIT_OF_THREE else 1, told))
        found = in_hertz(certificate, found) if told == "Hz" else found
        conventional = "conventional" in " ".join((*found.types, found.name)).lower()
        if name == "mass" and conventional and beside.get("mass_kind", "true") != "conventional":
            expected = f'mass_kind = "conventional" and the density, or a true mass in {certificate.path.name}'
            raise InputError(self.path, key, f"a conventional mass ({found.where})", expected)
        value = found.value.real - (-CELSIUS_AT_0_K if name == "sensor_temperature" else 0.0)
        if not ways[found.unit.dimension]:
            return found, value.tolist() if len(value) > 1 else float(value[0]), None
        if value[0] == 0.0:
            raise certificate.refusal(found.where, "0", "a sensitivity other than 0")
        return found, float(1.0 / value[0]), float(found.expanded[0] / abs(value[0]))

    def _picked(
        self, certificate: CalibrationCertificate, table: CertificateReference, key: str,
        fits: tuple[Mapping[Dimension, bool], int, str],
    ) -> CertifiedQuantity:  # fmt: skip
        """Return the one quantity of a certificate that a name, or its unit, picks; it has to have an uncertainty."""
        (ways, count, told), file = fits, certificate.path.name
        real = [q for q in certificate.quantities if q.is_real]
        named = [q for q in real if not table.result or q.is_named(table.result)]
        if not named:
            known = ", ".join(dict.fromkeys(f'"{q.result or q.name}"' for q in real[:8])) or "none"
            found = f'"{table.result}"' if table.result else "no result with numbers"
            raise InputError(self.path, f"{key}.result", found, f"a result of {file}, which has {known}")
        fitting = [own for q in named if (own := q.in_one_of(ways)) is not None]
        if not fitting:
            unusable = [q for q in named if q.problem is not None]
            if unusable and (table.result or len(unusable) == len(named)):
                unusable[0].usable()
            units = ", ".join(dict.fromkeys(q.unit.text for q in named[:8] if q.unit.text))
            raise InputError(self.path, key, f"{units} ({named[0].where} of {file})", f"a quantity in {told}")
        sized = [q for q in fitting if len(q.value) == count or q.problem is not None]
        if not sized:
            found = f"a list of {len(fitting[0].value)} ({fitting[0].where} of {file})"
            raise InputError(self.path, key, found, f"{count} numbers" if count > 1 else "a result with one value")
        if len(sized) > 1:
            where = "; ".join(q.where for q in sized[:4])
            expected = f"the id, name or type of one of the {len(sized)} results in {told} of {file} ({where})"
            raise InputError(self.path, f"{key}.result", f'"{table.result}"' if table.result else "nothing", expected)
        picked = sized[0].usable()
        if np.any(np.isnan(picked.value)):
            raise certificate.refusal(picked.where, "nan", "finite numbers" if count > 1 else "a finite number")
        if not np.all(np.isfinite(picked.expanded / picked.k)):
            raise certificate.refusal(picked.where, "no uncertainty", "U with its coverage factor")
        if np.ptp(picked.k) > 0.0:
            raise certificate.refusal(picked.where, "several coverage factors", "one for all three numbers")
        return picked

    def _curve(
        self, certificate: CalibrationCertificate, table: CertificateReference, at: tuple[At, dict[str, Any]],
        beside: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Check the list over frequency that a channel follows, and keep where it comes from."""
        inside, source = at
        key = key_path(*inside)
        plain, across = [parse_unit(unit).dimension for unit in ELECTRICAL], self._dimension(beside)
        fits = {_over(one, other) for one in plain for other in (*plain, across) if other is not None}
        curve, read = curve_named(certificate, table.result), certified_table(certificate, table.result)
        if curve.unit.dimension not in fits:
            found = f'{curve.unit.text} (result "{curve.name}" of {certificate.path.name})'
            expected = f"a response in V, A or C, to each other or per {beside.get('quantity')}"
            raise InputError(self.path, key, found, expected)
        relative = read.u_magnitude / read.magnitude
        stated = checked_table(
            UncertaintyStatement, {"U_relative": float(2.0 * relative.max()), "k": 2.0, **source}, self.path, inside
        )
        self.curves.append(UncertainInput(self.path, key, None, relative, True, stated))


def _is_certificate(value: object) -> bool:
    """Whether a text is the name of a certificate's file."""
    return isinstance(value, str) and value.lower().endswith(SUFFIX)


def _over(one: Dimension, other: Dimension) -> Dimension:
    return tuple(a - b for a, b in zip(one, other, strict=True))


def certified_inputs(text: dict[str, Any], path: Path, scope: PathScope, sensor_unit: str = "1") -> CertifiedInputs:
    """Return a manifest with every `{ dcc = "file.xml", … }` replaced by the table that a user types from it."""
    found = CertifiedInputs(path, scope, sensor_unit)
    found.text = found.replaced(text, text, [])
    return found
