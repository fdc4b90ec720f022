"""Drawings for developers and of performance: data flow, layers, one recording's stages, time."""

from __future__ import annotations

import ast
import json
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from style import BLUE, GREEN, GREY, ORANGE, RED, ROOT, blank, flow_arrow, flow_box, marked_table, new_figure

COLOURS = {"photogram": BLUE, "shaker": GREEN, "fusion": ORANGE, "shakercal": GREY}


FLOW: tuple[tuple[tuple[float, float], str, str, str], ...] = (
    ((1.0, 3.4), "image pairs", "photogram.images", "photogram"),
    ((2.9, 3.4), "tracked subsets", "photogram.subsets", "photogram"),
    ((4.8, 3.4), "points, motion\nin 6 components", "photogram.measure", "photogram"),
    ((1.0, 2.1), "channels:\nlasers, bridge, …", "shaker.io", "shaker"),
    ((2.9, 2.1), "one time base", "shaker.timebase", "shaker"),
    ((4.8, 2.1), "sine approximation", "shaker.sine", "shaker"),
    ((6.7, 2.75), "phasors with\ncovariance", "fusion.phasors", "fusion"),
    ((6.7, 0.8), "acceleration of\nload and base", "fusion.estimation", "fusion"),
    ((4.8, 0.8), "mass matrix:\nload on the sensor", "fusion.sensitivity", "fusion"),
    ((2.9, 0.8), "sensitivity and\nphase, with U", "fusion.sensitivity", "fusion"),
    ((1.0, 0.8), "tables, page,\ncertificate", "fusion.report", "fusion"),
)
"""Place, content, module and package of each step."""
ARROWS = ((0, 1), (1, 2), (3, 4), (4, 5), (2, 6), (5, 6), (6, 7), (7, 8), (8, 9), (9, 10))


def data_flow() -> Figure:
    """Show the steps from images and channels to the sensitivity."""
    figure, axes = new_figure(3.2)
    blank(axes, (0.0, 7.7), (0.0, 4.15), "auto")
    half_width, half_height = 0.82, 0.45
    for place, text, module, package in FLOW:
        corner = place[0] - half_width, place[1] - half_height
        flow_box(axes, corner, (2.0 * half_width, 2.0 * half_height), "", COLOURS[package])
        axes.text(place[0], place[1] + 0.1, text, ha="center", va="center", fontsize=8.5)
        axes.text(place[0], place[1] - 0.33, module, ha="center", va="center", fontsize=6.5, color=COLOURS[package])
    for begin, end in ARROWS:
        (x0, y0), (x1, y1) = FLOW[begin][0], FLOW[end][0]
        if x0 == x1:
            flow_arrow(axes, (x0, y0 - half_height), (x1, y1 + half_height))
        else:
            side = half_width if x1 > x0 else -half_width
            flow_arrow(axes, (x0 + side, y0), (x1 - side, y1))
    axes.set_title("From images and channels to the sensitivity: every step and its package")
    return figure


def layers() -> Figure:
    """Show the layers of each package, as the test of the house states them."""
    tree = ast.parse((ROOT / "tests" / "test_house.py").read_text(encoding="utf-8"))
    (value,) = (
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "LAYERS"
    )
    of = ast.literal_eval(value)
    figure, axes = new_figure(4.6)
    blank(axes, (0.0, 10.0), (0.0, 19.6), "auto")

    def column(package: str, middle: float, width: float, bottom: float) -> None:
        for place, entries in enumerate(of[package]):
            corner = middle - width / 2.0, bottom + 0.86 * place - 0.37
            flow_box(axes, corner, (width, 0.74), ", ".join(entries.split()), COLOURS[package])

    axes.text(5.0, 0.25, "shakercal._common", ha="center", fontsize=8.5, color=GREY, weight="bold")
    common = sorted(path.stem for path in (ROOT / "shakercal" / "_common").glob("*.py") if path.stem != "__init__")
    flow_box(axes, (0.2, 1.0), (9.6, 0.9), ", ".join(common), GREY)
    column("photogram", 2.5, 4.6, 3.2)
    column("shaker", 7.5, 4.6, 3.2)
    column("fusion", 5.0, 9.6, 9.4)
    for package, x, y in (("photogram", 2.5, 2.25), ("shaker", 7.5, 2.25), ("fusion", 5.0, 8.45)):
        axes.text(x, y, package, ha="center", fontsize=8.5, color=COLOURS[package], weight="bold")
    axes.set_title("Layers: a row imports from its row and from the rows below it")
    return figure


def one_recording() -> Figure:
    """Show the demo recording at four stages: image, motion, acceleration, sensitivity."""
    import shakercal

    folder = ROOT / "sample_images" / "demo" / "Fz-0080"
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    evaluation = shakercal.evaluate(folder)
    figure, ((image, motion), (acceleration, sensitivity)) = new_figure(5.4, 2, 2)
    top = next(one for one in evaluation.stereo if one.name == "top")
    image.imshow(top.reference_image, cmap="gray", interpolation="nearest")
    half = 0.5 * np.median(np.diff(np.unique(np.round(top.subsets_px[:, 1]))))
    for x, y in top.subsets_px:
        image.add_patch(
            Rectangle((x - half, y - half), 2.0 * half, 2.0 * half, fill=False, color=ORANGE, linewidth=0.8)
        )
    image.set(xlim=(110.0, 210.0), ylim=(160.0, 80.0))
    image.set_axis_off()
    image.set_title(f"1  Part of an image, {len(top.subsets_px)} subsets in all")
    turns = top.time_s * evaluation.lines.frequency_hz[0]
    z_m = top.motion_from_mean.pose[:, 2]
    motion.plot(turns % 1.0, 1e6 * z_m, "o", markersize=3.5, color=BLUE)
    fine = np.linspace(0.0, 1.0, 201)
    of_lines = np.exp(2j * np.pi * np.outer(fine, evaluation.lines.multiple)) @ top.fit.phasors.value[:, 2]
    motion.plot(fine, 1e6 * of_lines.real, linewidth=1.0, color=GREY)
    motion.set(xlabel="phase of the driven line / periods", ylabel="z of the load / µm")
    motion.set_title(f"2  Motion in {len(z_m)} frames, with the fit")
    true = complex(truth["acceleration"]["load"]["re"][0][2], truth["acceleration"]["load"]["im"][0][2])
    for colour, moved in zip((RED, BLUE, GREEN), evaluation.accelerations[:3], strict=True):
        _region(acceleration, moved.polar[0][2], true, 1.0, colour, moved.source)
    acceleration.set(xlabel="error of the real part / (m/s²)", ylabel="of the imaginary part / (m/s²)")
    acceleration.legend(fontsize=7.5, loc="upper left", frameon=False)
    acceleration.set_ylim(None, 0.2)
    acceleration.set_title(f"3  Acceleration along z ({abs(true):.1f} m/s²)")
    true = complex(truth["sensitivity"]["re"][0][2][2], truth["sensitivity"]["im"][0][2][2])
    element = evaluation.element
    _region(
        sensitivity,
        element.polar[0][element.elements.index((2, 2))],
        true,
        100.0 / abs(true),
        RED,
        "Fz output per Fz load",
    )
    sensitivity.set(xlabel="error of the real part / %", ylabel="of the imaginary part / %")
    sensitivity.set_ylim(None, 0.4)
    sensitivity.legend(fontsize=7.5, loc="upper left", frameon=False)
    sensitivity.set_title("4  Sensitivity")
    return figure


def _region(axes: Any, found: Any, true: complex, scale: float, colour: str, name: str) -> None:
    """Draw the 95 % region of a complex value about the truth, which is the cross."""
    cosine = found.region_r
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    first, second = np.cos(turn), cosine * np.cos(turn) + np.sqrt(1.0 - cosine**2) * np.sin(turn)
    axes.plot(
        scale * (found.re - true.real + found.region_re * first),
        scale * (found.im - true.imag + found.region_im * second),
        color=colour,
        label=name,
    )
    axes.plot(scale * (found.re - true.real), scale * (found.im - true.imag), ".", color=colour)
    axes.plot(0.0, 0.0, "+", color="black", markersize=9)


def time_over_frames() -> Figure:
    """Show the CPU time and the memory of a run over its number of frames."""
    rows = np.array([[float(cell) for cell in row] for row in marked_table("performance.md", "growth")])
    _, images, cpu_s, _, peak_mb = rows.T
    figure, (time, memory) = new_figure(2.6, 1, 2)
    slope, start = np.polyfit(images, cpu_s, 1)
    time.plot(images, cpu_s, "o", color=BLUE)
    time.plot([0.0, images[-1]], [start, start + slope * images[-1]], color=BLUE, linewidth=1.0)
    time.text(0.05, 0.9, f"{start:.1f} s + {1e3 * slope:.0f} ms per image", transform=time.transAxes)
    time.set(xlabel="images", ylabel="CPU time / s", xlim=(0.0, None), ylim=(0.0, None))
    time.set_title("Time: a constant and a share of each image")
    memory.plot(images, peak_mb, "o-", color=ORANGE)
    memory.set(xlabel="images", ylabel="peak memory / MB", xlim=(0.0, None), ylim=(0.0, 1.2 * peak_mb.max()))
    memory.set_title("Memory hardly grows")
    return figure


def time_by_stage() -> Figure:
    """Show the share of each stage in the CPU time of a run."""
    names, _, shares = zip(*marked_table("performance.md", "stages"), strict=True)
    share = np.array([float(one) for one in shares])
    figure, axes = new_figure(3.2)
    place = np.arange(len(names))[::-1]
    axes.barh(place, share, color=[BLUE if one >= 5.0 else GREY for one in share])
    axes.set_yticks(place, names)
    for y, one in zip(place, share, strict=True):
        axes.text(one + 0.4, y, f"{one:.0f} %", va="center", fontsize=8.0)
    axes.set(xlabel="share of the CPU time / %", xlim=(0.0, 1.15 * share.max()))
    axes.set_title("Most of the time is spent on the images")
    return figure


DRAWINGS = (data_flow, layers, one_recording, time_over_frames, time_by_stage)
