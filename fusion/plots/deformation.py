"""Figure of one stereo pair: how its body bends at a line, out of its plane and in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap
from numpy.typing import NDArray

from fusion.deflection import DeflectionShape
from fusion.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    RASTER_ABOVE,
    FloatArray,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
)
from fusion.polar import prefix
from shaker._checks import ComplexArray

AXES = ("x", "y", "z")
OUT_QUANTILE, INSIDE_QUANTILE = 2.448, 3.080
"""Amplitude of one and of two components, in standard uncertainties of their parts, that noise exceeds at 5 % of the
points: square roots of the 95 % quantiles of chi-square with 2 and 4 degrees of freedom."""
LONGEST_ARROW = 1.6  # distances between neighbours
PHASE_COLOURS = (BLUE, GREEN, ORANGE, PURPLE, BLUE)
"""Colours of -180, -90, 0, 90 and 180 degrees, distinct from the grey of points without a phase."""
PANEL_IN, TALLEST_IN, FLATTEST_IN = 2.2, 3.2, 0.8
BELOW_IN, ABOVE_IN, BAR_IN, BAR_HEIGHT_IN = 1.15, 0.3, 0.68, 0.11
MARGIN_SHARE = 0.03


@dataclass(frozen=True)
class _View:
    """A shape at one line as it is drawn: plan (N, 2) in mm, out of plane (N,), in plane (N, 2), and noise levels."""

    plan_mm: FloatArray
    out: ComplexArray
    out_level: FloatArray
    inside: ComplexArray
    inside_level: FloatArray
    normal: int
    across: tuple[int, int]

    @property
    def side_mm(self) -> float:
        """Distance of neighbouring points."""
        sample = self.plan_mm[:: max(1, len(self.plan_mm) // 200)]
        distance = np.abs(sample[:, None, :] - self.plan_mm[None, :, :]).max(axis=2)
        distance[distance < 1e-6] = np.inf
        return float(np.median(distance.min(axis=1)))

    @property
    def limits_mm(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the panels: the whole body with room for a square at its edge."""
        low, high = self.plan_mm.min(axis=0), self.plan_mm.max(axis=0)
        room = 1.2 * self.side_mm + MARGIN_SHARE * float((high - low).max())
        return low - room, high + room

    @property
    def height_in(self) -> float:
        """Height of the panels for equal scales."""
        low, high = self.limits_mm
        return float(np.clip(PANEL_IN * (high[1] - low[1]) / (high[0] - low[0]), FLATTEST_IN, TALLEST_IN))


def draw_deflection(shape: DeflectionShape, line: int, rigid: ComplexArray, name: str, body: str) -> Picture | None:
    """Amplitude and phase of the deflection out of the plane of the points, and the deflection in that plane.

    `rigid` (6,): displacement phasors of the body at this line; phases are counted from its largest translation. None
    when fewer than three points have a deflection.
    """
    known = np.isfinite(shape.value[line]).all(axis=1)
    if known.sum() < 3:
        return None
    view = _view(shape.reference_m[known], shape.value[line][known], shape.u[line][known])
    leader = int(np.argmax(np.abs(rigid[:3])))
    above = np.abs(view.out) > view.out_level
    identifier = f"deflection-{name}"
    with drawing(identifier):
        figure = new_figure(view.height_in + BELOW_IN + ABOVE_IN)
        panels = figure.subplots(1, 3)
        _draw_amplitude(panels[0], view)
        _draw_phase(panels[1], view, above, (float(np.angle(rigid[leader])), AXES[leader]))
        _draw_in_plane(panels[2], view)
        for axes in panels:
            _frame(axes, view)
        panels[0].set_ylabel(f"{AXES[view.across[1]]} / mm")
        lay_out(figure, panels, left=0.6, bottom=BELOW_IN, top=ABOVE_IN, gap=(0.5, 0.1), label=0.42)
        caption = (
            f"What the {body} does beside its rigid motion at {shape.frequency_hz[line]:.4f} Hz, seen by stereo pair "
            f"“{name}” (peak values). Left: amplitude along {AXES[view.normal]}, out of the plane of the points; "
            f"{above.sum()} of {len(above)} points are above the noise level, which noise alone exceeds at one point "
            f"in twenty. Middle: phase against the rigid translation along {AXES[leader]}, grey where the amplitude "
            "is below that level. Right: deflection in the plane at the instant of its largest extent, grey below "
            "the noise level. Bending appears smaller by the rigid motion that fits it best."
        )
        return finish(figure, identifier, f"Operating deflection shape seen by {name}", caption)


def _view(reference_m: FloatArray, value: ComplexArray, u: FloatArray) -> _View:
    """Plan and components of a shape (N, 3) with uncertainties (N, 3), in the plane that fits the points best."""
    _, _, axes = np.linalg.svd(reference_m - reference_m.mean(axis=0), full_matrices=False)
    normal = axes[2]
    main = int(np.argmax(np.abs(normal)))
    normal = normal * np.sign(normal[main])
    first, second = (axis for axis in range(3) if axis != main)
    out = value @ normal
    inside = (value - out[:, None] * normal)[:, [first, second]]
    return _View(
        plan_mm=1e3 * reference_m[:, [first, second]],
        out=out,
        out_level=OUT_QUANTILE * np.sqrt(u**2 @ normal**2),
        inside=inside,
        inside_level=INSIDE_QUANTILE * np.sqrt(np.mean(u[:, [first, second]] ** 2, axis=1)),
        normal=main,
        across=(first, second),
    )


def _draw_amplitude(axes: Axes, view: _View) -> None:
    """Squares coloured by the amplitude out of the plane; the colour bar shows the noise level."""
    factor, letter = prefix(np.abs(view.out))
    largest = float(np.abs(view.out).max()) / factor
    level = float(np.median(view.out_level)) / factor
    squares = _squares(view, np.abs(view.out) / factor, colormaps["viridis"], (0.0, max(largest, level)))
    axes.add_collection(squares)
    bar = _colour_bar(axes, view, squares, f"amplitude / {letter}m")
    bar.axvline(level, color="white", linewidth=2.6)
    bar.axvline(level, color=BLACK, linewidth=1.2)
    panel_label(axes, f"out of plane ({AXES[view.normal]}), noise level {float(f'{level:.2g}'):g} {letter}m")


def _draw_phase(axes: Axes, view: _View, above: NDArray[np.bool_], leader: tuple[float, str]) -> None:
    """Squares coloured by the phase out of the plane, against the leader's, where the amplitude is above the noise."""
    phase = np.degrees(np.angle(view.out * np.exp(-1j * leader[0])))
    colours = LinearSegmentedColormap.from_list("phase", PHASE_COLOURS)
    squares = _squares(view, np.where(above, phase, np.nan), colours, (-180.0, 180.0))
    axes.add_collection(squares)
    bar = _colour_bar(axes, view, squares, f"phase against {leader[1]} / °")
    bar.set_xticks([-180, -90, 0, 90, 180])
    panel_label(axes, f"out of plane ({AXES[view.normal]}), phase")


def _draw_in_plane(axes: Axes, view: _View) -> None:
    """Arrows at the instant at which the deflection in the plane is largest."""
    instant = np.exp(-0.5j * np.angle(np.sum(view.inside**2)))
    arrows = (view.inside * instant).real
    length = np.sqrt(np.sum(np.abs(view.inside) ** 2, axis=1))
    factor, letter = prefix(arrows)
    colour = np.where(length > view.inside_level, BLUE, GREY)
    longest = float(np.quantile(np.hypot(arrows[:, 0], arrows[:, 1]), 0.98)) / factor
    scale = max(longest, 1e-12) / (LONGEST_ARROW * view.side_mm)
    quiver = axes.quiver(
        *view.plan_mm.T,
        *(arrows / factor).T,
        color=list(colour),
        angles="xy",
        scale_units="xy",
        scale=scale,
        width=0.006,
        headwidth=3.5,
        rasterized=len(arrows) > RASTER_ABOVE,
    )
    key = float(f"{longest:.1g}")
    axes.quiverkey(
        quiver,
        0.5,
        -(BAR_IN - BAR_HEIGHT_IN) / view.height_in,
        key,
        f"{key:g} {letter}m",
        labelpos="S",
        labelsep=0.06,
        color=BLACK,
    )
    level = float(np.median(view.inside_level)) / factor
    names = ", ".join(AXES[axis] for axis in view.across)
    panel_label(axes, f"in plane ({names}), noise level {float(f'{level:.2g}'):g} {letter}m")


def _squares(view: _View, values: FloatArray, colours: Colormap, limits: tuple[float, float]) -> PolyCollection:
    """Squares about the points, coloured by values (N,), light grey where they are NaN."""
    corner = 0.47 * view.side_mm * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    squares = PolyCollection(list(view.plan_mm[:, None, :] + corner), linewidth=0.0, edgecolor="none")
    squares.set_array(np.ma.masked_invalid(values))
    squares.set_cmap(colours.with_extremes(bad=LIGHT))
    squares.set_clim(*limits)
    squares.set_rasterized(len(values) > RASTER_ABOVE)
    return squares


def _colour_bar(axes: Axes, view: _View, squares: PolyCollection, label: str) -> Axes:
    """Horizontal colour bar under a panel."""
    place = axes.inset_axes((0.0, -BAR_IN / view.height_in, 1.0, BAR_HEIGHT_IN / view.height_in))
    axes.figure.colorbar(squares, cax=place, orientation="horizontal")
    place.set_xlabel(label)
    place.grid(visible=False)
    return place


def _frame(axes: Axes, view: _View) -> None:
    """Equal scales and the whole body."""
    low, high = view.limits_mm
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel(f"{AXES[view.across[0]]} / mm")
    axes.grid(visible=False)
