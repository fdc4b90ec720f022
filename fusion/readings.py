"""From evaluated channels and the rig's entries to what the fusion takes: readings, observations, the body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.body import Body, make_part
from fusion.body import Part as RigidPart
from fusion.elastic_joint import make_joint
from fusion.errors import ComputeError
from fusion.manifest import ChannelEntry, Load, Manifest, Part
from fusion.measured_results import ChannelResult
from fusion.notices import AnyNotice, Notice
from fusion.observe import (
    ChainUncertainty,
    LineTurns,
    Observation,
    PulseExposure,
    Reading,
    StereoReading,
    observe_channels,
)
from fusion.response import read_response
from fusion.stereo_phasors import StereoPhasors
from fusion.timing import TimeBase
from shaker.signals.frequencies import Lines


def channel_readings(base: TimeBase, channels: Sequence[ChannelResult]) -> tuple[Reading, ...]:
    """Return every channel with its manifest entry and the uncertainty of its chain and clock."""
    entries = {(r.entry.name, c.name): c for r in base.records for c in r.entry.channel}
    return tuple(_reading(base, channel, entries[channel.daq, channel.name]) for channel in channels)


def _reading(base: TimeBase, channel: ChannelResult, entry: ChannelEntry) -> Reading:
    """Return one channel with the uncertainty of its response table and of its clock's tie to the first one."""
    tie = base.ties[channel.daq]
    u_clock_s = 0.0 if tie is None else float(tie.u_to_base_s(np.asarray(channel.samples / channel.sample_rate_hz / 2)))
    if entry.response is None:
        return Reading(entry, channel.phasors, ChainUncertainty(clock=channel.daq, u_clock_s=u_clock_s))
    response = read_response(entry.response, channel.phasors.frequency_hz)
    chain = ChainUncertainty(response.u_magnitude, response.u_phase_rad, channel.daq, u_clock_s)
    return Reading(entry, channel.phasors, chain)


def stereo_readings(
    manifest: Manifest, base: TimeBase, readings: Sequence[Reading], stereo: Sequence[StereoPhasors], lines: Lines
) -> tuple[StereoReading, ...]:
    """Return every stereo pair with its phasors and all that is known of their errors.

    Without any reading of a channel the lines were found in the motion itself, and what it leaves open of their
    frequencies turns the phasors by as much as its noise does; a channel knows them far better than that.
    """
    clock = manifest.daq[0].clock_uncertainty if manifest.daq else 0.0
    seen = []
    for item in stereo:
        pair = item.pair.model_copy(update={"delay_uncertainty": item.entry.delay_uncertainty})
        trigger = (item.entry.trigger, base.u_trigger_s(item.entry.trigger))
        middle_s = float(np.mean(item.result.time_s))
        turns = None if readings else LineTurns(lines.nominal_hz, lines.u_frequency_hz, middle_s)
        pulse = PulseExposure(item.entry.trigger, item.result.exposure_s, item.result.u_exposure_s)
        reading = StereoReading(item.result.name, pair, item.displacement, item.effects, clock, trigger, turns, pulse)
        seen.append(reading)
    return tuple(seen)


def observations(
    manifest: Manifest, base: TimeBase, readings: Sequence[Reading], stereo: Sequence[StereoPhasors], lines: Lines
) -> tuple[Observation, ...]:
    """Return every instrument of what was recorded at once as rows of the linear model."""
    return all_rows(manifest, readings, stereo_readings(manifest, base, readings, stereo, lines))


def all_rows(
    manifest: Manifest, readings: Sequence[Reading], pairs: Sequence[StereoReading]
) -> tuple[Observation, ...]:
    """Return channels and stereo pairs as rows of the linear model, the first block's clock being their time base."""
    first = manifest.daq or manifest.take[0].daq
    channels = observe_channels(readings, gravity(manifest), first[0].clock_uncertainty)
    return (*(pair.observed() for pair in pairs), *channels)


def unseen_fundamentals(
    seen: Sequence[Observation], lines: Lines, folded: Sequence[AnyNotice]
) -> tuple[AnyNotice, ...]:
    """Return a notice for each driven line at which no instrument sees a motion, and refuse a recording without any.

    `folded`: what was said of the lines that camera rates cannot tell apart.
    """
    driven = lines.frequency_hz[lines.multiple == 1]
    lost = [f for f in driven if not any(_sees(observation, float(f)) for observation in seen)]
    if len(driven) and len(lost) == len(driven) and (seen or folded):
        listed = " and ".join(f"{f:.6g} Hz" for f in lost)
        reasons = dict.fromkeys(notice.text for notice in folded if any(f"{f:.6g} Hz" in notice.text for f in lost))
        why = f" ({'; '.join(reasons)})" if reasons else ""
        raise ComputeError(f"no instrument sees the motion of the driven line at {listed}{why}")
    return tuple(
        Notice("warning", f"no instrument sees the motion at {f:.6g} Hz, a driven line", f"{f:.6g} Hz") for f in lost
    )


def _sees(observation: Observation, frequency_hz: float) -> bool:
    """Tell whether an instrument has a reading at a line."""
    line = observation.phasors.frequency_hz == frequency_hz
    return bool(np.isfinite(observation.phasors.value[line]).any())


def gravity(manifest: Manifest) -> tuple[float, float, float] | None:
    """Return the acceleration of gravity (m/s^2, sensor frame), None where the rig does not state it."""
    environment = manifest.rig.environment
    return None if environment is None else environment.gravity


def load_body(manifest: Manifest) -> Body | None:
    """Return all that moves above the elastic element: load, parts and internal mass; None without a `[load]`.

    The sensor's own mass lies below the load's joint, where there is one.
    """
    load, sensor, environment = manifest.rig.load, manifest.rig.sensor, manifest.rig.environment
    if load is None:
        return None
    air = 0.0 if environment is None else environment.air_density or 0.0
    parts = [_part("load", load, air)]
    parts += [_part(part.name, part, air, part.below_joint) for part in manifest.part if part.body == "load"]
    if sensor is not None and sensor.internal_mass > 0.0:
        u = (
            sensor.internal_mass_uncertainty,
            sensor.internal_centre_of_mass_uncertainty,
            sensor.internal_inertia_uncertainty,
        )
        centre, inertia = sensor.internal_centre_of_mass, sensor.internal_inertia
        parts.append(make_part("internal mass", sensor.internal_mass, centre, inertia, u, below_joint=True))
    if load.elastic_frequency is None:
        return Body(tuple(parts))
    joint = make_joint(load.elastic_frequency, load.elastic_frequency_uncertainty, load.elastic_damping)
    return Body(tuple(parts), joint)


def _part(name: str, entry: Load | Part, air_density: float, below_joint: bool = False) -> RigidPart:
    """Return one table of the rig as a rigid part with its true mass, in air of a density in kg/m^3 (0: not stated)."""
    u = (entry.mass_uncertainty, entry.centre_of_mass_uncertainty, entry.inertia_uncertainty)
    share = 0.0 if entry.density is None else air_density / entry.density
    return make_part(name, entry.true_mass, entry.centre_of_mass, entry.inertia, u, share, below_joint)
