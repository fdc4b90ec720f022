"""What a reference at rest makes of a room that shakes: coverage, and what it costs where nothing moves.

    python benchmarks/shaken_room.py [--trials 1000] [--rendered SEEDS] [--only NAME ...] [--write docs/room.md]

Phasors at one line, 80 Hz, 82 m/s²: a stereo pair and three laser points on the load, patches at rest in the pair's
view, an accelerometer on the laser head. Cameras and head move as rigid bodies about a place of their own; noise and
the stated errors are drawn, noise with a covariance that was estimated. Truth and readings come from the kinematics
below, which share nothing with the estimator. *Before*: the same draws without references. 1000 trials take half an
hour on one core.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from marked import existing_file, short_table, write_marked
from numpy.typing import NDArray

from fusion.estimation.fuse import fuse
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import polar_elements
from fusion.instruments.channel import ChainUncertainty, ChannelReading, observe_channels
from fusion.instruments.stereo import StereoReading
from fusion.recording.load import load_manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import InstrumentHead, NamedHead, Stereo
from fusion.recording.toml import to_toml
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.sensitivity.supports import without_supports
from fusion.simulate import simulate
from fusion.simulate.preset import Preset, face_of, patches_of, read_preset
from fusion.simulate.world import Draws, make_world
from photogram.synthetic.scene import motion_bound
from shaker.sine.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
FREQUENCY_HZ, DRIVE, DOF = 80.0, 82.0 * np.exp(0.7j), 34
W = 2.0 * np.pi * FREQUENCY_HZ
MOTION = np.array([0.6, 0.4j, DRIVE, 2.6j, -3.3, 1.1], dtype=np.complex128)
CAMERAS, FACE, HEAD = np.array([-0.10, -0.15, 0.44]), np.array([0.0, 0.0, 0.069]), np.array([0.0, 0.0, 0.60])
SPOTS = np.array([[0.018, 0.0, 0.069], [-0.009, 0.0156, 0.069], [-0.009, -0.0156, 0.069]])
SCALES = {"pair": 2e-4, "laser": 5e-4, "head": 3e-3}


@dataclass(frozen=True)
class Case:
    """One kind of trial: `shake`, size of the supports' motion over the drive, 0 for none; `along`: z alone, else any
    direction, with rotation; `noise` of a translation of the patch over the drive; `stated`: `support_motion`;
    `instruments`: which see the load."""

    name: str
    shake: float = 0.0
    along: bool = False
    noise: float = 5e-5
    stated: float | None = None
    instruments: str = "cameras"


CASES = (
    Case("cameras, at rest"),
    *(Case(f"cameras, {shake:g}", shake) for shake in (1e-4, 3e-4, 1e-3, 5e-3, 2e-2)),
    *(Case(f"cameras, {shake:g} along z", shake, along=True) for shake in (3e-4, 1e-3, 5e-3)),
    Case("cameras, at rest, a poor patch", noise=5e-4),
    *(Case(f"cameras, {shake:g}, a poor patch", shake, noise=5e-4) for shake in (1e-3, 5e-3)),
    Case("cameras, 0.002, 0.005 stated", 2e-3, stated=5e-3),
    Case("cameras, 0.002, 0.005 stated, a patch that tells nothing", 2e-3, stated=5e-3, noise=1.0),
    Case("lasers, at rest", instruments="lasers"),
    *(Case(f"lasers, {shake:g}", shake, instruments="lasers") for shake in (1e-3, 5e-3)),
    Case("both, at rest", instruments="both"),
    Case("both, 0.005", 5e-3, instruments="both"),
)


def point_motion(motion: ComplexArray, place: FloatArray) -> ComplexArray:
    """Return the acceleration (3,) of a point of a body that moves by (a, alpha) at the origin."""
    return np.asarray(motion[:3] + np.cross(motion[3:], place))


def rigid_noise(rng: np.random.Generator, sigma: float, middle: FloatArray, extent: float, draws: int) -> ComplexArray:
    """Return noise (N, 6), at the origin, of a face seen from above: height twice as loud, rotations sigma/extent."""
    local = sigma * np.array([1.0, 1.0, 2.0, 2.0 / extent, 2.0 / extent, 1.0 / extent])
    parts = local * (rng.standard_normal((draws, 6)) + 1j * rng.standard_normal((draws, 6)))
    parts[:, :3] -= np.cross(parts[:, 3:], middle)
    return np.asarray(parts)


def estimated(rng: np.random.Generator, sigma: float, middle: FloatArray, extent: float) -> FloatArray:
    """Return the covariance (12, 12) of such noise as so many degrees of freedom tell it, alike in Re and Im."""
    seen = rigid_noise(rng, sigma, middle, extent, DOF).real
    return np.asarray(np.kron(np.eye(2), seen.T @ seen / DOF))


def shaken(rng: np.random.Generator, case: Case, place: FloatArray) -> ComplexArray:
    """Return the motion (6,) at the origin of a support at a place."""
    if case.along:
        way, turn = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    else:
        way, turn = rng.standard_normal(3) / np.sqrt(3.0), rng.standard_normal(3) / 1.5
    size = case.shake * abs(DRIVE) * np.exp(2j * np.pi * rng.uniform())
    moved, turned = size * way, size * turn
    return np.concatenate([moved - np.cross(turned, place), turned])


def pair(
    name: str, body: str, value: ComplexArray, covariance: FloatArray, face: FloatArray, scale: float
) -> Observation:
    """Return what a stereo pair reads, as displacement."""
    stereo = Stereo.model_validate(
        {
            "body": body, "support": "frame", "rotation": np.eye(3).tolist(), "translation": CAMERAS.tolist(),
            "scale_uncertainty": scale, "exposure": 1e-4,
        }
    )  # fmt: skip
    names = tuple("abcdef")
    phasors = Phasors(
        np.array([FREQUENCY_HZ]), -value[None] / W**2, covariance[None] / W**4, names, ("m",) * 6, np.array([DOF * 1.0])
    )
    return StereoReading(name, stereo, phasors, face_m=face).observation()


def channel(entry: ChannelEntry, value: complex, sigma: float) -> ChannelReading:
    """Return what a channel reads."""
    covariance = sigma**2 * np.eye(2)[None]
    phasors = Phasors(np.array([FREQUENCY_HZ]), np.array([[value]]), covariance, (entry.name,), ("1",), np.array([1e3]))
    return ChannelReading(entry, phasors, ChainUncertainty())


def readings(case: Case, rng: np.random.Generator) -> tuple[Observation, ...]:
    """Return the instruments of one trial: those on the load, then the references."""
    seen, at_rest = list[Observation](), list[Observation]()
    scale = {name: 1.0 + u * rng.standard_normal() for name, u in SCALES.items()}
    if case.instruments != "lasers":
        support, sigma = shaken(rng, case, CAMERAS), case.noise * abs(DRIVE)
        for body, moved, noise, extent, own in (
            ("load", MOTION - support, 0.7e-4 * abs(DRIVE), 0.01, seen),
            ("room", -support, sigma, 0.02, at_rest),
        ):
            value = scale["pair"] * moved + rigid_noise(rng, noise, FACE, extent, 1)[0]
            own.append(pair(f"top {body}", body, value, estimated(rng, noise, FACE, extent), FACE, SCALES["pair"]))
    if case.instruments != "cameras":
        support, head = shaken(rng, case, HEAD), NamedHead("psv", InstrumentHead())
        z = {"direction": (0.0, 0.0, 1.0), "head": head}
        lasers = []
        for number, spot in enumerate(SPOTS):
            entry = ChannelEntry.model_validate(
                {"name": f"v{number}", "quantity": "velocity", "body": "load", "point": spot.tolist(), **z}
                | {"common": "laser", "scale_uncertainty": SCALES["laser"]}
            )
            velocity = (point_motion(MOTION, spot) - point_motion(support, np.array([*spot[:2], 0.6])))[2] / (1j * W)
            sigma = 2e-7
            noise = sigma * complex(*rng.standard_normal(2))
            lasers.append(channel(entry, scale["laser"] * complex(velocity) + noise, sigma))
        seen += observe_channels(lasers)
        entry = ChannelEntry.model_validate(
            {"name": "h", "quantity": "acceleration", "body": "head", "point": HEAD.tolist(), **z}
            | {"scale_uncertainty": SCALES["head"]}
        )
        noise = 1e-4 * complex(*rng.standard_normal(2))
        value = scale["head"] * complex(point_motion(support, HEAD)[2]) + noise
        at_rest += observe_channels([channel(entry, value, 1e-4)])
    return (*seen, *at_rest)


@dataclass(frozen=True)
class Found:
    """Of the load's acceleration along z, relative to the truth: its error, u, and which 95 % intervals hold it.

    `held`: of magnitude and phase along z, and of the mean over the components; `before`: error and u of the same draw
    without references.
    """

    error: complex
    u: float
    held: tuple[bool, bool, float]
    before: tuple[complex, float]


def estimate(observations: Sequence[Observation], limit: float | None) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Return acceleration (6,), standard uncertainties (2, 6) and expanded ones of magnitude and phase."""
    fused = fuse(without_supports(observations, limit)[0])
    (line,) = polar_elements(fused.phasors.value, fused.uncertainty)
    u = [[np.nan, np.nan] if p is None else [p.u_magnitude, p.u_phase_rad] for p in line]
    expanded = [[np.nan] * 2 if p is None else [p.expanded_magnitude, p.expanded_phase_rad] for p in line]
    return fused.phasors.value[0], np.array(u).T, np.array(expanded).T


def trial(case: Case, seed: int) -> Found:
    """Return what one draw gives."""
    observations = readings(case, np.random.default_rng(seed))
    value, u, expanded = estimate(observations, case.stated)
    plain, u_plain, _ = estimate([o for o in observations if o.body == "load"], case.stated)
    size, off = np.abs(value) - np.abs(MOTION), np.angle(value / MOTION)
    inside = np.stack([np.abs(size) <= expanded[0], np.abs(off) <= expanded[1]])
    seen = np.isfinite(value)
    held = bool(inside[0, 2]), bool(inside[1, 2]), float(inside[:, seen].mean())
    error, before = complex(value[2] / DRIVE - 1.0), complex(plain[2] / DRIVE - 1.0)
    return Found(error, u[0, 2] / abs(DRIVE), held, (before, u_plain[0, 2] / abs(DRIVE)))


def row(case: Case, trials: int) -> str:
    """Return one row of the table."""
    found = [trial(case, seed) for seed in range(trials)]
    error, before = np.array([f.error for f in found]), np.array([f.before[0] for f in found])
    held = np.array([f.held for f in found]).mean(axis=0)
    u, u_before = np.mean([f.u for f in found]), np.mean([f.before[1] for f in found])
    rms, rms_before = np.sqrt(np.mean(error.real**2)), np.sqrt(np.mean(before.real**2))
    figures = (rms_before, rms, u_before, u)
    cells = [case.name, *(f"{100 * figure:.4f}" if np.isfinite(figure) else "no mean" for figure in figures)]
    cells += [f"{100 * part:.1f}" for part in held]
    return "| " + " | ".join(cells) + " |"


# Rendered recordings of the preset `room`: what is found, and what the pictures of the patches allow.


def bound(seed: int) -> FloatArray:
    """Return the Cramér–Rao bound (6,) of one part of a line of the cameras' motion, m and rad at the sensor origin.

    The information of all pixels of both patches in both cameras of both pairs; a sine over F frames has the variance
    2/F of one frame in either part.
    """
    draws = Draws(seed, False)
    world = make_world(read_preset(Preset, "room"), draws, 0.0)
    information = np.zeros((6, 6))
    for stereo in world.stereo:
        for number, patch in enumerate(patches_of(stereo.setup)):
            face = face_of(patch, False, draws.stream(f"{patch.name}-{number}.speckle"))
            information += np.linalg.inv(motion_bound(stereo.views, face, stereo.setup.sensor))
    return np.sqrt(np.diagonal(np.linalg.inv(information)) * 2.0 / world.preset.frames)


def without_references(campaign: Path) -> None:
    """Take what looks at the room, or sits on the head, out of a recording."""
    (path,) = campaign.glob("*/recording.toml")
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    tables["images"] = [block for block in tables["images"] if not block["stereo"].endswith("-room")]
    for daq in tables["daq"]:
        daq["channel"] = [entry for entry in daq["channel"] if entry.get("body") != "head"]
    path.write_text(to_toml(tables), encoding="utf-8")


def rendered_row(seed: int, violate: Sequence[str]) -> list[str]:
    """Return the rows of one rendered recording: of the sensor's element, of the load by cameras and by lasers."""
    with tempfile.TemporaryDirectory() as folder:
        recording = simulate(f"{folder}/room", "room", seed, violate=tuple(violate), systematic_errors=False)
        truth = json.loads((recording / "truth.json").read_text(encoding="utf-8"))
        after = evaluate_recording(load_manifest(recording))
        without_references(Path(folder) / "room")
        before = evaluate_recording(load_manifest(recording))
    drive = complex(truth["acceleration"]["load"]["re"][0][2], truth["acceleration"]["load"]["im"][0][2])
    element = complex(truth["sensitivity"]["re"][0][2][2], truth["sensitivity"]["im"][0][2][2])
    rows = []
    for name in ("element", "photogrammetry", "vibrometer"):
        cells = [
            f"{', '.join(violate) or 'nothing'}, seed {seed}",
            "element Fz" if name == "element" else f"z by {name}",
        ]
        for evaluation in (before, after):
            if name == "element":
                found, true = evaluation.element, element
                assert found is not None
                one = polar_elements(found.value[:, 2:3, 2], found.uncertainty.at([found.elements.index((2, 2))]))[0][0]
            else:
                seen = next(a for a in evaluation.accelerations if (a.body, a.source) == ("load", name))
                one, true = polar_elements(seen.phasors.value, seen.uncertainty)[0][2], drive
            assert one is not None
            off = 100.0 * (one.magnitude / abs(true) - 1.0)
            cells += [f"{off:+.4f}", f"{100.0 * one.u_magnitude / abs(true):.4f}"]
        rows.append("| " + " | ".join(cells) + " |")
    cameras = next(moved for moved in after.supports if moved.name.startswith("cameras")).phasors
    shares = 100.0 * (2 * np.pi * FREQUENCY_HZ) ** 2 * bound(seed)[:3] / abs(drive)
    u = 100.0 * np.hypot(cameras.u_re, cameras.u_im)[0, :3] / np.sqrt(2.0) / abs(drive)
    print(f"cameras' motion x, y, z, %: u {u.round(4).tolist()}, bound of the pictures {shares.round(4).tolist()}")
    return rows


SHOWN = (
    *("cameras, at rest", "cameras, 0.0001", "cameras, 0.0003", "cameras, 0.001", "cameras, 0.005", "cameras, 0.02"),
    *("cameras, 0.001, a poor patch", "cameras, 0.002, 0.005 stated", "lasers, 0.005", "both, 0.005"),
)
"""Rows of the page."""
RENDERED = "| what shakes | of | error before, % | u before, % | error, % | u, % |"
HEADING = (
    "| what moves | error before, % | error, % | u before, % | u, % | magnitude covered, % | phase covered, % "
    "| all components covered, % |"
)


def main() -> None:
    """Print the table, and write it into a page where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--write", type=existing_file)
    parser.add_argument("--rendered", type=int, default=2, metavar="SEEDS")
    options = parser.parse_args()
    chosen = [case for case in CASES if not options.only or case.name in options.only]
    told = list[str]()
    for seed in range(1, options.rendered + 1):
        for violate in ((), ("floor-shake",)):
            told += rendered_row(seed, violate)
            print("\n".join(told[-3:]), flush=True)
    rows = list[str]()
    print(HEADING)
    for case in chosen:
        rows.append(row(case, options.trials))
        print(rows[-1], flush=True)
    if options.write is not None:
        parts = {"shaken room": short_table(HEADING, rows, (0, 1, 2, 4, 5), lambda cells: cells[0] in SHOWN)}
        parts["rendered room"] = short_table(RENDERED, told, (0, 1, 2, 4, 5), lambda cells: "seed 1" in cells[0])
        write_marked(options.write, parts)


if __name__ == "__main__":
    main()
