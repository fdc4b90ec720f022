"""The star of the DIC Challenge 2.0: spatial resolution against noise of our subsets and of another program's.

    python benchmarks/challenge.py --package FOLDER [--peer-python PATH] [--docs docs]

FOLDER is the folder `pyvale` of an installation of pyvale, which carries the pair of images; --peer-python is the
interpreter that has it. Nobody knows the pair's truth better than its makers (Reu et al. 2022, Exp. Mech. 62, 639):
v = 0.5 px · cos(2π(y − 250)/p) with the period p growing evenly from 10 px in the first column to 300 px in the last,
u = 0, white noise. Every program tracks the same subsets, 5 px apart in a band of ±40 px about the centre line.

- resolution: smallest period whose amplitude along the centre line, a mean over 75 px (5.4 px of period), is and
  stays 90 % of the true one. Stretches in which any was refused count as not resolved.
- noise: robust standard deviation of u (1.4826 times the median of |u|) where p > 100 px.
- off: points that were found with v off by more than 0.1 px; of those, where the subset resolves the field (p more
  than 1.2 times the resolution).
- beyond 5 u: points off by more than 0.1 px and by more than five times their stated standard uncertainty.
- sd/u: robust standard deviation of u's error over its standard uncertainty, p > 100 px; both images' noise counts.

With --docs, the table goes to tracking.md there and the figure to images/challenge.png.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from marked import short_table, write_marked

Array = np.ndarray
STAR = "data/dic/challenge/DIC_Challenge_Star_Noise_{}.tiff"
RADII_PX, STEP_PX, HALF_BAND_PX, MARGIN_PX = (9, 12, 15), 5, 40, 50
AMPLITUDE_PX, MIDDLE_PX, WIDTH_PX = 0.5, 250.0, 4000
PERIODS_PX = (10.0, 300.0)
AVERAGED, RESOLVED, WRONG_PX, SIGMAS = 15, 0.9, 0.1, 5.0
PLAIN_PX, ABOVE = 100.0, 1.2
HEAD = (
    "| program | order | subset in px | resolution in px | noise in mpx "
    "| refused | off | off, resolved | beyond 5 u | sd/u |"
)


@dataclass(frozen=True)
class Found:
    """Subsets centred at points (N,2), found moved by shifts (N,2) in px, NaN where refused; u_px (N,2): stated."""

    points: Array
    shifts: Array
    u_px: Array


@dataclass(frozen=True)
class Line:
    """One row of the table."""

    program: str
    order: int
    side_px: int
    resolution_px: float
    noise_px: float
    counts: tuple[int, int, int, int | None]
    ratio: float

    def __str__(self) -> str:
        refused, off, off_resolved, beyond = self.counts
        stated = ("–", "–") if beyond is None else (f"{beyond}", f"{self.ratio:.2f}")
        cells = (
            self.program,
            self.order,
            f"{self.side_px} × {self.side_px}",
            f"{self.resolution_px:.1f}",
            f"{1e3 * self.noise_px:.1f}",
            refused,
            off,
            off_resolved,
            *stated,
        )
        return f"| {' | '.join(map(str, cells))} |"


def period_px(x: Array) -> Array:
    """Period of the displacement in the columns x."""
    return PERIODS_PX[0] + (PERIODS_PX[1] - PERIODS_PX[0]) * x / (WIDTH_PX - 1)


def true_v(points: Array) -> Array:
    """Displacement (N,) along y in px at the points (N,2)."""
    return np.asarray(AMPLITUDE_PX * np.cos(2.0 * np.pi * (points[:, 1] - MIDDLE_PX) / period_px(points[:, 0])))


def ours(package: Path, points: Array, radius: int, order: int) -> Found:
    """Our subsets, with quintic splines."""
    import cv2

    from photogram.bspline import spline_of_image
    from photogram.subsets.find import find_without_prediction
    from photogram.subsets.icgn import TrackSettings, noise_of_residual, position_covariance
    from photogram.subsets.reference import TrackStatus, prepare_reference

    first, second = (cv2.imread(str(package / STAR.format(name)), cv2.IMREAD_UNCHANGED) for name in ("Ref", "Def"))
    assert first is not None
    assert second is not None
    settings = TrackSettings(radius_px=radius, shape_order=order)
    reference = prepare_reference(spline_of_image(first), points, radius, order)
    found = find_without_prediction(reference, first, (second, spline_of_image(second)), settings)
    noise = noise_of_residual(reference, found, settings.degree)
    covariance = position_covariance(reference, found, noise)[:, [0, 1], [0, 1]]
    place = [0, reference.removed.shape[2] // (4 if order == 2 else 2)]
    # What a series has once, here counts: the noise of the reference, whose gradients are those without their noise
    covariance += reference.inverse_hessian[:, place, place] * noise[:, None] ** 2
    shifts = np.where((found.status == TrackStatus.OK)[:, None], found.warp[:, [0, 3]], np.nan)
    return Found(points, shifts, np.sqrt(covariance))


def peer(package: Path, python: str, radius: int, order: int) -> Found:
    """The peer's subsets, in a process of its own interpreter."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "found.npz"
        words = [python, __file__, "--package", str(package), "--as-peer", str(result), str(radius), str(order)]
        subprocess.run(words, check=True, cwd=folder, stdout=subprocess.DEVNULL)
        with np.load(result) as content:
            points, shifts = content["points"], content["shifts"]
    return Found(points, shifts, np.full_like(shifts, np.nan))


def run_as_peer(package: Path, result: Path, radius: int, order: int) -> None:
    """What pyvale finds, without its image filter, in its own grid over our band."""
    from pyvale import dic

    first, second = (package / STAR.format(name) for name in ("Ref", "Def"))
    middle, mask = int(MIDDLE_PX), np.zeros((501, WIDTH_PX), dtype=bool)
    reach, side = HALF_BAND_PX + radius, MARGIN_PX - radius
    mask[middle - reach : middle + reach + 1, side : WIDTH_PX - side] = True
    with tempfile.TemporaryDirectory() as folder:
        dic.calculate_2d(
            reference=first,
            deformed=second,
            roi_mask=mask,
            seed=[3500, middle],
            subset_size=2 * radius + 1,
            subset_step=STEP_PX,
            shape_function={1: "AFFINE", 2: "QUAD"}[order],
            max_displacement=8,
            image_filter_kernel=1,
            num_threads=1,
            output_basepath=folder,
            output_binary=True,
            print_level=0,
        )
        found = dic.import_2d(Path(folder) / "*.dic2d", delimiter=",", binary=True, layout="column", print_level=0)
    points = np.column_stack([found.ss_x, found.ss_y]).astype(np.float64)
    np.savez(result, points=points, shifts=np.stack([found.u_px[0], found.v_px[0]], axis=-1))


def amplitude(found: Found) -> tuple[Array, Array]:
    """Periods (K,) in px and the amplitude (K,) there along the row next to the centre line, over the true one."""
    rows = np.unique(found.points[:, 1])
    line = found.points[:, 1] == rows[np.argmin(np.abs(rows - MIDDLE_PX))]
    line &= np.abs(true_v(found.points)) > AMPLITUDE_PX / 2
    order = np.argsort(found.points[line, 0])
    points, shifts = found.points[line][order], found.shifts[line][order]
    share = shifts[:, 1] / true_v(points)
    box = np.ones(AVERAGED) / AVERAGED
    return np.convolve(period_px(points[:, 0]), box, "valid"), np.convolve(share, box, "valid")


def resolution_px(found: Found) -> float:
    """Smallest period from which on the amplitude is 90 % of the true one."""
    period, share = amplitude(found)
    below = np.flatnonzero(~(share >= RESOLVED))
    if len(below) == 0:
        return float(period[0])
    last = below[-1]
    if last + 1 == len(period) or np.isnan(share[last]):
        return float(period[min(last + 1, len(period) - 1)])
    return float(np.interp(RESOLVED, share[last : last + 2], period[last : last + 2]))


def line_of(program: str, order: int, radius: int, found: Found) -> Line:
    """The row of the table of what a program found."""
    period, seen = period_px(found.points[:, 0]), np.isfinite(found.shifts).all(axis=1)
    plain, limit = seen & (period > PLAIN_PX), resolution_px(found)
    error = found.shifts - np.column_stack([np.zeros(len(period)), true_v(found.points)])
    off = seen & (np.abs(error) > WRONG_PX).any(axis=1)
    stated = bool(np.isfinite(found.u_px[plain]).all())
    beyond = int((off & (np.abs(error) > SIGMAS * found.u_px).any(axis=1)).sum()) if stated else None
    return Line(
        program,
        order,
        2 * radius + 1,
        limit,
        robust(error[plain, 0]),
        (int((~seen).sum()), int(off.sum()), int((off & (period > ABOVE * limit)).sum()), beyond),
        robust(error[plain, 0] / found.u_px[plain, 0]),
    )


def robust(values: Array) -> float:
    """Standard deviation about zero of most of the values."""
    return float(1.4826 * np.median(np.abs(values)))


def draw(lines: list[Line], shares: dict[str, tuple[Array, Array]]) -> bytes:
    """Noise over resolution of every row, and the amplitude over the period of 19 × 19 px."""
    from fusion.report.figure import BLUE, GREEN, GREY, ORANGE, RED
    from fusion.report.figure_files import drawing, figure_bytes, new_figure

    colours = {"shakercal 1": BLUE, "shakercal 2": RED, "pyvale 1": GREEN, "pyvale 2": ORANGE}
    with drawing("challenge"):
        figure = new_figure(2.9)
        left, right = figure.subplots(1, 2)
        for name, colour in colours.items():
            rows = [line for line in lines if f"{line.program} {line.order}" == name]
            label = "{}, order {}".format(*name.split())
            if rows:
                places, noise = zip(*((row.resolution_px, 1e3 * row.noise_px) for row in rows), strict=True)
                left.plot(places, noise, "o-", color=colour, markersize=3.5, linewidth=0.9, label=label)
                for row in rows:
                    place = (row.resolution_px, 1e3 * row.noise_px)
                    left.annotate(f" {row.side_px}", place, fontsize=6, color=colour)
                right.plot(*shares[name], color=colour, linewidth=0.8, label=label)
        left.set_xlabel("smallest resolved period in px (90 %)")
        left.set_ylabel("noise of u in mpx")
        left.legend(fontsize=6)
        right.axhline(RESOLVED, color=GREY, linewidth=0.7)
        right.set(xlim=(10, 120), ylim=(0.0, 1.15), xlabel="period in px", ylabel="amplitude found / true, 19 × 19 px")
        figure.tight_layout()
        return figure_bytes(figure, "png")


def main() -> None:
    """Print the table, and write table and figure into the documents where their folder is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--package", type=Path, required=True)
    parser.add_argument("--peer-python")
    parser.add_argument("--docs", type=Path)
    parser.add_argument("--as-peer", nargs=3, metavar=("RESULT", "RADIUS", "ORDER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    package = options.package.resolve()
    if not (package / STAR.format("Ref")).is_file():
        parser.error(f"--package: expected pyvale's folder with {STAR.format('Ref')}, found none in {package}")
    if options.as_peer:
        run_as_peer(package, Path(options.as_peer[0]), *map(int, options.as_peer[1:]))
        sys.exit()
    lines, shares = [], dict[str, tuple[Array, Array]]()
    columns = np.arange(MARGIN_PX, WIDTH_PX - MARGIN_PX, STEP_PX, dtype=np.float64)
    band = np.arange(MIDDLE_PX - HALF_BAND_PX, MIDDLE_PX + HALF_BAND_PX + 1, STEP_PX)
    points = np.stack(np.meshgrid(columns, band), axis=-1).reshape(-1, 2)
    print(HEAD)
    for radius in RADII_PX:
        for order in (1, 2):
            found = {"shakercal": ours(package, points, radius, order)}
            if options.peer_python:
                found["pyvale"] = peer(package, options.peer_python, radius, order)
            for program, here in found.items():
                lines.append(line_of(program, order, radius, here))
                shares.setdefault(f"{program} {order}", amplitude(here))
                print(lines[-1], flush=True)
    if options.docs:
        rows = list(map(str, lines))
        table = short_table(HEAD, rows, (0, 1, 3, 4, 5, 6, 8), lambda cells: cells[2] == "25 × 25")
        write_marked(options.docs / "tracking.md", {"challenge": table})
        (options.docs / "images" / "challenge.png").write_bytes(draw(lines, shares))


if __name__ == "__main__":
    main()
