"""Fields of a stereo pair: quantities of its subsets at a line, with uncertainty.

The displacement of a subset is the rigid motion of the pair at the subset plus the deviation of the subset from it. The
deviation is measured by the subset alone. Quantities that only evaluate the rigid motion at the points are named model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from fusion.estimation.coverage import along_and_across, region_factor
from fusion.phasors.deformation import ShapePhasors, with_effects
from fusion.phasors.stereo_phasors import StereoResult
from fusion.report.page_images import neighbour_distance
from fusion.sensitivity.analyse import Evaluation
from photogram.geometry import displacement_jacobian
from shaker.labels import AXES
from shaker.sine.phasor import derivative_factor
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray

COVERAGE_FACTOR = 2.0
"""k of every U of a field."""
GAP = 1.4  # longest side of a triangle over their median; longer ones are gaps in the tracked surface
NEARLY = 0.98  # cosine between two directions that count as equal
FEWEST_POINTS = 3  # that span a surface
FIRST_IMAGE = "first_image"
"""Data set of the first left image in the results of a pair."""
Kind = Literal["measured", "model", "shapes", "score"]


@dataclass(frozen=True)
class FieldQuantity:
    """One quantity of N points at a line, in SI.

    `value` (N,): peak phasors, or real numbers without a phase. `expanded` (N,): U of the amplitude or number, NaN if
    unknown; `across` (N,): U of the part at right angles to the phasor. `noise` (N,): amplitude that noise alone
    exceeds at 5 % of the points, None if the quantity is not compared with noise. `kind`: measured by the subsets,
    model of a rigid body, shapes fitted to all pixels, or score of the correlation.
    """

    key: str
    label: str
    kind: Kind
    unit: str
    value: ComplexArray | FloatArray
    expanded: FloatArray
    across: FloatArray | None = None
    noise: FloatArray | None = None

    @property
    def amplitude(self) -> FloatArray:
        """Amplitudes, or the numbers."""
        return np.asarray(np.abs(self.value) if self.across is not None else self.value.real)

    @property
    def u_part(self) -> FloatArray:
        """Standard uncertainties (N,) of the real and of the imaginary part, their root mean square."""
        across = self.expanded if self.across is None else self.across
        return np.asarray(np.hypot(self.expanded, across) / np.sqrt(2.0) / COVERAGE_FACTOR)

    @property
    def above_noise(self) -> BoolArray:
        """Points (N,) whose value is finite and above its noise."""
        finite = np.isfinite(self.value)
        return np.asarray(finite if self.noise is None else finite & (np.abs(self.value) > self.noise))


@dataclass(frozen=True, repr=False, eq=False)
class PointShapes(Arrays, shapes="form S N 3; value L S; covariance L P P"):
    """Deformation of N points in S shapes that are fitted to all pixels.

    `form` (S, N, 3): displacement for an amplitude of 1 m. `value` (L, S): amplitudes, peak phasors, with `covariance`
    (L, 2S, 2S). `names`: of the shapes.
    """

    form: FloatArray
    value: ComplexArray
    covariance: FloatArray
    names: tuple[str, ...]

    @classmethod
    def of(cls, found: ShapePhasors | None) -> PointShapes | None:
        """Return the shapes of a pair, None without a significant deformation."""
        if found is None or found.form is None:
            return None
        return cls(found.form, found.phasors.value, found.covariance, found.phasors.channels)


@dataclass(frozen=True, repr=False, eq=False)
class PairField(Arrays):
    """Tracked points of one stereo pair and their motion at L lines.

    `points_px` (N, 2): in the first left image. `reference_m` (N, 3): at rest in the sensor frame. `rigid` (L, 6):
    displacement phasors of the pair's body, with `covariance` (L, 12, 12) of all real and all imaginary parts, common
    errors included. `deviation`, `u_deviation` (L, N, 3): of the points from that motion; None for a single camera.
    `zncc` (N,): mean correlation. `image` (h, w): first left image, `pixels_per_px` of its pixels for one of the
    camera. `driven` (3,): driven direction, None if it is no translation. `shapes`: of a significant deformation.
    """

    name: str
    body: str
    frequency_hz: FloatArray
    points_px: FloatArray
    reference_m: FloatArray
    rigid: ComplexArray
    covariance: FloatArray
    deviation: ComplexArray | None
    u_deviation: FloatArray | None
    zncc: FloatArray | None
    image: NDArray[np.uint8] | None
    pixels_per_px: float
    driven: FloatArray | None = None
    frames: int = 0
    shapes: PointShapes | None = None

    @cached_property
    def subset_px(self) -> float:
        """Distance of neighbouring subsets."""
        return neighbour_distance(self.points_px, 0.5)

    @cached_property
    def triangles(self) -> IntArray:
        """Triangles (T, 3) between neighbouring points, without gaps of the surface."""
        if len(self.points_px) < FEWEST_POINTS:
            return np.zeros((0, 3), np.int64)
        from scipy.spatial import Delaunay  # imported late: only pages and exports need it

        found = Delaunay(self.points_px).simplices
        sides = np.linalg.norm(self.points_px[found] - self.points_px[np.roll(found, 1, axis=1)], axis=2)
        longest = sides.max(axis=1)
        return np.asarray(found[longest <= GAP * np.median(longest)], dtype=np.int64)

    @cached_property
    def normal(self) -> FloatArray:
        """Unit normal (3,) of the surface."""
        centred = self.reference_m - self.reference_m.mean(axis=0)
        return np.asarray(np.linalg.svd(centred, full_matrices=False)[2][2])

    @property
    def dof(self) -> int:
        """Degrees of freedom of the points' scatter over the frames."""
        return max(self.frames - 2 * len(self.frequency_hz) - 1, 1)

    @property
    def main_line(self) -> int:
        """Line with the largest translation."""
        return int(np.argmax(np.linalg.norm(np.nan_to_num(self.rigid[:, :3]), axis=1)))

    def displacement(self, line: int) -> ComplexArray:
        """Return the displacement (N, 3) of the points; of a single camera, the rigid model."""
        rigid = displacement_jacobian(self.reference_m) @ self.rigid[line]
        return np.asarray(rigid if self.deviation is None else rigid + self.deviation[line])

    def axis_name(self, axis: FloatArray, name: str) -> str:
        """Return the name of a direction with its relation to drive and surface."""
        remarks = ["driven direction"] if self.driven is not None and abs(axis @ self.driven) > NEARLY else []
        across = abs(float(axis @ self.normal))
        remarks += ["out of plane"] if across > NEARLY else ["in plane"] if across < np.sqrt(1.0 - NEARLY**2) else []
        return f"{name} ({', '.join(remarks)})" if remarks else name

    def directions(self) -> list[tuple[str, str, FloatArray]]:
        """Return key, name and unit vector of the directions, the driven one first."""
        axes = [(AXES[k], self.axis_name(axis, AXES[k]), axis) for k, axis in enumerate(np.eye(3))]
        if self.driven is None:
            first = int(np.argmax(np.abs(np.nan_to_num(self.rigid[self.main_line, :3]))))
        elif (first := int(np.argmax(np.abs(self.driven)))) >= 0 and abs(self.driven[first]) <= NEARLY:
            return [("driven", self.axis_name(self.driven, "the drive"), self.driven), *axes]
        return [axes[first], *axes[:first], *axes[first + 1 :]]

    def without_points(self, selected: BoolArray) -> PairField:
        """Return the field at some of its points (N,)."""
        return replace(
            self,
            points_px=self.points_px[selected],
            reference_m=self.reference_m[selected],
            deviation=None if self.deviation is None else self.deviation[:, selected],
            u_deviation=None if self.u_deviation is None else self.u_deviation[:, selected],
            zncc=None if self.zncc is None else self.zncc[selected],
            shapes=None if self.shapes is None else replace(self.shapes, form=self.shapes.form[:, selected]),
        )


# Quantities at a line.


def field_quantities(pair: PairField, line: int) -> list[FieldQuantity]:
    """Return all quantities of the points at a line."""
    moved, rigid = pair.displacement(line), displacement_jacobian(pair.reference_m) @ pair.rigid[line]
    found, directions = list[FieldQuantity](), pair.directions()
    kind: Kind = "model" if pair.deviation is None else "measured"
    for key, name, axis in directions:
        along = np.broadcast_to(axis, moved.shape)
        found.append(_component(pair, line, (f"d-{key}", f"displacement {name}", kind), moved, along))
    principal = principal_direction(moved, directions[0][2])
    found.append(
        _component(pair, line, ("d-size", "|displacement|, along its largest direction", kind), moved, principal)
    )
    if pair.deviation is not None and pair.u_deviation is not None:
        deviation, u = pair.deviation[line], pair.u_deviation[line]
        for key, name, axis in directions:
            of_axis = np.hypot.reduce(u * axis, axis=1)
            found.append(
                _deviation(pair, (f"r-{key}", f"deviation from rigid motion {name}"), deviation @ axis, of_axis)
            )
        found += [] if pair.shapes is None else [_bending(pair.shapes, line, one) for one in directions]
        key, name, axis = directions[0]
        along = np.broadcast_to(axis, moved.shape)
        model = _component(pair, line, (f"m-{key}", f"rigid motion {name}", "model"), rigid, along, noise=False)
        found += [model, _noise(pair, line, directions[0])]
    if pair.zncc is not None:
        none = np.full(len(pair.zncc), np.nan)
        found.append(FieldQuantity("zncc", "correlation (ZNCC)", "score", "", pair.zncc, none))
    return found


def principal_direction(phasors: ComplexArray, towards: FloatArray) -> FloatArray:
    """Return the directions (N, 3) of the largest displacement of points during a period.

    `phasors` (N, 3): of their displacement.

    Re{D·exp(jφ)} runs on an ellipse; its major axis is at the phase with 2φ = -arg(D·D), where the imaginary part is at
    right angles. Their sense is that of `towards` (3,).
    """
    square = np.sum(phasors**2, axis=1)
    largest = (phasors * np.exp(-0.5j * np.angle(square))[:, None]).real
    length = np.linalg.norm(largest, axis=1, keepdims=True)
    unit = np.where(length > 0.0, largest / np.where(length > 0.0, length, 1.0), towards)
    return np.asarray(unit * np.where(unit @ towards < 0.0, -1.0, 1.0)[:, None])


def _component(
    pair: PairField,
    line: int,
    names: tuple[str, str, Kind],
    moved: ComplexArray,
    along: FloatArray,
    *,
    noise: bool = True,
) -> FieldQuantity:
    """Return the component of displacements (N, 3) along unit vectors (N, 3).

    Its covariance is that of the rigid motion at the point and, with `noise`, of the subset.
    """
    key, label, kind = names
    value = np.einsum("nc,nc->n", along, moved)
    slope = np.einsum("nc,ncm->nm", along, displacement_jacobian(pair.reference_m))
    blocks = pair.covariance[line].reshape(2, 6, 2, 6)
    parts = np.einsum("ni,aibj,nj->nab", slope, blocks, slope)
    if noise and pair.u_deviation is not None:
        parts = parts + np.sum((along * pair.u_deviation[line]) ** 2, axis=1)[:, None, None] * np.eye(2)
    return FieldQuantity(key, label, kind, "m", value, *_expanded(value, parts))


def _deviation(pair: PairField, names: tuple[str, str], value: ComplexArray, u: FloatArray) -> FieldQuantity:
    """Return a deviation with the amplitude that noise exceeds at 5 % of the points."""
    expanded, noise = COVERAGE_FACTOR * u, float(region_factor(pair.dof)) * u
    return FieldQuantity(*names, "measured", "m", value, expanded, expanded, noise)


def _bending(shapes: PointShapes, line: int, direction: tuple[str, str, FloatArray]) -> FieldQuantity:
    """Return the deformation of the points in shapes along a direction."""
    key, name, axis = direction
    slope = (shapes.form @ axis).T
    value, count = slope @ shapes.value[line], len(shapes.names)
    parts = np.einsum("ns,asbt,nt->nab", slope, shapes.covariance[line].reshape(2, count, 2, count), slope)
    expanded, across = _expanded(value, parts)
    noise = float(region_factor(np.inf)) / COVERAGE_FACTOR * np.hypot(expanded, across) / np.sqrt(2.0)
    names = f"b-{key}", f"deformation in fitted shapes {name}"
    return FieldQuantity(*names, "shapes", "m", value, expanded, across, noise)


def _expanded(value: ComplexArray, parts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return U along phasors (N,) and at right angles, from covariances (N, 2, 2)."""
    frame = along_and_across(value)
    variance = np.einsum("nii->ni", frame.swapaxes(1, 2) @ parts @ frame)
    expanded = COVERAGE_FACTOR * np.sqrt(np.maximum(variance, 0.0))
    return expanded[:, 0], expanded[:, 1]


def _noise(pair: PairField, line: int, direction: tuple[str, str, FloatArray]) -> FieldQuantity:
    """Return the standard uncertainty of the points by their scatter over the frames.

    Its U is that of a standard deviation with ν degrees of freedom, k·u/√(2ν).
    """
    assert pair.u_deviation is not None
    key, name, axis = direction
    u = np.hypot.reduce(pair.u_deviation[line] * axis, axis=1)
    label = f"σ, noise of displacement {name}"
    return FieldQuantity(f"s-{key}", label, "measured", "m", u, COVERAGE_FACTOR * u / np.sqrt(2.0 * pair.dof))


# Where they come from: an evaluation, or its results file.


def pair_fields(evaluation: Evaluation) -> list[PairField]:
    """Return the fields of all stereo pairs with images, the load first."""
    found = [
        made
        for item in evaluation.stereo
        if item.subsets_px is not None and (made := _of_pair(evaluation, item)) is not None
    ]
    return sorted(found, key=lambda pair: pair.body != "load")


def _of_pair(evaluation: Evaluation, item: StereoResult) -> PairField | None:
    """Return the field of a pair, None with too few points."""
    assert item.subsets_px is not None
    shape = item.deflection
    surface = shape if shape is not None else next(iter(item.surface or ()), None)
    if surface is None:
        return None
    results = [result for result in evaluation.accelerations if result.body == item.body]
    chosen = next((r for r in results if r.source == "photogrammetry"), results[0] if results else None)
    covariance = item.phasors.covariance
    if chosen is not None:
        of_motion = chosen.uncertainty.covariance[item.usable[: len(chosen.uncertainty.covariance)]]
        covariance = common_covariance(item.phasors.frequency_hz, covariance, of_motion)
    made = PairField(
        name=item.name,
        body=item.body,
        frequency_hz=item.phasors.frequency_hz,
        points_px=np.asarray(item.subsets_px, dtype=np.float64),
        reference_m=surface.reference_m,
        rigid=item.phasors.value,
        covariance=covariance,
        deviation=None if shape is None else shape.value,
        u_deviation=None if shape is None else shape.u,
        zncc=item.subset_zncc,
        image=None,
        pixels_per_px=1.0,
        driven=_translation(evaluation.manifest.excitation.direction),
        frames=int(np.isfinite(item.motion.residual_m).sum()),
        shapes=PointShapes.of(item.shapes),
    )
    return finite_points(made)


def _translation(direction: Sequence[float] | None) -> FloatArray | None:
    """Return the driven direction (3,) of a translation, None for moments."""
    first = np.zeros(3) if direction is None else np.asarray(direction, dtype=np.float64)[:3]
    length = float(np.linalg.norm(first))
    return first / length if length > 0.0 else None


def common_covariance(frequency_hz: FloatArray, noise: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Return the covariance (L, 12, 12) of displacements from that of accelerations.

    Where that is not determined, `noise` (L, 12, 12) of the pair alone.
    """
    if acceleration.shape != noise.shape:
        return noise
    moved = acceleration * np.abs(derivative_factor(frequency_hz, -2)[:, None, None]) ** 2
    return np.asarray(np.where(np.isfinite(moved).all(axis=(1, 2), keepdims=True), moved, noise))


def finite_points(pair: PairField) -> PairField | None:
    """Return a field at its finite points, None for too few points."""
    finite = np.isfinite(pair.reference_m).all(axis=1) & np.isfinite(pair.points_px).all(axis=1)
    if pair.deviation is not None and pair.u_deviation is not None:
        finite &= np.isfinite(pair.deviation).all(axis=(0, 2)) & np.isfinite(pair.u_deviation).all(axis=(0, 2))
    usable = np.count_nonzero(finite) >= FEWEST_POINTS and len(pair.frequency_hz) > 0
    return pair.without_points(np.asarray(finite)) if usable and np.isfinite(pair.rigid).all() else None


def read_pair_fields(file: h5py.File) -> list[PairField]:
    """Return the fields of all stereo pairs of open results."""
    driven = file["excitation/direction"][()].tolist() if "direction" in file.get("excitation", {}) else None
    found = [_read_pair(file, name, _translation(driven)) for name in list(file.get("stereo", {}))]
    return sorted((pair for pair in found if pair is not None), key=lambda pair: pair.body != "load")


def _read_pair(file: h5py.File, name: str, driven: FloatArray | None) -> PairField | None:
    group = file[f"stereo/{name}"]
    if not isinstance(group, h5py.Group) or not {"subsets_px", "deflection", "phasors"} <= set(group):
        return None
    body, covariance = str(group.attrs["body"]), group["phasors/covariance"][()]
    frequency_hz, usable = group["phasors/frequency_hz"][()], group["usable"][()].astype(bool)
    for source in ("photogrammetry", "fused"):
        motion = file.get(f"accelerations/{body}-{source}/uncertainty/covariance")
        if motion is not None:
            covariance = common_covariance(frequency_hz, covariance, motion[()][usable[: len(motion)]])
            break
    image = group.get(FIRST_IMAGE)
    made = PairField(
        name=name,
        body=body,
        frequency_hz=frequency_hz,
        points_px=group["subsets_px"][()],
        reference_m=group["deflection/reference_m"][()],
        rigid=group["phasors/value"][()],
        covariance=covariance,
        deviation=group["deflection/value"][()],
        u_deviation=group["deflection/u"][()],
        zncc=group["subset_zncc"][()] if "subset_zncc" in group else None,
        image=None if image is None else image[()],
        pixels_per_px=1.0 if image is None else float(image.attrs["pixels_per_px"]),
        driven=driven,
        frames=int(np.isfinite(group["motion/residual_m"][()]).sum()),
        shapes=_read_shapes(group),
    )
    return finite_points(made)


def _read_shapes(group: h5py.Group) -> PointShapes | None:
    """Return the shapes of a pair of open results."""
    if "shapes/form" not in group:
        return None
    shapes, found = group["shapes"], group["shapes/phasors"]
    covariance = with_effects(found["covariance"][()], shapes["effects"][()])
    return PointShapes(
        shapes["form"][()], found["value"][()], covariance, tuple(found["channels"].asstr()[()].tolist())
    )
