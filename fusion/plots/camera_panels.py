"""Panels that show a camera's picture area: frame, arrows with their key, colour bar, colours of the views."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from fusion.plots.style import BLACK, RASTER_ABOVE, WIDTH_IN, FloatArray, lay_out, new_figure
from shaker._checks import IntArray

MARGIN_IN, BETWEEN_IN, TOP_IN, AXIS_IN = (0.62, 0.12), 0.55, 0.28, 0.42
"""Left and right margin, gap between panels, room for a label above and for an axis below."""
FLATTEST_IN, TALLEST_IN = 1.2, 4.5
KEY_IN, BAR_IN = 0.2, 0.55
"""Room below the axis for the key of arrows, and for a colour bar."""
ARROW_WIDTH = 0.0035  # of a panel's width; thinner where there are many
KEPT = 0.98  # quantile of the arrows' lengths that sets their scale


def picture_panels(count: int, size_px: IntArray, below_in: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Figure of the page's width with panels side by side that show one picture area each in equal scales."""
    width = (WIDTH_IN - sum(MARGIN_IN) - (count - 1) * BETWEEN_IN) / count
    height = float(np.clip(width * size_px[1] / size_px[0], FLATTEST_IN, TALLEST_IN))
    bottom = AXIS_IN + below_in
    figure = new_figure(height + TOP_IN + bottom)
    panels = list(figure.subplots(1, count, squeeze=False)[0])
    for axes in panels:
        frame_picture(axes, size_px)
    panels[0].set_ylabel("y / px")
    left, right = MARGIN_IN
    lay_out(figure, panels, left=left, right=right, bottom=bottom, top=TOP_IN, gap=(BETWEEN_IN, 0.1), label=0.48)
    return figure, panels


def frame_picture(axes: Axes, size_px: IntArray) -> None:
    """The whole picture area, y down, with its border."""
    axes.set_xlim(-0.5, size_px[0] - 0.5)
    axes.set_ylim(size_px[1] - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x / px")
    bordered(axes)


def bordered(axes: Axes) -> None:
    """A border on all sides and no grid."""
    axes.grid(visible=False)
    axes.spines[["top", "right"]].set_visible(True)


def view_colours(count: int) -> FloatArray:
    """Colours (count, 4) of the views in their order."""
    return np.asarray(colormaps["viridis"](np.linspace(0.0, 0.92, count)))


def arrows(axes: Axes, place: FloatArray, vector: FloatArray, longest: float, colour: Any, unit: str) -> None:
    """Arrows (N, 2) at places (N, 2), nearly the longest drawn `longest` data units long, with their key below."""
    if not len(place):
        return
    size = float(np.quantile(np.hypot(vector[:, 0], vector[:, 1]), KEPT)) or 1.0
    scale: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": size / longest, "headwidth": 3.5}
    many = len(place) > RASTER_ABOVE
    width = ARROW_WIDTH * min(1.0, (RASTER_ABOVE / len(place)) ** 0.5)
    axes.quiver(*np.hstack([place, vector]).T, color=colour, width=width, rasterized=many, **scale)
    lone = axes.quiver(*place[:1].T, [0.0], [0.0], width=ARROW_WIDTH, **scale)
    key = float(f"{size:.1g}")
    low = -(AXIS_IN + 0.07) / height_in(axes)
    axes.quiverkey(lone, 0.5, low, key, f"{key:g} {unit}", labelpos="E", labelsep=0.06, color=BLACK)
    lone.set_visible(False)


def colour_bar(axes: Axes, drawn: ScalarMappable, label: str) -> Axes:
    """Horizontal colour bar below a panel's axis."""
    height = height_in(axes)
    place = axes.inset_axes((0.0, -(AXIS_IN + 0.14) / height, 1.0, 0.1 / height))
    axes.figure.colorbar(drawn, cax=place, orientation="horizontal")
    place.set_xlabel(label)
    place.grid(visible=False)
    return place


def height_in(axes: Axes) -> float:
    """Height of a panel as laid out."""
    return float(axes.get_position(original=True).height * figure_of(axes).get_size_inches()[1])


def figure_of(axes: Axes) -> Figure:
    """Figure that a panel belongs to."""
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("axes: expected a panel of a figure")
    return figure


def two_digits(value: float) -> str:
    """Two significant digits without an exponent, with a typographic minus."""
    if not np.isfinite(value):
        return "–"
    places = 0 if value == 0.0 else max(0, 1 - int(f"{value:.1e}".partition("e")[2]))
    return f"{value:.{places}f}".replace("-", "−")
