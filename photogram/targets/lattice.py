"""Which of many patches lie on a square lattice, and at which place of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from photogram.arrays import FloatArray, IntArray, check_shape

AREA_SPAN = 4.0
NEIGHBOURS = 12
SEED_TOLERANCE = 0.3
LEAST_SEED_MATCHES = 3
MOST_GROUPS = 4
SEEDS = 4
TOLERANCE = 0.2
AREA_RATIO = (0.4, 2.5)
RINGS_ABOUT_A_CELL = (2, 3)
LEAST_POINTS = 9
FEW_POINTS, LEAST_PAIRS = 16, 1.0
AROUND = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]])


@dataclass(frozen=True, eq=False)
class Lattice:
    """Places on a square lattice, up to where it begins and how it is turned or mirrored.

    `member` (N,): numbers of the patches; `index` (N, 2): their places, each once.
    """

    member: IntArray
    index: IntArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("member", self.member, (None,))
        check_shape("index", self.index, (len(self.member), 2))


def find_lattice(centre_px: FloatArray, shape_px2: FloatArray) -> Lattice:
    """Return the largest square lattice among patches at `centre_px` (N, 2) of `shape_px2` (N, 2, 2).

    Where perspective turns circles into ellipses, it turns the lattice likewise: measured in the ellipse of a dot, its
    four nearest neighbours lie at equal distances and right angles, at any tilt. From such a start the lattice grows,
    place by place, by affine extrapolation of the places around. Patches of different size from their neighbours do
    not belong to it, nor those that lie more than a fifth of the spacing off.
    """
    check_shape("centre_px", centre_px, (None, 2))
    check_shape("shape_px2", shape_px2, (len(centre_px), 2, 2))
    best = Lattice(np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64))
    area = np.sqrt(np.linalg.det(shape_px2))
    for group in _groups_of_like_size(area):
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
    """Return how far points (N, 2) lie off a smooth map of their places, in spacings (N,), and its Jacobians (N, 2, 2).

    The map of each point is fitted to the places within two steps, itself left out: a polynomial of second order
    where there are ten of them, else an affine one; NaN where there are fewer than three or all in a line.
    """
    off = np.full(len(index), np.nan)
    jacobian = np.full((len(index), 2, 2), np.nan)
    for n, place in enumerate(index):
        step = index - place
        near = np.abs(step).max(axis=1) <= RINGS_ABOUT_A_CELL[0]
        near[n] = False
        found = _extrapolate(step[near], position_px[near], order=2 if near.sum() >= 10 else 1)
        if found is not None:
            jacobian[n] = found[1]
            off[n] = np.linalg.norm(np.linalg.solve(found[1], position_px[n] - found[0]))
    return off, jacobian


def _groups_of_like_size(area: FloatArray) -> list[IntArray]:
    """Patches whose areas are within a factor four, by octaves: those that cover most of the picture first."""
    if not len(area):
        return []
    octaves = np.arange(np.floor(np.log2(area.min())) - 1, np.ceil(np.log2(area.max())) + 1)
    groups = [np.flatnonzero((area >= 2.0**k) & (area < AREA_SPAN * 2.0**k)) for k in octaves]
    large = [group for group in groups if len(group) >= LEAST_POINTS]
    return sorted(large, key=lambda group: -area[group].sum())[:MOST_GROUPS]


def _seeds(centre: FloatArray, shape: FloatArray) -> IntArray:
    """Triples (S, 3) of a patch and its neighbours along both axes, the most regular surroundings first."""
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
    apart = np.linalg.norm(expected[:, :, None] - step[:, None], axis=3)
    nearest = apart.argmin(axis=2)
    miss: FloatArray = np.minimum(apart.min(axis=2) / length[:, None], SEED_TOLERANCE)
    hit = np.less(miss, SEED_TOLERANCE)
    score = hit.sum(axis=1) - miss.mean(axis=1)
    corner = hit[:, :4] & np.roll(hit[:, :4], -1, axis=1)
    order = np.argsort(-score)
    usable = np.asarray(corner.any(axis=1))
    order = order[usable[order] & (hit.sum(axis=1)[order] >= LEAST_SEED_MATCHES)][:SEEDS]
    first_axis = corner.argmax(axis=1)[order]
    along, beside = (near[order, nearest[order, (first_axis + turn) % 4]] for turn in (0, 1))
    return np.column_stack([order, along, beside])


@dataclass(eq=False)
class _Growth:
    """A lattice on the way: the patch at each place, from a start of three patches."""

    centre: FloatArray
    area: FloatArray
    start: IntArray
    at: dict[tuple[int, int], int] = field(default_factory=dict)

    def run(self) -> Lattice:
        """Grow until no place next to the lattice, nor one place further, holds a patch."""
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
        """Whether most places beside filled ones are filled too, which chance finds among random patches are not."""
        pairs = sum((i + 1, j) in self.at for i, j in self.at) + sum((i, j + 1) in self.at for i, j in self.at)
        return len(self.at) < FEW_POINTS or pairs > LEAST_PAIRS * len(self.at)

    def _extend(self, places: list[tuple[int, int]], reach: int) -> list[tuple[int, int]]:
        """Look at the empty places within `reach` steps of places; return those that were filled."""
        steps = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
        empty = dict.fromkeys(
            (i + di, j + dj) for i, j in places for di, dj in steps if (i + di, j + dj) not in self.at
        )
        index, member = np.array(list(self.at)), np.array(list(self.at.values()))
        wanted: dict[int, tuple[tuple[int, int], float]] = {}
        for place in empty:
            found = self._look(np.array(place), index, member)
            if found is not None and (found[0] not in wanted or found[1] < wanted[found[0]][1]):
                wanted[found[0]] = (place, found[1])
        taken = set(self.at.values())
        filled = {place: patch for patch, (place, _) in wanted.items() if patch not in taken}
        self.at.update(filled)
        return list(filled)

    def _look(self, place: IntArray, index: IntArray, member: IntArray) -> tuple[int, float] | None:
        """Return the patch at a place and how far off it lies, in spacings; None where there is none."""
        step = index - place
        distance = np.abs(step).max(axis=1)
        for rings in RINGS_ABOUT_A_CELL:
            near = distance <= rings
            expected = _extrapolate(step[near], self.centre[member[near]], order=1)
            if expected is not None:
                break
        else:
            return None
        position, jacobian = expected
        patch = int(self.tree.query(position)[1])
        off = float(np.linalg.norm(np.linalg.solve(jacobian, self.centre[patch] - position)))
        like = self.area[patch] / np.median(self.area[member[near]])
        return (patch, off) if off < TOLERANCE and AREA_RATIO[0] < like < AREA_RATIO[1] else None


def _extrapolate(step: IntArray, position: FloatArray, order: int) -> tuple[FloatArray, FloatArray] | None:
    """Return where the place 0 lies and the Jacobian there, from places at `step` (N, 2); None if all in a line."""
    i, j = step.T.astype(np.float64)
    columns = [np.ones(len(step)), i, j]
    if order == 2:
        columns += [i * i, i * j, j * j]
    solution, _, rank, _ = np.linalg.lstsq(np.column_stack(columns), position, rcond=None)
    if rank < len(columns) or abs(np.linalg.det(solution[1:3])) < 1e-6:
        return None
    return solution[0], solution[1:3].T
