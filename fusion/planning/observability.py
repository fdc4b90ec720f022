"""Motion components that instruments determine by position and direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.errors import InputError
from fusion.instruments.stereo import GEOMETRY, carrier_of
from fusion.recording.daq_records import FileCache
from fusion.recording.load import Manifest
from fusion.recording.placement import carrier, main_direction, measuring_point
from fusion.recording.rig import Rig, Stereo
from fusion.recording.transducer import STATIONARY, TRANSDUCERS
from photogram.images.sequence import ImageSequence
from shaker.labels import MOTION_COMPONENTS
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.digits import number_text

BODIES, TOGETHER = ("load", "base"), "all together"
EXACT, FEWEST_SUBSETS = 1e-4, 6  # u relative to that before that counts as exact; least number of subsets
ROW_TOLERANCE = 1e-9
"""Relative singular value below which instruments cannot distinguish two motions."""


@dataclass(frozen=True)
class Observability:
    """Motion components of a body that an instrument determines by position and direction."""

    body: str
    instrument: str
    rows: FloatArray

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components determined."""
        return tuple(
            name for name, seen in zip(MOTION_COMPONENTS, observable_components(self.rows), strict=True) if seen
        )

    def __str__(self) -> str:
        return f"{self.body}: {self.instrument}: {' '.join(self.components) or 'no single component'}"


def observable_components(rows: FloatArray) -> BoolArray:
    """Return which unit motions (6,) are in the row space of rows [d, r×d].

    Rows are (M, 6). Lever arms are in units of the longest one, which makes the tolerance independent of the size.
    """
    if len(rows) == 0:
        return np.zeros(6, dtype=bool)
    longest = float(np.abs(rows[:, 3:]).max())
    scaled = rows / np.repeat([1.0, longest if longest > 0 else 1.0], 3)
    _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
    basis = directions[singular > ROW_TOLERANCE * max(singular[0], 1e-300)]
    return np.asarray(np.sum(basis**2, axis=0) > 1 - 1e-6)


def instrument_observability(rig: Rig, takes: Sequence[Manifest]) -> list[Observability]:
    """Return the rows of every instrument, then of all instruments of a body together.

    A stereo pair determines all six components of the body it observes. Channels with the same `common` name are one
    instrument. An instrument on a head, or one that observes the room, measures the motion of its carrier.
    """
    names = dict.fromkeys(entry.stereo for take in takes for entry in (*take.images, *take.points))
    pairs = [(name, rig.stereo[name]) for name in names]
    single = [
        Observability(carrier_of(name, pair) if pair.body == STATIONARY else pair.body, f"stereo {name}", GEOMETRY)
        for name, pair in pairs
    ]
    groups: dict[tuple[str, str], list[FloatArray]] = {}
    for daq in (daq for take in takes for daq in take.daq):
        for entry in daq.channel:
            if entry.quantity in TRANSDUCERS and entry.body is not None:
                seen = entry.body if entry.body in BODIES else carrier(entry) or entry.body
                rows = groups.setdefault((seen, entry.common or f"{daq.name}.{entry.name}"), [])
                rows.append(TRANSDUCERS[entry.quantity].geometry(measuring_point(entry), main_direction(entry)))
    single += [Observability(body, name, np.stack(rows)) for (body, name), rows in groups.items()]
    observed = []
    for body in dict.fromkeys((*BODIES, *(item.body for item in single))):
        of_body = [item for item in single if item.body == body]
        observed += of_body
        if len(of_body) > 1:
            observed.append(Observability(body, TOGETHER, np.concatenate([item.rows for item in of_body])))
    return observed


def describe_single_cameras(
    rig: Rig, takes: Sequence[Manifest], observed: Sequence[Observability], already: FileCache
) -> list[str]:
    """Return the precision of each single camera and the remaining motions with all instruments."""
    texts = []
    for images in {images.stereo: images for take in takes for images in take.images}.values():
        name, pair, first = (
            images.stereo,
            rig.stereo[images.stereo],
            already.images.get((images.left, images.bit_depth)),
        )
        if pair.surface is None or first is None or calibration_problems(pair, (first,)):
            continue
        seen = _single_camera_covariance(name, pair, first)
        if seen is None:
            continue
        u, whole = 1e6 * np.sqrt(np.diagonal(seen[0])), seen[1]
        texts.append(
            f"stereo {name} is a single camera: u of one frame by image noise (camera axes, centre of the face) is "
            f"{u[:2].max():.2g} µm across its axis, {u[2]:.2g} µm along it, {u[5]:.2g} µrad about it and "
            f"{number_text(u[3:5].max(), 2)} µrad in tilts"
        )
        text = f"{pair.body}, at the sensor origin: {_sizes(whole, whole)} by stereo {name} only"
        instruments = {item.instrument: item.rows for item in observed if item.body == pair.body}
        others = {key: rows for key, rows in instruments.items() if key not in (TOGETHER, f"stereo {name}")}
        if others:
            rows = np.concatenate(list(others.values()))
            gain = whole @ rows.T @ np.linalg.pinv(rows @ whole @ rows.T, hermitian=True)
            text += (
                f"; {_sizes(np.asarray(whole - gain @ rows @ whole), whole)} with {', '.join(others)}, assumed exact"
            )
        texts.append(text)
    return texts


def _single_camera_covariance(name: str, pair: Stereo, images: ImageSequence) -> tuple[FloatArray, FloatArray] | None:
    """Return the covariance (6, 6) of one frame's motion by image noise, in two frames.

    (Σ JᵀJ/σ²)⁻¹ over the subsets, J the rates of their pixels: about the centre of the face in camera axes, and about
    the sensor origin in sensor axes. None if the first image is unusable.
    """
    from fusion.phasors.stereo_motion import read_rig, sensor_from_camera
    from fusion.planning.look.data_checks import examine_camera
    from photogram.camera import FaceCamera, locate
    from photogram.direct.surface import PlacedCamera, project_body_points
    from photogram.geometry import RigidTransform

    face, (_, look) = read_rig(pair, (images,)), examine_camera(name, images)
    if look is None or len(look.points_px) < FEWEST_SUBSETS or not isinstance(face, FaceCamera):
        return None
    points = locate(face, [look.points_px[None]]).position_m[0]

    def covariance(camera_from_body: RigidTransform) -> FloatArray:
        seen = project_body_points(
            PlacedCamera(face.camera, camera_from_body), camera_from_body.inverse().apply(points)
        )
        rates = seen.rates.reshape(-1, 6)
        return np.asarray(np.linalg.inv(rates.T @ rates / look.sigma_px**2), dtype=np.float64)

    middle = RigidTransform(np.eye(3), points.mean(axis=0))
    return covariance(middle), covariance(sensor_from_camera(pair).inverse())


def _sizes(covariance: FloatArray, before: FloatArray) -> str:
    """Return standard uncertainties of the six components.

    Components are omitted if they are exact compared with `before`.
    """
    u = 1e6 * np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    undetermined = u > EXACT * 1e6 * np.sqrt(np.diagonal(before))
    units = ("µm",) * 3 + ("µrad",) * 3
    sizes = [f"{MOTION_COMPONENTS[i]} {number_text(u[i], 2)} {units[i]}" for i in np.flatnonzero(undetermined)]
    return ", ".join(sizes) or "all determined"


def calibration_problems(pair: Stereo, sequences: Sequence[ImageSequence]) -> list[str]:
    """Return the errors of a pair's calibration, also against the size of its images."""
    from fusion.phasors.stereo_motion import read_rig

    try:
        read_rig(pair, sequences)
    except InputError as error:
        return [str(error)]
    return []
