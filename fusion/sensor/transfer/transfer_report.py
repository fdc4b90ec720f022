"""Files, page and printed lines of transfer functions, and the command."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from fusion.base import K2
from fusion.estimation.coverage import Polar, coverage_factor, polar
from fusion.estimation.uncertainty import Contribution, Uncertainty, element_covariance
from fusion.recording.load import load_for_command
from fusion.recording.manifest import ChannelEntry
from fusion.report.figure import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    Figure,
    draw_response,
    empty_figure,
    frequency_axis,
)
from fusion.report.folder import CommandReport
from fusion.report.h5 import write_value
from fusion.report.table import Headline, Table, TableColumn, columns_of, csv_text, page_column, polar_columns, table
from fusion.sensor.transfer.transfer_evaluation import evaluate_transfer
from fusion.sensor.transfer.transfer_records import (
    FoundResonance,
    ReferenceResult,
    TransferEvaluation,
    TransferSettings,
    uncertainty,
)
from fusion.sensor.unmodelled_effects import CAUSE_LABELS, NOT_ASSESSED, stated_influences
from shaker.frf.result import TransferFunction
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text, quantity_text, scaled_text, small, typeset

LARGEST_PERCENT = 100.0
REJECTED = "model refuted by the data"


class TransferLine(NamedTuple):
    """One line of a curve in transfer.csv."""

    frequency_hz: float
    response: str
    reference: str
    estimator: str
    value: Polar
    coherence: float
    dof: float
    unit: str


LINES: list[TableColumn[TransferLine]] = [
    *columns_of(TransferLine)[:4],
    *polar_columns("magnitude", lambda line: line.value)[:-1],
    *columns_of(TransferLine)[5:],
]


def transfer_lines(evaluation: TransferEvaluation) -> Iterator[TransferLine]:
    """Yield every line of every reference and response."""
    for result in evaluation.references:
        ratio, coherence = result.transfer.ratio, result.transfer.coherence
        for c, name in enumerate(ratio.channels):
            for k, frequency in enumerate(ratio.frequency_hz.tolist()):
                value = polar(complex(ratio.value[k, c]), element_covariance(ratio.covariance[k], c))
                head, tail = (name, result.name, result.transfer.estimator), (float(ratio.dof[k]), ratio.unit[c])
                yield TransferLine(frequency, *head, value, float(coherence[k, c]), *tail)


def expanded(result: ReferenceResult, channel: int) -> tuple[FloatArray, FloatArray]:
    """Return U(|H|)/|H| and U(arg H) in rad (K,) of one response (95 %)."""
    ratio, both = result.transfer.ratio, [channel, channel + len(result.transfer.ratio.channels)]
    whole, noise = (part[:, both][:, :, both] for part in (ratio.covariance, result.random_covariance))
    value = ratio.value[:, channel]
    parts = Contribution("noise", "A", noise, ratio.dof), Contribution("stated", "B", whole - noise)
    factors = _factor(Uncertainty(parts).dof_polar(value[:, None])[..., 0])
    size, phase = uncertainty(value, whole)
    return factors[0] * size, factors[1] * phase


def _factor(dof: FloatArray) -> FloatArray:
    """Return coverage factors for 95 %."""
    return np.asarray(np.vectorize(coverage_factor, otypes=[np.float64])(dof))


class TransferCurve(NamedTuple):
    """One response over its reference; `U_relative`, `U_phase_rad`: medians over the lines of U(|H|)/|H|, U(arg H)."""

    name: str
    unit: str
    transfer: TransferFunction
    U_relative: float
    U_phase_rad: float
    coherence: float

    @property
    def band(self) -> str:
        """First and last line, Hz."""
        return f"{self.transfer.ratio.frequency_hz[0]:.6g} to {self.transfer.ratio.frequency_hz[-1]:.6g}"


def curves(evaluation: TransferEvaluation) -> Iterator[TransferCurve]:
    """Yield every response of every reference."""
    for result in evaluation.references:
        transfer = result.transfer
        for c, name in enumerate(transfer.ratio.channels):
            size, turn = (float(np.median(part)) for part in expanded(result, c))
            lowest = float(np.min(transfer.coherence[:, c]))
            yield TransferCurve(f"{name} / {result.name}", transfer.ratio.unit[c], transfer, size, turn, lowest)


CURVES: list[TableColumn[TransferCurve]] = [
    page_column("curve", lambda curve: curve.name, "l"),
    page_column("unit", lambda curve: typeset(curve.unit), "l"),
    page_column("estimator", lambda curve: curve.transfer.estimator, "l"),
    page_column("lines", lambda curve: f"{len(curve.transfer.ratio.frequency_hz)}"),
    page_column("band / Hz", lambda curve: curve.band),
    page_column("spacing / Hz", lambda curve: number_text(curve.transfer.line_spacing_hz, 6)),
    page_column("U(|H|) / %, median", lambda curve: small(100.0 * curve.U_relative)),
    page_column("U(phase) / mrad, median", lambda curve: small(1e3 * curve.U_phase_rad)),
    page_column("smallest coherence", lambda curve: f"{curve.coherence:.4f}"),
]


def resonances(evaluation: TransferEvaluation) -> list[FoundResonance]:
    """Return every resonance of every reference."""
    return [found for result in evaluation.references for found in result.resonances]


def _over(found: FoundResonance) -> str:
    return f"{found.response} / {found.reference}"


def _damping(found: FoundResonance, unit: str = "") -> str:
    """Return the damping ratio in % with U (k = 2)."""
    return quantity_text(100.0 * found.fit.damping_ratio, 200.0 * found.u_damping_ratio, unit)


def _relative_damping(found: FoundResonance) -> float:
    """Return the relative U (k = 2) of the damping ratio."""
    return 2.0 * found.u_damping_ratio / found.fit.damping_ratio


RESONANCES: list[TableColumn[FoundResonance]] = [
    page_column("curve", _over, "l"),
    page_column("f₀ / Hz", lambda found: quantity_text(found.fit.frequency_hz, 2.0 * found.u_frequency_hz)),
    page_column("damping ratio ζ / %", _damping),
    page_column("quality Q", lambda r: quantity_text(r.fit.quality, r.fit.quality * _relative_damping(r))),
    page_column("fitted as", lambda found: f"{found.fit.kind}, {found.fit.law}", "l"),
    page_column(
        "lines / Hz", lambda found: f"{number_text(found.band_hz[0], 6)} to {number_text(found.band_hz[1], 6)}"
    ),
    page_column("χ² per dof", lambda found: f"{found.fit.chi_squared / found.fit.dof:.2f}"),
]


def headlines(evaluation: TransferEvaluation) -> list[Headline]:
    """Return frequency and damping ratio of the first resonances."""
    lines = []
    for found in resonances(evaluation)[:3]:
        fit = found.fit
        value = quantity_text(fit.frequency_hz, 2.0 * found.u_frequency_hz, "Hz")
        u_frequency = 200.0 * found.u_frequency_hz / fit.frequency_hz
        remarks = [f"U (k = 2) = {number_text(u, 2)} %" for u in (u_frequency, 100.0 * _relative_damping(found))]
        remarks = remarks if np.isfinite(u_frequency) else [REJECTED] * 2
        lines.append(Headline(f"Resonance of {_over(found)}", value, remarks[0]))
        lines.append(
            Headline("Damping ratio ζ", _damping(found, "%"), f"Q = {number_text(fit.quality, 5)}; {remarks[1]}")
        )
    return lines


def printed(evaluation: TransferEvaluation) -> Iterator[str]:
    """Yield the printed lines: curves with U (95 %), resonances with U (k = 2)."""
    for curve in curves(evaluation):
        lines = f"{curve.transfer.estimator}, {len(curve.transfer.ratio.frequency_hz)} lines from {curve.band} Hz"
        median = (
            f"{number_text(100.0 * curve.U_relative, 2)} % and {number_text(1e3 * curve.U_phase_rad, 2)} mrad (95 %)"
        )
        yield f"{curve.name} [{curve.unit}]: {lines}, median U {median}"
    for found in resonances(evaluation):
        fit = found.fit
        frequency = quantity_text(fit.frequency_hz, 2.0 * found.u_frequency_hz)
        damping = quantity_text(100.0 * fit.damping_ratio, 200.0 * found.u_damping_ratio)
        remark = "" if np.isfinite(found.u_frequency_hz) else f" ({REJECTED})"
        yield f"  resonance of {_over(found)}: {frequency} Hz, damping ratio {damping} %, Q {fit.quality:.4g}{remark}"


def _budget_table(found: FoundResonance, missing: Sequence[str]) -> Table:
    """Return the contributions to one resonance, and the `missing` causes as not assessed."""
    fit = found.fit
    rows: list[tuple[str, ...]] = [
        (name, small(1e6 * abs(change[0]) / fit.frequency_hz), small(100.0 * abs(change[1]) / fit.damping_ratio))
        for name, change in sorted(found.budget.items(), key=lambda item: -abs(item[1][0]))
    ]
    total = (1e6 * found.u_frequency_hz / fit.frequency_hz, 100.0 * found.u_damping_ratio / fit.damping_ratio)
    rows += [(CAUSE_LABELS[cause], NOT_ASSESSED, NOT_ASSESSED) for cause in missing]
    rows.append(("combined, k = 1", *map(small, total)))
    caption = f"Budget of the resonance of {_over(found)} at {number_text(fit.frequency_hz, 6)} Hz"
    return Table(caption, ("contribution", "u(f₀) / 10⁻⁶ f₀", "u(ζ) / % of ζ"), "lrr", tuple(rows))


def _context(evaluation: TransferEvaluation) -> dict[str, Any]:
    """Return the content of the page."""
    excitation = evaluation.manifest.excitation
    influences = stated_influences(evaluation.manifest.rig, [evaluation.manifest.mounting])
    excited: list[str] = [excitation.kind]
    if excitation.band is not None:
        excited.append(f"{number_text(excitation.band[0], 6)} to {number_text(excitation.band[1], 6)} Hz")
    if excitation.period is not None:
        excited.append(f"period {number_text(excitation.period, 6)} s, {excitation.settle_periods} left out to settle")
    further = len(evaluation.manifest.daq[0].further_files)
    if further:
        excited.append(f"{1 + further} files")
    used = {result.name for result in evaluation.references}
    used |= {name for result in evaluation.references for name in result.transfer.ratio.channels}
    channels = [
        (daq.name, entry)
        for daq in evaluation.manifest.daq
        for entry in daq.channel
        if entry.name in used and entry.quantity != "trigger"
    ]
    return {
        "subject": [("Rig", evaluation.manifest.rig.name), ("Excitation", ", ".join(excited))],
        "pictures": [
            draw_transfer(result, channel)
            for result in evaluation.references
            for channel in range(len(result.transfer.ratio.channels))
        ],
        "curves": table(
            "Transfer functions, U: 95 %, k by the degrees of freedom of each line", CURVES, curves(evaluation)
        ),
        "resonances": table("Resonances with U (k = 2)", RESONANCES, resonances(evaluation)),
        "budgets": [_budget_table(found, influences.missing) for found in resonances(evaluation) if found.budget],
        "channels": table("Channels and their chains as stated", CHANNELS, channels),
    }


CHANNELS: list[TableColumn[tuple[str, ChannelEntry]]] = [
    page_column("channel", lambda row: row[1].name, "l"),
    page_column("DAQ", lambda row: row[0], "l"),
    page_column("quantity", lambda row: row[1].quantity, "l"),
    page_column("scale", lambda row: number_text(row[1].scale, 6)),
    page_column("u(scale) / %", lambda row: number_text(100.0 * row[1].scale_uncertainty, 6)),
    page_column(
        "delay ± u / µs",
        lambda row: scaled_text(1e6 * row[1].delay, 1e6 * row[1].delay_uncertainty),
    ),
    page_column("corrected response", lambda row: row[1].response.name if row[1].response else "none stated", "l"),
]


def draw_transfer(result: ReferenceResult, channel: int) -> Figure:
    """Draw magnitude, phase, relative uncertainty and coherence of one response."""
    response, coherence = result.transfer.ratio.channels[channel], result.transfer.coherence[:, channel]
    curve, both = result.transfer.ratio.select([response]), [channel, channel + len(result.transfer.ratio.channels)]
    frequency, value, unit = curve.frequency_hz, curve.value[:, 0], typeset(curve.unit[0])
    noise = result.random_covariance[:, both][:, :, both]
    modes = [resonance for resonance in result.resonances if resonance.response == response]
    oscillators = [replace(resonance.fit, residual_terms=np.zeros(2, dtype=np.complex128)) for resonance in modes]
    title, size = f"{response} over {result.name}", np.abs(value)
    drawn = empty_figure(f"transfer-{response}-{result.name}", 7.4, (2.3, 1.5, 1.2, 0.9))
    magnitude, phase, relative, linear = drawn.panels
    wide, turn = expanded(result, channel)
    draw_response(magnitude, phase, frequency, value, (wide / K2, turn / K2), colour=BLUE, label="measured, U")
    for index, resonance in enumerate(modes):
        inside = np.linspace(*resonance.band_hz, 400)
        others = [other.model(inside) for other in (*oscillators[:index], *oscillators[index + 1 :])]
        fitted = np.abs(np.sum([resonance.fit.model(inside), *others], axis=0))
        magnitude.line(inside, fitted, "oscillators fitted", colour=RED, width=0.9, dashed=True)
        look = {"colour": RED, "width": 0.7, "dashed": True}
        phase.rule(resonance.fit.frequency_hz, "oscillators fitted", along="x", **look)
    magnitude.y.limits = (0.7 * float(size.min()), 1.6 * float(size.max()))
    magnitude.y.label = "|H|" if unit == "1" else f"|H| / ({unit})"
    noise_wide = _factor(curve.dof) * uncertainty(value, noise)[0]
    for part, colour, label in ((wide, BLACK, "U"), (noise_wide, ORANGE, "U by noise only")):
        relative.line(frequency, np.minimum(100.0 * part, LARGEST_PERCENT), label, colour=colour, width=0.8)
    relative.y.log, relative.y.label = True, "U(|H|) / %"
    linear.line(frequency, coherence, colour=GREY, width=0.8)
    lowest = min(0.9, np.floor(10.0 * float(np.nanmin(coherence))) / 10.0)
    linear.rule(1.0, colour=LIGHT, width=0.7)
    linear.y.limits, linear.y.label = (float(lowest), 1.0 + 0.06 * (1.0 - float(lowest))), "γ²"
    labels = (f"{title}: magnitude", "phase", "relative uncertainty of the magnitude", "coherence")
    for panel, text in zip(drawn.panels, labels, strict=True):
        frequency_axis(panel.x, frequency)
        panel.title, panel.x.label = text, panel.x.label if panel is linear else ""
    fitted_text = " Red: fitted oscillators, over the lines used for the fit." if modes else ""
    caption = (
        f"Bands: expanded uncertainty U (95 %), also in the third panel.{fitted_text} A coherence below one "
        "indicates noise, other sources or a nonlinear structure."
    )
    return drawn.with_title(title, caption, main=channel == 0)


def _fill(file: h5py.File, evaluation: TransferEvaluation) -> None:
    file.attrs["recording"] = evaluation.name
    file.attrs["rig"] = evaluation.manifest.rig.name
    file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
    influences = stated_influences(evaluation.manifest.rig, [evaluation.manifest.mounting])
    file.attrs["not_assessed"] = ", ".join(CAUSE_LABELS[cause] for cause in influences.missing)
    for name in ("references", "clocks", "notices", "duration_s"):
        write_value(file, name, getattr(evaluation, name))


TRANSFER: CommandReport[TransferEvaluation] = CommandReport(
    "transfer",
    "transfer",
    ("transfer.csv",),
    lambda evaluation: {"transfer.csv": csv_text(LINES, transfer_lines(evaluation))},
    _fill,
    _context,
    printed,
    headlines,
)


def run_transfer(
    path: Path, output: Path | None, settings: TransferSettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Evaluate each recording of a path, write its results and print the summary."""
    manifests = load_for_command([path], TRANSFER.name, allow_outside=allow_outside)
    for manifest in manifests:
        folder = manifest.folder / TRANSFER.name if output is None else output
        if output is not None and len(manifests) > 1:
            folder = output / manifest.folder.name
        evaluate = partial(evaluate_transfer, manifest, settings)
        TRANSFER.run_recordings([path], [manifest], folder, evaluate, force=force)
