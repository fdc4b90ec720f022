"""Figures of what a calibration leaves: residuals over the picture, their distribution, picture by picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from fusion.camera_facts import SIDES, FloatArray, Side, cell_px, pictures, residual_map, used_points
from fusion.plots.camera_panels import KEY_IN, arrows, picture_panels, two_digits
from fusion.plots.style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
)
from photogram.calibrate.result import Calibration

MEAN_QUANTILE = 1.731
"""Length of a mean of noise, in units of its rms length, that one in twenty exceeds: √(−ln 0.05)."""
LONGEST_SHARE = 0.04  # of the picture's width, of the longest arrow
SIDE_COLOUR = {"left": BLUE, "right": ORANGE}
INK = {"left": "white", "right": BLACK}
MOST_NAMES = 8  # dropped pictures that are named in the figure
LONGEST_NAME = 16
BINS = 40


def draw_residuals(calibration: Calibration, side: Side) -> Picture:
    """All residuals of one camera, and their means in cells, which show what the model does not describe."""
    size = (calibration.rig.left if side == "left" else calibration.rig.right).size_px
    position, residual, _ = used_points(calibration, side)
    cells = residual_map(position, residual, cell_px(calibration, side))
    with drawing(f"residuals-{side}"):
        figure, panels = picture_panels(2, size, KEY_IN)
        arrows(panels[0], position, residual, LONGEST_SHARE * float(size[0]), SIDE_COLOUR[side], "px")
        panel_label(
            panels[0],
            f"all {len(position)} points, rms length {two_digits(calibration.rms_sides_px[SIDES.index(side)])} px",
        )
        length = np.hypot(*cells.mean_px.T)
        clear = length > MEAN_QUANTILE * cells.within_px / np.sqrt(cells.count)
        arrows(panels[1], cells.centre_px, cells.mean_px, 0.95 * cells.side_px, np.where(clear, RED, GREY), "px")
        panel_label(
            panels[1], f"mean per cell of {cells.side_px:.0f} px, systematic part {two_digits(cells.systematic_px)} px"
        )
        panels[1].set_ylabel("")
        caption = (
            "Found minus modelled positions, strongly enlarged (arrow below each panel; the two scales differ). Left: "
            "every point in the fit. Right: mean per cell, red where it is longer than noise would make it in one "
            f"cell of twenty ({int(clear.sum())} of {len(clear)} cells). The systematic part is the rms length "
            "of the cells' means, their noise taken off: what lens model and target leave, beside a scatter of "
            f"{two_digits(cells.within_px)} px within the cells."
        )
        return finish(figure, f"residuals-{side}", f"Residuals of the {side} camera", caption)


def draw_distribution(calibration: Calibration) -> Picture:
    """How long the residuals are in units of their standard uncertainty, beside what normal noise gives."""
    lengths = {
        side: np.concatenate(
            [np.empty(0), *(p.normalised[p.used] for p in pictures(calibration, side) if p is not None)]
        )
        for side in SIDES
    }
    every = np.concatenate(list(lengths.values()))
    scale = float(np.sqrt(np.mean(every**2) / 2.0)) if len(every) else 1.0
    with drawing("distribution"):
        figure = new_figure(2.7)
        panels = figure.subplots(1, 2)
        _draw_density(panels[0], lengths, scale)
        _draw_exceedance(panels[1], lengths, scale)
        lay_out(figure, panels, gap=(0.75, 0.1))
        caption = (
            "Length d of the residuals in units of their standard uncertainty: the points' own noise and what was "
            "added to it. Left: density; right: share of points beyond d. Normal noise of that size follows the solid "
            f"line, exp(−d²/2); dashed: the same for {scale:.2f} times the noise, the size found. Points above the "
            "lines on the right are outliers that the rule for dropping them has kept, or a systematic part."
        )
        return finish(figure, "distribution", "Distribution of the residuals", caption)


def draw_pictures(calibration: Calibration) -> Picture:
    """Rms of the residuals picture by picture, points left out and pictures dropped."""
    whole = [item for item in calibration.dropped if item.points == 0]
    with drawing("pictures"):
        figure = new_figure(2.6)
        axes = figure.subplots()
        for offset, side in zip((-0.21, 0.21), SIDES, strict=True):
            _draw_bars(axes, calibration, side, offset)
        top = 1.3 * float(np.nanmax([p.rms_px for side in SIDES for p in pictures(calibration, side) if p is not None]))
        axes.set_ylim(0.0, top)
        start = len(calibration.views) + 1.0
        if whole:
            axes.axvspan(start - 0.4, start + len(whole) - 0.6, color=LIGHT, alpha=0.5, linewidth=0.0)
            axes.plot(start + np.arange(len(whole)), np.full(len(whole), 0.05 * top), "x", color=RED, label="dropped")
        for place, item in enumerate(whole if len(whole) <= MOST_NAMES else []):
            name = item.name if len(item.name) <= LONGEST_NAME else "…" + item.name[1 - LONGEST_NAME :]
            axes.text(
                start + place, 0.12 * top, name, rotation=90, ha="center", va="bottom", fontsize=6.5, parse_math=False
            )
        axes.set_xlim(0.4, start + len(whole) - (0.4 if whole else 0.5))
        axes.set_xticks(range(1, len(calibration.views) + 1, 1 + len(calibration.views) // 30))
        axes.set_xlabel("view")
        axes.set_ylabel("rms length / px")
        axes.grid(visible=False, axis="x")
        axes.legend(ncols=5, loc="upper right")
        lay_out(figure, [axes])
        caption = (
            "Rms length of the residuals in every picture; numbers in the bars count the points left out, crosses are "
            "pictures dropped as a whole. Lines: rms over all pictures of the camera. A picture that stands out was "
            "blurred, or the target moved between the exposures of the two cameras."
        )
        return finish(figure, "pictures", "Residuals picture by picture", caption)


def _draw_density(axes: Axes, lengths: dict[Side, FloatArray], scale: float) -> None:
    """Histograms as densities with that of the length of normal noise."""
    reach = 4.5 * max(scale, 1.0)
    edges = np.linspace(0.0, reach, BINS + 1)
    for side, values in lengths.items():
        if len(values):
            counts, _ = np.histogram(values, bins=edges)
            axes.stairs(
                counts / (len(values) * np.diff(edges)), edges, color=SIDE_COLOUR[side], linewidth=1.1, label=side
            )
    fine = np.linspace(0.0, reach, 181)
    for size, dashes in ((1.0, "-"), (scale, "--")):
        axes.plot(fine, fine / size**2 * np.exp(-0.5 * (fine / size) ** 2), dashes, color=BLACK, linewidth=0.9)
    axes.set_xlim(0.0, reach)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("normalised residual d")
    axes.set_ylabel("density")
    axes.legend()


def _draw_exceedance(axes: Axes, lengths: dict[Side, FloatArray], scale: float) -> None:
    """Share of the points beyond every length, on a logarithmic axis."""
    most = max((len(values) for values in lengths.values()), default=1)
    for side, values in lengths.items():
        ordered = np.sort(values)
        share = 1.0 - (np.arange(len(ordered)) + 0.5) / max(len(ordered), 1)
        axes.plot(ordered, share, color=SIDE_COLOUR[side], linewidth=1.3, drawstyle="steps-post", label=side)
    reach = max(4.5 * max(scale, 1.0), *(values.max(initial=0.0) for values in lengths.values()))
    fine = np.linspace(0.0, reach, 181)
    for size, dashes, name in ((1.0, "-", "normal noise"), (scale, "--", f"normal noise × {scale:.2f}")):
        axes.plot(fine, np.exp(-0.5 * (fine / size) ** 2), dashes, color=BLACK, linewidth=0.9, label=name)
    axes.set_yscale("log")
    axes.set_ylim(0.3 / max(most, 1), 1.5)
    decades(axes.yaxis)
    axes.set_xlim(0.0, reach)
    axes.set_xlabel("normalised residual d")
    axes.set_ylabel("share of points beyond d")
    axes.legend(loc="lower left")


def _draw_bars(axes: Axes, calibration: Calibration, side: Side, offset: float) -> None:
    """Bars of one camera, the numbers of points left out, and the line of its rms."""
    for place, picture in enumerate(pictures(calibration, side)):
        if picture is None:
            continue
        x, height = place + 1 + offset, np.nan_to_num(picture.rms_px)
        axes.bar(x, height, 0.38, color=SIDE_COLOUR[side])
        left_out = int((~picture.used).sum())
        if left_out:
            text: dict[str, Any] = {"ha": "center", "fontsize": 7.0, "color": INK[side]}
            axes.annotate(str(left_out), (x, 0.0), (0, 2.5), textcoords="offset points", **text)
    level = calibration.rms_sides_px[SIDES.index(side)]
    axes.axhline(
        level, color=SIDE_COLOUR[side], linewidth=0.9, linestyle="--", label=f"{side}, all {two_digits(level)} px"
    )
