"""Recordings of other laboratories: the figures this program obtains, beside the published ones and the bars.

Usage: python benchmarks/real_data.py [NAME ...]

Prints the tables of docs/real-data.md. The data sets are looked for in the folder SHAKERCAL_DATA, by default
`../shared/data` beside the repository; one that is not there is named and skipped. About a minute on two cores.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import csd, welch
from scipy.stats import t as student

from photogram.calibration.calibration_file import read_calibration
from photogram.calibration.exchange.exchange_files import import_calibration
from photogram.camera import Camera, StereoRig, epipolar_residual, triangulate
from photogram.geometry import RigidTransform, fit_rigid, rotation_from_vector, vector_from_rotation
from photogram.images.image_files import open_sequence
from photogram.motion import fit_motion
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import match_stereo, track_sequence, track_stereo
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.frf.sweeps import transfer_from_rest
from shaker.identification.measured_curves import MeasuredCurve
from shaker.identification.oscillator import Resonance, fit_resonance
from shaker.identification.sensor import NO_CHAIN, ChainModel, Load, SensorModel, correct_record, usable_band
from shaker.io import read_channels
from shaker.lines.frequencies import find_lines
from shaker.signal_notices import REPEATS_DIFFER
from shaker.sine.sine_fit import fit_sines

FloatArray = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
UM = 1e-6
TONES_HZ = [100.0, 120.0, 150.0]
SHOCK_RATE_HZ = 10e6
SHOCK = slice(3800, 6000)


@dataclass(frozen=True)
class Row:
    """One figure: what it is, what this program obtains, what others obtained, and the bar ("" where there is none)."""

    figure: str
    here: str
    others: str = ""
    bar: str = ""


def duodic_rigid(folder: Path) -> Iterator[Row]:
    """Matched points → triangulation → rigid motion, against the translation stage."""
    rig = read_calibration(folder / "calibration.json")
    with np.load(folder / "matched_points.npz") as file:
        left, right, stage_m = file["left"], file["right"], file["stage_translation_m"]
    points = triangulate(rig, left, right)
    motion = fit_motion(points, None, np.nanmean(points.position_m[0], axis=0))
    error = np.abs(np.linalg.norm(motion.pose[1:, :3], axis=1) - stage_m[1:]) / UM
    angle = np.degrees(np.linalg.norm(motion.pose[1:, 3:], axis=1)) * 3600
    residual = [_rigid_residual(points.position_m[0], now) / UM for now in points.position_m[1:]]
    yield Row("reprojection, median", f"{np.nanmedian(points.reprojection_px):.3f} px")
    yield Row(
        "error of the translation, mean magnitude", f"{error.mean():.2f} µm", "1.3 µm (published), 1.7 µm", "≤ 1.8 µm"
    )
    yield Row("its standard deviation over the states", f"{error.std(ddof=1):.2f} µm", "1.1 µm (published), 1.1 µm")
    yield Row("rotation, largest", f"{angle.max():.0f}″", "51″")
    spread = f"{min(residual):.2f} to {max(residual):.2f} µm"
    yield Row("rigid residual, rms per coordinate and state", spread, "0.6 to 0.96 µm", "≤ 1.0 µm")
    yield Row("points kept, fewest of a state", f"{motion.points.min()} of {left.shape[1]}")


def _rigid_residual(first: FloatArray, now: FloatArray) -> float:
    """Return the rms per coordinate (m) that Arun's rigid fit of one state to the first leaves."""
    known = np.isfinite(now).all(axis=1) & np.isfinite(first).all(axis=1)
    moved = fit_rigid(first[known], now[known]).apply(first[known])
    return float(np.sqrt(((now[known] - moved) ** 2).mean()))


def gt4_stereo(folder: Path) -> Iterator[Row]:
    """Another program's matches: found again in the images, and triangulated."""
    table = np.genfromtxt(folder / "GT4-0273_0_epipolar_sift_r16.csv", delimiter=",", names=True)
    points = _columns(table, "x", "y")
    first = open_sequence([folder / "GT4-0000_0.tif"]).read(0)
    yield Row("points in the peer's table", f"{len(table)}")
    for image, column, title, bar in (
        ("0273_0", "t1", "in time, left camera (t1)", "≤ 0.02 px"),
        ("0000_1", "r2", "across the views (r2)", "≤ 0.05 px"),
    ):
        second = open_sequence([folder / f"GT4-{image}.tif"]).read(0)
        tracks = match_stereo(first, second, points, TrackSettings(radius_px=16))
        distance = np.hypot(*(tracks.position_px[0] - _columns(table, f"{column}_x", f"{column}_y")).T)
        found = float(np.mean(tracks.status == TrackStatus.OK))
        yield Row(f"{title}: points matched", f"{100 * found:.2f} %")
        yield Row(f"{title}: median distance from the peer's", f"{np.nanmedian(distance):.4f} px", "", bar)
        yield Row(f"{title}: 95 % quantile of that distance", f"{np.nanquantile(distance, 0.95):.3f} px")
    rig = read_calibration(folder / "calibration.json")
    states = {"before": (points, "r2", "ref"), "loaded": (_columns(table, "t1_x", "t1_y"), "t2", "tar")}
    for title, (left, column, name) in states.items():
        made = triangulate(rig, left[None], _columns(table, f"{column}_x", f"{column}_y")[None])
        peer = np.column_stack([table[f"{name}_{axis}"] for axis in "xyz"]) * 1e-3
        distance = np.linalg.norm(made.position_m[0] - peer, axis=1) / UM
        yield Row(f"triangulation, {title}: median distance from the peer's", f"{np.median(distance):.3f} µm")
        far = distance > 0.5
        yield Row(f"triangulation, {title}: points beyond 0.5 µm", f"{np.count_nonzero(far)}", "", "0")
        where = f"{made.reprojection_px[0][far].min():.2f} px" if far.any() else "none"
        yield Row(f"triangulation, {title}: their smallest reprojection error", where)


def _columns(table: NDArray[np.void], *names: str) -> FloatArray:
    """Return named columns of a table side by side."""
    return np.column_stack([table[name] for name in names])


def static_stereo(folder: Path) -> Iterator[Row]:
    """A scene at rest: whatever moves is noise."""
    left, right = (open_sequence([folder / f"img_000{k}_{side}.tif" for k in range(3)]) for side in (0, 1))
    stereo = track_stereo(left, right, None, TrackSettings(radius_px=13))
    for name, tracks in (("left", stereo.left), ("right", stereo.right)):
        moved = tracks.position_px[1:] - tracks.position_px[0]
        scatter, mean = np.nanstd(moved, axis=1), np.abs(np.nanmean(moved, axis=1))
        stated = np.sqrt(2.0 * np.nanmean(tracks.covariance_px2[1:][..., [0, 1], [0, 1]], axis=1))
        found = float(np.mean(tracks.status == TrackStatus.OK))
        count = tracks.position_px.shape[1]
        yield Row(f"{name}: subsets, of which followed", f"{count}, {100 * found:.1f} %")
        spread = f"{scatter.min():.4f} to {scatter.max():.4f} px"
        yield Row(f"{name}: scatter of the displacement", spread, "0.003 to 0.005 px", "≤ 0.005 px")
        yield Row(f"{name}: mean displacement, largest", f"{mean.max():.4f} px", "0.005 to 0.020 px")
        ratio = scatter / stated
        yield Row(f"{name}: scatter / stated uncertainty", f"{ratio.min():.2f} to {ratio.max():.2f}", "none stated")
    yield from _static_cameras(folder, (stereo.left.position_px[0], stereo.right.position_px[0]))


def _static_cameras(folder: Path, ours: tuple[FloatArray, FloatArray]) -> Iterator[Row]:
    """Whether the calibration is that of the pictures: matches against it, and against what fits them."""
    stated = import_calibration(folder / "cal.xml").rig
    tables = (folder / f"DICe_solution_{name}_0.txt" for name in ("auto", "auto_stereo"))
    peer = [np.loadtxt(table, delimiter=",", skiprows=21)[:, :2] for table in tables]
    off, peers = (epipolar_residual(stated, *pair)[0] for pair in (ours, peer))
    yield Row(
        "rms distance of the matches from cal.xml's epipolar lines", _rms_px(off), f"{_rms_px(peers)} (peer's matches)"
    )

    def changed(x: FloatArray) -> StereoRig:  # a turn, the baseline's y and z, focal lengths, first radial terms
        turned = RigidTransform(rotation_from_vector(x[:3]), np.array([0.0, x[3], x[4]])) @ stated.right_from_left
        lenses = []
        for camera, focal, radial in ((stated.left, x[5], x[7]), (stated.right, x[6], x[8])):
            lens = camera.parameters.copy()
            lens[:2] *= np.exp(focal)
            lens[4] += radial
            lenses.append(Camera.from_parameters(lens, camera.size_px))
        return StereoRig(lenses[0], lenses[1], turned)

    angle, length = _angle_deg(stated), stated.left.matrix[0, 0]
    yield Row("angle between the axes, focal length as stated", f"{angle:.1f}°, {length:.0f} px")
    for what, free in (("pose fitted to the matches", 5), ("pose, focal lengths and distortion fitted", 9)):
        fit = least_squares(
            lambda x: epipolar_residual(changed(np.pad(x, (0, 9 - len(x)))), *ours)[0], np.zeros(free), x_scale="jac"
        )
        found = changed(np.pad(fit.x, (0, 9 - free)))
        text = f"{_rms_px(fit.fun)}; {_angle_deg(found):.1f}°, {found.left.matrix[0, 0]:.0f} px"
        yield Row(f"{what}: rms distance; angle, focal length", text)


def _rms_px(values: FloatArray) -> str:
    return f"{np.sqrt(np.mean(values**2)):.3g} px"


def _angle_deg(rig: StereoRig) -> float:
    return float(np.degrees(np.linalg.norm(vector_from_rotation(rig.right_from_left.rotation))))


def undersampled_video(folder: Path) -> Iterator[Row]:
    """Frames of a vibrating beam against every hundredth sample of a 15 kHz series."""
    sequence = open_sequence([folder / "data_showcase.cih"])
    series = np.load(folder / "displacements_lk.npy")[1:7, ::100, 0]
    x = (20.0 + 40.0 * np.arange(1.0, 7.0)[:, None] + np.arange(-15.0, 16.0, 5.0)).ravel()
    tracks = track_sequence(sequence, np.column_stack([x, np.full_like(x, 20.0)]), TrackSettings(radius_px=10))
    frames = series.shape[1]
    vertical, other = tracks.position_px[:frames, :, 1].mean(axis=1), series.mean(axis=0)
    slope, offset = np.polyfit(other, vertical, 1)
    left_over = vertical - slope * other - offset
    followed = np.count_nonzero(tracks.status == TrackStatus.OK)
    correlation = np.corrcoef(vertical, other)[0, 1]
    yield Row("frames read, frames of both series", f"{len(sequence)}, {frames}", "75, 38")
    yield Row("subsets followed through their frames", f"{followed} of {tracks.status.size}")
    yield Row("peak to peak of the mean vertical motion", f"{np.ptp(vertical):.3f} px")
    yield Row("correlation with the 15 kHz series", f"{correlation:.6f}", "0.99997", "≥ 0.9999")
    yield Row("difference after scale and offset, rms", f"{left_over.std():.4f} px")


def shaker_three_tone(folder: Path) -> Iterator[Row]:
    """Three tones of a shaker, sampled well at ×16 and below their frequencies at ×256."""
    ratio = {}
    for factor, wanted in ((16, "100, 120, 150 Hz"), (256, "120, 150 Hz; 100 Hz refused")):
        channels = read_channels(folder / f"data_set_1_downsampled_by_{factor}.lvm")
        values = np.stack([channel.samples for channel in channels.values()], axis=1)
        rate_hz = next(iter(channels.values())).sample_rate_hz
        time_s = np.arange(len(values)) / rate_hz
        lines = find_lines(time_s, values, TONES_HZ, [1])
        fit = fit_sines(time_s, values, lines.frequency_hz, ["U", "F", "a"], ["V", "lb", "g"])
        amplitude = np.abs(fit.phasors.value)
        ratio[factor] = dict(zip(lines.nominal_hz.tolist(), amplitude[:, 2] / amplitude[:, 1], strict=True))
        title = f"×{factor} ({rate_hz:g} Hz)"
        yield Row(f"{title}: lines found", ", ".join(f"{f:.4f} Hz" for f in lines.frequency_hz), bar=wanted)
        folded = np.abs(lines.frequency_hz - rate_hz * np.round(lines.frequency_hz / rate_hz))
        if factor > 16:
            yield Row(f"{title}: where they appear", ", ".join(f"{f:.2f} Hz" for f in folded), "80, 50 Hz", "80, 50 Hz")
            refused = "; ".join(notice.text for notice in lines.notices if notice.where == "100 Hz")
            yield Row(f"{title}: 100 Hz", refused, "on the Nyquist frequency", "refused, with the reason")
        drive = ", ".join(f"{value:.4f} V" for value in amplitude[:, 0])
        yield Row(f"{title}: drive", drive, "0.4994 V each" if factor == 16 else "")
    others = {120.0: "0.0448 and 0.037 g/lb", 150.0: "0.0920 and 0.095 g/lb"}
    for tone, bar in ((150.0, "within 5 %"), (120.0, "about −17 %, harmonics named")):
        full, folded_ratio = ratio[16][tone], ratio[256][tone]
        here = f"{full:.4f} and {folded_ratio:.4f} g/lb, {100 * (folded_ratio / full - 1):+.1f} %"
        yield Row(f"acceleration / force at {tone:g} Hz, ×16 and ×256", here, others[tone], bar)
    named = "; ".join(notice.text for notice in lines.notices if notice.where == "120 Hz")
    yield Row("×256 (200 Hz): 120 Hz", named, "", "480 and 720 Hz named")


def chirp_measured(folder: Path) -> Iterator[Row]:
    """Sweeps of a plate from rest to rest, one in each file: two of one view, one of another."""
    names, band_hz, rate_hz = ("view_0", "view_0_02", "view_1"), (60.0, 500.0), 25600.0
    records = []
    for name in names:
        stored = read_channels(folder / f"{name}.hdf5")
        force, motion = (stored[f"InputTask/data/{number}"].samples for number in (1, 2))
        records.append(TransferRecord(force, motion[:, None], rate_hz, "force", "N", ("acc",), ("m/s^2",)))
    for used in ((0,), (0, 1), (0, 1, 2)):
        found = transfer_from_rest([records[index] for index in used], band_hz=band_hz)
        relative = _relative_u(found) * student.ppf(0.975, found.ratio.dof)
        title = f"{len(used)} sweep{'s' if len(used) > 1 else ''}: lines, spacing, median U (95 %)"
        here = f"{len(relative)}, {found.line_spacing_hz:g} Hz, {100 * np.median(relative):.2g} %"
        yield Row(title, here)
        differ = [notice.text for notice in found.notices if notice.code == REPEATS_DIFFER.code]
        if differ:
            yield Row(f"{len(used)} sweeps: notice about the repeats", " ".join(differ))
    single = [transfer_from_rest([record], band_hz=band_hz) for record in records]
    whole = {"fs": rate_hz, "window": "boxcar", "nperseg": len(records[0].reference), "detrend": "constant"}
    cross = np.sum([csd(record.reference, record.responses[:, 0], **whole)[1] for record in records], axis=0)
    power = np.sum([welch(record.reference, **whole)[1] for record in records], axis=0)
    h1 = (cross / power)[np.round(found.ratio.frequency_hz / found.line_spacing_hz).astype(np.int64)]
    apart = np.abs(h1 / found.ratio.value[:, 0] - 1.0)
    yield Row("3 sweeps against H1 of their periodograms (scipy): median, lines within U", _within(apart, relative))
    for name, one in zip(names, single, strict=True):
        same, of_one = np.isin(found.ratio.frequency_hz, one.ratio.frequency_hz), one.ratio
        there = found.ratio.value[same, 0]
        common = np.isin(of_one.frequency_hz, found.ratio.frequency_hz)
        # A single repeat deviates from the mean of three by √2 of its standard uncertainty, and by its noise.
        noise = _relative_u(one)[common]
        limit = np.hypot(np.sqrt(2.0) * relative[same], 1.96 * noise)
        yield Row(
            f"{name} against all three: median, lines within U",
            _within(np.abs(of_one.value[common, 0] / there - 1.0), limit),
        )


def _relative_u(found: TransferFunction) -> FloatArray:
    """Return the relative standard uncertainty of a line, of its real or imaginary part."""
    variance = 0.5 * np.trace(found.ratio.covariance, axis1=1, axis2=2)
    return np.asarray(np.sqrt(variance) / np.abs(found.ratio.value[:, 0]))


def _within(apart: FloatArray, limit: FloatArray) -> str:
    """Return the median of differences and the share of them below their limit."""
    return f"{100 * np.median(apart):.2g} %, {100 * np.mean(apart < limit):.0f} %"


def uff(folder: Path) -> Iterator[Row]:
    """Universal files of other programs."""
    sine = read_channels(folder / "binary8byte.uff")["sine 5 Hz"]
    error = np.abs(sine.samples - np.sin(2 * np.pi * 5.0 * np.arange(len(sine.samples)) / 100.0)).max()
    yield Row("binary, 250 samples of a 5 Hz sine: largest error", f"{error:.1e}", "", "≤ 1e-5")
    microphone = read_channels(folder / "Sample_UFF58b_bin.uff")["Mic 01"]
    here = f"{len(microphone.samples)} samples in {microphone.unit} at {microphone.sample_rate_hz:.1f} Hz"
    yield Row("binary, microphone", here, "79292 samples in Pa at 65536 Hz")
    short = read_channels(folder / "time-history-not-all-columns-filled.uff")["1x"]
    yield Row(
        "text, last line half filled", f"{len(short.samples)} samples at {short.sample_rate_hz:g} Hz", "13 samples"
    )
    spectra = read_channels(folder / "sample_dataset58_psd.uff")
    yield Row("text, spectra: time responses found", f"{len(spectra)}", "none is one", "0")


def tdms(folder: Path) -> Iterator[Row]:
    """TDMS files of other programs."""
    raw = read_channels(folder / "raw1.tdms")
    one = next(iter(raw.values()))
    here = f"{len(raw)} channels of {len(one.samples)} samples at {one.sample_rate_hz:g} Hz"
    yield Row("raw1.tdms", here, "7 channels of 2000 samples at 50000 Hz")
    sweep = read_channels(folder / "big_endian.tdms", ["Phase sweep"])["Phase sweep"]
    yield Row("big_endian.tdms, Phase sweep", f"{len(sweep.samples)} samples", "3500 samples")


@dataclass(frozen=True)
class Shock:
    """A shock calibration and the sinusoidal calibration of the same accelerometer: `value` (K,) output / input."""

    frequency_hz: FloatArray
    value: NDArray[np.complex128]
    input: FloatArray
    output: FloatArray

    def fit(self, delay: bool) -> Resonance:
        """Fit a resonance to the table, 0.05 % per kHz of scatter in magnitude and phase."""
        size = 5e-4 * self.frequency_hz / 1e3 * np.abs(self.value)
        covariance = (size**2)[:, None, None] * np.eye(2)
        return fit_resonance(MeasuredCurve(self.frequency_hz, self.value, covariance), "receptance", delay=delay)

    def error(self, model: Callable[[FloatArray], NDArray[np.complex128]]) -> FloatArray:
        """Predict the output of the shock and return by how much it is wrong, as a share of the output's peak."""
        size = 2**16
        frequency = np.maximum(np.fft.rfftfreq(size, 1.0 / SHOCK_RATE_HZ), 1e-3)
        predicted = np.fft.irfft(model(frequency) * np.fft.rfft(self.input, size), size)[: len(self.input)]
        return np.asarray((predicted - self.output) / np.abs(self.output).max())

    def delay_s(self, band_hz: float = 10e3) -> float:
        """Mean delay of the output of the shock below a frequency, weighted by the input's power."""
        frequency = np.fft.rfftfreq(len(self.input), 1.0 / SHOCK_RATE_HZ)
        low = frequency < band_hz
        shock, output = np.fft.rfft(self.input)[low], np.fft.rfft(self.output)[low]
        weight = np.abs(shock) ** 2 * frequency[low]
        return float(-weight @ np.angle(output / shock) / (weight @ frequency[low]) / (2.0 * np.pi))


def read_shock(folder: Path) -> Shock:
    """Read the accelerometer's files; the phases of the table are degrees."""
    frequency, magnitude, phase = np.loadtxt(folder / "sinusoidal_calibration_values.txt").T
    shock, output = (np.loadtxt(folder / f"measured_{name}_accel.txt") for name in ("input", "output"))
    return Shock(frequency, magnitude * np.exp(1j * np.radians(phase)), shock, output)


def as_sensor(fit: Resonance) -> SensorModel:
    """An accelerometer as a force sensor under its seismic mass, here 1 kg: output per N is output per m/s²."""
    omega, zeta = 2.0 * np.pi * fit.frequency_hz, fit.damping_ratio
    place = {name: fit.parameters.index(name) for name in ("gain_re", "frequency_hz", "damping_ratio", "delay_s")}
    slopes = np.zeros((5, len(fit.parameters)))
    slopes[0, place["gain_re"]] = slopes[4, place["delay_s"]] = 1.0
    slopes[1:3, place["frequency_hz"]] = 4.0 * np.pi * np.array([omega, zeta])
    slopes[2, place["damping_ratio"]] = 2.0 * omega
    covariance, chain = slopes @ fit.covariance @ slopes.T, ChainModel("delay", np.array([fit.delay_s]))
    return SensorModel(fit.gain.real, omega**2, 2.0 * zeta * omega, 0.0, chain, covariance, "1/N")


def accelerometer_calibration(folder: Path) -> Iterator[Row]:
    """A second-order model fitted to a sinusoidal calibration predicts a shock."""
    data = read_shock(folder)
    fit, still, static = data.fit(True), data.fit(False), np.abs(data.value[0])
    ratio, magnitude = np.abs(np.fft.rfft(data.output)[3] / np.fft.rfft(data.input)[3]), np.abs(data.value)
    yield Row(
        "output / input of the shock at 1.7 kHz, of the table",
        f"{ratio:.3f}, {np.interp(1667.0, data.frequency_hz, magnitude):.3f}",
    )
    table_delay = -float(data.frequency_hz @ np.angle(data.value) / (data.frequency_hz @ data.frequency_hz)) / (
        2.0 * np.pi
    )
    yield Row(
        "delay of the table, of the shock below 10 kHz", f"{1e6 * table_delay:.2f}, {1e6 * data.delay_s():.2f} µs"
    )
    for title, one in (("with", fit), ("without", still)):
        delay = f", τ = ({1e6 * fit.delay_s:.2f} ± {2e6 * fit.u('delay_s'):.2f}) µs" if title == "with" else ""
        here = (
            f"f₀ = ({one.frequency_hz / 1e3:.1f} ± {2e-3 * one.u('frequency_hz'):.1f}) kHz, ζ = {one.damping_ratio:.3f}"
        )
        here += f" ± {2.0 * one.u('damping_ratio'):.3f}{delay}; χ²/dof {one.chi_squared / one.dof:.2f}"
        yield Row(f"table, model {title} delay (U, k = 2)", here)
    for permitted in (0.01, 0.05, 0.10):
        band = usable_band(as_sensor(fit), Load(1.0, "force"), permitted)
        here = f"({band.upper_hz / 1e3:.2f} ± {2e-3 * band.u_upper_hz:.2f}) kHz"
        measured = np.interp(1.0 + permitted, magnitude / static, data.frequency_hz) / 1e3
        yield Row(
            f"sensitivity has risen by {100 * permitted:.0f} %", here, f"{measured:.2f} kHz (table, interpolated)"
        )
    own, told = _fitted_to_shock(data)
    errors = {"model with delay": data.error(fit.model), "model without delay": data.error(still.model)}
    errors["constant sensitivity"] = data.error(lambda f: np.full(len(f), static + 0j))
    errors[f"the model closest to the shock itself ({told})"] = data.error(own)
    for title, error in errors.items():
        here = f"{100 * error.std():.2f} %, {100 * error[SHOCK].std():.2f} %"
        yield Row(
            f"shock by {title}: error over the record, over the shock", here, "", "≤ 5 %" if "with d" in title else ""
        )
    spectrum = np.abs(np.fft.rfft(errors["model with delay"])) ** 2
    bands = np.add.reduceat(spectrum, (np.array([0.0, 20e3, 40e3, 70e3]) * len(data.input) / SHOCK_RATE_HZ).astype(int))
    parts = ", ".join(f"{100 * np.sqrt(2.0 * part) / len(data.input):.2f} %" for part in bands)
    yield Row("model with delay: error at 0 to 20, 20 to 40, 40 to 70, above 70 kHz", parts)
    yield Row("ringing: largest output / input, smoothed", _ringing(data))
    yield from _corrected_shock(data, fit)


def _fitted_to_shock(data: Shock) -> tuple[Callable[[FloatArray], NDArray[np.complex128]], str]:
    """Return the second-order model with delay that leaves the smallest error of the shock, and its parameters."""

    def response(frequency_hz: FloatArray, x: FloatArray) -> NDArray[np.complex128]:
        p = 1j * frequency_hz / (1e4 * x[0])
        return np.asarray(x[2] * np.exp(-2e-6j * np.pi * frequency_hz * x[3]) / (1.0 + 2.0 * x[1] * p + p * p))

    found = least_squares(lambda x: data.error(lambda f: response(f, x)), [5.0, 0.05, 0.227, 0.0]).x
    return lambda f: response(f, found), f"f₀ = {10.0 * found[0]:.1f} kHz, ζ = {found[1]:.3f}, τ = {found[3]:.2f} µs"


def _ringing(data: Shock) -> str:
    """Return where output over input, averaged over 4 kHz, is largest between 30 and 100 kHz, and that ratio."""
    size = 2**16
    frequency = np.fft.rfftfreq(size, 1.0 / SHOCK_RATE_HZ)
    kernel = np.ones(round(4e3 * size / SHOCK_RATE_HZ))
    power = [
        np.convolve(np.abs(np.fft.rfft(record, size)) ** 2, kernel, "same") for record in (data.output, data.input)
    ]
    inside = (frequency > 30e3) & (frequency < 100e3)
    ratio = np.where(inside, np.sqrt(power[0] / power[1]), 0.0)
    return f"{np.max(ratio):.1f} at {frequency[np.argmax(ratio)] / 1e3:.0f} kHz"


def _corrected_shock(data: Shock, fit: Resonance) -> Iterator[Row]:
    """The output of the shock corrected up to 20 kHz against the input, with its peak and with the times aligned."""
    sensor, load, band_hz = as_sensor(fit), Load(1.0, "force"), 20e3
    rigid = SensorModel(1.0, 1e20, 0.0, 0.0, NO_CHAIN, np.zeros((4, 4)), "1/N")
    true = correct_record(data.input, SHOCK_RATE_HZ, rigid, load, band_hz).force
    plain = correct_record(data.output, SHOCK_RATE_HZ, rigid, load, band_hz).force / np.abs(data.value[0])
    corrected = correct_record(data.output, SHOCK_RATE_HZ, sensor, load, band_hz).force
    for title, one in (("corrected by the model", corrected), ("by the static sensitivity", plain)):
        shifted = [float(np.std((np.roll(one, shift) - true)[SHOCK]) / true.max()) for shift in range(-20, 21)]
        here = f"{100 * (one.max() / true.max() - 1.0):+.1f} %, {100 * min(shifted):.1f} %"
        yield Row(f"acceleration up to 20 kHz, {title}: peak, rms error after alignment", here)


SETS: tuple[Callable[[Path], Iterator[Row]], ...] = (
    duodic_rigid,
    gt4_stereo,
    static_stereo,
    undersampled_video,
    shaker_three_tone,
    chirp_measured,
    uff,
    tdms,
    accelerometer_calibration,
)


def markdown(rows: Iterator[Row]) -> str:
    """Return rows as a table."""
    lines = ["| quantity | this program | published or other | limit |", "|---|---|---|---|"]
    return "\n".join([*lines, *(f"| {row.figure} | {row.here} | {row.others} | {row.bar} |" for row in rows)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [evaluate.__name__ for evaluate in SETS]
    parser.add_argument("name", nargs="*", help=f"data sets to evaluate, by default all: {', '.join(names)}")
    wanted = parser.parse_args().name or names
    if unknown := sorted(set(wanted) - set(names)):
        parser.error(f"expected some of {', '.join(names)}, found {', '.join(unknown)}")
    data = Path(os.environ.get("SHAKERCAL_DATA", ROOT.parent / "shared" / "data"))
    for evaluate in SETS:
        if evaluate.__name__ in wanted:
            folder = data / evaluate.__name__
            print(f"## {evaluate.__name__}\n")
            print(markdown(evaluate(folder)) if folder.is_dir() else f"skipped: {folder} is not there", end="\n\n")


if __name__ == "__main__":
    main()
