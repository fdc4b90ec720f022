"""Transfer functions as rows and tables: transfer.csv, the page's tables, and what the command prints."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.plots.transfer import uncertainty
from fusion.polar import element_covariance, polar, rounded, typeset
from fusion.report_numbers import measured, small
from fusion.report_tables import Headline, Table
from fusion.results_csv import Row
from fusion.transfer.result import FoundResonance, ReferenceResult, TransferEvaluation

COLUMNS = [
    "frequency_hz",
    "response",
    "reference",
    "estimator",
    "magnitude",
    "phase_rad",
    "u_magnitude",
    "u_phase_rad",
    "re",
    "im",
    "u_re",
    "u_im",
    "r",
    "coherence",
    "dof",
    "unit",
]


def transfer_rows(evaluation: TransferEvaluation) -> Iterator[Row]:
    """One row per reference, response and line."""
    for result in evaluation.references:
        ratio = result.transfer.ratio
        for c, name in enumerate(ratio.channels):
            for k, frequency in enumerate(ratio.frequency_hz):
                item = polar(complex(ratio.value[k, c]), element_covariance(ratio.covariance[k], c))
                numbers: Row = [item.magnitude, item.phase_rad, item.u_magnitude, item.u_phase_rad]
                parts: Row = [item.re, item.im, item.u_re, item.u_im, item.r]
                head: Row = [float(frequency), name, result.name, result.transfer.estimator]
                tail: Row = [float(result.transfer.coherence[k, c]), float(ratio.dof[k]), ratio.unit[c]]
                yield [*head, *numbers, *parts, *tail]


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
