"""The fit of six components batched over frames, for a GPU: `fit_direct` by torch.

Pixels have the splines' precision, usually float32; sums over them, motions and systems of equations are float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from photogram.bspline import noise_gain_table
from photogram.camera import Camera
from photogram.direct.cells import SMALLEST_GAIN, nine_points, pixel_coordinates
from photogram.direct.direct_fit import (
    MAX_FINAL_STEP,
    MAX_MISFIT_RATIO,
    MAX_REMAINING_STEP,
    MAX_STEPS,
    MIN_CELLS,
    MIN_EIGENVALUE,
    MIN_EIGENVALUE_SHARE,
    MIN_MISFIT_RATIO,
    REJECT_CHI2,
    UNCORRECTED_SHARE,
    BodyView,
    DirectFit,
    estimate_shape_amplitudes,
    pose_covariance,
)
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from photogram.images.noise import QUANTISATION
from photogram.motion import MEDIAN_CHI2_OF_TWO
from photogram.subsets.icgn_torch import Squares, TorchSplines, square_sums, torch_type
from photogram.subsets.reference import shape_values
from shakercal._common.arrays import FloatArray

if TYPE_CHECKING:
    import torch
    from torch import Tensor


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
    hessian: Tensor
    rates: Tensor
    information: Tensor
    information_noise: Tensor
    inverse_shift_hessian: Tensor
    steady: Tensor
    points_m: Tensor
    rest_px: Tensor
    turn: Tensor
    origin_m: Tensor
    nine_points: Tensor


class _Compared(NamedTuple):
    """Comparison of one camera's cells with frames, NaN for none.

    gain, misfit and expected misfit (A, C), slope (A, C, 6).
    """

    gain: Tensor
    misfit: Tensor
    expected: Tensor
    slope: Tensor


class _CellSums(NamedTuple):
    """Sums over one camera's cells that show the body, for frames (A,), as in `fit_direct`."""

    information: Tensor
    noise_part: Tensor
    slope: Tensor
    misfit: Tensor
    expected: Tensor
    rounding: Tensor
    count: Tensor


def torch_view(view: BodyView, device: str, precision: str) -> TorchView:
    """Return the view on a device, its pixels of `precision` 'float64' or 'float32'."""
    import torch

    cells, camera_from_body = view.cells, view.camera.camera_from_body
    side, kind = cells.side_px, torch_type(precision)
    cell, reach = cells.of_pixels, (side - 1) / 2
    column, row = np.rint(pixel_coordinates(cells.runs) - cells.centre_px[cell] + reach).astype(np.int64).T
    pixels = np.zeros((len(cells.centre_px), 4, side * side))
    pixels[cell, :, row * side + column] = cells.pixels.T
    down, across = (grid.ravel() - reach for grid in np.mgrid[:side, :side])
    shape = shape_values(np.column_stack([across, down]), 1)
    steady = np.isfinite(view.inverse_shift_hessian[:, 0, 0]) & view.rates[:, :, :6].any(axis=(1, 2))

    from_cells = ("centre_px", "mean", "weight", "energy", "count", "removed", "hessian")
    from_view = ("rates", "information", "information_noise", "inverse_shift_hessian")
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
        steady=torch.from_numpy(steady).to(device),
        **{name: torch.from_numpy(np.array(array, dtype=np.float64)).to(device) for name, array in whole.items()},
    )


_LOADING = Lock()


def load_solvers(device: str) -> None:
    """Make torch load its solvers for a device.

    It loads them on their first call, and not in two threads at once.
    """
    import torch

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
    they converge; only motions, covariances and sums are copied back.
    """
    import torch

    device = views[0].centre_px.device
    rotation = torch.from_numpy(rotation_from_vector(starts[:, 3:])).to(device)
    shift = torch.tensor(starts[:, :3], device=device)
    numbers = [torch.tensor(list(which), device=device) for _, which in targets]
    size = views[0].rates.shape[2]
    matrices = torch.zeros((2, len(starts), size, size), dtype=torch.float64, device=device)
    slopes = torch.zeros((2, len(starts), size), dtype=torch.float64, device=device)  # and last steps
    scales, counts = torch.full((2, len(starts)), torch.nan, dtype=torch.float64, device=device)
    active = torch.arange(len(starts), device=device)
    for _ in range(MAX_STEPS):
        compared = [
            _compared(view, frames, number[active], rotation[active], shift[active])
            for view, (frames, _), number in zip(views, targets, numbers, strict=True)
        ]
        step = torch.zeros((len(active), 6), dtype=torch.float64, device=device)
        for _ in range(2):  # the cells are judged after the step of all of them
            parts = [_sum_cells(view, cells, step) for view, cells in zip(views, compared, strict=True)]
            total = _CellSums(*(torch.stack(values).sum(dim=0) for values in zip(*parts, strict=True)))
            of_motion, noise_part = total.information[:, :6, :6], total.noise_part[:, :6, :6]
            lowest = torch.linalg.eigvalsh(_scaled(of_motion))[:, 0]
            solvable = (total.count >= MIN_CELLS) & (lowest > MIN_EIGENVALUE)
            information = torch.where(solvable[:, None, None], of_motion, _eye(6, of_motion))
            scale = torch.maximum(total.misfit, total.rounding) / total.expected
            clean = information - torch.where(solvable, scale, 0.0)[:, None, None] * noise_part
            enough = solvable & (torch.linalg.eigvalsh(_scaled(clean))[:, 0] > MIN_EIGENVALUE_SHARE * lowest)
            step = torch.linalg.solve(torch.where(enough[:, None, None], clean, information), total.slope[:, :6])
        new_rotation, moved = _compose_inverse(rotation[active], shift[active], step)
        length = torch.sqrt(torch.einsum("ai,aij,aj->a", step, information, step) / scale)
        noise = torch.linalg.solve(information, noise_part).diagonal(dim1=1, dim2=2).sum(dim=1)
        left = scale * noise / 6.0 * torch.where(enough, UNCORRECTED_SHARE, 1.0)
        found = solvable & (length < MAX_FINAL_STEP) & (left * length < MAX_REMAINING_STEP)
        rotation[active], shift[active] = new_rotation, moved
        matrices[0, active], matrices[1, active] = total.information, total.noise_part
        slopes[0, active], slopes[1, active, :6] = total.slope, step
        scales[active], counts[active] = torch.where(found, scale, torch.nan), total.count.to(scales)
        active = active[solvable & ~found]
        if len(active) == 0:
            break
    found_on_device = (rotation, shift, matrices, slopes, scales, counts)
    turns, shifts, both, slopes_and_steps, levels, cells = (part.cpu().numpy() for part in found_on_device)
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
        fits[f] = DirectFit(moved, covariances[k], float(level[k]), int(cells[f]), amplitudes[k], of_shapes[k])
    return fits


def _compose_inverse(rotation: Tensor, shift: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Return T·δ⁻¹ of motions (A,3,3), (A,3) and steps (A,6) of shift and rotation vector."""
    from kornia.geometry.liegroup import So3

    rotated = rotation @ So3.exp(step[:, 3:]).matrix().transpose(1, 2)
    return rotated, shift - (rotated @ step[:, :3, None])[..., 0]


@lru_cache(maxsize=16)
def _lens(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the camera's matrix and distortion on a device."""
    import torch

    matrix, lens = (torch.from_numpy(part).to(device) for part in (camera.matrix, camera.distortion))
    return matrix, lens


@lru_cache(maxsize=4)
def _noise_gains(degree: int, device: torch.device) -> Tensor:
    """Return `bspline.noise_gain_table` on a device."""
    import torch

    return torch.from_numpy(noise_gain_table(degree)).to(device)


def _eye(size: int, like: Tensor) -> Tensor:
    import torch

    return torch.eye(size, dtype=like.dtype, device=like.device)


def torch_project(camera: Camera, points_m: Tensor) -> Tensor:
    """Return `camera.project` of points (..., 3) in the camera frame, float64, on their device."""
    import torch
    from kornia.geometry.calibration import distort_points

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
    import torch

    rotated = view.turn @ rotation @ view.turn.T  # in the camera's frame the body moves by C·T·C⁻¹, C its pose
    moved = shift @ view.turn.T + view.origin_m - (rotated @ view.origin_m[:, None])[..., 0]
    seen = torch_project(view.source.camera.camera, view.points_m @ rotated.transpose(1, 2) + moved[:, None])
    shift_px = seen.reshape(len(shift), -1, 5, 2) - view.rest_px
    arm = 2.0 * view.source.patches.arm_px
    along, down = (shift_px[:, :, 1] - shift_px[:, :, 2]) / arm, (shift_px[:, :, 3] - shift_px[:, :, 4]) / arm
    return torch.stack([shift_px[:, :, 0], along, down], dim=3).flatten(2)


def _compared(view: TorchView, frames: TorchSplines, number: Tensor, rotation: Tensor, shift: Tensor) -> _Compared:
    """Compare a camera's frames `number` (A,) at motions (A, 3, 3), (A, 3): `cells.compare_cells`."""
    import torch

    warp = _warps(view, rotation, shift)
    sums = _cell_sums(view, frames, number, warp)
    gain = sums[..., 2] / view.energy
    misfit = (sums[..., 1] - sums[..., 0] ** 2 / view.weight - gain**2 * view.energy).clamp(min=0.0)
    slope = sums[..., 3:] - view.removed[:, 0] * sums[..., :1] - view.removed[:, 1] * sums[..., 2:3]
    gain = torch.where(gain > SMALLEST_GAIN, gain, torch.nan)
    expected = (view.count - 2.0) * (_interpolated_noise(view, warp, frames.degree) + gain**2)
    return _Compared(gain, misfit, expected, torch.where(gain[..., None].isfinite(), slope, torch.nan))


def _sum_cells(view: TorchView, cells: _Compared, step: Tensor) -> _CellSums:
    """Return the sums over the cells that show the body after a step (A, 6)."""
    import torch

    gain, misfit, expected, slope = cells
    carried = torch.einsum("cij,acj->aci", view.hessian, torch.einsum("cij,aj->aci", view.rates[:, :, :6], step))
    used = _rigid_cells(view, misfit / expected, slope - gain[..., None] * carried)

    def over_cells(values: Tensor) -> Tensor:
        return torch.where(used, values, 0.0).sum(dim=1)

    share = torch.where(used, gain, 0.0)
    return _CellSums(
        torch.einsum("ac,cij->aij", share**2, view.information),
        torch.einsum("ac,cij->aij", share**2, view.information_noise),
        torch.einsum("ac,cij,aci->aj", share, view.rates, torch.where(used[..., None], slope, 0.0)),
        over_cells(misfit),
        over_cells(expected),
        over_cells(QUANTISATION * expected * view.weight / view.count),
        used.sum(dim=1),
    )


def _cell_sums(view: TorchView, frames: TorchSplines, number: Tensor, warp: Tensor) -> Tensor:
    """Return the sums (A,C,9) of `cells._compare` over frames (A,) at warps (A,C,6).

    NaN outside the image.
    """
    import torch

    count = len(view.centre_px)
    flat, cell = warp.reshape(-1, 6), torch.arange(warp.shape[0] * count, device=warp.device) % count
    middle = view.centre_px[cell] + flat[:, ::3]
    reach = flat.reshape(-1, 2, 3)[:, :, 1:] + _eye(2, flat)
    half_size = reach.abs().sum(dim=2) * (view.source.cells.side_px - 1) / 2
    (right, bottom), after = frames.size_px, middle + half_size
    inside = (middle >= half_size).all(dim=1) & (after[:, 0] <= right - 1.0) & (after[:, 1] <= bottom - 1.0)
    frame = number.repeat_interleave(count)
    return square_sums(view, frames, (frame, cell, flat), inside).reshape(*warp.shape[:2], 9)


def _interpolated_noise(view: TorchView, warp: Tensor, degree: int) -> Tensor:
    """Variance (A,C) of interpolated white noise at warps (A,C,6): `bspline.mean_noise_gain` at nine points."""
    import torch

    table = _noise_gains(degree, warp.device)
    swapped = warp.reshape(*warp.shape[:2], 2, 3)[..., 1:] + _eye(2, warp)
    middle = view.centre_px + warp[..., ::3]
    table_position = torch.einsum("acij,pj->acpi", swapped, view.nine_points) + middle[:, :, None]
    table_position = torch.nan_to_num(table_position - table_position.floor()) * (len(table) - 1)
    low = table_position.floor().to(torch.int64).clamp(0, len(table) - 2)
    gains = table[low] + (table_position - low) * (table[low + 1] - table[low])
    return torch.where(warp.isfinite().all(dim=2), gains.prod(dim=3).mean(dim=2), torch.nan)


def _rigid_cells(view: TorchView, ratio: Tensor, slope: Tensor) -> Tensor:
    """Return which cells (A,C) show the body, by misfit ratio (A,C) and slope (A,C,6)."""
    finite = ratio.isfinite() & slope.isfinite().all(dim=2) & view.steady
    typical = _median(ratio, finite).clamp(min=MIN_MISFIT_RATIO)[:, None]
    finite &= ratio <= MAX_MISFIT_RATIO * typical
    cell_shift = slope[..., ::3]
    squares = (cell_shift[..., None] * cell_shift[..., None, :] * view.inverse_shift_hessian).sum(dim=(2, 3)) / typical
    limit = REJECT_CHI2 * (_median(squares, finite) / MEDIAN_CHI2_OF_TWO).clamp(min=1.0)
    return finite & (squares <= limit[:, None])


def _median(values: Tensor, finite: Tensor) -> Tensor:
    """Median (A,) of the known ones of values (A, C), infinite where there is none."""
    import torch

    ordered = torch.where(finite, values, torch.inf).sort(dim=1).values
    count = finite.sum(dim=1, keepdim=True).clamp(min=1)
    return 0.5 * (ordered.gather(1, (count - 1) // 2) + ordered.gather(1, count // 2))[:, 0]


def _scaled(matrices: Tensor) -> Tensor:
    """Symmetric matrices (A,6,6) scaled to unit diagonals; zeros where a diagonal is not positive."""
    import torch

    diagonal = matrices.diagonal(dim1=1, dim2=2)
    scale = torch.where(diagonal > 0.0, diagonal, torch.inf).rsqrt()
    return matrices * scale[:, :, None] * scale[:, None, :]
