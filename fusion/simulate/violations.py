"""Violations of the program's assumptions: `shakercal simulate --violate NAME[=SIZE]`.

They are independent of the estimator's model: no evaluating module is imported. The same seed with and without a
violation gives the same errors and noise, so that two recordings differ only by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fusion.simulate.preset import ChannelSpec, Preset, StereoSetup
from fusion.simulate.world import SimulatedMotion, Violations, World
from fusion.simulate.write import Record
from photogram.synthetic.scene import Face, tile_texture
from shakercal._common.arrays import ComplexArray, FloatArray

GRAVITY_UNIT = 9.80665  # m/s² in one g
COEFFICIENT_PER_K = 5e-4  # an uncompensated strain gauge on aluminium: its stiffness and the gauge factor
FLICKER_HZ = 100.0
Records = Mapping[str, Record]


@dataclass(frozen=True)
class Violation:
    """One assumption that a simulation violates.

    `size` in `unit`: the default. `about`: the physics in one sentence. `needs`: requirement of the preset (`channels`:
    none, `cameras`, `images`). `changes`: by stage a function of its value, the size, its context.
    """

    unit: str
    size: float
    about: str
    changes: Mapping[str, Callable[..., Any]]
    needs: str = "channels"


def violations(texts: Sequence[str], preset: Preset) -> Violations:
    """Return the violations of `texts` (NAME or NAME=SIZE); `ValueError` if the preset has none."""
    active, sizes = [], dict[str, float]()
    for text in texts:
        name, equals, number = text.partition("=")
        violation = CATALOGUE.get(name)
        if violation is None:
            raise ValueError(f"violate: expected one of {', '.join(CATALOGUE)}, found {name or 'nothing'}")
        try:
            size = float(number) if equals else violation.size
        except ValueError:
            size = math.nan
        if not (math.isfinite(size) and size > 0.0):
            raise ValueError(
                f"violate: expected a number above 0 of unit {violation.unit} for {name}, found {number or 'nothing'}"
            )
        has = {"channels": True, "cameras": bool(preset.stereo), "images": bool(preset.stereo) and not preset.as_points}
        if not has[violation.needs]:
            raise ValueError(f"violate: expected a preset with {violation.needs} for {name}, found {preset.name}")
        if name in sizes:
            raise ValueError(f"violate: expected every name once, found {name} twice")
        sizes[name] = size
        active.append((size, violation.changes))
    return Violations(tuple(active), sizes)


# Placement: true directions of beams, and wrong statements.


def _head_tilt(direction: FloatArray, size: float, spec: ChannelSpec, _: Preset) -> FloatArray:
    """Rotate all beams of the head together, about an axis across the usual beams."""
    if spec.quantity != "velocity":
        return direction
    tilted = direction + np.cross(size * np.array([0.8, -0.6, 0.0]), direction)
    return np.asarray(tilted / np.linalg.norm(tilted))


def _scanner_fan(direction: FloatArray, size: float, spec: ChannelSpec, preset: Preset) -> FloatArray:
    """Let beams stated as parallel leave one mirror above the centre of their points."""
    if spec.quantity != "velocity":
        return direction
    nominal, point = np.array(spec.direction), np.array(spec.point)
    points = [
        np.array(other.point)
        for daq in preset.daqs
        for other in daq.channels
        if other.quantity == "velocity" and other.direction == spec.direction
    ]
    off = point - np.mean(points, axis=0)
    fanned = direction + (off - nominal * (off @ nominal)) / size  # the reading is positive away from the mirror
    return np.asarray(fanned / np.linalg.norm(fanned))


def _misstated(direction: FloatArray | float, *names: str) -> Callable[..., FloatArray]:
    """Return the change of some errors by multiples of their u along a `direction`."""

    def change(value: FloatArray, size: float, drawn: str, uncertainty: float | FloatArray) -> FloatArray:
        return np.asarray(value + size * uncertainty * direction) if drawn in names else value

    return change


# Motion: additional motions, and motions that only some instruments observe.


def _transverse(acceleration: ComplexArray, size: float) -> ComplexArray:
    """Add motion across the axis that moves most, a share of its amplitude."""
    main = int(np.argmax(np.abs(acceleration[0, :3])))
    changed = acceleration.copy()
    for across, share, phase in zip([(main + 1) % 3, (main + 2) % 3], (0.8, 0.6), (0.3, 0.5), strict=True):
        changed[:, across] += size * share * acceleration[:, main] * np.exp(1j * phase)
    return changed


def _shaken(*instruments: str) -> Callable[..., SimulatedMotion]:
    """Return the change of the motion that shaken instruments observe."""

    def change(
        motion: SimulatedMotion, size: float, world: World, _: str, instrument: str, __: FloatArray
    ) -> SimulatedMotion:
        if instrument not in instruments:
            return motion
        drive = world.motion["load"].acceleration
        main = int(np.argmax(np.abs(drive[0, :3])))
        shake = np.zeros_like(drive)
        shake[:, main] = size * drive[:, main] * np.exp(0.7j)
        shake[:, (main + 1) % 3] = 0.5 * shake[:, main]
        return SimulatedMotion(motion.frequency_hz, motion.acceleration - shake)

    return change


def _height(preset: Preset) -> float:
    """Return the height (m) of the load's highest face or point above the sensor origin."""
    faces = [setup.face_centre[2] for setup in preset.stereo if setup.body == "load"]
    points = [spec.point[2] for daq in preset.daqs for spec in daq.channels if spec.body == "load"]
    return max([*faces, *points])


def _loaded(world: World, more: ComplexArray) -> World:
    """Return a world with an additional wrench `more` (K, 6) on the sensor."""
    total = world.load_wrench + (1.0 if world.preset.sense == "on_load" else -1.0) * more
    return replace(world, load_wrench=total, outputs=np.einsum("kcj,kj->kc", world.sensitivity, total))


def _load_mass(preset: Preset) -> float:
    return preset.load.mass + sum(part.mass for part in preset.parts)


def _axial_angle(frequency_hz: FloatArray, size: float) -> FloatArray:
    """Return k·L = (π/2)·f/f₁ of a uniform rod that is driven at one end."""
    return np.asarray(0.5 * np.pi * frequency_hz / size)


def _axial_seen(
    motion: SimulatedMotion, size: float, world: World, body: str, _: str, point: FloatArray
) -> SimulatedMotion:
    """Return the motion of a rod at h: cos(k(L − h))/cos(kL) times that below."""
    if body != "load":
        return motion
    angle, share = _axial_angle(motion.frequency_hz, size), float(np.clip(point[2] / _height(world.preset), 0.0, 1.0))
    seen = motion.acceleration.copy()
    seen[:, 2] *= np.cos(angle * (1.0 - share)) / np.cos(angle)
    return SimulatedMotion(motion.frequency_hz, seen)


def _axial_load(world: World, size: float) -> World:
    """Load the sensor with the force at a rod's lower end: m·a·tan(kL)/(kL)."""
    motion, more = world.motion["load"], np.zeros_like(world.load_wrench)
    angle = _axial_angle(motion.frequency_hz, size)
    more[:, 2] = _load_mass(world.preset) * motion.acceleration[:, 2] * (np.tan(angle) / angle - 1.0)
    return _loaded(world, more)


def _bending(motion: SimulatedMotion, size: float, world: World) -> ComplexArray:
    """Return the motion (K, 2) of the tip in the first bending mode.

    Shape of a cantilever, φ(s) = s²(3 − s)/2 over s = h/L, participation ∫φ/∫φ² = (3/8)/(33/140). It is excited by the
    transverse motion at half the height.
    """
    frequency_hz, a = motion.frequency_hz, motion.acceleration
    ratio = (frequency_hz / size) ** 2
    half = 0.5 * _height(world.preset)
    driving = np.stack([a[:, 0] + half * a[:, 4], a[:, 1] - half * a[:, 3]], axis=1)
    return np.asarray((3 / 8) / (33 / 140) * (ratio / (1.0 - ratio))[:, None] * driving)


def _bending_seen(
    motion: SimulatedMotion, size: float, world: World, body: str, _: str, point: FloatArray
) -> SimulatedMotion:
    """Add the mode at a height: φ(s) of the tip's motion, and the rotation φ'(s)/L."""
    if body != "load":
        return motion
    tip, height = _bending(motion, size, world), _height(world.preset)
    s = float(np.clip(point[2] / height, 0.0, 1.0))
    shift, turn = s * s * (3.0 - s) / 2.0, (3.0 * s - 1.5 * s * s) / height
    seen = motion.acceleration.copy()
    seen[:, :2] += shift * tip - turn * point[2] * tip  # of the origin, which rotates with the point
    seen[:, 3] -= turn * tip[:, 1]
    seen[:, 4] += turn * tip[:, 0]
    return SimulatedMotion(motion.frequency_hz, seen)


def _bending_load(world: World, size: float) -> World:
    """Load the sensor with the mode's force m·∫φ and moment m·L·∫sφ at the origin."""
    tip = _load_mass(world.preset) * _bending(world.motion["load"], size, world)
    force, moment, more = 3 / 8 * tip, 11 / 40 * _height(world.preset) * tip, np.zeros_like(world.load_wrench)
    more[:, :2], more[:, 3], more[:, 4] = force, -moment[:, 1], moment[:, 0]
    return _loaded(world, more)


def _cable(world: World, size: float) -> World:
    """Connect the top of the load to the surroundings by a spring."""
    motion, clamp = world.motion["load"], np.array([0.03, 0.0, _height(world.preset)])
    moved = motion.displacement[:, :3] + np.cross(motion.displacement[:, 3:], clamp)
    pull = size * np.array([0.3, 0.3, 1.0]) * moved
    return _loaded(world, np.concatenate([pull, np.cross(clamp, pull)], axis=1))


def _warm(world: World, size: float) -> World:
    """Increase the outputs with the sensor's temperature."""
    return replace(world, outputs=world.outputs * (1.0 + COEFFICIENT_PER_K * size))


def _trigger_jitter(world: World, size: float) -> World:
    """Shift edges and exposures periodically, at twice the first line, which aliases to it."""
    frequency_hz, edges = 2.0 * float(world.preset.frequencies_hz[0]), world.trigger_s
    return replace(world, trigger_s=edges + size * np.sin(2 * np.pi * frequency_hz * edges + 0.4))


def _locked_clocks(world: World, size: float) -> World:
    """Set the frame period to whole samples, plus `size` samples per record."""
    number, edges = np.arange(len(world.trigger_s)), world.trigger_s
    sample_s = 1.0 / world.preset.daqs[0].sample_rate_hz
    slope = float(np.polyfit(number, edges, 1)[0])
    period_s = sample_s * (round(slope / sample_s) + size / number[-1])
    return replace(world, trigger_s=edges + (period_s - slope) * number)


# Records: errors of recorders and of users.


def _channels(preset: Preset, quantity: str) -> list[tuple[str, str]]:
    """Return file and name of all channels of a quantity, in their order."""
    return [(daq.file, spec.name) for daq in preset.daqs for spec in daq.channels if spec.quantity == quantity]


def _put(records: Records, changed: Mapping[tuple[str, str], FloatArray]) -> Records:
    """Return records with some channels' samples replaced."""
    new = {file: dict(record.samples) for file, record in records.items()}
    for (file, name), samples in changed.items():
        new[file][name] = np.asarray(samples, dtype=np.float32)
    return {file: replace(record, samples=new[file]) for file, record in records.items()}


def _samples(records: Records, channel: tuple[str, str]) -> FloatArray:
    return np.asarray(records[channel[0]].samples[channel[1]], dtype=np.float64)


def _nonlinear(records: Records, size: float, world: World) -> Records:
    """Compress the sensor's outputs by v³: `size` is the deviation at the largest value."""
    changed = {}
    for channel in _channels(world.preset, "output"):
        values = _samples(records, channel)
        changed[channel] = values * (1.0 - size * (values / np.abs(values).max()) ** 2)
    return _put(records, changed)


def _folded(records: Records, size: float, world: World) -> Records:
    """Add the alias of a harmonic to the outputs, 0.3 bins from the line."""
    changed = {}
    for channel in _channels(world.preset, "output"):
        values, record = _samples(records, channel), records[channel[0]]
        time = np.arange(len(values)) / record.sample_rate_hz
        line = float(world.preset.frequencies_hz[0]) + 0.3 / float(time[-1])
        amplitude = size * np.sqrt(2.0) * values.std()
        changed[channel] = values + amplitude * np.cos(2 * np.pi * line * time + 1.1)
    return _put(records, changed)


def _reversed(quantity: str) -> Callable[..., Records]:
    """Return the change that reverses the first `size` channels of a quantity."""

    def change(records: Records, size: float, world: World) -> Records:
        channels = _ordered(world, quantity)[: round(size)]
        return _put(records, {channel: -_samples(records, channel) for channel in channels})

    return change


def _exchanged(quantity: str) -> Callable[..., Records]:
    """Return the change that exchanges `size` pairs of channels of a quantity."""

    def change(records: Records, size: float, world: World) -> Records:
        channels = _ordered(world, quantity)
        pairs = list(zip(channels[::2], channels[1::2], strict=False))[: round(size)]
        both = [*pairs, *((second, first) for first, second in pairs)]
        return _put(records, {channel: _samples(records, other) for channel, other in both})

    return change


def _ordered(world: World, quantity: str) -> list[tuple[str, str]]:
    """Return the channels of a quantity, outputs by their share of the rating."""
    channels = _channels(world.preset, quantity)
    if quantity != "output":
        return channels
    rated = np.array(world.preset.sensitivity) * np.array(world.preset.capacity)
    share = np.abs(world.outputs[0]) / rated
    return [channels[i] for i in np.argsort(-share)]


def _unit(records: Records, size: float, world: World) -> Records:
    """Record accelerations in a unit of `size` m/s² that the manifest states as 1 m/s²."""
    return _put(
        records, {channel: _samples(records, channel) / size for channel in _channels(world.preset, "acceleration")}
    )


# Cameras: frames, images, and points of another program.


def _first_pair(setup: StereoSetup) -> bool:
    return setup.body == "load"


def _frames_lost(frames: NDArray[np.int64], size: float, setup: StereoSetup) -> NDArray[np.int64]:
    """Lose frames in the middle of the load's pair; the following ones are renumbered."""
    lost = np.arange(round(size), dtype=np.int64) + len(frames) // 2
    return frames[~np.isin(frames, lost)] if _first_pair(setup) else frames


def _drifting_points(position: FloatArray, size: float, setup: StereoSetup) -> FloatArray:
    """Move points as the left camera's image drifts by `size` px over the record.

    With the angle θ between the cameras the point moves by s across the ray and by s·cot θ along it.
    """
    if not _first_pair(setup):
        return position
    s = size * setup.pixel_m * np.linspace(0.0, 1.0, len(position))[:, None]
    return np.asarray(position + (s * np.array([1.0, 0.0, 1.0 / np.tan(np.deg2rad(setup.stereo_deg))]))[:, None, :])


def _drifting_image(image: FloatArray, size: float, series: str, _: float, share: float) -> FloatArray:
    if not series.endswith("left") or not series.startswith("top"):
        return image
    return np.asarray(ndimage.shift(image, (0.0, size * share), order=5, mode="nearest"))


def _flicker(image: FloatArray, size: float, _: str, middle_s: float, __: float) -> FloatArray:
    """Vary the brightness of the image with mains lamps."""
    return np.asarray(image * (1.0 + size * np.cos(2 * np.pi * FLICKER_HZ * middle_s)) / (1.0 + size))


def _repeating(face: Face, size: float) -> Face:
    """Print the foil from one repeated tile of `size` m."""
    return replace(face, texture=tile_texture(face.texture, size))


def _bit_depth(tables: dict[str, Any], size: float) -> dict[str, Any]:
    """State `size` more bits than the images have."""
    pairs = {name: keys | {"bit_depth": keys["bit_depth"] + round(size)} for name, keys in tables["stereo"].items()}
    return tables | {"stereo": pairs}


_FIRST_LASER = ("velocity_1", "velocity_1x")  # of the presets
_ACROSS = np.array([0.8, -0.6, 0.0])

CATALOGUE: dict[str, Violation] = {
    "head-tilt": Violation(
        "rad",
        5e-3,
        "all beams of one laser head point elsewhere by the same angle and mix transverse motion into every reading",
        {"direction": _head_tilt},
    ),
    "scanner-fan": Violation(
        "m",
        0.5,
        "beams that are stated parallel leave one mirror at this distance, so that each sees the cosine of its angle",
        {"direction": _scanner_fan},
    ),
    "camera-shake": Violation(
        "1",
        5e-3,
        "all cameras stand on what the shaker shakes and move coherently by this share of the driven motion",
        {"seen": _shaken("camera")},
        "cameras",
    ),
    "laser-shake": Violation(
        "1",
        5e-3,
        "the laser head moves coherently by this share of the driven motion, and every beam loses it",
        {"seen": _shaken("velocity")},
    ),
    "floor-shake": Violation(
        "1",
        5e-3,
        "cameras and laser head stand on one floor that moves coherently by this share of the driven motion",
        {"seen": _shaken("velocity", "camera")},
    ),
    "elastic-axial": Violation(
        "Hz",
        8400.0,
        "the load is a rod with this first axial natural frequency (steel, 15 cm): its top moves more than its foot",
        {"seen": _axial_seen, "world": _axial_load},
    ),
    "elastic-bending": Violation(
        "Hz",
        3000.0,
        "the load bends with this first natural frequency: its top shifts and turns more than its foot",
        {"seen": _bending_seen, "world": _bending_load},
    ),
    "cable": Violation(
        "N/m",
        5e3,
        "cables and hoses tie the top of the load to the room with this stiffness, a force that no mass explains",
        {"world": _cable},
    ),
    "transverse-motion": Violation(
        "1",
        0.1,
        "the shaker moves across its axis by this share of the driven motion",
        {"motion": _transverse},
    ),
    "warm-sensor": Violation(
        "K",
        5.0,
        f"the sensor is warmer than its reference temperature, with an unstated coefficient of {COEFFICIENT_PER_K:g}/K",
        {"world": _warm},
    ),
    "converter-nonlinearity": Violation(
        "1",
        5e-3,
        "the converter of the sensor's outputs compresses them by this share at their largest value",
        {"records": _nonlinear},
    ),
    "folded-harmonic": Violation(
        "1",
        5e-3,
        "without an anti-aliasing filter a harmonic of this share of each output folds to 0.3 bins from the line",
        {"records": _folded},
    ),
    "trigger-jitter": Violation(
        "s",
        2e-5,
        "trigger edges and exposures come early and late with this amplitude at twice the driven frequency",
        {"world": _trigger_jitter},
        "cameras",
    ),
    "locked-clocks": Violation(
        "samples",
        0.6,
        "the camera takes a frame every so many whole samples of the first recorder, but for this much over the record",
        {"world": _locked_clocks},
        "cameras",
    ),
    "lens-drift": Violation(
        "px",
        0.3,
        "the lens of one camera creeps while it warms up and shifts its image by so much over the record",
        {"points": _drifting_points, "image": _drifting_image},
        "cameras",
    ),
    "frames-lost": Violation(
        "frames",
        3.0,
        "frames in the middle of one pair are lost and those after them renumbered, so that they get too early a time",
        {"frames": _frames_lost},
        "cameras",
    ),
    "lamp-flicker": Violation(
        "1",
        0.05,
        f"lamps on the mains flicker at {FLICKER_HZ:g} Hz by this share of their light",
        {"image": _flicker},
        "images",
    ),
    "foil-repeats": Violation(
        "m",
        8e-3,
        "the speckle foil is printed from one tile of this size, so that a subset finds its like elsewhere",
        {"face": _repeating},
        "images",
    ),
    "bit-depth": Violation(
        "bits",
        2.0,
        "so many more bits are stated than the pictures have",
        {"rig": _bit_depth},
        "images",
    ),
    "mass": Violation(
        "u",
        5.0,
        "the load's mass is off by so many of its stated standard uncertainties",
        {"error": _misstated(1.0, "load.mass")},
    ),
    "inertia": Violation(
        "u",
        5.0,
        "the load's moments of inertia are off by so many of their stated standard uncertainties",
        {"error": _misstated(np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), "load.inertia")},
    ),
    "point": Violation(
        "u",
        5.0,
        "one laser point lies elsewhere by so many of its stated standard uncertainties",
        {"error": _misstated(_ACROSS, *(f"{name}.point" for name in _FIRST_LASER))},
    ),
    "direction": Violation(
        "u",
        5.0,
        "one laser beam points elsewhere by so many of its stated standard uncertainties",
        {"error": _misstated(_ACROSS, *(f"{name}.direction" for name in _FIRST_LASER))},
    ),
    "laser-reversed": Violation(
        "channels",
        1.0,
        "so many laser channels have the wrong sign",
        {"records": _reversed("velocity")},
    ),
    "output-reversed": Violation(
        "channels",
        1.0,
        "so many outputs of the sensor have the wrong sign, the one that answers most first",
        {"records": _reversed("output")},
    ),
    "lasers-exchanged": Violation(
        "pairs",
        1.0,
        "two laser points are stored under each other's name",
        {"records": _exchanged("velocity")},
    ),
    "outputs-exchanged": Violation(
        "pairs",
        1.0,
        "two outputs of the sensor are stored under each other's name, the one that answers most first",
        {"records": _exchanged("output")},
    ),
    "unit-mistaken": Violation(
        "m/s2",
        GRAVITY_UNIT,
        "accelerometers are recorded in a unit of this size (g) and stated in m/s²",
        {"records": _unit},
    ),
}
"""Violations by name."""
