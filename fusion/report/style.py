"""One look for all figures: fonts, colours (Okabe and Ito's, distinct to colour-blind readers), units, SVG output."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from fusion.estimation.coverage import Polar
from shaker.arrays import ComplexArray, FloatArray

WIDTH_IN = 8.4
RASTER_DPI = 200
RASTER_ABOVE = 500
"""Number of points above which they are drawn as an image inside the vector graphics."""
BLACK, GREY, LIGHT = "#222222", "#7a7a7a", "#d9d9d9"
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9"
COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
"""Of what stands side by side in one figure, in this order."""
SOURCE_COLOUR = {"fused": BLACK, "photogrammetry": BLUE, "vibrometer": RED, "accelerometer": GREEN}
SOURCE_MARKER = {"fused": "o", "photogrammetry": "s", "vibrometer": "D", "accelerometer": "^"}
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
UNDATED: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}
STYLE = mpl.rc_params_from_file(Path(__file__).with_name("templates") / "figures.mplstyle", use_default_template=False)


@dataclass(frozen=True)
class Picture:
    """One figure: an identifier, a title, a caption of one or two sentences, and the SVG text."""

    name: str
    title: str
    caption: str
    svg: str


@contextmanager
def drawing(name: str) -> Iterator[None]:
    """Apply the style, and make identifiers inside the SVG depend on the figure's name only."""
    settings: Any = {**STYLE, "svg.hashsalt": name}
    with mpl.rc_context(settings):
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Empty figure of the page's width."""
    return Figure(figsize=(width_in, height_in))


def lay_out(
    panels: Sequence[Axes],
    *,
    left: float = 0.72,
    right: float = 0.12,
    bottom: float = 0.45,
    top: float = 0.12,
    gap: tuple[float, float] = (0.6, 0.14),
    label: float = 0.52,
) -> None:
    """Margins, gaps (across, down) and the distance of the y labels from their panel, all in inches."""
    figure, grid = panels[0].get_figure(root=True), panels[0].get_gridspec()
    if figure is None:
        raise ValueError("panels: expected those of a figure, found others")
    width, height = figure.get_size_inches()
    across, down = (grid.ncols, grid.nrows) if grid is not None else (1, 1)
    panel_width = (width - left - right - (across - 1) * gap[0]) / across
    panel_height = (height - bottom - top - (down - 1) * gap[1]) / down
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        wspace=gap[0] / panel_width,
        hspace=gap[1] / panel_height,
    )
    for axes in panels:
        axes.yaxis.set_label_coords(-label / (axes.get_position().width * width), 0.5)


def finish(figure: Figure, name: str, title: str, caption: str) -> Picture:
    """Turn a figure into SVG text without date or other metadata that would change from run to run."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", dpi=RASTER_DPI, metadata={"Date": None, "Creator": None})
    return Picture(name, title, caption, stream.getvalue())


def as_file(figure: Figure, kind: str) -> bytes:
    """Turn a figure into a png, svg or pdf file without a date."""
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=RASTER_DPI, metadata=UNDATED[kind])
    return stream.getvalue()


@dataclass(frozen=True)
class Sheet:
    """A figure in the making: its name, and its panels from the upper left on, row by row."""

    name: str
    figure: Figure
    panels: tuple[Axes, ...]

    def picture(self, title: str, caption: str, **layout: Any) -> Picture:
        """Lay the panels out (`lay_out`, below a row of panel labels) and turn the figure into SVG text."""
        lay_out(self.panels, **{"top": 0.24, "left": 0.78, "label": 0.58, **layout})
        return finish(self.figure, self.name, title, caption)

    def file(self, kind: str, **layout: Any) -> bytes:
        """Lay the panels out (`lay_out`) and turn the figure into a png, svg or pdf file without a date."""
        lay_out(self.panels, **layout)
        return as_file(self.figure, kind)


@contextmanager
def sheet(
    name: str,
    height_in: float,
    rows: int = 1,
    columns: int = 1,
    *,
    heights: Sequence[float] | None = None,
    widths: Sequence[float] | None = None,
    **shared: Any,
) -> Iterator[Sheet]:
    """Give a figure of the page's width with panels that share their horizontal axis down a column."""
    with drawing(name):
        figure = new_figure(height_in)
        ratios = {"height_ratios": list(heights or [1.0] * rows), "width_ratios": list(widths or [1.0] * columns)}
        options = {"sharex": "col", **shared, "squeeze": False, "gridspec_kw": ratios}
        yield Sheet(name, figure, tuple(figure.subplots(rows, columns, **options).ravel()))


def thin_out(x: FloatArray, y: FloatArray, edges: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest `y` of each interval between `edges`, with its own `x`: peaks survive, the file stays small."""
    order = np.searchsorted(edges, x, side="right")
    starts = np.flatnonzero(np.diff(order, prepend=-1))
    best = [start + int(np.argmax(y[start:stop])) for start, stop in zip(starts, [*starts[1:], len(x)], strict=True)]
    return x[best], y[best]


def padded(low: float, high: float, share: float = 0.15) -> tuple[float, float]:
    """Axis limits with some room on both sides."""
    room = share * (high - low) if high > low else share * max(abs(high), 1e-300)
    return low - room, high + room


def power_text(exponent: int) -> str:
    """Power of ten in plain characters, which draw much faster than typeset ones."""
    return "10" + str(exponent).translate(SUPERSCRIPT)


def decades(axis: Axis) -> None:
    """Ticks of a logarithmic axis at powers of ten only."""
    axis.set_major_locator(LogLocator(10.0, numticks=6))
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: power_text(round(float(np.log10(value)))) if value > 0 else "")
    )
    axis.set_minor_locator(NullLocator())


def plain_logarithm(axis: Axis, subs: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Ticks of a logarithmic axis at powers of ten times `subs`, as plain numbers."""
    axis.set_major_locator(LogLocator(10.0, subs=subs, numticks=8))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def frequency_axis(axes: Axes, frequency_hz: FloatArray, wide_band: float = 8.0) -> None:
    """Frequency over the whole of `frequency_hz`, logarithmic where its ends are further apart than `wide_band`."""
    axes.set_xlim(float(frequency_hz[0]), float(frequency_hz[-1]))
    if frequency_hz[-1] > wide_band * frequency_hz[0]:
        axes.set_xscale("log")
        plain_logarithm(axes.xaxis)
    axes.set_xlabel("frequency / Hz")


def draw_response(
    upper: Axes,
    lower: Axes,
    frequency_hz: FloatArray,
    value: ComplexArray,
    u: tuple[FloatArray, FloatArray] | None = None,
    *,
    unwrapped: bool = False,
    **style: Any,
) -> None:
    """Draw magnitude (logarithmic) and phase in degrees of a curve over frequency, with bands of U (k = 2).

    `u`: relative standard uncertainty of the magnitude and that of the phase in rad, (K,) each. A phase that is not
    `unwrapped` lies within ±180° and has no strokes across that.
    """
    look = {"linewidth": 0.9, "zorder": 2.0, **style}
    size, phase = np.abs(value), np.degrees(np.angle(value))
    if unwrapped:
        phase = np.degrees(np.unwrap(np.angle(value)))
    else:
        phase = np.where(np.abs(np.diff(phase, prepend=phase[:1])) > 180.0, np.nan, phase)
        lower.set_ylim(-190.0, 190.0)
        lower.set_yticks([-180, -90, 0, 90, 180])
    upper.plot(frequency_hz, size, **look)
    lower.plot(frequency_hz, phase, **{**look, "label": None})
    if u is not None:
        band: dict[str, Any] = {"color": look.get("color"), "alpha": 0.25, "linewidth": 0, "zorder": 1}
        low, high = size * np.maximum(1.0 - 2.0 * u[0], 1e-3), size * (1.0 + 2.0 * u[0])
        upper.fill_between(frequency_hz, low, high, **band)
        turn = 2.0 * np.degrees(np.minimum(u[1], np.pi / 4.0))
        lower.fill_between(frequency_hz, phase - turn, phase + turn, **band)
    upper.set_yscale("log")
    lower.set_ylabel("phase / °")


def square_corners(points: FloatArray, side: float) -> FloatArray:
    """Corners (N, 4, 2) of squares about points (N, 2)."""
    corner = 0.5 * side * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.asarray(points[:, None, :] + corner)


def power_of_ten(values: FloatArray) -> tuple[float, str]:
    """Return a factor to take off values, and its text before their unit: none where they are readable as they are."""
    largest = float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0))
    power = int(np.floor(np.log10(largest))) if largest > 0.0 else 0
    return (1.0, "") if -2 <= power < 4 else (10.0**power, f"{power_text(power)} ")


def polar_bars(values: Sequence[Polar], factor: float) -> tuple[FloatArray, FloatArray]:
    """Return magnitude over `factor` and phase in rad of values as rows (2, N), and their expanded uncertainties."""
    rows = [(v.magnitude / factor, v.phase_rad, v.expanded_magnitude / factor, v.expanded_phase_rad) for v in values]
    level, half = np.asarray(rows, dtype=np.float64).reshape(len(rows), 2, 2).transpose(1, 2, 0)
    return level, half


def frame_bars(
    upper: Axes, lower: Axes, bars: tuple[FloatArray, FloatArray], magnitude: str, static: tuple[float, str] | None
) -> None:
    """Label `polar_bars` over frequency, in limits that hold all of them and what they are compared with.

    `magnitude`: unit of the magnitude; `static`: value at rest, with what it is called in the legend.
    """
    references = [] if static is None else [static[0]], [0.0]
    for axes, level, half, reference in zip((upper, lower), *bars, references, strict=True):
        ends = np.concatenate([level - half, level + half, reference])
        known = ends[np.isfinite(ends)]
        if len(known):
            axes.set_ylim(padded(float(known.min()), float(known.max())))
        axes.yaxis.set_major_locator(MaxNLocator(6))
    upper.set_ylabel(f"magnitude / {magnitude}")
    lower.set_ylabel("phase / rad")
    lower.axhline(0.0, color=GREY, linewidth=0.8)
    if static is not None:
        static_axis(upper, *static)


def panel_label(axes: Axes, text: str) -> None:
    """Short label above the upper left corner of a panel."""
    axes.set_title(text, fontsize=8.0, fontweight="normal", pad=2.5)


def static_axis(axes: Axes, static: float, label: str) -> None:
    """Draw a line at the static sensitivity, and on the right the deviation from it."""
    axes.axhline(static, color=RED, linewidth=1.0, linestyle=(0, (5, 3)), label=label)

    def deviation(magnitude: Any) -> Any:
        return np.asarray(100.0 * (np.asarray(magnitude) / static - 1.0))

    def magnitude(deviation: Any) -> Any:
        return np.asarray(static * (1.0 + np.asarray(deviation) / 100.0))

    right = axes.secondary_yaxis("right", functions=(deviation, magnitude))
    right.set_ylabel("deviation from static / %")
    right.spines["right"].set_visible(True)
