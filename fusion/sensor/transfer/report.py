"""What transfer functions leave: transfer.csv, transfer.h5, the page, and the lines of the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from fusion.base import rounded, typeset
from fusion.estimation.uncertainty import Polar, element_covariance, polar
from fusion.recording.load import load_for_command
from fusion.report.csv_files import polar_columns
from fusion.report.folder import Command
from fusion.report.h5 import write_fields
from fusion.report.numbers import measured, small
from fusion.report.table import Column, Headline, Table, csv_text, word
from fusion.sensor.transfer.evaluate import evaluate_transfer
from fusion.sensor.transfer.figures import draw_transfer, uncertainty
from fusion.sensor.transfer.records import FoundResonance, ReferenceResult, TransferEvaluation, TransferSettings


class Line(NamedTuple):
    """One line of a curve in transfer.csv."""

    frequency_hz: float
    response: str
    reference: str
    estimator: str
    value: Polar
    coherence: float
    dof: float
    unit: str


LINES: list[Column[Line]] = [
    Column("frequency_hz", lambda line: line.frequency_hz),
    word("response", lambda line: line.response),
    word("reference", lambda line: line.reference),
    word("estimator", lambda line: line.estimator),
    *polar_columns("magnitude", lambda line: line.value)[:-1],
    Column("coherence", lambda line: line.coherence),
    Column("dof", lambda line: line.dof),
    word("unit", lambda line: line.unit),
]


def transfer_lines(evaluation: TransferEvaluation) -> Iterator[Line]:
    """Every line of every reference and response."""
    for result in evaluation.references:
        ratio, coherence = result.transfer.ratio, result.transfer.coherence
        for c, name in enumerate(ratio.channels):
            for k, frequency in enumerate(ratio.frequency_hz.tolist()):
                value = polar(complex(ratio.value[k, c]), element_covariance(ratio.covariance[k], c))
                head, tail = (name, result.name, result.transfer.estimator), (float(ratio.dof[k]), ratio.unit[c])
                yield Line(frequency, *head, value, float(coherence[k, c]), *tail)


def curves_table(evaluation: TransferEvaluation) -> Table:
    """What was estimated: one row per response and reference."""
    rows = []
    for result in evaluation.references:
        transfer = result.transfer
        frequency = transfer.ratio.frequency_hz
        for c, name in enumerate(transfer.ratio.channels):
            relative, turn = typical_uncertainty(result, c)
            rows.append(
                (
                    f"{name} / {result.name}",
                    typeset(transfer.ratio.unit[c]),
                    transfer.estimator,
                    f"{len(frequency)}",
                    f"{frequency[0]:.6g} to {frequency[-1]:.6g}",
                    f"{transfer.line_spacing_hz:.6g}",
                    small(200.0 * relative),
                    small(2e3 * turn),
                    f"{float(np.min(transfer.coherence[:, c])):.4f}",
                )
            )
    head = (
        "curve",
        "unit",
        "estimator",
        "lines",
        "band / Hz",
        "spacing / Hz",
        "U(|H|) / %, median",
        "U(phase) / mrad, median",
        "smallest coherence",
    )
    return Table("Transfer functions, U: k = 2", head, "lllrrrrrr", tuple(rows))


def typical_uncertainty(result: ReferenceResult, channel: int) -> tuple[float, float]:
    """Return the median over the lines of u(|H|)/|H| and of u(arg H) in rad."""
    ratio = result.transfer.ratio.select([result.transfer.ratio.channels[channel]])
    relative, turn = uncertainty(ratio.value[:, 0], ratio.covariance)
    return float(np.median(relative)), float(np.median(turn))


def resonances(evaluation: TransferEvaluation) -> list[FoundResonance]:
    """Every resonance of every reference."""
    return [found for result in evaluation.references for found in result.resonances]


def resonances_table(evaluation: TransferEvaluation) -> Table | None:
    """Frequency, damping and quality of every resonance found."""
    rows = []
    for found in resonances(evaluation):
        fit = found.fit
        zeta = measured(100.0 * fit.damping_ratio, 200.0 * found.u_damping_ratio)
        u_quality = fit.quality * found.u_damping_ratio / fit.damping_ratio
        rows.append(
            (
                f"{found.response} / {found.reference}",
                measured(fit.frequency_hz, 2.0 * found.u_frequency_hz),
                zeta,
                measured(fit.quality, 2.0 * u_quality),
                fit.kind,
                f"{found.band_hz[0]:.6g} to {found.band_hz[1]:.6g}",
                f"{fit.chi_squared / fit.dof:.2f}",
            )
        )
    head = (
        "curve",
        "f₀ / Hz",
        "damping ratio ζ / %",
        "quality Q",
        "fitted as",
        "lines / Hz",
        "χ² per dof",
    )
    return Table("Resonances with U (k = 2)", head, "lrrrlrr", tuple(rows)) if rows else None


def budget_tables(evaluation: TransferEvaluation) -> list[Table]:
    """What contributes to the uncertainty of every resonance, largest first for its frequency."""
    return [_budget_table(found) for found in resonances(evaluation)]


def headlines(evaluation: TransferEvaluation) -> list[Headline]:
    """Frequency and damping of the first resonances."""
    told = []
    for found in resonances(evaluation)[:3]:
        fit = found.fit
        where = f"{found.response} / {found.reference}"
        value = measured(fit.frequency_hz, 2.0 * found.u_frequency_hz, "Hz")
        u_frequency = 200.0 * found.u_frequency_hz / fit.frequency_hz
        told.append(Headline(f"Resonance of {where}", value, f"U (k = 2) = {u_frequency:.2g} %"))
        share = 200.0 * found.u_damping_ratio / fit.damping_ratio
        damping = measured(100.0 * fit.damping_ratio, 200.0 * found.u_damping_ratio, "%")
        told.append(Headline("Damping ratio ζ", damping, f"Q = {fit.quality:.5g}; U (k = 2) = {share:.2g} %"))
    return told


def printed(evaluation: TransferEvaluation) -> Iterator[str]:
    """Lines for the terminal: curves, then resonances, U at k = 2."""
    for result in evaluation.references:
        transfer = result.transfer
        frequency = transfer.ratio.frequency_hz
        for c, name in enumerate(transfer.ratio.channels):
            relative, turn = typical_uncertainty(result, c)
            yield (
                f"{name} / {result.name} [{transfer.ratio.unit[c]}]: {transfer.estimator}, {len(frequency)} lines from "
                f"{frequency[0]:.6g} to {frequency[-1]:.6g} Hz, median U {200.0 * relative:.2g} % and "
                f"{2e3 * turn:.2g} mrad (k = 2)"
            )
    for found in resonances(evaluation):
        fit = found.fit
        frequency_text = rounded(fit.frequency_hz, 2.0 * found.u_frequency_hz, 0)
        damping = rounded(100.0 * fit.damping_ratio, 200.0 * found.u_damping_ratio, 0)
        yield (
            f"  resonance of {found.response} / {found.reference}: "
            f"{frequency_text.value} ± {frequency_text.expanded} Hz, "
            f"damping ratio {damping.value} ± {damping.expanded} %, Q {fit.quality:.4g}"
        )


def _budget_table(found: FoundResonance) -> Table:
    """Contributions to one resonance."""
    fit = found.fit
    rows: list[tuple[str, ...]] = [
        (name, small(1e6 * abs(change[0]) / fit.frequency_hz), small(100.0 * abs(change[1]) / fit.damping_ratio))
        for name, change in sorted(found.budget.items(), key=lambda item: -abs(item[1][0]))
    ]
    total = (1e6 * found.u_frequency_hz / fit.frequency_hz, 100.0 * found.u_damping_ratio / fit.damping_ratio)
    rows.append(("combined, k = 1", *map(small, total)))
    caption = f"Budget of the resonance of {found.response} / {found.reference} at {fit.frequency_hz:.6g} Hz"
    return Table(caption, ("contribution", "u(f₀) / 10⁻⁶ f₀", "u(ζ) / % of ζ"), "lrr", tuple(rows))


def _context(evaluation: TransferEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "subject": _subject(evaluation),
        "headlines": headlines(evaluation),
        "pictures": [
            draw_transfer(result, channel)
            for result in evaluation.references
            for channel in range(len(result.transfer.ratio.channels))
        ],
        "curves": curves_table(evaluation),
        "resonances": resonances_table(evaluation),
        "budgets": budget_tables(evaluation),
        "channels": _channels(evaluation),
    }


def _subject(evaluation: TransferEvaluation) -> list[tuple[str, str]]:
    """What was measured: rig, excitation."""
    excitation = evaluation.manifest.excitation
    facts = [("Rig", evaluation.manifest.rig.name)]
    told: list[str] = [excitation.kind]
    if excitation.band is not None:
        told.append(f"{excitation.band[0]:g} to {excitation.band[1]:g} Hz")
    if excitation.period is not None:
        told.append(f"period {excitation.period:g} s, {excitation.settle_periods} left out to settle")
    facts.append(("Excitation", ", ".join(told)))
    return facts


def _channels(evaluation: TransferEvaluation) -> Table:
    """The channels used, with what was stated of their chains."""
    used = {result.name for result in evaluation.references}
    used |= {name for result in evaluation.references for name in result.transfer.ratio.channels}
    rows = tuple(
        (
            entry.name,
            daq.name,
            entry.quantity,
            f"{entry.scale:g}",
            f"{100.0 * entry.scale_uncertainty:g}",
            f"{1e6 * entry.delay:g} ± {1e6 * entry.delay_uncertainty:g}",
            entry.response.name if entry.response is not None else "none stated",
        )
        for daq in evaluation.manifest.daq
        for entry in daq.channel
        if entry.name in used and entry.quantity != "trigger"
    )
    head = ("channel", "DAQ", "quantity", "scale", "u(scale) / %", "delay ± u / µs", "response taken off")
    return Table("Channels and their chains as stated", head, "lllrrrl", rows)


def _fill(file: h5py.File, evaluation: TransferEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["recording"] = evaluation.manifest.name
    file.attrs["rig"] = evaluation.manifest.rig.name
    file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
    write_fields(file, evaluation)


def _texts(evaluation: TransferEvaluation) -> dict[str, str | bytes]:
    """Every line of every curve."""
    return {"transfer.csv": csv_text(LINES, transfer_lines(evaluation))}


TRANSFER = Command("transfer", "transfer", ("transfer.csv",), _texts, _fill, _context, printed)


def run_transfer(
    path: Path, output: Path | None, settings: TransferSettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Evaluate the recording, or every recording of a campaign folder, write the results and print the summary.

    Results stand in the recording's own folder `transfer`, or in `output` (of a campaign: in a folder each). Of a
    campaign, recordings of other kinds are left out.
    """
    manifests = load_for_command([path], TRANSFER.name, allow_outside=allow_outside)
    for manifest in manifests:
        folder = manifest.folder / TRANSFER.name if output is None else output
        if output is not None and len(manifests) > 1:
            folder = output / manifest.folder.name
        evaluate = partial(evaluate_transfer, manifest, settings)
        TRANSFER.run_recordings([path], [manifest], folder, evaluate, force=force)
