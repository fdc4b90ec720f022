"""Everything after the phasors: fuse, load, sensitivity; and the result tree of one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import AnyNotice, ComputeError
from fusion.estimation.fuse import Acceleration, fuse_sources
from fusion.estimation.measurement_model import Observation
from fusion.instruments.channel import Reading
from fusion.instruments.output import Outputs, output_phasors
from fusion.instruments.vibrometer import PointSpread
from fusion.sensitivity.body import Body, load_body
from fusion.sensitivity.distributions import MonteCarlo
from fusion.sensitivity.load import LoadResult, load_phasors
from fusion.sensitivity.ratio import Sensitivity, driven_component, parasitic_loads, sensitivity_ratio
from shaker.arrays import brief
from shaker.lines.frequencies import Lines

if TYPE_CHECKING:
    from fusion.phasors.channels import ChannelResult
    from fusion.phasors.setups import SetUpResult
    from fusion.phasors.stereo_phasors import StereoResult
    from fusion.phasors.timing import ClockResult
    from fusion.recording.load import Manifest
    from fusion.recording.manifest import Sensor

# From the phasors of all instruments to acceleration, load and sensitivity: what follows tracks and channels.


@dataclass(frozen=True)
class Inputs:
    """What is known of one recording when all phasors have been found.

    `lines`: the K lines; `observations`: the instruments as rows of the linear model; `outputs`: the sensor's channels
    in its own order; `body`: all that moves above the elastic element, None without a load; `gravity_mps2`: None where
    the rig does not state it, `u_gravity_mps2`: its standard uncertainty; `direction`: 3 or 6 numbers.
    """

    lines: Lines
    observations: tuple[Observation, ...]
    outputs: tuple[Reading, ...]
    body: Body | None
    gravity_mps2: tuple[float, float, float] | None
    sensor: Sensor | None
    direction: tuple[float, ...] | None
    u_gravity_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(
        cls, manifest: Manifest, lines: Lines, observations: Sequence[Observation], readings: Sequence[Reading]
    ) -> Inputs:
        """Return the inputs that a manifest and the phasors found for it make."""
        sensor, environment = manifest.rig.sensor, manifest.rig.environment
        # A channel under the name of the sensor's output that it is.
        outputs = [
            replace(reading, phasors=replace(reading.phasors, channels=(str(reading.entry.channel),)))
            for reading in readings
            if reading.entry.quantity == "output"
        ]
        if sensor is not None:
            outputs.sort(key=lambda reading: sensor.channels.index(str(reading.entry.channel)))
        return cls(
            lines=lines,
            observations=tuple(observations),
            outputs=tuple(outputs),
            body=load_body(manifest.rig, manifest.part),
            gravity_mps2=manifest.rig.gravity,
            sensor=sensor,
            direction=manifest.excitation.direction,
            u_gravity_mps2=(0.0, 0.0, 0.0) if environment is None else environment.gravity_uncertainty,
        )


@dataclass(frozen=True)
class Analysis:
    """Acceleration of every body, fused first and then by source; outputs, load and sensitivity where there are any."""

    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    outputs: Outputs | None
    sensitivity: Sensitivity | None

    __repr__ = brief

    @property
    def notices(self) -> tuple[AnyNotice, ...]:
        """Return what fusion, load and sensitivity want the user to know."""
        results = [*(a for a in self.accelerations if a.source == "fused"), self.load, self.sensitivity]
        return tuple(notice for result in results if result is not None for notice in result.notices)


def analyse(inputs: Inputs) -> Analysis:
    """Fuse all instruments of every body, apply the mass matrix, and divide the outputs by the driven load.

    Raises `ComputeError` where nothing measures a motion.
    """
    seen = inputs.observations
    bodies = [body for body in ("load", "base") if any(observation.body == body for observation in seen)]
    if not bodies:
        raise ComputeError("no channel or camera of this recording measures a motion; add one to recording.toml")
    accelerations = tuple(acceleration for body in bodies for acceleration in fuse_sources(seen, body))
    outputs = output_phasors(inputs.outputs) if inputs.outputs else None
    fused, sensor = next((a for a in accelerations if a.body == "load" and a.source == "fused"), None), inputs.sensor
    if inputs.body is None or fused is None:
        return Analysis(accelerations, None, outputs, None)
    sense = "on_load" if sensor is None else sensor.sense
    load = load_phasors(fused, inputs.body, inputs.gravity_mps2, sense, inputs.u_gravity_mps2)
    if sensor is None or inputs.direction is None or outputs is None:
        return Analysis(accelerations, load, outputs, None)
    ratio = sensitivity_ratio(outputs, load, inputs.direction, inputs.lines.multiple, sensor.unit, sensor.capacity)
    parasitic = _parasitic_loads(sensor, outputs, load, inputs.direction)
    return Analysis(accelerations, load, outputs, replace(ratio, notices=(*ratio.notices, *parasitic)))


def _parasitic_loads(
    sensor: Sensor, outputs: Outputs, load: LoadResult, direction: Sequence[float]
) -> tuple[AnyNotice, ...]:
    """Return what the driven output owes to other loads at the strongest line, by the static sensitivity."""
    if sensor.static_sensitivity is None:
        return ()
    channels, component = outputs.phasors.channels, driven_component(direction, sensor.capacity)
    static = np.asarray(sensor.static_sensitivity)[[sensor.channels.index(name) for name in channels]]
    driven = int(np.argmax(np.abs(static[:, component])))
    line = int(np.argmax(np.nan_to_num(np.abs(load.value[:, component]))))
    where = f"output {channels[driven]} at {outputs.phasors.frequency_hz[line]:.6g} Hz"
    shares = parasitic_loads(outputs, load, static, component, sensor.static_sensitivity_uncertainty)
    return shares.notices(line, driven, where)


# What one evaluated recording consists of: the tree handed to the result writers and the report.


@dataclass(frozen=True)
class Evaluation:
    """Everything one recording yields.

    `accelerations`: one entry per body and source (`fused` first). `load`: wrench phasors at the sensor origin, N and
    N.m, with the manifest's sense. `outputs`: of the sensor. `points`: vibrometer points that look along one
    direction. `monte_carlo`: where it was asked for. `set_ups`: what ties them, none for one alone.
    `settings`, `versions`, `input_hashes` (file -> SHA-256) say what was run on what.
    """

    manifest: Manifest
    lines: Lines
    clocks: tuple[ClockResult, ...]
    channels: tuple[ChannelResult, ...]
    stereo: tuple[StereoResult, ...]
    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    outputs: Outputs | None
    sensitivity: Sensitivity | None
    notices: tuple[AnyNotice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float = 0.0
    set_ups: tuple[SetUpResult, ...] = ()
    points: tuple[PointSpread, ...] = ()
    monte_carlo: MonteCarlo | None = None

    __repr__ = brief
