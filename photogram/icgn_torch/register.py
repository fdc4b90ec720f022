"""Gauss-Newton registration of all subsets in all frames of a batch at once; the algorithm is `photogram.icgn`'s."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from photogram._checks import FloatArray, check_shape
from photogram.icgn import FREE_PARAMETERS, SMALL_STEP, Registration
from photogram.icgn_torch.frames import TorchSplines, basis_polynomials, corner_of, sample, torch_type
from photogram.reference import Reference, TrackStatus, subset_offsets

if TYPE_CHECKING:
    from torch import Tensor

RUNNING = -1
LOW = int(TrackStatus.LOW_CORRELATION)
WORKING_BYTES = {"cpu": 2**26, "cuda": 2**31}
NUMBERS_PER_PIXEL = 48


@dataclass(frozen=True)
class TorchReference:
    """A `Reference` on a device: N subsets of P pixels.

    pixels (N,3,P) and shape (3,P) = [1, dx, dy] in the precision of the sampling; centre_px (N,2), mean (N,), energy
    (N,), removed (N,2,6), inverse_hessian (N,6,6) in float64; status (N,).
    """

    radius_px: int
    pixels: Tensor
    shape: Tensor
    centre_px: Tensor
    mean: Tensor
    energy: Tensor
    removed: Tensor
    inverse_hessian: Tensor
    status: Tensor


@dataclass(frozen=True)
class _Limits:
    """When a subset is found, and when it is given up."""

    max_iterations: int
    convergence_px: float
    min_zncc: float


def torch_reference(reference: Reference, device: str, precision: str = "float64") -> TorchReference:
    """The reference on the device, its pixels in `precision`: 'float64', or 'float32' for GPUs without fast float64."""
    import torch

    pixel_type = torch_type(precision)
    offsets = subset_offsets(reference.radius_px)
    shape = np.concatenate([np.ones((1, len(offsets))), offsets.T])
    fields = ("centre_px", "mean", "energy", "removed", "inverse_hessian", "status")
    return TorchReference(
        reference.radius_px,
        torch.from_numpy(reference.pixels).to(device, pixel_type),
        torch.from_numpy(shape).to(device, pixel_type),
        **{name: torch.from_numpy(getattr(reference, name)).to(device) for name in fields},
    )


def register_frames(
    reference: TorchReference,
    frames: TorchSplines,
    start: FloatArray,
    max_iterations: int,
    convergence_px: float,
    min_zncc: float,
    working_bytes: int | None = None,
) -> tuple[Registration, ...]:
    """Find every subset in every frame, beginning at the warps `start` (B,N,6); NaN = no start. One result per frame.

    Same steps, stopping rule and statuses as `photogram.icgn.register`. Pairs of frame and subset are worked through
    in portions that need about `working_bytes` on the device (64 MiB on a CPU, 2 GiB on a GPU).
    """
    import torch

    count = len(reference.centre_px)
    check_shape("start", start, (len(frames.coefficients), count, 6))
    device = reference.centre_px.device
    warp = torch.from_numpy(np.ascontiguousarray(start, dtype=np.float64)).to(device).reshape(-1, 6).clone()
    scores = torch.full((len(warp), 3), torch.nan, dtype=torch.float64, device=device)
    outcome = torch.zeros((len(warp), 2), dtype=torch.int64, device=device)
    usable = reference.status.repeat(len(start)).to(torch.int64)
    ready = torch.where(warp.isfinite().all(dim=1), RUNNING, int(TrackStatus.NO_START))
    outcome[:, 0] = torch.where(usable == TrackStatus.OK, ready, usable)
    limits = _Limits(max_iterations, convergence_px, min_zncc)
    budget = WORKING_BYTES[device.type] if working_bytes is None else working_bytes
    size = NUMBERS_PER_PIXEL * reference.shape.shape[1] * reference.shape.element_size()
    for pairs in torch.nonzero(outcome[:, 0] == RUNNING)[:, 0].split(max(1, budget // size)):
        _register_pairs(reference, frames, limits, pairs, (warp, scores, outcome))
    return _registrations(warp, scores, outcome, count)


def _registrations(warp: Tensor, scores: Tensor, outcome: Tensor, count: int) -> tuple[Registration, ...]:
    """Results of all pairs as one Registration of `count` subsets per frame."""
    warps, ratings = warp.cpu().numpy().reshape(-1, count, 6), scores.cpu().numpy().reshape(-1, count, 3)
    outcomes = outcome.cpu().numpy().reshape(-1, count, 2)
    status = outcomes[..., 0].astype(np.int8)
    warps[status != TrackStatus.OK] = np.nan
    return tuple(
        Registration(warps[b], ratings[b, :, 0], ratings[b, :, 1], ratings[b, :, 2], status[b], outcomes[b, :, 1])
        for b in range(len(warps))
    )


def _register_pairs(
    reference: TorchReference,
    frames: TorchSplines,
    limits: _Limits,
    pairs: Tensor,
    state: tuple[Tensor, Tensor, Tensor],
) -> None:
    """Gauss-Newton steps of the pairs (flat frame·N + subset) until all stand still; updates state in place.

    The one wait for the device in every iteration is the choice of the pairs that go on.
    """
    import torch

    all_warp, all_scores, outcome = state
    first_shift = all_warp[pairs][:, [0, 3]]
    polynomials = torch.from_numpy(basis_polynomials(frames.degree)).to(reference.pixels)
    for iteration in range(1, limits.max_iterations + 1):
        warp = all_warp[pairs]
        frame, subset = pairs // len(reference.centre_px), pairs % len(reference.centre_px)
        gone = _gone(reference, frames, subset, warp, first_shift)
        centre, deformation = _placed(reference, subset, warp, gone)
        sums = _correlate(reference, frames, (frame, subset, centre, deformation), polynomials)
        step, scores, improvement = _solve(reference, subset, *sums)
        fate, scores = _judge(reference.radius_px, limits, gone, (step, scores, improvement))
        all_warp[pairs], all_scores[pairs] = _compose_inverse(warp, step), scores
        outcome[pairs] = torch.stack([fate, torch.full_like(fate, iteration)], dim=1)
        going_on = torch.nonzero(fate == RUNNING)[:, 0]
        if len(going_on) == 0:
            return
        pairs, first_shift = pairs[going_on], first_shift[going_on]
    outcome[pairs, 0] = int(TrackStatus.NOT_CONVERGED)


def _gone(reference: TorchReference, frames: TorchSplines, subset: Tensor, warp: Tensor, first_shift: Tensor) -> Tensor:
    """Status (n,) of the pairs that have run away or left the image, `RUNNING` for the others."""
    import torch

    shift = warp[:, [0, 3]]
    centre = reference.centre_px[subset] + shift
    reach = reference.radius_px * torch.stack(
        [(1.0 + warp[:, 1]).abs() + warp[:, 2].abs(), warp[:, 4].abs() + (1.0 + warp[:, 5]).abs()], dim=1
    )
    last = centre.new_tensor(frames.size_px) - 1.0
    inside = ((centre - reach >= 0.0) & (centre + reach <= last)).all(dim=1)
    far = (shift - first_shift).abs().sum(dim=1) > 2.0 * reference.radius_px
    fate = torch.where(inside, RUNNING, int(TrackStatus.LEFT_IMAGE))
    return torch.where(far, int(TrackStatus.NOT_CONVERGED), fate)


def _placed(reference: TorchReference, subset: Tensor, warp: Tensor, gone: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (n,2) and deformations (n,2,2) of the warped subsets; those that are gone shrink to the first pixel."""
    import torch

    centre = reference.centre_px[subset] + warp[:, [0, 3]]
    identity = torch.eye(2, dtype=warp.dtype, device=warp.device)
    deformation = identity + warp[:, [1, 2, 4, 5]].view(-1, 2, 2)
    here = gone == RUNNING
    return torch.where(here[:, None], centre, 0.0), torch.where(here[:, None, None], deformation, 0.0)


def _correlate(
    reference: TorchReference, frames: TorchSplines, pair: tuple[Tensor, Tensor, Tensor, Tensor], polynomials: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Sums (n,) of g and of g², sums (n,3,3) of f̃g, f_x g, f_y g times 1, dx, dy; g without the mean of f.

    Points are placed relative to the pixel under the subset's centre, so that float32 resolves them to 1e-6 px.
    """
    import torch

    frame, subset, centre, deformation = pair
    pixel = centre.floor()
    affine = torch.cat([(centre - pixel)[:, :, None], deformation], dim=2).transpose(0, 1).to(reference.shape.dtype)
    corner = corner_of(frames, frame, pixel.to(torch.int64))
    grey = sample(frames, corner, torch.matmul(affine.contiguous(), reference.shape), polynomials)
    grey -= reference.mean[subset, None].to(grey.dtype)
    products = reference.pixels[subset].mul_(grey[:, None])
    moments = torch.matmul(products, reference.shape.T).to(torch.float64)
    moments[:, 0, 0] = products[:, 0].sum(dim=1, dtype=torch.float64)
    return grey.sum(dim=1, dtype=torch.float64), grey.square().sum(dim=1, dtype=torch.float64), moments


def _solve(
    reference: TorchReference, subset: Tensor, total: Tensor, square: Tensor, products: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Steps (n,6), scores (n,3) = [zncc, gain, residual variance] and improvements (n,); NaN without correlation."""
    import torch

    size, energy, removed = reference.shape.shape[1], reference.energy[subset], reference.removed[subset]
    product = products[:, 0, 0]
    spread, gain = square - total.square() / size, product / energy
    slope = products[:, 1:].reshape(-1, 6) - removed[:, 0] * total[:, None] - removed[:, 1] * product[:, None]
    step = torch.matmul(reference.inverse_hessian[subset], slope[:, :, None])[:, :, 0] / gain[:, None]
    zncc = product / torch.sqrt(spread * energy)
    residual = spread * (1.0 - zncc.square()).clamp(min=0.0) / (size - FREE_PARAMETERS)
    correlated = (spread > 0.0) & (gain > 0.0)
    scores = torch.where(correlated[:, None], torch.stack([zncc, gain, residual], dim=1), torch.nan)
    return step, scores, (step * slope).sum(dim=1)


def _judge(radius: int, limits: _Limits, gone: Tensor, solved: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Status (n,) after this step, `RUNNING` where another is needed, and scores (n,3) of those that stand still."""
    import torch

    step, scores, improvement = solved
    zncc, gain, residual = scores.T
    extent = step.new_tensor([1.0, radius, radius, 1.0, radius, radius])
    still = (step * extent).square().sum(dim=1) < limits.convergence_px**2
    still |= gain * improvement < SMALL_STEP**2 * residual
    fate = torch.where(still, torch.where(zncc >= limits.min_zncc, int(TrackStatus.OK), LOW), RUNNING)
    fate = torch.where(zncc.isfinite(), fate, LOW)
    fate = torch.where(gone == RUNNING, fate, gone)
    return fate, torch.where((still & (gone == RUNNING))[:, None], scores, torch.nan)


def _compose_inverse(warp: Tensor, step: Tensor) -> Tensor:
    """Warps (n,6) ∘ steps⁻¹, both affine."""
    import torch

    a, b, c, d = 1.0 + step[:, 1], step[:, 2], step[:, 4], 1.0 + step[:, 5]
    scale = 1.0 / (a * d - b * c)
    ia, ib, ic, id_ = d * scale, -b * scale, -c * scale, a * scale
    iu, iv = -(ia * step[:, 0] + ib * step[:, 3]), -(ic * step[:, 0] + id_ * step[:, 3])
    p, q, r, s = 1.0 + warp[:, 1], warp[:, 2], warp[:, 4], 1.0 + warp[:, 5]
    across = [warp[:, 0] + p * iu + q * iv, p * ia + q * ic - 1.0, p * ib + q * id_]
    down = [warp[:, 3] + r * iu + s * iv, r * ia + s * ic, r * ib + s * id_ - 1.0]
    return torch.stack(across + down, dim=1)
