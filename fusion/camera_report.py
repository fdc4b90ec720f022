"""The page of a camera calibration: what was found, how well, and from which views."""

from __future__ import annotations

from typing import Any

from fusion.page import render_page
from fusion.provenance import PROGRAM, Provenance
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
        "notices": sorted(calibration.notices, key=lambda notice: notice.severity != "warning"),
        "program": f"{PROGRAM} {provenance.versions.get(PROGRAM, '')}".strip(),
        "duration_s": duration_s,
        "files": provenance.files,
    }
