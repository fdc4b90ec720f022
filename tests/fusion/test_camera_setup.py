"""`shakercal plan --setup`: optics against textbook cases, noise against rendered speckle, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support import refusals

from fusion.cli import main
from fusion.planning.camera_setup import CameraSetup, estimate_setup

SETUP = {
    "pixel": 4e-6,
    "image": (2000, 1500),
    "focal_length": 50e-3,
    "distance": 0.55,
    "f_number": 8.0,
    "stereo_angle": 60.0,
    "face": (0.04, 0.04),
    "speckle": 5.0,
    "contrast": 0.2,
    "noise": 0.01,
}
TEXT = "\n".join(f"{key} = {list(value) if isinstance(value, tuple) else value}" for key, value in SETUP.items())


def test_a_lens_at_a_tenth_of_natural_size() -> None:
    """50 mm at 0.55 m: M = 0.1, so 40 µm a pixel; 2·8·4 µm·1.1/0.01 of depth; Airy disc 2.44·0.55 µm·8·1.1."""
    found = estimate_setup(CameraSetup.model_validate(SETUP))
    assert found.pixel_m == pytest.approx(40e-6)
    assert found.field_m == pytest.approx((0.08, 0.06))
    assert found.depth_m == pytest.approx(7.04e-3)
    assert found.airy_px == pytest.approx(11.81e-6 / 4e-6, rel=1e-3)
    assert found.used_px == pytest.approx(1e6)
    x, y, z = found.noise_m
    assert (x / y, z / y) == pytest.approx((2.0 / np.sqrt(3.0), 2.0)), "half the stereo angle is 30°"


def test_the_noise_is_that_of_speckle_fitted_by_least_squares() -> None:
    """Smoothed noise of known autocorrelation; the shift of noisy copies by least squares, 2000 draws."""
    rng = np.random.default_rng(7)
    speckle, contrast, noise, side = 6.0, 0.2, 0.01, 200
    # A Gaussian filter of width w gives the autocorrelation exp(−τ²/(4w²)), of full width 4w·√(ln 2).
    image = gaussian_filter(rng.standard_normal((side + 60, side + 60)), speckle / (4.0 * np.sqrt(np.log(2.0))))
    image = contrast * image / image.std()
    slope = np.gradient(image, axis=1)[30:-30, 30:-30].ravel()
    shifts = noise * rng.standard_normal((2000, slope.size), dtype=np.float32) @ slope / np.sum(slope**2)
    pixel_m = 40e-6
    setup = SETUP | {"face": (side * pixel_m, side * pixel_m), "speckle": speckle, "stereo_angle": 1e-3}
    found = estimate_setup(CameraSetup.model_validate(setup))
    assert found.noise_m[0] * np.sqrt(2.0) / pixel_m == pytest.approx(shifts.std(), rel=0.1)


def test_the_table_has_units(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "setup.toml").write_text(TEXT, encoding="utf-8")
    assert main(["plan", "--setup", str(tmp_path / "setup.toml")]) == 0
    out = capsys.readouterr().out
    assert "80 × 60" in out
    assert "nm" in out
    assert max(map(len, out.splitlines())) <= 80
    planned = ["--frequencies", "120", "--frames", "211", "--rate", "50"]
    assert main(["plan", "--setup", str(tmp_path / "setup.toml"), *planned]) == 0
    assert "120" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("distance = 0.55", "distance = 0.05", "distance"),
        ("image = [2000, 1500]", "image = [2000]", "image"),
        ("f_number = 8.0", "f_number = 0", "f_number"),
        ("stereo_angle = 60.0", "stereo_angle = 180", "stereo_angle"),
        ("pixel = 4e-06", "pixels = 4e-06", "pixels"),
    ],
)
def test_wrong_setups_are_one_sentence(
    tmp_path: Path, old: str, new: str, key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "setup.toml"
    path.write_text(TEXT.replace(old, new), encoding="utf-8")
    assert f"setup.toml: {key}" in refusals(capsys)("plan", "--setup", path)


def test_without_a_setup_the_frequencies_are_required(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["plan", "--max-rate", "82"])
    assert "required: --frequencies, --frames" in capsys.readouterr().err
