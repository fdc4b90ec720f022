"""Whether a recording has its result, and the reason where it has none."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.estimation.fuse import Acceleration
from fusion.sensitivity.analyse import Analysis, Inputs, main_output
from fusion.sensitivity.ratio import driven_component
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shakercal._common.arrays import BoolArray
from shakercal._common.notices import Notice


def missing_result(inputs: Inputs, analysis: Analysis) -> Iterator[Notice]:
    """Yield a warning with the driven lines without a result and the reason.

    The result is the sensitivity to the driven load if outputs of a sensor were recorded. Otherwise it is the
    acceleration along the driven component, or along any component without a stated direction.
    """
    driven, direction = np.asarray(inputs.lines.multiple) == 1, inputs.direction
    capacity = None if inputs.sensor is None else inputs.sensor.capacity
    component = None if direction is None else driven_component(direction, capacity)
    if inputs.outputs is not None:
        name = "sensitivity" if component is None else f"sensitivity to the driven load {LOAD_COMPONENTS[component]}"
        found = _with_sensitivity(inputs, analysis, component)
    else:
        name = "acceleration" if component is None else f"acceleration along the driven {MOTION_COMPONENTS[component]}"
        found = np.any([_observed(a, component) for a in analysis.accelerations if a.source == "fused"], axis=0)
    lacking = driven & ~found
    if lacking.any():
        yield Notice(
            NO_RESULT_AT_LINES,
            "result",
            quantity=name,
            frequencies=", ".join(f"{nominal:g}" for nominal in inputs.lines.nominal_hz[lacking]),
            lost=int(np.sum(lacking)),
            driven=int(np.sum(driven)),
            reason=_describe_reason(inputs, analysis, component, lacking),
        )


def _observed(acceleration: Acceleration, component: int | None) -> BoolArray:
    seen = acceleration.observed
    return np.asarray(seen.any(axis=1) if component is None else seen[:, component])


def _with_sensitivity(inputs: Inputs, analysis: Analysis, component: int | None) -> BoolArray:
    """Return the lines (K,) at which the main output has a sensitivity.

    Any output, if none is the main one.
    """
    found = analysis.sensitivity
    if found is None or component is None or inputs.sensor is None:
        return np.zeros(1, dtype=np.bool_)
    finite, main = np.isfinite(found.value[:, :, component]), main_output(inputs.sensor, component)
    if main is None:
        return np.asarray(finite.any(axis=1))
    return np.asarray(finite[:, found.channels.index(main)] if main in found.channels else np.zeros(1, dtype=np.bool_))


def _describe_reason(inputs: Inputs, analysis: Analysis, component: int | None, lacking: BoolArray) -> str:
    """Return the reason why some lines (K,) have no result."""
    if inputs.outputs is not None and component is None:
        return "`excitation.direction` is not stated"
    if inputs.outputs is not None and inputs.body is None:
        return "[load] is not stated, so its mass is not known"
    load, reasons = analysis.load, list[str]()
    for moved in (a for a in analysis.accelerations if a.source == "fused" and (load is None or a.body == "load")):
        observed, titles = moved.observed[lacking], ", ".join(moved.instruments)
        if moved.disputed is not None and moved.disputed[lacking].any():
            reasons.append(f"the instruments of the {moved.body} ({titles}) contradict each other")
        elif component is None or not observed[:, component].all():
            names = [name for name, column in zip(MOTION_COMPONENTS, observed.T, strict=True) if column.all()]
            along = f"only {', '.join(names)}" if names else "no component"
            text = f"the readings of {titles} determine {along} of the {moved.body}"
            if not names:
                text += " (more points would separate translation and rotation)"
            stated = ", ".join(f"{number:g}" for number in inputs.direction or ())
            reasons.append(f"{text}, and excitation.direction is [{stated}]" if component is not None else text)
        elif load is not None and not load.observed[lacking, component].all():
            hidden = ", ".join(n for n, column in zip(MOTION_COMPONENTS, observed.T, strict=True) if not column.all())
            reasons.append(f"no instrument determines {hidden} of its motion, which may dominate the load")
    if inputs.outputs is not None and load is None:
        reasons = ["no instrument measures the motion of the load", *reasons]
    if not reasons and inputs.sensor is not None and component is not None:
        reasons = [f"its output {main_output(inputs.sensor, component) or ''} is not recorded, or has no value"]
    return "; ".join(reasons)
