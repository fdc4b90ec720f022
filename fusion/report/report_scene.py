"""The rig in space: cameras, beams, instruments and bodies from the manifests, and their motion.

All shapes are in the sensor frame at rest. A page shows them twice: interactively, in slow motion (templates/scene.js),
and as three static views for paper and for pages without scripts (`fusion.report.scene_views`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup

from fusion.base import PROGRAM, __version__, list_names, prefix
from fusion.errors import InputError
from fusion.estimation.coverage import Polar
from fusion.estimation.fuse import Acceleration
from fusion.phasors.stereo_motion import read_rig, sensor_from_camera
from fusion.recording.daq_records import split_scan
from fusion.recording.load import Manifest
from fusion.recording.manifest import SCAN, ChannelEntry
from fusion.recording.placement import LaserBeams, is_aimed_at_mirror, measuring_point, mirror_of, unit_direction
from fusion.recording.rig import Stereo
from fusion.recording.transducer import TRANSDUCERS
from fusion.report.figure import BLACK, GREY, ORANGE, PURPLE, SKY, SOURCE_COLOUR
from fusion.report.folder import render_page
from fusion.report.motion_figures import tracked_surface
from fusion.report.scene_views import SceneShape, make_box, solid, static_views
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.moving_body import MovingPart, make_moving_part, moving_parts
from photogram.camera import Camera, FaceCamera
from photogram.geometry import RigidTransform, displacement_jacobian
from shaker.labels import MOTION_COMPONENTS
from shaker.sine.phasor import derivative_factor
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.digits import number_text, quantity_text, signed_text

KINDS = {
    "load": ("load", ORANGE),
    "element": ("elastic element", ORANGE),
    "base": ("base", GREY),
    "surface": ("tracked points", SKY),
    "camera": ("cameras", SOURCE_COLOUR["photogrammetry"]),
    "vibrometer": ("laser beams", SOURCE_COLOUR["vibrometer"]),
    "accelerometer": ("sensors on the bodies", SOURCE_COLOUR["accelerometer"]),
    "force": ("force transducers", SKY),
    "frame": ("sensor axes", BLACK),
    "gravity": ("gravity", PURPLE),
}
"""Kinds of shapes: their name in the legend and their colour."""
BODIES = ("load", "base")
SMALLEST_REACH_M = 0.03
"""Smallest size of axes and arrows."""
CENTRED_M = 5e-3  # a centre of mass closer to the origin gives no direction
FARTHEST = 10.0  # largest distance of the cameras' target, over that of the left camera from the sensor
NEAR_PARALLEL = 1e-3  # of two optical axes: the sine of their angle
GAP = 2.0  # longest side of a triangle over their median; longer ones are gaps in the tracked surface
MOST_NAMES = 3  # of recordings that have one rig
MOST_LABELS = 12  # of channels of one kind
SHOWN_SHARE = 0.08  # of the size of the bodies: largest displacement at the first magnification


@dataclass(frozen=True)
class SceneMotion:
    """Motion at one line: phasors of x(t) = Re{X exp(+jωt)}, peak values.

    `rigid`: by body (6,), translation in m of the sensor origin and rotation in rad; `deflection`: by tracked surface
    (N, 3) in m, in addition to the rigid motion. `amplitudes`: texts with U.
    """

    name: str
    frequency_hz: float
    amplitudes: tuple[str, ...] = ()
    rigid: Mapping[str, ComplexArray] = field(default_factory=dict)
    deflection: Mapping[str, ComplexArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """Shapes in the sensor frame at rest, their motion at every line, and remarks.

    `up` (3,): against gravity; the sensor's z axis if gravity is not stated.
    """

    name: str
    shapes: tuple[SceneShape, ...]
    motions: tuple[SceneMotion, ...] = ()
    remarks: tuple[str, ...] = ()
    up: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @property
    def kinds(self) -> list[str]:
        """Existing kinds of shapes in the order of the legend."""
        return [kind for kind in KINDS if any(shape.kind == kind for shape in self.shapes)]

    def data(self) -> dict[str, Any]:
        """Return the data of the script: mm, and µm and µrad of phasors."""
        return {
            "up": _numbers(self.up, 6),
            "shapes": [_shape_data(shape) for shape in self.shapes],
            "motions": [_motion_data(motion, self.shapes) for motion in self.motions],
        }


class ScenePage(NamedTuple):
    """Context of templates/scene.html; `json` and `views` are safe within a page."""

    name: str
    json: Markup
    views: Markup
    legend: list[tuple[str, str]]
    colours: list[tuple[str, str]]
    descriptions: list[tuple[str, str]]
    lines: list[str]
    remarks: tuple[str, ...]
    deflects: bool


def scene_page(scene: Scene) -> ScenePage:
    """Return a scene as a page shows it."""
    data = scene.data()
    return ScenePage(
        name=scene.name,
        json=htmlsafe_json_dumps(data, separators=(",", ":"), allow_nan=False),
        views=static_views(scene.shapes),
        legend=[(kind, KINDS[kind][0]) for kind in scene.kinds],
        colours=[(kind, "var(--ink)" if colour == BLACK else colour) for kind, (_, colour) in KINDS.items()],
        descriptions=[(shape.name, shape.description) for shape in scene.shapes],
        lines=[motion.name for motion in scene.motions],
        remarks=scene.remarks,
        deflects=any(motion.deflection and motion.rigid for motion in scene.motions),
    )


def _numbers(values: FloatArray, digits: int) -> list[float]:
    """Return rounded numbers as a flat list, integers without a point."""
    rounded = np.round(np.asarray(values, dtype=np.float64).ravel(), digits) + 0.0
    return [int(value) if value == int(value) else value for value in rounded.tolist()]


def _shape_data(shape: SceneShape) -> dict[str, Any]:
    data = {
        "k": shape.kind,
        "n": shape.name,
        "t": shape.description,
        "p": _numbers(1e3 * shape.points_m, 1 if shape.dots == "many" else 2),
        "f": shape.faces,
        "s": shape.strokes,
        "b": shape.body,
        "l": shape.label,
        "d": shape.dots,
        "a": int(shape.arrow),
        "h": int(shape.dashed),
        "o": shape.fill if shape.faces else 0,
        "c": int(shape.closed),
        "u": shape.surface,
    }
    return {key: value for key, value in data.items() if value}


def _motion_data(motion: SceneMotion, shapes: Sequence[SceneShape]) -> dict[str, Any]:
    """Return a motion with its first magnifications, of all bodies and of deflections."""
    points = np.concatenate([shape.points_m for shape in shapes if shape.body] or [np.zeros((1, 3))])
    reach = 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
    moving = [shape for shape in shapes if shape.body in motion.rigid]
    rigid = [displacement_jacobian(shape.points_m) @ motion.rigid[shape.body] for shape in moving]
    bent = list(motion.deflection.values())
    return {
        "f": round(motion.frequency_hz, 6),
        "t": motion.amplitudes,
        "r": {body: _parts(value, 3) for body, value in motion.rigid.items()},
        "d": {name: _parts(value, 3) for name, value in motion.deflection.items()},
        "m": [_magnification(reach, rigid or bent), _magnification(reach, bent)],
    }


def _parts(phasors: ComplexArray, digits: int) -> list[float]:
    """Return real and imaginary part of every phasor in millionths, in turn, with significant digits."""
    values = 1e6 * np.stack([phasors.real, phasors.imag], axis=-1).ravel()
    return [float(f"{value:.{digits + 2}g}") for value in values.tolist()]


def _magnification(reach_m: float, displacements: Sequence[ComplexArray]) -> float:
    largest = max((float(np.linalg.norm(np.abs(d), axis=1).max(initial=0.0)) for d in displacements), default=0.0)
    return float(f"{SHOWN_SHARE * reach_m / largest:.2g}") if largest > 0.0 else 1.0


# Positions from the manifests.


def rig_scene(manifest: Manifest, surfaces: Mapping[str, FloatArray] | None = None) -> Scene:
    """Return the rig of a recording as its manifests state it.

    Only calibrations and scan points are read. `surfaces`: points (N, 3) in the sensor frame that stereo pairs have
    tracked, by the name of the pair.
    """
    rig, remarks, shapes = manifest.rig, list[str](), list[SceneShape]()
    channels, parts = list(_channels(manifest)), moving_parts(rig, manifest.part)
    if not (channels or parts or rig.stereo):
        remarks.append("The manifests state no position of a camera, an instrument or a load.")
    if parts:
        remarks.append("Load and parts are drawn as solids of their mass and moments of inertia.")
    shapes += [_solid(part, "load") for part in parts] + [_solid(part, "base") for part in _base_parts(manifest)]
    middle = sum((part.mass_kg * part.centre_of_mass_m for part in parts), np.zeros(3))
    middle = middle / max(sum(part.mass_kg for part in parts), 1e-30)
    sizes = [float(np.linalg.norm(shape.points_m, axis=1).max()) for shape in shapes]
    sizes = [max(sizes)] if sizes else [float(np.linalg.norm(measuring_point(entry))) for entry in channels]
    reach = max(SMALLEST_REACH_M, float(np.median(sizes or [0.0])))  # the median ignores a single distant point
    base = [np.array([entry.point]) for entry in channels if entry.body == "base" and entry.point is not None]
    pairs_by_remark: dict[str, list[str]] = {}
    for name, pair in rig.stereo.items():
        surface = None if surfaces is None else surfaces.get(name)
        cameras, target, remark = _pair(name, pair, surface)
        shapes += cameras if surface is None else [*cameras, _surface(name, pair.body, surface)]
        base += [target] if pair.body == "base" and len(target) else []
        pairs_by_remark.setdefault(remark, []).append(name)
    remarks += [f"Stereo {', '.join(names)}: {remark}." for remark, names in pairs_by_remark.items()]
    if base and not any(shape.body == "base" and shape.closed for shape in shapes):
        shapes.append(_table(np.concatenate(base), middle))
        remarks.append(f"The base has no stated shape: {shapes[-1].description}.")
    shapes += [*_axes(1.15 * reach), *_instruments(channels, middle, reach)]
    gravity, up = rig.surroundings.free_fall_mps2[0], np.array([0.0, 0.0, 1.0])
    if gravity is None:
        remarks.append("Gravity is not stated; the sensor's z axis points up.")
    else:
        up = -np.array(gravity) / np.linalg.norm(gravity)
        shapes.append(_gravity(np.array(gravity), reach, shapes))
    return Scene(manifest.name, tuple(shapes), (), tuple(remarks), up)


def _channels(manifest: Manifest) -> Iterator[ChannelEntry]:
    """Yield every channel with a position on a body, once."""
    seen = set()
    for _, block in manifest.set_ups:
        takes = [block]
        if any(daq.file.suffix.lower() == SCAN for daq in block.daq):
            try:
                takes = [part for part, _ in split_scan(block)]
            except InputError:  # the reader of the scan reports the error
                takes = [block]
        for entry in (entry for take in takes for daq in take.daq for entry in daq.channel):
            placed = entry.quantity in TRANSDUCERS or (entry.quantity == "force" and entry.point is not None)
            if placed and (entry.name, entry.point) not in seen:
                seen.add((entry.name, entry.point))
                yield entry


def _base_parts(manifest: Manifest) -> list[MovingPart]:
    """Return the parts of the base."""
    zero = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    parts = [part for part in manifest.part if part.body == "base"]
    return [
        make_moving_part(part.name, part.true_mass, part.centre_of_mass, part.inertia, (0.0, *zero[1:]))
        for part in parts
    ]


def _solid(part: MovingPart, body: str) -> SceneShape:
    """Return a part as a solid of its mass and inertia, or as a point."""
    points, faces, strokes, shape_text = solid(part.mass_kg, part.centre_of_mass_m, part.inertia_kgm2)
    text = f"{number_text(part.mass_kg, 5)} kg, centre of mass {position_text(part.centre_of_mass_m)}, {shape_text}"
    made = SceneShape(body, part.name, text, points, faces, strokes, body=body, closed=True, fill=0.5)
    return made if faces else replace(made, dots="one", closed=False)


def position_text(point_m: FloatArray) -> str:
    """Return a position in the sensor frame as text."""
    return "(" + ", ".join(signed_text(1e3 * x, ".1f") for x in point_m) + ") mm"


def along(direction: FloatArray) -> str:
    """Return a direction as text."""
    return "(" + ", ".join(signed_text(x, ".3f") for x in direction) + ")"


def _arrow(kind: str, name: str, description: str, ends_m: tuple[FloatArray, FloatArray], **more: Any) -> SceneShape:
    return SceneShape(kind, name, description, np.stack(ends_m), strokes=((0, 1),), arrow=True, **more)


def _dot(kind: str, name: str, description: str, at: FloatArray, **more: Any) -> SceneShape:
    return SceneShape(kind, name, description, at[None], dots="one", **more)


def _axes(length: float) -> Iterator[SceneShape]:
    for letter, axis in zip("xyz", np.eye(3), strict=True):
        text = f"{letter} axis of the sensor frame, from its origin"
        yield _arrow("frame", f"axis {letter}", text, (np.zeros(3), length * axis), label=letter)


def _gravity(gravity: FloatArray, reach: float, shapes: Sequence[SceneShape]) -> SceneShape:
    """Return the arrow of gravity, next to the bodies on the side opposite the cameras."""
    down = gravity / np.linalg.norm(gravity)
    seen = [shape.points_m[0] for shape in shapes if shape.kind == "camera"]
    direction = -np.mean(seen, axis=0) if seen else np.array([1.0, 0.0, 0.0])
    across = [v - (v @ down) * down for v in (direction, np.eye(3)[int(np.argmin(np.abs(down)))])]
    across_gravity = next(v for v in across if np.linalg.norm(v) > NEAR_PARALLEL * reach)
    start = 1.7 * reach * across_gravity / np.linalg.norm(across_gravity) - 0.45 * reach * down
    text = f"{np.linalg.norm(gravity):.4f} m/s² along {along(down)}"
    return _arrow("gravity", "gravity", text, (start, start + 0.9 * reach * down), label="g")


def _table(points: FloatArray, middle: FloatArray) -> SceneShape:
    """Return a box about an axis with all points of the base on one side.

    If possible the load is on the other side.
    """
    side = np.sign(points).sum(axis=0) / len(points)
    beyond = np.where(np.abs(side) == 1.0, np.abs(points).min(axis=0), 0.0)
    opposite = np.where(-side * middle > CENTRED_M, beyond, 0.0)
    size = opposite if opposite.any() else beyond
    axis = int(np.argmax(size)) if size.any() else 2
    half = np.abs(points).max(axis=0)
    half = np.maximum(half, max(SMALLEST_REACH_M, 0.5 * float(np.delete(half, axis).max())))
    low, high = -half, half
    low[axis], high[axis] = points[:, axis].min(), points[:, axis].max()
    thin = 0.2 * float(np.delete(half, axis).max()) - (high[axis] - low[axis])
    if thin > 0.0:  # outwards, as seen from the load
        end = low if low[axis] + high[axis] <= 0.0 else high
        end[axis] += np.copysign(thin, low[axis] + high[axis] - 1e-12)
    corners, faces, edges = make_box(high - low)
    text = f"drawn as a box about the {'xyz'[axis]} axis around its points"
    return SceneShape(
        "base", "base", text, corners + (low + high) / 2.0, faces, edges, "base", closed=True, fill=0.3, dashed=True
    )


def _surface(name: str, body: str, points: FloatArray) -> SceneShape:
    text = f"{len(points)} points on the {body} tracked by the pair, centre {position_text(points.mean(axis=0))}"
    faces = _triangles(points)
    return SceneShape(
        "surface", f"points of {name}", text, points, faces, body=body, dots="many", fill=0.5, surface=name
    )


def _triangles(points: FloatArray) -> tuple[tuple[int, ...], ...]:
    """Return the triangles between neighbours among points (N, 3) of a smooth surface."""
    from scipy.spatial import Delaunay  # imported late: only pages with a viewer need it

    _, size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if size[1] <= NEAR_PARALLEL * size[0]:
        return ()
    found = Delaunay(points @ axes[:2].T).simplices
    longest = np.linalg.norm(points[found] - points[np.roll(found, 1, axis=1)], axis=2).max(axis=1)
    return tuple(map(tuple, found[longest <= GAP * np.median(longest)].tolist()))


# Cameras.


def _pair(name: str, pair: Stereo, surface: FloatArray | None) -> tuple[list[SceneShape], FloatArray, str]:
    """Return the cameras of a pair, their target, and a remark on it."""
    pose = sensor_from_camera(pair)
    origin, distance = pose.translation_m, float(np.linalg.norm(pose.translation_m))
    middle = None if surface is None else surface.mean(axis=0)
    if pair.calibration is None:
        shape = _dot("camera", f"frame of {name}", f"origin {position_text(origin)}", origin, label=name)
        remark = "without a calibration only the origin of its frame is known, not the positions of its cameras"
        return [shape], np.zeros((0, 3)) if surface is None else surface, remark
    try:
        rig = read_rig(pair, ())
    except InputError:
        return [], np.zeros((0, 3)), "not drawn, since its calibration cannot be read"
    placed = [(camera, pose @ from_left.inverse()) for camera, from_left in rig.camera_poses]
    remark = "the frusta end at the tracked points"
    if middle is None and isinstance(rig, FaceCamera):
        middle, remark = pose.apply(rig.point_m), "the frustum ends at the stated surface"
    elif middle is None:
        middle = _fixation(placed[0][1], placed[1][1])
        remark = "the frusta end at the point nearest to both optical axes"
    if middle is None:
        middle = pose.apply(np.array([0.0, 0.0, max(-(pose.rotation.T @ origin)[2], 0.5 * distance)]))
        remark = "the axes of the cameras do not meet; the frusta end at the depth of the sensor origin"
    names = [f"{name} {side}" for side in ("left", "right")] if len(placed) > 1 else [name]
    shapes = [
        _camera(pair_name, pair.body, *camera_pose, middle)
        for pair_name, camera_pose in zip(names, placed, strict=True)
    ]
    return shapes, middle[None] if surface is None else surface, remark


def _fixation(left: RigidTransform, right: RigidTransform) -> FloatArray | None:
    """Return the point nearest to both optical axes.

    Returns None unless it is in front of both cameras.
    """
    centre = np.stack([left.translation_m, right.translation_m])
    axis = np.stack([left.rotation[:, 2], right.rotation[:, 2]])
    if np.linalg.norm(np.cross(*axis)) < NEAR_PARALLEL:
        return None
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centre))
    depth = np.einsum("nj,nj->n", axis, point - centre)
    return point if depth.min() > 0.0 and depth.max() < FARTHEST * np.linalg.norm(centre[0]) else None


def _camera(name: str, body: str, camera: Camera, pose: RigidTransform, target: FloatArray) -> SceneShape:
    """Return a camera and its frustum to the depth of a target.

    Points: apex, far and near corners, mark of the upper edge.
    """
    depth = float(pose.inverse().apply(target)[2])
    depth = depth if depth > 0.0 else max(float(np.linalg.norm(pose.translation_m)), SMALLEST_REACH_M)
    far, near = frustum(camera, pose, depth), frustum(camera, pose, 0.1 * depth)
    top = (near[0] + near[1]) / 2.0 + 0.25 * (near[0] - near[3] + near[1] - near[2]) / 2.0
    centre = pose.apply(np.array([0.0, 0.0, depth]))
    points = np.concatenate([pose.translation_m[None], far, near, top[None], centre[None]])
    strokes = [(0, k) for k in range(1, 5)] + [(1, 2, 3, 4, 1), (5, 6, 7, 8, 5), (5, 9, 6)]
    faces = ((1, 2, 3, 4), (5, 6, 7, 8), (5, 9, 6))
    width, height = (int(length) for length in camera.size_px)
    text = f"centre {position_text(pose.translation_m)}, view along {along(pose.rotation[:, 2])}, towards the {body}"
    text += f", {width} × {height} px"
    return SceneShape("camera", f"camera {name}", text, points, faces, tuple(strokes), label=name, fill=0.1)


def frustum(camera: Camera, pose: RigidTransform, depth_m: float) -> FloatArray:
    """Return the corners (4, 3) of the field of view at a depth.

    They run clockwise from the upper left.
    """
    width, height = camera.size_px.astype(np.float64) - 0.5
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    rays = camera.undistort(corners)
    if not np.isfinite(rays).all():  # outside the range of the distortion model
        rays = replace(camera, distortion=np.zeros(8)).undistort(corners)
    return pose.apply(depth_m * np.column_stack([rays, np.ones(4)]))


# Channels.


def _instruments(channels: Sequence[ChannelEntry], middle: FloatArray, reach: float) -> Iterator[SceneShape]:
    """Yield beams, points and senses of all channels with a position, and mirrors."""
    beams = LaserBeams.of(channels)
    kinds = [TRANSDUCERS[e.quantity].kind if e.quantity in TRANSDUCERS else "force" for e in channels]
    mirrors, named = dict[str, FloatArray](), set[str]()
    for kind, entry in zip(kinds, channels, strict=True):
        at = measuring_point(entry)
        if entry.direction is None and not is_aimed_at_mirror(entry):
            yield _dot(kind, entry.name, f"at {position_text(at)}", at, label=entry.name, body=entry.body or "")
            continue
        direction = unit_direction(entry)
        label = entry.name if kinds.count(kind) <= MOST_LABELS and entry.name not in named else ""
        named.add(entry.name)
        turns = entry.quantity in TRANSDUCERS and TRANSDUCERS[entry.quantity].rotational
        sense = "positive about" if turns else "positive along"
        text = f"{entry.quantity} of the {entry.body}, at {position_text(at)}, {sense} {along(direction)}"
        length = (0.28 if kind == "vibrometer" else 0.35) * reach
        ends = at, at + length * direction
        yield _arrow(kind, entry.name, text, ends, body=entry.body or "", label=label, dots="one")
        if kind == "vibrometer":
            start, head = _beam_start(entry, direction, middle if entry.body == "load" else np.zeros(3), beams, reach)
            text = f"from {position_text(start)}" if head else "from an unstated position"
            name, both = f"beam of {entry.name}", np.stack([start, at])
            yield SceneShape(kind, name, f"{text} to {position_text(at)}", both, strokes=((0, 1),), dashed=not head)
            if head:
                mirrors[head] = start
    for name, mirror in mirrors.items():
        yield _dot("vibrometer", f"head {name}", f"its beams leave {position_text(mirror)}", mirror, label=name)


def _beam_start(
    entry: ChannelEntry, direction: FloatArray, middle: FloatArray, beams: LaserBeams, reach: float
) -> tuple[FloatArray, str]:
    """Return the start of a laser beam and the name of its head.

    If no start is stated, it is on the free side of the body.
    """
    at, head = measuring_point(entry), entry.head
    if head is not None and head.stated.mirror is not None:
        return mirror_of(entry), head.name
    side = 1.0 if direction @ (at - middle) >= 0.0 else -1.0
    if head is not None and head.stated.standoff is not None:
        return beams.centres[head.name] + side * head.stated.standoff * direction, head.name
    return at + 2.0 * reach * side * direction, ""


# Additions of an evaluation: tracked points, and motion at every line.


def evaluation_scene(evaluation: Evaluation) -> Scene:
    """Return the rig of a recording with the motion and significant deflections of its bodies."""
    seen = [
        surface
        for item in evaluation.stereo
        if item.name in evaluation.manifest.rig.stereo
        for surface in tracked_surface(item)
    ]
    scene = rig_scene(evaluation.manifest, {surface.name: surface.points_m for surface in seen})
    moved = {body: result for body in BODIES if (result := _result(evaluation.accelerations, body)) is not None}
    remarks = list(scene.remarks)
    remarks += [text for body, result in moved.items() if (text := _unobserved(body, result))]
    frequency = next((result.phasors.frequency_hz for result in moved.values()), np.zeros(0))
    motions = list[SceneMotion]()
    elements = {body: result.polar for body, result in moved.items()}
    displaced = body_displacements(evaluation)
    for k, f in enumerate(frequency.tolist()):
        texts = [_amplitude_text(body, polar[k], f) for body, polar in elements.items()]
        texts += [text for surface in seen for text in surface.texts(k)]
        bent = {surface.name: value for surface in seen if (value := surface.deflection(k)) is not None}
        rigid = {body: phasors[k] for body, phasors in displaced.items()}
        multiple = int(evaluation.lines.multiple[k]) if k < len(evaluation.lines.multiple) else 1
        title = f"{f:.4f} Hz" + (f", harmonic {multiple}" if multiple > 1 else "")
        motions.append(SceneMotion(title, f, tuple(texts), rigid, bent))
    return replace(scene, motions=tuple(motions), remarks=tuple(remarks))


def displacement(result: Acceleration) -> ComplexArray:
    """Return displacement phasors (K, 6) of the sensor origin, -A/ω², in m and rad."""
    return np.asarray(derivative_factor(result.phasors.frequency_hz, -2)[:, None] * result.phasors.value)


def body_displacements(evaluation: Evaluation) -> dict[str, ComplexArray]:
    """Return displacement phasors (K, 6) by body, 0 where not observed."""
    found = {body: _result(evaluation.accelerations, body) for body in BODIES}
    return {body: np.nan_to_num(displacement(result)) for body, result in found.items() if result is not None}


def _result(accelerations: Sequence[Acceleration], body: str) -> Acceleration | None:
    """Return the fused acceleration of a body, else that of its first source."""
    results = [result for result in accelerations if result.body == body]
    return next((result for result in results if result.source == "fused"), results[0] if results else None)


def _unobserved(body: str, result: Acceleration) -> str:
    missing = [name for k, name in enumerate(MOTION_COMPONENTS) if not result.observed[:, k].any()]
    return f"{body.capitalize()}: no instrument observes {' '.join(missing)}, drawn as 0." if missing else ""


def _amplitude_text(body: str, elements: Sequence[Polar | None], frequency_hz: float) -> str:
    """Return the largest translation of a body at a line as text."""
    square = (2.0 * np.pi * frequency_hz) ** 2
    found = [(axis, value) for axis, value in zip("xyz", elements, strict=False) if value is not None]
    if not found:
        return f"{body}: no translation is observed"
    axis, value = max(found, key=lambda pair: pair[1].magnitude)
    factor, letter = prefix(value.magnitude / square)
    size = quantity_text(value.magnitude / square / factor, value.expanded_magnitude / square / factor, f"{letter}m")
    phase = np.degrees(np.angle(-complex(value.re, value.im)))
    text = f"{body} {axis}: {size} at {signed_text(phase, '.1f')}° (k = {value.k_magnitude:.2f})"
    return text.replace("-", "\N{MINUS SIGN}")


# A separate page without data.


def rig_page(manifests: Sequence[Manifest]) -> str:
    """Return a page of the rig of some recordings as stated, each arrangement once."""
    scenes: dict[Markup, tuple[list[str], ScenePage]] = {}
    for manifest in manifests:
        page = scene_page(rig_scene(manifest))
        scenes.setdefault(page.json, ([], page))[0].append(manifest.name)
    shown = [(list_names(names, MOST_NAMES), page) for names, page in scenes.values()]
    context = {"rig": manifests[0].rig.name, "scenes": shown, "program": f"{PROGRAM} {__version__}"}
    return render_page("rig.html", context)
