"""The page of a camera calibration: what was found, how well, and from which views."""

from __future__ import annotations

from typing import Any

from fusion import camera_tables as tables
from fusion.page import origin_frame, render_page
from fusion.plots.cameras import draw_cameras
from fusion.provenance import Provenance
from photogram.calibrate.result import Calibration


def render_camera_report(calibration: Calibration, name: str, provenance: Provenance, duration_s: float) -> str:
    """HTML text of one self-contained page about the calibrated stereo pair `name`.

    `provenance`: hashes of the pictures, settings, versions and the names of the files written beside the page.
    """
    return render_page("cameras.html", _context(calibration, name, provenance, duration_s))


def _context(calibration: Calibration, name: str, provenance: Provenance, duration_s: float) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": name,
        "subject": tables.subject(calibration),
        "verdict": tables.verdict(calibration),
        "headlines": tables.camera_headlines(calibration),
        "pictures": draw_cameras(calibration),
        "views": tables.views_table(calibration),
        "dropped": tables.dropped_table(calibration),
        "residuals": tables.residuals_table(calibration),
        "parameters": tables.parameters_table(calibration),
        "correlations": tables.correlations_table(calibration),
        "lengths": tables.lengths_table(calibration),
        "scale_u": calibration.scale_u,
        **origin_frame(provenance, calibration.notices),
        "duration_s": duration_s,
        "files": provenance.files,
    }
