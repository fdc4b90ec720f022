"""Everything after the phasors: fuse, load, sensitivity; and the result tree of one recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import AnyNotice, ComputeError
from fusion.estimation.fuse import Acceleration, fuse_sources
from fusion.estimation.measurement_model import Observation
from fusion.instruments.channel import Outputs
from fusion.instruments.vibrometer import PointSpread
from fusion.sensitivity.body import Body
from fusion.sensitivity.distributions import MonteCarlo
from fusion.sensitivity.load import LoadResult, load_phasors
from fusion.sensitivity.ratio import (
    KnownMatrix,
    Sensitivity,
    StatedMatrix,
    driven_component,
    known_matrix,
    parasitic_loads,
    sensitivity_ratio,
    sensor_element,
)
from shaker.arrays import Notice, brief
from shaker.labels import LOAD_COMPONENTS
from shaker.lines.frequencies import Lines

if TYPE_CHECKING:
    from fusion.phasors.channels import ChannelResult
    from fusion.phasors.setups import SetUpResult
    from fusion.phasors.stereo_phasors import StereoResult
    from fusion.phasors.timing import ClockResult
    from fusion.recording.load import Manifest
    from fusion.recording.rig import Sensor

CHANGED = 0.3
"""Relative change of the driven element since rest from which its static value is doubted."""

# From the phasors of all instruments to acceleration, load and sensitivity: what follows tracks and channels.


@dataclass(frozen=True)
class Inputs:
    """What is known of one recording when all phasors have been found.

    `lines`: the K lines; `observations`: the instruments as rows of the linear model; `outputs`: of the `sensor`;
    `body`: all that moves above the elastic element, None without a load; `direction`: 3 or 6 numbers.
    """

    lines: Lines
    observations: tuple[Observation, ...]
    outputs: Outputs | None = None
    body: Body | None = None
    sensor: Sensor | None = None
    direction: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Analysis:
    """Acceleration of every body, fused first and then by source; load and sensitivity where there are any.

    `sensitivity`: ratios of the outputs over the driven load; `element`: the sensor's own elements, with what is
    `known` of its matrix, None where nothing is.
    """

    accelerations: tuple[Acceleration, ...]
    load: LoadResult | None
    sensitivity: Sensitivity | None
    element: Sensitivity | None = None
    known: KnownMatrix | None = None

    __repr__ = brief

    @property
    def notices(self) -> tuple[AnyNotice, ...]:
        """Return what fusion, load and sensitivity want the user to know."""
        results = [*(a for a in self.accelerations if a.source == "fused"), self.load, self.sensitivity]
        results.append(self.element)
        return tuple(notice for result in results if result is not None for notice in result.notices)


def analyse(inputs: Inputs) -> Analysis:
    """Fuse all instruments of every body, apply the mass matrix, and divide the outputs by the driven load.

    Raises `ComputeError` where nothing measures a motion.
    """
    seen, outputs, sensor, direction = inputs.observations, inputs.outputs, inputs.sensor, inputs.direction
    bodies = [body for body in ("load", "base") if any(observation.body == body for observation in seen)]
    if not bodies:
        raise ComputeError("no channel or camera of this recording measures a motion; add one to recording.toml")
    accelerations = tuple(acceleration for body in bodies for acceleration in fuse_sources(seen, body))
    fused = next((a for a in accelerations if a.body == "load" and a.source == "fused"), None)
    if inputs.body is None or fused is None:
        return Analysis(accelerations, None, None)
    load = load_phasors(fused, inputs.body)
    if sensor is None or direction is None or outputs is None:
        return Analysis(accelerations, load, None)
    component = driven_component(direction, sensor.capacity)
    ratio = sensitivity_ratio(outputs, load, component, inputs.lines.multiple, sensor.capacity)
    sizes = np.nanmax(np.nan_to_num(np.abs(ratio.value[:, :, component])), axis=0)
    known = known_matrix(StatedMatrix.of(sensor), outputs.phasors.channels, component, sizes)
    notices = _element_notices(known, outputs, load, sensor, component)
    if known is None:
        return Analysis(accelerations, load, replace(ratio, notices=(*ratio.notices, *notices)))
    element = sensor_element(outputs, load, known, inputs.lines.multiple, notices)
    if not np.isfinite(element.value[:, known.main, component]).any():
        return Analysis(accelerations, load, ratio)
    return Analysis(accelerations, load, ratio, element, known)


def _element_notices(
    known: KnownMatrix | None, outputs: Outputs, load: LoadResult, sensor: Sensor, component: int
) -> tuple[Notice, ...]:
    """Say what the sensor's element is corrected for, what its U holds instead, or why there is none."""
    named = LOAD_COMPONENTS[component]
    if known is None:
        text = (
            f"results are ratios of outputs and the load {named}, not the sensor's own sensitivity: one recording does "
            "not span the 6 x 6 matrix, and neither sensor.static_sensitivity (with cross-talk) nor sensor.cross_talk "
            "is stated; what other loads put into the outputs is neither corrected nor in U"
        )
        return (Notice("info", text, "sensitivity"),)
    element = f"element {known.channels[known.main]} per {named}"
    if not known.static:
        text = (
            f"the {element} is not corrected for other loads: U holds a cross-talk within ± {sensor.cross_talk:.2%} of "
            "the rated output at every rated load"
        )
        return (Notice("info", text, "sensitivity"),)
    # Of the output that the driven load moves most, at the strongest line.
    shares = parasitic_loads(outputs, load, known.value, component, sensor.static_sensitivity_uncertainty)
    line = int(np.argmax(np.nan_to_num(np.abs(load.value[:, component]))))
    hertz = f"{outputs.phasors.frequency_hz[line]:.6g} Hz"
    course = outputs.phasors.value[line, known.main] / (load.value[line] @ known.value[known.main])
    doubt = []
    if abs(course - 1.0) > CHANGED:
        text = (
            f"the {element} is {abs(course):.3g} times its static value at {hertz}, turned by "
            f"{np.angle(course):.3g} rad: other elements may have changed by as much, which U contains; check units "
            "and signs of the static matrix"
        )
        doubt.append(Notice("warning", text, "sensitivity"))
    return (*shares.notices(line, known.main, f"output {known.channels[known.main]} at {hertz}"), *doubt)


# What one evaluated recording consists of: the tree handed to the result writers and the report.


@dataclass(frozen=True)
class Evaluation:
    """Everything one recording yields.

    `accelerations`: one entry per body and source (`fused` first). `load`: wrench phasors at the sensor origin, N and
    N.m, with the manifest's sense. `outputs`: of the sensor. `sensitivity`: ratios; `element`: the sensor's elements
    under the driven load, where its matrix is known. `points`: vibrometer points that look along one direction.
    `monte_carlo`: where it was asked for. `set_ups`: what ties them, none for one alone. `settings`, `versions`,
    `input_hashes` (file -> SHA-256) say what was run on what.
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
    element: Sensitivity | None = None

    __repr__ = brief
