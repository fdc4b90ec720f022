"""Pictures of the problems that a look finds: an image or signal, marked."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from photogram.images.sequence import GreyImage
from shaker.io.channel import RawChannel
from shaker.io.condition import Defect
from shakercal._common.arrays import BoolArray

WIDTH_PX, QUALITY = 480, 70
"""Width of a picture at most, and of its JPEG compression."""
OUTLINE_BGR = (0, 64, 255)
"""Orange-red, which no grey image has."""
LEAST_SHOWN_PX = 5
"""Side of a marked patch at least, so that a single pixel is seen."""
SHOWN_SPANS = 6
"""Number of clipped stretches that a picture of a signal shows."""


@dataclass(frozen=True)
class ProblemPicture:
    """A picture for the page: address of its data, and what it shows."""

    source: str
    caption: str


def mark_image(
    image: GreyImage, caption: str, problem: BoolArray | None = None, *, full: int = 0, filled: bool = False
) -> ProblemPicture:
    """Return an image (H, W), reduced, with its problem outlined.

    `problem` (H, W): its pixels, `filled`: whether they are also coloured; without these the whole image is outlined.
    `full`: grey value that is shown white, by default the brightest one.
    """
    import cv2

    factor = min(1.0, WIDTH_PX / image.shape[1])
    size = max(1, round(factor * image.shape[1])), max(1, round(factor * image.shape[0]))
    white = max(full or float(image.max()), 1.0)
    grey = cv2.resize(np.clip(image * (255.0 / white), 0, 255).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    shown = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    if problem is None:
        cv2.rectangle(shown, (1, 1), (size[0] - 2, size[1] - 2), OUTLINE_BGR, 3)
    else:
        share = cv2.resize(problem.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        if filled:
            shown[share > 0.5] = OUTLINE_BGR
        patch = cv2.dilate((share > 0.0).astype(np.uint8), np.ones((LEAST_SHOWN_PX, LEAST_SHOWN_PX), np.uint8))
        outlines, _ = cv2.findContours(patch, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(shown, outlines, -1, OUTLINE_BGR, 2)
    _, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return ProblemPicture(f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode('ascii')}", caption)


def mark_signal(channel: RawChannel, defect: Defect | None = None) -> ProblemPicture:
    """Return the trace of a channel with the samples of a defect marked."""
    from fusion.report.figure import BLUE, RED, empty_figure  # imported late: few recordings have a defect
    from fusion.report.static_figure import static_svg

    samples, time_s = np.asarray(channel.samples, dtype=np.float64), channel.time_s
    first, last = 0, len(samples)
    bad = np.zeros(len(samples), dtype=bool)
    if defect is not None and len(defect.spans):
        bad = defect.mask(len(samples))
        begin, end = int(defect.spans[0, 0]), int(defect.spans[:SHOWN_SPANS, 1].max())
        room = max(end - begin, 8)
        first, last = max(0, begin - room // 2), min(len(samples), end + room // 2)
    drawn = empty_figure("problem", 2.2)
    panel = drawn.panels[0]
    x, y = time_s[first:last], samples[first:last]
    panel.line(x, y, colour=BLUE)
    if bad.any():
        panel.line(x, np.where(_widened(bad)[first:last], y, np.nan), colour=RED, width=3.0)
        for begin, end in defect.spans[:SHOWN_SPANS].tolist() if defect is not None else ():
            panel.span(time_s[begin], time_s[min(end, len(samples) - 1)], colour=RED, opacity=0.15, along="x")
    panel.x.label, panel.y.label = "time / s", f"{channel.unit or 'reading'}"
    data = base64.b64encode(static_svg(drawn).encode()).decode("ascii")
    caption = (
        "the whole record" if not bad.any() else f"the first of {len(defect.spans) if defect else 0} stretches, red"
    )
    return ProblemPicture(f"data:image/svg+xml;base64,{data}", caption)


def _widened(bad: BoolArray) -> BoolArray:
    """Return a mask with a sample more on both sides of each stretch."""
    return np.asarray(bad | np.roll(bad, 1) | np.roll(bad, -1))
