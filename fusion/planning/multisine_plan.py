"""`shakercal plan --lines`: a multisine for a whole curve from one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fusion.errors import InputError
from fusion.planning.plan import MotionSize
from fusion.planning.planning_notices import MULTISINE_FRAMES
from fusion.report.table import TableColumn, csv_text, page_column
from fusion.report.terminal import print_table, print_text
from shaker.lines.multisine import LineGrid, crest_factor, place_lines, products_on_lines, small_crest_phases
from shaker.lines.rate_planner import RatePlan, Sampling, lines_of, plan_at, scan_rates
from shaker.sine.aliasing import CLEAR_BINS
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text

_RATES, _LOWEST_RATE = 21, 0.98  # camera rates tried, down to this share of the highest


@dataclass(frozen=True)
class MultisineRequest:
    """Input of a multisine: number of lines, band, record, and limits.

    Attributes
    ----------
    lines : number of lines.
    band_hz : lowest and highest frequency, Hz.
    sampling : frames at most, exposure and noise of the record.
    rates_hz : camera rates to try, Hz.
    linear : whether the lines are in equal steps instead of equal ratios.
    slope : exponent p of accelerations in proportion to f^p.
    peak_mps2 : peak of the acceleration, m/s².
    settle_s : waiting time before each recording, s.
    noise_m : noise of the displacement per frame, m, if known.
    """

    lines: int
    band_hz: tuple[float, float]
    sampling: Sampling
    rates_hz: tuple[float, ...]
    linear: bool = False
    slope: float = 0.0
    peak_mps2: float = 1.0
    settle_s: float = 0.0
    noise_m: float | None = None


@dataclass(frozen=True)
class MultisinePlan:
    """A multisine with its predicted uncertainty.

    `acceleration_mps2` and `phase_rad` (K,): of cosines at time zero. `margin_bins`: smallest distance of two lines at
    the camera, reduced by the tolerance.
    """

    request: MultisineRequest
    grid: LineGrid
    at_rate: RatePlan
    acceleration_mps2: FloatArray
    phase_rad: FloatArray
    crest: float
    margin_bins: float

    @cached_property
    def relative(self) -> FloatArray | None:
        """Relative standard uncertainty (K,) of the amplitudes, None without noise."""
        size = MotionSize(self.request.noise_m, acceleration_mps2=1.0)
        if self.request.noise_m is None:
            return None
        values = [size.relative(self.at_rate, k) for k in range(len(self.acceleration_mps2))]
        return np.array(values, dtype=np.float64) / self.acceleration_mps2

    @property
    def single_frames(self) -> float:
        """Frames of each of as many recordings of one line, in the same total time.

        It is not positive if the pauses fill this time.
        """
        lines, settle_s = len(self.acceleration_mps2), self.request.settle_s
        return self.grid.rate_hz * ((self.at_rate.duration_s + settle_s) / lines - settle_s)

    def over_single(self, frames: float) -> FloatArray:
        """Return u (K,) over that of one line with the same peak and these frames.

        For well separated lines u is √(2/frames·(1 + corner/alias)) over the gain.
        """
        plan, corner_hz = self.at_rate, self.request.sampling.corner_hz
        alone = np.sqrt(2.0 / frames * (1.0 + corner_hz / plan.alias_hz)) / np.abs(plan.gain)
        return np.asarray(plan.u_amplitude / self.acceleration_mps2 / (alone / self.request.peak_mps2))


def make_multisine(request: MultisineRequest) -> MultisinePlan:
    """Choose frequencies, camera rate, amplitudes and phases of a multisine.

    Raises `InputError` if the frames cannot resolve the lines.
    """
    space = np.linspace if request.linear else np.geomspace
    target = np.asarray(space(*request.band_hz, request.lines), dtype=np.float64)
    grids = []
    for rate_hz in request.rates_hz:
        try:
            grids.append(place_lines(target, rate_hz, request.sampling.frames))
        except ValueError as error:
            found, expected = request.sampling.frames, f"more than {2 * request.lines + 1} for {request.lines} lines"
            raise InputError(MULTISINE_FRAMES, "--frames", found=found, expected=expected) from error
    grid = min(grids, key=lambda grid: float(np.max(np.abs(grid.frequency_hz / target - 1.0))))
    sampling = replace(request.sampling, frames=grid.frames, harmonics=1)
    lines = lines_of(grid.frequency_hz.tolist(), 1)
    shape = (grid.frequency_hz / request.band_hz[1]) ** request.slope
    phase_rad = small_crest_phases(grid.numbers, shape)
    crest = crest_factor(grid.numbers, shape, phase_rad)
    return MultisinePlan(
        request,
        grid,
        plan_at(lines, grid.rate_hz, sampling),
        shape * (request.peak_mps2 / (crest * float(np.sqrt(np.sum(shape**2) / 2.0)))),
        phase_rad,
        crest,
        float(scan_rates(lines, np.array([grid.rate_hz]), sampling).margin_bins[0]),
    )


def rates_below(highest_hz: float, step_hz: float) -> tuple[float, ...]:
    """Return some camera rates up to the highest, as multiples of a step."""
    rates = highest_hz * np.linspace(1.0, _LOWEST_RATE, _RATES)
    return tuple(np.unique(np.maximum(np.round(np.floor(rates / step_hz + 1e-9) * step_hz, 9), step_hz)).tolist())


def multisine_csv(plan: MultisinePlan) -> str:
    """Return the lines as a table for a generator."""
    return csv_text(_columns(plan), range(len(plan.acceleration_mps2)))


def _columns(plan: MultisinePlan) -> list[TableColumn[int]]:
    """Return the columns of lines, for the file and the terminal."""
    at_rate, relative, distance = plan.at_rate, plan.relative, plan.at_rate.distance_hz / plan.at_rate.resolution_hz
    same_time = plan.over_single(plan.single_frames) if plan.single_frames >= 1.0 else None
    same_length = plan.over_single(plan.grid.frames)

    def some(name: str, head: str, values: FloatArray | None, factor: float = 1.0) -> list[TableColumn[int]]:
        if values is None:
            return []
        return [
            TableColumn(name, lambda k: f"{values[k]:.6g}", head, lambda k: f"{factor * values[k]:#.3g}".rstrip("."))
        ]

    def numbers(name: str, head: str, values: FloatArray, digits: int) -> TableColumn[int]:
        return TableColumn(name, lambda k: f"{values[k]:.12g}", head, lambda k: f"{values[k]:.{digits}f}")

    return [
        numbers("frequency_hz", "line / Hz", at_rate.lines.frequency_hz, 4),
        *some("acceleration_mps2", "amplitude / m/s²", plan.acceleration_mps2),
        numbers("phase_rad", "phase / rad", plan.phase_rad, 3),
        TableColumn("number", lambda k: int(plan.grid.numbers[k])),
        numbers("alias_hz", "seen at / Hz", at_rate.alias_hz, 3),
        *some("distance_bins", "distance", distance),
        page_column("loss / %", lambda k: f"{100.0 * (1.0 - at_rate.gain[k]):.3f}"),
        TableColumn("exposure_gain", lambda k: f"{at_rate.gain[k]:.6g}"),
        *some("u_relative", "u / %", relative, 100.0),
        *some("u_over_single_same_time", "u over single, same time", same_time),
        *some("u_over_single_same_length", "u over single, same length", same_length),
    ]


def print_multisine(plan: MultisinePlan) -> None:
    """Print the multisine to stdout."""
    grid, request, at_rate = plan.grid, plan.request, plan.at_rate
    kind = "odd multiples" if grid.odd else "multiples"
    print_text(
        f"{request.lines} lines, {number_text(grid.frequency_hz[0], 6)} to {number_text(grid.frequency_hz[-1], 6)} Hz, "
        f"{kind} of {grid.spacing_hz:.9g} Hz = {grid.rate_hz:.9g} Hz / {grid.period_frames}; {grid.frames} frames at "
        f"{grid.rate_hz:.9g} Hz, {at_rate.duration_s:.2f} s, "
        + ("one period" if grid.periods == 1 else f"{grid.periods} periods")
    )
    columns = [column for column in _columns(plan) if column.head is not None]
    rows = [[column.cell(k) for column in columns] for k in range(request.lines)]
    print_table("Lines of the multisine", [column.head or "" for column in columns], "r" * len(columns), [rows])
    print_text(
        f"Peak {number_text(request.peak_mps2, 4)} m/s², crest factor {plan.crest:.2f} (one sine: 1.41); condition "
        f"number of the fit {at_rate.condition:.2f}"
    )
    for text in (*_products(grid), *_single_lines(plan)):
        print_text(text)
    if plan.margin_bins < CLEAR_BINS:
        print_text(
            f"With frequencies known within {request.sampling.tolerance:g} lines may be only "
            f"{max(plan.margin_bins, 0.0):.2f} bins apart: {CLEAR_BINS:g} are required. Use more --frames, "
            "fewer --lines, or derive generator and camera from one clock (--tolerance 0)"
        )


def _products(grid: LineGrid) -> Sequence[str]:
    """Return which products of a nonlinear rig meet lines."""
    texts = []
    for order, name in ((2, "second"), (3, "third")):
        there = products_on_lines(grid.numbers, order)
        seen = products_on_lines(grid.numbers, order, grid.period_frames)
        text = f"Products of {name} order meet {there} of {len(grid.numbers)} lines at their frequencies, "
        texts.append(f"{text}and {seen} at the camera")
    return texts


def _single_lines(plan: MultisinePlan) -> Sequence[str]:
    """Return the comparison with recordings of one line each."""
    lines, total_s = plan.request.lines, plan.at_rate.duration_s + plan.request.settle_s
    if plan.single_frames < 1.0:
        text = f"The pauses before {lines} recordings of one line take longer than the multisine"
        return [f"{text} with its pause ({total_s:.1f} s)"]
    ratio = plan.over_single(plan.single_frames)
    ends = " to ".join(sorted({f"{value:.2f}" for value in (ratio.min(), ratio.max())}, key=float))
    return [
        f"{lines} recordings of one line with the same peak, {plan.single_frames:.1f} frames each, take the same "
        f"{total_s:.1f} s: the noise of the multisine is {ends} times theirs"
    ]
