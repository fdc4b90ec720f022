"""What image files state, as a recording and its check use it: numbers of frames, orientation, black images."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from cine_factory import write_cine
from contracts import refused

from fusion.base import Settings, no_progress
from fusion.cli import main
from fusion.errors import InputError
from fusion.phasors.stereo_motion import PreparedImages, prepare_images
from fusion.phasors.timing import tie_daqs
from fusion.phasors.tracked_blocks import measure_images
from fusion.planning.check import check
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import load_manifest
from photogram.images.image_notices import ORIENTATION_NOT_APPLIED

FRAMES = 24
Named = Callable[[int], str | None]
BOTH = ("left", "right")


@pytest.fixture
def run(tmp_path: Path, demo_recording: Path) -> Path:
    """The demo's recording with one stereo pair, at hand to be changed."""
    shutil.copytree(demo_recording, tmp_path / "demo")
    folder = tmp_path / "demo" / "Fz-0080"
    text = (folder / "recording.toml").read_text(encoding="utf-8")
    (folder / "recording.toml").write_text(
        re.sub(r'\[\[images\]\]\nstereo = "base".*?(?=\n\[\[|\Z)', "", text, flags=re.S)
    )
    return folder


def renamed(run: Path, name: Named, sides: tuple[str, ...] = BOTH) -> None:
    """Give the frames of the pair new names; what has none is lost."""
    for side in sides:
        files = sorted((run / f"top-{side}").glob("*.tif"))
        moved = [file.rename(file.with_name(f"old-{file.name}")) for file in files]
        for number, file in enumerate(moved):
            new = name(number)
            file.unlink() if new is None else file.rename(file.with_name(new))


def stated(run: Path, line: str) -> None:
    """Add a line to the images of the pair."""
    path = run / "recording.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('stereo = "top"\n', f'stereo = "top"\n{line}\n', 1), encoding="utf-8")


def opened(run: Path) -> PreparedImages:
    manifest = load_manifest(run)
    return prepare_images(manifest, tie_daqs(manifest, read_daqs(manifest)), manifest.images[0])


@pytest.fixture(scope="module")
def whole(demo_recording: Path) -> PreparedImages:
    return opened(demo_recording / "Fz-0080")


def told(images: PreparedImages) -> str:
    return " | ".join(notice.text for notice in images.notices)


@pytest.mark.parametrize(
    ("name", "edges", "words"),
    [
        (lambda k: f"{k}.tif", range(FRAMES), ""),
        (lambda k: f"f{1000 + k}.tif" if k not in (2, 9) else None, {*range(FRAMES)} - {2, 9}, "1002, 1009"),
        (lambda k: f"f{5 * k:04d}.tif", range(FRAMES), ""),
        (lambda k: f"f{5 * k:04d}.tif" if k != 7 else None, {*range(FRAMES)} - {7}, "0035"),
        (lambda k: f"{10**9 + 26 * k + k % 3}.tif" if k != 7 else None, {*range(FRAMES)} - {7}, "1 between"),
    ],
)
def test_frames_are_exposed_by_the_edge_of_their_number(run, whole, name, edges, words):
    """The demo has as many edges as frames; the instants are those of the whole series."""
    renamed(run, name)
    images = opened(run)
    assert images.sight.edge.tolist() == sorted(edges)
    np.testing.assert_array_equal(images.sight.time_s, whole.sight.time_s[sorted(edges)])
    assert (words in told(images)) if words else not told(images)


def test_numbers_that_contradict_the_edges_or_each_other_are_refused(run):
    renamed(run, lambda k: f"{k if k < 12 else k + 3:04d}.tif")
    refused("top.trigger: .*0012 to 0014", opened, run, error=InputError)
    renamed(run, lambda k: f"{k:04d}.tif" if k != 4 else None, ("left",))
    renamed(run, lambda k: f"{k:04d}.tif" if k != 6 else None, ("right",))
    refused("top.right: .*0004.*0006", opened, run, error=InputError)


def test_a_camera_that_begins_with_another_number_is_named(run):
    renamed(run, lambda k: f"{k + 1:04d}.tif", ("right",))
    assert re.search("0000.*0001", told(opened(run)))
    assert re.search("0000.*0001", str(check(load_manifest(run))))
    renamed(run, lambda k: f"{k + 700:04d}.tif", ("right",))
    assert not told(opened(run))


def test_numbers_that_count_by_two_ask_which_edges_have_frames(run):
    renamed(run, lambda k: f"{k:04d}.tif" if k % 2 == 0 else None)
    stated(run, "first_edge = 0")
    refused("top.edge_step: .* 24 ", opened, run, error=InputError)
    for step in (1, 2):
        stated(run, f"edge_step = {step}")
        assert opened(run).sight.edge.tolist() == list(range(0, 12 * step, step))
        path = run / "recording.toml"
        path.write_text(path.read_text(encoding="utf-8").replace(f"edge_step = {step}\n", ""), encoding="utf-8")


def test_one_image_is_no_series(run):
    text = (run / "recording.toml").read_text(encoding="utf-8")
    for side in BOTH:
        shutil.copy(run / f"top-{side}" / "0000.tif", run / f"{side}.tif")
        text = text.replace(f'"top-{side}/*.tif"', f'"{side}.tif"')
    (run / "recording.toml").write_text(text, encoding="utf-8")
    refused("top.left: .* 3 frames.* 1 .*left.tif", opened, run, error=InputError)


def turned(path: Path, tag: int) -> None:
    tifffile.imwrite(path, tifffile.imread(path), extratags=[(274, "H", 1, tag, True)], metadata=None)


def test_a_tag_that_rotates_is_reported_and_one_that_mirrors_refused(run, capsys):
    for path in (run / "top-left").glob("*.tif"):
        turned(path, 3)
    (notice,) = (notice for notice in opened(run).notices if notice.code == ORIENTATION_NOT_APPLIED.code)
    assert [notice.values[name] for name in ("tag", "tagged", "files")] == [3, 24, 24]
    assert main(["check", str(run)]) == 0
    assert "top-left" in capsys.readouterr().out
    turned(run / "top-left" / "0003.tif", 4)
    assert main(["check", str(run)]) == 2
    assert re.search("0003.tif: .*tag 4", capsys.readouterr().out)


def test_black_images_are_named(run, capsys):
    """Other instruments of the demo see the load: `check` remarks, `run` leaves the pair out."""
    rng = np.random.default_rng(2)
    for path in (run / "top-right").glob("*.tif"):
        tifffile.imwrite(path, rng.poisson(12.0, tifffile.imread(path).shape).astype(np.uint16))
    report = check(load_manifest(run))
    assert any(re.search("images top: .*right.*dark", remark) for remark in report.remarks)
    assert report.problems == ()
    assert main(["look", str(run)]) == 1
    assert re.search("top right: .*dark", capsys.readouterr().out)


def test_a_raw_colour_mosaic_is_named_and_left_out(run, capsys):
    for path in (run / "top-left").glob("*.tif"):
        grey = tifffile.imread(path)
        mosaic = grey * np.tile([[1.0, 0.6], [0.5, 1.0]], (grey.shape[0] // 2, grey.shape[1] // 2))
        tifffile.imwrite(path, np.rint(mosaic).astype(np.uint16))
    report = check(load_manifest(run))
    assert any(re.search("images top: left: .*raw mosaic of a colour camera", remark) for remark in report.remarks)
    assert report.problems == ()
    assert main(["look", str(run)]) == 1
    assert re.search("top left: .*raw mosaic", capsys.readouterr().out)


@pytest.mark.parametrize(("sides", "copies"), [(("right",), {1: 0, 8: 7}), (BOTH, dict.fromkeys(range(6, 24), 5))])
def test_copies_of_earlier_frames_are_named_and_take_no_part(run, sides, copies):
    for side in sides:
        for number, earlier in copies.items():
            shutil.copy(run / f"top-{side}" / f"{earlier:04d}.tif", run / f"top-{side}" / f"{number:04d}.tif")
    images = opened(run)
    assert np.flatnonzero(images.copied).tolist() == sorted(copies)
    assert [notice.values["camera"] for notice in images.notices] == list(sides)
    assert f"{min(copies):04d}.tif" in told(images)
    pose = measure_images(images, Settings(), no_progress).motion.pose
    assert np.flatnonzero(~np.isfinite(pose).all(axis=1)).tolist() == sorted(copies)


def test_a_frozen_camera_is_refused(run):
    for number in range(2, FRAMES):
        shutil.copy(run / "top-left" / "0001.tif", run / "top-left" / f"{number:04d}.tif")
    words = "images.top: .* 2 of 24"
    refused(words, measure_images, opened(run), Settings(), no_progress, error=InputError)


@pytest.mark.parametrize(("share", "outcome"), [(0.3, r" 3\d\.\d % "), (0.012, "")])
def test_a_sensor_that_clips_below_full_scale_is_saturated_at_that_level(run, share, outcome):
    limit = int(np.quantile(tifffile.imread(run / "top-left" / "0000.tif"), 1.0 - share))
    for side in BOTH:
        for path in (run / f"top-{side}").glob("*.tif"):
            tifffile.imwrite(path, np.minimum(tifffile.imread(path), np.uint16(limit)), compression="zlib")
    if outcome:
        refused(f"0000.tif: .*{outcome}.* {limit}, .* 1023", opened, run, error=InputError)
        return
    images = opened(run)
    assert [camera.clips_at for camera in images.cameras] == [limit, limit]
    shown = told(images)
    assert all(text in shown for text in (str(limit), "1023"))


# Frames in Phantom cine files: the same frames; exposure and times as the files have them.

EXPOSURE_S, INTERVAL_S = 60e-6, 0.0261
"""Of the files; the interval of the demo's trigger, nearly."""


def filmed(folder: Path, demo_recording: Path, exposure: str = '"file"', **options: object) -> Path:
    """The demo's recording with the frames of the pair `top` in two cine files; options are those of the files."""
    shutil.copytree(demo_recording, folder / "demo")
    run = folder / "demo" / "Fz-0080"
    text = (run / "recording.toml").read_text(encoding="utf-8")
    for side in BOTH:
        frames = np.stack([tifffile.imread(path) for path in sorted((run / f"top-{side}").glob("*.tif"))])
        stated = {"interval_s": INTERVAL_S, "exposure_s": EXPOSURE_S, "bits": 10} | options
        write_cine(run / f"top-{side}.cine", frames, **stated)
        text = text.replace(f'"top-{side}/*.tif"', f'"top-{side}.cine"')
    text = text.replace('stereo = "top"\n', f'stereo = "top"\nexposure = {exposure}\n', 1)
    (run / "recording.toml").write_text(text, encoding="utf-8")
    return run


def test_frames_and_exposure_of_the_files_are_those_of_the_images(tmp_path, demo_recording, whole):
    run = filmed(tmp_path, demo_recording)
    images, pictures = opened(run), whole
    assert not images.notices
    assert images.sight.exposure.length_s == pytest.approx(EXPOSURE_S, abs=1e-9)
    np.testing.assert_allclose(images.sight.time_s, pictures.sight.time_s, atol=1e-9)
    for frame in (0, 7):
        np.testing.assert_array_equal(images.cameras[1].read(frame), pictures.cameras[1].read(frame))
    assert "exposure 60 µs" in str(check(load_manifest(run)))


@pytest.mark.parametrize(
    ("exposure", "options", "words"),
    [
        ("70e-6", {}, "top-left.cine: .* 60 µs.* 70 µs"),
        ('"file"', {"lost": 5}, "top-left.cine: .* frames 4 and 5"),
        ('"file"', {"interval_s": 0.5}, "top-left.cine: .* 0.5 s"),
    ],
)
def test_files_that_contradict_the_manifest_are_named(tmp_path, demo_recording, exposure, options, words):
    texts = [
        f"{notice.where}: {notice.text}"
        for notice in opened(filmed(tmp_path, demo_recording, exposure, **options)).notices
    ]
    assert any(re.search(words, text) for text in texts), texts


def test_an_exposure_that_no_file_states_is_refused(tmp_path, demo_recording):
    run = filmed(tmp_path, demo_recording)
    frames = [tifffile.imread(path) for path in sorted((run / "top-left").glob("*.tif"))]
    tifffile.imwrite(run / "top-left.tif", np.stack(frames), photometric="minisblack")
    text = (run / "recording.toml").read_text(encoding="utf-8")
    (run / "recording.toml").write_text(text.replace("top-left.cine", "top-left.tif"), encoding="utf-8")
    refused(r'images.top.exposure.*"file".* 60 µs', opened, run, error=InputError)
