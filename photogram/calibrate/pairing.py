"""Which pictures of two cameras show one position of the target, and how the cameras stand to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from photogram._checks import FloatArray, IntArray
from photogram.rigid import RigidTransform, vector_from_rotation
from photogram.target.view import Target, TargetView

Pair = tuple[TargetView | None, TargetView | None]
Poses = dict[int, RigidTransform]

_STRANGE = 5.0  # times the median disagreement, beyond which a pair is strange
_TOLERATED = 0.05  # disagreement that is never strange: rad, share of the distance
_QUARTER_TURN = np.array([[0, -1], [1, 0]])


@dataclass(frozen=True, eq=False)
class Pairing:
    """`right_from_left`, the pairs with their right poses, and the numbers of the pairs that do not agree with it."""

    right_from_left: RigidTransform
    pairs: tuple[Pair, ...]
    right_poses: Poses
    strange: tuple[int, ...]


def pair_up(pairs: Sequence[Pair], left_poses: Poses, right_poses: Poses, target: Target) -> Pairing:
    """Return the relative pose of the pair that agrees best with all others, and who does not agree.

    A target that looks alike after half a turn (a square one after a quarter) may be numbered differently in the two
    pictures of a pair: where another numbering of the right one makes it agree, that is taken. Raises `ValueError`
    when most pairs do not agree: the two lists of pictures do not belong together.
    """
    common = sorted(set(left_poses) & set(right_poses))
    if not common:
        raise ValueError(
            "no position of the target is seen by both cameras; the two lists of pictures must be in one order"
        )
    depth = float(np.median([np.linalg.norm(left_poses[view].translation_m) for view in common]))
    relative, limit = _agreed([right_poses[view] @ left_poses[view].inverse() for view in common], depth)
    numbered, poses, strange = list(pairs), dict(right_poses), []
    for view in common:
        for turn in ((np.eye(2, dtype=np.int64), np.zeros(2)), *_look_alikes(target)):
            pose = right_poses[view] @ _moves_points(turn, target.spacing_m).inverse()
            if _disagreement(pose @ left_poses[view].inverse(), relative, depth) <= limit:
                left, right = pairs[view]
                numbered[view], poses[view] = (left, _renumbered(right, turn)), pose
                break
        else:
            strange.append(view)
    if len(strange) * 2 > len(common) or limit > 10 * _TOLERATED:
        raise ValueError(
            "the left and right pictures do not belong together: no relative pose of the cameras fits most pairs; "
            "give all left pictures first, then all right ones in the same order"
        )
    return Pairing(relative, tuple(numbered), poses, tuple(strange))


def _agreed(found: Sequence[RigidTransform], depth_m: float) -> tuple[RigidTransform, float]:
    """Return the relative pose nearest to all others, and how far off another one may be."""
    apart = np.array([[_disagreement(a, b, depth_m) for b in found] for a in found])
    best = int(np.argmin(np.median(apart, axis=1)))
    return found[best], max(_TOLERATED, _STRANGE * float(np.median(apart[best])))


def _disagreement(a: RigidTransform, b: RigidTransform, depth_m: float) -> float:
    """Return how far two relative poses are apart: rotation in rad or shift in distances, whichever is more."""
    turn = float(np.linalg.norm(vector_from_rotation(a.rotation @ b.rotation.T)))
    return max(turn, float(np.linalg.norm(a.translation_m - b.translation_m)) / depth_m)


def _look_alikes(target: Target) -> list[tuple[IntArray, FloatArray]]:
    """Return the turns (matrix (2, 2), shift (2,)) of lattice indices after which the target looks the same."""
    if target.size is None or target.kind == "charuco":
        return []
    columns, rows = target.size
    asymmetric = target.kind == "asymmetric-dots"
    unlike = (columns + rows) % 2 == 1 if target.kind == "chessboard" else asymmetric and rows % 2 == 1
    if unlike:
        return []
    last = np.array([2 * columns - 1 if asymmetric else columns - 1, rows - 1])
    turns = [-np.eye(2, dtype=np.int64)]
    if columns == rows and not asymmetric:
        turns += [_QUARTER_TURN, -_QUARTER_TURN]
    return [(turn, (last - turn @ last) / 2) for turn in turns]


def _moves_points(turn: tuple[IntArray, FloatArray], spacing_m: float) -> RigidTransform:
    """Return the turn of indices as one of the target's points."""
    rotation = np.eye(3)
    rotation[:2, :2] = turn[0]
    return RigidTransform(rotation, np.append(turn[1], 0.0) * spacing_m)


def _renumbered(view: TargetView | None, turn: tuple[IntArray, FloatArray]) -> TargetView | None:
    """Return the view with its indices turned."""
    if view is None:
        return None
    return replace(view, index=np.rint(view.index @ turn[0].T + turn[1]).astype(np.int64))
