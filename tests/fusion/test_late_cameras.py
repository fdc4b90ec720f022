"""Frames of cameras that belong to other edges: late, lost and repeated ones, by positions and by rendered images."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import late_cameras
import numpy as np
import pytest
from contracts import refused, slow
from late_cameras import Rendering, dropped, rendering, repeated, shifted, with_edges

from fusion import evaluate_recording, look
from fusion.errors import ComputeError, InputError
from fusion.phasors.frame_order import check_frame_order
from fusion.phasors.phasor_notices import (
    CAMERA_DELAYED,
    CAMERAS_OUT_OF_STEP,
    FRAMES_OF_OTHER_EDGES,
    FRAMES_OUT_OF_ORDER,
    PAIR_REJECTED,
    ROWS_INTERLACED,
)
from fusion.phasors.stereo_motion import RejectedPair, StereoMotion
from fusion.sensitivity.analyse import Evaluation
from photogram.camera import Camera, FaceCamera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.images.rows import parity_displacement, rows_repeat

FREQUENCY_HZ, PERIOD_S, NOISE_PX = 80.0, 0.0261, 2e-3
CAMERA = Camera.from_parameters(np.array([2000.0, 2000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
RIG = StereoRig(
    CAMERA, CAMERA, RigidTransform(rotation_from_vector(np.array([0.0, 0.3, 0.02])), np.array([-0.15, 0.002, 0.03]))
)
MIDDLE = np.array([0.0, 0.0, 0.5])  # of the body, from the left camera
ACROSS, ALONG = np.array([5e-6, 3e-5 * np.exp(0.7j), 1e-5j]), np.array([3e-5 + 0j, 0.0, 0.0])
Change = Callable[[list[int]], list[int]]


def tracked(
    changes: dict[str, Change] | None = None,
    *,
    frames: int = 24,
    late_s: float = 0.0,
    motion_m: np.ndarray = ACROSS,
    drift: complex = 0.0,
    frequency_hz: Sequence[float] = (FREQUENCY_HZ,),
    seed: int = 1,
    subset_frames: np.ndarray | None = None,
    cameras: int = 2,
) -> StereoMotion:
    """A pair that tracked 60 points of a body; `changes` of the edges that a camera shows, the right one late.

    Each line has the motion of `motion_m` (3,) and an eighth turn more than the line before; by the end of the record
    it has grown by the share `drift`.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.04, 0.04, (60, 3)) * [1.0, 1.0, 0.3]
    first = list(range(6, 6 + frames))
    sides, joint = [], np.zeros((frames, 6))
    for side, from_left, delay_s in (("left", RigidTransform.identity(), 0.0), ("right", RIG.right_from_left, late_s)):
        edges = np.array((changes or {}).get(side, lambda same: same)(first))
        moved = np.zeros((frames, 3))
        for k, frequency in enumerate(frequency_hz):
            turn = np.exp(2j * np.pi * (frequency * (PERIOD_S * edges - delay_s) + k / 8))
            turn *= 1.0 + drift * (edges - edges[0]) / frames
            moved += np.real(turn[:, None] * motion_m)
        positions = np.array([CAMERA.project(from_left.apply(points + MIDDLE + step)) for step in moved])
        sides.append(positions + NOISE_PX * rng.normal(size=positions.shape) / np.sqrt(2.0))
        joint[:, :3] += 0.5 * (moved - moved[0])
    some = np.ones(frames, dtype=np.bool_) if subset_frames is None else subset_frames
    rig = RIG if cameras == 2 else FaceCamera(CAMERA, MIDDLE, np.array([0.0, 0.0, -1.0]), np.eye(16))
    blocks = [SimpleNamespace(cameras=[SimpleNamespace(position_px=one[some]) for one in sides[:cameras]])]
    pair = SimpleNamespace(body="load", rotation=np.eye(3), translation=-MIDDLE, row_time=(0.0, 0.0))
    sight = SimpleNamespace(name="top", pair=pair, time_s=PERIOD_S * np.array(first), edge=np.array(first), files=())
    view = SimpleNamespace(tracks=blocks, rig=rig)
    motion = SimpleNamespace(pose=joint)
    return StereoMotion(sight, motion, (), 0.0, view, (), None if subset_frames is None else some)  # type: ignore[arg-type]


def checked(measured: StereoMotion, frequency_hz: Sequence[float] = (FREQUENCY_HZ,)) -> StereoMotion | ComputeError:
    found = check_frame_order(measured, np.array(frequency_hz))
    if isinstance(found, RejectedPair):
        assert isinstance(found.error, ComputeError)
        return found.error
    return found


@pytest.mark.parametrize("motion", [ACROSS, ALONG, 1e-9 * ACROSS], ids=["across", "along", "still"])
def test_cameras_in_step_are_not_doubted(motion):
    for seed in range(10):
        assert checked(tracked(motion_m=motion, seed=seed)).notices == ()


@pytest.mark.parametrize(("late_s", "side"), [(60e-6, "right"), (-200e-6, "left")])
@pytest.mark.parametrize("motion", [ACROSS, ALONG], ids=["across", "along"])
def test_a_lag_is_measured_within_its_uncertainty(late_s, side, motion):
    (notice,) = checked(tracked(late_s=late_s, motion_m=motion)).notices
    assert (notice.code, notice.values["late"]) == (CAMERA_DELAYED.code, side)
    lag_us, u_mrad = notice.values["delay_us"], notice.values["u_mrad"]
    assert abs(1e-6 * lag_us - abs(late_s)) < 3e-3 * u_mrad / (2 * np.pi * FREQUENCY_HZ)
    assert u_mrad < 5.0


@pytest.mark.parametrize(("count", "side"), [(1, "right"), (-1, "left"), (3, "right"), (-2, "left")])
@pytest.mark.parametrize("motion", [ACROSS, *slow(ALONG)], ids=["across", "along"])
def test_whole_frames_are_named_with_both_keys(count, side, motion):
    error = checked(tracked({"right": shifted(count)}, motion_m=motion))
    assert (error.code, error.values["late"]) == (CAMERAS_OUT_OF_STEP.code, side)
    assert error.values["frames"] == abs(count)
    assert error.values["delay_ms"] == pytest.approx(1e3 * abs(count) * PERIOD_S)
    keys = f"first_edge = {{ left = 6, right = {6 - count} }} or first_edge = {{ left = {6 + count}, right = 6 }}"
    assert error.values["stated"] == keys


WITHIN = {
    "lost left": ({"left": dropped(13)}, "{ left = [[0, 6], [13, 20]], right = 6 }"),
    "repeated": ({"left": repeated(7)}, "{ left = [[0, 6], [7, 12]], right = 6 }"),
    "lost in both": ({side: dropped(13) for side in late_cameras.SIDES}, "[[0, 6], [13, 20]]"),
    "lost in each": (
        {"left": dropped(5), "right": dropped(13)},
        "{ left = [[0, 6], [5, 12]], right = [[0, 6], [13, 20]] }",
    ),
    "counts equal": (
        {"left": lambda edges: dropped(16)(repeated(7)(edges))},
        "{ left = [[0, 6], [7, 12], [16, 22]], right = 6 }",
    ),
    "two lost right": ({"right": dropped(9, 2)}, "{ left = 6, right = [[0, 6], [9, 17]] }"),
    "lost before the last": ({"right": dropped(23)}, "{ left = 6, right = [[0, 6], [23, 30]] }"),
}


@pytest.mark.parametrize("name", [*list(WITHIN)[:4], *slow(*list(WITHIN)[4:])])
def test_frames_lost_and_repeated_within_the_record_are_named_with_their_key(name):
    changes, key = WITHIN[name]
    error = checked(tracked(changes))
    assert (error.code, error.values["stated"]) == (FRAMES_OUT_OF_ORDER.code, f"first_edge = {key}")


@pytest.mark.parametrize(
    ("change", "event"),
    [
        (dropped(9, 2), "lost 2 frames before frame 9 (then 2 frames ahead)"),
        (repeated(7), "repeated 1 frame before frame 7 (then 1 frame behind)"),
    ],
)
def test_the_camera_and_what_its_recorder_did_are_named(change, event):
    assert checked(tracked({"right": change})).values["changes"] == f"the right camera {event}"


def test_a_late_camera_that_loses_a_frame_has_both_in_its_key():
    error = checked(tracked({"right": lambda edges: dropped(13)(shifted(2)(edges))}))
    assert error.values["stated"].startswith("first_edge = { left = 6, right = [[0, 4], [13, 18]] } or ")


def test_a_frame_lost_by_a_single_camera_is_named():
    error = checked(tracked({"left": dropped(13)}, cameras=1))
    assert error.values["stated"] == "first_edge = [[0, 6], [13, 20]]"


def test_a_change_between_frames_with_subsets_is_where_the_grey_values_show_it():
    some = np.arange(96) % 5 == 0
    error = checked(tracked({"right": dropped(52)}, frames=96, subset_frames=some))
    assert error.values["stated"] == "first_edge = { left = 6, right = [[0, 6], [52, 59]] }"


@pytest.mark.parametrize("drift", [0.5j, -0.3, 0.2 - 0.6j])
@pytest.mark.parametrize("beat", [0.03, *slow(0.088, 0.41)])
def test_a_motion_that_changes_over_the_record_is_no_loss_of_frames(drift, beat):
    frequency = [(2.0 + beat) / PERIOD_S]
    assert isinstance(checked(tracked(drift=drift, frequency_hz=frequency), frequency), StereoMotion)


def test_shifts_that_look_the_same_are_mentioned():
    error = checked(tracked({"right": shifted(1)}, frequency_hz=[0.25 / PERIOD_S]), [0.25 / PERIOD_S])
    assert "4 frames more or less" in error.values["alike"]
    assert not checked(tracked({"right": shifted(1)})).values["alike"]


def test_two_lines_tell_frames_apart_that_one_cannot():
    lines = [0.25 / PERIOD_S, 0.1 / PERIOD_S]
    error = checked(tracked({"right": shifted(-3)}, frequency_hz=lines), lines)
    assert (error.values["late"], error.values["frames"]) == ("left", 3)


def test_rows_of_noise_differ_and_those_of_one_field_do_not():
    grey = np.random.default_rng(1).normal(400.0, 30.0, (120, 80))
    doubled, between = np.repeat(grey, 2, axis=0), np.repeat(grey, 2, axis=0)
    between[1:-1:2] = np.rint(0.5 * (between[0:-2:2] + between[2::2]))
    assert [rows_repeat(one) for one in (grey, doubled, between, np.zeros((64, 64)))] == [False, True, True, False]


def test_rows_that_moved_further_are_measured_and_columns_are_the_control():
    y, x = np.mgrid[:120.0, :120.0]

    def pattern(right: float) -> np.ndarray:
        return 400.0 + 100.0 * np.sin(0.5 * (x - right) + 0.2 * y) * np.cos(0.37 * y - 0.1 * (x - right))

    later = pattern(2.3)
    later[1::2] = pattern(2.4)[1::2]
    rows, columns = parity_displacement(pattern(0.0), later, np.array([2.3, 0.0]))
    assert rows == pytest.approx([0.1, 0.0], abs=1e-2)
    assert columns == pytest.approx([0.0, 0.0], abs=5e-3)


# Rendered recordings.


def evaluated(folder: Path, one: Rendering) -> Evaluation:
    return evaluate_recording(late_cameras.write(folder, one))


def stated(run: Path, key: str) -> None:
    """State another key in the manifest in place of `first_edge`, the first of two alternatives."""
    path = run / "recording.toml"
    path.write_text(
        re.sub("first_edge = .*", key.split(" or ", maxsplit=1)[0], path.read_text(encoding="utf-8")), encoding="utf-8"
    )


def load_z(evaluation: Evaluation) -> tuple[complex, float]:
    """The load's fused acceleration along z, and its u."""
    phasors = next(a for a in evaluation.accelerations if (a.body, a.source) == ("load", "fused")).phasors
    return complex(phasors.value[0, 2]), float(np.hypot(phasors.u_re[0, 2], phasors.u_im[0, 2]))


def codes(evaluation: Evaluation) -> set[str]:
    return {notice.code for notice in evaluation.notices}


def test_a_lost_frame_of_one_camera_is_named_and_its_key_restores_the_result(tmp_path):
    plain = rendering(lasers=False)
    right, u = load_z(evaluated(tmp_path / "plain", plain))
    run = late_cameras.write(tmp_path / "lost", with_edges(plain, "top", {"right": dropped(11)}))
    error = refused("first_edge", evaluate_recording, run, error=ComputeError)
    assert (error.code, error.values["stated"]) == (
        FRAMES_OUT_OF_ORDER.code,
        "first_edge = { left = 6, right = [[0, 6], [11, 18]] }",
    )
    stated(run, error.values["stated"])
    found, u_found = load_z(evaluate_recording(run))
    assert abs(found - right) < 2.0 * np.hypot(u, u_found)


def test_a_repeated_frame_in_the_middle_is_named_as_copy_and_shift(tmp_path):
    run = late_cameras.write(tmp_path, with_edges(rendering(), "top", {"left": repeated(7)}))
    evaluation = evaluate_recording(run)
    (notice,) = (notice for notice in evaluation.notices if notice.code == PAIR_REJECTED.code)
    assert "left = [[0, 6], [7, 12]]" in notice.text
    assert any("left = [[0, 6], [7, 12]]" in finding.text for finding in look(run).findings)


@pytest.mark.parametrize(("late", "key"), [(1, "first_edge = 5"), *slow((-2, "first_edge = 8"))])
def test_a_pair_late_as_a_whole_is_named_by_the_phase_of_the_laser(tmp_path, late, key):
    run = late_cameras.write(
        tmp_path, with_edges(rendering(), "top", {side: shifted(late) for side in late_cameras.SIDES})
    )
    (notice,) = (n for n in evaluate_recording(run).notices if n.code == FRAMES_OF_OTHER_EDGES.code)
    assert (notice.values["stated"], notice.values["count"]) == (key, abs(late))
    stated(run, key)
    evaluation = evaluate_recording(run)
    assert FRAMES_OF_OTHER_EDGES.code not in codes(evaluation)
    assert load_z(evaluation)[0] == pytest.approx(82.0 * np.exp(0.74j), rel=1e-2)


def test_of_two_keys_for_a_late_camera_the_laser_shows_the_wrong_one(tmp_path):
    run = late_cameras.write(tmp_path, with_edges(rendering(), "top", {"left": shifted(1)}))
    stated(run, "first_edge = { left = 6, right = 7 }")
    (notice,) = (n for n in evaluate_recording(run).notices if n.code == FRAMES_OF_OTHER_EDGES.code)
    assert notice.values["stated"] == "first_edge = { left = 5, right = 6 }"


def test_interlaced_rows_are_named_and_those_of_one_field_too(tmp_path):
    error = refused("SC-517", evaluated, tmp_path / "rows", rendering(lasers=False, rows_late=0.5), error=ComputeError)
    assert error.code == ROWS_INTERLACED.code

    def field(pair: str, side: str, images: list[np.ndarray]) -> list[np.ndarray]:
        return [np.repeat(image[::2], 2, axis=0) for image in images]

    refused("top.left: .*every other row", evaluated, tmp_path / "field", rendering(change=field), error=InputError)
    assert not codes(evaluated(tmp_path / "plain", rendering())) & {PAIR_REJECTED.code, CAMERA_DELAYED.code}


def test_cameras_of_unequal_numbers_of_files_are_paired_by_their_edges(tmp_path):
    one = with_edges(rendering(lasers=False), "top", {"right": lambda edges: edges[2:-1]})
    run = late_cameras.write(tmp_path, one)
    refused("24 left and 21 right", evaluate_recording, run, error=InputError)
    stated(run, "first_edge = { left = 6, right = 8 }")
    evaluation = evaluate_recording(run)
    assert len(evaluation.stereo[0].time_s) == 21
    value, u = load_z(evaluation)
    assert abs(value - 82.0 * np.exp(0.74j)) < 3.0 * u


def test_a_file_that_one_camera_lacks_leaves_the_frames_of_both(tmp_path):
    run = late_cameras.write(tmp_path, rendering(lasers=False))
    (run / "top-right" / "0010.png").unlink()
    (run / "top-left" / "0015.png").unlink()
    refused("missing 0015 and right: .* missing 0010", evaluate_recording, run, error=InputError)
    stated(run, "first_edge = { left = 6, right = 6 }")
    edges = np.round((evaluate_recording(run).stereo[0].time_s - 0.02) * Rendering.rate_hz)
    np.testing.assert_array_equal(edges, np.delete(np.arange(6, 30), [10, 15]))


@pytest.mark.slow
def test_late_lost_and_repeated_frames_are_named_rightly_in_20_of_20(tmp_path):
    rng = np.random.default_rng(20)
    for number in range(20):
        pair, side = ("top", "base")[number % 2], late_cameras.SIDES[number // 2 % 2]
        beat = float(rng.choice([0.06, 0.0865, 0.13, 0.21, 0.29, 0.37, 0.46]))
        plain = rendering(pairs=("top", "base"), lasers=False, rate_hz=80.0003 / (2.0 + beat), seed=number)
        at, count = int(rng.integers(2, 22)), int(rng.choice([-2, -1, 1, 2]))
        kind = number // 4 % 5
        change, key = (
            (shifted(count), f"{side} = {6 - count}"),
            (shifted(-count), f"{side} = {6 + count}"),
            (dropped(at), f"{side} = [[0, 6], [{at}, {at + 7}]]"),
            (repeated(at), f"{side} = [[0, 6], [{at}, {at + 5}]]"),
            (dropped(at, 2), f"{side} = [[0, 6], [{at}, {at + 8}]]"),
        )[kind]
        run = late_cameras.write(tmp_path / f"{number}", with_edges(plain, pair, {side: change}))
        (notice,) = (n for n in evaluate_recording(run).notices if n.code == PAIR_REJECTED.code)
        assert notice.where == f"stereo pair {pair}"
        assert key in notice.text, (number, beat, key, notice.text)
