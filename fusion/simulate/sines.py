"""Recordings of sines: one rendered recording (`demo`, `nitsche2018`), campaigns over frequency and of six components.

`sweep`: the campaign of the published sensitivity curve, twelve frequencies, two mountings, two recordings of each.
`matrix`: the campaign that determines all 36 sensitivities, axial, transverse and with a mass on an arm of a cross.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import ProgressCallback, no_progress
from fusion.simulate.channels import (
    Run,
    calibration_file,
    points_file,
    record,
    recording_tables,
    response_table,
    rig_tables,
    truth_tables,
)
from fusion.simulate.preset import PartSpec, Preset, face_of, read_preset
from fusion.simulate.world import Draws, Motion, TruePart, TrueStereo, World, make_world, point_series, wrench
from fusion.simulate.write import points_text, to_toml, write_recording, write_texts
from photogram.calibration.file import write_calibration
from photogram.synthetic.scene import Face, View, render_exposure, view_of
from shaker.arrays import ComplexArray

TRIGGER_JITTER_S = 30e-9
LEAD_S = 0.1  # of the first frame after the first recorder's start, and of a record's end after the last frame
DRIVE_MPS2 = 60.0
STEP_HZ = 53.7
STEPS = (1, 2, 3, 5, 7, 9, 11, 13, 14, 15, 17, 19)
"""All frequencies are multiples of 53.7 Hz; the publication names the 1st, the 7th (rocking) and the 19th."""
MOUNTINGS = ("1", "2")
REPEATS = 2
FREQUENCY_ERROR = 2.4e-6
ROCKING_HZ = 7 * STEP_HZ
_ROCKING_DAMPING = 0.03
_ROCKING_PER_M = ((0.022, 2.1), (0.034, -0.4))  # angular over linear acceleration far below resonance, about x and y
_BEATS = (0.27, 0.33)  # cycles that a line may advance from frame to frame beyond whole ones

MULTIPLES = (8, 17, 31)
_FUNDAMENTAL_HZ = 10.00002  # the generator's 10 Hz
_SIDE = 0.02  # motion in other components over the driven one (rotations: over 0.1 m)
_ARMS = {"+x": (0.2, 0.0, 0.0), "-x": (-0.2, 0.0, 0.0), "+y": (0.0, 0.2, 0.0)}
SETUPS = (("z", ""), ("z", "+x"), ("z", "-x"), ("z", "+y"), ("x", ""), ("x", "+y"), ("y", ""), ("y", "+x"))
"""Axis along the shaker, and the arm that carries the mass ("": the load alone)."""


@dataclass(frozen=True)
class SimulationOptions:
    """Switches of truth and noise, each on its own.

    `image_noise`, `channel_noise`: shot and read noise; that of amplifiers and of points. `systematic_errors`: what the
    manifests state as uncertainties is drawn, else everything is exactly as stated. `trigger_jitter`: 30 ns rms.
    `aliased`: sharp 2 px speckle without lens blur. `frames`: fewer frames. `image_scale`: smaller images of a smaller
    face, same optics. `recordings`: only the first so many.
    """

    image_noise: bool = True
    channel_noise: bool = True
    systematic_errors: bool = True
    trigger_jitter: bool = True
    aliased: bool = False
    frames: int | None = None
    image_scale: float = 1.0
    recordings: int | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be a recording."""
        if self.frames is not None and self.frames < 3:
            raise ValueError(f"frames: expected at least 3, found {self.frames}")
        if not 0.1 <= self.image_scale <= 1:
            raise ValueError(f"image_scale: expected 0.1 to 1, found {self.image_scale}")


def runs(preset: str) -> tuple[Run, ...]:
    """Return the recordings of a preset."""
    if preset == "sweep":
        places = [(step, mounting, repeat) for step in STEPS for mounting in MOUNTINGS for repeat in (1, 2)]
        return tuple(_sweep_run(*place) for place in places)
    if preset == "matrix":
        return tuple(_matrix_run(number, axis, arm) for number, (axis, arm) in enumerate(SETUPS, 1))
    return (rendered_run(read_preset(Preset, preset)),)


def rendered_run(preset: Preset) -> Run:
    """Return the one recording of a preset as it stands, driven along z."""
    nominal = round(preset.fundamental_hz, 2)
    return Run(f"Fz {nominal} Hz, simulated", preset, (nominal,))


def write_runs(folder: Path, preset: str, seed: int, progress: ProgressCallback, options: SimulationOptions) -> None:
    """Write the recordings of a preset and the rigs they stand on; `progress` hears of each."""
    chosen = runs(preset)[: options.recordings]
    jitter_s = TRIGGER_JITTER_S if options.trigger_jitter else 0.0
    for number, run in enumerate(chosen, 1):
        smaller = replace(run, preset=run.preset.shrunk(options.frames, options.image_scale))
        draws = Draws(seed, options.systematic_errors)
        if run.mounting:
            draws = replace(draws, mounting=run.mounting, recording=run.preset.recording)
        write_run(folder, smaller, make_world(smaller.preset, draws, jitter_s), draws, options, progress)
        progress("write", number, len(chosen))


def write_run(
    folder: Path,
    run: Run,
    world: World,
    draws: Draws,
    options: SimulationOptions | None = None,
    progress: ProgressCallback = no_progress,
) -> Path:
    """Write one recording into the folder of a campaign, and its rig where there is none yet; return its folder."""
    options = options or SimulationOptions()
    preset = run.preset
    records = {daq.file: record(world, daq, draws, options.channel_noise) for daq in preset.daqs}
    texts = {daq.response: response_table() for daq in preset.daqs if daq.response}
    for setup in preset.stereo if preset.as_points else ():
        texts[points_file(setup)] = points_text(point_series(world, setup, draws, options.channel_noise))
    recording = folder / preset.recording
    write_recording(recording, recording_tables(run), truth_tables(run, world, draws), records, texts)
    for stereo in world.stereo:
        calibration = folder / calibration_file(stereo.setup)
        calibration.parent.mkdir(exist_ok=True)
        write_calibration(calibration, stereo.nominal, 0.02)
    if world.stereo:
        _write_images(recording, world, draws, options, progress)
    if not (folder / run.rig_file).exists():
        write_texts(folder, {run.rig_file: to_toml(rig_tables(world, run.parts))})
    return recording


@dataclass(frozen=True, eq=False)
class _Shot:
    """One camera's series: where it is written, what it sees."""

    folder: Path
    view: View
    face: Face
    stereo: TrueStereo


def _shots(folder: Path, world: World, draws: Draws, aliased: bool) -> Iterator[_Shot]:
    """Yield the cameras of all stereo pairs, each with its face."""
    for stereo in world.stereo:
        name = stereo.setup.name
        face = face_of(stereo.setup, aliased, draws.stream(f"{name}.speckle"))
        right_from_sensor = stereo.rig.right_from_left @ stereo.left_from_sensor
        yield _Shot(folder / f"{name}-left", view_of(stereo.rig.left, stereo.left_from_sensor), face, stereo)
        yield _Shot(folder / f"{name}-right", view_of(stereo.rig.right, right_from_sensor), face, stereo)


def _write_images(
    folder: Path, world: World, draws: Draws, options: SimulationOptions, progress: ProgressCallback
) -> None:
    """Render and write every image, frames in parallel: the work is done outside Python's lock."""
    done, total = 0, 2 * len(world.stereo) * world.preset.frames
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        for shot in _shots(folder, world, draws, options.aliased):
            shot.folder.mkdir()
            tasks = [pool.submit(_shoot, shot, world, draws, options, k) for k in range(world.preset.frames)]
            for task in tasks:
                task.result()
                done += 1
                progress("render", done, total)
    finally:
        pool.shutdown(cancel_futures=True)  # who interrupts need not wait for the images that are left


def _shoot(shot: _Shot, world: World, draws: Draws, options: SimulationOptions, frame: int) -> None:
    """Render, digitise and write one image."""
    import tifffile

    setup, exposure = shot.stereo.setup, world.preset.exposure_s
    middle = float(world.trigger_s[frame] + shot.stereo.delay_s + exposure / 2)
    pose_at = world.motion[setup.body].pose
    image = render_exposure(shot.view, shot.face, pose_at, middle, exposure, 4 if options.aliased else 2)
    rng = draws.stream(f"{shot.folder.name}.{frame}") if options.image_noise else None
    whole: dict[str, Any] = {"photometric": "minisblack", "compression": "zlib", "metadata": None, "software": False}
    tifffile.imwrite(shot.folder / f"{frame:04d}.tif", setup.sensor.digitise(image, rng), **whole)


def driven(
    preset: Preset, recording: str, fundamental_hz: float, motion: ComplexArray, multiples: Sequence[int] = (1, 2)
) -> Preset:
    """Return a preset with lines and motion (K, 6) of one recording, and records that hold all its frames."""
    end = LEAD_S + preset.frames / preset.camera_rate_hz + LEAD_S
    return replace(
        preset,
        recording=recording,
        fundamental_hz=fundamental_hz,
        multiples=tuple(multiples),
        acceleration=tuple(tuple(complex(v) for v in row) for row in motion),
        first_frame_s=LEAD_S,
        daqs=tuple(replace(daq, duration_s=end - daq.start_s) for daq in preset.daqs),
    )


def camera_rate(preset: Preset, frequency_hz: float) -> float:
    """Return a camera rate near 53 Hz that beats with a line and is no simple fraction of the recorders' rates.

    Of rates that let the line advance by about 0.3 cycles from frame to frame it is the one whose edges leave the
    smallest gaps between their places in the sampling intervals: the gap is what the trigger's instant stays open to.
    """

    def gap_s(rate_hz: float, sampling_hz: float) -> float:
        place = np.sort(np.arange(preset.frames) * sampling_hz / rate_hz % 1.0)
        return float(np.max(np.diff(np.append(place, place[0] + 1.0))) / sampling_hz)

    rates = frequency_hz / (np.floor(frequency_hz / 53.0) + np.linspace(*_BEATS, 61))
    return float(min(rates, key=lambda rate: max(gap_s(float(rate), daq.sample_rate_hz) for daq in preset.daqs)))


def _sweep_run(step: int, mounting: str, repeat: int) -> Run:
    """Return one recording of the sweep.

    The body rocks as an oscillator at 375.9 Hz that the axial motion drives: α = a·c/(1 − η² + 2jζη). Every recording
    starts at another moment and is driven within 1 % of the same amplitude.
    """
    nominal = round(step * STEP_HZ, 1)
    rng = np.random.default_rng((step, int(mounting), repeat))
    turn = np.exp(2j * np.pi * rng.uniform(size=2))
    axial = DRIVE_MPS2 * (1 + 0.01 * rng.uniform(-1, 1)) * np.array([1.0, 0.004]) * turn
    ratio = nominal * np.array([1.0, 2.0]) / ROCKING_HZ
    resonance = 1 / (1 - ratio**2 + 2j * _ROCKING_DAMPING * ratio)
    motion = np.zeros((2, 6), dtype=np.complex128)
    motion[:, 2] = axial
    for axis, (size, phase) in enumerate(_ROCKING_PER_M, 3):
        motion[:, axis] = axial * resonance * size * np.exp(1j * phase)
    side = np.array([0.004, 0.003, 0.02])  # x, y, and the turn about z in rad/m
    motion[:, [0, 1, 5]] = axial[:, None] * side * np.exp(1j * np.array([0.7, -1.9, 2.4]))
    rig = read_preset(Preset, "sweep")
    rig = replace(rig, camera_rate_hz=camera_rate(rig, nominal))
    name = f"Fz-{nominal:06.1f}-{mounting}{'ab'[repeat - 1]}"
    preset = driven(rig, name, nominal * (1 + FREQUENCY_ERROR), motion)
    title = f"Fz {nominal:g} Hz, mounting {mounting}, recording {repeat}, simulated"
    return Run(title, preset, (nominal,), mounting=mounting)


def _matrix_run(number: int, axis: str, arm: str) -> Run:
    """Return one recording for the matrix, mounted anew, the sensor's `axis` upwards.

    One translation is driven, the other components move by 1 to 2 % of it, phases at random. The moment mass is one and
    the same cylinder, wherever it is clamped.
    """
    place = "xyz".index(axis)
    rng = np.random.default_rng([6, number])
    size = _SIDE * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    size[place] = 1.0
    amplitude = DRIVE_MPS2 * size * rng.uniform(0.5, 1.0, (len(MULTIPLES), 6))
    amplitude[:, place] = DRIVE_MPS2
    motion = amplitude * np.exp(2j * np.pi * rng.uniform(size=amplitude.shape))
    rig = read_preset(Preset, "matrix")
    cross, mass = rig.parts
    parts = (cross, replace(mass, centre_of_mass=_ARMS[arm])) if arm else ()
    x, y, z = (0.0 - float(v) + 0.0 for v in np.eye(3)[place])
    rig = replace(rig, rig_name=f"{rig.rig_name}, {axis} upwards", down=(x, y, z), parts=parts)
    x, y, z = np.eye(3)[place].tolist()
    direction = wrench_direction((rig.load, rig.internal, *parts), (x, y, z)) if arm else (x, y, z)
    share = np.abs(direction) / np.array(rig.capacity[: len(direction)])
    name = f"{number}-{axis}" + (f"-mass-{arm}" if arm else "")
    return Run(
        name=f"shaker along {axis}" + (f", mass at {arm}" if arm else "") + ", simulated",
        preset=driven(rig, name, _FUNDAMENTAL_HZ, motion, MULTIPLES),
        nominal_hz=tuple(10.0 * multiple for multiple in MULTIPLES),
        rig_file=f"rig-{axis}.toml",
        mounting=name,
        kind="multisine",
        direction=direction,
        driven=int(np.argmax(share)),
        parts=parts,
    )


def wrench_direction(parts: tuple[PartSpec, ...], translation: tuple[float, float, float]) -> tuple[float, ...]:
    """Return the six load components that a unit acceleration of rigid parts needs, as they are stated: N and N·m."""
    amplitude = np.array([[*translation, 0.0, 0.0, 0.0]], dtype=np.complex128)
    rigid = [TruePart(p.mass, np.array(p.centre_of_mass), np.diag(p.inertia)) for p in parts]
    total = wrench(Motion(np.array([1.0]), amplitude), rigid, np.zeros(3))[0].real
    return tuple(round(float(component), 4) + 0.0 for component in total)
