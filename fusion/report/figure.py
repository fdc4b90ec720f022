"""Description of a figure: panels, axes and marks, independent of the program that draws it."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.estimation.coverage import Polar
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.digits import exponent_of, power_text

BLACK, GREY, LIGHT = "#222222", "#7a7a7a", "#d9d9d9"
"""On dark pages their opposites."""
WHITE, DARK = "#ffffff", "#111111"
"""On coloured ground, the same on every page."""
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9"
"""Okabe and Ito's, distinct to colour-blind readers."""
COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
"""Colours of series in one figure, in this order."""
SOURCE_COLOUR = {"fused": BLACK, "photogrammetry": BLUE, "vibrometer": RED, "accelerometer": GREEN}
SOURCE_MARKER = {"fused": "circle", "photogrammetry": "square", "vibrometer": "diamond", "accelerometer": "triangle"}
PHASE_COLOURS = (BLUE, GREEN, ORANGE, PURPLE, BLUE)
"""Colours of -180, -90, 0, 90 and 180 degrees."""
FEW, STRETCHES = 200, 1500
"""Largest number of values with ten digits; number of stretches of a long line whose extremes are drawn."""
WIDTH_IN, SHEET_IN = 8.4, 11.0
"""Width of a page's figure, and largest height on A4 paper at that width, which is scaled to the paper's."""
Along = Literal["x", "y"]


@dataclass(frozen=True)
class Scale:
    """Colours of values from `low` to `high`: a name, or colours at equal steps.

    With a `label` a colour bar is drawn.
    """

    colours: str | tuple[str, ...]
    low: float
    high: float
    label: str = ""
    log: bool = False


@dataclass(frozen=True, kw_only=True)
class Mark:
    """Part of a panel; `label` is its entry in the legend."""

    label: str = ""
    colour: str = BLUE


@dataclass(frozen=True, kw_only=True)
class Line(Mark):
    """Line through points (N,); NaN interrupts it.

    `step`: constant from each point to the next.
    """

    x: FloatArray
    y: FloatArray
    width: float = 1.1
    dashed: bool = False
    step: bool = False


@dataclass(frozen=True, kw_only=True)
class Points(Mark):
    """Markers at (N,) with optional error bars, names and colours.

    `half_x`, `half_y`: half lengths of the bars (U). `names`: shown by the pointer. `values`: coloured by `scale`.
    """

    x: FloatArray
    y: FloatArray
    half_x: FloatArray | None = None
    half_y: FloatArray | None = None
    marker: str = "circle"
    size: float = 4.5
    open: bool = False
    names: tuple[str, ...] = ()
    values: FloatArray | None = None
    scale: Scale | None = None


@dataclass(frozen=True, kw_only=True)
class Bounds(Mark):
    """Upper bounds at (N,): an arrow from each towards smaller values of x or y."""

    x: FloatArray
    y: FloatArray
    along: Along = "y"


@dataclass(frozen=True, kw_only=True)
class Band(Mark):
    """Area between two curves over x (N,)."""

    x: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, kw_only=True)
class Span(Mark):
    """Area between two values of x or y, across the whole panel."""

    low: float
    high: float
    opacity: float
    along: Along = "y"


@dataclass(frozen=True, kw_only=True)
class Rule(Mark):
    """Lines at values (N,) of x or y, across the whole panel."""

    at: FloatArray
    along: Along = "y"
    dashed: bool = False
    width: float = 0.8


@dataclass(frozen=True, kw_only=True)
class Ellipses(Mark):
    """Ellipses about (N,) with whole axes and the angle of the first one from x."""

    x: FloatArray
    y: FloatArray
    width: FloatArray
    height: FloatArray
    angle_rad: FloatArray


@dataclass(frozen=True, kw_only=True)
class Boxes(Mark):
    """Rectangles (N,): bars, classes of a histogram or cells of a map.

    They are filled in one colour or by `values`, or only outlined.
    """

    left: FloatArray
    right: FloatArray
    low: FloatArray
    high: FloatArray
    filled: bool = True
    names: tuple[str, ...] = ()
    values: FloatArray | None = None
    scale: Scale | None = None


@dataclass(frozen=True, kw_only=True)
class Arrows(Mark):
    """Arrows from (N,) by (dx, dy) in the units of the axes."""

    x: FloatArray
    y: FloatArray
    dx: FloatArray
    dy: FloatArray


@dataclass(frozen=True, kw_only=True)
class Texts(Mark):
    """Texts at (N,).

    `align`: left of, centred at or right of the point; `offset_px`: shift across and up; `upright`: read upwards.
    """

    x: FloatArray
    y: FloatArray
    texts: tuple[str, ...]
    align: Literal["left", "center", "right"] = "center"
    offset_px: tuple[float, float] = (0.0, 0.0)
    upright: bool = False


@dataclass(frozen=True, kw_only=True)
class Image(Mark):
    """Grey image (rows, columns) of bytes that fills a rectangle of the axes."""

    grey: NDArray[np.uint8]
    left: float
    right: float
    top: float
    bottom: float


@dataclass
class PanelAxis:
    """One axis of a panel.

    `limits`: first and last value, the first at the left or below; by default those of all marks. `names`: labels at 0,
    1, …; `ticks`: values with numbers. `second`: label, zero and factor of a second scale, factor·(value - zero).
    `link`: axes of this name move together in all figures of a page.
    """

    label: str = ""
    limits: tuple[float, float] | None = None
    log: bool = False
    names: tuple[str, ...] = ()
    ticks: tuple[float, ...] = ()
    second: tuple[str, float, float] | None = None
    link: str = ""
    grid: bool = True


@dataclass
class Panel:
    """One pair of axes and its marks in drawing order.

    `blank`: only its texts are shown.
    """

    title: str = ""
    x: PanelAxis = field(default_factory=PanelAxis)
    y: PanelAxis = field(default_factory=PanelAxis)
    marks: list[Mark] = field(default_factory=list)
    equal: bool = False
    blank: bool = False

    def line(self, x: ArrayLike, y: ArrayLike, label: str = "", **look: Any) -> None:
        """Add a `Line`; of very many points only the extremes of each stretch."""
        x, y = extremes(_row(x), _row(y))
        self.marks.append(Line(label=label, x=x, y=y, **look))

    def points(self, x: ArrayLike, y: ArrayLike, label: str = "", **look: Any) -> None:
        """Add a `Points`; one bar length for all points may be a number."""
        x, y = _row(x), _row(y)
        for name in ("half_x", "half_y", "values"):
            if look.get(name) is not None:
                look[name] = np.broadcast_to(_row(look[name]), x.shape)
        self.marks.append(Points(label=label, x=x, y=y, **look))

    def bounds(self, x: ArrayLike, y: ArrayLike, label: str = "", **look: Any) -> None:
        """Add `Bounds`."""
        self.marks.append(Bounds(label=label, x=_row(x), y=_row(y), **look))

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, label: str = "", **look: Any) -> None:
        """Add a `Band`."""
        x = _row(x)
        ends: Any = {"low": np.broadcast_to(_row(low), x.shape), "high": np.broadcast_to(_row(high), x.shape)}
        self.marks.append(Band(label=label, x=x, **ends, **look))

    def span(self, low: float, high: float, label: str = "", **look: Any) -> None:
        """Add a `Span`; its default colour is light grey."""
        plain: dict[str, Any] = {"colour": LIGHT, "opacity": 0.15 if "colour" in look else 0.5}
        self.marks.append(Span(label=label, low=float(low), high=float(high), **(plain | look)))

    def rule(self, at: ArrayLike, label: str = "", **look: Any) -> None:
        """Add a `Rule`; its default colour is black. Without values there is no mark."""
        at = _row(at)
        if len(at):
            self.marks.append(Rule(label=label, at=at, **{"colour": BLACK, **look}))

    def ellipse(
        self, centre: complex, axes: tuple[float, float], angle_rad: float, label: str = "", **look: Any
    ) -> None:
        """Add one ellipse about a complex value with its half-axes."""
        width, height = (_row(2.0 * axis) for axis in axes)
        centre_fields: Any = {"x": _row(centre.real), "y": _row(centre.imag), "angle_rad": _row(angle_rad)}
        self.marks.append(Ellipses(label=label, **centre_fields, width=width, height=height, **look))

    def boxes(
        self, x: tuple[ArrayLike, ArrayLike], y: tuple[ArrayLike, ArrayLike], label: str = "", **look: Any
    ) -> None:
        """Add `Boxes` between pairs of x and of y."""
        if look.get("values") is not None:
            look["values"] = _row(look["values"])
        left, right, low, high = np.broadcast_arrays(*(_row(end) for end in (*x, *y)))
        self.marks.append(Boxes(label=label, left=left, right=right, low=low, high=high, **look))

    def squares(self, middle: FloatArray, side: float, label: str = "", **look: Any) -> None:
        """Add `Boxes` of one side about places (N, 2)."""
        half = 0.5 * side
        x, y = middle.T
        self.boxes((x - half, x + half), (y - half, y + half), label, **look)

    def arrows(self, position: FloatArray, vector: FloatArray, label: str = "", **look: Any) -> None:
        """Add `Arrows` from places (N, 2) by vectors (N, 2)."""
        (x, y), (dx, dy) = np.asarray(position, np.float64).T, np.asarray(vector, np.float64).T
        self.marks.append(Arrows(label=label, x=x, y=y, dx=dx, dy=dy, **look))

    def text(self, x: ArrayLike, y: ArrayLike, texts: Sequence[str] | str, **look: Any) -> None:
        """Add `Texts`, black without a colour."""
        lines = (texts,) if isinstance(texts, str) else tuple(texts)
        self.marks.append(Texts(x=_row(x), y=_row(y), texts=lines, **{"colour": BLACK, **look}))

    def image(self, grey: NDArray[np.uint8], across: tuple[float, float], down: tuple[float, float]) -> None:
        """Add an `Image` from `across` to `down` ends in the units of the axes."""
        self.marks.append(Image(grey=grey, left=across[0], right=across[1], top=down[0], bottom=down[1]))


@dataclass(frozen=True)
class Figure:
    """Panels row by row with a title and a caption of one or two sentences.

    `height_in`, `width_in`: of the printed one; `heights` and `widths`: shares of rows and columns; `main`: shown where
    the page may run no programs, too.
    """

    name: str
    panels: tuple[Panel, ...]
    height_in: float
    heights: tuple[float, ...]
    widths: tuple[float, ...]
    shared_x: bool
    shared_y: bool
    title: str = ""
    caption: str = ""
    main: bool = False
    width_in: float = WIDTH_IN

    def with_title(self, title: str, caption: str, *, main: bool = False) -> Figure:
        """Return the figure with title and caption."""
        return replace(self, title=title, caption=caption, main=main)

    def sheets(self) -> list[Figure]:
        """Return the figure in parts of whole rows that fit on a sheet of paper."""
        columns, parts, first = len(self.widths), list[Figure](), 0
        each = np.asarray(self.heights) * self.height_in / sum(self.heights)
        for row in range(1, len(each) + 1):
            if row == len(each) or each[first : row + 1].sum() > SHEET_IN:
                panels = self.panels[first * columns : row * columns]
                height_in = float(each[first:row].sum())
                parts.append(replace(self, panels=panels, heights=self.heights[first:row], height_in=height_in))
                first = row
        return parts

    def json(self) -> str:
        """Return the figure as JSON for `figures.js`, without default values."""
        data = {
            "name": self.name,
            "title": self.title,
            "height_in": self.height_in,
            "heights": self.heights,
            "widths": self.widths,
            "shared_x": self.shared_x,
            "shared_y": self.shared_y,
            "panels": [
                {
                    "title": panel.title,
                    "x": _plain(panel.x),
                    "y": _plain(panel.y),
                    "equal": panel.equal,
                    "blank": panel.blank,
                    "marks": [{"kind": type(mark).__name__, **_plain(mark)} for mark in panel.marks],
                }
                for panel in self.panels
            ],
        }
        return _text(data)


def empty_figure(
    name: str,
    height_in: float,
    rows: int | Sequence[float] = 1,
    columns: int | Sequence[float] = 1,
    *,
    shared_x: bool = True,
    shared_y: bool = False,
) -> Figure:
    """Return a figure of empty panels that share an axis.

    `rows` and `columns`: their numbers, or their shares of height and width. `shared_x`: one horizontal axis per
    column. `shared_y`: one vertical axis per row.
    """
    heights, widths = ((1.0,) * part if isinstance(part, int) else tuple(part) for part in (rows, columns))
    panels = tuple(Panel() for _ in range(len(heights) * len(widths)))
    return Figure(name, panels, height_in, heights, widths, shared_x, shared_y)


def _row(values: ArrayLike) -> FloatArray:
    """Return numbers as an array (N,)."""
    return np.atleast_1d(np.asarray(values, dtype=np.float64)).ravel()


def _plain(part: Any) -> dict[str, Any]:
    """Return the fields of an axis or mark that are not at their defaults."""
    plain: dict[str, Any] = {}
    for entry in fields(part):
        value = getattr(part, entry.name)
        if isinstance(value, np.ndarray):
            plain[entry.name] = jpeg_uri(value) if value.dtype == np.uint8 else value
        elif isinstance(value, Scale):
            plain[entry.name] = _plain(value)
        elif value is not None and value != entry.default:
            plain[entry.name] = value
    return plain


_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


def _text(data: Any) -> str:
    """Return JSON without blanks; few numbers with ten digits, many with seven, NaN as null."""
    if isinstance(data, dict):
        return f"{{{','.join(f'{_ENCODER.encode(name)}:{_text(value)}' for name, value in data.items())}}}"
    if isinstance(data, list):
        return f"[{','.join(map(_text, data))}]"
    if not isinstance(data, np.ndarray):
        return _ENCODER.encode(data)
    written = ",".join(["%.10g" if len(data) <= FEW else "%.7g"] * len(data))
    return f"[{written % tuple(np.where(np.isfinite(data), data, np.nan).tolist())}]".replace("nan", "null")


def jpeg_uri(grey: NDArray[np.uint8]) -> str:
    """Return a grey image as the source of an HTML image element."""
    import cv2

    _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 75])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


# Common parts of figures.


def padded_limits(low: float, high: float, share: float = 0.15) -> tuple[float, float]:
    """Return axis limits with a margin on both sides."""
    margin = share * (high - low) if high > low else share * max(abs(high), 1e-300)
    return low - margin, high + margin


def power_of_ten(values: FloatArray) -> tuple[float, str]:
    """Return a common power of ten of values, and its text before the unit."""
    exponent = exponent_of(float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0)))
    return (10.0**exponent, f"{power_text(exponent)} ") if exponent else (1.0, "")


def extremes(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest `y` of each of `STRETCHES` stretches, with their `x`."""
    each = -(-len(y) // STRETCHES)
    if each <= 4:
        return x, y
    whole = np.concatenate([y, np.full(-len(y) % each, np.nan)]).reshape(-1, each)
    missing = np.isnan(whole)
    ends = np.where(missing, np.inf, whole).argmin(axis=1), np.where(missing, -np.inf, whole).argmax(axis=1)
    selected = np.unique(np.concatenate(ends).reshape(2, -1) + each * np.arange(len(whole)))
    return x[selected], y[selected]


def decimate_edges(x: FloatArray, y: FloatArray, edges: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the largest `y` of each interval between `edges`, with its `x`.

    Peaks remain while the file stays small. `x` must increase.
    """
    starts = np.unique([0, *np.searchsorted(x, edges)])
    starts = starts[starts < len(x)]
    largest = np.repeat(np.maximum.reduceat(y, starts), np.diff(starts, append=len(x)))
    peaks = np.flatnonzero(~(y < largest))
    best = peaks[np.searchsorted(peaks, starts)]  # the first of each interval
    return x[best], y[best]


def frequency_axis(axis: PanelAxis, frequency_hz: FloatArray, wide_band: float = 8.0) -> None:
    """Set a frequency axis over all of `frequency_hz`.

    Logarithmic if the ratio of its ends exceeds `wide_band`.
    """
    axis.limits = (float(frequency_hz[0]), float(frequency_hz[-1]))
    axis.log = bool(frequency_hz[-1] > wide_band * frequency_hz[0])
    axis.label, axis.link = "frequency / Hz", "frequency"


def draw_response(
    upper: Panel,
    lower: Panel,
    frequency_hz: FloatArray,
    value: ComplexArray,
    u: tuple[FloatArray, FloatArray] | None = None,
    *,
    unwrapped: bool = False,
    dots: bool = False,
    **style: Any,
) -> None:
    """Draw magnitude and phase in degrees over frequency, with bands of U (k = 2).

    `u`: relative standard uncertainty of the magnitude and that of the phase in rad, (K,) each. A phase that is not
    `unwrapped` is within ±180°, and its line is interrupted at jumps. `dots`: one dot per value instead of a line.
    """
    look = {"size": 2.0, **style} if dots else {"width": 0.9, **style}
    size, phase = np.abs(value), np.degrees(np.angle(value))
    if unwrapped:
        phase = np.degrees(np.unwrap(np.angle(value)))
    else:
        phase = np.where(np.abs(np.diff(phase, prepend=phase[:1])) > 180.0, np.nan, phase)
        lower.y.limits, lower.y.ticks = (-190.0, 190.0), (-180.0, -90.0, 0.0, 90.0, 180.0)
    if u is not None:
        band = {key: look[key] for key in ("colour", "label") if key in look}
        upper.band(frequency_hz, size * np.maximum(1.0 - 2.0 * u[0], 1e-3), size * (1.0 + 2.0 * u[0]), **band)
        turn = 2.0 * np.degrees(np.minimum(u[1], np.pi / 4.0))
        lower.band(frequency_hz, phase - turn, phase + turn, **band)
    for panel, values in ((upper, size), (lower, phase)):
        (panel.points if dots else panel.line)(frequency_hz, values, **look)
    upper.y.log, lower.y.label = True, "phase / °"


def polar_bars(values: Sequence[Polar], factor: float) -> tuple[FloatArray, FloatArray]:
    """Return magnitude over `factor` and phase in rad, and their U, (2, N) each."""
    rows = [(v.magnitude / factor, v.phase_rad, v.expanded_magnitude / factor, v.expanded_phase_rad) for v in values]
    level, half = np.asarray(rows, dtype=np.float64).reshape(len(rows), 2, 2).transpose(1, 2, 0)
    return level, half


def frame_bars(
    upper: Panel, lower: Panel, bars: tuple[FloatArray, FloatArray], magnitude: str, static: tuple[float, str] | None
) -> None:
    """Label `polar_bars` over frequency and set limits that include bars and reference.

    `magnitude`: unit of the magnitude; `static`: static value with its name in the legend.
    """
    references = [] if static is None else [static[0]], [0.0]
    for panel, level, half, reference in zip((upper, lower), *bars, references, strict=True):
        ends = np.concatenate([level - half, level + half, reference])
        finite = ends[np.isfinite(ends)]
        if len(finite):
            panel.y.limits = padded_limits(float(finite.min()), float(finite.max()))
    upper.y.label, lower.y.label = f"magnitude / {magnitude}", "phase / rad"
    lower.rule(0.0, colour=GREY)
    if static is not None:
        upper.rule(static[0], static[1], colour=RED, dashed=True, width=1.0)
        upper.y.second = ("from static / %", static[0], 100.0 / static[0])
