"""DAQ records: what each channel's file holds, on its recorder's own clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.draws import Draws
from fusion.simulate.mechanics import ComplexArray, acceleration_at, harmonic, velocity_at
from fusion.simulate.preset import ChannelSpec, DaqSpec
from fusion.simulate.world import World
from shaker._checks import FloatArray

_PULSE_S = 2e-3
_HIGH_V = 5.0
RESPONSE_HZ = np.array([0.0, 20.0, 50.0, *np.arange(100.0, 3001.0, 100.0)])
_RESPONSE_U = (1e-4, 1e-4)  # relative magnitude, phase in rad


@dataclass(frozen=True, eq=False)
class Record:
    """A recorder's file: its nominal rate and one array of samples per channel."""

    sample_rate_hz: float
    samples: dict[str, NDArray[np.float32]]
    units: dict[str, str]


def clock(daq: DaqSpec, draws: Draws) -> tuple[float, float]:
    """Return a recorder's true start (s) and the true seconds that pass in one second of its clock."""
    return daq.start_s, 1 + float(draws.normal(f"{daq.name}.clock", daq.clock_uncertainty))


def record(world: World, daq: DaqSpec, draws: Draws, noise: bool) -> Record:
    """Return what one recorder stores, rounded to its converter's steps."""
    start, rate = clock(daq, draws)
    count = np.arange(round(daq.duration_s * daq.sample_rate_hz), dtype=np.float64)
    time: FloatArray = start + rate * count / daq.sample_rate_hz
    samples, units = {}, {}
    for spec in daq.channels:
        if spec.quantity == "trigger":
            values = _trigger(world, time)
        else:
            phasors = recorded_phasors(world, daq, spec, draws)
            values = harmonic(time, world.preset.frequencies_hz, phasors[:, None])[:, 0]
        if noise:
            values = values + spec.noise * draws.stream(f"{daq.name}.{spec.name}.noise").standard_normal(len(time))
        samples[spec.name] = (np.rint(values / spec.lsb) * spec.lsb).astype(np.float32)
        units[spec.name] = spec.unit
    return Record(daq.sample_rate_hz, samples, units)


def _trigger(world: World, time_s: FloatArray) -> FloatArray:
    """Return rectangular pulses of 2 ms that rise at the trigger instants."""
    last = np.searchsorted(world.trigger_s, time_s, side="right") - 1
    since = time_s - world.trigger_s[np.maximum(last, 0)]
    return np.where((last >= 0) & (since < _PULSE_S), _HIGH_V, 0.0)


def recorded_phasors(world: World, daq: DaqSpec, spec: ChannelSpec, draws: Draws) -> ComplexArray:
    """Return the phasors (K,) in the file: true value · response · exp(−jω·delay) / true scale."""
    shared = spec.common or spec.name
    scale = float(draws.normal(f"{shared}.scale", spec.stated.get("scale_uncertainty", 0.0)))
    own = float(draws.normal(f"{spec.name}.individual", spec.stated.get("individual_uncertainty", 0.0)))
    delay = float(draws.normal(f"{shared}.delay", spec.stated.get("delay_uncertainty", 0.0)))
    value = _true_phasors(world, spec, draws) * np.exp(-2j * np.pi * world.preset.frequencies_hz * delay)
    if daq.response:
        value = value * true_response(shared, world.preset.frequencies_hz, draws)
    return np.asarray(value / (spec.scale * (1 + scale) * (1 + own)))


def _true_phasors(world: World, spec: ChannelSpec, draws: Draws) -> ComplexArray:
    """Return the phasors (K,) of the quantity in SI, at the point and along the axis where the channel really sits."""
    if spec.quantity == "output":
        return np.asarray(world.outputs[:, ("Fx", "Fy", "Fz", "Mx", "My", "Mz").index(spec.name)])
    motion = world.motion[spec.body]
    point = np.array(spec.point) + draws.normal(f"{spec.name}.point", spec.stated.get("point_uncertainty", 0.0), 3)
    nominal = np.array(spec.direction)
    tilt = draws.normal(f"{spec.name}.direction", spec.stated.get("direction_uncertainty", 0.0), 3)
    direction = nominal + np.cross(tilt, nominal)
    direction = direction / np.linalg.norm(direction)
    if spec.quantity == "velocity":
        return velocity_at(motion, point, direction)
    transverse = draws.normal(f"{spec.name}.transverse", spec.stated.get("transverse_sensitivity", 0.0) / np.sqrt(2), 3)
    axis = direction + transverse - nominal * (transverse @ nominal)
    return acceleration_at(motion, point, axis, world.gravity)


def nominal_response(frequency_hz: FloatArray) -> ComplexArray:
    """Return the stated response of the bridge amplifier, a second-order low-pass at 9 kHz with damping 0.7."""
    ratio = np.asarray(frequency_hz) / 9000.0
    return np.asarray(1 / (1 - ratio**2 + 1.4j * ratio))


def true_response(name: str, frequency_hz: FloatArray, draws: Draws) -> ComplexArray:
    """Return the response with one magnitude and one phase error for all frequencies."""
    magnitude, phase = (float(draws.normal(f"{name}.response.{k}", u)) for k, u in zip("mp", _RESPONSE_U, strict=True))
    table = nominal_response(RESPONSE_HZ)
    size = np.interp(frequency_hz, RESPONSE_HZ, np.abs(table))
    angle = np.interp(frequency_hz, RESPONSE_HZ, np.unwrap(np.angle(table)))
    return np.asarray(size * (1 + magnitude) * np.exp(1j * (angle + phase)))


def response_table() -> str:
    """Return the stated response as text: frequency_hz, magnitude, phase_rad and their uncertainties."""
    value = nominal_response(RESPONSE_HZ)
    lines = ["frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad"]
    for frequency, entry in zip(RESPONSE_HZ, value, strict=True):
        u_magnitude = abs(entry) * _RESPONSE_U[0]
        lines.append(f"{frequency!r},{abs(entry):.9f},{np.angle(entry):.9f},{u_magnitude:.3e},{_RESPONSE_U[1]!r}")
    return "\n".join(lines).replace("np.float64(", "").replace(")", "") + "\n"
