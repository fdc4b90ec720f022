"""The fit of six components batched over frames, for a GPU: `fit_direct` by torch.

Pixels have the splines' precision, usually float32; sums over them, motions and systems of equations are float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

import numpy as np
import torch
from kornia.geometry.calibration import distort_points
from kornia.geometry.liegroup import So3
from torch import Tensor

from photogram.bspline import mean_noise_gain, noise_gain_table
from photogram.camera import Camera
from photogram.direct.cells import SMALLEST_GAIN, CellSums, nine_points, pixel_coordinates
from photogram.direct.direct_fit import (
    MAX_STEPS,
    BodyView,
    DirectFit,
    estimate_shape_amplitudes,
    pose_covariance,
    solve_step,
)
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from photogram.subsets.icgn_torch import Squares, TorchSplines, square_sums, torch_type
from photogram.subsets.reference import shape_values
from shakercal._common.arrays import FloatArray


@dataclass(frozen=True)
class TorchView(Squares):
    """A `BodyView` on a device: C cells; pixels outside the body have weight 0.

    All else is float64 and named as in `Cells`, `BodyView` and `Patches`. The points_m (5·C, 3) are in the camera's
    frame. From the body's frame, turn (3, 3) and origin_m (3,) lead to it. Which cells can determine a motion is in
    `steady` (C,).
    """

    source: BodyView
    weight: Tensor
    energy: Tensor
    count: Tensor
    removed: Tensor
    rates: Tensor
    information: Tensor
    information_noise: Tensor
    inverse_shift_hessian: Tensor
    rounding: Tensor
    shift_rates: Tensor
    steady: Tensor
    points_m: Tensor
    rest_px: Tensor
    turn: Tensor
    origin_m: Tensor
    nine_points: Tensor


def torch_view(view: BodyView, device: str, precision: str) -> TorchView:
    """Return the view on a device, its pixels of `precision` 'float64' or 'float32'."""
    cells, camera_from_body = view.cells, view.camera.camera_from_body
    side, kind = cells.side_px, torch_type(precision)
    cell, reach = cells.of_pixels, (side - 1) / 2
    column, row = np.rint(pixel_coordinates(cells.runs) - cells.centre_px[cell] + reach).astype(np.int64).T
    pixels = np.zeros((len(cells.centre_px), 4, side * side))
    pixels[cell, :, row * side + column] = cells.pixels.T
    down, across = (grid.ravel() - reach for grid in np.mgrid[:side, :side])
    shape = shape_values(np.column_stack([across, down]), 1)
    from_cells = ("centre_px", "mean", "weight", "energy", "count", "removed")
    from_view = ("rates", "information", "information_noise", "inverse_shift_hessian", "rounding", "shift_rates")
    placed = camera_from_body.apply(view.patches.points_m).reshape(-1, 3)
    whole = {
        **{name: getattr(cells, name) for name in from_cells},
        **{name: getattr(view, name) for name in from_view},
        **{"points_m": placed, "rest_px": view.patches.rest_px, "turn": camera_from_body.rotation},
        **{"origin_m": camera_from_body.translation_m, "nine_points": nine_points(side)},
    }
    return TorchView(
        source=view,
        pixels=torch.from_numpy(pixels).to(device, kind),
        shape=torch.from_numpy(shape).to(device, kind),
        steady=torch.from_numpy(view.steady).to(device),
        **{name: torch.from_numpy(np.array(array, dtype=np.float64)).to(device) for name, array in whole.items()},
    )


_LOADING = Lock()


def load_solvers(device: str) -> None:
    """Make torch load its solvers for a device.

    It loads them on their first call, and not in two threads at once.
    """
    with _LOADING:
        one = torch.eye(1, dtype=torch.float64, device=device)
        torch.linalg.solve(one, torch.linalg.eigvalsh(one)[:, None])


def fit_frames(
    views: Sequence[TorchView],
    targets: Sequence[tuple[TorchSplines, Sequence[int]]],
    starts: FloatArray,
) -> list[DirectFit | None]:
    """Return the result of `fit_direct` for each of F frames, all at once.

    targets: for each view the splines on its device, and which F of them are the frames. Frames leave the iteration as
    they converge; only motions, covariances and sums are copied back. None also for a motion to which the rates of the
    views do not apply (`BodyView.is_near`).
    """
    device = views[0].centre_px.device
    rotation = torch.from_numpy(rotation_from_vector(starts[:, 3:])).to(device)
    shift = torch.tensor(starts[:, :3], device=device)
    numbers = [torch.tensor(list(which), device=device) for _, which in targets]
    size = views[0].rates.shape[2]
    matrices = torch.zeros((2, len(starts), size, size), dtype=torch.float64, device=device)
    slopes = torch.zeros((2, len(starts), size), dtype=torch.float64, device=device)  # and last steps
    scales, counts = torch.full((2, len(starts)), torch.nan, dtype=torch.float64, device=device)
    misfits = torch.zeros((len(starts), len(views), 2), dtype=torch.float64, device=device)
    scores = torch.zeros((len(starts), sum(len(view.rates) for view in views), 6), dtype=torch.float32, device=device)
    active = torch.arange(len(starts), device=device)
    for _ in range(MAX_STEPS):
        compared = [
            _compared(view, frames, number[active], rotation[active], shift[active])
            for view, (frames, _), number in zip(views, targets, numbers, strict=True)
        ]
        step = solve_step(torch, views, compared)
        new_rotation, moved = _compose_inverse(rotation[active], shift[active], step.pose)
        rotation[active], shift[active] = new_rotation, moved
        matrices[0, active], matrices[1, active] = step.sums.information, step.sums.noise_part
        slopes[0, active], slopes[1, active, :6] = step.sums.slope, step.pose
        scales[active], counts[active] = (
            torch.where(step.final, step.noise_ratio, torch.nan),
            step.sums.cells.to(scales),
        )
        misfits[active] = torch.stack([one.misfit for one in step.residuals], 1)
        scores[active] = torch.cat([one.scores for one in step.residuals], 1).to(scores)
        active = active[step.solvable & ~step.final]
        if len(active) == 0:
            break
    found_on_device = (rotation, shift, matrices, slopes, scales, counts, misfits, scores)
    turns, shifts, both, slopes_and_steps, levels, cells, *residuals = (part.cpu().numpy() for part in found_on_device)
    fits: list[DirectFit | None] = [None] * len(starts)
    fitted = np.flatnonzero(np.isfinite(levels))
    whole, level = both[:, fitted], levels[fitted]
    each, size = level[:, None, None], slice(6)
    rotations = turns[fitted], vector_from_rotation(turns[fitted])
    covariances = each * pose_covariance(whole[0, :, size, size], each * whole[1, :, size, size], *rotations)
    steps, gradients = slopes_and_steps[1, fitted, :6], slopes_and_steps[0, fitted]
    amplitudes, of_shapes = estimate_shape_amplitudes(steps, gradients, (whole[0], whole[1]), level)
    for k, f in enumerate(fitted):
        moved = RigidTransform(turns[f], shifts[f])
        if not all(view.source.is_near(moved) for view in views):
            continue
        rest = (part[f] for part in residuals)
        fits[f] = DirectFit(moved, covariances[k], float(level[k]), int(cells[f]), amplitudes[k], of_shapes[k], *rest)
    return fits


def _compose_inverse(rotation: Tensor, shift: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Return T·δ⁻¹ of motions (A,3,3), (A,3) and steps (A,6) of shift and rotation vector."""
    rotated = rotation @ So3.exp(step[:, 3:]).matrix().transpose(1, 2)
    return rotated, shift - (rotated @ step[:, :3, None])[..., 0]


@lru_cache(maxsize=16)
def _lens(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the camera's matrix and distortion on a device."""
    matrix, lens = (torch.from_numpy(part).to(device) for part in (camera.matrix, camera.distortion))
    return matrix, lens


@lru_cache(maxsize=4)
def _noise_gains(degree: int, device: torch.device) -> Tensor:
    """Return `bspline.noise_gain_table` on a device."""
    return torch.from_numpy(noise_gain_table(degree)).to(device)


def _eye(size: int, like: Tensor) -> Tensor:
    return torch.eye(size, dtype=like.dtype, device=like.device)


def torch_project(camera: Camera, points_m: Tensor) -> Tensor:
    """Return `camera.project` of points (..., 3) in the camera frame, float64, on their device."""
    matrix, lens = _lens(camera, points_m.device)
    plain = _eye(3, points_m)
    depth = torch.where(points_m[..., 2:] > 0.0, points_m[..., 2:], torch.nan)
    normal = (points_m[..., :2] / depth).reshape(1, -1, 2)
    distorted = distort_points(normal, plain[None], lens[None], plain[None]).reshape(*points_m.shape[:-1], 2)
    return distorted @ matrix[:2, :2].T + matrix[:2, 2]


def _warps(view: TorchView, rotation: Tensor, shift: Tensor) -> Tensor:
    """Return affine warps (A,C,6) of the cells by motions of the body (A,3,3), (A,3).

    As `surface.patch_warps`.
    """
    rotated = view.turn @ rotation @ view.turn.T  # in the camera's frame the body moves by C·T·C⁻¹, C its pose
    moved = shift @ view.turn.T + view.origin_m - (rotated @ view.origin_m[:, None])[..., 0]
    seen = torch_project(view.source.camera.camera, view.points_m @ rotated.transpose(1, 2) + moved[:, None])
    shift_px = seen.reshape(len(shift), -1, 5, 2) - view.rest_px
    arm = 2.0 * view.source.patches.arm_px
    along, down = (shift_px[:, :, 1] - shift_px[:, :, 2]) / arm, (shift_px[:, :, 3] - shift_px[:, :, 4]) / arm
    return torch.stack([shift_px[:, :, 0], along, down], dim=3).flatten(2)


def _compared(view: TorchView, frames: TorchSplines, number: Tensor, rotation: Tensor, shift: Tensor) -> CellSums:
    """Compare a camera's frames `number` (A,) at motions (A, 3, 3), (A, 3): `cells.compare_cells`."""
    warp = _warps(view, rotation, shift)
    sums = _cell_sums(view, frames, number, warp)
    gain = sums[..., 2] / view.energy
    misfit = (sums[..., 1] - sums[..., 0] ** 2 / view.weight - gain**2 * view.energy).clamp(min=0.0)
    slope = sums[..., 3:] - view.removed[:, 0] * sums[..., :1] - view.removed[:, 1] * sums[..., 2:3]
    gain = torch.where(gain > SMALLEST_GAIN, gain, torch.nan)
    table = _noise_gains(frames.degree, warp.device)
    interpolated = mean_noise_gain(torch, view.centre_px, warp, view.nine_points, table)
    expected = (view.count - 2.0) * (interpolated + gain**2)
    return CellSums(gain, misfit, torch.where(gain[..., None].isfinite(), slope, torch.nan), expected)


def _cell_sums(view: TorchView, frames: TorchSplines, number: Tensor, warp: Tensor) -> Tensor:
    """Return the sums (A,C,9) of `cells._compare` over frames (A,) at warps (A,C,6).

    NaN outside the image.
    """
    count = len(view.centre_px)
    flat, cell = warp.reshape(-1, 6), torch.arange(warp.shape[0] * count, device=warp.device) % count
    middle = view.centre_px[cell] + flat[:, ::3]
    reach = flat.reshape(-1, 2, 3)[:, :, 1:] + _eye(2, flat)
    half_size = reach.abs().sum(dim=2) * (view.source.cells.side_px - 1) / 2
    (right, bottom), after = frames.size_px, middle + half_size
    inside = (middle >= half_size).all(dim=1) & (after[:, 0] <= right - 1.0) & (after[:, 1] <= bottom - 1.0)
    frame = number.repeat_interleave(count)
    return square_sums(view, frames, (frame, cell, flat), inside).reshape(*warp.shape[:2], 9)
