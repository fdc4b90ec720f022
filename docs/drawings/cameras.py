"""Drawings of stereo pairs, calibration targets, poses and supports: docs/cameras.md and its neighbours."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from matplotlib.patches import Circle, Polygon, Rectangle
from style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    Figure,
    FloatArray,
    arrow,
    blank,
    camera_shape,
    marked_table,
    new_figure,
)

from fusion.planning.camera_setup import CameraSetup, estimate_setup
from photogram.calibration.session import calibrate_pair
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import render_board, simulate_session
from photogram.synthetic.patterns import Board
from photogram.targets.target_view import Target

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")


def stereo_geometry() -> Figure:
    """Draw a pair from above, and what its angle does to the noise, by `shakercal plan --setup`."""
    figure, (scene, chart) = new_figure(3.0, 1, 2, width_ratios=[1.0, 1.25])
    blank(scene, (-7.5, 7.5), (-1.5, 15))
    half, distance = np.radians(17.0), 10.0
    scene.add_patch(Rectangle((-2.5, -0.5), 5, 0.5, facecolor="#e5e7eb", edgecolor=GREY))
    scene.text(0, -1.2, "speckled face", ha="center", fontsize=8)
    for sign, name in ((-1, "left"), (1, "right")):
        place = distance * np.array([sign * np.sin(half), np.cos(half)])
        scene.plot([0, place[0]], [0, place[1]], color=BLUE, linewidth=0.9, linestyle="--")
        for edge in (-2.5, 2.5):
            scene.plot([edge, place[0]], [0, place[1]], color=GREY, linewidth=0.6)
        camera_shape(scene, place, np.zeros(2))
        scene.text(*(place * (1.0 + 2.5 / distance)), name, ha="center", va="center", fontsize=8, color=BLUE)
    turn = np.linspace(-half, half, 30)
    scene.plot(5 * np.sin(turn), 5 * np.cos(turn), color=RED)
    behind = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    scene.text(0, 5.5, "angle α", ha="center", color=RED, fontsize=8, bbox=behind)
    end = distance * np.sin(half)
    arrow(scene, (-end, 13.2), (end, 13.2), GREEN, "<|-|>")
    scene.text(0, 13.6, "baseline 2·Z·tan(α/2)", ha="center", color=GREEN, fontsize=8)
    arrow(scene, (6.2, 0), (6.2, distance * np.cos(half)), ORANGE, "<|-|>")
    scene.text(6.4, 4.6, "distance Z", rotation=90, va="center", color=ORANGE, fontsize=8)
    angles = np.arange(6.0, 91.0, 2.0)
    sheet: dict[str, Any] = {"format": 1, "pixel": 3.45e-6, "image": [2448, 2048], "focal_length": 50e-3}
    sheet |= {"distance": 0.6, "f_number": 8, "face": [0.06, 0.06], "contrast": 0.2, "noise": 0.006}
    found = [estimate_setup(CameraSetup(**sheet, stereo_angle=float(angle))).covariance["a pair"] for angle in angles]
    noise = [np.sqrt(np.diagonal(covariance))[:3] for covariance in found]
    for values, name, colour in zip(
        1e9 * np.array(noise).T, ("x", "y", "z, along the view"), (BLUE, GREEN, RED), strict=True
    ):
        chart.semilogy(angles, values, color=colour, label=name)
    chart.axvspan(20, 35, color=GREEN, alpha=0.12, linewidth=0)
    chart.text(27.5, 12, "advised", ha="center", color=GREEN, fontsize=8)
    chart.set_yticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    chart.minorticks_off()
    chart.set(xlabel="stereo angle α in degrees", ylabel="noise of a frame in nm", title="z over y: cot(α/2)")
    chart.legend(loc="upper right")
    return figure


def target_kinds() -> Figure:
    """Draw the kinds of targets, rendered."""
    figure, axes = new_figure(3.1, 2, 3)
    boards = {
        "chessboard": Board(Target("chessboard", 10e-3, (9, 6))),
        "charuco": Board(Target("charuco", 10e-3, (10, 7), "DICT_4X4_100")),
        "aprilgrid": Board(Target("aprilgrid", 13e-3, (6, 4), tag_spacing=0.3)),
        "dots, three ring markers": Board(Target("dots", 9e-3), rings=(5, 3), lattice=(-3, 7, -2, 4)),
        "dots": Board(Target("dots", 9e-3, (11, 7))),
        "asymmetric-dots": Board(Target("asymmetric-dots", 8e-3, (6, 7))),
    }
    camera = Camera.from_parameters(np.array([500.0, 500, 119.5, 79.5, 0, 0, 0, 0, 0]), np.array([240, 160]))
    turn = rotation_from_vector(np.array([0.0, 0.42, 0.0])) @ rotation_from_vector(np.array([0.18, 0.0, 0.0]))
    for axis, (name, board) in zip(axes.ravel(), boards.items(), strict=True):
        middle = 0.5 * (board.points_m.min(axis=0) + board.points_m.max(axis=0))
        flip = np.diag([1.0, -1.0, -1.0]) if board.target.kind == "aprilgrid" else np.eye(3)
        extent = np.ptp(board.points_m, axis=0)
        distance = 500.0 * max((extent[0] + 0.03) / 225.0, (extent[1] + 0.03) / 150.0)
        rotation = turn @ flip
        pose = RigidTransform(rotation, np.array([0.0, 0.0, distance]) - rotation @ middle)
        image = render_board(camera, pose, board, 0.5, falloff=0.0)
        axis.imshow(np.round(8 * image) / 8, cmap="gray", vmin=0, vmax=0.9, interpolation="nearest")
        axis.set(xticks=[], yticks=[], title=name)
        for side in ("left", "bottom"):
            axis.spines[side].set_visible(False)
    return figure


def _session(poses: list[RigidTransform], board: Board, rig: StereoRig) -> tuple[float, float]:
    """Return the relative standard uncertainties of fx and of the baseline, in per cent, from one simulated session."""
    pairs = simulate_session(np.random.default_rng(2), rig, poses, board, 0.03)
    found = calibrate_pair(pairs, board.target, shape="flat", lens="polynomial")
    u = {one.name: one.u for one in found.parameters}
    baseline = float(np.linalg.norm(rig.right_from_left.translation_m))
    return 100.0 * u["left.fx"] / rig.left.matrix[0, 0], 100.0 * u["translation.x"] / baseline


PLACES = (
    *((-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0), (0, 0, -0.02), (0, 0, 0.03)),
    *((-0.9, 0, 0.02), (0.9, 0, 0.02), (0, 1, 0.01), (0, -1, 0.01), (0.3, 0.2, -0.03), (-0.3, -0.2, 0.04)),
)
"""Of the target in a good session: x and y in half widths of the covered area, z in m from the working distance."""


def target_poses() -> Figure:
    """Draw the outlines of a target in the left image, of a good and a poor session, with what each determines."""
    board = Board(Target("chessboard", 9e-3, (10, 7)))
    camera = Camera.from_parameters(np.array([2200.0, 2200, 639.5, 511.5, -0.05, 0, 0, 0, 0]), np.array([1280, 1024]))
    turn = rotation_from_vector(np.array([0.0, np.radians(25.0), 0.0]))
    distance = 0.36
    rig = StereoRig(camera, camera, RigidTransform(turn, np.array([0.0, 0.0, distance]) - turn @ [0.0, 0.0, distance]))
    middle = board.points_m.mean(axis=0)
    facing = rotation_from_vector(np.array([0.0, -np.radians(12.5), 0.0]))

    def pose(tilt: float, direction: float, spin: float, shift: tuple[float, float, float]) -> RigidTransform:
        axis = np.array([np.cos(direction), np.sin(direction), 0.0])
        rotation = facing @ rotation_from_vector(tilt * axis) @ rotation_from_vector(np.array([0.0, 0.0, spin]))
        return RigidTransform(rotation, np.array([0.0, 0.0, distance]) + np.array(shift) - rotation @ middle)

    corner = 0.042
    good = [
        pose(np.radians(30.0), 0.25 * np.pi * k, 0.5 * np.pi * (k % 4 == 3), (sx * corner, sy * 0.032, z))
        for k, (sx, sy, z) in enumerate(PLACES)
    ]
    poor = [
        pose(np.radians(6.0), 0.5 * k, 0.02 * k, (0.003 * np.sin(k), 0.003 * np.cos(2 * k), 0.0)) for k in range(12)
    ]
    figure, axes = new_figure(2.9, 1, 2)
    names = (
        "12 poses: tilted by 30°, near and far, in all corners",
        "12 poses: tilted by 6°, in the middle, one distance",
    )
    outline = np.array([[-1, -1, 0], [10, -1, 0], [10, 7, 0], [-1, 7, 0], [-1, -1, 0]]) * board.target.spacing_m
    for axis, poses, name, colour in zip(axes, (good, poor), names, (GREEN, RED), strict=True):
        for one in poses:
            seen = rig.left.project(one.apply(outline))
            axis.fill(*seen.T, facecolor=colour, alpha=0.07)
            axis.plot(*seen.T, color=colour, linewidth=0.9)
        axis.set(xlim=(0, 1279), ylim=(1023, 0), aspect="equal", xticks=[], yticks=[])
        axis.set_title(name, fontsize=8)
        for side in ("top", "right"):
            axis.spines[side].set_visible(True)
        of_focal, of_base = _session(poses, board, rig)
        axis.set_xlabel(f"u of the focal length {of_focal:.2g} %, of the baseline {of_base:.2g} %")
    return figure


def frames_of_edges() -> Figure:
    """Draw which edge of the trigger each file shows where the right camera lost one frame."""
    figure, axes = new_figure(2.2)
    blank(axes, (-2.6, 12.5), (-0.7, 3.6), "auto")
    edges = np.arange(12)
    for edge in edges:
        axes.plot(
            [edge, edge, edge + 0.35, edge + 0.35, edge + 1], [3.0, 3.4, 3.4, 3.0, 3.0], color=GREY, linewidth=1.2
        )
        axes.text(edge + 0.17, 2.62, str(edge), ha="center", fontsize=8, color=GREY)
    rows = ((1.6, "left", edges), (0.3, "right", [e for e in edges if e != 5]))
    for y, name, shown in rows:
        axes.text(-0.25, y + 0.25, f"files of {name}", ha="right", va="center", fontsize=8.5)
        for number, edge in enumerate(shown):
            late = name == "right" and edge > 5
            colour = RED if late else BLUE
            axes.add_patch(Rectangle((edge - 0.08, y), 0.66, 0.55, facecolor=f"{colour}22", edgecolor=colour))
            axes.text(edge + 0.25, y + 0.27, str(number), ha="center", va="center", fontsize=8, color=colour)
    axes.text(-0.25, 3.2, "trigger edges", ha="right", va="center", fontsize=8.5)
    axes.text(5.25, 0.55, "lost", ha="center", va="center", fontsize=8, color=RED)
    axes.text(0, -0.55, "first_edge = { left = 0, right = [[0, 0], [5, 6]] }", fontsize=8.5, family="DejaVu Sans Mono")
    axes.set_title("From the lost frame on, equal file numbers show different edges")
    return figure


def alignment_evidence() -> Figure:
    """Draw four kinds of evidence about the pose of a camera in the sensor frame."""
    figure, axes = new_figure(2.5, 1, 4)
    titles = ("points", "faces", "motion", "axis")
    notes = (
        "three, not on one line:\neverything",
        "three normals:\neverything",
        "one direction: two\nangles; two: all angles",
        "two angles and the\nplace across the axis",
    )
    for axis, title, note in zip(axes, titles, notes, strict=True):
        blank(axis, (-4.2, 4.2), (-5.6, 6.4))
        axis.set_title(title)
        camera_shape(axis, np.array([0.0, 4.4]), np.zeros(2), size=0.9)
        axis.add_patch(
            Polygon([[-2.6, -2.8], [2.0, -2.8], [2.0, 0.2], [-2.6, 0.2]], facecolor="#eef1f4", edgecolor=GREY)
        )
        axis.add_patch(Polygon([[-2.6, 0.2], [-1.4, 1.2], [3.2, 1.2], [2.0, 0.2]], facecolor="#f7f8fa", edgecolor=GREY))
        axis.add_patch(Polygon([[2.0, -2.8], [3.2, -1.8], [3.2, 1.2], [2.0, 0.2]], facecolor="#e2e6ea", edgecolor=GREY))
        axis.text(0, -4.6, note, ha="center", va="center", fontsize=7.6, linespacing=1.3)
    for x, y in ((-1.7, 0.5), (2.3, 0.9), (0.2, 0.55)):
        axes[0].add_patch(Circle((x, y), 0.24, color=RED))
        axes[0].plot([x, 0], [y, 3.9], color=RED, linewidth=0.7, linestyle=":")
    for start, end in (((0.3, 0.7), (0.3, 2.6)), ((2.6, -0.8), (4.0, -0.3)), ((-0.4, -1.3), (-1.4, -3.0))):
        arrow(axes[1], start, end, RED)
    arrow(axes[2], (-0.3, -2.2), (-0.3, 1.9), RED, "<|-|>")
    arrow(axes[2], (-2.0, -1.0), (1.6, -1.0), ORANGE, "<|-|>")
    axes[3].plot([0.3, 0.3], [-3.2, 2.6], color=RED, linestyle="-.")
    turn = np.linspace(0.2 * np.pi, 1.85 * np.pi, 50)
    axes[3].plot(0.3 + 1.5 * np.cos(turn), 1.7 + 0.45 * np.sin(turn), color=RED)
    arrow(axes[3], (1.45, 1.42), (1.75, 1.62), RED)
    return figure


def _face_camera() -> tuple[Camera, FloatArray]:
    """Return the camera of the motions, 0.4 m before a face of 50 mm radius, and points of the face."""
    camera = Camera.from_parameters(np.array([3000.0, 3000, 511.5, 511.5, 0, 0, 0, 0, 0]), np.array([1024, 1024]))
    grid = np.stack(np.meshgrid(np.linspace(-0.05, 0.05, 9), np.linspace(-0.05, 0.05, 9)), -1).reshape(-1, 2)
    inside = grid[np.hypot(*grid.T) < 0.051]
    return camera, np.column_stack([inside, np.zeros(len(inside))])


QUIVER: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "width": 0.012}


def single_camera_motions() -> Figure:
    """Draw how the points of a face move in the image by each of the six components, with equal motion of the rim."""
    camera, points = _face_camera()
    away = np.array([0.0, 0.0, 0.4])
    figure, axes = new_figure(3.9, 2, 3)
    names = ("x by 1 mm", "y by 1 mm", "z by 1 mm", "rx by 20 mrad", "ry by 20 mrad", "rz by 20 mrad")
    for number, (axis, name) in enumerate(zip(axes.ravel(), names, strict=True)):
        step = np.zeros(6)
        step[number] = 1e-3 if number < 3 else 0.02
        moved = points @ rotation_from_vector(step[3:]).T + step[:3]
        before, after = camera.project(points + away), camera.project(moved + away)
        shift = after - before
        rms = float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))
        well = rms > 3.0
        colour, scale = (GREEN, 0.12) if well else (RED, 0.012)
        axis.quiver(*before.T, *shift.T, color=colour, scale=scale, **QUIVER)
        axis.add_patch(Circle((511.5, 511.5), 390, fill=False, color=GREY, linewidth=0.8))
        blank(axis, (60, 970), (970, 60))
        note = "" if well else "\n(arrows × 10)"
        axis.set_title(f"{name}: {rms:.2g} px rms{note}", color=GREEN if well else RED, loc="center")
    return figure


def one_camera_views() -> Figure:
    """Draw places of one camera before a load, and u of the vertical motion over the angle of its view."""
    figure, (scene, chart) = new_figure(3.0, 1, 2, width_ratios=[1.0, 1.25])
    blank(scene, (-6.5, 9.0), (-10.5, 4.5))
    scene.add_patch(Rectangle((-2, -2), 4, 4, facecolor="#e5e7eb", edgecolor=GREY))
    scene.plot([-2, 2], [-2, -2], color="black", linewidth=3)
    scene.text(0, 2.4, "load, seen from above", ha="center", fontsize=8)
    scene.plot(0, 0, "o", color=RED, markersize=4)
    scene.text(0.3, -0.5, "axis", color=RED, fontsize=8)
    scene.text(-2.2, -2.1, "face", ha="right", fontsize=8)
    face, turn = np.array([0.0, -2.0]), np.radians(35.0)
    for angle, name, colour in ((0.0, "across", ORANGE), (turn, "turned by β", BLUE)):
        place = face + 7.0 * np.array([np.sin(angle), -np.cos(angle)])
        scene.plot([face[0], place[0]], [face[1], place[1]], color=colour, linewidth=0.9, linestyle="--")
        camera_shape(scene, place, face, 0.8)
        scene.text(place[0] + 1.0, place[1], name, fontsize=8, color=colour)
    arc = np.linspace(0.0, turn, 20)
    scene.plot(4 * np.sin(arc), -2 - 4 * np.cos(arc), color=GREEN)
    scene.text(1.1, -6.6, "β", color=GREEN)
    sheet: dict[str, Any] = {"format": 1, "pixel": 3.45e-6, "image": [2448, 2048], "focal_length": 50e-3}
    sheet |= {"distance": 0.6, "f_number": 8, "face": [0.06, 0.06], "contrast": 0.2, "noise": 0.006}
    side, above, angles = {"origin": (0.0, -0.03, -0.04)}, {}, np.arange(0.0, 61.0, 2.5)
    for place, axis, name, colour in (
        (side, 1, "face at the side", BLUE),
        (above, 2, "face above, on the axis", ORANGE),
    ):
        found = [estimate_setup(CameraSetup(**sheet, **place, view_angle=float(a))).covariance for a in angles]
        values = [1e9 * float(np.sqrt(one["one camera"][axis, axis])) for one in found]
        chart.semilogy(angles, values, color=colour, label=name)
        pair = estimate_setup(CameraSetup(**sheet, **place, stereo_angle=25.0)).covariance["a pair"]
        chart.axhline(1e9 * float(np.sqrt(pair[axis, axis])), color=colour, linestyle=":", linewidth=1.1)
    chart.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    chart.minorticks_off()
    chart.set(xlabel="angle β of the view in degrees", ylabel="u of the vertical motion\nof a frame in nm")
    chart.set_title("dotted: pairs of 25°")
    chart.legend(loc="upper right", fontsize=8)
    return figure


def camera_arrangements() -> Figure:
    """Draw the bounds of the arrangements of cameras in the table of docs/cameras-per-body.md."""
    rows = marked_table("cameras-per-body.md", "arrangements")
    figure, axes = new_figure(2.7, 1, 2)
    colours = (RED, BLUE, ORANGE, GREEN, GREY)
    for axis, first, unit, scale in ((axes[0], 1, "µm", 1e-3), (axes[1], 4, "µrad", 1.0)):
        for number, (row, colour) in enumerate(zip(rows, colours, strict=True)):
            values = [scale * float(cell) for cell in row[first : first + 3]]
            axis.bar(np.arange(3) + 0.16 * (number - 2), values, 0.15, color=colour, label=row[0])
        axis.set_xticks(range(3), COMPONENTS[first - 1 : first + 2])
        axis.set(ylabel=f"bound of a frame in {unit}", yscale="log")
    axes[0].set_yticks([0.1, 0.2, 0.5, 1], ["0.1", "0.2", "0.5", "1"])
    axes[1].set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
    for axis in axes:
        axis.minorticks_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def stationary_surface() -> Figure:
    """Draw the view of a camera with a stationary surface, and how its motion is removed from the body's."""
    figure, (view, sketch) = new_figure(2.7, 1, 2, width_ratios=[1.1, 1.0])
    rng = np.random.default_rng(4)
    blank(view, (0, 304), (240, 0))
    view.add_patch(Rectangle((0, 0), 304, 240, facecolor="#374151"))
    areas = {
        "body": (76, 45, 155, 149, "#dbe4ee"),
        "left": (14, 42, 48, 156, "#fde7d3"),
        "right": (246, 42, 48, 156, "#fde7d3"),
    }
    for x, y, wide, high, colour in areas.values():
        view.add_patch(Rectangle((x, y), wide, high, facecolor=colour))
        dots = rng.uniform([x + 3, y + 3], [x + wide - 3, y + high - 3], (wide * high // 60, 2))
        view.scatter(*dots.T, s=4, color="#111827", linewidths=0)
    view.add_patch(Rectangle((76, 45), 155, 149, fill=False, edgecolor=BLUE, linewidth=2))
    view.add_patch(Rectangle((11, 39), 286, 162, fill=False, edgecolor=ORANGE, linewidth=2))
    view.text(153, 36, "region of the body, mask of the room", color="white", ha="center", va="bottom", fontsize=7.5)
    view.text(153, 232, "region of the room", color=ORANGE, ha="center", va="bottom", fontsize=8)
    view.set_title("one image, two regions")
    blank(sketch, (-8, 8.5), (-6.6, 7.2))
    sketch.set_title("what each region shows")
    camera_shape(sketch, np.array([-5.0, 4.6]), np.array([0.0, -2.0]))
    arrow(sketch, (-7.6, 2.2), (-4.2, 2.2), RED, "<|-|>")
    sketch.text(-5.9, 1.2, "H", color=RED, ha="center", va="center")
    sketch.add_patch(Rectangle((-2, -4.4), 4, 2.6, facecolor="#dbe4ee", edgecolor=BLUE))
    arrow(sketch, (-2.4, -5.2), (2.4, -5.2), BLUE, "<|-|>")
    sketch.text(0, -6.1, "A", color=BLUE, ha="center", va="center")
    sketch.add_patch(Rectangle((4.4, -4.4), 2.4, 2.6, facecolor="#fde7d3", edgecolor=ORANGE))
    sketch.text(5.6, -5.3, "at rest", color=ORANGE, ha="center", va="center", fontsize=8)
    sketch.plot([-4.6, 0], [4.0, -1.8], color=BLUE, linewidth=0.8, linestyle="--")
    sketch.plot([-4.6, 5.4], [4.0, -1.8], color=ORANGE, linewidth=0.8, linestyle="--")
    lines = ("the body's region: A − H", "the room's region: −H", "result: A = (A − H) − (−H)")
    for number, (line, colour) in enumerate(zip(lines, (BLUE, ORANGE, GREEN), strict=True)):
        sketch.text(-1.4, 6.2 - 1.2 * number, line, color=colour, fontsize=8.5)
    return figure


def support_shake() -> Figure:
    """Draw the errors with and without a stationary surface of the table in docs/room.md."""
    figure, axes = new_figure(2.6)
    shares, before, after, stated = [], [], [], []
    for row in marked_table("room.md", "shaken room"):
        match = re.fullmatch(r"cameras, ([\d.]+)", row[0])
        if match:
            shares.append(100.0 * float(match[1]))
            before.append(float(row[1]))
            after.append(float(row[2]))
            stated.append(float(row[3]))
    axes.loglog(shares, before, "o-", color=RED, label="error without a stationary surface")
    axes.loglog(shares, after, "o-", color=GREEN, label="error with it")
    axes.loglog(shares, stated, "--", color=BLUE, label="stated standard uncertainty with it")
    axes.set(xlabel="motion of the cameras, % of the measured motion", ylabel="error of z in %, rms")
    axes.set_xticks([0.01, 0.1, 1], ["0.01", "0.1", "1"])
    axes.set_yticks([0.02, 0.05, 0.1, 0.2, 0.5, 1], ["0.02", "0.05", "0.1", "0.2", "0.5", "1"])
    axes.minorticks_off()
    axes.set_title("A stationary surface in view removes the motion of the cameras")
    axes.legend()
    return figure


DRAWINGS = (
    stereo_geometry,
    target_kinds,
    target_poses,
    frames_of_edges,
    alignment_evidence,
    single_camera_motions,
    one_camera_views,
    camera_arrangements,
    stationary_surface,
    support_shake,
)
