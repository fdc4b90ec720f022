"""Subsets of a stereo pair frame by frame, as far as results keep them: where they were, and what is not rigid."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import InputError
from fusion.phasors.stereo_motion import sensor_from_camera
from fusion.planning.look.signal_checks import fit_trigger_channel
from fusion.planning.view.server import table
from fusion.planning.view.viewed_recording import ViewedPair, ViewedRecording
from fusion.recording.daq_records import DaqRecord
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.motion_figures import neighbour_distance
from fusion.report.points import HEAD
from photogram.camera import StereoRig
from photogram.geometry import rotation_from_vector
from shaker.arrays import FloatArray
from shaker.labels import AXES
from shaker.lines.spectrum import amplitude_spectrum
from shaker.timebase.trigger import TriggerFit

NO_RESULTS = "Subsets, residuals and tracks need results: shakercal run makes them."
LINES_ONLY = (
    "Subsets stand where the rigid motion puts them; of what is not rigid the results keep the part at the lines: "
    "shakercal run --save-points keeps every subset in every frame."
)
EVERY_FRAME = "Subsets and what is not rigid of them as measured in every frame (points-NAME.csv)."
NO_RESIDUALS = "Of epipolar residuals results keep the mean of each subset over the frames, not every frame's."
SIDES = ("left", "right")
FARTHEST, NEAREST, STEPS = 1e3, 2.0, 400  # of an epipolar line, in distances of the cameras


@dataclass(frozen=True)
class SubsetResults:
    """What results keep of a stereo pair: see `fusion.phasors.stereo_phasors.StereoResult` for the fields."""

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
        """Read a pair from a result folder; None where it has none of its images."""
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
        """What is not rigid (F, N, 3): of every frame where the points were saved, else its part at the lines."""
        if self.table.is_file():
            found = np.full((len(self.time_s), len(self.reference_m), 3), np.nan)
            known = np.flatnonzero(np.isfinite(self.reference_m).all(axis=1))
            columns = [HEAD.index(name) for name in ("frame", "point", *(f"rest_{axis}_m" for axis in AXES))]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # an empty table
                rows = np.loadtxt(self.table, delimiter=",", skiprows=1, usecols=columns, ndmin=2)
            found[rows[:, 0].astype(int), known[rows[:, 1].astype(int)]] = rows[:, 2:]
            return found
        turn = np.exp(2j * np.pi * np.outer(self.time_s, self.line_hz))
        part = np.einsum("fk,kni->fni", turn, np.nan_to_num(self.deflection_m)).real
        return np.asarray(part)

    def positions_m(self, frame: int, *, rigid: bool = False) -> FloatArray:
        """Return where the points (N, 3) are in a frame, without what is not rigid on request."""
        turn = rotation_from_vector(self.pose[frame, 3:])
        moved = self.origin_m + self.pose[frame, :3] + (self.reference_m - self.origin_m) @ turn.T
        return np.asarray(moved if rigid else moved + self.deformation_m[frame])

    @property
    def radius_px(self) -> float:
        """Half-width of the subsets, which lie side by side."""
        return (neighbour_distance(self.subsets_px, 0.5) - 1) / 2


class SubsetViews:
    """The stereo pairs of an opened recording with what results keep of them."""

    def __init__(self, opened: ViewedRecording) -> None:
        self.opened = opened
        results = opened.source.results
        self.kept = [
            None if results is None else SubsetResults.read(results, pair.entry.stereo) for pair in opened.pairs
        ]

    def description(self, number: int) -> Mapping[str, Any]:
        """Return times of the frames and phases (F) of each line, and what is missing."""
        kept, pair = self.kept[number], self.opened.pairs[number]
        entry = pair.entry
        more = {"region": entry.region, "mask": entry.mask}
        if kept is not None:
            kind = EVERY_FRAME if kept.table.is_file() else LINES_ONLY
            found = {"missing": f"{kind} {NO_RESIDUALS}"} | _beat(kept.time_s, kept.line_hz)
        else:
            times = self._times(pair)
            nominal = np.asarray(self.opened.manifest.excitation.frequencies or ())
            found = {"missing": NO_RESULTS} | ({} if times is None else _beat(times, nominal))
        return found | {key: value for key, value in more.items() if value}

    def _times(self, pair: ViewedPair) -> FloatArray | None:
        """Return the times of frames by their trigger alone; None where it is not periodic."""
        for number, channel in enumerate(self.opened.channels):
            if channel.entry.name == pair.entry.trigger and channel.daq in pair.manifest.daq:
                try:
                    raw = {channel.entry.name: self.opened.raw(number)}
                    fit = fit_trigger_channel(DaqRecord(channel.daq, raw, 0.0), channel.entry)
                except (OSError, ValueError, InputError):
                    return None
                if isinstance(fit, TriggerFit):
                    return np.asarray(fit.period_s * np.arange(len(pair.sequences[0])))
        return None

    def frame(self, number: int, frame: int) -> Mapping[str, Any]:
        """Return where each camera sees the subsets (N, 2) in a frame, and what of it is not rigid, in px."""
        kept = self.kept[number]
        if kept is None or not 0 <= frame < len(kept.time_s):
            return {"told": ""}
        if not np.isfinite(kept.pose[frame]).all():
            return {"told": "No motion was found in this frame."}
        whole, rigid = (self._seen(number, kept.positions_m(frame, rigid=only)) for only in (False, True))
        sides = {side: _pairs(own) for side, own in zip(SIDES, whole, strict=False)}
        rest = {side: _pairs(a - b) for side, a, b in zip(SIDES, whole, rigid, strict=False)}
        return {**sides, "residual": rest, "radius": kept.radius_px, "told": ""}

    def _seen(self, number: int, points_m: FloatArray) -> list[FloatArray]:
        """Return the pixels (N, 2) at which each camera sees points (N, 3) of the sensor frame."""
        pair = self.opened.pairs[number]
        left = sensor_from_camera(pair.manifest.rig.stereo[pair.entry.stereo]).inverse().apply(points_m)
        return [camera.project(from_left.apply(left)) for camera, from_left in pair.rig.camera_poses]

    def epipolar(self, number: int, side: int, position: tuple[float, float]) -> Mapping[str, Any]:
        """Return a place of one camera and the line in the other one on which it lies, as pixels within the picture.

        Of a camera alone the place itself.
        """
        pair = self.opened.pairs[number]
        rig = pair.rig
        if not isinstance(rig, StereoRig):
            return {SIDES[side]: [list(position)]}
        cameras = (rig.left, rig.right)
        other_from_own = rig.right_from_left if side == 0 else rig.right_from_left.inverse()
        ray = np.append(cameras[side].undistort(np.array([position]))[0], 1.0)
        apart = float(np.linalg.norm(rig.right_from_left.translation_m))
        depth = apart / np.linspace(1 / FARTHEST, NEAREST, STEPS)
        pixels = cameras[1 - side].project(other_from_own.apply(depth[:, None] * ray))
        width, height = pair.sequences[1 - side].size_px
        inside = ((pixels >= -0.1 * width) & (pixels <= 1.1 * np.array([width, height]))).all(axis=1)
        return {
            SIDES[side]: [list(position)],
            SIDES[1 - side]: pixels[inside & np.isfinite(pixels).all(axis=1)].tolist(),
        }

    def track(self, number: int, point: int) -> bytes:
        """Return curves of a subset: its motion, what of it is not rigid, and the spectrum of both."""
        kept = self.kept[number]
        if kept is None:
            raise ValueError(NO_RESULTS)
        if not 0 <= point < len(kept.reference_m):
            raise ValueError(f"point: expected 0 to {len(kept.reference_m) - 1}, found {point}")
        frames = np.flatnonzero(np.isfinite(kept.pose).all(axis=1))
        moved = np.array([kept.positions_m(frame)[point] for frame in frames.tolist()]) - kept.reference_m[point]
        rest = kept.deformation_m[frames, point]
        fine = np.isfinite(moved).all(axis=1)
        time, moved, rest = kept.time_s[frames][fine], 1e6 * moved[fine], 1e6 * rest[fine]
        if len(time) < 2:
            raise ValueError(f"subset {point}: expected at least 2 frames in which it was found, found {len(time)}")
        spectra = [amplitude_spectrum(values, (len(time) - 1) / (time[-1] - time[0])) for values in (moved, rest)]
        arrays = [time, *moved.T, *rest.T]
        for found in spectra:
            arrays += [found.frequency_hz[1:], *found.amplitude[1:].T]
        own = "what is not rigid" if kept.table.is_file() else "what is not rigid, at the lines only"
        panels = []
        for title, x, places in (
            (f"subset {point}: displacement", "time / s", (0, 1)),
            (f"subset {point}: {own}", "time / s", (0, 4)),
            (f"subset {point}: spectrum of the displacement, folded by the frame rate", "frequency / Hz", (7, 8)),
            (f"subset {point}: spectrum of {own}", "frequency / Hz", (11, 12)),
        ):
            curves = [[axis, places[0], places[1] + i] for i, axis in enumerate(AXES)]
            y = "displacement / µm" if x.startswith("time") else "amplitude / µm"
            panels.append({"title": title, "x": x, "y": y, "curves": curves})
        mean = kept.epipolar_px[point]
        told = f"Subset {point}: mean epipolar residual {mean:.4f} px." if np.isfinite(mean) else f"Subset {point}."
        return table({"panels": panels, "told": told}, *arrays)


def _beat(times: FloatArray, line_hz: FloatArray) -> dict[str, Any]:
    """Return times, and the phase of each line at each, in periods."""
    phases = [(np.nan_to_num(times) * frequency % 1.0).tolist() for frequency in line_hz]
    return {"times": [_known(value) for value in times], "beats": line_hz.tolist(), "phases": phases}


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _pairs(values: FloatArray) -> list[list[float | None]]:
    """Return rows of numbers, None for what is not known."""
    return [[_known(value) for value in row] for row in values]
