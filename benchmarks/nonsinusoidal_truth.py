"""Recordings of chirps, noise, blows and sines with cameras, computed in the time domain, with their truth.

    python benchmarks/nonsinusoidal_truth.py OUT --kind chirp|noise|impact|train|sine [--draw 0] [--frequency 120.7]
        [--poses] [--exact] [--duration 20] [--direction x|y|z|rx|ry|rz]

It shares no code with the program: mechanics are those of `nonsinusoidal_rig.py`, images those of
`nonsinusoidal_views.py`, taken at the mean pose of each exposure. Outputs are S (K d + share C d') behind an amplifier,
d the deformation of the sensor. `truth.json` has the closed form at 40 frequencies, and the motion at every exposure.
A train is blows every 0.09 to 0.16 s, stated as noise. `--poses` writes points in place of images.
`--exact` samples no systematic errors; the statements stay. `--direction` is a mounting of its own, with lasers from
the sides: the same rig, other places and directions of the channels, and the rig's files in the folder above.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from nonsinusoidal_rig import (
    BAND_HZ,
    CAPACITY,
    DIRECTIONS,
    GRAVITY_M_S2,
    INTERNAL,
    KINDS,
    LOAD,
    SETTLE_S,
    U_BODIES,
    ComplexArray,
    FloatArray,
    Rig,
    System,
    drive,
    integrate,
    make_rig,
    make_system,
    row_of,
)
from nonsinusoidal_views import DISC_M, IMAGE_PX, TOP_M, View, make_cameras, make_texture, photograph
from scipy.spatial.transform import Rotation

Errors = dict[str, dict[str, Any]]

SAMPLE_RATE_HZ, REST_S, AFTER_S = 25.6e3, 0.3, 0.5
SINES_HZ = (63.7, 97.3, 146.9, 219.7, 311.9, 407.3, 601.3, 703.7, 809.1, 887.9)
"""Frequencies whose aliases in the frames are far from 0 and from half the frame rate."""
TRUTH_HZ = np.sort(np.append(np.linspace(*BAND_HZ, 30), SINES_HZ))
FRAME_RATE_HZ, EXPOSURE_S, PULSE_S, JITTER_S = 53.127, 100e-6, 2e-3, 1e-6
U_CAMERA_DELAY_S, U_CAMERA_SCALE, U_POSE = 2e-7, 1e-4, [1e-4] * 3 + [5e-4] * 3
POINTS, U_POINT_M, POINT_COLUMNS = 25, np.array([0.3e-6, 0.3e-6, 1.2e-6]), ("frame", "id", "x", "y", "z")
"""Points of a table, and the noise of each along the axes of the left camera."""
AMPLIFIER = """format = 1

[[element]]
name = "bridge amplifier"
filter = "butterworth"
order = 2
corner = 5000.0
"""
NAMES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
Z = [0.0, 0.0, 1.0]
CHANNELS: dict[str, dict[str, Any]] = {
    **{
        f"velocity_{number}": {"quantity": "velocity", "body": "load", "point": point, "direction": Z, "scale": 0.1}
        | {"common": "laser", "point_uncertainty": 2e-4, "direction_uncertainty": 2e-3, "scale_uncertainty": 5e-4}
        | {"individual_uncertainty": 5e-5, "delay_uncertainty": 2e-7}
        for number, point in enumerate(([0.033, 0.0, 0.07], [-0.0165, 0.0286, 0.07], [-0.0165, -0.0286, 0.07]), 1)
    },
    **{
        name: {"quantity": "acceleration", "body": body, "point": point, "direction": direction, "scale": 100.0}
        | {
            "point_uncertainty": 5e-4,
            "direction_uncertainty": 5e-3,
            "scale_uncertainty": 3e-3,
            "delay_uncertainty": 1e-6,
        }
        for name, body, point, direction in (
            ("base_acceleration", "base", [0.05, 0.0, -0.03], Z),
            ("load_acceleration_z", "load", [0.0, 0.036, 0.04], Z),
            ("load_acceleration_x", "load", [0.036, 0.0, 0.04], [1.0, 0.0, 0.0]),
        )
    },
    **{
        name: {
            "quantity": "output",
            "channel": name,
            "response": "amplifier.toml",
            "scale": 1e-3,
            "common": "amplifier",
        }
        | {"scale_uncertainty": 1e-4, "delay_uncertainty": 2e-7}
        for name in NAMES
    },
}
SIDES: dict[str, dict[str, Any]] = {
    name: CHANNELS["velocity_1"] | {"common": "side laser", "point": point, "direction": direction}
    for name, point, direction in (
        ("velocity_x", [0.036, 0.0, 0.05], [1.0, 0.0, 0.0]),
        ("velocity_y1", [0.03, 0.036, 0.05], [0.0, 1.0, 0.0]),
        ("velocity_y2", [-0.03, 0.036, 0.05], [0.0, 1.0, 0.0]),
    )
}
"""Channels of a recording with a direction of its own."""
NOISE = {"velocity": (1e-5, "V"), "acceleration": (5e-3, "V"), "output": (2e-9, "mV/V")}
"""Rms of a sample in SI, and the unit of the file."""
STATED = ("point", "direction", "scale", "individual", "delay")


def block(header: str, **keys: Any) -> str:
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in keys.items()]
    return "\n".join([*([header] if header else []), *lines]) + "\n\n"


@dataclass(frozen=True)
class Order:
    """Options of a recording; `duration_s` is that of the drive."""

    kind: str
    draw: int = 0
    hertz: float = 120.7
    poses: bool = False
    exact: bool = False
    duration_s: float = 20.0
    oversampling: int = 4
    direction: str | None = None

    @property
    def rng(self) -> np.random.Generator:
        """Return the generator of everything but the rig."""
        seed = [72, self.draw, KINDS.index(self.kind), round(1e3 * self.hertz)]
        return np.random.default_rng(seed + ([] if self.direction is None else [self.driven]))

    @property
    def driven(self) -> int:
        """Return the driven component of the base."""
        return DIRECTIONS.index(self.direction or "z")

    @property
    def channels(self) -> dict[str, dict[str, Any]]:
        """Return the channels and their keys."""
        return CHANNELS if self.direction is None else CHANNELS | SIDES


def simulate(order: Order, rig: Rig, errors: Errors, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Return samples (n, R), edges, middles of exposures, poses at the middles, and means over the exposures."""
    sine = order.kind == "sine"
    before, rest, after = (SETTLE_S, 0.0, 0.0) if sine else (0.0, REST_S, AFTER_S)
    record_s = rest + order.duration_s + after
    step_s = 1.0 / (SAMPLE_RATE_HZ * order.oversampling)
    grid_s = np.arange(round((before + record_s) / step_s) + 1, dtype=float) * step_s
    end_s = order.duration_s + (before + 1.0 if sine else 0.0)
    force = drive(order.kind, np.asarray(grid_s - rest, dtype=float), end_s, order.hertz, rng)
    period_s = 1.0 / (FRAME_RATE_HZ * (1.0 + 1e-5 * rng.normal()))
    edges_s = np.arange(0.05 + 0.01 * rng.uniform(), record_s - 0.05, period_s)
    edges_s += JITTER_S * rng.normal(size=edges_s.size)
    starts_s = edges_s + errors["stereo"]["delay_s"]
    nodes, weights = np.polynomial.legendre.leggauss(5)
    nodes = np.append(nodes, 0.0)
    times_s = before + starts_s[:, None] + 0.5 * EXPOSURE_S * (1.0 + nodes)
    every = slice(round(before / step_s), None, order.oversampling)
    system = make_system(rig)
    rows = channel_rows(system, errors)
    samples, poses = integrate(system, force, step_s, rows, (every, times_s.ravel()))
    poses = poses.reshape(-1, 6, 6)
    mean = np.einsum("fnc,n->fc", poses[:, :5], 0.5 * weights)
    return {"samples": samples, "edges": edges_s, "middle": times_s[:, 5] - before, "pose": poses[:, 5], "mean": mean}


def sample_errors(order: Order) -> Errors:
    """Sample the truth of every channel, and of the pair, from the stated uncertainties."""
    rng, exact = np.random.default_rng([73, order.draw]), order.exact
    mounted = rng if order.direction is None else np.random.default_rng([74, order.draw, order.driven])
    errors: Errors = {}
    shared: dict[str, FloatArray] = {}
    for name, keys in order.channels.items():
        own = {key: float(keys.get(f"{key}_uncertainty", 0.0)) * (not exact) for key in STATED}
        common = shared.setdefault(keys.get("common", name), rng.normal(size=2))
        factor = 1.0 + own["scale"] * common[0] + own["individual"] * rng.normal()
        errors[name] = {"factor": factor, "delay_s": own["delay"] * common[1]}
        moves = mounted.normal(size=(2, 3))
        if "point" in keys:
            direction = np.array(keys["direction"])
            tilt = own["direction"] * moves[1] * (1.0 - direction)
            errors[name]["point"] = (np.array(keys["point"]) + own["point"] * moves[0]).tolist()
            errors[name]["direction"] = ((direction + tilt) / np.linalg.norm(direction + tilt)).tolist()
    off = 0.0 if exact else 1.0
    errors["stereo"] = {
        "delay_s": off * U_CAMERA_DELAY_S * rng.normal(),
        "scale": off * U_CAMERA_SCALE * rng.normal(),
        "pose": (off * np.array(U_POSE) * rng.normal(size=6)).tolist(),
    }
    return errors


def channel_rows(system: System, errors: Errors) -> FloatArray:
    """Return what every channel reads of the states, in SI, late by its delay (first order), (R, 38)."""
    rows = []
    for name, keys in (CHANNELS | SIDES).items():
        if name not in errors:
            continue
        if keys["quantity"] == "output":
            row = np.eye(38)[26 + NAMES.index(keys["channel"])]
        else:
            direction = np.array(errors[name]["direction"])
            place = row_of(np.array(errors[name]["point"]), direction)
            row = system.reading(1 if keys["quantity"] == "velocity" else 2, keys["body"], place)
            if keys["quantity"] == "acceleration":
                fall = np.cross(direction, [0.0, 0.0, -GRAVITY_M_S2])
                row = row - system.reading(0, keys["body"], np.concatenate([np.zeros(3), fall]))
        rows.append(errors[name]["factor"] * (row - errors[name]["delay_s"] * (row @ system.a)))
    return np.array(rows)


def pair(values: ComplexArray) -> dict[str, Any]:
    return {"re": values.real.tolist(), "im": values.imag.tolist()}


def truth_of(order: Order, rig: Rig, motion: dict[str, FloatArray], errors: Errors) -> dict[str, Any]:
    """Return the closed form at 40 frequencies (and that of the sine), and the motion at every exposure."""
    hertz = TRUTH_HZ if order.kind != "sine" else np.append(order.hertz, TRUTH_HZ)
    omega = 2.0 * np.pi * hertz[:, None]
    pose, load, matrix = rig.responses(hertz)
    first = CHANNELS["velocity_1"]
    velocity = 1j * omega * (pose @ row_of(np.array(first["point"]), np.array(first["direction"])))[:, None]
    outputs = np.einsum("fij,fj->fi", matrix, load)
    natural_hz, _ = rig.natural()
    return {
        **{"format": 1, **asdict(order), "frequencies": hertz.tolist(), "natural_hz": natural_hz.tolist()},
        "sensitivity": pair(matrix),
        "ratio": pair(outputs[:, 2] / load[:, 2]),
        "acceleration_per_velocity": pair(-(omega**2) * pose / velocity),
        "load_per_velocity": pair(load / velocity),
        "outputs_per_velocity": pair(outputs / velocity),
        "base_acceleration_per_velocity": pair(-(omega**2) * rig.base_per_table(hertz) / velocity),
        "exposures": {name: motion[name].tolist() for name in ("edges", "middle", "pose", "mean")},
        "sampled_errors": errors,
        "damper_share": rig.damper_share,
    }


def write_channels(path: Path, order: Order, motion: dict[str, FloatArray], rng: np.random.Generator) -> None:
    """Write the file of the recorder in single precision."""
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = SAMPLE_RATE_HZ
        for (name, keys), samples in zip(order.channels.items(), motion["samples"].T, strict=True):
            rms, unit = NOISE[keys["quantity"]]
            noisy = (samples + rms * rng.normal(size=samples.size)) / keys["scale"]
            file.create_dataset(name, data=noisy.astype(np.float32)).attrs["unit"] = unit
        times_s = np.arange(len(motion["samples"])) / SAMPLE_RATE_HZ
        last = np.searchsorted(motion["edges"], times_s, side="right") - 1
        high = (last >= 0) & (times_s - motion["edges"][last] < PULSE_S)
        volts = 5.0 * high + 0.01 * rng.normal(size=high.size)
        file.create_dataset("camera_trigger", data=volts.astype(np.float32)).attrs["unit"] = "V"


def write_stereo(folder: Path, errors: Errors) -> str:
    """Write the calibration, and return the block of the pair, both as far off as stated."""
    left, right = make_cameras()
    scale, error = 1.0 + errors["stereo"]["scale"], np.array(errors["stereo"]["pose"])
    turn = Rotation.from_rotvec(error[3:]).as_matrix()
    sides = {
        name: {"matrix": camera.matrix.tolist(), "distortion": camera.distortion}
        for name, camera in (("left", left), ("right", right))
    }
    between = {
        "rotation": (right.axes.T @ left.axes).tolist(),
        "translation": (scale * right.axes.T @ (left.place_m - right.place_m)).tolist(),
    }
    content = {"format": 1, "image_size": IMAGE_PX, **sides, **between, "reprojection_rms": 0.02, "covariance": None}
    (folder / "top.json").write_text(json.dumps(content), encoding="utf-8")
    return block(
        "[stereo.top]",
        **{"body": "load", "calibration": "top.json", "rotation": (turn @ left.axes).tolist()},
        **{"translation": (turn @ left.place_m + error[:3]).tolist(), "pose_uncertainty": U_POSE, "bit_depth": 8},
        **{"scale_uncertainty": U_CAMERA_SCALE, "exposure": EXPOSURE_S, "delay_uncertainty": U_CAMERA_DELAY_S},
    ) + "".join(block(f"[stereo.top.{side}]", prnu=0.0, dsnu=0.0) for side in sides)


def write_rig(order: Order, folder: Path, rig: Rig, errors: Errors) -> None:
    """Write rig.toml with nominal values."""
    text = block("", format=1, name=f"simulated rig {order.draw}")
    bodies = []
    for prefix, body, (u_mass, u_centre, u_inertia) in zip(("", "internal_"), (LOAD, INTERNAL), U_BODIES, strict=True):
        values = {
            "mass": body.mass_kg,
            "centre_of_mass": body.centre_m.tolist(),
            "inertia": body.inertia_kg_m2.tolist(),
        }
        stated = {"mass": u_mass, "centre_of_mass": u_centre, "inertia": u_inertia}
        bodies.append(
            {prefix + key: value for key, value in values.items()}
            | {f"{prefix}{key}_uncertainty": value for key, value in stated.items()}
        )
    text += block(
        "[sensor]",
        **{"name": "six-component sensor", "channels": NAMES, "unit": "V/V", "sense": "on_load"},
        **{"capacity": CAPACITY.tolist(), "static_sensitivity": rig.stated_static.tolist()},
        **{"static_sensitivity_uncertainty": 5e-4, **bodies[1]},
    )
    text += block("[load]", **bodies[0]) + block("[environment]", gravity=[0.0, 0.0, -GRAVITY_M_S2])
    (folder / "rig.toml").write_text(text + write_stereo(folder, errors), encoding="utf-8")


def write_recording(order: Order, folder: Path) -> None:
    """Write recording.toml and the response of the amplifier."""
    driven = np.eye(6)[order.driven]
    keys: dict[str, Any] = {
        "kind": "noise" if order.kind == "train" else order.kind,
        "direction": (driven if order.driven > 2 else driven[:3]).tolist(),
    }
    if order.kind == "sine":
        keys["frequencies"] = [order.hertz]
    else:
        keys |= {"band": BAND_HZ}
    if order.kind != "sine" and order.direction is None:
        keys |= {"reference": ["base_acceleration" if order.kind == "impact" else "velocity_1"]}
    of = {"rig": "rig.toml"} if order.direction is None else {"rig": "../rig.toml", "mounting": order.direction}
    name = f"{order.kind} {order.draw} {order.direction or ''}".strip()
    text = block("", format=1, name=name, simulated=True, **of)
    text += block("[excitation]", **keys) + block("[[daq]]", name="daq", file="daq.h5", clock_uncertainty=1e-7)
    for name, channel in order.channels.items():
        text += block("[[daq.channel]]", name=name, **channel)
    text += block("[[daq.channel]]", name="camera_trigger", quantity="trigger", threshold=2.5)
    if order.poses:
        text += block("[[points]]", stereo="top", files="points.csv", columns=POINT_COLUMNS, trigger="camera_trigger")
    else:
        angle = np.linspace(0.0, 2.0 * np.pi, 25)[:-1]
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(24)], 1) * 0.93 * DISC_M + [0.0, 0.0, TOP_M]
        region = np.rint(make_cameras()[0].pixels(ring)).astype(int).tolist()
        text += block(
            "[[images]]", stereo="top", left="left/*.tif", right="right/*.tif", trigger="camera_trigger", region=region
        )
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    (folder / "amplifier.toml").write_text(AMPLIFIER, encoding="utf-8")


def write_points(folder: Path, poses: FloatArray, rng: np.random.Generator) -> None:
    """Write points of the face in the frame of the left camera, with white noise."""
    left = make_cameras()[0]
    radius, angle = DISC_M * np.sqrt(rng.uniform(0.02, 0.9, POINTS)), rng.uniform(0.0, 2.0 * np.pi, POINTS)
    body = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(POINTS, TOP_M)], 1)
    lines = [",".join(POINT_COLUMNS)]
    for frame, pose in enumerate(poses):
        places = (Rotation.from_rotvec(pose[3:]).apply(body) + pose[:3] - left.place_m) @ left.axes
        places += U_POINT_M * rng.normal(size=places.shape)
        lines += [f"{frame},{number},{x:.10f},{y:.10f},{z:.10f}" for number, (x, y, z) in enumerate(places)]
    (folder / "points.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_images(folder: Path, poses: FloatArray, rng: np.random.Generator) -> None:
    """Write the images of both cameras."""
    texture = make_texture(rng)
    for name, camera in zip(("left", "right"), make_cameras(), strict=True):
        (folder / name).mkdir()
        view = View.of(camera, texture)
        for frame, pose in enumerate(poses):
            cv2.imwrite(str(folder / name / f"{frame:05d}.tif"), photograph(view.image(pose), rng))


def write(order: Order, folder: Path) -> dict[str, Any]:
    """Write a recording with its rig into an empty folder, and return the truth."""
    folder.mkdir(parents=True)
    rig, rng = make_rig(order.draw, order.exact, order.driven), order.rng
    errors = sample_errors(order)
    motion = simulate(order, rig, errors, rng)
    write_channels(folder / "daq.h5", order, motion, rng)
    write_rig(order, folder if order.direction is None else folder.parent, rig, errors)
    write_recording(order, folder)
    (write_points if order.poses else write_images)(folder, motion["mean"], rng)
    truth = truth_of(order, rig, motion, errors)
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
    return truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--draw", type=int, default=0)
    parser.add_argument("--frequency", type=float, default=120.7)
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--poses", action="store_true")
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--direction", choices=DIRECTIONS)
    stated = parser.parse_args()
    order = Order(stated.kind, stated.draw, stated.frequency, stated.poses, stated.exact, stated.duration)
    write(replace(order, direction=stated.direction), stated.out)


if __name__ == "__main__":
    main()
