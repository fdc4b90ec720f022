"""`shakercal plan --setup`: optics against textbook cases, noise against rendered speckle, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support import refusals

from fusion.cli import main
from fusion.planning.camera_setup import CameraSetup, estimate_setup, relative_expanded_uncertainty

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
    x, y, z = np.sqrt(np.diagonal(found.covariance["a pair"]))[:3]
    assert (x / y, z / y) == pytest.approx((1.0, np.sqrt(3.0)), rel=0.02), "half the stereo angle is 30°: cot 30°"


def test_one_camera_across_a_square_face_has_the_uncertainties_of_the_closed_form() -> None:
    """With half the side a, distance Z and w = u of a shift alone: √(14/9)·w, Z·w·√1.5/a, √5·Z·w/a², √1.5·w/a.

    Shifts alone see n pixels with w = pixel·noise/(slope·√n). The moments of the square are a²/3, a⁴/5 and a⁴/9.
    """
    one = {key: value for key, value in SETUP.items() if key != "stereo_angle"} | {"view_angle": 0.0}
    half, far, shift = 0.02, 0.55, 40e-6 * 0.01 / (2.0 * np.sqrt(2.0 * np.log(2.0)) * 0.2 / 5.0 * 1000.0)
    expected = [np.sqrt(14.0 / 9.0) * shift] * 2 + [np.sqrt(1.5) * far * shift / half]
    expected += [np.sqrt(5.0) * far * shift / half**2] * 2 + [np.sqrt(1.5) * shift / half]
    (found,) = estimate_setup(CameraSetup.model_validate(one)).covariance.values()
    np.testing.assert_allclose(np.sqrt(np.diagonal(found)), expected, rtol=2e-3)
    # At the sensor 40 mm behind the face, x takes up the tilt about y.
    (behind,) = estimate_setup(CameraSetup.model_validate(one | {"origin": (0.0, 0.0, -0.04)})).covariance.values()
    assert np.sqrt(behind[0, 0]) == pytest.approx(0.04 * expected[4], rel=0.02)


def test_the_uncertainty_of_the_sensitivity_is_that_of_the_displacement_and_of_the_scale() -> None:
    """u√(2/N)·ω²/a, with the scale, times 1.96."""
    setup = CameraSetup.model_validate(SETUP | {"frequency": 50.0, "acceleration": 4.0, "scale_uncertainty": 1e-4})
    noise = np.sqrt(1e-16 * 2.0 / 211) * (2.0 * np.pi * 50.0) ** 2 / 4.0
    found = relative_expanded_uncertainty(setup, np.diag([0.0, 0.0, 1e-16, 0.0, 0.0, 0.0]))
    assert found == pytest.approx(1.96 * np.hypot(noise, 1e-4))


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
    (covariance,) = found.covariance.values()
    # Two views, and with two tilts: √2 and √(9/14) of the shift of one view alone.
    assert np.sqrt(covariance[0, 0] * 2.0 * 9.0 / 14.0) / pixel_m == pytest.approx(shifts.std(), rel=0.1)


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
        ("distance = 0.55", "distance = 0.2", "face"),  # field of 24 × 18 mm
        ("distance = 0.55", "distance = 55", "face"),  # 4.4 mm a pixel: 9 px
        ("image = [2000, 1500]", "image = [2000]", "image"),
        ("f_number = 8.0", "f_number = 0", "f_number"),
        ("stereo_angle = 60.0", "stereo_angle = 180", "stereo_angle"),
        ("stereo_angle = 60.0", "", "stereo_angle"),
        ("noise = 0.01", "noise = 0.01\nfrequency = 80", "acceleration"),
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
