"""Overlapping subsets share pixels, and with them their noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photogram._checks import FloatArray, check_shape

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def overlap_correlation(points_px: FloatArray, radius_px: int) -> csr_array:
    """Correlation (N,N) of the positional noise of subsets with sides w = 2·radius + 1 around points_px (N,2).

    ρ = (1 − |Δx|/w)(1 − |Δy|/w), the share of pixels in common, and 0 where there are none. A subset's error is
    H⁻¹ Σ f′ε over its pixels (f′: steepest-descent images, ε: white noise), so two subsets have the covariance
    σ² Hₙ⁻¹ (Σ f′f′ᵀ over the pixels in common) Hₘ⁻¹. In a homogeneous texture that sum is the share times H, and
    translation is orthogonal to the affine terms (Σ f′² d = 0 about the centre), which leaves the share alone.
    A subset with a NaN centre shares nothing.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    check_shape("points_px", points_px, (None, 2))
    if radius_px < 1:
        raise ValueError(f"radius_px: expected at least 1, found {radius_px}")
    count, side = len(points_px), 2 * radius_px + 1
    known = np.flatnonzero(np.isfinite(points_px).all(axis=1))
    pairs = known[cKDTree(points_px[known]).query_pairs(side, p=np.inf, output_type="ndarray")]
    apart = np.abs(points_px[pairs[:, 0]] - points_px[pairs[:, 1]])
    shared = np.prod(np.maximum(1.0 - apart / side, 0.0), axis=1)
    own = np.arange(count)
    rows = np.concatenate([own, pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([own, pairs[:, 1], pairs[:, 0]])
    values = np.concatenate([np.ones(count), shared, shared])
    return csr_array((values, (rows, columns)), shape=(count, count))
