"""A pair of one camera: what its surface and its pose leave open, how it is stated, and a recording evaluated by it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from contracts import refused
from support import complex_of, truth_of

from fusion.errors import InputError
from fusion.estimation.coverage import coverage_factor
from fusion.instruments.stereo import SURFACE, StereoReading
from fusion.phasors import clocks
from fusion.phasors.image_effects import THROUGH, phasor_motion, surface_effects, with_surface_at_rest
from fusion.phasors.phasor_notices import IMAGES_REFUSED, SINGLE_CAMERA_NOT_ASSESSED
from fusion.phasors.stereo_motion import StereoMotion
from fusion.phasors.timing import U_FRAME_RATE, Exposure, Sight, TimeBase
from fusion.planning.check import check
from fusion.planning.look.look import look
from fusion.recording.load import load_manifest
from fusion.recording.recording_notices import KEY_NOT_APPLICABLE
from fusion.recording.rig import Stereo
from fusion.report.recording_report import render_report
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate import simulate
from photogram.camera import Camera, FaceCamera, locate
from photogram.direct.surface import PlacedCamera, PlainShapes, motion_from_positions, project_body_points
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.motion import RigidMotion
from shaker.sine.phasor import Phasors
from shaker.timebase.trigger import nominal_trigger

FACE = np.array([0.01, -0.005, 0.07])
FACE_POINTS = FACE + np.stack(
    np.meshgrid(np.linspace(-0.02, 0.02, 7), np.linspace(-0.015, 0.015, 5), [0.0]), -1
).reshape(-1, 3)
MOTION = np.array([3e-6, -2e-6, 5e-5, 4e-4, -3e-4, 5e-4])
OFF = np.array([2e-4, 1e-4, 3e-4, 5e-4, 4e-4, 6e-4])  # of the pose
STATED = (3e-4, 8e-4)
CAMERA = Camera.from_parameters(np.array([1600.0, 1600, 150, 120, -0.09, 0.1, 1e-4, 0, 0]), np.array([304, 240]))
PLACED = RigidTransform(
    rotation_from_vector(np.array([0.2, -0.3, 0.0])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.1, 0.45])
)
PAIR = Stereo(
    body="load",
    rotation=PLACED.rotation.tolist(),
    translation=PLACED.translation_m.tolist(),
    pose_uncertainty=OFF.tolist(),
    exposure=1e-4,
)


def rig_at(point: np.ndarray, normal: np.ndarray) -> FaceCamera:
    covariance = np.diag([*np.zeros(13), STATED[0] ** 2, *[STATED[1] ** 2] * 2])
    place = PLACED.inverse()
    return FaceCamera(CAMERA, place.apply(point), place.rotation @ normal, covariance)


def read(placed: RigidTransform, points: np.ndarray) -> np.ndarray:
    """What is read of the motion, (6,), when the camera is truly there and the face has these points."""
    moved = RigidTransform.from_pose(MOTION).apply(points)
    frames = np.array([CAMERA.project(placed.inverse().apply(where)) for where in (points, moved, points)])
    return phasor_motion(rig_at(FACE, np.array([0.0, 0, 1])), PLACED, [frames], PlainShapes.of(FACE_POINTS))[0, :6].real


AS_STATED = read(PLACED, FACE_POINTS)


def errors_by_name() -> dict[str, np.ndarray]:
    """What one standard uncertainty of each unknown does to the reading by the model of the fusion, (6,)."""
    moved = RigidTransform.from_pose(MOTION).apply(FACE_POINTS)
    frames = np.array([CAMERA.project(PLACED.inverse().apply(where)) for where in (FACE_POINTS, moved, FACE_POINTS)])
    measured: Any = SimpleNamespace(sight=SimpleNamespace(pair=PAIR))
    effects = surface_effects(measured, rig_at(FACE, np.array([0.0, 0, 1])), [frames], PlainShapes.of(FACE_POINTS))
    names = tuple("abcdef")
    phasors = Phasors(np.array([1.0]), MOTION[None] + 0j, 1e-20 * np.eye(12)[None], names, ("m",) * 6, np.array([9.0]))
    reading = StereoReading("top", PAIR, phasors, {SURFACE: effects[SURFACE]}, through_surface=effects[THROUGH])
    seen = reading.observation()
    acceleration = -((2.0 * np.pi) ** 2) * MOTION[None] + 0j
    assert reading.unknowns == frozenset()
    return {error.name: error.effect(acceleration)[0].real for error in seen.common}


@pytest.mark.parametrize("component", range(6))
def test_a_pose_that_is_off_does_what_the_model_says_also_through_the_distance_of_the_surface(component):
    """Positions of the sensor origin count as they are, rotations turn what is read (`StereoReading`)."""
    error = np.zeros(6)
    error[component] = OFF[component]
    turn = rotation_from_vector(-error[3:])
    true = RigidTransform(turn, error[:3]) @ PLACED
    kind, axis = ("position", "rotation")[component // 3], "xyz"[component % 3]
    found = read(true, FACE_POINTS) - AS_STATED
    stated = errors_by_name()[f"stereo top: pose {kind} {axis}"]
    size = np.repeat([np.linalg.norm(MOTION[:3]), np.linalg.norm(MOTION[3:])], 3)
    np.testing.assert_allclose(found / size, stated / size, atol=5e-6)  # beside up to 2e-3, turned by milliradians
    assert np.abs(stated / size).max() > 1e-4


def test_a_face_elsewhere_or_tilted_does_what_the_model_says():
    stated = errors_by_name()
    assert [name for name in stated if SURFACE in name] == [f"stereo top: surface {k}" for k in range(3)]
    size = np.repeat([np.linalg.norm(MOTION[:3]), np.linalg.norm(MOTION[3:])], 3)
    further = read(PLACED, FACE_POINTS + np.array([0.0, 0.0, STATED[0]])) - AS_STATED
    np.testing.assert_allclose(np.abs(further / size), np.abs(stated["stereo top: surface 0"] / size), atol=3e-6)
    # Any two axes across the normal span the same errors.
    points = [FACE + (FACE_POINTS - FACE) @ rotation_from_vector(STATED[1] * axis).T for axis in np.eye(3)[:2]]
    tilted = np.array([read(PLACED, where) - AS_STATED for where in points]) / size
    of_model = np.array([stated[f"stereo top: surface {k}"] for k in (1, 2)]) / size
    np.testing.assert_allclose(tilted.T @ tilted, of_model.T @ of_model, atol=3e-8)


def test_the_stated_surface_is_that_of_the_mean_pose_wherever_the_body_was_in_the_first_frame():
    """A body 0.3 mm off in the first frame: its motion is off by 0.07 % as it is fitted, and by nothing afterwards."""
    mean = RigidTransform.from_pose(np.array([1e-5, 0.0, -3e-4, 1e-4, 2e-4, 0.0]))
    first = mean.inverse().apply(FACE_POINTS)
    rig = rig_at(FACE, np.array([0.0, 0.0, 1.0]))

    def pixels(pose: np.ndarray) -> np.ndarray:
        return CAMERA.project(PLACED.inverse().apply(RigidTransform.from_pose(pose).apply(first)))

    at_first = pixels(np.zeros(6))
    seen = project_body_points(
        PlacedCamera(CAMERA, PLACED.inverse()), locate(rig, [at_first[None]]).transformed(PLACED).position_m[0]
    )
    true = np.array([0.02 * MOTION, np.array([2e-5, 1e-5, 3e-5, 1e-4, -1e-4, 2e-4])])
    fitted = [motion_from_positions([seen], [pixels(pose)]) for pose in true]
    poses = np.array([found.pose for found in fitted if found is not None])
    motion = RigidMotion(poses, np.tile(np.eye(6), (2, 1, 1)), np.zeros(2), np.full(2, 9), np.zeros(3))
    tracks: Any = SimpleNamespace(left=SimpleNamespace(position_px=at_first[None]))
    view: Any = SimpleNamespace(rig=rig, tracks=[tracks], phase_rotated=None)
    sight: Any = SimpleNamespace(pair=PAIR)
    corrected = with_surface_at_rest(StereoMotion(sight, motion, (), np.nan, view, ()), mean.pose).motion.pose
    size = np.repeat(np.abs(true[1]).reshape(2, 3).max(axis=1), 3)
    assert np.abs((poses[1] - true[1]) / size).max() > 5e-4
    np.testing.assert_allclose((corrected - true) / size, 0.0, atol=5e-5)


SURFACE_TEXT = """[stereo.top.surface]
point = [0.0, 0.0, 0.07]
normal = [0.0, 0.0, 1.0]
distance_uncertainty = 2e-4
tilt_uncertainty = 1e-3

[stereo.base]"""


def alone(*more: tuple[str, str, str]) -> tuple[tuple[str, str, str], ...]:
    return (("rig.toml", "[stereo.base]", SURFACE_TEXT), *more)


NO_RIGHT = ("recording.toml", 'right = "top-right/*.tif"\n', "")


def test_a_pair_with_a_surface_is_one_camera(make_campaign):
    manifest = load_manifest(make_campaign(replace=alone(NO_RIGHT)))
    (entry,) = manifest.images
    assert [side for side, _ in entry.cameras] == ["left"]
    assert manifest.rig.stereo["top"].surface.distance_uncertainty == 2e-4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((NO_RIGHT,), r"images\.top\.right: "),
        (alone(), r"images\.top\.right: "),
        (
            alone(NO_RIGHT, ("rig.toml", "point = [0.0, 0.0, 0.07]", "point = [0.0, 0.0, 2.0]")),
            r"rig\.toml: stereo\.top\.surface: .* -1\.\d+ m",
        ),
        (alone(NO_RIGHT, ("rig.toml", "distance_uncertainty = 2e-4\n", "")), r"surface\.distance_uncertainty"),
    ],
)
def test_what_one_camera_needs_is_told(make_campaign, changes, words):
    refused(words, load_manifest, make_campaign(replace=changes), error=InputError)


@pytest.mark.slow
def test_a_recording_before_one_camera_holds_the_truth_and_check_says_what_is_seen(tmp_path):
    recording = simulate(tmp_path / "single", "single", 5, image_scale=0.7)
    manifest = load_manifest(recording)
    told = [remark for remark in check(manifest).remarks if "top" in remark]
    assert told[0].startswith("stereo top ")
    single, combined = told[1].split(";")
    assert " z " in single
    assert " z " not in combined.partition(" laser")[0]
    evaluation = evaluate_recording(manifest)
    truth = complex_of(truth_of(recording)["acceleration"]["load"])[0]
    fused, seen = (
        next(a for a in evaluation.accelerations if (a.body, a.source) == ("load", source))
        for source in ("fused", "photogrammetry")
    )
    for found in (fused, seen):
        u = np.hypot(found.phasors.u_re[0], found.phasors.u_im[0])
        assert (np.abs(found.phasors.value[0] - truth) <= coverage_factor(float(found.phasors.dof[0])) * u).all()
    pair = next(pair for pair in evaluation.stereo if pair.name == "top")
    assert pair.epipolar is pair.deflection is pair.shapes is None
    assert look(recording).level == "good"
    page = render_report(evaluation)
    assert SINGLE_CAMERA_NOT_ASSESSED.code in page
    assert "stereo top: surface" in page
    assert "Epipolar residuals of top" not in page


@pytest.mark.parametrize(("off", "lost"), [(8e-4, 0), (-1.7e-3, 5)])
def test_the_motion_shows_the_rate_of_frames_without_a_trigger(off, lost):
    """120 frames at 60 Hz of a sine of 80 Hz, some of them lost: found to a fifth of a turn over the record."""
    time_s, true_s = np.arange(120) / 60.0, np.arange(120) / 60.0 / (1.0 + off)
    pose = np.zeros((120, 6))
    pose[:, 2] = 1e-5 * np.sin(2.0 * np.pi * 80.0 * true_s + 1.0) + 1e-6 * np.random.default_rng(1).normal(size=120)
    pose[3 : 3 + lost] = np.nan
    motion = RigidMotion(pose, np.tile(np.eye(6), (120, 1, 1)), np.zeros(120), np.full(120, 9), np.zeros(3))
    sight = SimpleNamespace(pair=PAIR, time_s=time_s)
    lines: Any = SimpleNamespace(frequency_hz=np.array([80.0]))
    measured = StereoMotion(sight, motion, (), np.nan, None, ())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clocks, "replace", lambda item, **new: SimpleNamespace(**(vars(item) | new)))
        found = clocks._at_near_rate(measured, lines)
    stretch = np.ptp(found.sight.time_s) / np.ptp(time_s)
    assert abs(stretch - 1.0 / (1.0 + off)) < clocks.RATE_STEP / (80.0 * np.ptp(time_s))


@pytest.mark.parametrize(
    ("true_hz", "stated_hz", "frames", "confirmed"),
    [
        (38.35, 38.35 * 1.002, 120, True),
        (38.35, 38.35 * 0.998, 40, True),
        (38.35, 39.0, 40, False),
        (38.35, 39.0, 120, False),
        (38.35, 37.7, 400, False),
        (38.35, 38.35 * 1.005, 120, False),
    ],
)
def test_a_frame_rate_that_the_motion_contradicts_is_refused(true_hz, stated_hz, frames, confirmed):
    """Frames of a sine of 80 Hz with 2 % of a second harmonic, at even instants of the true rate."""
    phase = 2.0 * np.pi * 80.0 * np.arange(frames) / true_hz
    pose = np.zeros((frames, 6))
    pose[:, 2] = 1e-5 * (np.sin(phase + 1.0) + 0.02 * np.sin(2.0 * phase))
    pose += 1e-7 * np.random.default_rng(2).normal(size=pose.shape)
    motion = RigidMotion(pose, np.tile(np.eye(6), (frames, 1, 1)), np.zeros(frames), np.full(frames, 9), np.zeros(3))
    fit = nominal_trigger(frames, 1.0 / stated_hz, np.diag([0.0, (U_FRAME_RATE / stated_hz) ** 2]))
    sight = Sight("top", PAIR, Exposure("film", 1e-4), fit.edge_s, 1.0, (Path(), ""), fit.number)
    lines: Any = SimpleNamespace(
        frequency_hz=np.array([80.0, 160.0]), nominal_hz=np.array([80.0, 80.0]), multiple=np.array([1, 2])
    )
    base = TimeBase((), {("daq", "film"): fit}, {"daq": None})
    manifest: Any = SimpleNamespace(path=Path("recording.toml"))
    entry: Any = SimpleNamespace(stereo="top", trigger="film", frame_rate=stated_hz)
    measured = StereoMotion(sight, motion, (), np.nan, None, ())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clocks, "_reference", lambda *_: (0.0, 0.0))
        if confirmed:
            found = clocks._with_frame_rate(manifest, base, entry, [measured], lines).triggers["daq", "film"]
            assert abs(found.period_s * true_hz - 1.0) < 2e-5
            return
        with pytest.raises(InputError) as error:
            clocks._with_frame_rate(manifest, base, entry, [measured], lines)
    assert (error.value.code, error.value.key) == (IMAGES_REFUSED.code, "images.top.frame_rate")


@pytest.mark.parametrize(
    ("trigger", "key"),
    [("frame_rate = 40.0", "first_edge"), ('trigger = "camera_trigger"\nframe_rate = 40.0', "trigger")],
)
def test_frames_without_a_trigger_count_no_edges(make_campaign, trigger, key):
    with pytest.raises(InputError) as error:
        load_manifest(make_campaign(replace=alone(NO_RIGHT, ("recording.toml", 'trigger = "camera_trigger"', trigger))))
    assert (error.value.code, error.value.key) == (KEY_NOT_APPLICABLE.code, f"images.top.{key}")
