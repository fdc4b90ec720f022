"""The dot grid with ring markers as two real cameras saw it, 14 times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photogram.targets.dots import find_dots
from photogram.targets.view import Target, TargetView

RING_GRID = Target("dots", 3.5e-3)


def view_of(folder: Path, number: int, camera: int) -> TargetView:
    import cv2

    path = folder / "dotgrid_stereo" / f"CalB-sys2-{number:04d}_{camera}.jpeg"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return find_dots(image, RING_GRID, path.name, 255)


def common(first: TargetView, second: TargetView) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the dots that both views show, in the same order."""
    there = {tuple(index): position for index, position in zip(second.index.tolist(), second.position_px, strict=True)}
    pairs = [
        (position, there[tuple(index)])
        for index, position in zip(first.index.tolist(), first.position_px, strict=True)
        if tuple(index) in there
    ]
    return np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])


def plane_residual_px(from_px: np.ndarray, to_px: np.ndarray) -> float:
    """Rms distance per axis from the best homography between two views."""
    import cv2

    matrix, _ = cv2.findHomography(from_px, to_px, 0)
    seen = cv2.perspectiveTransform(from_px.reshape(-1, 1, 2), matrix).reshape(-1, 2)
    return float(np.sqrt(np.mean((seen - to_px) ** 2)))


def check(left: TargetView, right: TargetView) -> None:
    """76 dots, the rings where the target's description has them, and both cameras see one plane."""
    for view in (left, right):
        assert len(view.index) >= 76
        place = {tuple(index): position for index, position in zip(view.index.tolist(), view.position_px, strict=True)}
        origin, x_ring, y_ring = place[0, 0], place[5, 0], place[0, 3]
        assert x_ring[0] - origin[0] > 1000
        assert y_ring[1] - origin[1] < -600
        assert origin[0] < 800
        assert origin[1] > 1000
        assert view.radius == pytest.approx(0.2025, abs=0.001)
    here, there = common(left, right)
    assert len(here) >= 72
    assert plane_residual_px(here, there) < 0.15


@pytest.mark.parametrize("number", [1, 10])
def test_all_dots_of_a_stereo_pair(data_dir: Path, number: int) -> None:
    check(view_of(data_dir, number, 0), view_of(data_dir, number, 1))


@pytest.mark.slow
def test_every_one_of_the_28_pictures_is_found(data_dir: Path) -> None:
    for number in range(1, 15):
        check(view_of(data_dir, number, 0), view_of(data_dir, number, 1))


def test_centres_repeat_to_two_hundredths_of_a_pixel(data_dir: Path) -> None:
    first, second = (view_of(data_dir, number, 1) for number in (12, 13))
    here, there = common(first, second)
    assert plane_residual_px(here, there) < 0.02 * np.sqrt(2)
