"""A synthetic evaluation with known numbers, as the recording of a shaker driven along z at 106.25 Hz would give it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.estimation.fuse import Acceleration
from fusion.estimation.instrument_consistency import CommonEstimate, Consistency
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.instruments.channel import Outputs
from fusion.phasors.channel_phasors import ChannelResult
from fusion.phasors.stereo_phasors import StereoResult
from fusion.phasors.timing import ClockResult, EdgeGrid
from fusion.recording.environment import Environment
from fusion.recording.rig import Rig, RigLoad, Sensor
from fusion.recording.toml import UncertainInput, UncertaintyStatement
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.load_phasors import LoadResult
from fusion.sensitivity.ratio import Sensitivity
from photogram.measure.epipolar import EpipolarCheck
from photogram.motion import RigidMotion
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, MOTION_COMPONENTS, component_units
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.aliasing import exposure_gain
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import fit_sines
from shaker.timebase.tie import ClockTie
from shaker.timebase.trigger import TriggerFit
from shakercal._common.notices import DeclaredNotice, Notice

FREQUENCY_HZ = np.array([106.2503, 212.5006, 425.0012])
ACCELERATION = np.array(
    [
        [0.31 - 0.12j, -0.18 + 0.05j, 189.3217 * np.exp(0.369j), 1.4 + 0.3j, -0.9 + 1.1j, 0.06 - 0.02j],
        [0.02 + 0.01j, 0.01j, 0.38 - 0.21j, 0.11 + 0.02j, 0.09j, 0.0 + 0.01j],
        [0.01 + 0.0j, 0.02 + 0.0j, 0.9596 * np.exp(-0.71j), 0.3 - 0.1j, 0.2 + 0.1j, 0.05 + 0.0j],
    ]
)
RELATIVE_U = 6.5e-4
WEAK_U = np.array([0.03, 0.03, 0.02, 0.25, 0.25, 0.4])
STATIC = np.diag([5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6])
CROSS = np.array(
    [2.1e-10 + 1e-11j, -8e-11 + 3e-11j, 1.972e-7 * np.exp(-0.0337j), 9e-10j, 4e-10 + 1e-10j, 1e-11 + 2e-11j]
)
MASS_KG = 7.7295


@dataclass(frozen=True)
class Choice:
    """What the synthetic recording has: frames, sensor, images."""

    frames: int = 211
    sensor: bool = True
    images: bool = True
    name: str = "Fz 106.25 Hz"
    mounting: str = "1"


CERTIFIED = UncertaintyStatement(value=6.9605, U=0.0020, k=2.0, certificate="M-2026-117", valid_until=date(2028, 3, 2))
"""What a certificate says of the load mass."""


def make_evaluation(folder: Path, choice: Choice | None = None, seed: int = 0) -> Evaluation:
    """Return a complete evaluation; `folder` is where its manifest would lie."""
    choice = Choice() if choice is None else choice
    rng = np.random.default_rng(seed)
    accelerations = make_accelerations(rng)
    stereo = tuple(_stereo(name, body, choice, rng) for name, body in (("top", "load"), ("base", "base")))
    return Evaluation(
        manifest=_manifest(folder, choice),
        lines=LINES,
        clocks=_clocks(folder, rng),
        channels=_channels(rng),
        stereo=stereo if choice.images else (),
        accelerations=accelerations,
        load=_load(accelerations[0].phasors) if choice.sensor else None,
        outputs=_outputs() if choice.sensor else None,
        sensitivity=_sensitivity() if choice.sensor else None,
        notices=NOTICES,
        settings={"subset_radius_px": 10, "spline_degree": 5},
        versions={"shakercal": version("shakercal"), "python": "3.11", "numpy": "2.0"},
        input_hashes={"rig.toml": "ab" * 32, "Fz/recording.toml": "cd" * 32, "Fz/top-left/0000.tif": "ef" * 32},
        duration_s=12.5,
    )


def make_accelerations(rng: np.random.Generator) -> tuple[Acceleration, ...]:
    """Return the load's acceleration from three sources and fused, the base's from photogrammetry."""
    return (
        _acceleration("load", "fused", RELATIVE_U, 1.0, range(6), rng),
        _acceleration("load", "photogrammetry", 8e-4, 1.6, range(6), rng),
        _acceleration("load", "vibrometer", 1.0e-3, 1.0, [2], rng),
        _acceleration("load", "accelerometer", 4e-3, 3.0, [0, 1, 2], rng),
        _acceleration("base", "fused", 9e-4, 1.6, range(6), rng),
        _acceleration("base", "photogrammetry", 9e-4, 1.6, range(6), rng),
    )


def phasors(value: NDArray[Any], u: NDArray[Any], channels: tuple[str, ...], unit: tuple[str, ...]) -> Phasors:
    """Return phasors with a little correlation of real and imaginary parts; `u` (K, C) of each part."""
    lines, count = value.shape
    covariance = np.zeros((lines, 2 * count, 2 * count))
    diagonal = np.arange(count)
    covariance[:, diagonal, diagonal] = u**2
    covariance[:, diagonal + count, diagonal + count] = (0.6 * u) ** 2
    covariance[:, diagonal, diagonal + count] = covariance[:, diagonal + count, diagonal] = 0.3 * 0.6 * u**2
    return Phasors(FREQUENCY_HZ, value, covariance, channels, unit, np.full(lines, 204.0))


def _acceleration(
    body: str, source: Any, relative: float, weak: float, observed: Any, rng: np.random.Generator
) -> Acceleration:
    true = ACCELERATION * (1.0 if body == "load" else 0.93 * np.exp(0.004j))
    u = np.hypot(np.abs(true) * relative, WEAK_U * weak)
    error = 0.5 * u * (rng.standard_normal(u.shape) + 0.6j * rng.standard_normal(u.shape))
    mask = np.zeros(true.shape, dtype=bool)
    mask[:, list(observed)] = True
    values = phasors(
        np.where(mask, true + error, np.nan), np.where(mask, u, np.nan), MOTION_COMPONENTS, component_units(2)
    )
    parts = (
        Contribution("scatter of the sine approximation", "A", 0.2 * values.covariance, np.full(3, 8.16)),
        Contribution("length scale of the stereo pair", "B", 0.8 * values.covariance),
    )
    consistency = (Consistency("stereo top", 1.12, 6), Consistency("laser", 0.94, 1, True, 1.0006 * np.exp(0.4e-3j)))
    fused = source == "fused" and body == "load"
    told = (CommonEstimate("laser: scale", "laser: scale", 2.5e-4, "1", 0.4, 0.9),) if fused else ()
    return Acceleration(
        body,
        source,
        values,
        mask,
        ("stereo top", "laser") if fused else (source,),
        Uncertainty(parts),
        consistency if fused else (),
        14.2 if fused else 0.0,
        12 if fused else 0,
        told,
        (),
    )


def _load(acceleration: Phasors) -> LoadResult:
    inertia = np.array([MASS_KG, MASS_KG, MASS_KG, 0.036, 0.036, 0.031])
    load = acceleration.scaled(inertia, LOAD_UNITS)
    noise = Contribution("scatter of the sine approximation", "A", load.covariance, load.dof)
    return LoadResult(FREQUENCY_HZ, load.value, Uncertainty((noise,)), np.ones((3, 6), dtype=bool), ())


def _outputs() -> Outputs:
    value = CROSS * MASS_KG * ACCELERATION[:, 2:3]
    found = phasors(value, np.full((3, 6), 2e-9), LOAD_COMPONENTS, ("V/V",) * 6)
    return Outputs(found, Uncertainty((Contribution("output noise", "A", found.covariance, found.dof),)))


def _sensitivity() -> Sensitivity:
    value = np.full((3, 6, 6), np.nan, dtype=complex)
    slope = np.array([1.0, 0.995 * np.exp(-0.033j), 0.97 * np.exp(-0.1j)])
    value[:, :, 2] = CROSS * slope[:, None]
    u = np.array([0.45e-10, 1e-9, 2e-9])[:, None] * np.array([0.3, 0.3, 1.0, 2.0, 2.0, 0.5])
    covariance = np.zeros((3, 12, 12))
    place = np.arange(6)
    covariance[:, place, place] = covariance[:, place + 6, place + 6] = u**2
    covariance[:, place, place + 6] = covariance[:, place + 6, place] = 0.2 * u**2
    noise = Contribution("scatter of the sine approximation", "A", covariance, np.array([204.0, 204.0, np.inf]))
    return Sensitivity(
        frequency_hz=FREQUENCY_HZ,
        value=value,
        elements=tuple((channel, 2) for channel in range(6)),
        uncertainty=Uncertainty((noise,), _influences(value[:, :, 2])),
        channels=LOAD_COMPONENTS,
        components=LOAD_COMPONENTS,
        unit="V/V",
        kind=("ratio", "harmonic", "harmonic"),
        notices=(),
    )


def _influences(value: NDArray[Any]) -> tuple[Influence, ...]:
    known = {
        "length scale of stereo pair top": (2e-4, 1.0, "1", 1.0 + 1.0j),
        "scale of the laser vibrometer": (2.5e-4, 1.0, "1", 1.0 - 1.0j),
        "load mass": (0.001, 0.14, "kg", -1.0 + 1.0j),
        "internal mass": (0.002, 0.13, "kg", -1.0 - 1.0j),
        "bridge amplifier response": (1.0, 1.0e-4, "1", 1.0 + 1.0j),
        "pose of stereo pair top": (1e-4, 0.2, "m", 1.0 + 1.0j),
        "delay of the exposure": (1e-7, 667.0, "s", -1.0j),
    }
    changes = ((name, u, unit, value * u * slope * turn) for name, (u, slope, unit, turn) in known.items())
    return tuple(
        Influence(name, name, u, unit, np.concatenate([c.real, c.imag], 1), "rig") for name, u, unit, c in changes
    )


def _stereo(name: str, body: str, choice: Choice, rng: np.random.Generator) -> StereoResult:
    time = 0.970013 + np.arange(choice.frames) / 52.874
    omega = 2.0 * np.pi * FREQUENCY_HZ
    amplitude = -ACCELERATION / omega[:, None] ** 2 * (1.0 if body == "load" else 0.93)
    noise = np.array([0.2e-6, 0.2e-6, 0.4e-6, 3e-6, 3e-6, 1e-6])
    pose = (np.exp(1j * np.multiply.outer(time, omega)) @ amplitude).real
    pose = pose + noise * rng.standard_normal(pose.shape)
    if len(pose) > 60:
        pose[57] = np.nan
    covariance = np.tile(np.diag(noise**2), (choice.frames, 1, 1))
    failed = ~np.isfinite(pose).all(axis=1)
    covariance[failed] = np.nan
    points = np.where(failed, 0, 437)
    residual = np.where(failed, np.nan, 0.9e-6 + 5e-8 * rng.standard_normal(choice.frames))
    fit = fit_sines(time, pose, FREQUENCY_HZ, MOTION_COMPONENTS, component_units(0))
    grid = np.stack(np.meshgrid(np.arange(40, 600, 22), np.arange(40, 480, 22)), axis=-1).reshape(-1, 2)
    return StereoResult(
        name=name,
        body=body,
        time_s=time,
        exposure_s=40e-6,
        motion=RigidMotion(pose - pose[0], covariance, residual, points, np.zeros(3)),
        motion_from_mean=RigidMotion(pose, covariance, residual, points, np.zeros(3)),
        fit=fit,
        phasors=fit.phasors.scaled(1.0 / exposure_gain(FREQUENCY_HZ, 40e-6)[:, None]),
        usable=np.ones(3, dtype=bool),
        reprojection_px=0.021,
        reference_image=_speckle(rng),
        subsets_px=grid.astype(np.float64),
        speckle_px=4.4,
        noise_grey=9.3,
        median_zncc=0.9971,
        epipolar=_epipolar(grid.astype(np.float64), failed, rng),
    )


def _epipolar(grid: NDArray[np.float64], failed: NDArray[np.bool_], rng: np.random.Generator) -> EpipolarCheck:
    course = 0.004 + 4e-4 * rng.standard_normal((len(failed), 3))
    course[failed] = np.nan
    residual = 0.004 + 3e-3 * rng.standard_normal(len(grid))
    residual[7] = np.nan
    pattern, covariance = np.array([0.004, 0.0, 0.0]), np.diag([0.003, 0.002, 0.002]) ** 2
    return EpipolarCheck(course, 4e-4 + 0.0 * course, pattern, covariance, grid, residual, ())


def _speckle(rng: np.random.Generator) -> NDArray[np.uint16]:
    raw = np.fft.rfft2(rng.standard_normal((512, 640)))
    fy, fx = np.meshgrid(np.fft.fftfreq(512), np.fft.rfftfreq(640), indexing="ij")
    smooth = np.fft.irfft2(raw * np.exp(-((fx**2 + fy**2) * (2.0 * np.pi * 1.6) ** 2) / 2.0), s=(512, 640))
    return np.clip(2000.0 + 900.0 * np.tanh(1.5 * smooth / smooth.std()), 0, 4095).astype(np.uint16)


def _channels(rng: np.random.Generator) -> tuple[ChannelResult, ...]:
    velocity = ACCELERATION[:, 2] / (2j * np.pi * FREQUENCY_HZ)
    found = [_channel("velocity", "vibrometer", "velocity", "m/s", 51200.0, velocity, 4e-5, rng)]
    for name, ratio in zip(LOAD_COMPONENTS, CROSS, strict=True):
        output = ratio * MASS_KG * ACCELERATION[:, 2]
        found.append(_channel(name, "bridge", "output", "V/V", 10000.0, output, 2e-7, rng))
    return tuple(found)


def _channel(
    name: str, daq: str, quantity: str, unit: str, rate: float, value: Any, noise: float, rng: np.random.Generator
) -> ChannelResult:
    time = np.arange(int(0.5 * rate)) / rate
    clean = (np.exp(2j * np.pi * np.multiply.outer(time, FREQUENCY_HZ)) @ value).real
    samples = clean + noise * rng.standard_normal(len(time))
    spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(time)))) * 4.0 / len(time)
    short = slice(0, int(0.04 * rate), max(1, int(rate / 12800)))
    return ChannelResult(
        name=name,
        daq=daq,
        quantity=quantity,
        body="load",
        unit=unit,
        sample_rate_hz=rate,
        samples=len(time),
        phasors=phasors(value[:, None], np.full((3, 1), noise / 100.0), (name,), (unit,)),
        residual_rms=noise,
        excerpt_s=0.96 + time[short],
        excerpt=samples[short],
        excerpt_fit=clean[short],
        spectrum_hz=np.fft.rfftfreq(len(time), 1.0 / rate),
        spectrum=spectrum,
    )


def _clocks(folder: Path, rng: np.random.Generator) -> tuple[ClockResult, ...]:
    tie = ClockTie(
        -0.4312077, 1.0 + 4.2e-6, np.diag([(2e-7) ** 2, (1e-7) ** 2]), 0, "burst start and end", 210, 3.39, ()
    )
    base, other = _trigger(0.97, 1 / 51200, rng), _trigger(1.4012, 1e-4, rng)
    width = 2e-3, 1e-7
    first = ClockResult("vibrometer", folder / "vibrometer.h5", base, None, *width, EdgeGrid.of(base, None, 2e-3))
    return first, ClockResult("bridge", folder / "bridge.tdms", other, tie, *width, EdgeGrid.of(other, tie, 2e-3))


def _trigger(start_s: float, resolution_s: float, rng: np.random.Generator) -> TriggerFit:
    number = np.delete(np.arange(211), 90)
    period = 1.0 / 52.874
    edges = start_s + period * number + resolution_s * (rng.random(210) - 0.5)
    covariance = np.diag([(resolution_s / 50) ** 2, (resolution_s / 6000) ** 2])
    return TriggerFit(
        start_s=start_s,
        period_s=period,
        number=number,
        lower_s=edges - resolution_s / 2,
        upper_s=edges + resolution_s / 2,
        edge_s=edges,
        correction_s=np.zeros(len(number)),
        kind="sampled",
        covariance=covariance,
        jitter_s=2e-7,
        missing=(90,),
        doubled=0,
        spurious=0,
        idle_before=True,
        idle_after=True,
        resolution_s=resolution_s,
        open_s=0.0,
        notices=(),
    )


LINES = LineFrequencies(
    frequency_hz=FREQUENCY_HZ,
    u_frequency_hz=np.array([1e-5, 4e-4, 3e-4]),
    nominal_hz=np.full(3, 106.25),
    multiple=np.array([1, 2, 4]),
    why=("nominal frequency, refined", "stands 32 dB out of the noise", "stands 40 dB out of the noise"),
    notices=(),
)
NOTICES = (
    Notice(DeclaredNotice("SC-998", "note", "edge 90 of 211 is missing; its frame keeps its place"), "camera_trigger"),
    Notice(DeclaredNotice("SC-999", "warning", "318.75 Hz is left out: <u> above its limit & more"), "top"),
)


def _manifest(folder: Path, choice: Choice) -> Any:
    sensor = Sensor(
        name="six-component transducer",
        serial="0815",
        channels=LOAD_COMPONENTS,
        unit="V/V",
        sense="on_load",
        capacity=(2000.0, 2000.0, 4000.0, 100.0, 100.0, 100.0),
        static_sensitivity=STATIC.tolist(),
        static_sensitivity_uncertainty=1e-3,
        internal_mass=0.769,
        internal_mass_uncertainty=0.002,
        cross_talk=0.02,
        cross_talk_uncertainty=2e-4,
    )
    point = {"centre_of_mass": (0.0, 0.0, 0.0), "inertia": np.zeros((3, 3)).tolist()}
    rig = Rig(
        format=1,
        name="10 kN shaker, load mass 7 kg",
        sensor=sensor if choice.sensor else None,
        load=RigLoad(mass=6.9605, mass_uncertainty=0.0010, **point),
        environment=Environment(temperature=23.0),
    )
    excitation = SimpleNamespace(kind="sine", direction=(0.0, 0.0, 1.0), frequencies=(106.25,))
    return SimpleNamespace(
        name=choice.name,
        address="",
        set_ups=[],
        mounting=choice.mounting,
        path=folder / "recording.toml",
        folder=folder,
        root=folder,
        rig=rig,
        part=(),
        date=date(2026, 3, 2),
        operator="A. Tester",
        procedure=None,
        simulated=True,
        inputs=(UncertainInput(folder / "rig.toml", "load.mass", 6.9605, 0.0010, False, CERTIFIED),),
        excitation=excitation,
        is_broadband=False,
    )
