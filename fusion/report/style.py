"""The look of figures on paper: fonts, margins, files; of those too that are drawn as pictures from the start."""

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
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from fusion.report.figure import power_text

WIDTH_IN = 8.4
RASTER_DPI = 200
RASTER_ABOVE = 500
"""Number of points above which they are drawn as an image inside the vector graphics."""
UNDATED: dict[str, dict[str, Any]] = {"svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None}, "png": {}}
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
    figure.savefig(stream, format="svg", dpi=RASTER_DPI, metadata=UNDATED["svg"])
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


def decades(axis: Axis) -> None:
    """Ticks of a logarithmic axis at powers of ten only."""
    axis.set_major_locator(LogLocator(10.0, numticks=6))
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: power_text(round(float(np.log10(value)))) if value > 0 else "")
    )
    axis.set_minor_locator(NullLocator())


def panel_label(axes: Axes, text: str) -> None:
    """Short label above the upper left corner of a panel."""
    axes.set_title(text, fontsize=8.0, fontweight="normal", pad=2.5)
