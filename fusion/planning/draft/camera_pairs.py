"""Stereo pairs among the cameras of a recording, and their left cameras."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from fusion.base import natural_key
from fusion.planning.draft.image_series import FEWEST_ALONE, FoundCamera
from photogram.calibration.calibration_file import read_calibration
from photogram.camera import triangulate
from photogram.images.image_files import open_sequence
from photogram.subsets.search import match_features
from shakercal._common.arrays import FloatArray

SIDES = (
    ("left", "right"), ("links", "rechts"), ("l", "r"), ("li", "re"), ("lh", "rh"), ("lhs", "rhs"), ("lft", "rgt"),
    ("gauche", "droite"), ("g", "d"), ("izquierda", "derecha"), ("izq", "der"), ("sinistra", "destra"), ("sx", "dx"),
    ("esquerda", "direita"), ("links", "right"), ("left", "rechts"),
)  # fmt: skip
"""Words for left and right."""
ORDERED = (("a", "b"), ("c", "d"), ("master", "slave"), ("main", "sub"), ("primary", "secondary"), ("first", "second"))
"""Words for the first and the second camera."""
BODIES = (
    {"base", "table", "tisch", "bottom", "lower", "unten", "armature", "anker"},
    {"load", "mass", "top", "upper", "oben", "masse", "last"},
)
"""Words for what a camera observes: the base, the load."""
DULL = {"cam", "camera", "cameras", "img", "image", "images", "frame", "frames", "kamera", "kameras", "pair", "stereo"}
MATCHES, CLEAR = 12, 0.9  # least number of matches; share of their shifts that decides
CLOSE_PX, DECIDES = 1.0, 3.0  # median residual of the right order; least ratio of that of the wrong one to it
FEATURES = 2000  # of an image, to find which camera is the left one
BY_SIDE, BY_ORDER, BY_ONE_NUMBER, BY_SIZE = range(4)


@dataclass(frozen=True)
class FoundCameras:
    """Two cameras of a stereo pair, or a single one.

    `name` is the common part of their names; `why`: the reason where the pair is a guess.
    """

    name: str
    left: FoundCamera
    right: FoundCamera | None
    why: str = ""

    @property
    def cameras(self) -> tuple[FoundCamera, ...]:
        """The left and the right camera, or the single one."""
        return (self.left,) if self.right is None else (self.left, self.right)


@dataclass(frozen=True)
class _Match:
    """Two cameras that may be a pair: how well their names agree (small is good)."""

    rank: int
    differing: int
    left: FoundCamera
    right: FoundCamera

    @property
    def order(self) -> tuple[object, ...]:
        return self.rank, self.differing, natural_key(self.left.pattern), natural_key(self.right.pattern)


def pair_cameras(
    cameras: Sequence[FoundCamera], calibrations: Sequence[Path] = ()
) -> tuple[tuple[FoundCameras, ...], tuple[FoundCamera, ...]]:
    """Return pairs and single cameras, and all other cameras with the reason."""
    sights, odd = list[FoundCameras](), list[FoundCamera]()
    rest = sorted(cameras, key=lambda camera: natural_key(camera.pattern))
    matches = sorted(
        (match for pair in combinations(rest, 2) if (match := _matched(*pair)) is not None), key=lambda m: m.order
    )
    for match in matches:
        one, other = match.left, match.right
        if one not in rest or other not in rest or (match.rank > BY_ORDER and not _even(rest, one)):
            continue
        rest = [camera for camera in rest if camera not in (one, other)]
        if one.frames == other.frames:
            sights.append(_left_first(match, calibrations))
            continue
        for camera, partner in ((one, other), (other, one)):
            problem = camera.problem or f"{camera.summary}, and {partner.pattern} has {partner.summary}"
            odd.append(replace(camera, problem=problem))
    for camera in rest:
        if camera.problem or camera.frames < FEWEST_ALONE:
            odd.append(replace(camera, problem=camera.problem or f"{camera.summary}, without a second camera"))
        else:
            sights.append(FoundCameras(_common_name([camera], "camera"), camera, None))
    most = max((sight.left.frames for sight in sights), default=0)
    for sight in [s for s in sights if s.right is not None and s.left.frames < FEWEST_ALONE <= most]:
        sights.remove(sight)  # such as dark frames and reference images
        odd += [replace(c, problem=f"{c.summary}, fewer than other cameras have") for c in sight.cameras]
    sights.sort(key=lambda sight: natural_key(sight.left.pattern))
    names = [sight.name for sight in sights]
    counts = [names[:i].count(name) for i, name in enumerate(names)]
    named = [replace(s, name=f"{s.name}{n + 1}" if n else s.name) for s, n in zip(sights, counts, strict=True)]
    return tuple(named), tuple(odd)


def _even(rest: Sequence[FoundCamera], one: FoundCamera) -> bool:
    """Return whether the cameras with as many frames of this size are pairs."""
    same = [c for c in rest if (c.frames, c.size_px) == (one.frames, one.size_px) and not c.problem]
    return len(same) % 2 == 0


# Names.


def _words(pattern: str) -> list[str]:
    """Return the words and numbers of a pattern without its suffix, in lower case."""
    stem = re.sub(r"\.[A-Za-z][A-Za-z0-9]{1,4}$", "", pattern.replace("[0-9]*", "*"))
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_]+", stem)]


def _apart(one: str, other: str) -> tuple[str, str]:
    """Return the different parts of two words: `left` and `right` of `camleft` and `camright`."""
    for side in [*SIDES, *ORDERED]:
        for pair in (side, side[::-1]):
            if min(map(len, pair)) > 2 or one[: -len(pair[0])] in DULL:
                ends = one.endswith(pair[0]) and other.endswith(pair[1])
                if ends and one[: -len(pair[0])] == other[: -len(pair[1])]:
                    return pair
                starts = one.startswith(pair[0]) and other.startswith(pair[1])
                if starts and one[len(pair[0]) :] == other[len(pair[1]) :]:
                    return pair
    return one, other


def _matched(one: FoundCamera, other: FoundCamera) -> _Match | None:
    """Return how well two cameras match by their names, or None."""
    words = _words(one.pattern), _words(other.pattern)
    bodies = [{i for i, body in enumerate(BODIES) if body & set(of)} for of in words]
    if bodies[0] != bodies[1]:
        return None
    same_size = one.frames == other.frames and one.size_px == other.size_px
    guessable = same_size and one.frames >= FEWEST_ALONE and not (one.problem or other.problem)
    by_size = _Match(BY_SIZE, 0, one, other) if guessable else None
    if len(words[0]) != len(words[1]):
        return by_size
    differing = list(dict.fromkeys(_apart(a, b) for a, b in zip(*words, strict=True) if a != b))
    numbers = [pair for pair in differing if all(word.isdigit() for word in pair)]
    for rank, sides in ((BY_SIDE, SIDES), (BY_ORDER, ORDERED)):
        for first, second in ((0, 1), (1, 0)):
            found = [pair for pair in differing if (pair[first], pair[second]) in sides]
            if found and all(pair in found or pair in numbers for pair in differing):
                cameras = (one, other)
                return _Match(rank, len(differing) - len(found), cameras[first], cameras[second])
    if len(differing) == len(numbers) == 1:
        low, high = (int(number) for number in numbers[0])
        if abs(high - low) == 1 and max(low, high) < 100:
            cameras = (one, other) if low < high else (other, one)
            return _Match(BY_ORDER, 0, *cameras)
    if guessable and len(differing) == 1:
        return _Match(BY_ONE_NUMBER, 0, one, other)
    return by_size


def _common_name(cameras: Sequence[FoundCamera], default: str) -> str:
    """Return the words that all names share, without common ones and frame numbers."""
    sides = {word for pair in (*SIDES, *ORDERED) for word in pair}
    shared = [re.findall(r"[A-Za-z0-9]+", camera.pattern.rpartition(".")[0] or camera.pattern) for camera in cameras]
    specific = [word for word in dict.fromkeys(shared[0]) if all(word in of for of in shared)]
    if len(cameras) == 1:
        specific = [word for word in specific if word.lower() not in sides]
    return "-".join(word for word in specific if word.lower() not in DULL and not word.isdigit())[:40] or default


# Which camera is the left one.


def _left_first(match: _Match, calibrations: Sequence[Path]) -> FoundCameras:
    """Return a pair with the left camera first.

    The calibration, the names or the images show which one it is.
    """
    left, right = match.left, match.right
    why = "" if match.rank == BY_SIDE else "guessed: both have as many frames of one size"
    order = (
        "" if match.rank == BY_SIDE else "by their names" if match.rank == BY_ORDER else "in the order of their names"
    )
    if left.size_px == right.size_px and (calibrations or match.rank > BY_ORDER):
        exchange, evidence = _exchanged(left, right, calibrations, by_images=match.rank > BY_ORDER)
        if evidence:
            left, right, order = (right, left, evidence) if exchange else (left, right, evidence)
    if order.startswith("as") and match.rank == BY_SIDE:
        why = f"guessed: {order}" if left is not match.left else ""
    elif why:
        why = f"{why}; left {order}"
    return FoundCameras(_common_name((left, right), "pair"), left, right, why)


def _exchanged(
    one: FoundCamera, other: FoundCamera, calibrations: Sequence[Path], *, by_images: bool
) -> tuple[bool, str]:
    """Return whether the second of two cameras is the left one, and the evidence."""
    try:
        first, second = (open_sequence(camera.files).read(0) for camera in (one, other))
    except (OSError, ValueError):
        return False, ""
    matches = match_features(first, second, most=FEATURES)
    if len(matches[0]) < MATCHES:
        return False, ""
    for path in calibrations:
        as_named, exchanged = _misfit(path, *matches), _misfit(path, *matches[::-1])
        if min(as_named, exchanged) < CLOSE_PX and max(as_named, exchanged) > DECIDES * min(as_named, exchanged):
            return exchanged < as_named, f"as in {path.name}"
    moved = matches[0][:, 0] - matches[1][:, 0]  # a point is farther right in the left camera
    to_the_left = float(np.mean(moved > 0.0))
    if by_images and max(to_the_left, 1.0 - to_the_left) > CLEAR:
        return to_the_left < 0.5, "by the shift between their first images"
    return False, ""


def _misfit(calibration: Path, left_px: FloatArray, right_px: FloatArray) -> float:
    """Return the median residual (px) of matches as points before a calibrated pair."""
    try:
        points = triangulate(read_calibration(calibration), left_px[None], right_px[None])
    except (OSError, ValueError):
        return np.inf
    return float(np.median(np.nan_to_num(points.reprojection_px, nan=np.inf)))
