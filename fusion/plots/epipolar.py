"""Figure of one stereo pair: whether its cameras still are, and stay, what was calibrated."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from fusion.plots.style import (
    BLACK,
    BLUE,
    LIGHT,
    RASTER_ABOVE,
    RED,
    FloatArray,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
)
from photogram.epipolar import COVERAGE, EpipolarCheck

MPX = 1e3
SMALLEST_PX = 1e-3  # range of the colours where residuals are smaller
COLOURS = "RdBu_r"


def draw_epipolar(check: EpipolarCheck, time_s: FloatArray, name: str) -> Picture:
    """Mean epipolar residual over time with what the calibration explains, and its mean over time over the picture."""
    title = f"epipolar-{name}"
    with drawing(title):
        figure = new_figure(2.7)
        course, picture = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.5, 1.0]})
        _draw_course(course, check, time_s)
        _draw_residuals(picture, check)
        lay_out(figure, (course, picture), right=0.75, gap=(0.75, 0.14))
        explained = (
            "Grey band: what calibration and matching explain, k = 2. "
            if check.pattern_covariance is not None
            else "The calibration states no uncertainty to compare with. "
        )
        caption = (
            "How far the points of the right picture are off the epipolar lines of their left ones. Left: mean over "
            f"the points, frame by frame, bars: image noise, k = 2. {explained}A camera that moves makes a step or a "
            "drift. Right: mean over the frames, over the left picture."
        )
        return finish(figure, title, f"Epipolar residuals of {name}", caption)


def _draw_course(axes: Axes, check: EpipolarCheck, time_s: FloatArray) -> None:
    """The mean residual over time."""
    if check.pattern_covariance is not None:
        explained = MPX * COVERAGE * float(np.sqrt(check.pattern_covariance[0, 0]))
        axes.axhspan(-explained, explained, color=LIGHT, linewidth=0)
    axes.axhline(0.0, color=BLACK, linewidth=0.6)
    axes.errorbar(
        time_s,
        MPX * check.mean_px,
        yerr=MPX * COVERAGE * check.u_course_px[:, 0],
        color=BLUE,
        fmt="o",
        markersize=2.6,
        elinewidth=0.7,
        capsize=0.0,
        rasterized=len(time_s) > RASTER_ABOVE,
    )
    axes.set_xlabel("time / s")
    axes.set_ylabel("mean residual / mpx")


def _draw_residuals(axes: Axes, check: EpipolarCheck) -> None:
    """The mean residual of every point at its place in the left picture; outliers as crosses."""
    known = np.isfinite(check.residual_px)
    if not known.any():
        axes.set_axis_off()
        return
    limit = MPX * max(SMALLEST_PX, float(np.abs(check.residual_px[known]).max()))
    x, y = check.position_px.T
    points = axes.scatter(
        x[known], y[known], c=MPX * check.residual_px[known], cmap=COLOURS, vmin=-limit, vmax=limit, s=14, linewidths=0
    )
    points.set_rasterized(int(known.sum()) > RASTER_ABOVE)
    axes.plot(x[~known], y[~known], "x", color=RED, markersize=4)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.set_xlabel("x / px")
    axes.set_ylabel("y / px")
    bar = axes.inset_axes((1.03, 0.0, 0.04, 1.0))
    axes.figure.colorbar(points, cax=bar)
    bar.set_ylabel("residual / mpx")
