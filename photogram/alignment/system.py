"""The whitened linear system of all evidence about a trial pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram._checks import BoolArray, FloatArray, IntArray
from photogram.alignment.evidence import Evidence
from photogram.alignment.residuals import Residuals
from photogram.rigid import RigidTransform

_RANK = 1e-10  # singular values below this share of the largest count as zero


@dataclass(frozen=True, eq=False)
class System:
    """Rows (M, 6 + Q) and residuals (M,) in units of their standard deviations.

    Unknown are the displacement of the pose and Q common errors, whose priors are the last Q rows. `piece` (M,): number
    of each row's piece among `names`, −1 for priors of common errors. `columns`: first column and number of each common
    error's unknowns. `information` (6, 6): what the evidence says about the components that it may determine,
    common errors and all.
    """

    rows: FloatArray
    residual: FloatArray
    piece: IntArray
    names: tuple[str, ...]
    columns: dict[str, tuple[int, int]]
    information: FloatArray

    def covariance(self, known: str = "") -> FloatArray:
        """Return the covariance (6, 6) of the pose, on condition that the common errors of one name are known."""
        first, count = self.columns.get(known, (0, 0))
        rows = np.delete(self.rows, np.s_[first : first + count], axis=1)
        covariance = np.linalg.inv(rows.T @ rows)[:6, :6]
        return np.asarray((covariance + covariance.T) / 2)

    def response(self, known: str) -> FloatArray:
        """Return how the pose (6, Q) answers one standard uncertainty of each common error of a name."""
        first, count = self.columns.get(known, (0, 0))
        chosen = self.rows[:, first : first + count]
        others = np.delete(self.rows, np.s_[first : first + count], axis=1)
        return np.asarray(-np.linalg.solve(others.T @ others, others.T @ chosen)[:6])


def assemble(evidence: Sequence[Evidence], pose: RigidTransform) -> System:
    """Return the system of all evidence at a trial pose."""
    parts = [item.residuals(pose) for item in evidence]
    columns = _columns(parts)
    total = sum(count for _, count in columns.values())
    names = tuple(dict.fromkeys(name for part in parts for name in part.piece))
    blocks = [_rows(part, columns, total) for part in parts]
    piece = [np.repeat([names.index(name) for name in part.piece], part.residual.shape[1]) for part in parts]
    prior = np.eye(6 + total)[6:]
    rows = np.concatenate([*(rows for rows, _, _ in blocks), prior])
    claimed = np.concatenate([*(rows * _mask(mask, total) for rows, _, mask in blocks), prior])
    return System(
        rows,
        np.concatenate([*(residual for _, residual, _ in blocks), np.zeros(total)]),
        np.concatenate([*piece, np.full(total, -1)]).astype(np.int64),
        names,
        columns,
        _about_pose(claimed.T @ claimed),
    )


def sum_of_squares(rows: FloatArray, residual: FloatArray) -> tuple[float, int]:
    """Return the least sum of squares of residual + rows·x and its degrees of freedom."""
    if not len(rows):
        return 0.0, 0
    scale = np.linalg.norm(rows, axis=0)
    u, singular, _ = np.linalg.svd(rows / np.where(scale > 0.0, scale, 1.0), full_matrices=False)
    fitted = u[:, singular > _RANK * singular[0]]
    left = residual - fitted @ (fitted.T @ residual)
    return float(left @ left), len(rows) - fitted.shape[1]


def _columns(parts: Sequence[Residuals]) -> dict[str, tuple[int, int]]:
    """Return first column and number of the unknowns of every common error."""
    columns: dict[str, tuple[int, int]] = {}
    place = 6
    for part in parts:
        for name, changes in part.common.items():
            if not len(changes):
                continue
            if columns.setdefault(name, (place, len(changes)))[1] != len(changes):
                raise ValueError(f"{name}: expected {columns[name][1]} common errors as before, found {len(changes)}")
            place = max(place, sum(columns[name]))
    return columns


def _rows(part: Residuals, columns: dict[str, tuple[int, int]], total: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return one evidence's whitened rows (m, 6 + Q) and residuals (m,), and which components it may determine."""
    groups, size = part.residual.shape
    full = np.zeros((groups, size, 6 + total))
    full[..., :6] = part.jacobian
    for name, changes in part.common.items():
        if len(changes):
            first, count = columns[name]
            full[..., first : first + count] += np.moveaxis(changes, 0, -1)
    try:
        root = np.linalg.cholesky(part.covariance)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{part.piece[0]}: expected a positive definite covariance") from error
    white = np.linalg.solve(root, np.concatenate([full, part.residual[..., None]], axis=-1))
    white = white.reshape(groups * size, 7 + total)
    return white[:, :-1], white[:, -1], part.determines


def _mask(determines: BoolArray, total: int) -> FloatArray:
    """Return factors (6 + Q,) that leave what an evidence may determine."""
    return np.concatenate([determines, np.ones(total)]).astype(np.float64)


def _about_pose(normal: FloatArray) -> FloatArray:
    """Return the information (6, 6) about the pose when the common errors are unknown: the Schur complement."""
    pose, mixed, common = normal[:6, :6], normal[:6, 6:], normal[6:, 6:]
    return np.asarray(pose - mixed @ np.linalg.solve(common, mixed.T))
