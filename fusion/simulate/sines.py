"""Simulated recordings of sines: one rendered (`demo`, `nitsche2018`), and campaigns.

`sweep`: the campaign of the published sensitivity curve, twelve frequencies, two mountings, two recordings of each.
`multisine`: 40 lines at once. `matrix`: the campaign for all 36 sensitivities, axial, transverse and with a mass on an
arm of a cross.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.base import ProgressCallback, no_progress
from fusion.recording.toml import to_toml
from fusion.report.atomic_files import write_file, write_files
from fusion.simulate.multisine import many_lines, rocking_motion
from fusion.simulate.preset import (
    ChannelSpec,
    DaqSpec,
    PartSpec,
    Preset,
    face_of,
    patches_of,
    read_preset,
)
from fusion.simulate.violations import violations
from fusion.simulate.world import (
    Draws,
    SimulatedMotion,
    TruePart,
    TrueStereo,
    World,
    acceleration_at,
    bent_view,
    elastic_keys,
    harmonic,
    make_world,
    point_series,
    surface_files,
    velocity_at,
    wrench,
)
from fusion.simulate.write import (
    COLUMNS,
    POINTS_SCALE,
    RIG_FILE,
    Record,
    calibration_file,
    complex_table,
    images,
    pairs,
    points_file,
    points_text,
    write_recording,
)
from photogram.calibration.calibration_file import write_calibration
from photogram.geometry import RigidTransform
from photogram.synthetic.scene import Face, View, add_face, render_exposure
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.arrays import ComplexArray, FloatArray

# Records of each recorder on its clock, manifests and truth.

RESPONSE_HZ = np.array([0.0, 20.0, 50.0, *np.arange(100.0, 3001.0, 100.0)])
_RESPONSE_U = (1e-4, 1e-4)  # relative magnitude, phase in rad
_PULSE_S = 2e-3
_HIGH_V = 5.0


@dataclass(frozen=True)
class Run:
    """One recording: its `preset` (with the whole load), and the first keys of its manifest.

    `rig_file`: its rig. `mounting`: empty if not stated. `direction`: 3 or 6 numbers. `driven`: index of the driven
    component. `parts`: parts of the load in the manifest of this recording.
    """

    name: str
    preset: Preset
    nominal_hz: tuple[float, ...]
    rig_file: str = RIG_FILE
    mounting: str = ""
    kind: str = "sine"
    direction: tuple[float, ...] = (0.0, 0.0, 1.0)
    driven: int = 2
    parts: tuple[PartSpec, ...] = ()


def clock(daq: DaqSpec, draws: Draws) -> tuple[float, float]:
    """Return the true start of a recorder, s, and its true clock rate."""
    return daq.start_s, 1 + float(draws.normal(f"{daq.name}.clock", daq.clock_uncertainty))


def record(world: World, daq: DaqSpec, draws: Draws, noise: bool) -> Record:
    """Return the samples of one recorder, rounded to the steps of its converter."""
    start, rate = clock(daq, draws)
    count = np.arange(round(daq.duration_s * daq.sample_rate_hz), dtype=np.float64)
    time: FloatArray = start + rate * count / daq.sample_rate_hz
    samples, units = {}, {}
    for spec in daq.channels:
        if spec.quantity == "trigger":
            last = np.searchsorted(world.trigger_s, time, side="right") - 1
            since = time - world.trigger_s[np.maximum(last, 0)]
            values = np.where((last >= 0) & (since < _PULSE_S), _HIGH_V, 0.0)
        else:
            phasors = recorded_phasors(world, daq, spec, draws)
            values = harmonic(time, world.preset.frequencies_hz, phasors[:, None])[:, 0]
        if noise:
            values = values + spec.noise * draws.stream(f"{daq.name}.{spec.name}.noise").standard_normal(len(time))
        step = spec.range / 2**spec.bits
        samples[spec.name] = (np.rint(values / step) * step).astype(np.float32)
        units[spec.name] = spec.unit
    return Record(daq.sample_rate_hz, samples, units, gzip=6)


def recorded_phasors(world: World, daq: DaqSpec, spec: ChannelSpec, draws: Draws) -> ComplexArray:
    """Return phasors (K,) in the file: true · response · exp(−jω·delay) / scale."""
    shared = spec.common or spec.name
    scale = float(draws.normal(f"{shared}.scale", spec.stated.get("scale_uncertainty", 0.0)))
    individual = float(draws.normal(f"{spec.name}.individual", spec.stated.get("individual_uncertainty", 0.0)))
    delay = float(draws.normal(f"{shared}.delay", spec.stated.get("delay_uncertainty", 0.0)))
    value = _true_phasors(world, spec, draws) * np.exp(-2j * np.pi * world.preset.frequencies_hz * delay)
    if daq.response:
        value = value * true_response(shared, world.preset.frequencies_hz, draws)
    return np.asarray(value / (spec.scale * (1 + scale) * (1 + individual)))


def _true_phasors(world: World, spec: ChannelSpec, draws: Draws) -> ComplexArray:
    """Return the true phasors (K,) of a channel in SI units."""
    if spec.quantity == "output":
        return np.asarray(world.outputs[:, LOAD_COMPONENTS.index(spec.name)])
    # Independent of `fusion.instruments`, which is tested with these recordings.
    motion = world.observed_motion(draws, spec.body, spec.quantity, np.array(spec.point))
    point = np.array(spec.point) + draws.normal(f"{spec.name}.point", spec.stated.get("point_uncertainty", 0.0), 3)
    nominal = np.array(spec.direction)
    tilt = draws.normal(f"{spec.name}.direction", spec.stated.get("direction_uncertainty", 0.0), 3)
    for head in (
        head for head in world.preset.heads if head.name == spec.head
    ):  # all its beams shift and rotate together
        point = point + draws.normal(f"head {head.name}.point", head.point_uncertainty, 3)
        tilt = tilt + draws.normal(f"head {head.name}.direction", head.rotation_uncertainty, 3)
    direction = nominal + np.cross(tilt, nominal)
    direction = direction / np.linalg.norm(direction)
    direction = draws.violations("direction", direction, spec, world.preset)
    if spec.quantity == "velocity":
        return velocity_at(motion, point, direction)
    transverse = draws.normal(f"{spec.name}.transverse", spec.stated.get("transverse_sensitivity", 0.0) / np.sqrt(2), 3)
    axis = direction + transverse - nominal * (transverse @ nominal)
    return acceleration_at(motion, point, axis, world.gravity)


def nominal_response(frequency_hz: FloatArray) -> ComplexArray:
    """Return the stated response of the bridge amplifier: a low-pass, 9 kHz, damping 0.7."""
    ratio = np.asarray(frequency_hz) / 9000.0
    return np.asarray(1 / (1 - ratio**2 + 1.4j * ratio))


def true_response(name: str, frequency_hz: FloatArray, draws: Draws) -> ComplexArray:
    """Return the response with one magnitude and one phase error for all frequencies."""
    magnitude, phase = (float(draws.normal(f"{name}.response.{k}", u)) for k, u in zip("mp", _RESPONSE_U, strict=True))
    table = nominal_response(RESPONSE_HZ)
    size = np.interp(frequency_hz, RESPONSE_HZ, np.abs(table))
    angle = np.interp(frequency_hz, RESPONSE_HZ, np.unwrap(np.angle(table)))
    return np.asarray(size * (1 + magnitude) * np.exp(1j * (angle + phase)))


def response_table() -> str:
    """Return the stated response as text, with uncertainties."""
    lines = ["frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad"]
    for frequency, entry in zip(RESPONSE_HZ.tolist(), nominal_response(RESPONSE_HZ).tolist(), strict=True):
        u_magnitude = abs(entry) * _RESPONSE_U[0]
        lines.append(f"{frequency!r},{abs(entry):.9f},{np.angle(entry):.9f},{u_magnitude:.3e},{_RESPONSE_U[1]!r}")
    return "\n".join(lines) + "\n"


def rig_tables(world: World, recording_parts: tuple[PartSpec, ...] = ()) -> dict[str, Any]:
    """Return rig.toml as nested dictionaries, without the parts of a recording's manifest."""
    preset = world.preset
    tables: dict[str, Any] = {
        "format": 1,
        "name": preset.rig_name,
        "sensor": sensor_keys(preset, world.static_stated),
        "load": part_keys(preset.load) | elastic_keys(preset),
    }
    parts = [part_table(part) for part in preset.parts if part not in recording_parts]
    if parts:
        tables["part"] = parts
    tables["environment"] = environment_keys(preset)
    if preset.heads:
        keys = ("rotation_uncertainty", "point_uncertainty")
        tables["head"] = {head.name: {key: getattr(head, key) for key in keys} for head in preset.heads}
    return tables | {"stereo": dict(keys for setup in preset.stereo for keys in pairs(setup, preset))}


def sensor_keys(preset: Preset, static: NDArray[np.float64]) -> dict[str, Any]:
    """Return the block of the sensor under test, with its stated static sensitivity (6, 6)."""
    internal = {f"internal_{key}": value for key, value in part_keys(preset.internal).items()}
    return {
        "name": preset.sensor_name,
        "serial": preset.serial,
        "channels": list(LOAD_COMPONENTS),
        "unit": "V/V",
        "sense": preset.sense,
        "capacity": list(preset.capacity),
        "static_sensitivity": [[float(f"{v:.6e}") for v in row] for row in static],
        **internal,
    }


def environment_keys(preset: Preset) -> dict[str, Any]:
    """Return the block of the environment of a rig."""
    return {"gravity": preset.gravity_mps2.tolist(), "temperature": 23.0, "air_density": 1.19}


def part_keys(spec: PartSpec) -> dict[str, Any]:
    """Return the keys of a rigid part."""
    return {
        "mass": spec.mass,
        "mass_uncertainty": spec.mass_uncertainty,
        "centre_of_mass": list(spec.centre_of_mass),
        "centre_of_mass_uncertainty": spec.centre_of_mass_uncertainty,
        "inertia": np.diag(spec.inertia).tolist(),
        "inertia_uncertainty": spec.inertia_uncertainty,
    }


def part_table(spec: PartSpec) -> dict[str, Any]:
    """Return the block of a further part of the load."""
    return {"name": spec.name, "body": "load", **part_keys(spec)}


def recording_tables(run: Run) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    preset = run.preset
    tables: dict[str, Any] = {"format": 1, "name": run.name, "rig": f"../{run.rig_file}"}
    if run.mounting:
        tables["mounting"] = run.mounting
    tables["excitation"] = {
        "kind": run.kind,
        "direction": list(run.direction),
        "frequencies": list(run.nominal_hz),
        "harmonics": "auto" if run.kind == "sine" else [],
    }
    if run.parts:
        tables["part"] = [part_table(part) for part in run.parts]
    tables["daq"] = [
        {
            "name": daq.name,
            "file": daq.file,
            "clock_uncertainty": daq.clock_uncertainty,
            "channel": [_channel(spec, daq.response) for spec in daq.channels],
        }
        for daq in preset.daqs
    ]
    if preset.as_points:
        columns = {"columns": list(COLUMNS), "scale": POINTS_SCALE}
        tables["points"] = [{"stereo": setup.name, "files": points_file(setup), **columns} for setup in preset.stereo]
    elif preset.stereo:
        tables["images"] = [block for setup in preset.stereo for block in images(setup)]
    for block in (*tables.get("points", ()), *tables.get("images", ())):
        block["trigger"] = "camera_trigger"
    return tables


def _channel(spec: ChannelSpec, response: str) -> dict[str, Any]:
    """Return the block of one channel."""
    if spec.quantity == "trigger":
        return {"name": spec.name, "quantity": "trigger", "threshold": 2.5, "edge": "rising"}
    keys: dict[str, Any] = {"name": spec.name, "quantity": spec.quantity}
    if spec.quantity == "output":
        keys["channel"] = spec.name
        if response:
            keys["response"] = response
    else:
        keys |= {"body": spec.body, "point": list(spec.point), "direction": list(spec.direction)}
    keys["scale"] = spec.scale
    if spec.head:
        keys["head"] = spec.head
    if spec.common:
        keys["common"] = spec.common
    return keys | spec.stated


def truth_tables(run: Run, world: World, draws: Draws) -> dict[str, Any]:
    """Return truth.json: phasors, sensitivity, ratio of the driven component, clocks, all errors.

    With images, also the motion of every frame and the middles of the exposures on the first clock.
    """
    preset, images, tie = world.preset, dict[str, Any](), dict[str, float]()
    if world.stereo:
        middle = world.trigger_s + preset.exposure_s / 2
        poses = {}
        for stereo in world.stereo:
            moved = [RigidTransform.from_pose(p) for p in world.motion[stereo.setup.body].pose(middle + stereo.delay_s)]
            poses[stereo.setup.name] = [(pose @ moved[0].inverse()).pose.tolist() for pose in moved]
        images["motion"] = poses
        images["exposure_middle_s"] = (middle / clock(preset.daqs[0], draws)[1]).tolist()
    if len(preset.daqs) > 1:  # t_first = offset_s + rate · t_second of the two recorders' clocks
        (start, rate), (other_start, other_rate) = (clock(daq, draws) for daq in preset.daqs)
        tie = {"offset_s": (other_start - start) / rate, "rate": other_rate / rate}
    return {
        "format": 1,
        "preset": preset.name,
        "seed": draws.seed,
        **({"mounting": run.mounting} if run.mounting else {}),
        "frequencies": preset.frequencies_hz.tolist(),
        "acceleration": {body: complex_table(motion.acceleration) for body, motion in world.motion.items()},
        "load": complex_table(world.load_wrench),
        "outputs": complex_table(world.outputs),
        "sensitivity": complex_table(world.sensitivity),
        **({} if images else {"driven": run.driven}),
        "ratio": complex_table(world.outputs / world.load_wrench[:, run.driven, None]),
        **images,
        "clock": tie,
        "drawn": draws.values,
        **({"violated": dict(draws.violations.sizes)} if draws.violations.sizes else {}),
    }


# One rendered recording, campaigns over frequency and of six components.

TRIGGER_JITTER_S = 30e-9
RENDERINGS_PER_PERIOD = 40  # for an exposure of one period
LEAD_S = 0.1  # of the first frame after the first recorder's start, and of a record's end after the last frame
DRIVE_MPS2 = 60.0
STEP_HZ = 53.7
STEPS = (1, 2, 3, 5, 7, 9, 11, 13, 14, 15, 17, 19)
"""All frequencies are multiples of 53.7 Hz; the publication names the 1st, the 7th (rocking) and the 19th."""
MOUNTINGS = ("1", "2")
FREQUENCY_ERROR = 2.4e-6
_BEATS = (0.27, 0.33)  # cycles that a line may advance from frame to frame beyond whole ones

MULTIPLES = (8, 17, 31)
_FUNDAMENTAL_HZ = 10.00002  # the generator's 10 Hz
_SIDE = 0.02  # motion in other components over the driven one (rotations: over 0.1 m)
_ARMS = {"+x": (0.2, 0.0, 0.0), "-x": (-0.2, 0.0, 0.0), "+y": (0.0, 0.2, 0.0)}
SETUPS = (("z", ""), ("z", "+x"), ("z", "-x"), ("z", "+y"), ("x", ""), ("x", "+y"), ("y", ""), ("y", "+x"))
"""Axis along the shaker, and the arm that carries the mass ("": the load alone)."""


@dataclass(frozen=True)
class SimulationOptions:
    """Switches of truth and noise.

    `image_noise`: shot and read noise. `channel_noise`: of amplifiers and points. `systematic_errors`: stated
    uncertainties are sampled, otherwise all values are exact. `trigger_jitter`: 30 ns rms. `aliased`: sharp 2 px
    speckle without lens blur. `frames`: fewer frames. `image_scale`: smaller images of a smaller face, same optics.
    `recordings`: only the first ones. `violate`: assumptions to violate, NAME or NAME=SIZE.
    """

    image_noise: bool = True
    channel_noise: bool = True
    systematic_errors: bool = True
    trigger_jitter: bool = True
    aliased: bool = False
    frames: int | None = None
    image_scale: float = 1.0
    recordings: int | None = None
    violate: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse impossible recordings."""
        if self.frames is not None and self.frames < 3:
            raise ValueError(f"frames: expected at least 3, found {self.frames}")
        if not 0.1 <= self.image_scale <= 1:
            raise ValueError(f"image_scale: expected 0.1 to 1, found {self.image_scale}")


def runs(preset: str) -> tuple[Run, ...]:
    """Return the recordings of a preset."""
    if preset == "sweep":
        variants = [(step, mounting, repeat) for step in STEPS for mounting in MOUNTINGS for repeat in (1, 2)]
        return tuple(_sweep_run(*variant) for variant in variants)
    if preset == "multisine":
        return (multisine_run(read_preset(Preset, preset)),)
    if preset == "matrix":
        return tuple(_matrix_run(number, axis, arm) for number, (axis, arm) in enumerate(SETUPS, 1))
    return (rendered_run(read_preset(Preset, preset)),)


def rendered_run(preset: Preset) -> Run:
    """Return the one recording of a preset, driven along z."""
    nominal = round(preset.fundamental_hz, 2)
    return Run(f"Fz {nominal} Hz, simulated", preset, (nominal,))


def write_runs(folder: Path, preset: str, seed: int, progress: ProgressCallback, options: SimulationOptions) -> None:
    """Write the recordings of a preset and their rigs; `progress` is called for each."""
    chosen = runs(preset)[: options.recordings]
    broken = violations(options.violate, chosen[0].preset)
    jitter_s = TRIGGER_JITTER_S if options.trigger_jitter else 0.0
    for number, run in enumerate(chosen, 1):
        smaller = replace(run, preset=run.preset.reduced(options.frames, options.image_scale))
        draws = Draws(seed, options.systematic_errors, violations=broken)
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
    """Write one recording and, if missing, its rig; return its folder."""
    options = options or SimulationOptions()
    preset = run.preset
    records = {daq.file: record(world, daq, draws, options.channel_noise) for daq in preset.daqs}
    records = draws.violations("records", records, world)
    texts = {daq.response: response_table() for daq in preset.daqs if daq.response}
    for setup in preset.stereo if preset.as_points else ():
        position = point_series(world, setup, draws, options.channel_noise)
        texts[points_file(setup)] = points_text(position[draws.violations("frames", np.arange(len(position)), setup)])
    recording = folder / preset.recording
    write_recording(recording, recording_tables(run), truth_tables(run, world, draws), records, texts)
    for stereo in world.stereo:
        calibration = folder / calibration_file(stereo.setup)
        calibration.parent.mkdir(exist_ok=True)
        write_calibration(calibration, stereo.nominal, 0.02)
    if world.stereo:
        _write_images(recording, world, draws, options, progress)
    if not (folder / run.rig_file).exists():
        rig = to_toml(draws.violations("rig", rig_tables(world, run.parts)))
        write_files(folder, {run.rig_file: rig, **surface_files(preset)})
    return recording


def _write_images(
    folder: Path, world: World, draws: Draws, options: SimulationOptions, progress: ProgressCallback
) -> None:
    """Render, digitise and write every image, frames in parallel (without the interpreter lock)."""
    import tifffile

    done, frames, exposure = 0, world.preset.frames, world.preset.exposure_s
    times = max(2, int(np.ceil(RENDERINGS_PER_PERIOD * exposure * float(world.preset.frequencies_hz.max()))))
    whole: dict[str, Any] = {"photometric": "minisblack", "metadata": None, "software": False}
    whole |= {
        "compression": "zlib",
        "compressionargs": {"level": 1},
    }  # higher levels gain 1 % for twice the time, because of the noise

    def shoot(stereo: TrueStereo, faces: Sequence[Face], view: View, series: Path, number: int, frame: int) -> None:
        face, *patches = faces
        middle = stereo.exposure_middle_s(float(world.trigger_s[frame]), exposure)
        pose_at = world.observed_motion(draws, stereo.setup.body, "camera", np.array(stereo.setup.face_centre)).pose
        load = stereo.setup.body == "load"
        bent = bent_view(world, draws, view, face, (middle, exposure)) if load else view
        nodes = 4 if options.aliased else 2
        image = render_exposure(bent, face, pose_at, middle, exposure, nodes, times)
        at_rest = world.observed_motion(draws, "room", "camera", np.array(stereo.setup.face_centre)).pose
        for patch in patches:
            image = add_face(image, view, patch, at_rest, (middle, exposure), nodes)
        image = draws.violations("image", image, series.name, float(np.mean(middle)), frame / frames)
        rng = draws.stream(f"{series.name}.{frame}") if options.image_noise else None
        stream = io.BytesIO()
        tifffile.imwrite(stream, stereo.setup.sensor.digitise(image, rng), **whole)
        write_file(series / f"{number:04d}.tif", stream.getvalue())

    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        for stereo in world.stereo:
            name = stereo.setup.name
            face = face_of(stereo.setup, options.aliased, draws.stream(f"{name}.speckle"))
            face = draws.violations("face", face)
            patches = [
                face_of(patch, options.aliased, draws.stream(f"{patch.name}-{number}.speckle"))
                for number, patch in enumerate(patches_of(stereo.setup))
            ]
            stored = draws.violations("frames", np.arange(frames), stereo.setup).tolist()
            for side, view in zip(stereo.setup.sides, stereo.views, strict=True):
                series = folder / f"{name}-{side}"
                series.mkdir()
                tasks = [
                    pool.submit(shoot, stereo, (face, *patches), view, series, *numbers)
                    for numbers in enumerate(stored)
                ]
                for task in tasks:
                    task.result()
                    done += 1
                    progress("render", done, sum(len(pair.setup.sides) for pair in world.stereo) * frames)
    finally:
        pool.shutdown(cancel_futures=True)  # an interruption does not wait for the remaining images


def driven(
    preset: Preset, recording: str, fundamental_hz: float, motion: ComplexArray, multiples: Sequence[int] = (1, 2)
) -> Preset:
    """Return a preset with lines and motion (K, 6) of one recording."""
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
    """Return a camera rate near 53 Hz for a line and the DAQ rates.

    It beats with the line and is no simple fraction of the DAQ rates. At the candidate rates a line advances by about
    0.3 cycles per frame. The selected rate has the smallest gap between the phases of its edges in the sampling
    intervals: this gap limits the resolution of the trigger instants.
    """

    def gap_s(rate_hz: float, sampling_hz: float) -> float:
        phase = np.sort(np.arange(preset.frames) * sampling_hz / rate_hz % 1.0)
        return float(np.max(np.diff(np.append(phase, phase[0] + 1.0))) / sampling_hz)

    rates = frequency_hz / (np.floor(frequency_hz / 53.0) + np.linspace(*_BEATS, 61))
    return float(min(rates, key=lambda rate: max(gap_s(float(rate), daq.sample_rate_hz) for daq in preset.daqs)))


def _sweep_run(step: int, mounting: str, repeat: int) -> Run:
    """Return one recording of the sweep.

    Every recording starts at another moment, with an amplitude within 1 %.
    """
    nominal = round(step * STEP_HZ, 1)
    rng = np.random.default_rng((step, int(mounting), repeat))
    turn = np.exp(2j * np.pi * rng.uniform(size=2))
    axial = DRIVE_MPS2 * (1 + 0.01 * rng.uniform(-1, 1)) * np.array([1.0, 0.004]) * turn
    motion = rocking_motion(nominal * np.array([1.0, 2.0]), axial)
    rig = read_preset(Preset, "sweep")
    rig = replace(rig, camera_rate_hz=camera_rate(rig, nominal))
    name = f"Fz-{nominal:06.1f}-{mounting}{'ab'[repeat - 1]}"
    preset = driven(rig, name, nominal * (1 + FREQUENCY_ERROR), motion)
    title = f"Fz {nominal:g} Hz, mounting {mounting}, recording {repeat}, simulated"
    return Run(title, preset, (nominal,), mounting=mounting)


def multisine_run(preset: Preset) -> Run:
    """Return one recording of 40 lines with the rates of a preset."""
    grid, motion = many_lines(preset.camera_rate_hz, preset.frames)
    numbers, spacing_hz = grid.numbers.tolist(), grid.spacing_hz * (1 + FREQUENCY_ERROR)
    nominal = tuple(np.round(grid.frequency_hz, 6).tolist())
    many = driven(replace(preset, frames=grid.frames), "Fz-multisine", spacing_hz, motion, numbers)
    return Run(f"Fz, {len(numbers)} lines at once, simulated", many, nominal, kind="multisine")


def _matrix_run(number: int, axis: str, arm: str) -> Run:
    """Return one recording for the matrix, mounted again, with the sensor's `axis` upwards.

    One translation is driven; the other components move by 1 to 2 % of it with random phases. The moment mass is the
    same cylinder at every arm.
    """
    index = "xyz".index(axis)
    rng = np.random.default_rng([6, number])
    size = _SIDE * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    size[index] = 1.0
    amplitude = DRIVE_MPS2 * size * rng.uniform(0.5, 1.0, (len(MULTIPLES), 6))
    amplitude[:, index] = DRIVE_MPS2
    motion = amplitude * np.exp(2j * np.pi * rng.uniform(size=amplitude.shape))
    rig = read_preset(Preset, "matrix")
    cross, mass = rig.parts
    parts = (cross, replace(mass, centre_of_mass=_ARMS[arm])) if arm else ()
    x, y, z = (0.0 - float(v) + 0.0 for v in np.eye(3)[index])
    rig = replace(rig, rig_name=f"{rig.rig_name}, {axis} upwards", down=(x, y, z), parts=parts)
    x, y, z = np.eye(3)[index].tolist()
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
    """Return the six load components of a unit acceleration of rigid parts, N and N·m."""
    amplitude = np.array([[*translation, 0.0, 0.0, 0.0]], dtype=np.complex128)
    rigid = [TruePart(p.mass, np.array(p.centre_of_mass), np.diag(p.inertia)) for p in parts]
    total = wrench(SimulatedMotion(np.array([1.0]), amplitude), rigid, np.zeros(3))[0].real
    return tuple(round(float(component), 4) + 0.0 for component in total)
