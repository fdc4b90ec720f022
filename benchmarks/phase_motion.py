"""Motion of poor surfaces: grey-value fits and phase-based methods on the same pixels, compared with the bound.

    python benchmarks/phase_motion.py [--draws 20] [--write]

Surfaces of `poor_surfaces` move in two sines, one along the direction of their strongest slopes and one across it.
Every estimator finds the displacement of one subset of 31 x 31 px in 64 frames. Errors are relative to the
Cramér-Rao bound of a known image with free gain and offset.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from marked import markdown_row, markdown_table, write_marked
from poor_surfaces import (
    BITS,
    DISTURBANCES,
    INNER,
    MIDDLE_PX,
    RADIUS,
    SIDE,
    SURFACES,
    ComplexArray,
    FloatArray,
    Series,
    X,
    record,
)
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from skimage.registration import phase_cross_correlation

from photogram.bspline import spline_of_image
from photogram.subsets.icgn import TrackSettings, register
from photogram.subsets.reference import prepare_reference

Estimator = Callable[[FloatArray], FloatArray]
PAGE = Path(__file__).resolve().parents[1] / "docs" / "poor-surfaces.md"
AMPLITUDE_PX = 0.1
MIDDLE = np.full((1, 2), float(MIDDLE_PX))
WAVELENGTHS_PX = (4.0, 8.0, 14.0)
WINDOW = np.outer(np.hanning(2 * RADIUS + 1), np.hanning(2 * RADIUS + 1))


def subsets(order: int, averaged: bool = False) -> Estimator:
    """Return the program's registration of a subset by a shape function's order, each frame from rest.

    The reference is the first frame, or the mean of all.
    """

    def estimate(frames: FloatArray) -> FloatArray:
        grey = frames * (2**BITS - 1)
        settings = TrackSettings(radius_px=RADIUS, degree=7, shape_order=order, min_zncc=0.0)
        first = grey.mean(axis=0) if averaged else grey[0]
        reference = prepare_reference(spline_of_image(first, 7), MIDDLE, RADIUS, order)
        start = np.zeros((1, 6))
        found = [register(reference, spline_of_image(one, 7), start, settings).warp[0, [0, 3]] for one in grey]
        return np.array(found)

    return estimate


def smoothed(frames: FloatArray) -> FloatArray:
    """Return the shifts of `light_gradient` after a Gaussian filter of 1 px."""
    return light_gradient(gaussian_filter(frames, (0.0, 1.0, 1.0)))


def light_gradient(frames: FloatArray) -> FloatArray:
    """Return shifts by a fit of translation, gain, offset and a linear change of the light, to the mean image."""
    mean, step = spline_filter(frames.mean(axis=0), 5), 0.01
    first = _moved(mean, np.zeros(2))
    slopes = [(_moved(mean, step * one) - _moved(mean, -step * one)) / (2.0 * step) for one in np.eye(2)]
    x, y = (each[INNER, INNER].ravel() / RADIUS for each in np.meshgrid(X, X))
    design = np.linalg.pinv(np.column_stack([*slopes, np.ones_like(first), first, first * x, first * y]))
    found = []
    for frame in frames:
        moved, spline = np.zeros(2), spline_filter(frame, 5)
        for _ in range(3):
            moved = moved - (design @ (_moved(spline, moved) - first))[:2]
        found.append(moved)
    return np.array(found)


def _moved(spline: FloatArray, moved_px: FloatArray) -> FloatArray:
    """Return grey values at the subset's pixels displaced by (x, y)."""
    pixels = np.arange(INNER.start, INNER.stop)
    rows, columns = np.meshgrid(pixels + moved_px[1], pixels + moved_px[0], indexing="ij")
    return np.asarray(map_coordinates(spline, [rows.ravel(), columns.ravel()], order=5, prefilter=False))


def _frequencies() -> tuple[FloatArray, FloatArray]:
    line = 2.0 * np.pi * np.fft.fftfreq(SIDE)
    across, down = np.meshgrid(line, line)
    return across, down


def _phase_sums(reference: ComplexArray, slopes: ComplexArray, found: ComplexArray, sigma_px: float) -> FloatArray:
    """Return sums (F, 2, 3) of amplitude-weighted phase gradients: normal matrix and right-hand side.

    A filter reaches by its width beyond the pixels that are summed, so that the subset's data are used.
    """
    inner = slice(INNER.start + round(sigma_px), INNER.stop - round(sigma_px))
    centre, seen = reference[inner, inner], found[:, inner, inner]
    gradient = (np.conj(centre) * slopes[:, inner, inner]).imag  # |R|² times the gradient of the phase
    change = np.angle(seen * np.conj(centre))
    normal = np.einsum("iyx,jyx->ij", gradient, gradient / np.abs(centre) ** 2)
    return np.concatenate(
        [np.broadcast_to(normal, (len(found), 2, 2)), -np.einsum("iyx,fyx->fi", gradient, change)[:, :, None]], axis=2
    )


def phase_gabor(frames: FloatArray) -> FloatArray:
    """Return shifts by local phases of 18 Gabor filters: three wavelengths, six directions (Fleet and Jepson 1990)."""
    across, down = _frequencies()
    spectra = np.fft.fft2(frames - frames.mean(axis=(1, 2), keepdims=True))
    total = np.zeros((len(frames), 2, 3))
    for wavelength in WAVELENGTHS_PX:
        sigma, wave = 0.56 * wavelength, 2.0 * np.pi / wavelength  # one octave wide
        for angle in np.pi * np.arange(6) / 6:
            distance2 = (across - wave * np.cos(angle)) ** 2 + (down - wave * np.sin(angle)) ** 2
            transfer = np.exp(-0.5 * sigma**2 * distance2)
            filtered = spectra * transfer / np.sqrt(np.mean(transfer**2))
            mean = filtered.mean(axis=0)
            slopes = np.fft.ifft2(np.array([1j * across * mean, 1j * down * mean]))
            total += _phase_sums(np.fft.ifft2(mean), slopes, np.fft.ifft2(filtered), sigma)
    return np.asarray(np.linalg.solve(total[:, :, :2], total[:, :, 2:])[..., 0], np.float64)


def phase_monogenic(frames: FloatArray) -> FloatArray:
    """Return shifts by the phases of the monogenic signal in three bands (Felsberg and Sommer 2001)."""
    across, down = _frequencies()
    spectra = np.fft.fft2(frames - frames.mean(axis=(1, 2), keepdims=True))
    radius = np.hypot(across, down)
    radius[0, 0] = 1.0
    total = np.zeros((len(frames), 2, 3))
    for wavelength in WAVELENGTHS_PX:
        band = np.exp(-0.5 * (np.log(radius * wavelength / (2.0 * np.pi)) / 0.55) ** 2)  # one octave wide
        band[0, 0] = 0.0
        scale, mean = 1.0 / np.sqrt(np.mean(band**2)), spectra.mean(axis=0)
        odd = [band * 1j * each / radius for each in (across, down)]
        right, lower = (np.fft.ifft2(mean * part).real for part in odd)
        angle = np.arctan2(lower, right)  # of the local structure, the same for all frames
        slopes = np.array([1j * across * mean, 1j * down * mean])
        reference, gradient, found = (scale * _monogenic(each, (band, *odd), angle) for each in (mean, slopes, spectra))
        total += _phase_sums(reference, gradient, found, 0.4 * wavelength)
    return np.asarray(np.linalg.solve(total[:, :, :2], total[:, :, 2:])[..., 0], np.float64)


def _monogenic(spectrum: ComplexArray, parts: tuple[ComplexArray, ...], angle: FloatArray) -> ComplexArray:
    """Return the even part of a band and its odd part along an angle, as a complex signal."""
    even, right, lower = (np.fft.ifft2(spectrum * part).real for part in parts)
    return np.asarray(even - 1j * (np.cos(angle) * right + np.sin(angle) * lower))


def correlation_peak(frames: FloatArray) -> FloatArray:
    """Return shifts by scikit-image's upsampled correlation under Hann's window, in steps of 0.01 px.

    Without whitening: with it the errors of these noisy images are five times as large.
    """
    crops = frames[:, INNER, INNER]
    crops = (crops - crops.mean(axis=(1, 2), keepdims=True)) * WINDOW
    shifts = [phase_cross_correlation(crops[0], one, upsample_factor=100, normalization=None)[0] for one in crops]
    return -np.array(shifts)[:, ::-1]


def correlation_centroid(frames: FloatArray) -> FloatArray:
    """Return shifts by OpenCV's phase correlation: the centroid of the peak, with Hann's window."""
    crops = np.ascontiguousarray(frames[:, INNER, INNER])
    return np.array([cv2.phaseCorrelate(crops[0], one, WINDOW)[0] for one in crops])


ESTIMATORS: dict[str, Estimator] = {
    "subset, affine": subsets(1),
    "subset, translation": subsets(0),
    "subset, mean reference": subsets(0, averaged=True),
    "with light gradient": light_gradient,
    "and Gaussian filter": smoothed,
    "phase, Gabor": phase_gabor,
    "phase, monogenic": phase_monogenic,
    "correlation, scikit-image": correlation_peak,
    "correlation, OpenCV": correlation_centroid,
}


def evaluate(series: Series, found_px: FloatArray) -> FloatArray:
    """Return (2, 2): rms error over the bound, and slope - 1, along the strong and the weak direction."""
    truth, found = (each @ series.axes.T for each in (series.truth_px, found_px))
    truth, found = truth - truth.mean(axis=0), found - found.mean(axis=0)
    rms = np.sqrt(np.mean((found - truth) ** 2, axis=0)) / series.bound_px
    return np.stack([rms, np.sum(found * truth, axis=0) / np.sum(truth**2, axis=0) - 1.0])


def rows(draws: int, amplitude_px: float, report: Callable[[str], None]) -> dict[str, list[str]]:
    """Return the rows of the tables: rms error over the bound, and slope - 1, along the strong direction."""
    tables: dict[str, list[str]] = {"rms": [], "bias": []}
    for name in SURFACES:
        for disturbance in DISTURBANCES:
            found: list[list[FloatArray]] = [[] for _ in ESTIMATORS]
            bounds = []
            for draw in range(draws):
                series = record(name, disturbance, amplitude_px, draw)
                bounds.append(1e3 * series.bound_px)
                for one, estimate in zip(found, ESTIMATORS.values(), strict=True):
                    one.append(evaluate(series, estimate(series.frames)))
            strong, weak = np.median(bounds, axis=0)
            along = f"{weak:.0f}" if weak < 1e5 else "none"
            rms, bias = (list(each) for each in zip(*(_cells(np.array(one)) for one in found), strict=True))
            tables["rms"].append(markdown_row(name, disturbance, f"{strong:.1f}", along, *rms))
            tables["bias"].append(markdown_row(name, disturbance, *bias))
            report(tables["rms"][-1] + "\n" + tables["bias"][-1])
    return tables


def _cells(found: FloatArray) -> tuple[str, str]:
    """Return rms and bias in per cent with its standard error, of the draws (D, 2, 2) that have a result."""
    used = found[np.isfinite(found[:, 0, 0])][:, :, 0]
    if len(used) < max(2, len(found) / 2):
        return "refused", "refused"
    rms, slope = float(np.sqrt(np.mean(used[:, 0] ** 2))), 100.0 * used[:, 1]
    if rms > 10.0:
        return "> 10", "-"
    return f"{rms:.2f}", f"{slope.mean():+.1f} ± {slope.std(ddof=1) / np.sqrt(len(slope)):.1f}"


def main() -> None:
    """Print the tables, or write them into the documents."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--amplitude-px", type=float, default=AMPLITUDE_PX)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    tables = rows(arguments.draws, arguments.amplitude_px, lambda row: print(row, flush=True))
    heads = {
        "rms": markdown_row("surface", "disturbance", "bound / mpx", "across / mpx", *ESTIMATORS),
        "bias": markdown_row("surface", "disturbance", *ESTIMATORS),
    }
    marked = {f"phase {name}": markdown_table(heads[name], table) for name, table in tables.items()}
    print("\n\n".join(marked.values()))
    if arguments.write:
        write_marked(PAGE, marked)


if __name__ == "__main__":
    main()
