"""Inverse-compositional Gauss-Newton batched over frames and subsets, for a GPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib.util import find_spec
from math import ceil, log
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import embedding_bag

from photogram.bspline import PADDING_PX, poles_of
from photogram.lanes import basis_polynomials
from photogram.subsets.icgn import (
    GAIN_AND_OFFSET,
    LINEAR_PX,
    REMAINING,
    SMALL_STEP,
    Registration,
    TrackSettings,
    affine_part,
    compose_with_inverse,
    reject_poor_curvature,
    starts_from_affine,
)
from photogram.subsets.reference import ReferenceSubsets, TrackStatus, shape_values, subset_offsets
from shakercal._common.arrays import FloatArray, check_shape

# Images as B-splines on a device: coefficients of a stack of frames, and their values at many points.

PRECISIONS = ("float64", "float32")
PRECISION = "float32"
"""Of pixels and coefficients on a GPU; sums over them are float64."""
BLOCK, SMALLEST_TERM = 128, 1e-17  # rows of a product of matrices; entries below double precision


@dataclass(frozen=True)
class TorchSplines:
    """B images as B-splines of `degree` 3, 5 or 7 on a device.

    coefficients (B, H+8, W+8), padded as in `Spline`.
    """

    coefficients: Tensor
    degree: int

    def __post_init__(self) -> None:
        if self.coefficients.ndim != 3 or not self.coefficients.is_contiguous():
            raise ValueError(
                f"coefficients: expected a contiguous tensor of shape (any, any, any), "
                f"found {tuple(self.coefficients.shape)}"
            )
        poles_of(self.degree)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the images."""
        _, height, width = self.coefficients.shape
        return width - 2 * PADDING_PX, height - 2 * PADDING_PX


def upload_images(images: Sequence[NDArray[np.generic]], device: str) -> tuple[NDArray[np.generic], Tensor]:
    """Return B images (B, H, W) in memory and on the device.

    A GPU receives them from pinned memory, in parallel to its computations.
    """
    kind = np.result_type(*{image.dtype for image in images}).newbyteorder("=")
    on_gpu = torch.device(device).type == "cuda"
    dtype = torch.from_numpy(np.empty(0, kind)).dtype
    stack = torch.empty((len(images), *images[0].shape), dtype=dtype, pin_memory=on_gpu)
    in_memory: NDArray[np.generic] = stack.numpy()
    for image, target in zip(images, in_memory, strict=True):
        np.copyto(target, image)
    if not on_gpu:
        return in_memory, stack.to(device)
    stream = torch.cuda.Stream(device)
    with torch.cuda.stream(stream):
        raw = stack.to(device, non_blocking=True)
    stream.synchronize()
    raw.record_stream(torch.cuda.default_stream(device))
    return in_memory, raw


def splines_of(raw: Tensor, degree: int, precision: str) -> TorchSplines:
    """Return the splines of images (B, H, W) that are on a device.

    C = A_H · image · A_Wᵀ with A the exact inverse of the B-spline sampled at whole pixels, its mirrored borders
    included: the recursion of `spline_of_image` as matrix products, which suit a GPU better. Entries of A below 1e-17
    are neglected.
    """
    down = _filtered(raw.to(torch_type(precision)).transpose(1, 2).contiguous(), degree)
    return TorchSplines(_filtered(down.transpose(1, 2).contiguous(), degree), degree)


def torch_type(precision: str) -> Any:
    """Return the torch type named 'float64' or 'float32'."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, found {precision!r}")
    return getattr(torch, precision)


def sample(frames: TorchSplines, corner: Tensor, position_px: Tensor, polynomials: Tensor) -> Tensor:
    """Return grey values (n, P) at positions (2, n, P) relative to pixels.

    corner (n,): where the coefficients of these pixels begin. A point gathers degree + 1 rows of coefficients, windows
    of one long line, weighted down and then along x.
    """
    taps = frames.degree + 1
    line = frames.coefficients.view(-1)
    windows = line.as_strided((line.numel() - taps + 1, taps), (1, 1))
    stride = frames.coefficients.shape[2]
    whole = position_px.floor()
    # Values (2,M,degree+1) of the B-splines that reach the offsets (2,M) in [0,1)
    fraction = (position_px - whole).view(2, -1)
    powers = fraction.new_empty((len(polynomials), *fraction.shape))
    powers[0], powers[1] = 1.0, fraction
    for k in range(2, len(powers)):
        torch.mul(powers[k - 1], fraction, out=powers[k])
    along, down = torch.matmul(powers.permute(1, 2, 0), polynomials)
    column, row = whole.to(corner.dtype)
    rows = stride * torch.arange(taps, dtype=corner.dtype, device=corner.device)
    first = (corner[:, None] + row * stride + column).view(-1, 1) + rows
    summed = embedding_bag(first, windows, per_sample_weights=down, mode="sum")
    return summed.mul_(along).sum(dim=1).view(position_px.shape[1:])


def sample_warped(frames: TorchSplines, squares: tuple[Tensor, Tensor, Tensor], shape: Tensor, basis: Tensor) -> Tensor:
    """Return grey values (n,P) at warped squares: frames (n,), centres (n,2), warps (n,6 or 12).

    shape (s, P) of their points, as in `TorchReference`. Points are relative to the pixel under the square's centre, so
    that float32 resolves them to 1e-6 px; `basis`: `basis_polynomials` on the device.
    """
    frame, centre_px, warp = squares
    polynomials = _polynomials(warp)
    polynomials[:, :, 0] += centre_px
    pixel = polynomials[:, :, 0].floor()
    polynomials[:, :, 0] -= pixel
    positions = torch.matmul(polynomials.transpose(0, 1).to(shape.dtype).contiguous(), shape)
    return sample(frames, corner_of(frames, frame, pixel.to(torch.int64)), positions, basis)


def corner_of(frames: TorchSplines, frame: Tensor, pixel: Tensor) -> Tensor:
    """Return flat indices (n,) of the first coefficients of whole pixels (n,2) of frames (n,)."""
    _, height, width = frames.coefficients.shape
    first = PADDING_PX - frames.degree // 2
    corner = (frame * height + pixel[:, 1] + first) * width + pixel[:, 0] + first
    return corner.to(torch.int32 if frames.coefficients.numel() < 2**31 else torch.int64)


def _filtered(lines: Tensor, degree: int) -> Tensor:
    """Return coefficients (..., n+8) of lines of n pixels, mirrored by four at both ends."""
    inverse = _inverse_filter(lines.shape[-1], degree, lines.device, lines.dtype)
    reach = 2 * PADDING_PX + ceil(log(SMALLEST_TERM) / log(max(map(abs, poles_of(degree)))))
    coefficients = lines.new_empty((*lines.shape[:-1], len(inverse)))
    for first in range(0, len(inverse), BLOCK):
        block, near = slice(first, first + BLOCK), slice(max(0, first - reach), first + BLOCK + reach)
        coefficients[..., block] = torch.matmul(lines[..., near], inverse[block, near].T)
    return coefficients


@lru_cache(maxsize=8)
def _inverse_filter(size: int, degree: int, device: Any, kind: Any) -> Tensor:
    """Return the matrix (size+8, size) from the pixels of a line to its spline coefficients.

    The line is mirrored by four at both ends.
    """
    reach = degree // 2
    values = basis_polynomials(degree)[0, : 2 * reach + 1]
    sampled = np.zeros((size, size))
    pixel = np.arange(size)
    for offset, value in zip(range(-reach, reach + 1), values, strict=True):
        neighbour = np.abs(pixel + offset)
        np.add.at(sampled, (pixel, np.minimum(neighbour, 2 * (size - 1) - neighbour)), value)
    inverse = np.linalg.inv(sampled)
    inverse[np.abs(inverse) < SMALLEST_TERM] = 0.0
    padded = np.pad(inverse, ((PADDING_PX, PADDING_PX), (0, 0)), mode="reflect")
    return torch.from_numpy(padded).to(device, kind)


# Sums over the pixels of squares that are warped into frames: of subsets, and of the cells of `direct.fit_torch`.

WORKING_BYTES = {"cpu": 2**26, "cuda": 2**31}  # of a portion: fits into a processor's cache, and into a GPU
NUMBERS_PER_PIXEL = 48  # of temporary arrays, with spline weights of degree 5


@dataclass(frozen=True)
class Squares:
    """N squares of P pixels on a device.

    pixels (N, 3, P) = f̃, f_x, f_y or, with a weight w of each, (N, 4, P) = w, w·f̃, w·f_x, w·f_y. The shape (s, P) is
    [1, dx, dy] or [1, dx, dy, dx²/2, dx dy, dy²/2]. Both have the precision of the sampling. In float64: centre_px (N,
    2) and mean (N,) of the grey values in the reference.
    """

    pixels: Tensor
    shape: Tensor
    centre_px: Tensor
    mean: Tensor


Pairs = tuple[Tensor, Tensor, Tensor]
"""Frames (n,) and squares (n,) that are compared, and the warps (n,6 or 12)."""


def square_sums(squares: Squares, frames: TorchSplines, pairs: Pairs, alive: Tensor) -> Tensor:
    """Return sums (n,3+2s) over the warped squares, NaN for pairs not alive (n,).

    The sums are w·g, w·g², w·f̃·g, w·f_x·g and w·f_y·g, the last two times the s shape functions. g is the warped
    square's grey values without the mean of the reference. One kernel on a GPU with Triton. Otherwise torch's
    operations, in portions that need about 64 MiB on a CPU, 2 GiB on a GPU.
    """
    frame, square, warp = pairs
    sums = warp.new_full((len(warp), 3 + warp.shape[1]), torch.nan)
    if frames.coefficients.is_cuda and frames.coefficients.dtype == torch.float32 and (kernel := _kernel()):
        kernel(squares, frames, pairs, alive, sums, basis_polynomials(frames.degree))
        return sums
    basis = torch.from_numpy(basis_polynomials(frames.degree)).to(squares.pixels)
    size = NUMBERS_PER_PIXEL * squares.shape.shape[1] * squares.shape.element_size()
    for some in torch.nonzero(alive)[:, 0].split(max(1, WORKING_BYTES[warp.device.type] // size)):
        sums[some] = _portion_sums(squares, frames, (frame[some], square[some], warp[some]), basis)
    return sums


@cache
def _kernel() -> Callable[..., None] | None:
    """Return `sums_triton.square_sums` if Triton is installed (by PyTorch for CUDA on Linux)."""
    if find_spec("triton") is None:
        return None
    from photogram.subsets.sums_triton import square_sums as kernel

    return kernel


def _portion_sums(squares: Squares, frames: TorchSplines, pairs: Pairs, basis: Tensor) -> Tensor:
    """Return the sums (n, 3+2s) by torch's operations; basis: `basis_polynomials` on the device."""
    frame, square, warp = pairs
    grey = sample_warped(frames, (frame, squares.centre_px[square], warp), squares.shape, basis)
    grey -= squares.mean[square, None].to(grey.dtype)
    products = squares.pixels[square].mul_(grey[:, None])
    weighted = products[:, 0] if products.shape[1] > 3 else grey
    exact = [weighted, weighted * grey, products[:, -3]]
    slopes = torch.matmul(products[:, -2:], squares.shape.T).flatten(1).to(torch.float64)
    return torch.cat([torch.stack([one.sum(dim=1, dtype=torch.float64) for one in exact], dim=1), slopes], dim=1)


# Gauss-Newton registration of all subsets in all frames of a batch at once, by the algorithm of `subsets.icgn`.

RUNNING = -1


@dataclass(frozen=True)
class TorchReference(Squares):
    """`ReferenceSubsets` on a device: N subsets with m parameters of order 0, 1 or 2.

    m = 2, 6 or 12. In float64: rim (s,), the largest values of the shape functions, energy (N,), removed (N, 2, m) and
    inverse_hessian (N, m, m). The source is the subsets in memory, status (N,) theirs. In order 2 `affine` has the same
    subsets with order 1.
    """

    radius_px: int
    order: int
    rim: Tensor
    energy: Tensor
    removed: Tensor
    inverse_hessian: Tensor
    status: Tensor
    source: ReferenceSubsets
    affine: TorchReference | None = None

    @property
    def columns(self) -> int:
        """Length of a warp: 6, or 12 for order 2."""
        return 2 * len(self.shape)


def torch_reference(reference: ReferenceSubsets, device: str, precision: str = "float64") -> TorchReference:
    """Return the reference on the device, its pixels in `precision` 'float64' or 'float32'.

    The latter is for GPUs without fast float64.
    """
    pixel_type = torch_type(precision)
    shape = shape_values(subset_offsets(reference.radius_px), max(reference.order, 1))
    pixels = torch.from_numpy(reference.pixels).to(device, pixel_type)

    def prepared(source: ReferenceSubsets, values: FloatArray, affine: TorchReference | None) -> TorchReference:
        fields = ("centre_px", "mean", "energy", "removed", "inverse_hessian", "status")
        return TorchReference(
            pixels=pixels,
            shape=torch.from_numpy(values).to(device, pixel_type),
            rim=torch.from_numpy(values.max(axis=1)).to(device),
            radius_px=source.radius_px,
            order=source.order,
            **{name: torch.from_numpy(getattr(source, name)).to(device) for name in fields},
            source=source,
            affine=affine,
        )

    if reference.affine is None:
        return prepared(reference, shape, None)
    first = replace(reference.affine, status=reference.status)
    return prepared(reference, shape, prepared(first, shape[:3], None))


def register_frames(
    reference: TorchReference, frames: TorchSplines, start: FloatArray, settings: TrackSettings
) -> tuple[Registration, ...]:
    """Find every subset in every frame from warps `start` (B,N,6); return one result per frame.

    NaN is no start. Order 2 has warps (N, 12), accepts starts (B, N, 12), and starts from order 1. Same steps, stopping
    rule and statuses as `photogram.subsets.icgn.register`.
    """
    if reference.affine is None:
        return _found_in_frames(reference, frames, start, settings)
    given = 12 if start.shape[2:] == (12,) else 6
    check_shape("start", start, (len(frames.coefficients), len(reference.centre_px), given))
    whole = np.pad(start, ((0, 0), (0, 0), (0, 12 - given)))
    first = _found_in_frames(reference.affine, frames, affine_part(whole), settings)
    curved = np.stack([starts_from_affine(frame_start, plain) for frame_start, plain in zip(whole, first, strict=True)])
    found = _found_in_frames(reference, frames, curved, settings)
    return tuple(
        reject_poor_curvature(reference.source, frame_start, plain)
        for frame_start, plain in zip(found, first, strict=True)
    )


def _found_in_frames(
    reference: TorchReference, frames: TorchSplines, start: FloatArray, settings: TrackSettings
) -> tuple[Registration, ...]:
    """Iterate all subsets in all frames from the starts (B, N, 6 or 12)."""
    count, columns, device = len(reference.centre_px), reference.columns, reference.centre_px.device
    given = columns if start.shape[2:] == (columns,) else 6
    check_shape("start", start, (len(frames.coefficients), count, given))
    warp = torch.zeros((start.size // given, columns), dtype=torch.float64, device=device)
    warp[:, :given] = torch.from_numpy(np.ascontiguousarray(start, dtype=np.float64)).to(device).view(-1, given)
    scores = torch.full((len(warp), 3), torch.nan, dtype=torch.float64, device=device)
    outcome = torch.zeros((len(warp), 2), dtype=torch.int64, device=device)
    usable = reference.status.repeat(len(start)).to(torch.int64)
    ready = torch.where(warp.isfinite().all(dim=1), RUNNING, int(TrackStatus.NO_START))
    outcome[:, 0] = torch.where(usable == TrackStatus.OK, ready, usable)
    running = torch.nonzero(outcome[:, 0] == RUNNING)[:, 0]
    _register_pairs(reference, frames, settings, running, (warp, scores, outcome))
    warps, ratings, outcomes = (
        values.cpu().numpy().reshape(-1, count, values.shape[1]) for values in (warp, scores, outcome)
    )
    status = outcomes[..., 0].astype(np.int8)
    warps[status != TrackStatus.OK] = np.nan
    return tuple(
        Registration(warps[b], ratings[b, :, 0], ratings[b, :, 1], ratings[b, :, 2], status[b], outcomes[b, :, 1])
        for b in range(len(warps))
    )


def _register_pairs(
    reference: TorchReference,
    frames: TorchSplines,
    settings: TrackSettings,
    pairs: Tensor,
    state: tuple[Tensor, Tensor, Tensor],
) -> None:
    """Iterate the pairs (flat frame·N + subset) until all converge; update state in place.

    Each iteration waits once for the device: to choose the pairs that continue.
    """
    all_warp, all_scores, outcome = state
    first_shift = all_warp[pairs][:, :6:3]
    for iteration in range(1, settings.max_iterations + 1):
        if len(pairs) == 0:
            return
        warp = all_warp[pairs]
        frame, subset = pairs // len(reference.centre_px), pairs % len(reference.centre_px)
        gone = _lost_status(reference, frames, subset, warp, first_shift)
        sums = square_sums(reference, frames, (frame, subset, warp), gone == RUNNING)
        step, scores, fate = _solve(reference, settings, (subset, gone), sums)
        all_warp[pairs], all_scores[pairs] = _compose_inverse(warp, step), scores
        outcome[pairs] = torch.stack([fate, torch.full_like(fate, iteration)], dim=1)
        going_on = torch.nonzero(fate == RUNNING)[:, 0]
        pairs, first_shift = pairs[going_on], first_shift[going_on]
    outcome[pairs, 0] = int(TrackStatus.NOT_CONVERGED)


def _lost_status(
    reference: TorchReference, frames: TorchSplines, subset: Tensor, warp: Tensor, first_shift: Tensor
) -> Tensor:
    """Return the status (n,) of pairs that diverged or left the image, else `RUNNING`."""
    radius, shift = reference.radius_px, warp[:, :6:3]
    centre = reference.centre_px[subset] + shift
    reach = _polynomials(warp)[:, :, 1:].abs() @ reference.rim[1:]
    after, (right, bottom) = centre + reach, frames.size_px
    inside = (centre >= reach).all(dim=1) & (after[:, 0] <= right - 1.0) & (after[:, 1] <= bottom - 1.0)
    far = (shift - first_shift).abs().sum(dim=1) > 2.0 * radius
    fate = torch.full_like(subset, RUNNING).masked_fill_(~inside, int(TrackStatus.LEFT_IMAGE))
    return fate.masked_fill_(far, int(TrackStatus.NOT_CONVERGED))


def _solve(
    reference: TorchReference, settings: TrackSettings, pair: tuple[Tensor, Tensor], sums: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return steps (n,6 or 12), scores (n,3) of the converged pairs, and statuses (n,).

    Pairs are subset and status. Scores are [zncc, gain, residual variance]. The status is `RUNNING` where another step
    is needed.
    """
    (subset, gone), (total, square, product), rim = pair, sums[:, :3].unbind(dim=1), reference.rim
    size, energy, removed = reference.shape.shape[1], reference.energy[subset], reference.removed[subset]
    spread, gain = square - total.square() / size, product / energy
    moments = sums[:, 3:].unflatten(1, (2, -1))
    slope = moments[:, :, 0] if reference.order == 0 else _columns(moments)
    slope = slope - removed[:, 0] * total[:, None] - removed[:, 1] * product[:, None]
    step = torch.matmul(reference.inverse_hessian[subset], slope[:, :, None])[:, :, 0] / gain[:, None]
    improvement = (step * slope).sum(dim=1)
    left = (spread - (product + improvement) * gain).clamp(min=0.0)
    zncc, residual = (1.0 - left / spread).clamp(min=0.0).sqrt(), left / (size - slope.shape[1] - GAIN_AND_OFFSET)
    zncc = zncc.masked_fill((spread <= 0.0) | (gain <= 0.0), torch.nan)
    remaining = REMAINING[slope.shape[1]]
    small = gain * improvement < (SMALL_STEP / remaining) ** 2 * slope.shape[1] * residual
    if reference.order == 0:
        step = torch.stack([step, torch.zeros_like(step), torch.zeros_like(step)], dim=2).flatten(1)
    moved = (step[:, :6].view(-1, 2, 3) * rim[:3]).square().sum(dim=(1, 2))
    moved = moved + rim[1] ** 4 / 4.0 * step[:, 6:].square().sum(dim=1)
    converged = (moved < LINEAR_PX**2) & (small | (remaining**2 * moved < settings.convergence_px**2))
    converged &= zncc.isfinite() & (gone == RUNNING)
    similar = zncc >= settings.min_zncc
    fate = torch.full_like(gone, RUNNING).masked_fill_(converged & similar, int(TrackStatus.OK))
    fate.masked_fill_((converged & ~similar) | ~zncc.isfinite(), int(TrackStatus.LOW_CORRELATION))
    scores = torch.stack([zncc, gain, residual], dim=1).masked_fill(~converged[:, None], torch.nan)
    return step, scores, torch.where(gone == RUNNING, fate, gone)


def _polynomials(warp: Tensor) -> Tensor:
    """Return polynomial coefficients (n,2,s) in dx and dy of warps (n,6 or 12).

    Of 1, dx, dy, dx²/2, dx dy, dy²/2.
    """
    coefficients = torch.cat(
        [warp[:, :6].view(-1, 2, 3), warp[:, 6:].reshape(len(warp), 2, (warp.shape[1] - 6) // 2)], dim=2
    )
    coefficients[:, 0, 1] += 1.0
    coefficients[:, 1, 2] += 1.0
    return coefficients


def _columns(values: Tensor) -> Tensor:
    """Return values (n, 2, s) in the order of a warp (n, 6 or 12)."""
    return torch.cat([values[:, :, :3].flatten(1), values[:, :, 3:].flatten(1)], dim=1)


def _compose_inverse(warp: Tensor, step: Tensor) -> Tensor:
    """Return warps (n, 6 or 12) ∘ steps⁻¹.

    Affine, or polynomials of second order as matrices on their powers (Gao 2015).
    """
    if warp.shape[1] == 6:
        return torch.stack(compose_with_inverse(warp.T, step.T), dim=1)
    product = torch.matmul(_matrices(warp), torch.linalg.inv_ex(_matrices(step)).inverse)
    coefficients = product[:, 1:3].clone()
    coefficients[:, :, 3::2] *= 2.0
    coefficients[:, 0, 1] -= 1.0
    coefficients[:, 1, 2] -= 1.0
    return _columns(coefficients)


def _matrices(warp: Tensor) -> Tensor:
    """Return the matrices (n,6,6) of warps (n,12) on [1,dx,dy,dx²,dx dy,dy²], truncated."""
    coefficients = _polynomials(warp)
    coefficients[:, :, 3::2] *= 0.5
    x, y = coefficients.unbind(dim=1)
    one = torch.zeros_like(x)
    one[:, 0] = 1.0
    return torch.stack([one, x, y, _product(x, x), _product(x, y), _product(y, y)], dim=1)


def _product(p: Tensor, q: Tensor) -> Tensor:
    """Multiply polynomials (n,6) in [1,dx,dy,dx²,dx dy,dy²], truncated to second order."""
    product = p[:, :1] * q + q[:, :1] * p
    product[:, 0] = p[:, 0] * q[:, 0]
    product[:, 3] += p[:, 1] * q[:, 1]
    product[:, 4] += p[:, 1] * q[:, 2] + p[:, 2] * q[:, 1]
    product[:, 5] += p[:, 2] * q[:, 2]
    return product
