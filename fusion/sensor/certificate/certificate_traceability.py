"""Shares of a variance by inputs with a certificate, and by those without one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fusion.errors import InputError
from fusion.estimation.uncertainty import Uncertainty
from fusion.report.traceability import SMALLEST_SHARE, trace_inputs
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensor import result_notices as declared
from fusion.sensor.certificate.certificate_form import CertifiedEquipment
from shakercal._common.arrays import ComplexArray

TRACEABLE = "The results are traceable to the SI through the certificates of the references and instruments listed."


@dataclass(frozen=True)
class CertificateShares:
    """Shares, from 0 to 1, of the variance of the magnitude of one value.

    `certified`: of inputs with a certificate. `uncertified`: name and share of every input without one. The rest is
    noise and other effects that the recordings determine.
    """

    name: str
    frequency_hz: float
    certified: float
    uncertified: tuple[tuple[str, float], ...]

    @property
    def missing(self) -> float:
        """Share of all inputs without a certificate."""
        return sum(share for _, share in self.uncertified)

    @property
    def statement(self) -> str:
        """The statement of a certificate on its traceability."""
        if self.missing < SMALLEST_SHARE:
            return TRACEABLE
        named = ", ".join(f"{name} {share:.0%}" for name, share in self.uncertified if share >= SMALLEST_SHARE)
        return (
            f"Of the variance of the magnitude of {self.name} at {self.frequency_hz:.6g} Hz, {self.certified:.0%} "
            f"comes from inputs with a certificate and {self.missing:.0%} from inputs without one ({named}). The "
            "rest is noise of the recordings and effects that they determine. The inputs without a certificate are "
            "statements of the laboratory; the certificates listed do not cover them."
        ).replace("%", " %")


MainValue = tuple[str, float, ComplexArray, Uncertainty]
"""Name, frequency (Hz), value (1, 1) and uncertainty of a main value."""


def least_certified(
    values: Iterable[MainValue],
    evidence: Iterable[InputEvidence],
    equipment: Sequence[CertifiedEquipment],
    path: Path,
) -> CertificateShares | None:
    """Return the shares of the value with the largest share of inputs without a certificate.

    `equipment` of the form at `path`: its certificates apply to the inputs that it names. Raises `InputError` for a
    name that no uncertain input has.
    """
    rows = _of_equipment(evidence, equipment, path)
    certified = {row.input for row in rows if row.certificate}
    found = []
    for name, frequency_hz, value, uncertainty in values:
        stated = [one for one in trace_inputs(value, uncertainty, rows) if one.key]
        covered = sum(one.of_magnitude for one in stated if one.key in certified)
        others = tuple((one.name, one.of_magnitude) for one in stated if one.key not in certified)
        found.append(CertificateShares(name, frequency_hz, covered, others))
    return max(found, key=lambda one: one.missing, default=None)


def _of_equipment(
    evidence: Iterable[InputEvidence], equipment: Sequence[CertifiedEquipment], path: Path
) -> list[InputEvidence]:
    """Return the evidence with the certificates of the equipment."""
    rows = sorted(set(evidence), key=lambda row: (row.unknown, row.input, row.certificate))
    for one in equipment:
        for name in one.inputs:
            covered = [f".{row.input.rpartition(': ')[2]}".endswith(f".{name}") for row in rows]
            if not any(covered):
                keys = ", ".join(sorted({row.input.rpartition(": ")[2] for row in rows}))
                raise InputError(declared.UNKNOWN_CERTIFIED_INPUT, path, "equipment.inputs", found=name, keys=keys)
            rows = [
                replace(row, certificate=one.certificate, laboratory=one.laboratory)
                if is_covered and not row.certificate
                else row
                for row, is_covered in zip(rows, covered, strict=True)
            ]
    return rows
