"""Everything after the phasors: fuse, load, sensitivity; and the result tree of one recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import AnyNotice, ComputeError
from fusion.estimation.fuse import Acceleration, fuse_sources
from fusion.estimation.least_squares import UnseenMotion
from fusion.estimation.measurement_model import Observation
from fusion.instruments.channel import Outputs
from fusion.instruments.vibrometer import PointSpread
from fusion.sensitivity.body import Body
from fusion.sensitivity.distributions import MonteCarlo
from fusion.sensitivity.load import LoadResult, load_phasors
from fusion.sensitivity.ratio import Sensitivity, driven_component, parasitic_loads, sensitivity_ratio
from shaker.arrays import Notice, brief
from shaker.lines.frequencies import Lines

if TYPE_CHECKING:
    from fusion.phasors.channels import ChannelResult
    from fusion.phasors.setups import SetUpResult
    from fusion.phasors.stereo_phasors import StereoResult
    from fusion.phasors.timing import ClockResult
    from fusion.recording.load import Manifest
    from fusion.recording.rig import Sensor

# From the phasors of all instruments to acceleration, load and sensitivity: what follows tracks and channels.


@dataclass(frozen=True)
class Inputs:
    """What is known of one recording when all phasors have been found.

    `lines`: the K lines; `observations`: the instruments as rows of the linear model; `outputs`: of the `sensor`;
    `body`: all that moves above the elastic element, None without a load; `direction`: 3 or 6 numbers. `unseen`: what
    is assumed of motion that nobody observes.
    """

    lines: Lines
    observations: tuple[Observation, ...]
    outputs: Outputs | None = None
    body: Body | None = None
    sensor: Sensor | None = None
    direction: tuple[float, ...] | None = None
    unseen: UnseenMotion = field(default_factory=UnseenMotion)


@dataclass(frozen=True)
class Analysis:
    """Acceleration of every body, fused first and then by source; load and sensitivity where there are any."""

    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    sensitivity: Sensitivity | None

    __repr__ = brief

    @property
    def notices(self) -> tuple[AnyNotice, ...]:
        """Return what fusion, load and sensitivity want the user to know."""
        results = [*(a for a in self.accelerations if a.source == "fused"), self.load, self.sensitivity]
        return tuple(notice for result in results if result is not None for notice in result.notices)


SINGLE = (
    "one recording: repeatability and what mounting anew changes are not assessed and not in U; a campaign that holds "
    "it again, mounted anew, has them"
)


def analyse(inputs: Inputs) -> Analysis:
    """Fuse all instruments of every body, apply the mass matrix, and divide the outputs by the driven load.

    Raises `ComputeError` where nothing measures a motion.
    """
    seen, outputs, sensor, direction = inputs.observations, inputs.outputs, inputs.sensor, inputs.direction
    bodies = [body for body in ("load", "base") if any(observation.body == body for observation in seen)]
    if not bodies:
        raise ComputeError("no channel or camera of this recording measures a motion; add one to recording.toml")
    accelerations = tuple(acceleration for body in bodies for acceleration in fuse_sources(seen, body, inputs.unseen))
    fused = next((a for a in accelerations if a.body == "load" and a.source == "fused"), None)
    if inputs.body is None or fused is None:
        return Analysis(accelerations, None, None)
    load = load_phasors(fused, inputs.body)
    if sensor is None or direction is None or outputs is None:
        return Analysis(accelerations, load, None)
    component = driven_component(direction, sensor.capacity)
    ratio = sensitivity_ratio(outputs, load, component, inputs.lines.multiple, sensor.capacity)
    if np.any(np.isfinite(ratio.value)):
        ratio = replace(ratio, notices=(*ratio.notices, Notice("info", SINGLE, "sensitivity")))
    if sensor.static_sensitivity is not None:
        channels, frequency_hz = outputs.phasors.channels, outputs.phasors.frequency_hz
        static = np.array([sensor.static_sensitivity[sensor.channels.index(name)] for name in channels])
        parasitic = parasitic_loads(outputs, load, static, component, sensor.static_sensitivity_uncertainty)
        # Of the output that the driven load moves most, at the strongest line.
        line = int(np.argmax(np.nan_to_num(np.abs(load.value[:, component]))))
        driven = int(np.argmax(np.abs(static[:, component])))
        told = parasitic.notices(line, driven, f"output {channels[driven]} at {frequency_hz[line]:.6g} Hz")
        ratio = replace(ratio, notices=(*ratio.notices, *told))
    return Analysis(accelerations, load, ratio)


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
