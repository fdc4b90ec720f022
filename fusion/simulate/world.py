"""True motion of a simulation: sampled errors, motion of load and base, load, sensor output.

Newton and Euler of each rigid part: F = m·(a + α × c) + m·θ × g, M = c × F + I·α, θ = −α/ω².
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.preset import (
    PartSpec,
    PlateSpec,
    Preset,
    StereoSetup,
    camera_pose,
    face_of,
    nominal_rig,
    read_preset,
)
from photogram.camera import StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.scene import Face, View, bend_view, motion_bound, view_of
from shakercal._common.arrays import ComplexArray, FloatArray

MOUNTING_ERRORS = ("point", "direction", "transverse", "centre_of_mass")
"""Last parts of the names of errors that differ between mountings."""
RECORDING_ERRORS = (
    "noise",
    "trigger jitter",
    "points",
)  # last parts of the names of errors that differ between recordings
STATIC_UNCERTAINTY = 1e-3  # relative change of a sensor since its static calibration, one standard deviation
GRID = (8, 5)  # points on a face, as in tables of other correlation programs
_INSIDE = 0.68  # of the half size: the corners of the grid are on a round face
_NOISE_M = (0.7e-6, 0.7e-6, 1.8e-6)  # of these points: x, y and along the view of the left camera
_T = TypeVar("_T")


@dataclass(frozen=True)
class Violations:
    """Assumptions of the program that a simulation violates: size and changes by stage.

    The simulator passes its value at each stage through this object; without violations it is unchanged. `sizes`: by
    name.
    """

    active: tuple[tuple[float, Mapping[str, Callable[..., Any]]], ...] = ()
    sizes: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, stage: str, value: _T, *context: Any) -> _T:
        """Return the value of a stage after all changes; each gets value, size, context."""
        for size, changes in self.active:
            if stage in changes:
                value = changes[stage](value, size, *context)
        return value


@dataclass(frozen=True)
class Draws:
    """Normal deviates by name, each with a separate stream of `seed`.

    `systematic` False gives zeros. `values` records every sampled error for the truth file. The errors of a rig are
    common to all recordings of a campaign. With `mounting`, errors of mounted instruments (`MOUNTING_ERRORS`) differ
    between mountings, except those of the sensor's internal parts. With `recording`, noise (`RECORDING_ERRORS`) differs
    between recordings. `violations`: the violated assumptions.
    """

    seed: int
    systematic: bool
    values: dict[str, list[float]] = field(default_factory=dict)
    mounting: str | None = None
    recording: str | None = None
    violations: Violations = field(default_factory=Violations)

    def stream(self, name: str) -> np.random.Generator:
        """Return the generator of a name, within its mounting or its recording."""
        last = name.rpartition(".")[2]
        scope = self.recording if last in RECORDING_ERRORS else None
        if last in MOUNTING_ERRORS and not name.startswith("internal."):
            scope = self.mounting
        whole = name if scope is None else f"{name} [{scope}]"
        return np.random.default_rng([self.seed, zlib.crc32(whole.encode())])

    def normal(self, name: str, uncertainty: float | FloatArray, count: int | None = None) -> FloatArray:
        """Return errors (count,) or scalar () of a standard uncertainty, and record them."""
        deviate = self.stream(name).standard_normal(count)
        value = np.asarray(deviate * uncertainty if self.systematic else 0.0 * deviate * uncertainty)
        value = self.violations("error", value, name, uncertainty)
        if np.any(np.asarray(uncertainty) > 0):
            self.values[name] = [float(v) for v in np.atleast_1d(value)]
        return value

    def covariant(self, name: str, covariance: FloatArray) -> FloatArray:
        """Return errors (P,) with a covariance (P, P), and record them."""
        varying = np.diagonal(covariance) > 0.0
        scale = np.sqrt(np.diagonal(covariance)[varying])
        lower = np.linalg.cholesky(covariance[np.ix_(varying, varying)] / np.outer(scale, scale))
        value = np.zeros(len(covariance))
        value[varying] = (
            scale * (lower @ self.stream(name).standard_normal(len(scale))) * (1.0 if self.systematic else 0.0)
        )
        self.values[name] = [float(v) for v in value]
        return np.asarray(value)


@dataclass(frozen=True, eq=False)
class TruePart:
    """A rigid part: mass_kg, centre_of_mass_m (3,), inertia_kgm2 (3, 3) about the centre of mass."""

    mass_kg: float
    centre_of_mass_m: FloatArray
    inertia_kgm2: FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedMotion:
    """Harmonic motion of a body: frequency_hz (K,), acceleration phasors (K, 6) of the origin.

    Units are m/s² and rad/s².
    """

    frequency_hz: FloatArray
    acceleration: ComplexArray

    @property
    def displacement(self) -> ComplexArray:
        """Displacement phasors (K, 6), m and rad: −A/ω²."""
        return -self.acceleration / self.omega[:, None] ** 2

    @property
    def omega(self) -> FloatArray:
        """Angular frequencies (K,), rad/s."""
        return 2 * np.pi * self.frequency_hz

    def pose(self, time_s: FloatArray | float) -> FloatArray:
        """Return the poses (..., 6) at times (...,): translation of the origin and rotation vector."""
        return harmonic(np.asarray(time_s), self.frequency_hz, self.displacement)


def harmonic(time_s: FloatArray, frequency_hz: FloatArray, phasors: ComplexArray) -> FloatArray:
    """Return Σ Re{X·e^{jωt}} (..., C) at times (...,) of phasors (K, C)."""
    time = np.asarray(time_s, dtype=np.float64)
    total = np.zeros((*time.shape, phasors.shape[1]))
    for frequency, line in zip(frequency_hz, phasors, strict=True):
        turn = np.exp(2j * np.pi * frequency * time)[..., None]
        total += (turn * line).real
    return total


def wrench(motion: SimulatedMotion, parts: Sequence[TruePart], gravity: FloatArray) -> ComplexArray:
    """Return force and moment phasors (K, 6) at the origin that accelerate parts.

    In body axes. The last term of F is gravity in tilted axes: Rᵀ·(−m·g) = −m·g + m·θ × g to first order.
    """
    a, alpha = motion.acceleration[:, :3], motion.acceleration[:, 3:]
    tilt = np.cross(motion.displacement[:, 3:], gravity)
    total = np.zeros_like(motion.acceleration)
    for part in parts:
        c = part.centre_of_mass_m
        force = part.mass_kg * (a + np.cross(alpha, c) + tilt)
        total[:, :3] += force
        total[:, 3:] += np.cross(c, force) + alpha @ part.inertia_kgm2.T
    return total


def base_motion(load: SimulatedMotion, mount_hz: FloatArray, damping: float) -> SimulatedMotion:
    """Return the motion of the base below an oscillator per component.

    load/base = (1 + 2jζη)/(1 − η² + 2jζη), η = f/f_0 with f_0 of the component (`mount_hz`, (6,)).
    """
    ratio = load.frequency_hz[:, None] / np.asarray(mount_hz)
    transfer = (1 + 2j * damping * ratio) / (1 - ratio**2 + 2j * damping * ratio)
    return SimulatedMotion(load.frequency_hz, load.acceleration / transfer)


def sensitivity(frequency_hz: FloatArray, static: FloatArray, damping_s: FloatArray, lag_s: float) -> ComplexArray:
    """Return the complex sensitivity (K, 6, 6) of a spring-damper sensor behind a filter.

    Outputs follow the spring's deflection: component i of the load has the factor 1/(1 + jω·b_i/k_i) (`damping_s` =
    b/k), and the chain is a first-order low-pass 1/(1 + jω·lag). `static` (6, 6) includes the cross-talk.
    """
    jw = 2j * np.pi * frequency_hz[:, None]
    per_component = 1 / (1 + jw * damping_s) / (1 + jw * lag_s)
    return np.asarray(static[None] * per_component[:, None, :])


def velocity_at(motion: SimulatedMotion, point: FloatArray, direction: FloatArray) -> ComplexArray:
    """Return velocity phasors (K,) of a point along a fixed direction.

    d·(v + ω × r).
    """
    velocity = motion.acceleration / (1j * motion.omega[:, None])
    return np.asarray((velocity[:, :3] + np.cross(velocity[:, 3:], point)) @ direction)


def acceleration_at(
    motion: SimulatedMotion, point: FloatArray, direction: FloatArray, gravity: FloatArray
) -> ComplexArray:
    """Return phasors (K,) of a tilting accelerometer.

    d·(a + α × r) − (θ × d)·g.
    """
    a, alpha = motion.acceleration[:, :3], motion.acceleration[:, 3:]
    tilted = np.cross(motion.displacement[:, 3:], direction)
    return np.asarray((a + np.cross(alpha, point)) @ direction - tilted @ gravity)


@dataclass(frozen=True, eq=False)
class TrueStereo:
    """A stereo pair as stated (`nominal`, `sensor_from_left`) and true (`rig`, `left_from_sensor`, times).

    `setup`: with the true face, which differs from the stated one before a single camera.
    """

    setup: StereoSetup
    nominal: StereoRig
    sensor_from_left: RigidTransform
    rig: StereoRig
    left_from_sensor: RigidTransform
    delay_s: float
    row_time_s: float

    @property
    def views(self) -> tuple[View, ...]:
        """Views of its cameras, by `StereoSetup.sides`."""
        placed = zip(self.setup.sides, self.rig.camera_poses, strict=False)
        return tuple(view_of(camera, from_left @ self.left_from_sensor) for _, (camera, from_left) in placed)

    def exposure_middle_s(self, edge_s: float, exposure_s: float) -> float | FloatArray:
        """Return the middle of the exposure after an edge, per row (H,) if rolling."""
        first, rows = edge_s + self.delay_s + exposure_s / 2, np.arange(self.setup.size_px[1])
        if self.setup.row_time == 0.0:
            return first
        return np.asarray(first + abs(self.row_time_s) * (rows if self.setup.row_time > 0.0 else rows[::-1]))


@dataclass(frozen=True, eq=False)
class World:
    """The truth of a simulation.

    Motions of both bodies, wrench on the load (K, 6), sensitivity (K, C, 6), outputs (K, C). `load_wrench` has the
    sense of the manifest. `trigger_s` (F,): instants of the trigger edges, with their jitter. Times are true seconds
    since the first sample of the first DAQ.
    """

    preset: Preset
    gravity: FloatArray
    motion: dict[str, SimulatedMotion]
    load_wrench: ComplexArray
    sensitivity: ComplexArray
    static_stated: FloatArray
    outputs: ComplexArray
    trigger_s: FloatArray
    stereo: tuple[TrueStereo, ...]

    def observed_motion(self, draws: Draws, body: str, instrument: str, point: FloatArray) -> SimulatedMotion:
        """Return the motion of a body observed by a kind of instrument.

        `instrument`: `velocity`, `acceleration` or `camera`. The room is stationary. The head of the lasers moves
        opposite to their reading of the room.
        """
        if body == "head":
            observed = self.observed_motion(draws, "room", "velocity", point)
            return SimulatedMotion(observed.frequency_hz, -observed.acceleration)
        load = self.motion["load"]
        motion = self.motion.get(body, SimulatedMotion(load.frequency_hz, np.zeros_like(load.acceleration)))
        if self.preset.plate is not None and body == "load":
            motion = plate_motion(self.preset.plate, motion, draws, point)
        return draws.violations("seen", motion, self, body, instrument, point)


def make_world(preset: Preset, draws: Draws, jitter_s: float) -> World:
    """Return the truth of a preset with sampled errors."""
    gravity = preset.gravity_mps2
    frequency = preset.frequencies_hz
    load = SimulatedMotion(frequency, draws.violations("motion", np.array(preset.acceleration)))
    base = base_motion(load, np.array(preset.mount_hz), preset.mount_damping)
    parts = [true_part(spec, draws) for spec in (preset.load, preset.internal, *preset.parts)]
    sign = 1.0 if preset.sense == "on_load" else -1.0
    force = sign * wrench(load, parts, gravity)
    if preset.plate is not None:
        force = force + sign * plate_wrench(preset.plate, load, draws)
    stated, true = static_sensitivity(preset, draws)
    matrix = sensitivity(frequency, true, np.array(preset.damping_s), preset.lag_s)
    outputs = np.einsum("kcj,kj->kc", matrix, force)
    edges = preset.first_frame_s + np.arange(preset.frames) / preset.camera_rate_hz
    edges = edges + jitter_s * draws.stream("trigger jitter").standard_normal(preset.frames)
    stereo = () if preset.as_points else tuple(true_stereo(setup, draws) for setup in preset.stereo)
    motion = {"load": load, "base": base}
    return draws.violations("world", World(preset, gravity, motion, force, matrix, stated, outputs, edges, stereo))


def true_part(spec: PartSpec, draws: Draws) -> TruePart:
    """Return a part with errors of mass, centre of mass and inertia."""
    name = f"{spec.name}.mass"
    mass = spec.mass + float(draws.normal(name, spec.mass_uncertainty))
    centre = draws.normal(f"{spec.name}.centre_of_mass", spec.centre_of_mass_uncertainty, 3)
    six = draws.normal(f"{spec.name}.inertia", spec.inertia_uncertainty, 6)
    error = np.array([[six[0], six[3], six[4]], [six[3], six[1], six[5]], [six[4], six[5], six[2]]])
    return TruePart(mass, np.array(spec.centre_of_mass) + centre, np.diag(spec.inertia) + error)


def static_sensitivity(preset: Preset, draws: Draws) -> tuple[FloatArray, FloatArray]:
    """Return the stated and the true static sensitivity (6, 6).

    Cross-talk is relative to the rated loads: output i for component j is up to `cross_talk` of its rated output at the
    rated load j.
    """
    rated = np.array(preset.sensitivity) * np.array(preset.capacity)
    share = np.random.default_rng(6).uniform(-preset.cross_talk, preset.cross_talk, (6, 6))
    np.fill_diagonal(share, 1.0)
    stated = share * rated[:, None] / np.array(preset.capacity)
    change = draws.normal("static_sensitivity", STATIC_UNCERTAINTY, 36).reshape(6, 6) * np.diagonal(share)[:, None]
    return stated, stated * (1 + change)


def true_stereo(setup: StereoSetup, draws: Draws) -> TrueStereo:
    """Return a stereo pair with errors of cameras, scale, pose and delay.

    The true baseline is longer by the relative scale error. The stated pose was determined with the stated rig: the
    position of the sensor origin in the camera frame grows by the same factor; then the pose error shifts and rotates
    it.
    """
    nominal, sensor_from_left = nominal_rig(setup)
    covariance = nominal.covariance
    assert covariance is not None
    rig = nominal.perturbed(draws.covariant(f"{setup.name}.calibration", covariance))
    scale = 1.0
    if not setup.surface_uncertainty:
        scale += float(draws.normal(f"{setup.name}.scale", setup.scale_uncertainty))
    between = rig.right_from_left
    rig = StereoRig(rig.left, rig.right, RigidTransform(between.rotation, between.translation_m * scale))
    true = true_pose(setup, sensor_from_left, scale, draws)
    delay = float(draws.normal(f"{setup.name}.delay", setup.delay_uncertainty))
    row_time = setup.row_time + float(draws.normal(f"{setup.name}.row_time", setup.row_time_uncertainty))
    return TrueStereo(_true_face(setup, draws), nominal, sensor_from_left, rig, true.inverse(), delay, row_time)


def _true_face(setup: StereoSetup, draws: Draws) -> StereoSetup:
    """Return a set-up with the true face before a single camera."""
    if not setup.surface_uncertainty:
        return setup
    distance, tilt = setup.surface_uncertainty
    error = draws.normal(f"{setup.name}.surface", np.array([distance, tilt, tilt]), 3)
    normal, up = np.array(setup.face_normal), np.array(setup.face_up)
    turn = rotation_from_vector(error[1] * up + error[2] * np.cross(up, normal))
    (a, b, c), (d, e, f) = (turn @ normal).tolist(), (turn @ up).tolist()
    x, y, z = (np.array(setup.face_centre) + error[0] * normal).tolist()
    return replace(setup, face_centre=(x, y, z), face_normal=(a, b, c), face_up=(d, e, f))


def true_pose(setup: StereoSetup, stated: RigidTransform, scale: float, draws: Draws) -> RigidTransform:
    """Return the true sensor_from_left; true lengths are `scale` times the stated ones."""
    error = draws.normal(f"{setup.name}.pose", np.array(setup.pose_uncertainty), 6)
    turn = rotation_from_vector(error[3:])
    return RigidTransform(turn @ stated.rotation, turn @ (stated.translation_m * scale) + error[:3])


def frame_bounds(preset: str, seed: int) -> dict[str, NDArray[np.float64]]:
    """Return the Cramér-Rao bound (6,) of one frame's motion per pair.

    It uses all pixels of both cameras, the true rig and the nominal noise (`photogram.synthetic.scene.motion_bound`).
    """
    draws = Draws(seed, True)
    bounds = {}
    for stereo in make_world(read_preset(Preset, preset), draws, 0.0).stereo:
        face = face_of(stereo.setup, False, draws.stream(f"{stereo.setup.name}.speckle"))
        bounds[stereo.setup.name] = np.sqrt(np.diagonal(motion_bound(stereo.views, face, stereo.setup.sensor)))
    return bounds


def face_points(setup: StereoSetup) -> FloatArray:
    """Return a grid (N, 3) of points on a face at rest."""
    across, up = (_INSIDE * half * np.linspace(-1.0, 1.0, n) for half, n in zip(setup.half_size, GRID, strict=True))
    side = np.cross(np.array(setup.face_up), np.array(setup.face_normal))
    grid = across[:, None, None] * side + up[None, :, None] * np.array(setup.face_up)
    return np.asarray(np.array(setup.face_centre) + grid.reshape(-1, 3))


def point_series(world: World, setup: StereoSetup, draws: Draws, noise: bool) -> FloatArray:
    """Return the points (F, N, 3) of a pair in its left camera frame.

    The points move, are blurred by the exposure, and have scale and pose errors of the pair. A measured point is the
    true one in the camera's frame over the scale 1 + e. An exposure of length T shows the mean over T: a line at f is
    smaller by sin(πfT)/(πfT).
    """
    scale = 1 + float(draws.normal(f"{setup.name}.scale", setup.scale_uncertainty))
    left_from_sensor = true_pose(setup, camera_pose(setup), scale, draws).inverse()
    delay = float(draws.normal(f"{setup.name}.delay", setup.delay_uncertainty))
    exposure = world.preset.exposure_s
    motion = world.observed_motion(draws, setup.body, "camera", np.array(setup.face_centre))
    observed = SimulatedMotion(
        motion.frequency_hz, motion.acceleration * np.sinc(motion.frequency_hz * exposure)[:, None]
    )
    rest = face_points(setup)
    poses = (RigidTransform.from_pose(pose) for pose in observed.pose(world.trigger_s + delay + exposure / 2))
    position = np.stack([left_from_sensor.apply(pose.apply(rest)) for pose in poses]) / scale
    if noise:
        deviate = draws.stream(f"{setup.name}.points").standard_normal(position.shape)
        position = position + deviate * np.array(_NOISE_M)
    return draws.violations("points", position, setup)


# A plate on the load that bends: a disc of uniform mass m about the axis z of the sensor, with the shape s(ρ) =
# ρ²·(1.4 − 0.4·ρ²) over the radius ρ = r/R. Its rim moves by q relative to its centre, m·⟨s²⟩·(q̈ + 2ζω₀·q̇ + ω₀²·q) =
# −m·⟨s⟩·a, and the foot carries m·⟨s⟩·q̈ in addition to the rigid load. Means over the disc are sums over rings.

SURFACE_FILE = "plate-mode-1.csv"
RINGS, SPOKES = 12, 24  # of the surface's table
_RADII = (np.arange(20000) + 0.5) / 20000


def plate_shape(rho: FloatArray) -> FloatArray:
    """Return the displacement over that of the rim, at radii over that of the rim."""
    return np.asarray(rho**2 * (1.4 - 0.4 * rho**2))


MEAN_SHAPE, MEAN_SQUARE_SHAPE = (
    float(np.sum(plate_shape(_RADII) ** power * _RADII) / np.sum(_RADII)) for power in (1, 2)
)


def _rim_share(plate: PlateSpec, point: Sequence[float] | FloatArray) -> float:
    return float(plate_shape(np.hypot(point[0], point[1]) / plate.radius))


def rim_acceleration(plate: PlateSpec, motion: SimulatedMotion, draws: Draws) -> ComplexArray:
    """Return the acceleration phasors (K,) of the rim relative to the centre.

    The natural frequency has its sampled error.
    """
    natural = (
        2.0 * np.pi * plate.frequency * (1.0 + float(draws.normal("plate.frequency", plate.frequency_uncertainty)))
    )
    omega = motion.omega
    denominator = natural**2 - omega**2 + 2j * plate.damping * natural * omega
    return np.asarray(omega**2 * MEAN_SHAPE / MEAN_SQUARE_SHAPE * motion.acceleration[:, 2] / denominator)


def plate_motion(plate: PlateSpec, motion: SimulatedMotion, draws: Draws, point: FloatArray) -> SimulatedMotion:
    """Return the apparent motion of the load at a point of the plate."""
    moved = motion.acceleration.copy()
    moved[:, 2] += _rim_share(plate, point) * rim_acceleration(plate, motion, draws)
    return replace(motion, acceleration=moved)


def plate_wrench(plate: PlateSpec, motion: SimulatedMotion, draws: Draws) -> ComplexArray:
    """Return the wrench (K, 6) of the plate in addition to the rigid load."""
    total = np.zeros((len(motion.frequency_hz), 6), np.complex128)
    total[:, 2] = plate.mass * MEAN_SHAPE * rim_acceleration(plate, motion, draws)
    return total


def bent_view(world: World, draws: Draws, view: View, face: Face, instant: tuple[float | FloatArray, float]) -> View:
    """Return a view of the bending face of the load, averaged over an exposure.

    instant: middle of the exposure, (H,) for rows, and its length, s.
    """
    plate, motion, (middle_s, exposure_s) = world.preset.plate, world.motion["load"], instant
    if plate is None:
        return view
    omega = motion.omega
    lost = np.sinc(omega * exposure_s / (2.0 * np.pi))
    turn = np.exp(1j * np.multiply.outer(middle_s, omega))
    rim_m = np.sum(-rim_acceleration(plate, motion, draws) / omega**2 * lost * turn, axis=-1).real[..., None]

    def bending(u: FloatArray, v: FloatArray) -> FloatArray:
        position = face.origin_m + u[..., None] * face.axis_u + v[..., None] * face.axis_v
        up = rim_m * plate_shape(np.hypot(position[..., 0], position[..., 1]) / plate.radius)
        none = np.zeros_like(up)
        return np.stack([none, none, up * np.cross(face.axis_u, face.axis_v)[2]], axis=-1)

    return bend_view(view, face, motion.pose(float(np.mean(middle_s))), bending)


def elastic_keys(preset: Preset) -> dict[str, Any]:
    """Return the keys of the plate in the load's table, none without a plate."""
    plate = preset.plate
    if plate is None:
        return {}
    points = {spec.name: spec.point for daq in preset.daqs for spec in daq.channels if spec.body == "load"}
    points |= {setup.name: setup.face_centre for setup in preset.stereo if setup.body == "load"}
    mode = {
        "frequency": plate.frequency,
        "frequency_uncertainty": plate.frequency * plate.frequency_uncertainty,
        "participation": [0.0, 0.0, plate.mass * MEAN_SHAPE, 0.0, 0.0, 0.0],
        "modal_mass": plate.mass * MEAN_SQUARE_SHAPE,
        "displacement": {name: [0.0, 0.0, _rim_share(plate, point)] for name, point in points.items()},
        "surface": SURFACE_FILE,
    }
    measured = {"measured_by": list(plate.measured_by)} if plate.measured_by else {}
    return {"elastic": [{"name": "plate", "shape": "modes", "damping": plate.damping, **measured, "mode": [mode]}]}


def surface_files(preset: Preset) -> dict[str, str]:
    """Return the file of the mode on the top face, if there is a plate."""
    plate = preset.plate
    if plate is None:
        return {}
    height_m = max(setup.face_centre[2] for setup in preset.stereo if setup.body == "load")
    rho, angle = (
        np.linspace(1.0, 0.0, RINGS, endpoint=False)[:, None],
        np.linspace(0.0, 2.0 * np.pi, SPOKES, endpoint=False),
    )
    x, y = (plate.radius * rho * turn for turn in (np.cos(angle), np.sin(angle)))
    up = np.broadcast_to(plate_shape(rho), x.shape)
    rows = np.stack([x, y, np.full_like(x, height_m), 0.0 * x, 0.0 * x, up], axis=-1).reshape(-1, 6).tolist()
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    return {SURFACE_FILE: "\n".join(["x,y,z,ux,uy,uz", *lines]) + "\n"}
