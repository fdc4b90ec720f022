"""Grids of round dots, with and without ring markers: lattice positions and ellipses' centres."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.targets.ellipse import Blobs, FittedEllipses, find_blobs, fit_ellipses
from photogram.targets.target_view import (
    Target,
    TargetNotFound,
    TargetView,
    check_blur,
    check_exposure,
    image_fault,
    outline,
    refuse_second,
)
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape

MIN_DOTS = 12  # of a grid, more than by chance
MOST_SATURATED = 0.9  # share of the pixels: an overexposed sheet has smaller dots, not shifted ones
_SECOND = 0.5  # of the dots of the grid found, for a second one
WINDOWS = (1 / 6, 1 / 20, 2 / 5)  # of the image's longer side, for usual, small and large dots
ROUGHNESS = (0.5, 0.06)  # of a round dot, in px and in radii
OFF_LATTICE = 0.1  # spacings between a dot and its position
QUARTER_TURN = np.array([[0, -1], [1, 0]])


class _NoGrid(ValueError):
    """Reason why patches are no grid, and the number of dots."""

    def __init__(self, dots: int, reason: str) -> None:
        super().__init__(reason)
        self.dots = dots


@dataclass(frozen=True, eq=False)
class _DotGrid:
    """Dots with sub-pixel ellipses on a lattice that is right-handed in the image.

    The lattice is rotated and, if necessary, mirrored (first index to the right, second down, if rotated suitably).
    `ring` (N,): which are ring markers; `jacobian` (N, 2, 2): pixels per lattice step.
    """

    index: IntArray
    ellipses: FittedEllipses
    ring: BoolArray
    jacobian: FloatArray


def find_dots(image: NDArray[Any], target: Target, name: str, full_scale: int) -> TargetView:
    """Return the dots of a target of kind "dots" or "asymmetric-dots" in an image (H,W).

    With three ring markers (dots with a hole) positions count from the ring at the corner of their L. The longer arm is
    x, the shorter one y. The y axis points up in the image when x points to the right, which distinguishes arms of
    equal length. The dots may extend beyond the image's edge. Dots cut by the edge are excluded.

    Without rings all `target.size` dots must be visible, and positions count from a corner: first index to the right,
    second down. The first index runs to the right as far as the grid's symmetry leaves a choice (half turns, of a
    square grid quarter turns). A plain grid cannot show whether the image is mirrored. An asymmetric one has the
    positions (2 i + j mod 2, j), i-th dot of row j, as in OpenCV. With an odd number of rows its half turns and
    mirroring are distinguished as far as its symmetry allows.

    Dark dots on bright and bright dots on dark are both found. Raises `TargetNotFound` with the fault of the image.
    """
    check_shape("image", image, (None, None))
    failures = [_NoGrid(0, "no dots")]
    for share in WINDOWS:
        for blobs in find_blobs(image, share * max(image.shape)):
            try:
                return _view(image, blobs, target, name, full_scale)
            except _NoGrid as failure:
                failures.append(failure)
    worth = max(failures, key=lambda failure: failure.dots)
    fault = image_fault(image, full_scale) if worth.dots < MIN_DOTS else None
    raise TargetNotFound(fault or str(worth))


def _view(image: NDArray[Any], blobs: Blobs, target: Target, name: str, full_scale: int) -> TargetView:
    """Return the view of these patches; raise `_NoGrid` for no grid."""
    lattice = find_lattice(blobs.centre_px, blobs.shape_px2)
    seen = len(lattice.member)
    if seen < MIN_DOTS:
        few = f"no grid of dots: {seen} on a lattice, at least {MIN_DOTS} are needed"
        raise _NoGrid(seen, few if seen else "no dots")
    grid = _measure(image, blobs, lattice)
    dots = len(grid.index)
    if dots < MIN_DOTS:
        raise _NoGrid(dots, f"no round dots: {seen} patches on a lattice, but only {dots} are elliptic")
    spacing_px = float(np.median(_spacing(grid.jacobian)))
    check_exposure(image, outline(grid.ellipses.centre_px), full_scale, MOST_SATURATED)
    check_blur(float(np.median(grid.ellipses.blur_px)), spacing_px)
    positions = _lattice_positions(grid, target, image.shape)
    _refuse_another(image, blobs, lattice.member, target)
    ellipses, order = grid.ellipses, np.lexsort(positions.T)
    radius = ellipses.radius_px / _spacing(local_fit(positions, ellipses.centre_px)[1])
    return TargetView(
        name,
        positions[order],
        ellipses.centre_px[order],
        ellipses.covariance_px2[order],
        float(np.nanmedian(radius[~grid.ring])),
        float(np.median(ellipses.blur_px)),
        np.array(image.shape[::-1], dtype=np.int64),
    )


def _refuse_another(image: NDArray[Any], blobs: Blobs, member: IntArray, target: Target) -> None:
    """Raise `TargetNotFound` where patches next to a grid's are another such grid."""
    rest = np.setdiff1d(np.arange(len(blobs.ring)), member)
    left = Blobs(blobs.centre_px[rest], blobs.shape_px2[rest], blobs.ring[rest])
    lattice = find_lattice(left.centre_px, left.shape_px2)
    if len(lattice.member) < max(MIN_DOTS, _SECOND * len(member)):
        return
    try:
        _lattice_positions(_measure(image, left, lattice), target, image.shape)
    except _NoGrid:
        return
    refuse_second("a grid of dots" + ("" if target.size is None else f", {target.size[0]} x {target.size[1]},"))


def _measure(image: NDArray[Any], blobs: Blobs, lattice: Lattice) -> _DotGrid:
    """Fit the ellipses, and return the dots that are round and on the lattice."""
    member, index = lattice.member, lattice.index
    shape, ring = blobs.shape_px2[member], blobs.ring[member]
    _, jacobian = local_fit(index, blobs.centre_px[member])
    minor = np.sqrt(np.linalg.eigvalsh(shape)[:, 0])
    spacing = _spacing(jacobian) / blobs.radius_px[member]
    reach = np.nan_to_num((spacing / 2 - 1) * minor)
    ellipses = fit_ellipses(image, blobs.centre_px[member], shape, reach, ring)
    good = ellipses.roughness_px < np.maximum(ROUGHNESS[0], ROUGHNESS[1] * ellipses.radius_px)
    off, jacobian = local_fit(index[good], ellipses.centre_px[good])
    good[good] = off < OFF_LATTICE
    jacobian = jacobian[off < OFF_LATTICE]
    flip = np.array([1, -1 if len(jacobian) and np.median(np.linalg.det(jacobian)) < 0 else 1])
    return _DotGrid(
        index[good] * flip,
        FittedEllipses(**{name: value[good] for name, value in vars(ellipses).items()}),
        ring[good],
        jacobian * flip,
    )


def _spacing(jacobian: FloatArray) -> FloatArray:
    """Return the lattice step (N,) in px, NaN without a Jacobian."""
    return np.asarray(np.sqrt(np.abs(jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0])))


def _lattice_positions(grid: _DotGrid, target: Target, shape: tuple[int, ...]) -> IntArray:
    """Return positions (N, 2) in the target's lattice; raise `_NoGrid` for another target."""
    rings, dots = int(grid.ring.sum()), len(grid.index)
    if target.kind == "dots" and rings == 3:
        return _positions_from_rings(grid)
    if target.kind == "dots" and rings:
        raise _NoGrid(dots, f"{rings} of {dots} dots are ring markers, expected three that are wholly visible")
    if target.size is None:
        raise _NoGrid(dots, f"no ring markers among {dots} dots: give the number of dots, columns x rows")
    return _positions_from_size(grid, target.kind == "asymmetric-dots", target.size, shape)


def _positions_from_rings(grid: _DotGrid) -> IntArray:
    """Return positions from the ring at the corner of the L."""
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
            raise _NoGrid(len(grid.index), "mirrored: the order of the ring markers is reversed")
        return np.asarray((grid.index - rings[corner]) @ axes.T)
    raise _NoGrid(len(grid.index), "the three ring markers do not form an L")


def _positions_from_size(grid: _DotGrid, asymmetric: bool, size: tuple[int, int], shape: tuple[int, ...]) -> IntArray:
    """Return positions from the corner of a full grid."""
    (columns, rows), dots = size, len(grid.index)
    expected = {(2 * i + j % 2 if asymmetric else i, j) for i in range(columns) for j in range(rows)}
    basis = np.array([[1, -1], [1, 1]]) if asymmetric else np.eye(2, dtype=np.int64)
    mean = grid.jacobian.mean(axis=0) @ np.linalg.inv(basis)
    turns = [np.asarray(np.linalg.matrix_power(QUARTER_TURN, turn), dtype=np.int64) for turn in range(4)]
    rotated = [(axes, _from_corner(grid.index @ basis.T @ axes.T)) for axes in turns]
    fitting = [(mean @ axes.T, positions) for axes, positions in rotated if _same(positions, expected)]
    if fitting:  # the one whose first index runs most to the right
        return max(fitting, key=lambda fit: float(fit[0][0, 0] / np.linalg.norm(fit[0][:, 0])))[1]
    if any(_same(_from_corner(positions * np.array([-1, 1])), expected) for _, positions in rotated):
        raise _NoGrid(dots, "mirrored: the shift of the rows is reversed")
    edge = "extends beyond the edge of the image: " if dots < len(expected) and _leaves(grid, shape) else ""
    if dots < len(expected):
        raise _NoGrid(dots, f"{edge}{dots} dots on a lattice, expected all {columns} x {rows}")
    extent = np.ptp(grid.index, axis=0) + 1
    seen = f"{dots} dots within {extent[0]} x {extent[1]} positions"
    raise _NoGrid(dots, f"another grid: {seen}, expected {columns} x {rows}")


def _from_corner(index: IntArray) -> IntArray:
    """Return positions counted from the least of both indices."""
    return np.asarray(index - index.min(axis=0))


def _same(positions: IntArray, expected: set[tuple[int, int]]) -> bool:
    return len(positions) == len(expected) and set(map(tuple, positions.tolist())) == expected


def _leaves(grid: _DotGrid, shape: tuple[int, ...]) -> bool:
    """Return whether the next dots beyond the lattice would not be wholly in the image."""
    steps = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    beyond = grid.ellipses.centre_px[:, None] + np.einsum("nab,kb->nka", grid.jacobian, steps)
    empty = ~(grid.index[:, None, None] + steps[:, None] == grid.index).all(axis=3).any(axis=2)
    margin = grid.ellipses.radius_px[:, None, None]
    outside = ((beyond < margin) | (beyond > np.array(shape[::-1]) - 1 - margin)).any(axis=2)
    return bool((empty & outside).any())


# Patches that lie on a lattice, in perspective and through a lens.

AREA_SPAN = 4.0  # ratio of the areas of one target's dots, in perspective
NEIGHBOURS = 12  # patches around a seed, of which eight are those of the lattice
SEED_TOLERANCE = 0.3  # spacings between a seed's neighbours and their positions
MIN_SEED_MATCHES = 3  # neighbours of a seed
MAX_GROUPS = 4  # of patches of similar area that are tried
SEEDS = 4  # of a group that are tried
TOLERANCE = 0.2  # spacings between a patch and its extrapolated position
AREA_RATIO = (0.4, 2.5)  # of a patch and its neighbours
RINGS_ABOUT_A_CELL = (2, 3)  # from which a position is extrapolated, the second if the first is too empty
MIN_POINTS = 9  # of a group
FEW_POINTS, MIN_PAIRS = 16, 1.0  # patches that are always accepted; pairs of neighbours per patch beyond that
AROUND = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]])


@dataclass(frozen=True, eq=False, repr=False)
class Lattice(Arrays, shapes="member N; index N 2"):
    """Positions on a square lattice, of arbitrary origin, rotation and handedness.

    `member` (N,): numbers of the patches; `index` (N, 2): their positions, each once.
    """

    member: IntArray
    index: IntArray


def find_lattice(centre_px: FloatArray, shape_px2: FloatArray) -> Lattice:
    """Return the largest square lattice among patches at `centre_px` (N, 2).

    shape_px2 (N, 2, 2): of the patches. Perspective deforms circles into ellipses, and the lattice equally: measured in
    the ellipse of a dot, its four nearest neighbours lie at equal distances and right angles, at any tilt. From such a
    start the lattice grows by affine extrapolation of the surrounding positions. Patches of different size from their
    neighbours do not belong to it, nor those more than a fifth of the spacing off.
    """
    check_shape("centre_px", centre_px, (None, 2))
    check_shape("shape_px2", shape_px2, (len(centre_px), 2, 2))
    best = Lattice(np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64))
    if not len(centre_px):
        return best
    area = np.sqrt(np.linalg.det(shape_px2))
    octaves = np.arange(np.floor(np.log2(area.min())) - 1, np.ceil(np.log2(area.max())) + 1)
    groups = [np.flatnonzero((area >= 2.0**k) & (area < AREA_SPAN * 2.0**k)) for k in octaves]
    large = [group for group in groups if len(group) >= MIN_POINTS]
    for group in sorted(large, key=lambda group: -area[group].sum())[:MAX_GROUPS]:  # those that cover most first
        tried: set[int] = set()
        for seed in _seeds(centre_px[group], shape_px2[group]):
            if int(group[seed[0]]) in tried:
                continue
            grown = _Growth(centre_px, area, group[seed]).run()
            tried.update(grown.member.tolist())
            if len(grown.member) > len(best.member):
                best = grown
        if 2 * len(best.member) > len(group):
            break
    return best


def local_fit(index: IntArray, position_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deviation (N,) and Jacobians of points (N,2) from a smooth map.

    The map of each point is fitted to the positions within two steps, except itself: a polynomial of second order for
    ten of them, else an affine one. Jacobians are (N, 2, 2). NaN where there are fewer than three or all in a line.
    """
    off = np.full(len(index), np.nan)
    jacobian = np.full((len(index), 2, 2), np.nan)
    for n, position in enumerate(index):
        step = index - position
        near = np.abs(step).max(axis=1) <= RINGS_ABOUT_A_CELL[0]
        near[n] = False
        expected = _extrapolate(step[near], position_px[near], order=2 if near.sum() >= 10 else 1)
        if expected is not None:
            jacobian[n] = expected[1]
            off[n] = np.linalg.norm(np.linalg.solve(expected[1], position_px[n] - expected[0]))
    return off, jacobian


def _seeds(centre: FloatArray, shape: FloatArray) -> IntArray:
    """Return triples (S, 3) of a patch and its neighbours, the most regular surroundings first."""
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS, len(centre) - 1)
    near = cKDTree(centre).query(centre, k=count + 1)[1][:, 1:]
    step = centre[near] - centre[:, None]
    to_circle = np.linalg.inv(np.linalg.cholesky(shape))
    step = np.einsum("nij,nkj->nki", to_circle, step)
    first = step[np.arange(len(step)), np.linalg.norm(step, axis=2).argmin(axis=1)]
    length = np.linalg.norm(first, axis=1)
    across = np.column_stack([-first[:, 1], first[:, 0]])
    expected = np.einsum("ka,nai->nki", AROUND.astype(float), np.stack([first, across], axis=1))
    distance = np.linalg.norm(expected[:, :, None] - step[:, None], axis=3)
    nearest = distance.argmin(axis=2)
    miss: FloatArray = np.minimum(distance.min(axis=2) / length[:, None], SEED_TOLERANCE)
    hit = np.less(miss, SEED_TOLERANCE)
    score = hit.sum(axis=1) - miss.mean(axis=1)
    corner = hit[:, :4] & np.roll(hit[:, :4], -1, axis=1)
    order = np.argsort(-score)
    usable = np.asarray(corner.any(axis=1))
    order = order[usable[order] & (hit.sum(axis=1)[order] >= MIN_SEED_MATCHES)][:SEEDS]
    first_axis = corner.argmax(axis=1)[order]
    along, across_axis = (near[order, nearest[order, (first_axis + turn) % 4]] for turn in (0, 1))
    return np.column_stack([order, along, across_axis])


@dataclass(eq=False)
class _Growth:
    """A growing lattice: the patch at each position, from a start of three patches."""

    centre: FloatArray
    area: FloatArray
    start: IntArray
    at: dict[tuple[int, int], int] = field(default_factory=dict)

    def run(self) -> Lattice:
        """Grow until no further patch fits the lattice."""
        from scipy.spatial import cKDTree

        self.at = dict(zip([(0, 0), (1, 0), (0, 1)], self.start.tolist(), strict=True))
        self.tree = cKDTree(self.centre)
        fresh = list(self.at)
        while fresh and self._is_dense():
            fresh = self._extend(fresh, 1)
            if not fresh:
                fresh = self._extend(list(self.at), 2)
        member = np.array(list(self.at.values()), dtype=np.int64)
        return Lattice(member, np.array(list(self.at), dtype=np.int64))

    def _is_dense(self) -> bool:
        """Return whether most positions next to filled ones are filled, unlike random patches."""
        pairs = sum((i + 1, j) in self.at for i, j in self.at) + sum((i, j + 1) in self.at for i, j in self.at)
        return len(self.at) < FEW_POINTS or pairs > MIN_PAIRS * len(self.at)

    def _extend(self, starts: list[tuple[int, int]], reach: int) -> list[tuple[int, int]]:
        """Fill empty positions within `reach` steps of given ones; return those that were filled."""
        steps = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
        empty = dict.fromkeys(
            (i + di, j + dj) for i, j in starts for di, dj in steps if (i + di, j + dj) not in self.at
        )
        index, member = np.array(list(self.at)), np.array(list(self.at.values()))
        candidates: dict[int, tuple[tuple[int, int], float]] = {}
        for position in empty:
            patch, off = self._nearest_patch(np.array(position), index, member)
            if off < TOLERANCE and (patch not in candidates or off < candidates[patch][1]):
                candidates[patch] = (position, off)
        taken = set(self.at.values())
        filled = {position: patch for patch, (position, _) in candidates.items() if patch not in taken}
        self.at.update(filled)
        return list(filled)

    def _nearest_patch(self, lattice_index: IntArray, index: IntArray, member: IntArray) -> tuple[int, float]:
        """Return the patch at a position and its distance in spacings, infinite for none."""
        step = index - lattice_index
        distance = np.abs(step).max(axis=1)
        for rings in RINGS_ABOUT_A_CELL:
            near = distance <= rings
            expected = _extrapolate(step[near], self.centre[member[near]], order=1)
            if expected is not None:
                break
        else:
            return -1, np.inf
        position, jacobian = expected
        patch = int(self.tree.query(position)[1])
        off = float(np.linalg.norm(np.linalg.solve(jacobian, self.centre[patch] - position)))
        like = self.area[patch] / np.median(self.area[member[near]])
        return (patch, off) if AREA_RATIO[0] < like < AREA_RATIO[1] else (-1, np.inf)


def _extrapolate(step: IntArray, position: FloatArray, order: int) -> tuple[FloatArray, FloatArray] | None:
    """Return point and Jacobian at position 0 of positions (N, 2), None on a line."""
    i, j = step.T.astype(np.float64)
    columns = [np.ones(len(step)), i, j]
    if order == 2:
        columns += [i * i, i * j, j * j]
    solution, _, rank, _ = np.linalg.lstsq(np.column_stack(columns), position, rcond=None)
    if rank < len(columns) or abs(np.linalg.det(solution[1:3])) < 1e-6:
        return None
    return solution[0], solution[1:3].T
