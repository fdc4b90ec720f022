"""transfer.html: one self-contained page with curves, resonances and origin of one recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.evaluated import page_frame
from fusion.page import render_page
from fusion.plots.transfer import TransferCurve, draw_transfer
from fusion.report_tables import Table
from fusion.transfer import tables
from fusion.transfer.result import FloatArray, ReferenceResult, TransferEvaluation

PAGE_FILE = "transfer.html"


def render_transfer_page(evaluation: TransferEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("transfer.html", _context(evaluation))


def _context(evaluation: TransferEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.manifest.name,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "pictures": [draw_transfer(curve) for result in evaluation.references for curve in _curves(result)],
        "curves": tables.curves_table(evaluation),
        "resonances": tables.resonances_table(evaluation),
        "budgets": tables.budget_tables(evaluation),
        "channels": _channels(evaluation),
        **page_frame(evaluation),
    }


def _curves(result: ReferenceResult) -> list[TransferCurve]:
    """The responses of one reference as the figures take them."""
    transfer, curves = result.transfer, []
    for c, name in enumerate(transfer.ratio.channels):
        noise = _noise(result, c)
        fits = tuple((found.fit, found.band_hz) for found in result.resonances if found.response == name)
        one = transfer.ratio.select([name])
        curves.append(
            TransferCurve(
                response=name,
                reference=result.name,
                unit=one.unit[0],
                frequency_hz=one.frequency_hz,
                value=one.value[:, 0],
                covariance=one.covariance,
                random_covariance=noise,
                coherence=transfer.coherence[:, c],
                resonances=fits,
            )
        )
    return curves


def _noise(result: ReferenceResult, channel: int) -> FloatArray:
    """Noise covariance (K, 2, 2) of one response."""
    both = [channel, channel + len(result.transfer.ratio.channels)]
    return np.asarray(result.random_covariance[:, both][:, :, both])


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
