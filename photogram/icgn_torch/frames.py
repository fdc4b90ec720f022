"""Images as B-splines on a device: coefficients of a stack of frames, and their values at many points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, comb, factorial, log
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray, check_shape
from photogram.interpolate import PADDING_PX, POLES, SMALLEST_TERM

if TYPE_CHECKING:
    from torch import Tensor

PRECISIONS = ("float64", "float32")
BLOCK = 128


@dataclass(frozen=True)
class TorchSplines:
    """B images as B-splines of `degree` 3, 5 or 7: coefficients (B,H+8,W+8) on their device, padded as in `Spline`."""

    coefficients: Tensor
    degree: int

    def __post_init__(self) -> None:
        if self.coefficients.ndim != 3 or not self.coefficients.is_contiguous():
            raise ValueError(
                f"coefficients: expected a contiguous tensor of shape (any, any, any), "
                f"found {tuple(self.coefficients.shape)}"
            )
        if self.degree not in POLES:
            raise ValueError(f"degree: expected 3, 5 or 7, found {self.degree}")

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the images."""
        _, height, width = self.coefficients.shape
        return width - 2 * PADDING_PX, height - 2 * PADDING_PX


def spline_frames(images: NDArray[np.generic], degree: int, device: str, precision: str = "float64") -> TorchSplines:
    """The splines through the grey values of images (B,H,W), on the device."""
    return TorchSplines(prefilter(images, degree, device, precision), degree)


def prefilter(images: NDArray[np.generic], degree: int, device: str, precision: str = "float64") -> Tensor:
    """Spline coefficients (B,H+8,W+8) of images (B,H,W), mirrored at the outermost pixels, on the device.

    C = A_H · image · A_Wᵀ with A the exact inverse of the B-spline sampled at whole pixels, its mirrored borders
    included: the recursion of `spline_of_image` as matrix products, which suit a GPU better. Blocks of A are multiplied
    with what reaches them by more than 1e-17.
    """
    import torch

    check_shape("images", images, (None, None, None))
    _, height, width = images.shape
    if min(height, width) < 2 * PADDING_PX:
        raise ValueError(f"images: expected at least {2 * PADDING_PX} x {2 * PADDING_PX} px, found {images.shape[1:]}")
    if degree not in POLES:
        raise ValueError(f"degree: expected 3, 5 or 7, found {degree}")
    native = np.ascontiguousarray(images, dtype=images.dtype.newbyteorder("="))
    raw = torch.from_numpy(native).to(device).to(torch_type(precision))
    down = _filtered(raw.transpose(1, 2).contiguous(), degree)
    return _filtered(down.transpose(1, 2).contiguous(), degree)


def torch_type(precision: str) -> Any:
    """The torch type named 'float64' or 'float32'."""
    import torch

    if precision not in PRECISIONS:
        raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, found {precision!r}")
    return getattr(torch, precision)


def basis_polynomials(degree: int) -> FloatArray:
    """Coefficients (degree+1 powers of t, degree+1 splines) of the B-splines that reach the offset t in [0,1).

    Spline j is β(t + (degree−1)/2 − j), β the sum of truncated powers (Unser 1999, IEEE Signal Process. Mag. 16, 22,
    box 1): β(x) = Σ_k (−1)^k C(n+1,k) max(0, x + (n+1)/2 − k)^n / n!.
    """
    n = degree
    table = np.zeros((n + 1, n + 1))
    for j in range(n + 1):
        for k in range(n - j + 1):
            for power in range(n + 1):
                term = comb(n, power) * (n - j - k) ** (n - power)
                table[power, j] += (-1) ** k * comb(n + 1, k) * term / factorial(n)
    return table


def sample(frames: TorchSplines, corner: Tensor, place_px: Tensor, polynomials: Tensor) -> Tensor:
    """Grey values (n,P) at place_px (2,n,P) [x, y], relative to the pixels whose coefficients begin at corner (n,).

    Every point gathers (degree+1) rows of neighbouring coefficients, overlapping windows of one long line, and sums
    them with its weights down; the weights along x follow.
    """
    import torch
    from torch.nn.functional import embedding_bag

    taps = frames.degree + 1
    line = frames.coefficients.view(-1)
    windows = line.as_strided((line.numel() - taps + 1, taps), (1, 1))
    stride = frames.coefficients.shape[2]
    whole = place_px.floor()
    along, down = _weights((place_px - whole).view(2, -1), polynomials)
    column, row = whole.to(corner.dtype)
    rows = stride * torch.arange(taps, dtype=corner.dtype, device=corner.device)
    first = (corner[:, None] + row * stride + column).view(-1, 1) + rows
    summed = embedding_bag(first, windows, per_sample_weights=down, mode="sum")
    return summed.mul_(along).sum(dim=1).view(place_px.shape[1:])


def corner_of(frames: TorchSplines, frame: Tensor, pixel: Tensor) -> Tensor:
    """Flat indices (n,) of the first coefficients that reach the whole pixels (n,2) of the frames (n,)."""
    import torch

    _, height, width = frames.coefficients.shape
    first = PADDING_PX - frames.degree // 2
    corner = (frame * height + pixel[:, 1] + first) * width + pixel[:, 0] + first
    return corner.to(torch.int32 if frames.coefficients.numel() < 2**31 else torch.int64)


def _weights(fraction: Tensor, polynomials: Tensor) -> Tensor:
    """Values (2,M,degree+1) of the B-splines that reach the offsets (2,M) in [0,1)."""
    import torch

    powers = fraction.new_empty((len(polynomials), *fraction.shape))
    powers[0], powers[1] = 1.0, fraction
    for k in range(2, len(powers)):
        torch.mul(powers[k - 1], fraction, out=powers[k])
    return torch.matmul(powers.permute(1, 2, 0), polynomials)


def _filtered(lines: Tensor, degree: int) -> Tensor:
    """Coefficients (...,n+8) of lines of n pixels (...,n), mirrored by four at both ends."""
    import torch

    inverse = torch.from_numpy(_inverse_filter(lines.shape[-1], degree)).to(lines)
    reach = 2 * PADDING_PX + ceil(log(SMALLEST_TERM) / log(max(map(abs, POLES[degree]))))
    coefficients = lines.new_empty((*lines.shape[:-1], len(inverse)))
    for first in range(0, len(inverse), BLOCK):
        block, near = slice(first, first + BLOCK), slice(max(0, first - reach), first + BLOCK + reach)
        coefficients[..., block] = torch.matmul(lines[..., near], inverse[block, near].T)
    return coefficients


@lru_cache(maxsize=4)
def _inverse_filter(size: int, degree: int) -> FloatArray:
    """Matrix (size+8,size) from the pixels of a line to its spline coefficients, mirrored by four at both ends."""
    reach = degree // 2
    values = basis_polynomials(degree)[0, : 2 * reach + 1]
    sampled = np.zeros((size, size))
    pixel = np.arange(size)
    for offset, value in zip(range(-reach, reach + 1), values, strict=True):
        neighbour = np.abs(pixel + offset)
        np.add.at(sampled, (pixel, np.minimum(neighbour, 2 * (size - 1) - neighbour)), value)
    inverse = np.linalg.inv(sampled)
    inverse[np.abs(inverse) < SMALLEST_TERM] = 0.0
    return np.pad(inverse, ((PADDING_PX, PADDING_PX), (0, 0)), mode="reflect")
