"""Traceability of a result: its uncertain inputs, their certificates, and their shares of the uncertainty."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import check_new_file
from fusion.errors import InputError
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.estimation.uncertainty import Influence, Uncertainty
from fusion.report.atomic_files import write_atomically
from fusion.report.h5 import open_results, read_evidence
from fusion.report.labelled_results import read_results
from fusion.report.report_notices import NO_SENSITIVITY_TO_EXPORT
from fusion.report.table import Table, TableColumn, csv_text, page_column, table, text_column
from fusion.sensitivity.input_evidence import InputEvidence
from shakercal._common.arrays import ComplexArray, FloatArray

SMALLEST_SHARE = 0.01
"""Smallest share of a variance that has a row: less changes U by 0.5 %."""
HALVED = 0.75
"""What halving an uncertainty takes from its variance."""
RECORDED = "noise, clocks and fits of the recordings (type A)"


@dataclass(frozen=True)
class TracedInput:
    """An input of a result, with its largest shares of the variances.

    Shares are from 0 to 1, of all lines.

    Attributes
    ----------
    name : label of its unknowns.
    key : file and key, empty without one.
    certificate, laboratory, valid_until : as stated, empty where they are not.
    """

    name: str
    key: str
    certificate: str
    laboratory: str
    valid_until: str
    of_magnitude: float
    of_phase: float

    @property
    def source(self) -> str:
        """Return certificate, laboratory and end of validity as text."""
        valid = f"valid until {self.valid_until}" if self.valid_until else ""
        return ", ".join(filter(None, (self.certificate, self.laboratory, valid)))

    @property
    def calibrated(self) -> bool:
        """Whether a new calibration of the input could lower its uncertainty."""
        return bool(self.key)

    @property
    def gain(self) -> float:
        """Return the share by which U falls if u of this input is halved."""
        return float(1.0 - np.sqrt(1.0 - HALVED * self.of_magnitude))


def trace_inputs(
    value: ComplexArray, uncertainty: Uncertainty, evidence: Iterable[InputEvidence]
) -> tuple[TracedInput, ...]:
    """Return the inputs of complex values (K, C) by their largest share of a variance.

    With dX/X = d ln|X| + j d arg X, the variances are those of magnitude (relative) and phase. Unknowns that one key
    states are one input.
    """
    relative = uncertainty.relative_to(value)
    total = relative.covariance.diagonal(axis1=1, axis2=2)
    rows = {row.unknown: row for row in reversed(tuple(evidence))}
    variances: dict[str, FloatArray] = {}
    sources: dict[str, tuple[str, InputEvidence | None]] = {}
    for influence in relative.influences:
        row = rows.get(influence.name)
        recorded = row is None and influence.type == "A"
        name = RECORDED if recorded else influence.label if row is None else f"{influence.label} {row.input}"
        variances[name] = variances.get(name, np.zeros_like(total)) + influence.effect**2
        sources.setdefault(name, (influence.label, row))
    for part in relative.random:
        name = RECORDED if part.type == "A" else part.label
        variances[name] = variances.get(name, np.zeros_like(total)) + part.covariance.diagonal(axis1=1, axis2=2)
        sources.setdefault(name, (name, None))
    found = []
    for name, variance in variances.items():
        share = np.divide(variance, total, out=np.zeros_like(total), where=total > 0.0)
        magnitude, phase = np.split(np.nan_to_num(share), 2, axis=1)
        largest = float(magnitude.max(initial=0.0)), float(phase.max(initial=0.0))
        found.append(_traced(name if sources[name][1] is None else sources[name][0], sources[name][1], *largest))
    return tuple(sorted(found, key=lambda entry: -max(entry.of_magnitude, entry.of_phase)))


def _traced(name: str, row: InputEvidence | None, of_magnitude: float = 0.0, of_phase: float = 0.0) -> TracedInput:
    if row is None:
        return TracedInput(name, "", "", "", "", of_magnitude, of_phase)
    certificate = row.certificate or (f"file of SHA-256 {row.sha256[:8]}…" if row.sha256 else "")
    return TracedInput(name, row.input, certificate, row.laboratory, row.valid_until, of_magnitude, of_phase)


def largest_of(parts: Iterable[Sequence[TracedInput]]) -> tuple[TracedInput, ...]:
    """Return every input once, with its largest shares of all parts."""
    merged: dict[str, TracedInput] = {}
    for entry in (entry for part in parts for entry in part):
        other = merged.get(entry.name + entry.key, entry)
        magnitude, phase = max(entry.of_magnitude, other.of_magnitude), max(entry.of_phase, other.of_phase)
        merged[entry.name + entry.key] = replace(other, of_magnitude=magnitude, of_phase=phase)
    return tuple(sorted(merged.values(), key=lambda entry: -max(entry.of_magnitude, entry.of_phase)))


def traceability(inputs: Sequence[TracedInput], result: str) -> dict[str, Any]:
    """Return table and best recalibration for a page."""
    candidates = [entry for entry in inputs if entry.calibrated and entry.of_magnitude >= SMALLEST_SHARE]
    best = max(candidates, key=lambda entry: entry.gain, default=None)
    return {"traceability": traceability_table(inputs, result), "recalibration": best}


def traceability_table(inputs: Sequence[TracedInput], result: str) -> Table | None:
    """Return the table of the inputs that matter, for a page."""
    shown = [entry for entry in inputs if max(entry.of_magnitude, entry.of_phase) >= SMALLEST_SHARE]

    def percent(share: float) -> str:
        return f"{100.0 * share:.1f}"

    columns: list[TableColumn[TracedInput]] = [
        page_column("input", lambda entry: entry.name, "l"),
        page_column("stated in", lambda entry: entry.key or "–", "l"),
        page_column("certificate", lambda entry: entry.source or ("none stated" if entry.calibrated else "–"), "l"),
        page_column("share of the variance of the magnitude / %", lambda entry: percent(entry.of_magnitude)),
        page_column("of the phase / %", lambda entry: percent(entry.of_phase)),
        page_column("U of the magnitude falls at half its u by / %", lambda entry: percent(entry.gain)),
    ]
    return table(f"Inputs of {result}, largest shares over the driven frequencies", columns, shown)


@dataclass(frozen=True)
class _InputRow:
    """One uncertain input of one value, with its effects for one standard uncertainty."""

    result: LabelledPhasors
    line: int
    element: int
    name: str
    label: str
    type: str
    dof: float
    distribution: str
    u: float | None
    unit: str
    effect: tuple[float, float, float]
    source: TracedInput | None

    @property
    def value(self) -> complex:
        return complex(self.result.value[self.line, self.element])


INPUTS: list[TableColumn[_InputRow]] = [
    TableColumn("frequency_hz", lambda row: row.result.frequency_hz[row.line]),
    text_column("channel", lambda row: row.result.channel[row.element]),
    text_column("component", lambda row: row.result.component[row.element]),
    text_column("kind", lambda row: row.result.kind[row.line]),
    text_column("unit", lambda row: row.result.unit[row.element]),
    TableColumn("value_re", lambda row: row.value.real),
    TableColumn("value_im", lambda row: row.value.imag),
    text_column("input", lambda row: row.name),
    text_column("label", lambda row: row.label),
    text_column("type", lambda row: row.type),
    TableColumn("dof", lambda row: row.dof),
    text_column("distribution", lambda row: row.distribution),
    TableColumn("u_input", lambda row: row.u),
    text_column("input_unit", lambda row: row.unit),
    TableColumn("u_re", lambda row: row.effect[0]),
    TableColumn("u_im", lambda row: row.effect[1]),
    TableColumn("correlation", lambda row: row.effect[2]),
    text_column("stated_in", lambda row: "" if row.source is None else row.source.key),
    text_column("certificate", lambda row: "" if row.source is None else row.source.certificate),
    text_column("laboratory", lambda row: "" if row.source is None else row.source.laboratory),
    text_column("valid_until", lambda row: "" if row.source is None else row.source.valid_until),
]


def export_inputs(path: Path, output: Path, *, force: bool = False) -> int:
    """Write all uncertain inputs of the main elements of results as a table.

    Returns the number of rows. Raises `InputError` for results without a sensitivity.
    """
    check_new_file(output, force=force)
    results = read_results(path)
    with open_results(results.path) as file:
        evidence = {row.unknown: _traced("", row) for row in reversed(read_evidence(file))}
    parts = results.curve or tuple(part for part in (results.sensitivity, results.element) if part is not None)
    rows = [row for part in parts for row in _rows(part, evidence)]
    if not rows:
        raise InputError(NO_SENSITIVITY_TO_EXPORT, results.path)
    write_atomically(output, csv_text(INPUTS, rows))
    return len(rows)


def _rows(part: LabelledPhasors, evidence: dict[str, TracedInput]) -> Iterator[_InputRow]:
    """Yield the inputs of every finite value of the main elements."""
    for element in part.main_elements():
        own = part.uncertainty.at([element])
        for line in np.flatnonzero(np.isfinite(part.value[:, element])).tolist():
            for contribution in own.random:
                variance = contribution.covariance[line]
                u_re, u_im = np.sqrt(np.maximum(np.diag(variance), 0.0)).tolist()
                if u_re > 0.0 or u_im > 0.0:
                    shared = variance[0, 1] / (u_re * u_im) if u_re * u_im > 0.0 else 0.0
                    dof = np.inf if contribution.dof is None else float(contribution.dof[line])
                    name, kind, effect = contribution.label, contribution.type, (u_re, u_im, float(shared))
                    yield _InputRow(part, line, element, name, name, kind, dof, "normal", None, "", effect, None)
            for influence in own.influences:
                row = _of_influence(part, line, element, influence, evidence.get(influence.name))
                if row is not None:
                    yield row


def _of_influence(
    part: LabelledPhasors, line: int, element: int, influence: Influence, source: TracedInput | None
) -> _InputRow | None:
    """Return the row of an unknown; its effects have signs, which tell how they correlate."""
    real, imaginary = influence.effect[line].tolist()
    if real == 0.0 and imaginary == 0.0:
        return None
    effect = (real, imaginary, 1.0)
    kind, distribution = influence.type, influence.distribution
    name, label, dof = influence.name, influence.label, influence.dof
    return _InputRow(
        part, line, element, name, label, kind, dof, distribution, influence.u, influence.unit, effect, source
    )
