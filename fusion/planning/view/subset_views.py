"""Subsets of a stereo pair in its images, their tracks, and epipolar lines."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fusion.phasors.stereo_motion import sensor_from_camera
from fusion.planning.view.viewed_pair import ViewedPair
from fusion.planning.view.wire_format import table
from fusion.report.figure import COLOURS
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.page_images import neighbour_distance
from photogram.camera import StereoRig
from photogram.geometry import rotation_from_vector
from shaker.labels import AXES
from shaker.lines.spectrum import amplitude_spectrum
from shakercal._common.arrays import FloatArray

NO_RESULTS = "Subsets, residuals and tracks require results of shakercal run."
LINES_ONLY = (
    "Subsets are at the positions of the rigid motion. The results contain the deformation at the lines only; "
    "shakercal run --save-points stores every subset in every frame."
)
EVERY_FRAME = "Subsets and their deformation as measured in every frame (points-NAME.csv)."
NO_RESIDUALS = "The epipolar residual of each subset is the mean over the frames."
SIDES = ("left", "right")
FARTHEST, NEAREST, STEPS = 1e3, 2.0, 400  # of an epipolar line, in distances of the cameras


@dataclass(frozen=True)
class SubsetResults:
    """Stored results of a stereo pair; fields as in `fusion.phasors.stereo_phasors.StereoResult`."""

    time_s: FloatArray
    subsets_px: FloatArray
    pose: FloatArray
    origin_m: FloatArray
    reference_m: FloatArray
    line_hz: FloatArray
    deflection_m: np.typing.NDArray[np.complex128]
    epipolar_px: FloatArray
    table: Path

    @classmethod
    def read(cls, folder: Path, name: str) -> SubsetResults | None:
        """Read a pair from a result folder; None without results of its images."""
        with open_results(folder / RESULT_FILE) as file:
            group = file.get(f"stereo/{name}")
            if group is None or "subsets_px" not in group or "deflection" not in group:
                return None
            inner = group["deflection"]
            residual = (
                group["epipolar/residual_px"][()] if "epipolar" in group else np.full(len(group["subsets_px"]), np.nan)
            )
            return cls(
                group["time_s"][()],
                group["subsets_px"][()],
                group["motion/pose"][()],
                group["motion/origin_m"][()],
                inner["reference_m"][()],
                inner["frequency_hz"][()],
                inner["value"][()],
                residual,
                folder / f"points-{name}.csv",
            )

    @cached_property
    def deformation_m(self) -> FloatArray:
        """Deformation (F, N, 3), of every frame if the points were saved.

        Otherwise it is the part at the lines.
        """
        if self.table.is_file():
            from fusion.report.recording_report import POINT_COLUMNS

            found = np.full((len(self.time_s), len(self.reference_m), 3), np.nan)
            finite = np.flatnonzero(np.isfinite(self.reference_m).all(axis=1))
            columns = [POINT_COLUMNS.index(name) for name in ("frame", "point", *(f"rest_{axis}_m" for axis in AXES))]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # an empty table
                rows = np.loadtxt(self.table, delimiter=",", skiprows=1, usecols=columns, ndmin=2)
            found[rows[:, 0].astype(int), finite[rows[:, 1].astype(int)]] = rows[:, 2:]
            return found
        turn = np.exp(2j * np.pi * np.outer(self.time_s, self.line_hz))
        part = np.einsum("fk,kni->fni", turn, np.nan_to_num(self.deflection_m)).real
        return np.asarray(part)

    def positions_m(self, frame: int, *, rigid: bool = False) -> FloatArray:
        """Return the positions (N, 3) of the points in a frame; `rigid`: without deformation."""
        turn = rotation_from_vector(self.pose[frame, 3:])
        moved = self.origin_m + self.pose[frame, :3] + (self.reference_m - self.origin_m) @ turn.T
        return np.asarray(moved if rigid else moved + self.deformation_m[frame])

    @property
    def radius_px(self) -> float:
        """Half-width of the subsets, which are adjacent."""
        return (neighbour_distance(self.subsets_px, 0.5) - 1) / 2


class SubsetViews:
    """The stereo pairs of a recording with their stored results."""

    def __init__(
        self,
        pairs: Sequence[ViewedPair],
        results: Path | None,
        frame_times: Callable[[ViewedPair], FloatArray | None],
        nominal_hz: Sequence[float],
    ) -> None:
        self.pairs, self._frame_times, self._nominal_hz = pairs, frame_times, np.asarray(nominal_hz)
        self.results = [None if results is None else SubsetResults.read(results, one.stated.stereo) for one in pairs]

    def description(self, number: int) -> Mapping[str, Any]:
        """Return times of the frames, phases (F) of each line, and missing data."""
        results, pair = self.results[number], self.pairs[number]
        if results is not None:
            kind = EVERY_FRAME if results.table.is_file() else LINES_ONLY
            times = np.full(len(pair.frames), np.nan)
            shown = pair.evaluated_frames(len(results.time_s))
            times[shown] = results.time_s[: len(shown)]
            return {"missing": f"{kind} {NO_RESIDUALS}"} | _beat(times, results.line_hz)
        known = self._frame_times(pair)
        return {"missing": NO_RESULTS} | ({} if known is None else _beat(known, self._nominal_hz))

    def frame(self, number: int, frame: int) -> Mapping[str, Any]:
        """Return the pixels of the subsets (N, 2), and their deformation in px."""
        results = self.results[number]
        shown = [] if results is None else self.pairs[number].evaluated_frames(len(results.time_s))
        if results is None or frame not in shown:
            return {"told": ""}
        frame = shown.index(frame)
        if not np.isfinite(results.pose[frame]).all():
            return {"told": "No motion was found in this frame."}
        whole, rigid = (self.seen(number, results.positions_m(frame, rigid=only)) for only in (False, True))
        sides = {side: _pairs(pixels) for side, pixels in zip(SIDES, whole, strict=False)}
        rest = {side: _pairs(a - b) for side, a, b in zip(SIDES, whole, rigid, strict=False)}
        return {**sides, "residual": rest, "radius": results.radius_px, "told": ""}

    def seen(self, number: int, points_m: FloatArray) -> list[FloatArray]:
        """Return the pixels (N, 2) of points (N, 3) in each camera.

        Points are in the sensor frame.
        """
        pair = self.pairs[number]
        if pair.stated.pair is None:
            return []
        left = sensor_from_camera(pair.stated.pair).inverse().apply(points_m)
        return [camera.project(from_left.apply(left)) for camera, from_left in pair.rig.camera_poses]

    def epipolar(self, number: int, side: int, position: tuple[float, float]) -> Mapping[str, Any]:
        """Return a pixel of one camera and its epipolar line in the other one.

        The line is limited to the image. For a single camera it is the pixel itself.
        """
        pair = self.pairs[number]
        rig = pair.rig
        if not isinstance(rig, StereoRig):
            return {SIDES[side]: [list(position)]}
        cameras = (rig.left, rig.right)
        other_from_camera = rig.right_from_left if side == 0 else rig.right_from_left.inverse()
        ray = np.append(cameras[side].undistort(np.array([position]))[0], 1.0)
        distance_m = float(np.linalg.norm(rig.right_from_left.translation_m))
        depth = distance_m / np.linspace(1 / FARTHEST, NEAREST, STEPS)
        pixels = cameras[1 - side].project(other_from_camera.apply(depth[:, None] * ray))
        other = pair.cameras[SIDES[1 - side]].sequence
        width, height = other.size_px if other is not None else (0, 0)
        inside = ((pixels >= -0.1 * width) & (pixels <= 1.1 * np.array([width, height]))).all(axis=1)
        return {
            SIDES[side]: [list(position)],
            SIDES[1 - side]: pixels[inside & np.isfinite(pixels).all(axis=1)].tolist(),
        }

    def track(self, number: int, point: int) -> bytes:
        """Return curves of a subset: its motion, its deformation, and the spectrum of both."""
        results = self.results[number]
        if results is None:
            raise ValueError(NO_RESULTS)
        if not 0 <= point < len(results.reference_m):
            raise ValueError(f"point: expected 0 to {len(results.reference_m) - 1}, found {point}")
        frames = np.flatnonzero(np.isfinite(results.pose).all(axis=1))
        moved = np.array([results.positions_m(frame)[point] for frame in frames.tolist()]) - results.reference_m[point]
        rest = results.deformation_m[frames, point]
        fine = np.isfinite(moved).all(axis=1)
        time, moved, rest = results.time_s[frames][fine], 1e6 * moved[fine], 1e6 * rest[fine]
        if len(time) < 2:
            raise ValueError(f"subset {point}: expected at least 2 frames in which it was found, found {len(time)}")
        spectra = [amplitude_spectrum(values, (len(time) - 1) / (time[-1] - time[0])) for values in (moved, rest)]
        arrays = [time, *moved.T, *rest.T]
        for found in spectra:
            arrays += [found.frequency_hz[1:], *found.amplitude[1:].T]
        name = "deformation" if results.table.is_file() else "deformation, at the lines only"
        panels: list[dict[str, Any]] = []
        for title, x, columns in (
            (f"subset {point}: displacement", "time / s", (0, 1)),
            (f"subset {point}: {name}", "time / s", (0, 4)),
            (f"subset {point}: spectrum of the displacement, aliased by the frame rate", "frequency / Hz", (7, 8)),
            (f"subset {point}: spectrum of {name}", "frequency / Hz", (11, 12)),
        ):
            curves = [[axis, columns[0], columns[1] + i, COLOURS[i]] for i, axis in enumerate(AXES)]
            y = "displacement / µm" if x.startswith("time") else "amplitude / µm"
            panels.append({"title": title, "x": x, "y": y, "curves": curves})
        mean = results.epipolar_px[point]
        text = f"Subset {point}: mean epipolar residual {mean:.4f} px." if np.isfinite(mean) else f"Subset {point}."
        return table({"panels": panels, "told": text}, *arrays)


def _beat(times: FloatArray, line_hz: FloatArray) -> dict[str, Any]:
    """Return times, and the phase of each line at each, in periods."""
    phases = [(np.nan_to_num(times) * frequency % 1.0).tolist() for frequency in line_hz]
    return {"times": [_finite(value) for value in times], "beats": line_hz.tolist(), "phases": phases}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _pairs(values: FloatArray) -> list[list[float | None]]:
    """Return rows of numbers, None for undefined ones."""
    return [[_finite(value) for value in row] for row in values]
