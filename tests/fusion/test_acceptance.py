"""The command `shakercal accept`: a right rig passes, a wrong one fails and its fault is named."""

from __future__ import annotations

import csv
import json
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from contracts import slow
from page_outline import self_contained
from support import DOCS, RefusedCommand, documented_keys, examples, key_tables

from fusion.cameras.accept.acceptance_evaluation import evaluate_acceptance
from fusion.cameras.accept.acceptance_manifest import (
    AcceptanceTables,
    RotationBlock,
    StationaryBlock,
    Tolerances,
    TranslationBlock,
    read_acceptance,
)
from fusion.cameras.accept.acceptance_notices import LATE_FRAMES, LIKELY_FAULT, TEST_IMAGES, TOO_FEW_SUBSETS
from fusion.cameras.accept.acceptance_rows import AcceptanceRow
from fusion.cameras.accept.apparent_field import apparent_field
from fusion.cameras.accept.calibration_faults import MovedPlate, diagnose, plate_noise
from fusion.cameras.accept.moved_plate import measure_translation
from fusion.cameras.accept.tracked_test import TrackedTest
from fusion.cli import main
from fusion.recording.toml import to_toml
from fusion.simulate.acceptance import write_acceptance
from photogram.calibration.calibration_file import read_calibration, write_calibration
from photogram.camera import Camera, StereoRig, triangulate
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from shakercal._common.arrays import FloatArray

DOC = (DOCS / "acceptance.md").read_text(encoding="utf-8")
MOST_PRINTED = 25
NOISE_PX = 0.002
TRAVEL_M = 0.01

Faulty = Callable[[StereoRig], StereoRig]


def turned(rig: StereoRig, vector_rad: FloatArray) -> StereoRig:
    turn = RigidTransform(rotation_from_vector(vector_rad), np.zeros(3))
    return replace(rig, right_from_left=turn @ rig.right_from_left)


def with_matrix(camera: Camera, factor: float = 1.0, shift_px: tuple[float, float] = (0.0, 0.0)) -> Camera:
    matrix = camera.matrix.copy()
    matrix[:2, :2] *= factor
    matrix[:2, 2] += shift_px
    return replace(camera, matrix=matrix)


def stretched(rig: StereoRig, factor: float) -> StereoRig:
    moved = RigidTransform(rig.right_from_left.rotation, factor * rig.right_from_left.translation_m)
    return replace(rig, right_from_left=moved)


def undistorted(rig: StereoRig) -> StereoRig:
    return replace(
        rig,
        left=replace(rig.left, distortion=np.zeros(8)),
        right=replace(rig.right, distortion=np.zeros(8)),
    )


FAULTY: dict[str, tuple[Faulty, str]] = {
    "pose": (lambda rig: turned(rig, np.array([1e-4, -2e-4, 1e-4])), "pose"),
    "focal": (lambda rig: replace(rig, left=with_matrix(rig.left, 0.999)), "focal"),
    "principal": (lambda rig: replace(rig, right=with_matrix(rig.right, 1.0, (4.0, -3.0))), "principal_right"),
    "distortion": (undistorted, "distortion"),
    "scale": (lambda rig: stretched(rig, 0.998), "scale"),
}
"""Calibrations that are wrong in one way, and the name of the fault."""


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("acceptance")
    write_acceptance(folder, 1, frames=32)
    return folder


@pytest.fixture
def rewritten(simulated: Path, tmp_path: Path) -> Callable[..., Path]:
    """Copy the simulated tests with other tables and another calibration."""

    def write(fault: Faulty | None = None, **changes: Any) -> Path:
        folder = tmp_path / "test"
        shutil.copytree(simulated, folder, ignore=shutil.ignore_patterns("accept"))
        path = folder / "acceptance.toml"
        tables = tomllib.loads(path.read_text(encoding="utf-8")) | changes
        path.write_text(to_toml({key: value for key, value in tables.items() if value is not None}), encoding="utf-8")
        if fault is not None:
            calibration = folder / "calibration.json"
            write_calibration(calibration, fault(read_calibration(calibration)), 0.02)
        return folder

    return write


# Whole command.


def test_a_right_rig_passes(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "out"
    assert main(["accept", str(simulated), "-o", str(output), "-q"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) <= MOST_PRINTED
    assert "verdict: PASS" in printed
    with (output / "acceptance.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["verdict"] for row in rows} == {"PASS"}
    stored = json.loads((output / "acceptance.json").read_text(encoding="utf-8"))
    assert stored["verdict"] == "PASS"
    assert [row["value"] for row in stored["rows"]] == pytest.approx([float(row["value"]) for row in rows])
    page = self_contained((output / "acceptance.html").read_text(encoding="utf-8"))
    assert "stationary" in page.ids
    truth = json.loads((simulated / "truth.json").read_text(encoding="utf-8"))
    by_name = {(row["test"], row["quantity"]): row for row in rows}
    angle = by_name["rotation sine bar", "angle"]
    assert abs(float(angle["value"]) - (truth["turned_rad"] / 0.010 - 1.0)) <= float(angle["U"])


@pytest.mark.parametrize("case", [next(iter(FAULTY)), *slow(*list(FAULTY)[1:])])
def test_a_wrong_calibration_fails_and_is_named(
    case: str, rewritten: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    fault, name = FAULTY[case]
    folder = rewritten(fault, stationary=None, rotation=None)
    assert main(["accept", str(folder), "-q"]) == 1
    printed = capsys.readouterr().out.splitlines()
    assert "verdict: FAIL" in printed
    assert len(printed) <= MOST_PRINTED
    stored = json.loads((folder / "accept/acceptance.json").read_text(encoding="utf-8"))
    assert LIKELY_FAULT.code in [notice["code"] for notice in stored["notices"]]
    assert stored["faults"][0]["fault"] == name


def test_a_late_camera_is_named(rewritten: Callable[..., Path]) -> None:
    folder = rewritten(stationary=None, rotation=None)
    late = sorted((folder / "x").glob("right-*.png"))
    for number in range(len(late) - 1, 0, -1):
        shutil.copyfile(late[number - 1], late[number])
    own = cv2.imread(str(late[0]), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(late[0]), own ^ np.uint8(1))
    evaluation = evaluate_acceptance(read_acceptance(folder), {})
    assert evaluation.verdict == "FAIL"
    (notice,) = [notice for notice in evaluation.notices if notice.code == LATE_FRAMES.code]
    assert (notice.values["camera"], notice.values["frames"]) == ("right", 1)


REFUSED = {
    "no test": ({"stationary": None, "translation": None, "rotation": None}, "acceptance.toml: expected at least one"),
    "count": ({"positions": [0.0, 1e-3]}, "translation.x.positions: expected 10 numbers"),
    "missing": ({"left": "none-*.png"}, "translation.x.left: expected at least one file"),
    "unequal": ({"left": "x/left-00[0-4].png", "positions": None}, "translation.x.right: expected 5 images"),
    "text": ({"position_uncertainty": "1 um"}, "translation.x.position_uncertainty"),
    "equal": ({"positions": [0.0] * 10}, "translation.x.positions: expected at least two different"),
    "unknown": ({"position": [0.0]}, "translation.x.position"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_input_is_one_sentence(case: str, rewritten: Callable[..., Path], refused: RefusedCommand) -> None:
    changes, expected = REFUSED[case]
    folder = rewritten(stationary=None, rotation=None)
    path = folder / "acceptance.toml"
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    if "translation" in changes:
        tables |= changes
    else:
        tables["translation"][0] |= changes
        tables["translation"][0] = {key: item for key, item in tables["translation"][0].items() if item is not None}
    path.write_text(to_toml({key: value for key, value in tables.items() if value is not None}), encoding="utf-8")
    sentence = refused("accept", folder, "-q")
    assert expected in sentence.replace(str(folder), "")
    assert not (folder / "accept").exists()


def test_images_of_another_size_and_a_small_region_are_refused(
    rewritten: Callable[..., Path], refused: RefusedCommand
) -> None:
    folder = rewritten(region=[120, 110, 120, 80], stationary=None, rotation=None)
    assert TOO_FEW_SUBSETS.code in refused("accept", folder, "-q")
    first = folder / "x/left-000.png"
    cv2.imwrite(str(first), cv2.imread(str(first), cv2.IMREAD_GRAYSCALE)[:300])
    assert "translation.x.left" in refused("accept", folder, "-q")
    for path in (folder / "x").glob("left-*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[:300])
    assert TEST_IMAGES.code in refused("accept", folder, "-q")


@pytest.mark.parametrize(
    ("test", "noisy"),
    [("stationary", False), ("translation", False), ("rotation", False), ("translation", True), ("rotation", True)],
)
def test_the_same_image_in_all_frames_is_refused(
    test: str, noisy: bool, rewritten: Callable[..., Path], refused: RefusedCommand
) -> None:
    others = {"stationary", "translation", "rotation"} - {test}
    folder, rng = rewritten(**dict.fromkeys(others)), np.random.default_rng(0)
    images = folder / {"stationary": "rest", "translation": "x", "rotation": "turned"}[test]
    for side in ("left", "right"):
        first, *later = sorted(images.glob(f"{side}-*.png"))
        grey = cv2.imread(str(first), cv2.IMREAD_GRAYSCALE)
        for path in later:
            cv2.imwrite(str(path), grey - (grey > 9) * rng.integers(0, 3 if noisy else 1, grey.shape, np.uint8))
    sentence = refused("accept", folder, "-q")
    assert TEST_IMAGES.code in sentence
    assert f"{test}." in sentence
    assert not (folder / "accept").exists()


def test_half_a_late_frame_is_refused(tmp_path: Path, refused: RefusedCommand) -> None:
    assert "late-frame" in refused(
        "simulate", tmp_path / "new", "--preset", "acceptance", "--violate", "late-frame=0.5"
    )


@pytest.mark.parametrize("truth", [b"{", b"\xff", b"3", b'{"files": 5}', b'{"files": [5, "\\u0000"]}', b"[]"])
def test_a_damaged_truth_is_no_earlier_simulation(truth: bytes, tmp_path: Path, refused: RefusedCommand) -> None:
    (tmp_path / "truth.json").write_bytes(truth)
    refused("simulate", tmp_path, "--preset", "acceptance", "--force")
    assert (tmp_path / "truth.json").read_bytes() == truth


# Parts, against closed forms and OpenCV's projection.


def test_u_counts_against_pass_and_fail() -> None:
    def verdict(value: float) -> str:
        return AcceptanceRow("test", "name", "label", value, 0.5, 3.0, "1").verdict

    assert [verdict(value) for value in (1.9, -1.9, 2.5, 3.5, 4.1, -4.1)] == [
        *["PASS"] * 2,
        *["UNDECIDED"] * 2,
        *["FAIL"] * 2,
    ]


def test_the_field_of_an_affine_motion_is_found() -> None:
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 12), np.linspace(-0.02, 0.02, 9))
    axes = rotation_from_vector(np.array([0.1, 0.3, 0.0]))
    plate = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    rotation, strain = np.array([2e-3, -1e-3, 3e-3]), np.array([[4e-3, 1e-3, 0], [1e-3, -2e-3, 0], [0, 0, 0]])
    rate = np.array([0.6, 0.1, -0.7]) + np.cross(rotation, plate) + plate @ strain
    along = np.array([0.0, 1e-3, 4e-3, 2e-3])
    noise = 1e-9 * rng.standard_normal((4, len(plate), 3))
    start = plate @ axes.T + [0.0, 0.0, 0.5]
    field = apparent_field(start, along[:, None, None] * (rate @ axes.T) + noise, along)
    back = field.axes.T @ axes  # from the axes of the plate to those found
    u = 4.0 * np.sqrt(np.diagonal(field.covariance))
    assert np.abs(field.rates[:3] - back @ [0.6, 0.1, -0.7]).max() < u[:3].max()
    assert np.abs(field.rates[3:6] - back @ rotation).max() < u[3:6].max()
    tensor = back @ strain @ back.T
    assert np.abs(field.rates[6:] - [tensor[0, 0], tensor[1, 1], tensor[0, 1]]).max() < u[6:].max()
    assert np.abs(field.strain[0] - np.linalg.eigvalsh(strain).max()) < u[6:].max()


def projected(rig: StereoRig, points_m: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return noisy pixels (N, 2) of points in both cameras by OpenCV."""
    right = rig.right_from_left
    pixels = []
    for camera, vector, shift in (
        (rig.left, np.zeros(3), np.zeros(3)),
        (rig.right, vector_from_rotation(right.rotation), right.translation_m),
    ):
        seen, _ = cv2.projectPoints(points_m, vector, shift, camera.matrix, camera.distortion)
        pixels.append(seen[:, 0] + NOISE_PX * rng.standard_normal((len(points_m), 2)))
    return pixels[0], pixels[1]


@pytest.mark.parametrize("case", [*FAULTY, "none"])
def test_faults_are_named_from_points(case: str, simulated: Path) -> None:
    rig = read_calibration(simulated / "calibration.json")
    fault, name = FAULTY.get(case, (lambda right: right, ""))
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 15), np.linspace(-0.024, 0.024, 12))
    plate = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.48)], axis=1)
    plates = []
    for direction in ([1.0, 0.0, 0.0], [0.2, 0.0, 1.0]):
        unit = np.array(direction) / np.linalg.norm(direction)
        ends = [projected(rig, plate + share * TRAVEL_M * unit, rng) for share in (-0.5, 0.5)]
        left, right = (np.stack(side) for side in zip(*ends, strict=True))
        wrong = fault(rig)
        plates.append(MovedPlate(left, right, TRAVEL_M, 3e-5, 1e-5, plate_noise(wrong, left, right, TRAVEL_M)))
    found = diagnose(fault(rig), plates)
    assert found.is_significant == bool(name)
    if name:
        assert found.best.kind.name == name
        assert found.explains
    if case == "pose":
        assert np.abs(found.best.value - [-1e-4, 2e-4, -1e-4]).max() < 4.0 * found.best.u.max()
    if case == "scale":
        assert found.best.value == pytest.approx([1.0 / 0.998 - 1.0], abs=4.0 * float(found.best.u[0]))


def test_a_published_rig_is_to_scale_but_off_its_epipolar_lines(data_dir: Path) -> None:
    """DuoDIC's translation test: published mean error 1.3 µm; its calibration states no uncertainty."""
    folder = data_dir / "duodic_rigid"
    stored, rig = np.load(folder / "matched_points.npz"), read_calibration(folder / "calibration.json")
    left, right = (stored[side].astype(np.float64) for side in ("left", "right"))
    finite = np.isfinite(triangulate(rig, left, right).position_m).all(axis=(0, 2))
    left, right = left[:, finite], right[:, finite]
    noise = 0.01**2 * np.eye(2)
    points = triangulate(rig, left, right, noise, noise)
    place = points.position_m[0]
    pixel_m = float(np.median(place[:, 2])) / float(rig.left.matrix[0, 0])
    tracked = TrackedTest(left, right, points, place.mean(axis=0), pixel_m, 10)
    block = TranslationBlock.model_construct(
        name="stage",
        left=(),
        right=(),
        positions=tuple(stored["stage_translation_m"].tolist()),
        position_uncertainty=1e-6,
        scale_uncertainty=5e-5,
        rotation_uncertainty=2e-5,
        straightness_uncertainty=1e-6,
    )
    test = measure_translation(rig, block, tracked, Tolerances())
    rows = {row.name: row for row in test.rows}
    assert abs(rows["scale"].value) < rows["scale"].expanded
    assert rows["position"].value < 5e-6
    assert rows["strain"].verdict == "PASS"
    assert rows["epipolar"].verdict == "FAIL"
    assert 0.1 < rows["epipolar"].value < 0.15
    assert test.late is None  # equal steps


# Documents.


def test_every_key_is_documented() -> None:
    models = {
        "Top level": AcceptanceTables,
        "`[stationary]`": StationaryBlock,
        "`[[translation]]`": TranslationBlock,
        "`[[rotation]]`": RotationBlock,
    }
    tables = key_tables(DOC.partition("## Every key")[2].partition("\n## ")[0])
    tolerances = tables.pop("`[tolerance]`")
    assert tables == documented_keys(models)
    assert tolerances == documented_keys({"": Tolerances})[""]


def test_the_example_of_the_document_is_valid() -> None:
    (shown,) = examples(DOC)
    given = tomllib.loads(shown)
    assert set(given) <= set(AcceptanceTables.model_fields)
    for block in given["translation"]:
        assert set(block) <= set(TranslationBlock.model_fields)


# Statistics.


@pytest.mark.slow
def test_rendered_faults_fail_and_right_rigs_pass(tmp_path: Path) -> None:
    """Nine of ten faulty rigs fail and their fault is named; 19 of 20 right rigs pass (benchmarks/acceptance.py)."""
    cases = {
        "camera-turned=2e-4": {"pose"},
        "focal-length": {"focal"},
        "principal-point": {"principal_left", "principal_right"},
        "target-spacing": {"scale"},
        "no-distortion": {"distortion"},
    }
    for case, names in cases.items():
        named = 0
        for seed in range(1, 11):
            folder = tmp_path / f"{case}-{seed}"
            write_acceptance(folder, seed, violate=(case,), frames=32)
            evaluation = evaluate_acceptance(read_acceptance(folder), {})
            assert evaluation.diagnosis is not None
            found = evaluation.diagnosis
            named += found.best.kind.name in names and evaluation.verdict == "FAIL"
            shutil.rmtree(folder)
        assert named >= 9, case
    failed = 0
    for seed in range(1, 21):
        folder = tmp_path / f"right-{seed}"
        write_acceptance(folder, seed)
        failed += evaluate_acceptance(read_acceptance(folder), {}).verdict != "PASS"
        shutil.rmtree(folder)
    assert failed <= 1


@pytest.mark.slow
def test_a_vibration_is_named(tmp_path: Path) -> None:
    write_acceptance(tmp_path, 1, violate=("vibration",))
    evaluation = evaluate_acceptance(read_acceptance(tmp_path), {})
    (row,) = [row for row in evaluation.rows if row.name == "vibration"]
    assert row.verdict == "FAIL"
    assert evaluation.stationary is not None
    assert np.abs(evaluation.stationary.lines.frequency_hz - 12.0).min() < 0.1
    assert row.value == pytest.approx(1e-5, rel=0.05)
