"""The DIC Challenge 2.0 in its own metrics, with our subsets and those of other open programs at equal grid and frames.

    python benchmarks/dic_challenge.py --package FOLDER [--peer-python PATH] [--docs docs] [--results FOLDER]

FOLDER is the folder `pyvale` of an installation of pyvale, which carries the images; --peer-python is the interpreter
that has pyvale, pyidi and al-dic. Every program tracks the same subsets of the star, 4 px apart in a band of ±80 px
about the centre row, for six sizes of subsets, in a process of its own on one thread; then pyvale and ours evaluate the
stereo images. The metrics are those of dic_metrics.py. Takes about an hour of one core, most of it imports.

With --docs the tables go to dic-challenge.md there, and the figures to images. With --results the displacements are
kept in that folder, and a run that has its file there is not repeated; metrics.csv there has all metrics.
"""

from __future__ import annotations

import argparse
import csv
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from dic_figures import bias_figure, cut_figure, efficiency_figure
from dic_metrics import (
    LONG_PX,
    MIDDLE_PX,
    Field,
    Resamples,
    centre_row,
    lasting_resolution_px,
    noise_px,
    period_px,
    pixel_bias_px,
    projected_amplitude,
    resample,
    resolution_px,
    true_shift,
)
from dic_programs import PROGRAMS, Grid
from dic_stereo import CASES, Case, Surface, epipolar_px, our_surface
from marked import existing_file, existing_folder, markdown_row, markdown_table, write_marked
from numpy.typing import NDArray
from tracking_programs import NOT_INSTALLED

STAR = "data/dic/challenge/DIC_Challenge_Star_Noise_{}.tiff"
SIDES_PX, DETAILED_PX, BLOCK_PX = (11, 15, 19, 25, 31, 41), 19, 60.0
COLUMNS_PX, ROWS_PX, STEP_PX = (26, 3974), (170, 330), 4
OWN = "shakercal"
ORDERS = {"translation": 0, "affine": 1, "quadratic": 2}
NM = 1e3  # in µm
WRONG_PX, SIGMAS = 0.1, 5.0  # of points with a large error
STATED_PX = (19, 31)
Samples = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """Metrics of one program with subsets of one size."""

    program: str
    side_px: int
    version: str
    user_us: float
    field: Field
    u_px: Samples
    resamples: Resamples
    resolution: float
    noise: float
    bias: float

    @property
    def shape(self) -> str:
        """Shape function: translation, affine or quadratic."""
        return next(name for name in ORDERS if name in self.program)

    @property
    def mei(self) -> float:
        """Metrological efficiency indicator in px²."""
        return self.resolution * self.noise

    @property
    def missing(self) -> tuple[int, float]:
        """Number of missing points, and the longest period with one in the centre row (NaN for none) in px."""
        x, ratio = centre_row(self.field)
        gone = period_px(x[np.isnan(ratio)])
        return int(np.isnan(self.field.shifts[:, 0]).sum()), float(gone.max()) if len(gone) else float("nan")


Results = dict[tuple[str, int], Measured]


def run_program(program: str, side_px: int, package: Path, python: Path, results: Path) -> Path | None:
    """Return the file of one program's displacements, None if it is not installed; the reason is printed."""
    result = results / f"{re.sub('[^a-z]+', '-', program)}_{side_px}.npz"
    if result.is_file():
        return result
    grid = Grid(COLUMNS_PX, ROWS_PX, STEP_PX, side_px // 2)
    words = ["--columns", *map(str, grid.columns), "--rows", *map(str, grid.rows)]
    words += ["--step", f"{grid.step}", "--radius", f"{grid.radius}"]
    images = [package / STAR.format(name) for name in ("Ref", "Def")]
    limits = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [python.absolute(), Path(__file__).with_name("dic_programs.py"), program, *images, result, *words],
            cwd=folder,  # where a program may leave what it likes
            env={**os.environ, **limits},
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode == NOT_INSTALLED:
        print(f"{program} skipped: {done.stderr.strip()}", file=sys.stderr)
        return None
    if done.returncode != 0:
        raise RuntimeError(f"{program}: {done.stderr[-2000:]}")
    return result


def measure(program: str, side_px: int, result: Path) -> Measured:
    """Return the metrics of one result."""
    with np.load(result) as content:
        field = Field(content["points"], content["shifts"])
        user_us, version = 1e6 * float(content["user_s"]) / len(field.points), str(content["version"])
        u_px = content["u_px"]
    metrics = (resolution_px(field), noise_px(field), pixel_bias_px(field))
    return Measured(program, side_px, version, user_us, field, u_px, resample(field, BLOCK_PX), *metrics)


def with_u(value: float, samples: Samples, digits: int) -> str:
    """Return a value and its standard uncertainty, the standard deviation of its resamples."""
    return f"{value:.{digits}f} ({np.nanstd(samples):.{digits}f})".replace("-", "−")


def size_table(results: Results, title: str, cells: dict[tuple[str, int], str], first: list[str]) -> str:
    """Return a table of programs over sizes; `first`: rows before them."""
    head = f"| {title} | {' | '.join(f'{side} px' for side in SIDES_PX)} |"
    programs = list(dict.fromkeys(program for program, _ in results))
    lines = [(program, *(cells.get((program, side), "–") for side in SIDES_PX)) for program in programs]
    return markdown_table(head, first + [markdown_row(*line) for line in lines if set(line[1:]) != {"–"}])


def star_tables(results: Results) -> dict[str, str]:
    """Return the tables of the star by the names of their places in the page."""
    predicted = [
        markdown_row(
            f"*least squares, {shape}*", *(f"{resolution_px(least_squares(side, order)):.1f}" for side in SIDES_PX)
        )
        for shape, order in list(ORDERS.items())[1:]
    ]
    items = results.items()
    columns = {
        "dic-mei": ("MEI in px²", {k: with_u(m.mei, m.resamples.mei, 3) for k, m in items}, []),
        "dic-ratio": ("MEI over shakercal's", {k: ratio_text(m, results) for k, m in items}, []),
        "dic-resolution": (
            "λ in px",
            {k: with_u(m.resolution, m.resamples.resolution, 1) for k, m in items},
            predicted,
        ),
        "dic-lasting": (
            "MEI over shakercal's, λ by the running mean",
            {k: lasting_text(m, results) for k, m in items},
            [],
        ),
        "dic-time": ("user CPU over shakercal's", {k: time_text(m, results) for k, m in items}, []),
        "dic-noise": ("σ in mpx", {k: with_u(1e3 * m.noise, 1e3 * m.resamples.noise, 1) for k, m in items}, []),
    }
    tables = {name: size_table(results, *arguments) for name, arguments in columns.items()}
    head = (
        f"| program, {DETAILED_PX} px | version | bias b in mpx | λ by the running mean in px | missing points "
        "| longest period of one in px |"
    )
    details = [detail_row(m) for (_, side), m in items if side == DETAILED_PX]
    stated = [stated_row(m) for (program, side), m in items if side in STATED_PX and np.isfinite(m.u_px).any()]
    title = "| program | subset in px | missing | error > 0.1 px | of these > 5 u | standard deviation of error / u |"
    return {**tables, "dic-details": markdown_table(head, details), "dic-stated": markdown_table(title, stated)}


def least_squares(side_px: int, order: int) -> Field:
    """Return the centre row of a program that averages by least squares, without noise."""
    x = np.arange(COLUMNS_PX[0], COLUMNS_PX[1] + 1.0, STEP_PX)
    points = np.column_stack([x, np.full_like(x, MIDDLE_PX)])
    return Field(points, true_shift(points) * projected_amplitude(side_px, order, period_px(x))[:, None])


def ratio_text(measured: Measured, results: Results) -> str:
    """Return the MEI over that of our subsets of equal size and shape, at common points, with its uncertainty."""
    own = results[f"{OWN}, {measured.shape}", measured.side_px]
    if own is measured:
        return "–"
    pair = [measured, own]
    seen = [np.isfinite(each.field.shifts[:, 0]) for each in pair]
    if not np.array_equal(seen[0], seen[1]):
        pair = [at_points(each, seen[0] & seen[1]) for each in pair]
    return with_u(pair[0].mei / pair[1].mei, pair[0].resamples.mei / pair[1].resamples.mei, 3)


def lasting_text(measured: Measured, results: Results) -> str:
    """Return the MEI with λ by the running mean over that of our subsets; – where points above λ are missing."""
    own = results[f"{OWN}, {measured.shape}", measured.side_px]
    lasting = [lasting_resolution_px(each.field) for each in (measured, own)]
    if own is measured or lasting[0] > 2.0 * measured.resolution or lasting[1] > 2.0 * own.resolution:
        return "–"
    return f"{lasting[0] * measured.noise / (lasting[1] * own.noise):.2f}"


def time_text(measured: Measured, results: Results) -> str:
    """Return the user CPU time per subset over that of our subsets."""
    own = results[f"{OWN}, {measured.shape}", measured.side_px]
    return "–" if own is measured else f"{measured.user_us / own.user_us:.1f}"


def at_points(measured: Measured, used: NDArray[np.bool_]) -> Measured:
    """Return the metrics of a program at the points `used` (N,) of its grid."""
    field = Field(measured.field.points, np.where(used[:, None], measured.field.shifts, np.nan))
    return replace(
        measured,
        field=field,
        resamples=resample(field, BLOCK_PX),
        resolution=resolution_px(field),
        noise=noise_px(field),
    )


def detail_row(measured: Measured) -> str:
    """Return bias and missing points of one program."""
    missing, longest = measured.missing
    return markdown_row(
        measured.program,
        measured.version,
        with_u(1e3 * measured.bias, 1e3 * measured.resamples.bias, 1),
        f"{lasting_resolution_px(measured.field):.1f}",
        f"{missing} of {len(measured.field.points)}",
        "–" if np.isnan(longest) else f"{longest:.1f}",
    )


def stated_row(measured: Measured) -> str:
    """Return how errors compare with the standard uncertainties that a program states."""
    error, long = np.abs(measured.field.error), measured.field.period > LONG_PX
    wrong = (error > WRONG_PX).any(axis=1)
    beyond = wrong & (error > SIGMAS * measured.u_px).any(axis=1)
    counts = (measured.missing[0], wrong.sum(), beyond.sum())
    scatter = np.nanstd(measured.field.error[long, 0] / measured.u_px[long, 0])
    return markdown_row(measured.program, f"{measured.side_px}", *map(str, counts), f"{scatter:.2f}")


def peer_surface(package: Path, name: str, python: Path, results: Path) -> Surface:
    """Return the surface of a case by pyvale, in a process of its own."""
    result = results / f"stereo-{name}.npz"
    if not result.is_file():
        words = [
            str(python.absolute()),
            str(Path(__file__).with_name("dic_stereo.py")),
            str(package),
            name,
            str(result),
        ]
        subprocess.run(words, check=True, cwd=results, stdout=subprocess.DEVNULL)
    with np.load(result) as content:
        return Surface(content["points"], content["right_px"], content["position_mm"])


def stereo_tables(package: Path, python: Path, results: Path) -> dict[str, str]:
    """Return the tables of the stereo images."""
    found: dict[str, dict[str, Surface]] = {}
    for name, case in CASES.items():
        peer = peer_surface(package, name, python, results)
        found[name] = {OWN: our_surface(package, case, peer.points), "pyvale": peer}
    common = np.all([np.isfinite(each.position_mm).all(axis=2) for each in found["plate"].values()], axis=0)
    plate = [
        markdown_row(program, *plate_cells(CASES["plate"], each, common)) for program, each in found["plate"].items()
    ]
    both = np.isfinite([each.position_mm[0, :, 2] for each in found["challenge"].values()]).all(axis=0)
    specimen = []
    for program, each in found["challenge"].items():
        seen, off = np.isfinite(each.position_mm[0, :, 2]), np.abs(epipolar_px(package, CASES["challenge"], each))
        share = [f"{1e3 * value:.1f}" for value in (np.median(off[both]), np.percentile(off[both], 95))]
        specimen.append(markdown_row(program, f"{seen.sum()} of {len(seen)}", *share))
    apart = np.linalg.norm(np.subtract(*(each.position_mm[0] for each in found["challenge"].values())), axis=1)[both]
    limits = (f"{1e3 * np.median(apart):.2f} µm", f"{1e3 * np.percentile(apart, 95):.1f} µm")
    return {
        "dic-plate": markdown_table(
            "| plate | largest mean error x, y in nm | z | largest standard deviation x, y in nm | z | points at rest "
            "| after 500 µm |",
            plate,
        ),
        "dic-specimen": markdown_table(
            "| specimen | points found | distance from the epipolar line in mpx: median | 95 % |", specimen
        ),
        "dic-apart": f"Both programs found {both.sum()} points. Their positions differ by {limits[0]} (median) and "
        f"{limits[1]} (95 %).",
    }


def plate_cells(case: Case, surface: Surface, common: NDArray[np.bool_]) -> list[str]:
    """Return the largest error and scatter of a plate's displacements over its states, at common points (F,N)."""
    moved = 1e3 * (surface.position_mm - surface.position_mm[0])[1:]
    error = np.where(common[1:, :, None], moved - np.array(case.true_um)[1:, None], np.nan)
    numbers = [np.abs(np.nanmean(error, axis=1)).max(axis=0), np.nanstd(error, axis=1).max(axis=0)]
    cells = [f"{NM * value:.1f}" for each in numbers for value in (each[:2].max(), each[2])]
    found = np.isfinite(surface.position_mm).all(axis=2).sum(axis=1)
    return [*cells, f"{found[0]}", f"{found[-1]}"]


def write_metrics(results: Results, path: Path) -> None:
    """Write all metrics of the star as a table of text."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = ("resolution_px", "u", "noise_px", "u", "mei_px2", "u", "bias_px", "u", "missing", "user_us")
        writer.writerow(["program", "version", "side_px", *names])
        for (program, side), m in results.items():
            pairs: tuple[tuple[float, Samples], ...]
            pairs = ((m.resolution, m.resamples.resolution), (m.noise, m.resamples.noise), (m.mei, m.resamples.mei))
            numbers = [
                n for value, samples in (*pairs, (m.bias, m.resamples.bias)) for n in (value, np.nanstd(samples))
            ]
            writer.writerow(
                [program, m.version, side, *(f"{n:.6g}" for n in numbers), m.missing[0], f"{m.user_us:.0f}"]
            )


def main() -> None:
    """Run all programs, print the tables, and write tables and figures into the documents if their folder is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--package", type=existing_folder, required=True)
    parser.add_argument("--peer-python", type=existing_file)
    parser.add_argument("--docs", type=existing_folder)
    parser.add_argument("--results", type=Path)
    options = parser.parse_args()
    package = options.package.resolve()
    if not (package / STAR.format("Ref")).is_file():
        parser.error(f"--package: expected pyvale's folder with {STAR.format('Ref')}, found none in {package}")
    with tempfile.TemporaryDirectory() as scratch:
        kept = (options.results or Path(scratch)).resolve()
        kept.mkdir(parents=True, exist_ok=True)
        results: Results = {}
        for side in SIDES_PX:
            for program in PROGRAMS:
                python = Path(sys.executable) if program.startswith(OWN) else options.peer_python
                done = run_program(program, side, package, python, kept) if python else None
                if done is not None:
                    results[program, side] = m = measure(program, side, done)
                    print(f"{program}, {side} px: λ {m.resolution:.1f} px, σ {1e3 * m.noise:.1f} mpx", flush=True)
        tables = star_tables(results)
        if options.peer_python:
            tables |= stereo_tables(package, options.peer_python, kept)
        write_metrics(results, kept / "metrics.csv")
    print("\n\n".join(tables.values()))
    if options.docs:
        write_marked(options.docs / "dic-challenge.md", tables)
        fields = {program: m.field for (program, side), m in results.items() if side == DETAILED_PX}
        places = {key: (m.resolution, m.noise) for key, m in results.items()}
        pictures = {
            "dic-cut": cut_figure(fields, DETAILED_PX),
            "dic-efficiency": efficiency_figure(places),
            "dic-bias": bias_figure(fields, DETAILED_PX),
        }
        for name, picture in pictures.items():
            (options.docs / "images" / f"{name}.png").write_bytes(picture)


if __name__ == "__main__":
    main()
