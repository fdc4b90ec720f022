"""From the phasors of all instruments to acceleration, load and sensitivity: what follows tracks and channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.body import Body
from fusion.errors import ComputeError
from fusion.fuse import Acceleration, fuse_sources
from fusion.load import LoadResult, load_phasors
from fusion.manifest import Manifest, Sensor
from fusion.notices import AnyNotice
from fusion.observe import Observation, Reading
from fusion.other_loads import other_loads
from fusion.outputs import Outputs, output_phasors
from fusion.readings import gravity, load_body
from fusion.sensitivity import Sensitivity, driven_component, sensitivity_ratio
from shaker.signals.frequencies import Lines


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
        outputs = [_as_output(reading) for reading in readings if reading.entry.quantity == "output"]
        if sensor is not None:
            outputs.sort(key=lambda reading: sensor.channels.index(str(reading.entry.channel)))
        return cls(
            lines=lines,
            observations=tuple(observations),
            outputs=tuple(outputs),
            body=load_body(manifest),
            gravity_mps2=gravity(manifest),
            sensor=sensor,
            direction=manifest.excitation.direction,
            u_gravity_mps2=(0.0, 0.0, 0.0) if environment is None else environment.gravity_uncertainty,
        )


def _as_output(reading: Reading) -> Reading:
    """A channel under the name of the sensor's output that it is."""
    return replace(reading, phasors=replace(reading.phasors, channels=(str(reading.entry.channel),)))


@dataclass(frozen=True)
class Analysis:
    """Acceleration of every body, fused first and then by source; outputs, load and sensitivity where there are any."""

    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    outputs: Outputs | None
    sensitivity: Sensitivity | None

    @property
    def notices(self) -> tuple[AnyNotice, ...]:
        """Return what fusion, load and sensitivity want the user to know."""
        found = [notice for a in self.accelerations if a.source == "fused" for notice in a.notices]
        found += [notice for result in (self.load, self.sensitivity) if result is not None for notice in result.notices]
        return tuple(found)


def analyse(inputs: Inputs) -> Analysis:
    """Fuse all instruments of every body, apply the mass matrix, and divide the outputs by the driven load.

    Raises `ComputeError` where nothing measures a motion.
    """
    seen = inputs.observations
    bodies = [body for body in ("load", "base") if any(observation.body == body for observation in seen)]
    if not bodies:
        raise ComputeError("no channel or camera of this recording measures a motion; add one to recording.toml")
    accelerations = tuple(acceleration for body in bodies for acceleration in fuse_sources(seen, body))
    load = _load(inputs, accelerations)
    outputs = output_phasors(inputs.outputs) if inputs.outputs else None
    return Analysis(accelerations, load, outputs, _sensitivity(inputs, load, outputs))


def _load(inputs: Inputs, accelerations: Sequence[Acceleration]) -> LoadResult | None:
    """Return the load on the sensor, None where the rig states no load mass or nobody observed the load's motion."""
    fused = next((a for a in accelerations if a.body == "load" and a.source == "fused"), None)
    if inputs.body is None or fused is None:
        return None
    sense = "on_load" if inputs.sensor is None else inputs.sensor.sense
    return load_phasors(fused, inputs.body, inputs.gravity_mps2, sense, inputs.u_gravity_mps2)


def _sensitivity(inputs: Inputs, load: LoadResult | None, outputs: Outputs | None) -> Sensitivity | None:
    """Return output over load of the driven component, None where there are no outputs or there is no load."""
    sensor, direction = inputs.sensor, inputs.direction
    if sensor is None or load is None or direction is None or outputs is None:
        return None
    found = sensitivity_ratio(outputs, load, direction, inputs.lines.multiple, sensor.unit, sensor.capacity)
    return replace(found, notices=(*found.notices, *_other_loads(sensor, outputs, load, direction)))


def _other_loads(
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
    shares = other_loads(outputs, load, static, component, sensor.static_sensitivity_uncertainty)
    return shares.notices(line, driven, where)
