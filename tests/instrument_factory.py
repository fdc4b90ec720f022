"""Instruments of one body for `fuse`, at two lines: camera pair, lasers, side beam, accelerometer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusion.estimation.fuse import Acceleration
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import Contribution, Uncertainty
from fusion.instruments.channel import ChainUncertainty, ChannelReading, ChannelRelativeError, observe_channels
from fusion.instruments.stereo import StereoReading
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors

FREQUENCY = np.array([106.25, 212.5])
OMEGA = 2.0 * np.pi * FREQUENCY
TRUTH = np.array(
    [[0.5, -0.3j, 189.0, 4.0j, -3.0, 1.0], [0.01, 0.02, 0.9 - 0.2j, 0.1, 0.05j, 0.02]], dtype=np.complex128
)
AXIAL = np.zeros((2, 6), dtype=np.complex128)
AXIAL[:, 2] = 189.0 * np.exp(0.369j), 1.9 * np.exp(-1.2j)
CIRCLE = [(0.04 * np.cos(a), 0.04 * np.sin(a), 0.03) for a in 2 * np.pi * np.arange(8) / 8]
GRAVITY = np.array([0.0, 0.0, -9.8125])
CAMERA = {"scale_uncertainty": 2e-4, "pose_uncertainty": (1e-4,) * 3 + (5e-4,) * 3, "delay_uncertainty": 1e-6}
LASER = {
    "scale_uncertainty": 2.5e-4, "delay_uncertainty": 5e-7, "individual_uncertainty": 1e-4,
    "point_uncertainty": (1e-3,) * 3, "direction_uncertainty": 5e-3,
}  # fmt: skip
TRIAXIAL = {
    "scale_uncertainty": 2e-3, "individual_uncertainty": 1e-3, "direction_uncertainty": 5e-4,
    "transverse_sensitivity": 1e-3, "point_uncertainty": (1e-3,) * 3, "common": "triaxial",
}  # fmt: skip
BEAM = LASER | {"direction_uncertainty": 5e-4, "common": "side"}
PLAIN, QUIET = 1e-6 * np.eye(12), 1e-18 * np.eye(2)
BARE = {"scale_uncertainty": 2.5e-4}


def phasors(value: np.ndarray, sigma: np.ndarray | float, dof: float = 200.0) -> Phasors:
    """Phasors (K, C) at the first K lines, with noise `sigma` of real and imaginary parts."""
    lines, count = value.shape
    covariance = np.tile(np.broadcast_to(sigma, value.shape), (1, 2))[:, :, None] ** 2 * np.eye(2 * count)
    names = tuple(f"c{i}" for i in range(count))
    return Phasors(FREQUENCY[:lines], value.astype(complex), covariance, names, ("SI",) * count, np.full(lines, dof))


def moving(
    value: np.ndarray = TRUTH,
    covariance: np.ndarray = PLAIN,
    dof: float = 50.0,
    observed: Any = True,
    frequency: np.ndarray = FREQUENCY,
    **uncertain: Any,
) -> Acceleration:
    """The load's acceleration with a covariance (12, 12) at all lines; `uncertain`: `noise` by its name, `influences`."""
    seen = np.broadcast_to(np.asarray(observed), value.shape)
    gone = ~np.tile(seen, (1, 2))
    spread = np.where(gone[:, :, None] | gone[:, None, :], np.nan, covariance)
    noise = Contribution(uncertain.get("noise", "noise"), "A", spread, np.full(len(value), dof))
    total = Uncertainty((noise,), uncertain.get("influences", ()))
    found = np.where(seen, value, complex(np.nan, np.nan))
    series = Phasors(frequency, found, total.covariance, MOTION_COMPONENTS, component_units(2), noise.dof)
    return Acceleration("load", "fused", series, seen, ("top",), total, (), 0.0, 0, (), ())


def output(
    value: np.ndarray,
    covariance: np.ndarray = QUIET,
    dof: float = 100.0,
    further_errors: tuple[ChannelRelativeError, ...] = (),
    frequency: np.ndarray = FREQUENCY,
    **stated: Any,
) -> ChannelReading:
    """An output of the sensor, Fz unless it is named, with the covariance (2, 2) of its noise."""
    entry = channel_entry(**{"name": "Fz", "quantity": "output"} | stated)
    entry.channel = entry.name
    spread, freedom = np.tile(covariance, (len(value), 1, 1)), np.full(len(value), dof)
    found = Phasors(frequency, value[:, None].astype(complex), spread, (entry.name,), ("V/V",), freedom)
    return ChannelReading(entry, found, ChainUncertainty(), further_errors)


def channel_entry(**changes: Any) -> Any:
    """Manifest entry of a laser along z through the origin, without errors."""
    return SimpleNamespace(
        **{
            "name": "v", "quantity": "velocity", "body": "load", "point": (0.0, 0.0, 0.0),
            "direction": (0.0, 0.0, 1.0), "point_uncertainty": (0.0,) * 3, "direction_uncertainty": 0.0,
            "scale_uncertainty": 0.0, "individual_uncertainty": 0.0, "transverse_sensitivity": 0.0,
            "delay_uncertainty": 0.0, "filter_delay_s": 0.0, "common": None, "channel": None, "head": None,
        }
        | changes
    )  # fmt: skip


def stereo_entry(**changes: Any) -> Any:
    """Manifest entry of a camera pair, without errors."""
    exact = {"body": "load", "scale_uncertainty": 0.0, "pose_uncertainty": (0.0,) * 6, "delay_uncertainty": 0.0}
    at_once = {"row_time": (0.0, 0.0), "row_time_uncertainty": 0.0, "readout_s": lambda rows: 0.0}
    return SimpleNamespace(**(exact | at_once | changes))


def channels(rows: Sequence[tuple[str, Any, Any]], noise: np.ndarray, quantity: str, **stated: Any) -> Observation:
    """Channels (name, point, direction) that read zero; `noise` (K,) of each."""
    blank = phasors(np.zeros((len(noise), 1)), noise[:, None])
    entries = [channel_entry(quantity=quantity, name=n, point=p, direction=d, **stated) for n, p, d in rows]
    return observe_channels([ChannelReading(entry, blank, ChainUncertainty()) for entry in entries], GRAVITY)[0]


def lasers(points: Any = 8, noise: float = 1e-5, truth: np.ndarray = TRUTH, **stated: Any) -> Observation:
    """Lasers along z at points, or at some of a circle, without errors; `noise` over the driven velocity of a line."""
    positions = CIRCLE[:points] if isinstance(points, int) else points
    rows = [(f"p{i}", point, (0.0, 0.0, 1.0)) for i, point in enumerate(positions)]
    size = np.abs(truth[:, 2]) / OMEGA[: len(truth)]
    return exact_reading(channels(rows, noise * size, "velocity", **{"common": "laser"} | (stated or LASER)), truth)


def beam() -> Observation:
    return channels([("side", (0.05, 0.0, 0.02), (1.0, 0.0, 0.0))], 1e-5 * 189.0 / OMEGA, "velocity", **BEAM)


def triaxial() -> Observation:
    rows = [("a" + "xyz"[i], (0.02, -0.03, 0.06), tuple(np.eye(3)[i])) for i in range(3)]
    return channels(rows, np.full(2, 2e-5 * 189.0), "acceleration", **TRIAXIAL)


def camera(noise_m: float = 1e-9, **stated: Any) -> Observation:
    """A camera pair without errors; `noise_m` along its x."""
    sigma = noise_m * np.array([1, 1, 3, 30, 30, 10.0])
    return exact_reading(
        StereoReading("top", stereo_entry(**(stated or CAMERA)), phasors(np.zeros((2, 6)), sigma)).observation()
    )


def exact_reading(observation: Observation, truth: np.ndarray = TRUTH) -> Observation:
    """Readings of a motion without errors."""
    return with_values(observation, np.einsum("kmj,kj->km", observation.design, truth))


def simulated_readings(
    seen: Sequence[Observation], rng: np.random.Generator, truth: np.ndarray = TRUTH, drawn: bool = True
) -> list[Observation]:
    """Readings of a motion with sampled common errors and noise."""
    found = []
    for observation in seen:
        value = np.einsum("kmj,kj->km", observation.design, truth)
        for error in observation.common if drawn else ():
            value = value + rng.normal() * error.effect(truth)
        sd = np.sqrt(observation.phasors.covariance.diagonal(axis1=1, axis2=2))[:, : value.shape[1]]
        noise = sd * (rng.normal(size=value.shape) + 1j * rng.normal(size=value.shape))
        found.append(with_values(observation, value + noise))
    return found


def drop_readings(observation: Observation, gone: np.ndarray) -> Observation:
    """An instrument without some readings (K, M)."""
    value = np.where(gone, complex(np.nan, np.nan), observation.phasors.value)
    missing = np.tile(gone, (1, 2))
    covariance = np.where(missing[:, :, None] | missing[:, None, :], np.nan, observation.phasors.covariance)
    return replace(observation, phasors=replace(observation.phasors, value=value, covariance=covariance))


def with_values(observation: Observation, value: np.ndarray) -> Observation:
    return replace(observation, phasors=replace(observation.phasors, value=value))


def rotated_frame(observation: Observation, axis: int, angle_rad: float) -> Observation:
    """A rotated camera frame, with translations and rotations in other axes."""
    matrix = np.kron(np.eye(2), Rotation.from_rotvec(angle_rad * np.eye(3)[axis]).as_matrix())
    return with_values(observation, observation.phasors.value @ matrix.T)
