"""Grids of round dots in a picture: their places in the lattice and the centres of the ellipses that are seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photogram._checks import BoolArray, FloatArray, IntArray, check_shape
from photogram.target.blobs import Blobs, find_blobs
from photogram.target.ellipse import Ellipses, fit_ellipses
from photogram.target.lattice import Lattice, find_lattice, local_fit
from photogram.target.picture import check_blur, check_exposure, outline, picture_fault
from photogram.target.view import Target, TargetNotFound, TargetView

LEAST_DOTS = 12
WINDOWS = (1 / 6, 1 / 20, 2 / 5)
ROUGHNESS = (0.5, 0.06)
OFF_LATTICE = 0.1
QUARTER_TURN = np.array([[0, -1], [1, 0]])


class _Failure(NamedTuple):
    """Why an attempt failed, and how many dots it had found."""

    dots: int
    reason: str


@dataclass(frozen=True, eq=False)
class _Grid:
    """Dots with sub-pixel ellipses and places on a lattice that is turned and, if need be, mirrored to be right-handed
    in the picture (first index to the right, second down, if turned suitably).

    `ring` (N,): which are ring markers; `jacobian` (N, 2, 2): pixels per lattice step.
    """  # fmt: skip

    index: IntArray
    ellipses: Ellipses
    ring: BoolArray
    jacobian: FloatArray


def find_dots(image: NDArray[Any], target: Target, name: str, full_scale: int) -> TargetView:
    """Return the dots of a target of kind "dots" or "asymmetric-dots" in a picture (H, W).

    With three ring markers (dots with a hole) the places count from the ring at the corner of their L: the longer arm
    is x, the shorter one y, and y points up in the picture when x points to the right; the dots may run over the
    picture's edge. Arms of the same length are told apart by that handedness. Dots cut by the edge are left out.

    Without rings all `target.size` dots must be seen, and places count from a corner: first index to the right, second
    down, turned such that the first runs to the right as far as the grid's symmetry leaves a choice (half turns, of a
    square grid quarter turns). A plain grid cannot show whether the picture is mirrored. An asymmetric one has the
    places (2 i + j mod 2, j), i-th dot of row j, as in OpenCV; with an odd number of rows its half turns and mirroring
    are told apart or not as its symmetry allows.

    Dark dots on bright and bright dots on dark are both found. Raises `TargetNotFound` with what is wrong.
    """
    check_shape("image", image, (None, None))
    failures = [_Failure(0, "no dots")]
    for share in WINDOWS:
        for blobs in find_blobs(image, share * max(image.shape)):
            found = _attempt(image, blobs, target, name, full_scale)
            if isinstance(found, TargetView):
                return found
            failures.append(found)
    worth = max(failures, key=lambda failure: failure.dots)
    fault = picture_fault(image, full_scale) if worth.dots < LEAST_DOTS else None
    raise TargetNotFound(fault or worth.reason)


def _attempt(image: NDArray[Any], blobs: Blobs, target: Target, name: str, full_scale: int) -> TargetView | _Failure:
    """The view that these patches are, or why they are none."""
    lattice = find_lattice(blobs.centre_px, blobs.shape_px2)
    if len(lattice.member) < LEAST_DOTS:
        return _too_few(len(lattice.member))
    grid = _measure(image, blobs, lattice)
    dots = len(grid.index)
    if dots < LEAST_DOTS:
        return _Failure(
            dots, f"no round dots: {len(lattice.member)} patches on a lattice, but only {dots} are elliptic"
        )
    spacing_px = float(np.median(_spacing(grid.jacobian)))
    check_exposure(image, outline(grid.ellipses.centre_px), full_scale)
    check_blur(float(np.median(grid.ellipses.blur_px)), spacing_px)
    places = _places(grid, target, image.shape)
    if isinstance(places, str):
        return _Failure(dots, places)
    return _view(grid, places, name, image.shape)


def _too_few(dots: int) -> _Failure:
    """What to say of a picture with hardly any dots."""
    return _Failure(
        dots, f"no grid of dots: {dots} on a lattice, at least {LEAST_DOTS} are needed" if dots else "no dots"
    )


def _measure(image: NDArray[Any], blobs: Blobs, lattice: Lattice) -> _Grid:
    """Fit the ellipses and keep the dots that are round and on the lattice."""
    member, index = lattice.member, lattice.index
    shape, ring = blobs.shape_px2[member], blobs.ring[member]
    _, jacobian = local_fit(index, blobs.centre_px[member])
    minor = np.sqrt(np.linalg.eigvalsh(shape)[:, 0])
    apart = _spacing(jacobian) / blobs.radius_px[member]
    reach = np.nan_to_num((apart / 2 - 1) * minor)
    ellipses = fit_ellipses(image, blobs.centre_px[member], shape, reach, ring)
    good = ellipses.roughness_px < np.maximum(ROUGHNESS[0], ROUGHNESS[1] * ellipses.radius_px)
    off, jacobian = local_fit(index[good], ellipses.centre_px[good])
    good[good] = off < OFF_LATTICE
    jacobian = jacobian[off < OFF_LATTICE]
    flip = np.array([1, -1 if len(jacobian) and np.median(np.linalg.det(jacobian)) < 0 else 1])
    return _Grid(index[good] * flip, _select(ellipses, good), ring[good], jacobian * flip)


def _spacing(jacobian: FloatArray) -> FloatArray:
    """Lattice step (N,) in px: the root of the area of a cell, NaN without a Jacobian."""
    return np.asarray(np.sqrt(np.abs(jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0])))


def _select(ellipses: Ellipses, kept: BoolArray) -> Ellipses:
    """The ellipses that are kept."""
    return Ellipses(**{name: value[kept] for name, value in vars(ellipses).items()})


def _places(grid: _Grid, target: Target, shape: tuple[int, ...]) -> IntArray | str:
    """Places (N, 2) in the target's lattice, or why there are none."""
    rings = int(grid.ring.sum())
    if target.kind == "dots" and rings == 3:
        return _places_from_rings(grid)
    if target.kind == "dots" and rings:
        edge = "runs over the edge of the picture, " if rings < 3 and _leaves(grid, shape) else ""
        return f"{edge}{rings} of {len(grid.index)} dots are ring markers, expected three"
    if target.size is None:
        return f"no ring markers among {len(grid.index)} dots: give the number of dots, columns x rows"
    return _places_from_size(grid, target, target.size, shape)


def _places_from_rings(grid: _Grid) -> IntArray | str:
    """Places from the ring at the corner of the L, x along the longer arm, y the shorter."""
    rings = grid.index[grid.ring]
    for corner in range(3):
        arms = np.delete(rings, corner, axis=0) - rings[corner]
        lengths = np.abs(arms).sum(axis=1)
        if (np.abs(arms).max(axis=1) < lengths).any() or arms[0] @ arms[1] != 0:
            continue
        axes = arms // lengths[:, None]
        up = np.linalg.det(axes) < 0
        if (lengths[0] < lengths[1]) or (lengths[0] == lengths[1] and not up):
            axes, up = axes[::-1], not up
        if not up:
            return "mirrored: the ring markers run the wrong way round"
        return np.asarray((grid.index - rings[corner]) @ axes.T)
    return "the three ring markers do not form an L"


def _places_from_size(grid: _Grid, target: Target, size: tuple[int, int], shape: tuple[int, ...]) -> IntArray | str:
    """Places from the corner of a full grid."""
    asymmetric = target.kind == "asymmetric-dots"
    columns, rows = size
    wanted = {(2 * i + j % 2 if asymmetric else i, j) for i in range(columns) for j in range(rows)}
    basis = np.array([[1, -1], [1, 1]]) if asymmetric else np.eye(2, dtype=np.int64)
    mean = grid.jacobian.mean(axis=0) @ np.linalg.inv(basis)
    turns = [np.asarray(np.linalg.matrix_power(QUARTER_TURN, turn), dtype=np.int64) for turn in range(4)]
    turned = [(axes, _from_corner(grid.index @ basis.T @ axes.T)) for axes in turns]
    fitting = [(_rightward(mean @ axes.T), places) for axes, places in turned if _same(places, wanted)]
    if fitting:
        return max(fitting, key=lambda fit: fit[0])[1]
    if any(_same(_from_corner(places * np.array([-1, 1])), wanted) for _, places in turned):
        return "mirrored: the rows of the dots are shifted the wrong way"
    edge = "runs over the edge of the picture: " if _leaves(grid, shape) else ""
    if edge or len(grid.index) < len(wanted):
        return f"{edge}{len(grid.index)} dots on a lattice, expected all {columns} x {rows}"
    extent = np.ptp(grid.index, axis=0) + 1
    return f"another grid: {len(grid.index)} dots within {extent[0]} x {extent[1]} places, expected {columns} x {rows}"


def _rightward(jacobian: FloatArray) -> float:
    """Cosine between the first index's direction and the picture's x."""
    return float(jacobian[0, 0] / np.linalg.norm(jacobian[:, 0]))


def _from_corner(index: IntArray) -> IntArray:
    """Places counted from the least of both indices."""
    return np.asarray(index - index.min(axis=0))


def _same(places: IntArray, wanted: set[tuple[int, int]]) -> bool:
    """Whether the places are exactly those wanted."""
    return len(places) == len(wanted) and set(map(tuple, places.tolist())) == wanted


def _leaves(grid: _Grid, shape: tuple[int, ...]) -> bool:
    """Whether the next dots beyond the lattice would not be wholly in the picture."""
    steps = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    beyond = grid.ellipses.centre_px[:, None] + np.einsum("nab,kb->nka", grid.jacobian, steps)
    empty = ~(grid.index[:, None, None] + steps[:, None] == grid.index).all(axis=3).any(axis=2)
    margin = grid.ellipses.radius_px[:, None, None]
    outside = ((beyond < margin) | (beyond > np.array(shape[::-1]) - 1 - margin)).any(axis=2)
    return bool((empty & outside).any())


def _view(grid: _Grid, places: IntArray, name: str, shape: tuple[int, ...]) -> TargetView:
    """The view with the dots in the order of their places."""
    ellipses = grid.ellipses
    _, jacobian = local_fit(places, ellipses.centre_px)
    radius = ellipses.radius_px / _spacing(jacobian)
    order = np.lexsort(places.T)
    return TargetView(
        name=name,
        index=places[order],
        position_px=ellipses.centre_px[order],
        covariance_px2=ellipses.covariance_px2[order],
        radius=float(np.nanmedian(radius[~grid.ring])),
        blur_px=float(np.median(ellipses.blur_px)),
        size_px=np.array(shape[::-1], dtype=np.int64),
    )
