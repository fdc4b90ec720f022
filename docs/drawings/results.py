"""Drawings of the results: a row, a budget, a curve, regions in the complex plane, and the tree of result.h5.

The numbers are those of the demo recording, evaluated once, and of the table of docs/nitsche2018.md.
"""

from __future__ import annotations

import csv
import re
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from style import BLUE, DARK, GREEN, GREY, ORANGE, RED, ROOT, VIOLET, blank, marked_table, new_figure

from fusion import Settings, run_path

MONO = {"family": "DejaVu Sans Mono", "fontsize": 7.5, "va": "center"}
LARGEST = 9
COLUMNS = (
    ("what", BLUE, ("frequency_hz", "channel", "component", "unit", "kind", "recording")),
    ("value", DARK, ("magnitude", "phase_rad", "re", "im")),
    ("uncertainty", ORANGE, ("u_magnitude", "u_phase_rad", "u_re", "u_im", "r", "dof", "dof_magnitude", "dof_phase")),
    ("for 95 %", GREEN, ("k_magnitude", "k_phase", "region_re", "region_im", "region_r")),
)
BRANCHES = (
    ("inputs", GREY, ("provenance", "evidence", "excitation", "sensor")),
    ("signals", BLUE, ("lines", "clocks", "channels", "set_ups")),
    ("motion", VIOLET, ("stereo", "points", "accelerations")),
    ("results", ORANGE, ("load", "outputs", "sensitivity", "element", "notices")),
)


@cache
def _demo() -> tuple[list[dict[str, str]], dict[str, Any]]:
    """Return the rows of sensitivity.csv, and parts of result.h5, of the demo recording."""
    with tempfile.TemporaryDirectory() as folder:
        (outcome,) = run_path(ROOT / "sample_images" / "demo", Path(folder) / "results", Settings())
        with (outcome.folder / "sensitivity.csv").open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        with h5py.File(outcome.folder / "result.h5") as file:
            main = file["element"]
            at = list(main["channels"].asstr()).index("Fz")
            budget = {
                part.attrs["label"]: (float(part["u_relative"][0, at]), str(part.attrs["type"]))
                for part in main["budget"].values()
            }
            tree = {name: _members(node) for name, node in file.items() if isinstance(node, h5py.Group)}
    return rows, {"budget": budget, "tree": tree}


def _members(group: h5py.Group) -> list[str]:
    return [f"{name}/" if isinstance(node, h5py.Group) else name for name, node in group.items()]


def _row(channel: str, kind: str) -> dict[str, str]:
    return next(row for row in _demo()[0] if (row["channel"], row["kind"]) == (channel, kind))


def result_budget() -> Figure:
    """Draw the largest lines of the budget of the demo's sensitivity."""
    budget = sorted(_demo()[1]["budget"].items(), key=lambda item: item[1][0])[-LARGEST:]
    total = float(np.sqrt(sum(value[0] ** 2 for value in _demo()[1]["budget"].values())))
    figure, axes = new_figure(2.9)
    names = [f"{label}" for label, _ in budget]
    colours = [ORANGE if kind == "A" else BLUE for _, (_, kind) in budget]
    axes.barh(names, [100.0 * size for _, (size, _) in budget], color=colours, height=0.65)
    axes.barh(["all together"], [100.0 * total], color=GREY, height=0.65)
    for kind, colour in (("Type A: from the scatter", ORANGE), ("Type B: stated", BLUE)):
        axes.barh([0], [0], color=colour, label=kind)
    axes.set(xlabel="relative standard uncertainty of the sensitivity / %")
    axes.legend(loc="center right")
    axes.set_title("Nine largest contributions, demo recording")
    return figure


def result_curve() -> Figure:
    """Draw sensitivity and phase over frequency with U, static and true values, from docs/nitsche2018.md."""
    frequency, size, expanded, phase, phase_expanded, truth, true_phase = _published_curve()
    figure, (above, below) = new_figure(3.9, 2, 1, sharex=True)
    for panel, value, u, true in ((above, size, expanded, truth), (below, phase, phase_expanded, true_phase)):
        panel.plot(frequency, true, color=GREY, lw=1.0, label="true value of the simulation")
        panel.errorbar(frequency, value, u, fmt="o", ms=3, color=BLUE, capsize=3, lw=1.2, label="result with U (95 %)")
    above.axhline(2.0, color=RED, lw=1.0, ls="--", label="static sensitivity")
    above.set(ylabel="S / (10⁻⁷ (V/V)/N)")
    below.set(ylabel="phase / rad", xlabel="frequency / Hz", xlim=(0, 1080))
    above.legend(loc="lower left")
    above.set_title("Sensitivity Fz of a simulated campaign: every bar covers the true curve")
    return figure


def _published_curve() -> list[np.ndarray]:
    """Return frequency, fused magnitude, its U, phase, its U, true magnitude and phase of the page's table."""
    rows = []
    for line in marked_table("nitsche2018.md", "figure 14"):
        cells = [cell.replace("\N{MINUS SIGN}", "-") for cell in line]
        (size, u), (phase, u_phase) = (cells[at].split(" ± ") for at in (5, 6))
        rows.append([float(cell) for cell in (cells[0], size, u, phase, u_phase, cells[7], cells[8])])
    return list(np.array(rows).T)


def result_row() -> Figure:
    """Draw one row of sensitivity.csv, its columns in groups."""
    row = _row("Fz", "element")
    figure, axes = new_figure(2.9)
    blank(axes, (0.0, 20.0), (0.0, 9.4), "auto")
    left = 0.0
    for (title, colour, names), width in zip(COLUMNS, (5.1, 4.6, 5.6, 4.7), strict=True):
        axes.text(left + 0.15, 9.0, title, color=colour, fontsize=9.5, weight="bold", va="center")
        axes.plot([left + 0.1, left + width - 0.35], [8.5, 8.5], color=colour, lw=1.5)
        for at, name in enumerate(names):
            y = 7.8 - 0.98 * at
            axes.text(left + 0.15, y, name, color=colour, **MONO)
            axes.text(left + width - 0.4, y, _short(row[name]), ha="right", color=DARK, fontsize=7.5, va="center")
        left += width
    return figure


def _short(text: str) -> str:
    """Return a cell of a table with five digits."""
    try:
        number = float(text)
    except ValueError:
        return text.split(",", maxsplit=1)[0]
    return re.sub(r"e([+-])0?(\d)", r"e\1\2", f"{number:.6g}").replace("-", "\N{MINUS SIGN}")


def result_region() -> Figure:
    """Draw a strong phasor with its ellipse, and a weak one whose region contains zero."""
    figure, (strong, weak) = new_figure(3.0, 1, 2)
    for panel, value, covariance, title in (
        (strong, 1.0 + 0.7j, np.array([[0.010, 0.006], [0.006, 0.008]]), "strong: magnitude and phase"),
        (weak, 0.16 + 0.1j, np.array([[0.010, -0.004], [-0.004, 0.016]]), "weak: the 95 % region contains zero"),
    ):
        angle = np.linspace(0.0, 2.0 * np.pi, 241)
        circle = np.stack([np.cos(angle), np.sin(angle)])
        ellipse = 2.448 * np.linalg.cholesky(covariance) @ circle
        panel.fill(value.real + ellipse[0], value.imag + ellipse[1], color=BLUE, alpha=0.2, lw=0)
        panel.plot(value.real + ellipse[0], value.imag + ellipse[1], color=BLUE, label="95 % region")
        panel.annotate("", (value.real, value.imag), (0, 0), arrowprops={"arrowstyle": "-|>", "color": DARK, "lw": 1.5})
        panel.axhline(0.0, color=GREY, lw=0.6)
        panel.axvline(0.0, color=GREY, lw=0.6)
        panel.plot([0], [0], "o", color=RED, ms=4)
        panel.set(aspect="equal", xlabel="real part")
        panel.set_title(title)
    _polar_errors(strong, 1.0 + 0.7j, np.array([[0.010, 0.006], [0.006, 0.008]]))
    reach = 2.448 * np.sqrt([0.010, 0.016])
    weak.annotate("", (0.16, 0.1), (0.16 + reach[0], 0.1), arrowprops={"arrowstyle": "<|-|>", "color": ORANGE})
    weak.annotate("", (0.16, 0.1), (0.16, 0.1 + reach[1]), arrowprops={"arrowstyle": "<|-|>", "color": ORANGE})
    weak.text(0.2, 0.04, "region_re", color=ORANGE, fontsize=8)
    weak.text(0.15, 0.22, "region_im", color=ORANGE, fontsize=8, ha="right")
    corner = np.array([0.16, 0.1]) - reach
    weak.add_patch(Rectangle(tuple(corner), *(2.0 * reach), fill=False, ec=ORANGE, ls=":", lw=1.0))
    strong.set(ylabel="imaginary part", xlim=(-0.12, 1.5), ylim=(-0.12, 1.1))
    weak.set(xlim=(-0.3, 0.6), ylim=(-0.28, 0.47))
    return figure


def _polar_errors(axes: Axes, value: complex, covariance: np.ndarray) -> None:
    """Draw the standard uncertainties of magnitude and phase at a phasor."""
    along = np.array([value.real, value.imag]) / abs(value)
    across = np.array([-along[1], along[0]])
    for direction, name, shift in (
        (along, "U of |X|", (0.2, -0.12)),
        (across, "U of the phase · |X|", (-0.72, 0.16)),
    ):
        reach = 1.96 * np.sqrt(direction @ covariance @ direction)
        begin, end = (np.array([value.real, value.imag]) + sign * reach * direction for sign in (-1.0, 1.0))
        axes.annotate("", end, begin, arrowprops={"arrowstyle": "<|-|>", "color": ORANGE, "lw": 1.3})
        axes.text(value.real + shift[0], value.imag + shift[1], name, color=ORANGE, fontsize=8)


def result_tree() -> Figure:
    """Draw the groups of result.h5 with their members."""
    tree = _demo()[1]["tree"]
    figure, axes = new_figure(3.4)
    blank(axes, (0.0, 20.0), (1.0, 16.6), "auto")
    y = 16.0
    for title, colour, groups in BRANCHES:
        shown = [name for name in groups if name in tree]
        height = 0.98 * len(shown)
        box = FancyBboxPatch(
            (0.1, y - height + 0.45), 1.9, height - 0.2, boxstyle="round,pad=0.05", fc=colour, alpha=0.15, lw=0
        )
        axes.add_patch(box)
        axes.text(
            1.05, y - 0.5 * height + 0.4, title, color=colour, ha="center", va="center", fontsize=9, weight="bold"
        )
        for name in shown:
            axes.text(2.4, y, f"{name}/", color=colour, **MONO)
            axes.text(5.7, y, _listed(tree[name]), color=DARK, **{**MONO, "fontsize": 7.0})
            y -= 0.98
        y -= 0.25
    return figure


def _listed(members: list[str], width: int = 86) -> str:
    """Return names of members in one line, the last ones left out where it would be too long."""
    text = "  ".join(members)
    return text if len(text) <= width else text[:width].rsplit("  ", 1)[0] + "  …"


DRAWINGS = (result_budget, result_curve, result_row, result_region, result_tree)
