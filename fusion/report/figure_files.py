"""Figures as files: PNG or PDF by matplotlib, SVG by `static_figure`."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from fusion.report.figure import (
    LIGHT,
    Arrows,
    Band,
    Bounds,
    Boxes,
    Ellipses,
    Figure,
    Image,
    Line,
    Mark,
    Panel,
    PanelAxis,
    Points,
    Rule,
    Scale,
    Span,
    Texts,
    power_text,
)
from fusion.report.layout import WIDTH_IN, frames, has_upright_names, scale_below
from fusion.report.static_figure import static_svg

RASTER_DPI = 200
"""Resolution of raster images and of PNG files (chosen for print)."""
RASTER_ABOVE = 500
"""Number of points above which they are a raster image inside the vector graphics."""
UNDATED: dict[str, dict[str, Any]] = {"svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None}, "png": {}}
STYLE = mpl.rc_params_from_file(Path(__file__).with_name("templates") / "figures.mplstyle", use_default_template=False)
LINE_RASTER_ABOVE = 2_000
"""Number of points above which a line is a raster image inside the vector graphics."""
LEGEND_COLUMNS = 6
SHAPES = {
    "circle": "o", "square": "s", "diamond": "D", "triangle": "^", "inverted_triangle": "v", "cross": "P", "x": "x",
    "plus": "+",
}  # fmt: skip


@dataclass(frozen=True)
class PrintedFigure:
    """One figure as SVG text with an identifier, a title and a caption."""

    name: str
    title: str
    caption: str
    svg: str


@contextmanager
def drawing(name: str) -> Iterator[None]:
    """Apply the style, with SVG identifiers that depend only on the name of the figure."""
    settings: Any = {**STYLE, "svg.hashsalt": name}
    with mpl.rc_context(settings):
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Canvas:
    """Return an empty figure of the page's width."""
    return Canvas(figsize=(width_in, height_in))


def figure_bytes(figure: Canvas, kind: str) -> bytes:
    """Return a figure as a png, svg or pdf file without a date."""
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=RASTER_DPI, metadata=UNDATED[kind])
    return stream.getvalue()


def finish(figure: Canvas, name: str, title: str, caption: str) -> PrintedFigure:
    """Return a figure as SVG text without a date."""
    return PrintedFigure(name, title, caption, figure_bytes(figure, "svg").decode())


def render_figure(figure: Figure, kind: str = "svg") -> bytes:
    """Return a figure as a file: svg, png or pdf.

    Equal figures give equal bytes.
    """
    if kind == "svg":
        return static_svg(figure).encode()
    with drawing(figure.name):
        return figure_bytes(_canvas(figure), kind)


def _canvas(figure: Figure) -> Canvas:
    """Return all panels of a figure in the page's width."""
    rows, columns = len(figure.heights), len(figure.widths)
    canvas = new_figure(figure.height_in)
    shared: Any = {"sharex": "col" if figure.shared_x else False, "sharey": "row" if figure.shared_y else False}
    shares = {"height_ratios": figure.heights, "width_ratios": figure.widths}
    every = canvas.subplots(rows, columns, squeeze=False, gridspec_kw=shares, **shared)
    handles, upright = dict[str, Any](), has_upright_names(figure)
    for index, panel in enumerate(figure.panels):
        row, column = divmod(index, columns)
        inner = (figure.shared_x and row < rows - 1, figure.shared_y and column > 0)
        if upright:
            every[row, column].tick_params(axis="x", labelrotation=90)
        handles = _draw_panel(every[row, column], panel, inner) | handles
    _lay_out(figure, every, 0.2 * -(-len(handles) // LEGEND_COLUMNS))
    if handles:
        look: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (0.05, 1.0), "borderaxespad": 0.2}
        canvas.legend(handles.values(), handles.keys(), ncols=LEGEND_COLUMNS, **look)
    return canvas


def _lay_out(figure: Figure, every: Any, legend_in: float) -> None:
    """Set the positions of axes, labels and colour bars."""
    for axes, panel, frame in zip(every.flat, figure.panels, frames(figure, legend_in), strict=True):
        rect = frame.left, figure.height_in - frame.top - frame.height, frame.width, frame.height
        axes.set_position(
            tuple(part / whole for part, whole in zip(rect, 2 * (WIDTH_IN, figure.height_in), strict=True))
        )
        axes.yaxis.set_label_coords(-(frame.left_margin - 0.16) / frame.width, 0.5)
        if (scale := scale_below(panel)) is not None:
            _colour_bar(axes, scale, -frame.bottom_margin / frame.height, 0.1 / frame.height)


def _colour_bar(axes: Axes, scale: Scale, below: float, height: float) -> None:
    """Draw a horizontal colour bar below a panel."""
    bar_axes = axes.inset_axes((0.0, below - height, 1.0, height))
    colours, norm = _colours(scale)
    axes.figure.colorbar(ScalarMappable(norm, colours), cax=bar_axes, orientation="horizontal")
    bar_axes.set_xlabel(scale.label)
    bar_axes.grid(visible=False)


def _draw_panel(axes: Axes, panel: Panel, inner: tuple[bool, bool]) -> dict[str, Any]:
    """Draw axes and marks of one panel, and return the marks by label.

    `inner`: whether another panel has its numbers of x, of y.
    """
    for name in "xy":
        if getattr(panel, name).log:
            getattr(axes, f"set_{name}scale")("log")
    handles: dict[str, Any] = {}
    for mark in panel.marks:
        drawn = DRAWN[type(mark)](axes, mark)
        if mark.label:
            handles.setdefault(mark.label, drawn)
    for name, hidden in zip("xy", inner, strict=True):
        _set_axis(axes, name, getattr(panel, name), hidden=hidden)
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim" if panel.x.limits is None else "box")
    if panel.title:
        axes.set_title(panel.title, fontsize=8.0, fontweight="normal", pad=2.5)
    if panel.blank:
        axes.set_axis_off()
    return handles


def _set_axis(axes: Axes, name: str, spec: PanelAxis, *, hidden: bool) -> None:
    """Set label, limits, numbers and second scale of one axis."""
    axis = axes.xaxis if name == "x" else axes.yaxis
    if spec.label and not hidden:
        axis.set_label_text(spec.label)
    if spec.names:
        axis.set_ticks(range(len(spec.names)), [] if hidden else list(spec.names))
        getattr(axes, f"set_{name}lim")(
            *((-0.6, len(spec.names) - 0.4) if name == "x" else (len(spec.names) - 0.4, -0.6))
        )
    elif spec.ticks:
        axis.set_ticks(spec.ticks)
    elif spec.log:
        _logarithm(axes, name)
    else:
        axis.set_major_locator(MaxNLocator(6))
    if spec.limits is not None:
        getattr(axes, f"set_{name}lim")(*spec.limits)
    axes.grid(visible=spec.grid and not (spec.names and name == "y"), axis="x" if name == "x" else "y")
    if spec.second is not None and name == "y":
        label, zero, factor = spec.second
        functions: Any = (lambda v: factor * (np.asarray(v) - zero), lambda v: np.asarray(v) / factor + zero)
        right = axes.secondary_yaxis("right", functions=functions)
        right.set_ylabel(label)
        right.spines["right"].set_visible(True)


def _logarithm(axes: Axes, name: str) -> None:
    """Set the numbers of a logarithmic axis: powers of ten, or 1, 2, 5."""
    axis = axes.xaxis if name == "x" else axes.yaxis
    low, high = sorted(axis.get_view_interval())
    narrow = low > 0.0 and high < 100.0 * low and high < 1e5
    axis.set_major_locator(LogLocator(10.0, subs=(1.0, 2.0, 5.0) if narrow else (1.0,), numticks=8))

    def text(value: float, _: Any) -> str:
        if value <= 0.0:
            return ""
        return f"{value:g}" if narrow else power_text(round(float(np.log10(value))))

    axis.set_major_formatter(FuncFormatter(text))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def _colours(scale: Scale) -> tuple[Colormap, Normalize]:
    """Return the colours of a scale and the normalisation of values."""
    if isinstance(scale.colours, str):
        colours = mpl.colormaps["RdBu_r" if scale.colours == "RdBu" else scale.colours]
    else:
        colours = LinearSegmentedColormap.from_list("custom", scale.colours)
    return colours.with_extremes(bad=LIGHT), (LogNorm if scale.log else Normalize)(scale.low, scale.high)


# One function per kind of mark; it returns the entry of the legend.


def _draw_line(axes: Axes, mark: Line) -> Any:
    look: dict[str, Any] = {"linestyle": (0, (5, 3)) if mark.dashed else "-"}
    if mark.step:
        look["drawstyle"] = "steps-post"
    many = len(mark.x) > LINE_RASTER_ABOVE
    (drawn,) = axes.plot(mark.x, mark.y, color=mark.colour, linewidth=mark.width, rasterized=many, **look)
    return drawn


def _draw_points(axes: Axes, mark: Points) -> Any:
    many = len(mark.x) > RASTER_ABOVE
    if mark.values is not None and mark.scale is not None:
        colours, norm = _colours(mark.scale)
        look: dict[str, Any] = {"cmap": colours, "norm": norm, "linewidths": 0, "rasterized": many}
        shape = SHAPES[mark.marker]
        return axes.scatter(mark.x, mark.y, s=mark.size**2, c=mark.values, marker=shape, zorder=3, **look)
    look = {"markersize": mark.size, "markerfacecolor": "none" if mark.open else mark.colour, "color": mark.colour}
    look |= {"elinewidth": 1.0, "capthick": 1.0, "capsize": 0.0 if many else 2.5, "rasterized": many, "zorder": 3}
    if not mark.open and mark.marker in ("circle", "square", "diamond"):
        look["markeredgewidth"] = 0
    return axes.errorbar(mark.x, mark.y, mark.half_y, mark.half_x, fmt=SHAPES[mark.marker], **look)


def _draw_bounds(axes: Axes, mark: Bounds) -> Any:
    along: dict[str, Any] = (
        {"xerr": 0.5 * mark.x, "xuplims": True} if mark.along == "x" else {"yerr": 0.5 * mark.y, "uplims": True}
    )
    return axes.errorbar(mark.x, mark.y, color=mark.colour, fmt="none", elinewidth=1.0, **along)


def _draw_band(axes: Axes, mark: Band) -> Any:
    return axes.fill_between(mark.x, mark.low, mark.high, color=mark.colour, alpha=0.25, linewidth=0, zorder=1)


def _draw_span(axes: Axes, mark: Span) -> Any:
    draw = axes.axvspan if mark.along == "x" else axes.axhspan
    return draw(mark.low, mark.high, color=mark.colour, alpha=mark.opacity, linewidth=0, zorder=0.5)


def _draw_rule(axes: Axes, mark: Rule) -> Any:
    draw = axes.axvline if mark.along == "x" else axes.axhline
    look: dict[str, Any] = {"linewidth": mark.width, "linestyle": (0, (5, 3)) if mark.dashed else "-"}
    lines = [draw(float(value), color=mark.colour, **look) for value in mark.at]
    return lines[-1]


def _draw_ellipses(axes: Axes, mark: Ellipses) -> Any:
    centres, reach = np.stack([mark.x, mark.y], 1), 0.5 * np.maximum(mark.width, mark.height)[:, None]
    look: dict[str, Any] = {"facecolors": "none", "edgecolors": mark.colour, "linewidths": 1.1}
    angles = np.degrees(mark.angle_rad)
    drawn = EllipseCollection(
        mark.width, mark.height, angles, units="xy", offsets=centres, offset_transform=axes.transData, **look
    )
    axes.add_collection(drawn)
    axes.update_datalim(np.concatenate([centres - reach, centres + reach]))
    return drawn


def _draw_boxes(axes: Axes, mark: Boxes) -> Any:
    corners = np.stack([mark.left, mark.low, mark.left, mark.high, mark.right, mark.high, mark.right, mark.low], 1)
    look: dict[str, Any] = {"facecolor": mark.colour, "linewidth": 0.0}
    if not mark.filled:
        look = {"facecolor": "none", "edgecolor": mark.colour, "linewidth": 0.5}
    drawn = PolyCollection(list(corners.reshape(-1, 4, 2)), **look)
    if mark.values is not None and mark.scale is not None:
        colours, norm = _colours(mark.scale)
        drawn.set_array(np.ma.masked_invalid(mark.values))
        drawn.set_cmap(colours)
        drawn.set_norm(norm)
    drawn.set_rasterized(len(corners) > RASTER_ABOVE)
    axes.add_collection(drawn)
    axes.autoscale_view()
    return drawn


def _draw_arrows(axes: Axes, mark: Arrows) -> Any:
    look: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.006, "headwidth": 3.5}
    return axes.quiver(
        mark.x, mark.y, mark.dx, mark.dy, color=mark.colour, rasterized=len(mark.x) > RASTER_ABOVE, **look
    )


def _draw_texts(axes: Axes, mark: Texts) -> None:
    look: dict[str, Any] = {"textcoords": "offset points", "ha": mark.align, "va": "center", "fontsize": 7.5}
    if mark.upright:
        look |= {"rotation": 90, "va": "bottom", "fontsize": 5.5}
    for x, y, text in zip(mark.x, mark.y, mark.texts, strict=True):
        axes.annotate(text, (x, y), mark.offset_px, color=mark.colour, annotation_clip=True, **look)


def _draw_image(axes: Axes, mark: Image) -> None:
    extent = (mark.left, mark.right, mark.bottom, mark.top)
    axes.imshow(mark.grey, cmap="gray", vmin=0, vmax=255, extent=extent, aspect="auto", interpolation="none")


DRAWN: dict[type[Mark], Callable[[Axes, Any], Any]] = {
    Line: _draw_line,
    Points: _draw_points,
    Bounds: _draw_bounds,
    Band: _draw_band,
    Span: _draw_span,
    Rule: _draw_rule,
    Ellipses: _draw_ellipses,
    Boxes: _draw_boxes,
    Arrows: _draw_arrows,
    Texts: _draw_texts,
    Image: _draw_image,
}
