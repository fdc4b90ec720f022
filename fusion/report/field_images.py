"""Fields of stereo pairs as colours over camera images, for pages.

`templates/fields.js` draws them interactively. Images, points, values, U and phases of a field are its data.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from numpy.typing import NDArray

from fusion.base import prefix
from fusion.phasors.stereo_phasors import StereoResult
from fusion.report.field_data import COVERAGE_FACTOR, FieldQuantity, PairField, field_quantities
from fusion.report.figure import PHASE_COLOURS
from fusion.report.page_images import jpeg_source, reduced_image
from fusion.report.svg_marks import COLOURS
from shakercal._common.arrays import BoolArray, FloatArray

MOST_POINTS = 900
"""Largest number of points of a pair on a page; exports have all of them."""
MOST_LINES, MOST_VALUES = 4, 3000
"""Largest number of lines on a page, and of points of all pairs at all of them; exports have all of them."""
OPACITY = 0.8
"""Of the colours over an image."""
OUTSIDE = -1e-9  # smallest barycentric coordinate inside a triangle


class FieldScale(NamedTuple):
    """Colours from `low` to `high`, and the `factor` of their `unit` with SI prefix."""

    low: float
    high: float
    factor: float
    unit: str
    colours: tuple[str, ...]


class FieldFigure(NamedTuple):
    """One field of a page; `json` is safe within a page.

    `source`: address of the plain image, empty if the page shows it elsewhere by the same name. `coloured`: address of
    the image with the colours of the first quantity, described by `caption` and the ends `low` and `high` of its scale.
    """

    name: str
    body: str
    width: int
    height: int
    source: str
    coloured: str
    label: str
    low: str
    high: str
    unit: str
    points: int
    shown: int
    frames: int
    json: Markup


class FieldPage(NamedTuple):
    """Context of templates/fields.html."""

    figures: list[FieldFigure]
    quantities: list[tuple[str, str]]
    lines: list[str]
    measured: bool
    k: float
    ramp: str
    shapes: list[str]


def field_page(pairs: Sequence[PairField], results: Sequence[StereoResult], shown: Sequence[str]) -> FieldPage | None:
    """Return the fields of a page, None without any.

    `results`: of the pairs, with their first images. `shown`: names of the pairs whose image the page has elsewhere.
    """
    images = {item.name: item.reference_image for item in results if item.reference_image is not None}
    pairs = [pair for pair in pairs if pair.name in images]
    if not pairs:
        return None
    strongest = np.argsort(-np.linalg.norm(np.nan_to_num(pairs[0].rigid[:, :3]), axis=1), kind="stable")
    points = sum(min(len(pair.points_px), MOST_POINTS) for pair in pairs)
    count = int(np.clip(MOST_VALUES // points, 1, MOST_LINES))  # about 250 bytes for each point at each line
    lines = sorted(pairs[0].frequency_hz[strongest[:count]].tolist())
    lines.sort(key=lambda hertz: hertz != pairs[0].frequency_hz[strongest[0]])
    figures, names = list[FieldFigure](), dict[str, str]()
    for pair in pairs:
        made, quantities = _figure(pair, np.asarray(images[pair.name]), lines, pair.name in shown)
        figures.append(made)
        for one in quantities:
            names.setdefault(one.key, _shared_label(one.label) if len(pairs) > 1 else one.label)
    measured = any(pair.deviation is not None for pair in pairs)
    texts, ramp = [f"{hertz:.4f} Hz" for hertz in lines], ", ".join(COLOURS["viridis"])
    shapes = list(dict.fromkeys(name for pair in pairs if pair.shapes is not None for name in pair.shapes.names))
    return FieldPage(figures, list(names.items()), texts, measured, COVERAGE_FACTOR, ramp, shapes)


def _shared_label(label: str) -> str:
    """Return a label without the relation to the surface, which differs between pairs."""
    shared = label.replace(", out of plane)", ")").replace(", in plane)", ")")
    return shared.replace(" (out of plane)", "").replace(" (in plane)", "")


def _figure(
    pair: PairField, image: NDArray[Any], lines: Sequence[float], elsewhere: bool
) -> tuple[FieldFigure, list[FieldQuantity]]:
    """Return the figure of a pair and its quantities."""
    small, scale = reduced_image(image)
    total, pair = len(pair.points_px), pair.without_points(decimate_points(pair.points_px, pair.subset_px))
    at = [int(np.argmin(np.abs(pair.frequency_hz - hertz))) for hertz in lines]
    found = [(abs(pair.frequency_hz[k] - hertz) < 0.01 * hertz, k) for k, hertz in zip(at, lines, strict=True)]
    each = [field_quantities(pair, k) if present else [] for present, k in found]
    first = next(quantities for quantities in each if quantities)
    points = pair.points_px
    scaling = value_scale(first[0].amplitude, first[0].expanded, first[0].unit)
    colours = overlay(small, reduced_points(points, scale), pair.triangles, first[0].amplitude, scaling)
    low, high = scale_ends(scaling)
    data = {"name": pair.name} | encode_field(pair, each) | encode_points(points, pair.subset_px, scale, small.shape)
    figure = FieldFigure(
        name=pair.name,
        body=pair.body,
        width=small.shape[1],
        height=small.shape[0],
        source="" if elsewhere else jpeg_source(small),
        coloured=jpeg_source(colours),
        label=first[0].label,
        low=low,
        high=high,
        unit=scaling.unit,
        points=total,
        shown=len(points),
        frames=pair.frames,
        json=htmlsafe_json_dumps(data, separators=(",", ":")),
    )
    return figure, first


def encode_field(pair: PairField, each: Sequence[Sequence[FieldQuantity]]) -> dict[str, Any]:
    """Return the quantities of a field for `templates/fields.js`.

    `each`: those of each line, empty for a line that the pair does not have.
    """
    first = next(quantities for quantities in each if quantities)
    return {
        "triangles": pair.triangles.ravel().tolist(),
        "quantities": [_quantity(one, [_line(quantities, one.key) for quantities in each]) for one in first],
        "colours": {"size": COLOURS["viridis"], "sign": COLOURS["RdBu"], "phase": PHASE_COLOURS},
        "opacity": OPACITY,
    }


def encode_points(points_px: FloatArray, subset_px: float, scale: float, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return points (N, 2) of a camera's image for `templates/fields.js`.

    `scale`: pixels of the drawn image, of `shape` (h, w), per camera pixel.
    """
    return {
        "size": [shape[1], shape[0]],
        "scale": scale,
        "side": round(scale * subset_px, 2),
        "points": _coded(np.round(reduced_points(points_px, scale), 2)),
    }


def reduced_points(points_px: FloatArray, scale: float) -> FloatArray:
    """Return points (N, 2) in pixels of a reduced image."""
    return scale * (points_px + 0.5) - 0.5


def _line(quantities: Sequence[FieldQuantity], key: str) -> FieldQuantity | None:
    return next((one for one in quantities if one.key == key), None)


def _quantity(one: FieldQuantity, lines: Sequence[FieldQuantity | None]) -> Mapping[str, Any]:
    """Return a quantity at all lines, as numbers with their unit.

    For phasors Re, Im, U along and U across, then the noise; for others value and U."""
    phasor, shown = one.across is not None, list[Any]()
    for found in lines:
        if found is None:
            shown.append(None)
            continue
        factor, letter = prefix(found.amplitude) if found.unit else (1.0, "")
        columns = [found.value.real, *([found.value.imag] if phasor else []), found.expanded]
        columns += [] if found.across is None else [found.across]
        columns += [] if found.noise is None else [found.noise]
        shown.append({"unit": letter + found.unit, "values": _coded(np.stack(columns) / factor)})
    return {
        "key": one.key,
        "label": one.label,
        "kind": one.kind,
        "phasor": phasor,
        "noise": one.noise is not None,
        "lines": shown,
    }


def _coded(values: FloatArray) -> str:
    """Return numbers as little-endian floats of 32 bits in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def decimate_points(points_px: FloatArray, step_px: float) -> BoolArray:
    """Return which points (N,) a page shows: every n-th row and column."""
    places = np.round((points_px - points_px.min(axis=0)) / max(step_px, 1e-9)).astype(np.int64)
    every = 1
    while np.count_nonzero((places % every == 0).all(axis=1)) > MOST_POINTS:
        every += 1
    chosen = np.asarray((places % every == 0).all(axis=1))
    return chosen if np.count_nonzero(chosen) >= 3 else np.ones(len(points_px), dtype=np.bool_)


# Colours.


def value_scale(values: FloatArray, expanded: FloatArray, unit: str, *, signed: bool = False) -> FieldScale:
    """Return colours for values (N,): their range, or equal limits of both signs.

    A range narrower than the median U is widened to it, so that noise does not use all colours.
    """
    finite = np.isfinite(values)
    factor, letter = prefix(values) if unit else (1.0, "")
    if signed or not finite.any():
        high = float(np.abs(values[finite]).max(initial=0.0)) or 1.0
        return FieldScale(-high, high, factor, letter + unit, COLOURS["RdBu"])
    low, high = float(values[finite].min()), float(values[finite].max())
    least = float(np.nanmedian(expanded)) if np.isfinite(expanded).any() else 0.0
    widened = max(least - (high - low), 0.0, 1e-9 * abs(high)) / 2.0
    return FieldScale(low - widened, high + widened, factor, letter + unit, COLOURS["viridis"])


def scale_ends(scale: FieldScale) -> tuple[str, str]:
    """Return both ends of a scale with two significant digits of its range."""
    width = (scale.high - scale.low) / scale.factor
    decimals = max(0, 1 - int(np.floor(np.log10(width)))) if width > 0.0 else 2
    ends = (f"{end / scale.factor:.{decimals}f}" for end in (scale.low, scale.high))
    low, high = (end.replace("-", "\N{MINUS SIGN}") for end in ends)
    return low, high


def colour_table(colours: Sequence[str], levels: int = 256) -> NDArray[np.uint8]:
    """Return red, green, blue (levels, 3) between colours at equal steps."""
    given = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in colours], dtype=np.float64)
    at = np.linspace(0.0, len(given) - 1.0, levels)
    table = np.stack([np.interp(at, np.arange(len(given)), column) for column in given.T], axis=-1)
    return np.asarray(np.rint(table), dtype=np.uint8)


def raster(points_px: FloatArray, triangles: NDArray[np.int64], shape: tuple[int, int]) -> tuple[Any, Any]:
    """Return the triangle of every pixel, -1 for none, and its barycentric coordinates."""
    number, weight = np.full(shape, -1, dtype=np.int64), np.zeros((*shape, 3))
    for t, corners in enumerate(points_px[triangles]):
        low = np.maximum(np.ceil(corners.min(axis=0)).astype(int), 0)
        high = np.minimum(np.floor(corners.max(axis=0)).astype(int), np.array(shape)[::-1] - 1)
        sides = np.column_stack([corners[1] - corners[0], corners[2] - corners[0]])
        if (high < low).any() or abs(np.linalg.det(sides)) < 1e-9:
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        two = np.linalg.solve(sides, np.stack([x.ravel() - corners[0, 0], y.ravel() - corners[0, 1]]))
        three = np.stack([1.0 - two.sum(axis=0), *two], axis=-1).reshape(*x.shape, 3)
        inside = (three >= OUTSIDE).all(axis=-1)
        number[y[inside], x[inside]], weight[y[inside], x[inside]] = t, three[inside]
    return number, weight


def _squares(points_px: FloatArray, image: NDArray[np.uint8], side_px: float) -> tuple[Any, Any]:
    """Return the point (h, w) whose square holds each pixel, -1 for none."""
    number = np.full(image.shape[:2], -1, dtype=np.int64)
    for point, (x, y) in enumerate(points_px):
        rows, columns = (slice(max(0, round(at - side_px / 2)), max(0, round(at + side_px / 2))) for at in (y, x))
        number[rows, columns] = point
    return number, None


def overlay(
    image: NDArray[np.uint8],
    points_px: FloatArray,
    triangles: NDArray[np.int64],
    values: FloatArray,
    scale: FieldScale,
    side_px: float = 0.0,
) -> NDArray[np.uint8]:
    """Return an image with colours for values (N,) of points.

    Linear between neighbours, or with a `side_px` each point as a square. NaN is left free.
    """
    number, weight = (
        raster(points_px, triangles, image.shape[:2]) if not side_px else _squares(points_px, image, side_px)
    )
    shown = number >= 0
    found = values[number[shown]] if side_px else np.einsum("pc,pc->p", values[triangles[number[shown]]], weight[shown])
    share = np.clip((found - scale.low) / (scale.high - scale.low), 0.0, 1.0)
    colours = colour_table(scale.colours)[np.rint(255.0 * np.nan_to_num(share)).astype(np.int64)]
    out = np.repeat(image[..., None], 3, axis=2).astype(np.float64)
    mixed = (1.0 - OPACITY) * out[shown] + OPACITY * colours
    out[shown] = np.where(np.isfinite(found)[:, None], mixed, out[shown])
    return np.asarray(np.rint(out), dtype=np.uint8)
