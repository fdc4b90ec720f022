"""Shares of the variance of a result whose inputs have a certificate, and of those without one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.campaign.joint_evaluation import CampaignEvaluation, main_channel
from fusion.errors import InputError
from fusion.report.tables import result_name
from fusion.report.traceability import SMALLEST_SHARE, trace_inputs
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensor import result_notices as declared
from fusion.sensor.certificate.certificate_form import CertifiedEquipment
from shaker.labels import LOAD_COMPONENTS

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


def least_certified(
    evaluation: CampaignEvaluation, equipment: Sequence[CertifiedEquipment], path: Path
) -> CertificateShares | None:
    """Return the shares of the main value with the largest share of inputs without a certificate.

    `equipment` of the form at `path`: its certificates apply to the inputs that it names. Raises `InputError` for a
    name that no uncertain input has.
    """
    evidence = _of_equipment({row for entry in evaluation.recorded for row in entry.evidence}, equipment, path)
    return max(_shares(evaluation, evidence), key=lambda one: one.missing, default=None)


def _of_equipment(
    evidence: Iterable[InputEvidence], equipment: Sequence[CertifiedEquipment], path: Path
) -> list[InputEvidence]:
    """Return the evidence with the certificates of the equipment."""
    rows = sorted(evidence, key=lambda row: (row.unknown, row.input, row.certificate))
    for one in equipment:
        for name in one.inputs:
            covered = [f".{row.input.rpartition(': ')[2]}".endswith(f".{name}") for row in rows]
            if not any(covered):
                keys = ", ".join(sorted({row.input.rpartition(": ")[2] for row in rows}))
                raise InputError(declared.UNKNOWN_CERTIFIED_INPUT, path, "equipment.inputs", found=name, keys=keys)
            certified = {"certificate": one.certificate, "laboratory": one.laboratory}
            rows = [
                replace(row, **certified) if is_covered and not row.certificate else row
                for row, is_covered in zip(rows, covered, strict=True)
            ]
    return rows


def _shares(evaluation: CampaignEvaluation, evidence: Sequence[InputEvidence]) -> Iterator[CertificateShares]:
    """Yield the shares of every main value, of ratios only if there is nothing else."""
    with_certificate = {row.input for row in evidence if row.certificate}
    kinds = {curve.kind for curve in evaluation.curves}
    kind = next((kind for kind in ("matrix", "element", "ratio") if kind in kinds), None)
    for curve in (curve for curve in evaluation.curves if curve.kind == kind):
        for e, (channel, component) in enumerate(curve.elements):
            if channel != main_channel(evaluation, curve.channels, component):
                continue
            of_element = curve.uncertainty.at([e])
            name = result_name(curve.kind, curve.channels[channel], LOAD_COMPONENTS[component], main=True)
            for line in np.flatnonzero(np.isfinite(curve.value[:, e])).tolist():
                inputs = trace_inputs(curve.value[[line]][:, [e]], of_element.at_lines([line]), evidence)
                stated = [one for one in inputs if one.key]
                yield CertificateShares(
                    name,
                    float(curve.frequency_hz[line]),
                    sum(one.of_magnitude for one in stated if one.key in with_certificate),
                    tuple((one.name, one.of_magnitude) for one in stated if one.key not in with_certificate),
                )
