"""Cells of an area: every pixel once, sums against plain numpy, and the surface they lie on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photogram.bspline import evaluate, spline_of_image
from photogram.camera import Camera
from photogram.direct import LEAST_FILLED, compare_cells, lay_cells, pixel_residuals, prepare_cells
from photogram.geometry import RigidTransform
from photogram.images import NoiseModel
from photogram.motion import PlacedCamera, body_patches, patch_rates, patch_warps

NOISE = NoiseModel(4.0, 0.01)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), side=st.integers(3, 12), filled=st.floats(0.05, 0.95))
def test_every_pixel_of_a_well_filled_square_appears_once(seed: int, side: int, filled: float) -> None:
    area = np.random.default_rng(seed).random((37, 41)) < filled
    centres, runs, first = lay_cells(area, side)
    seen = np.zeros(area.shape, dtype=int)
    for row, column, length, _ in runs:
        seen[row, column : column + length] += 1
    assert np.array_equal(runs[:, 3], np.cumsum(runs[:, 2]) - runs[:, 2])
    assert seen.max() <= 1
    assert not np.any(seen[~area])
    assert first[-1] == len(runs)
    for index, centre in enumerate(centres):
        mine = runs[first[index] : first[index + 1]]
        assert mine[:, 2].sum() >= LEAST_FILLED * side**2
        half = (side - 1) / 2
        assert np.all(np.abs(mine[:, 0] - centre[1]) <= half)
        assert np.all(mine[:, 1] >= centre[0] - half)
        assert np.all(mine[:, 1] + mine[:, 2] - 1 <= centre[0] + half)


@pytest.mark.parametrize("degree", [3, 5])
def test_sums_of_a_cell_against_numpy(make_texture, degree: int) -> None:  # type: ignore[no-untyped-def]
    """One ragged cell at an affine warp: gain, misfit, projected gradients and Hessian from their definitions."""
    texture = make_texture(seed=3, s=1.6, waves=60)
    first = spline_of_image(1000 + 200 * texture.image((60, 50)), degree)
    second = spline_of_image(1100 + 180 * texture.image((60, 50), lambda p: p - [0.4, -0.3]), degree)
    area = np.zeros((50, 60), dtype=bool)
    area[18:31, 20:33] = True
    area[18:22, 20:25] = False
    cells = prepare_cells(first, lay_cells(area, 13), 13, NOISE, 4095)
    assert cells.count.tolist() == [13 * 13 - 20]
    warp = np.array([[0.37, 2e-3, -1e-3, -0.28, 3e-3, 1e-3]])
    found = compare_cells(cells, second, warp)

    rows, columns = np.nonzero(area)
    d = np.column_stack([columns, rows]) - cells.centre_px[0]
    f, slope = evaluate(first, np.column_stack([columns, rows]).astype(float))
    w = 1 / NOISE.variance(f)
    u, ux, uy, v, vx, vy = warp[0]
    moved = d + cells.centre_px[0] + np.column_stack([u + d @ [ux, uy], v + d @ [vx, vy]])
    g, _ = evaluate(second, moved)
    shape = np.column_stack([np.ones(len(d)), d])
    steepest = np.concatenate([slope[:, :1] * shape, slope[:, 1:] * shape], axis=1)
    base = np.column_stack([np.ones(len(f)), f - np.average(f, weights=w)])
    normal = base.T @ (w[:, None] * base)
    offset, gain = np.linalg.solve(normal, base.T @ (w * g))
    residual = g - offset - gain * base[:, 1]
    projected = steepest - base @ np.linalg.solve(normal, base.T @ (w[:, None] * steepest))
    np.testing.assert_allclose(found.gain, gain, rtol=1e-10)
    np.testing.assert_allclose(found.misfit, np.sum(w * residual**2), rtol=1e-7)
    np.testing.assert_allclose(found.slope[0], projected.T @ (w * g), rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(cells.hessian[0], projected.T @ (w[:, None] * projected), rtol=1e-8, atol=1e-6)
    grey, squares = pixel_residuals(cells, second, warp)
    np.testing.assert_allclose(grey, f, rtol=1e-10)
    np.testing.assert_allclose(squares / squares.sum(), residual**2 / np.sum(residual**2), rtol=1e-6, atol=1e-9)


def test_cells_that_leave_the_image_and_saturated_pixels_do_not_count(make_texture) -> None:  # type: ignore[no-untyped-def]
    image = 1000 + 200 * make_texture(seed=4, waves=60).image((60, 50))
    image[20:24, 20:30] = 4095
    area = np.ones((50, 60), dtype=bool)
    cells = prepare_cells(spline_of_image(image), lay_cells(area, 10), 10, NOISE, 4095)
    assert cells.count.sum() == 50 * 60 - 40
    target = spline_of_image(np.roll(image, 4, axis=1))
    found = compare_cells(cells, target, np.tile([4.0, 0, 0, 0, 0, 0], (len(cells.count), 1)))
    last = cells.centre_px[:, 0] > 50
    assert np.all(np.isnan(found.gain[last]))
    assert np.all(np.isfinite(found.slope[~last]))
    inner = cells.centre_px[~last, 0] > 10
    np.testing.assert_allclose(found.gain[~last][inner], 1.0, atol=1e-3)


def test_patches_of_a_plane_move_as_projected_points_do() -> None:
    """Rates and warps of a tilted plane against differences of exact projections, lens distortion included."""
    matrix = np.array([[1500.0, 0, 320], [0, 1500.0, 256], [0, 0, 1.0]])
    camera = Camera(matrix, np.array([-0.1, 0.2, 1e-3, -1e-3, 0.0]), np.array([640, 512]))
    placed = PlacedCamera(camera, RigidTransform.from_pose(np.array([0.01, -0.02, 0.4, 0.2, -0.3, 0.1])))
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.06, 0.06, 25), np.linspace(-0.05, 0.05, 21)))
    known = np.column_stack([u, v, 0.1 * u - 0.05 * v])
    known[::17, 2] += 5e-3  # wrong points, which the local planes must leave out
    centre = placed.project(np.array([[0.01, 0.02, 0.0], [-0.03, 0.01, -0.0035], [0.0, 0.0, 0.0]]))
    patches = body_patches(placed, known, centre, 6.0, 40.0)
    plane = patches.points_m[..., 2] - 0.1 * patches.points_m[..., 0] + 0.05 * patches.points_m[..., 1]
    assert np.max(np.abs(plane)) < 1e-8
    np.testing.assert_allclose(placed.project(patches.points_m[:, 0]), centre, atol=1e-8)
    pose = np.array([1e-4, -2e-4, 3e-4, 1e-3, -2e-3, 3e-3])
    moved = RigidTransform.from_pose(pose)
    warp, rates = patch_warps(placed, patches, moved), patch_rates(placed, patches)
    shift = placed.project(moved.apply(patches.points_m)) - placed.project(patches.points_m)
    for arm, step in enumerate(6.0 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])):
        along = warp[:, [0, 3]] + warp[:, [1, 4]] * step[0] + warp[:, [2, 5]] * step[1]
        np.testing.assert_allclose(along, shift[:, arm], atol=2e-4)
    np.testing.assert_allclose(rates @ pose, warp, atol=0.02 * np.abs(warp).max())


def test_unknown_surface_is_nan() -> None:
    camera = PlacedCamera(
        Camera(np.array([[1000.0, 0, 100], [0, 1000.0, 100], [0, 0, 1.0]]), np.zeros(5), np.array([200, 200])),
        RigidTransform(np.eye(3), np.array([0, 0, 0.5])),
    )
    known = np.column_stack([np.random.default_rng(1).uniform(-0.01, 0.01, (30, 2)), np.zeros(30)])
    patches = body_patches(camera, known, np.array([[100.0, 100.0], [190.0, 190.0]]), 5.0, 20.0)
    assert np.isfinite(patches.points_m[0]).all()
    assert np.isnan(patches.points_m[1]).all()
    with pytest.raises(ValueError, match="known_m: expected at least 3"):
        body_patches(camera, known[:2], np.array([[100.0, 100.0]]), 5.0, 20.0)
