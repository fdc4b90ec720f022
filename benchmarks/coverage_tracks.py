"""Coverage of the 95 % regions at the level of tracks and channels: every systematic error drawn, no image rendered.

    python benchmarks/coverage_tracks.py [--trials 400]

One stereo pair on the load (211 frames, 64 subsets with 0.02 px noise), three laser points and six outputs on a
recorder of their own. Subsets are projected through the true cameras at the true middles of the exposures, channels are
sampled on the true clocks; from there on it is the program's own path.

At 52.874 frames per second the line at 106.25 Hz is seen as a beat of 0.50 Hz: 211 frames, as the protocol has them,
hold two of its periods. 48 frames hold half of one, which drift resembles: six degrees of freedom, k = 2.4.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from coverage_statistics import HEAD, Counts
from numpy.typing import NDArray

from fusion.instruments.channel import observe_channels, sensor_outputs
from fusion.phasors.channel_phasors import channel_phasors, find_channel_lines, line_clock, line_strength
from fusion.phasors.stereo_motion import ImageView, StereoMotion, sensor_from_camera
from fusion.phasors.stereo_phasors import pairs_phasors
from fusion.phasors.timing import TimeBase, frame_sight, tie_daqs
from fusion.recording.daq_records import DaqRecord
from fusion.recording.load import Manifest, load_manifest
from fusion.recording.toml import to_toml
from fusion.sensitivity.analyse import Analysis, Inputs, analyse
from fusion.sensitivity.moving_body import load_body
from fusion.simulate.preset import ChannelSpec, Preset, read_preset
from fusion.simulate.sines import record, recording_tables, rendered_run, rig_tables
from fusion.simulate.world import Draws, TrueStereo, World, make_world
from photogram.calibration.calibration_file import read_calibration, write_calibration
from photogram.camera import triangulate
from photogram.direct.surface import PlainShapes, ShapeAmplitudes
from photogram.geometry import RigidTransform
from photogram.measure.epipolar import check_epipolar
from photogram.motion import deformation, fit_motion
from photogram.subsets.track import StereoTracks, Tracks
from shaker.io.channel import RawChannel
from shaker.sine.aliasing import exposure_gain

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
NOISE_PX = 0.02
FRAMES = 211
SIDE = 8
RATES_HZ = (25600.0, 20000.0)
TRIGGER_JITTER_S = 30e-9
NITSCHE2018 = read_preset(Preset, "nitsche2018")


@dataclass(frozen=True)
class Case:
    """A direction of the excitation: driven load component, the true acceleration (1, 6), where the lasers look."""

    name: str
    driven: int
    direction: tuple[float, ...]
    acceleration: tuple[tuple[complex, ...], ...]
    laser_points: tuple[tuple[float, float, float], ...]
    laser_direction: tuple[float, float, float]


def _motion(driven: int, size: float, lever: float = 0.0) -> tuple[tuple[complex, ...], ...]:
    """Return the phasors of a fundamental: one component driven, the others small."""
    main = np.array([0.52 - 0.8j, -0.6 + 0.5j, 0.7 + 0.4j, 2.1 + 1.2j, -2.4 - 1.9j, 0.5 + 0.7j])
    main[driven] = size * np.exp(0.369j)
    if lever:
        main[0] = lever * main[driven]
    return (tuple(main.tolist()),)


TOP = ((0.045, 0.0, 0.0973), (-0.0225, 0.0390, 0.0973), (-0.0225, -0.0390, 0.0973))
SIDE_FACE = ((0.05, 0.0, 0.02), (0.05, 0.03, 0.08), (0.05, -0.03, 0.08))
CASES = (
    Case("uniaxial z", 2, (0.0, 0.0, 1.0), _motion(2, 189.32), TOP, (0.0, 0.0, 1.0)),
    Case("transverse x", 0, (1.0, 0.0, 0.0), _motion(0, 90.0), SIDE_FACE, (1.0, 0.0, 0.0)),
    Case("moment My", 4, (0.0, 0.0, 0.0, 0.0, 1.0, 0.0), _motion(4, 900.0, 0.01), TOP, (0.0, 0.0, 1.0)),
)


def case_preset(case: Case) -> Preset:
    """Return the set-up of a case: one pair, fewer frames, shorter records."""
    daqs = []
    for daq, rate_hz, duration_s, start_s in zip(NITSCHE2018.daqs, RATES_HZ, (4.4, 4.3), (0.0, 0.06), strict=True):
        channels = tuple(_placed(spec, case) for spec in daq.channels if spec.body != "base")
        shifted = replace(daq, sample_rate_hz=rate_hz, duration_s=duration_s, start_s=start_s)
        daqs.append(replace(shifted, channels=channels))
    return replace(
        NITSCHE2018,
        multiples=(1,),
        acceleration=case.acceleration,
        frames=FRAMES,
        first_frame_s=0.15,
        stereo=NITSCHE2018.stereo[:1],
        daqs=tuple(daqs),
    )


def started(preset: Preset, draws: Draws) -> Preset:
    """Return the set-up with the second recorder and the camera started at any instant of a sampling interval."""
    shifts = draws.stream("starts").uniform(0.0, 1.0, 2) / np.array(RATES_HZ)
    second = replace(preset.daqs[1], start_s=preset.daqs[1].start_s + shifts[1])
    return replace(preset, first_frame_s=preset.first_frame_s + shifts[0], daqs=(preset.daqs[0], second))


def _placed(spec: ChannelSpec, case: Case) -> ChannelSpec:
    """Return a channel, lasers where the case has them."""
    if spec.common != "laser":
        return spec
    point = case.laser_points[int(spec.name[-1]) - 1]
    return replace(spec, point=point, direction=case.laser_direction)


def write_manifest(folder: Path, case: Case, world: World) -> Manifest:
    """Write the manifests of a case, its calibration and empty files in place of data, and load them."""
    preset = world.preset
    recording = folder / preset.recording
    (folder / "calibration").mkdir(parents=True)
    recording.mkdir()
    for stereo in world.stereo:
        write_calibration(folder / "calibration" / f"{stereo.setup.name}.json", stereo.nominal, 0.02)
        for side in ("left", "right"):
            (recording / f"{stereo.setup.name}-{side}").mkdir()
            for frame in range(preset.frames):
                (recording / f"{stereo.setup.name}-{side}" / f"{frame:04d}.tif").touch()
    for daq in preset.daqs:
        (recording / daq.file).touch()
    tables = recording_tables(rendered_run(preset))
    tables["excitation"] |= {"direction": list(case.direction), "harmonics": [1]}
    (folder / "rig.toml").write_text(to_toml(rig_tables(world)), encoding="utf-8")
    (recording / "recording.toml").write_text(to_toml(tables), encoding="utf-8")
    return load_manifest(recording)


def time_base(manifest: Manifest, world: World, draws: Draws) -> TimeBase:
    """Return the recorders' samples as if they had been read from their files."""
    records = []
    for daq, entry in zip(world.preset.daqs, manifest.daq, strict=True):
        taken = record(world, daq, draws, True)
        raw = {
            name: RawChannel(samples.astype(np.float64), taken.sample_rate_hz)
            for name, samples in taken.samples.items()
        }
        records.append(DaqRecord(entry, raw, 0.0))
    return tie_daqs(manifest, records)


def stereo_motion(manifest: Manifest, base: TimeBase, world: World, draws: Draws) -> StereoMotion:
    """Return the motion of the body that the pair sees, from tracks of its subsets."""
    (stereo,), (entry,) = world.stereo, manifest.images
    pair = manifest.rig.stereo[entry.stereo]
    assert pair.calibration is not None
    rig = read_calibration(pair.calibration)
    tracks = subset_tracks(world, stereo, draws)
    points = triangulate(
        rig, tracks.left.position_px, tracks.right.position_px, tracks.left.covariance_px2, tracks.right.covariance_px2
    ).transformed(sensor_from_camera(pair))
    motion = fit_motion(points, None, np.zeros(3))
    epipolar = check_epipolar(tracks, rig)
    frames, shapes = len(motion.pose), PlainShapes.of(points.position_m[0])
    nothing = np.full((frames, len(shapes.names)), np.nan)  # no grey values that tell of shapes
    deformed = ShapeAmplitudes(
        shapes, nothing, nothing[:, :, None] * nothing[:, None], np.zeros((6, len(shapes.names)))
    )
    view = ImageView((tracks,), rig, np.zeros((1, 1), np.uint8), None, None, epipolar, deformed, np.nan, np.nan)
    reprojection = float(np.sqrt(np.mean(points.reprojection_px**2)))
    sight = frame_sight(manifest, base, entry, world.preset.frames)
    return StereoMotion(sight, motion, (deformation(points, motion),), reprojection, view, epipolar.notices)


def subset_tracks(world: World, stereo: TrueStereo, draws: Draws) -> StereoTracks:
    """Return the subsets' true pixels, averaged over each exposure, with noise in both cameras."""
    middle = world.trigger_s + stereo.delay_s + world.preset.exposure_s / 2
    motion = world.motion[stereo.setup.body]
    gain = exposure_gain(motion.frequency_hz, world.preset.exposure_s)
    poses = replace(motion, acceleration=motion.acceleration * gain[:, None]).pose(middle)
    half = 0.8 * np.array(stereo.setup.half_size)
    axis = np.linspace(-1.0, 1.0, SIDE)
    u, v = np.meshgrid(axis * half[0], axis * half[1])
    up, normal = np.array(stereo.setup.face_up), np.array(stereo.setup.face_normal)
    face = np.array(stereo.setup.face_centre) + u.reshape(-1, 1) * np.cross(up, normal) + v.reshape(-1, 1) * up
    moved = np.stack([RigidTransform.from_pose(pose).apply(face) for pose in poses])
    pixels = stereo.rig.project(stereo.left_from_sensor.apply(moved))
    sides = [_track(place, draws.stream(f"subsets.{name}")) for name, place in zip("lr", pixels, strict=True)]
    return StereoTracks((sides[0], sides[1]), (), np.full(2, 5.0), np.full(2, 6.0), np.zeros(2))


def _track(place: FloatArray, rng: np.random.Generator) -> Tracks:
    """Return one camera's subsets with noise."""
    frames, points, _ = place.shape
    noisy = place + NOISE_PX * rng.standard_normal(place.shape)
    covariance = np.broadcast_to(NOISE_PX**2 * np.eye(2), (frames, points, 2, 2)).copy()
    status = np.zeros((frames, points), dtype=np.int8)
    return Tracks(noisy, covariance, np.ones((frames, points)), status, np.full(points, 6.0))


def evaluate_trial(manifest: Manifest, world: World, draws: Draws) -> Analysis:
    """Return what the program makes of one drawn recording."""
    base = time_base(manifest, world, draws)
    lines = find_channel_lines(manifest, base)
    if lines is None:
        raise RuntimeError("no channel shows the lines")
    _, readings = channel_phasors(manifest, base, lines)
    errors, strength = base.line_errors(lines, line_clock(base)), line_strength(readings, lines)
    stereo, *_ = pairs_phasors(base, [stereo_motion(manifest, base, world, draws)], lines, errors, strength)
    channels = observe_channels(readings, manifest.rig.surroundings.gravity, manifest.daq[0].clock_uncertainty)
    sensor, body = manifest.rig.sensor, load_body(manifest.rig, manifest.part)
    outputs = None if sensor is None else sensor_outputs(readings, sensor.channels)
    observations = (*(item.reading.observation() for item in stereo), *channels)
    return analyse(Inputs(lines, observations, outputs, body, sensor, manifest.excitation.direction))


def run_case(case: Case, seeds: range) -> Counts:
    """Simulate and evaluate one case."""
    counts, preset = Counts(), case_preset(case)
    with tempfile.TemporaryDirectory() as scratch:
        manifest = write_manifest(Path(scratch) / "campaign", case, make_world(preset, Draws(0, False), 0.0))
        for seed in seeds:
            draws = Draws(seed, True)
            world = make_world(started(preset, draws), draws, TRIGGER_JITTER_S)
            true = world.motion["load"].acceleration[0], world.load_wrench[0], world.outputs[0]
            counts.add(case.driven, evaluate_trial(manifest, world, draws), *true)
    return counts


def main(trials: int = 400) -> None:
    """Run all cases and print the table."""
    print(HEAD)
    for case in CASES:
        for line in run_case(case, range(1, trials + 1)).rows(case.name):
            print(line, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=400)
    main(parser.parse_args().trials)
