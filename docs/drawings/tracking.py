"""Drawings of speckle, subsets, interpolation and the fixed pattern: docs/tracking.md, docs/practice.md and others."""

from __future__ import annotations

import importlib
import re
import sys
from typing import Any

import cv2
import numpy as np
from matplotlib.patches import FancyArrowPatch, Polygon, Rectangle
from style import BLUE, GREEN, GREY, ORANGE, RED, ROOT, VIOLET, Figure, FloatArray, blank, new_figure

from photogram.bspline import grey_gradients, pattern_overlap, spline_of_image
from photogram.calibration.calibration_file import read_calibration
from photogram.camera import Camera, epipolar_residual
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.images.noise import NoiseModel
from photogram.subsets.icgn import TrackSettings, register
from photogram.subsets.reference import prepare_reference, subset_offsets
from photogram.subsets.texture import aliasing_bias, assess_subsets, place_subsets, speckle_size
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, tile_texture, view_of

SENSOR = ImageSensor()
PIXEL_M, FOCAL_PX = 2e-4, 2000.0
DIRECTION, REFERENCE = (0.958, 0.287), float(np.cos(2.0 * np.pi * 80.0 * 0.0011))
"""Of the motion in benchmarks/sensor_pattern.py, and where its first frame is, in amplitudes."""
NOISE = NoiseModel(SENSOR.read_noise_grey**2 + 1.0 / 12.0, 1.0 / SENSOR.electrons_per_grey)


class Foil:
    """A speckled face before one camera, 0.2 mm a pixel."""

    def __init__(self, dot_px: float, contrast: float = 0.64, seed: int = 1, size_px: int = 200, **extra: Any) -> None:
        wide, blur = (1.6 * size_px * PIXEL_M,) * 2, extra.get("blur_px", 0.6) * PIXEL_M
        texture = speckle_texture(wide, dot_px * PIXEL_M, PIXEL_M / 4, blur, np.random.default_rng(seed))
        if "period_px" in extra:
            texture = tile_texture(texture, extra["period_px"] * PIXEL_M)
        turn = np.radians(extra.get("turn_deg", 0.0))
        axes = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
        half = np.full(2, size_px * PIXEL_M)
        tone = 0.5 * (1.0 + contrast), 0.5 * (1.0 - contrast)
        self.face = Face(np.zeros(3), *axes, half, False, texture, PIXEL_M, *tone)
        middle = (size_px - 1) / 2.0
        camera = Camera.from_parameters(
            np.array([FOCAL_PX, FOCAL_PX, middle, middle, 0, 0, 0, 0, 0]), np.array([size_px] * 2)
        )
        self.view = view_of(camera, RigidTransform(np.eye(3), np.array([0.0, 0.0, FOCAL_PX * PIXEL_M])), 0.0)

    def image(self, x_px: float = 0.0, y_px: float = 0.0, turn_deg: float = 0.0, away: float = 0.0) -> FloatArray:
        """Return the image without noise, share of full scale, of the displaced foil."""
        pose = np.array([x_px, y_px, away * FOCAL_PX, 0.0, 0.0, 0.0]) * PIXEL_M
        pose[5] = np.radians(turn_deg)
        return render(self.view, self.face, pose[None], np.ones(1), nodes=3)


def _show(axes: Any, image: FloatArray, title: str = "") -> None:
    axes.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    axes.set(xticks=[], yticks=[], title=title)


def speckle_quality() -> Figure:
    """Draw four speckles, the expected noise and bias of subsets of 21 x 21 px, and spectra along x."""
    figure, axes = new_figure(3.9, 2, 4, height_ratios=[1.25, 1.0])
    cases = ("good", 6.5, 0.64), ("too fine", 1.6, 0.64), ("too coarse", 18.0, 0.64), ("low contrast", 6.5, 0.06)
    for column, (name, dot_px, contrast) in enumerate(cases):
        grey = SENSOR.digitise(Foil(dot_px, contrast).image(), np.random.default_rng(1))
        _show(axes[0, column], grey[60:130, 60:130] / SENSOR.full_scale, name)
        area, radius = np.ones(grey.shape, np.bool_), 10
        subsets = prepare_reference(spline_of_image(grey, 7), place_subsets(area, radius, 2 * radius + 1), radius)
        quality = assess_subsets(subsets, grey, NOISE, SENSOR.full_scale)
        noise_grey = float(np.sqrt(NOISE.variance(np.array([float(grey.mean())])))[0])
        sigma = 1e3 * np.sqrt(np.nanmean(quality.predicted_sigma_px**2))
        bias = 1e3 * aliasing_bias(grey, area, noise_grey, radius, 7).mean_px
        lost = int(np.sum(~quality.usable))
        text = f"speckle {speckle_size(grey, area):.1f} px\nnoise {sigma:.1f} mpx\nbias {bias:.2g} mpx"
        axes[0, column].set_xlabel(text + (f"\n{lost} of {len(quality.status)} lost" if lost else ""))
        window = np.hanning(len(grey))
        power = np.mean(np.abs(np.fft.rfft((grey - grey.mean()) * window, axis=1)) ** 2, axis=0) / np.sum(window**2)
        smooth = np.convolve(np.pad(power, 2, "edge"), np.ones(5) / 5.0, "valid")
        axes[1, column].semilogy(np.fft.rfftfreq(len(grey)), smooth, color=BLUE)
        axes[1, column].axhline(noise_grey**2, color=RED, linewidth=1.0, linestyle="--")
        axes[1, column].set(xlim=(0, 0.5), ylim=(1e2, 3e7), xlabel="cycles per pixel")
        axes[1, column].set_yticks([1e2, 1e4, 1e6])
    axes[1, 0].set_ylabel("power, grey²")
    axes[1, 0].text(0.02, 4e2, "noise", color=RED, fontsize=8)
    return figure


def speckle_autocorrelation() -> Figure:
    """Draw the autocorrelation of three speckles, whose width at half maximum is the speckle size."""
    figure, axes = new_figure(2.6, 1, 2, width_ratios=[1.0, 2.2])
    for dot_px, colour in ((2.5, ORANGE), (6.5, BLUE), (11.0, GREEN)):
        grey = Foil(dot_px).image()
        size = speckle_size(grey, np.ones(grey.shape, np.bool_))
        centred = grey - grey.mean()
        spectrum = np.abs(np.fft.fft2(centred, (512, 512))) ** 2
        inside = np.abs(np.fft.fft2(np.ones_like(grey), (512, 512))) ** 2
        part = np.s_[:15, :15]
        correlation = np.fft.ifft2(spectrum).real[part] / np.fft.ifft2(inside).real[part]
        lags = np.arange(15)
        along = 0.5 * (correlation[0] + correlation[:, 0]) / correlation[0, 0]
        axes[1].plot(
            lags, along, "o-", color=colour, markersize=3, label=f"dots of {dot_px:g} px: speckle {size:.1f} px"
        )
        axes[1].plot([size / 2] * 2, [-0.3, 0.5], color=colour, linestyle=":", linewidth=1.0)
        if colour == BLUE:
            _show(axes[0], grey[20:70, 20:70], "dots of 6.5 px")
            axes[0].plot([5, 5 + size], [45, 45], color=ORANGE, linewidth=4)
            axes[0].set_xlabel(f"bar: speckle size {size:.1f} px")
    axes[1].axhline(0.5, color=GREY, linewidth=0.8)
    axes[1].set(xlim=(0, 14), ylim=(-0.3, 1.02), xlabel="shift in px", ylabel="autocorrelation")
    axes[1].set_title("speckle size = 2 × shift at half maximum")
    axes[1].legend()
    return figure


def _outline(warp: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    corners = radius * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return centre + warp[::3] + corners @ (np.eye(2) + warp.reshape(2, 3)[:, 1:]).T


def subset_registration() -> Figure:
    """Draw the reference, a moved image, and what remains before and after the affine registration."""
    figure, axes = new_figure(2.5, 1, 4)
    foil, radius, centre = Foil(5.0, size_px=80), 14, np.array([[36.0, 40.0]])
    rng = np.random.default_rng(3)
    first, moved = (SENSOR.digitise(image, rng) for image in (foil.image(), foil.image(5.0, -2.5, 5.0, -0.06)))
    subsets = prepare_reference(spline_of_image(first), centre, radius)
    start = np.array([[4.0, 0.02, -0.05, -2.0, 0.05, 0.02]])
    found = register(subsets, spline_of_image(moved), start, TrackSettings(radius_px=radius))
    u, _, _, v, _, _ = found.warp[0]
    full = float(SENSOR.full_scale)
    _show(axes[0], first / full, "reference")
    axes[0].add_patch(Polygon(_outline(np.zeros(6), centre[0], radius), fill=False, color=ORANGE, linewidth=2))
    _show(axes[1], moved / full, "a later frame")
    axes[1].add_patch(Polygon(_outline(np.zeros(6), centre[0], radius), fill=False, color=ORANGE, linestyle=":"))
    axes[1].add_patch(Polygon(_outline(found.warp[0], centre[0], radius), fill=False, color=ORANGE, linewidth=2))
    axes[1].set_xlabel(f"u = {u:.3f} px\nv = {v:.3f} px")
    offsets = subset_offsets(radius)
    reference = cv2.remap(first.astype(np.float32), *_places(np.zeros(6), centre[0], offsets), cv2.INTER_CUBIC)
    for axis, warp, title in ((axes[2], np.zeros(6), "before"), (axes[3], found.warp[0], "after")):
        there = cv2.remap(moved.astype(np.float32), *_places(warp, centre[0], offsets), cv2.INTER_CUBIC)
        left = (there - reference).reshape(2 * radius + 1, -1) / full
        axis.imshow(left, cmap="RdBu", vmin=-0.6, vmax=0.6, interpolation="nearest")
        axis.set(xticks=[], yticks=[], title=f"difference {title}")
        axis.set_xlabel(f"rms {100 * np.std(left):.2g} %\nof full scale")
    return figure


def _places(warp: FloatArray, centre: FloatArray, offsets: FloatArray) -> tuple[Any, Any]:
    points = centre + warp[::3] + offsets @ (np.eye(2) + warp.reshape(2, 3)[:, 1:]).T
    return points[:, 0].astype(np.float32), points[:, 1].astype(np.float32)


def subset_bound() -> Figure:
    """Draw the Cramér–Rao bound of a subset's position over its size, and the scatter that registration reaches."""
    figure, axes = new_figure(2.9)
    foil, rng = Foil(6.5, size_px=260), np.random.default_rng(5)
    clean = foil.image()
    area = np.zeros(clean.shape, np.bool_)
    area[10:-10, 10:-10] = True
    sides, bound, scatter = [], [], []
    for radius in (5, 7, 10, 14, 19, 25):
        centres = place_subsets(area, radius, 2 * radius + 1)
        exact = SENSOR.digitise(clean, None)
        parts = []
        for order in (0, 1, 2):
            subsets = prepare_reference(spline_of_image(exact, 7), centres, radius, order)
            sigma = assess_subsets(subsets, exact, NOISE, SENSOR.full_scale).predicted_sigma_px
            parts.append(1e3 * np.sqrt(np.nanmean(sigma**2)))
        subsets = prepare_reference(spline_of_image(exact, 7), centres, radius)
        shifts = []
        for _ in range(6):
            noisy = spline_of_image(SENSOR.digitise(clean, rng), 7)
            found = register(subsets, noisy, np.zeros((len(centres), 6)), TrackSettings(radius_px=radius, degree=7))
            shifts.append(found.warp[:, ::3])
        sides.append(2 * radius + 1)
        bound.append(parts)
        scatter.append(1e3 * np.nanstd(np.array(shifts)))
    for column, (name, colour) in enumerate((("translation", GREEN), ("affine", BLUE), ("second order", VIOLET))):
        axes.loglog(sides, np.array(bound)[:, column], color=colour, label=f"bound, {name}")
    axes.loglog(sides, scatter, "o", color=RED, label="affine, registered in noisy images")
    axes.set(xlabel="side of the subset in px", ylabel="standard deviation in mpx")
    axes.set_xticks(sides, [str(side) for side in sides])
    axes.set_yticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
    axes.minorticks_off()
    axes.set_title("Noise of one subset: registration reaches the Cramér–Rao bound")
    axes.legend(loc="upper right")
    return figure


def interpolation_bias() -> Figure:
    """Draw the error of exact images registered by splines of three degrees."""
    figure, axes = new_figure(2.8, 1, 2)
    shifts = np.linspace(0.0, 1.0, 11)
    sizes, amplitudes = [], []
    for dot_px in (2.0, 3.0, 4.0, 6.0, 8.0):
        foil = Foil(dot_px, size_px=160, blur_px=0.9)
        images = [foil.image(x_px=shift) * 4095.0 for shift in shifts]
        area = np.zeros(images[0].shape, np.bool_)
        area[8:-8, 8:-8] = True
        centres = place_subsets(area, 10, 21)
        sizes.append(speckle_size(images[0], area))
        amplitudes.append([])
        for degree, colour in ((3, ORANGE), (5, BLUE), (7, GREEN)):
            subsets = prepare_reference(spline_of_image(images[0], degree), centres, 10, 0)
            settings = TrackSettings(degree=degree, shape_order=0, convergence_px=1e-7, max_iterations=60)
            start = np.zeros((len(centres), 6))
            bias = np.empty(len(shifts))
            for number, image in enumerate(images):
                start[:, 0] = shifts[number]
                found = register(subsets, spline_of_image(image, degree), start, settings)
                bias[number] = 1e3 * (np.nanmean(found.warp[:, 0]) - shifts[number])
            amplitudes[-1].append(0.5 * np.ptp(bias))
            if dot_px == 4.0:
                axes[0].plot(shifts, bias, color=colour, label=f"degree {degree}")
    axes[0].set(xlabel="true shift in px", ylabel="mean error in mpx")
    axes[0].set_title(f"speckle of {sizes[2]:.1f} px")
    axes[0].legend()
    for column, colour in enumerate((ORANGE, BLUE, GREEN)):
        axes[1].semilogy(sizes, np.array(amplitudes)[:, column], "o-", color=colour, markersize=3)
    axes[1].set(xlabel="speckle size in px", ylabel="amplitude of the error in mpx", title="over the speckle size")
    return figure


def _benchmark_points(pattern: str) -> FloatArray:
    """Return motion and error as recorded of a pattern's rows in the table of docs/tracking.md."""
    page = (ROOT / "docs" / "tracking.md").read_text(encoding="utf-8")
    row = rf"^\| ([\d.]+) \| {re.escape(pattern)} \| unknown \| ([+-][\d.]+) \|"
    return np.array(re.findall(row, page, re.MULTILINE), dtype=np.float64).reshape(-1, 2)


def fixed_pattern() -> Figure:
    """Draw by how much a pattern that stays on the sensor shortens a sine, in closed form, and rendered recordings.

    Texture, direction and phase of the reference are those of benchmarks/sensor_pattern.py.
    """
    figure, axes = new_figure(2.9)
    amplitude = np.geomspace(0.02, 5.0, 120)
    wave = np.cos((np.arange(256) + 0.5) / 256 * 2.0 * np.pi)
    along, across = (np.multiply.outer(part * amplitude, wave - REFERENCE) for part in DIRECTION)
    grey = Foil(5.0, 0.3, blur_px=1.2).image()
    slope = np.mean(grey_gradients(spline_of_image(grey, 5))[0][10:-10, 10:-10] ** 2)
    for prnu, colour in ((0.01, RED), (0.005, ORANGE), (0.0025, GREEN)):
        variance = prnu**2 * np.mean(grey**2) + (0.1 * prnu) ** 2
        overlap = pattern_overlap(along, 5)[1] * pattern_overlap(across, 5)[0]
        error = -variance / slope * 2.0 * np.mean(overlap * wave, axis=1) / (DIRECTION[0] * amplitude)
        name = f"PRNU {100 * prnu:g} %"
        axes.semilogx(amplitude, 100.0 * error, color=colour, label=name)
        points = _benchmark_points(name)
        axes.plot(points[:, 0], points[:, 1], "o", color=colour, markersize=4)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set(xlabel="amplitude in the image in px", ylabel="error of the amplitude in %")
    axes.set_xticks([0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5], ["0.02", "0.05", "0.1", "0.2", "0.5", "1", "2", "5"])
    axes.set_title("Uncorrected, a fixed pattern shortens small motions (lines: formula, points: rendered)")
    axes.legend(loc="lower right")
    return figure


def repeated_print() -> Figure:
    """Draw where copies of one subset lie on a foil that repeats, straight and turned against the epipolar lines."""
    figure, axes = new_figure(3.1, 1, 2)
    radius = 12
    for axis, turn, title in ((axes[0], 0.0, "rows along the epipolar lines"), (axes[1], 8.0, "pattern turned by 8°")):
        grey = Foil(5.0, size_px=200, period_px=62.0, turn_deg=turn, seed=4).image().astype(np.float32)
        x, y = 30, 88
        score = cv2.matchTemplate(
            grey, grey[y - radius : y + radius + 1, x - radius : x + radius + 1], cv2.TM_CCOEFF_NORMED
        )
        peaks = (score >= cv2.dilate(score, np.ones((21, 21)))) & (score > 0.75)
        rows, columns = np.nonzero(peaks)
        axis.imshow(np.round(6.0 * grey) / 6.0, cmap="gray", vmin=-1.5, vmax=1.0, interpolation="nearest")
        axis.set(xticks=[], yticks=[], title=title)
        axis.axhspan(y - 6, y + 6, color=BLUE, alpha=0.35)
        for column, row in zip(columns + radius, rows + radius, strict=True):
            true, inside = abs(column - x) < 3 and abs(row - y) < 3, abs(row - y) <= 6
            colour = GREEN if true else (RED if inside else GREY)
            corner = (column - radius, row - radius)
            axis.add_patch(Rectangle(corner, 25, 25, facecolor=f"{colour}55", edgecolor=colour, linewidth=3.5))
        wrong = int(np.sum((np.abs(rows + radius - y) <= 6) & (np.abs(columns + radius - x) > 3)))
        axis.set_xlabel(f"{len(rows) - 1} copies, {wrong} of them in the band of the epipolar line")
    return figure


def epipolar_sensitivity() -> Figure:
    """Draw how points of the demo pair move in the right image by a turn of that camera, and what of it is visible."""
    rig = read_calibration(ROOT / "sample_images" / "demo" / "calibration" / "top.json")
    width, height = rig.right.size_px
    grid = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 7) * width, np.linspace(0.1, 0.9, 6) * height), -1).reshape(-1, 2)
    distance = _crossing_m(rig)
    rays = np.column_stack([rig.left.undistort(grid), np.ones(len(grid))])
    points = rays * distance
    left, right = rig.project(points)
    figure, axes = new_figure(2.75, 1, 3, sharey=True)
    names = "about its x axis (across)", "about its y axis (vertical)", "about its optical axis"
    for number, (axis, name) in enumerate(zip(axes, names, strict=True)):
        turn = np.zeros(3)
        turn[number] = 5e-4
        moved = rig.right.project(rig.right_from_left.apply(points) @ rotation_from_vector(turn).T)
        residual = epipolar_residual(rig, left, moved)[0]
        shift = moved - right
        moves, seen = np.sqrt(np.mean(np.sum(shift**2, axis=1))), np.sqrt(np.mean(residual**2))
        times = 40 if moves > 0.1 else 400
        drawn = axis.quiver(*right.T, *shift.T, np.abs(residual), scale=1.0 / times, **QUIVER)
        drawn.set_clim(0.0, 0.8)
        axis.set(xlim=(0, width + 30), ylim=(height + 15, -25), aspect="equal", xticks=[], yticks=[])
        axis.set_title(f"{name}\narrows × {times}", fontsize=8.5)
        axis.set_xlabel(f"points move by {moves:.2g} px rms\nepipolar residual {seen:.2g} px rms")
    figure.colorbar(drawn, ax=axes, label="epipolar residual in px", shrink=0.8)
    figure.suptitle(
        "The right camera turned by 0.5 mrad: displacement of points in its image", x=0.01, ha="left", fontsize=9.5
    )
    return figure


QUIVER: dict[str, Any] = {"cmap": "plasma", "angles": "xy", "scale_units": "xy", "width": 0.012}


def _crossing_m(rig: Any) -> float:
    """Return the distance at which the right camera's axis passes the left one's."""
    back = rig.right_from_left.inverse()
    direction, start = back.rotation[:, 2], back.translation_m
    columns = np.column_stack([np.array([0.0, 0.0, 1.0]), -direction])
    return float(np.linalg.lstsq(columns, start, rcond=None)[0][0])


def tracking_steps() -> Figure:
    """Draw the steps from the images of two cameras to the six components of the body."""
    figure, axes = new_figure(2.1)
    blank(axes, (-0.3, 100), (0, 30), "auto")
    boxes = [
        (0, "1 grid", "subsets on the\ntextured area of\nthe first left image", BLUE),
        (20.6, "2 left to right", "each subset along\nits epipolar line,\nonce", BLUE),
        (41.2, "3 through time", "each subset in\nevery chosen frame\nof both cameras", BLUE),
        (61.8, "4 points", "triangulation,\nrigid motion,\noutliers rejected", ORANGE),
        (82.4, "5 grey values", "six components\nfitted to all pixels\nof both cameras", GREEN),
    ]
    for x, title, text, colour in boxes:
        axes.add_patch(Rectangle((x, 8), 17.2, 20, facecolor="white", edgecolor=colour, linewidth=1.6))
        axes.text(x + 1, 24.4, title, fontsize=9, fontweight="bold", color=colour, va="center")
        axes.text(x + 1, 15.4, text, fontsize=7.6, va="center", linespacing=1.35)
    for x in (17.6, 38.2, 58.8, 79.4):
        axes.add_patch(FancyArrowPatch((x, 18), (x + 2.8, 18), arrowstyle="-|>", mutation_scale=10, color=GREY))
    axes.text(71, 3.6, "start, and check of deformation", color=ORANGE, ha="center", fontsize=8)
    axes.text(91, 3.6, "the result", color=GREEN, ha="center", fontsize=8)
    axes.text(9, 3.6, "in the first frame", color=BLUE, fontsize=8)
    axes.plot([0, 37.8], [6.2, 6.2], color=BLUE, linewidth=1.0)
    return figure


def poor_surfaces() -> Figure:
    """Draw subsets of the surfaces of benchmarks/poor_surfaces.py, with their bounds along two directions."""
    sys.path.append(str(ROOT / "benchmarks"))
    module = importlib.import_module("poor_surfaces")
    figure, axes = new_figure(3.6, 2, 3)
    for axis, name in zip(axes.ravel(), module.SURFACES, strict=True):
        series = module.record(name, "none", 0.0, 1)
        subset = series.frames[0][module.INNER, module.INNER]
        _show(axis, 0.5 + (subset - subset.mean()) / (6.0 * subset.std()), name)
        along, across = 1e3 * series.bound_px
        weak = f"{across:.0f} mpx across" if across < 1e5 else "undetermined across"
        axis.set_xlabel(f"{along:.0f} mpx along the slopes,\n{weak}", fontsize=8)
    return figure


DRAWINGS = (
    speckle_quality,
    speckle_autocorrelation,
    subset_registration,
    subset_bound,
    interpolation_bias,
    fixed_pattern,
    repeated_print,
    epipolar_sensitivity,
    tracking_steps,
    poor_surfaces,
)
