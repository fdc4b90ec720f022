"""A recording whose frames stand in Phantom cine files: the same frames; exposure and times as the files have them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from cine_factory import write_cine
from contracts import refused

from fusion.errors import InputError
from fusion.phasors.stereo_motion import PreparedImages, prepare_images
from fusion.phasors.timing import tie_daqs
from fusion.planning.check import check
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import load_manifest

EXPOSURE_S = 60e-6


def recording(folder: Path, demo_recording: Path, exposure: str = '"file"', **options: object) -> Path:
    """The demo's recording with the frames of the pair `top` in two cine files; options are those of the files."""
    shutil.copytree(demo_recording, folder / "demo")
    run = folder / "demo" / "Fz-0080"
    edges_s = None
    for side in ("left", "right"):
        frames = np.stack([tifffile.imread(path) for path in sorted((run / f"top-{side}").glob("*.tif"))])
        if edges_s is None:
            manifest = load_manifest(demo_recording / "Fz-0080")
            base = tie_daqs(manifest, read_daqs(manifest))
            edges_s = prepare_images(manifest, base, manifest.images[0]).sight.time_s
        interval_s = float(np.median(np.diff(edges_s)))
        stated = {"interval_s": interval_s, "exposure_s": EXPOSURE_S, "bits": 10} | options
        write_cine(run / f"top-{side}.cine", frames, **stated)
    text = (run / "recording.toml").read_text(encoding="utf-8")
    for side in ("left", "right"):
        text = text.replace(f'"top-{side}/*.tif"', f'"top-{side}.cine"')
    text = text.replace('stereo = "top"\n', f'stereo = "top"\nexposure = {exposure}\n', 1)
    (run / "recording.toml").write_text(text, encoding="utf-8")
    return run


def opened(run: Path) -> PreparedImages:
    manifest = load_manifest(run)
    base = tie_daqs(manifest, read_daqs(manifest))
    return prepare_images(manifest, base, next(entry for entry in manifest.images if entry.stereo == "top"))


def test_frames_and_exposure_of_the_files_are_those_of_the_images(tmp_path, demo_recording):
    run = recording(tmp_path, demo_recording)
    images, pictures = opened(run), opened(demo_recording / "Fz-0080")
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
        for notice in opened(recording(tmp_path, demo_recording, exposure, **options)).notices
    ]
    assert any(re.search(words, text) for text in texts), texts


def test_an_exposure_that_no_file_states_is_refused(tmp_path, demo_recording):
    run = recording(tmp_path, demo_recording)
    frames = [tifffile.imread(path) for path in sorted((run / "top-left").glob("*.tif"))]
    tifffile.imwrite(run / "top-left.tif", np.stack(frames), photometric="minisblack")
    text = (run / "recording.toml").read_text(encoding="utf-8")
    (run / "recording.toml").write_text(text.replace("top-left.cine", "top-left.tif"), encoding="utf-8")
    refused(r'images.top.exposure.*"file".* 60 µs', opened, run, error=InputError)
