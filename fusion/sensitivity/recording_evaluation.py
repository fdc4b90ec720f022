"""Evaluation of a recording: from its folder to the complex sensitivity."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fusion.base import CheckpointStore, Executor, ProgressCallback, Settings, no_progress, versions
from fusion.instruments.channel import sensor_outputs
from fusion.instruments.vibrometer import beam_notices, point_spreads
from fusion.phasors.frame_order import other_edges
from fusion.phasors.set_up import MeasuredSetUp, measure_set_ups, prepare_set_ups
from fusion.phasors.set_up_merging import join_set_ups
from fusion.phasors.stereo_phasors import unresolved_fundamentals
from fusion.phasors.timing import Sight
from fusion.recording.acknowledged import acknowledge
from fusion.recording.load import Manifest, find_single_recording, load_manifest
from fusion.recording.manifest import EdgeRuns
from fusion.sensitivity.analyse import Analysis, Evaluation, Inputs, analyse, elastic_rows, main_output
from fusion.sensitivity.disturbances import at_reference_temperature, not_assessed, unstated_chain, with_base_strain
from fusion.sensitivity.exact_inputs import exact_inputs_notice
from fusion.sensitivity.monte_carlo import propagate
from fusion.sensitivity.moving_body import load_body, with_measured_modes
from fusion.sensitivity.ratio import driven_component, with_ratios
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES
from fusion.sensitivity.supports import carried_by, without_supports
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shakercal._common.arrays import BoolArray
from shakercal._common.notices import Notice


def evaluate_recording(
    recording: Manifest | str | Path,
    settings: Settings | None = None,
    input_hashes: Mapping[str, str] | None = None,
    progress: ProgressCallback = no_progress,
    executor: Executor | None = None,
    checkpoints: CheckpointStore | None = None,
) -> Evaluation:
    """Evaluate one sinusoidal recording: files → phasors → acceleration → load → sensitivity.

    Sequential set-ups are referred to the first one before the instruments are fused.

    Parameters
    ----------
    recording : Manifest, str or Path
        Manifest, or folder of the recording.
    settings : Settings, optional
        Settings of the evaluation; default `Settings()`.
    input_hashes : mapping, optional
        File → SHA-256, copied into the result.
    progress : callable, optional
        Called with stage, step and number of steps.
    executor : Executor, optional
        Processes that track the images, with identical results; default threads of this process.
    checkpoints : CheckpointStore, optional
        Store of tracked blocks of frames, by which an interrupted evaluation continues.

    Returns
    -------
    Evaluation
        All results of the recording.

    Raises
    ------
    InputError
        If a file has a mistake that the user can correct.
    ComputeError
        If the files do not allow a result.

    Examples
    --------
    >>> from fusion import evaluate_recording
    >>> evaluation = evaluate_recording("sample_images/demo/Fz-0080")  # doctest: +SKIP
    >>> evaluation.sensitivity.value[:, 2, 2]  # Fz output per Fz load, line by line  # doctest: +SKIP
    """
    started, settings = time.monotonic(), settings or Settings()
    manifest = recording if isinstance(recording, Manifest) else load_manifest(find_single_recording(recording))
    manifest.check_command("run")
    set_ups = measure_set_ups(prepare_set_ups(manifest), settings, progress, executor, checkpoints)
    evaluation = evaluate_set_ups(manifest, set_ups, settings, progress)
    evaluation = replace(evaluation, notices=acknowledge(evaluation.notices, manifest.acknowledged))
    return replace(evaluation, input_hashes=dict(input_hashes or {}), duration_s=time.monotonic() - started)


def _sights(set_ups: Sequence[MeasuredSetUp]) -> dict[str, tuple[Sight, int | dict[str, EdgeRuns] | None]]:
    """Return the frames of each stereo pair, and their stated edges."""
    stated = {one.stereo: one.first_edge for set_up in set_ups for one in set_up.prepared.manifest.images}
    images = [one for set_up in set_ups for one in set_up.prepared.images]
    return {one.sight.name: (one.sight, stated[one.sight.name]) for one in images}


def evaluate_set_ups(
    manifest: Manifest, set_ups: Sequence[MeasuredSetUp], settings: Settings, progress: ProgressCallback = no_progress
) -> Evaluation:
    """Evaluate a recording from the phasors of its instruments: fusion, mass matrix, outputs over load."""
    joined = join_set_ups(set_ups)
    sensor, surroundings, body = manifest.rig.sensor, manifest.rig.surroundings, load_body(manifest.rig, manifest.part)
    observations = joined.observed(surroundings.free_fall_mps2[0])
    observations, supports, shaken = without_supports(observations, surroundings.support_motion)
    unobserved_lines = unresolved_fundamentals(observations, joined.lines, joined.aliased)
    body, measured = with_measured_modes(body, manifest.rig.load, joined.stereo)
    rows = observations if body is None else elastic_rows(observations, body.elastic)
    outputs = None if sensor is None else sensor_outputs(joined.readings, sensor.channels)
    if sensor is not None and outputs is not None:
        outputs = at_reference_temperature(with_base_strain(outputs, sensor, surroundings), sensor, surroundings)
    direction, limits = manifest.excitation.direction, manifest.shaker.unobserved_motion
    inputs = Inputs(joined.lines, rows, outputs, body, sensor, direction, limits)
    analysis = analyse(inputs)
    drawn = propagate(inputs, analysis, settings.monte_carlo, settings.seed, progress) if settings.monte_carlo else None
    points = point_spreads(observations, analysis.accelerations)
    if body is not None and analysis.outputs is not None and analysis.sensitivity is not None:
        points = tuple(with_ratios(spread, analysis.outputs, analysis.sensitivity, body) for spread in points)
    entries = [reading.entry for reading in joined.readings]
    lowest_hz = float(np.min(joined.lines.frequency_hz))
    missing = [*not_assessed(manifest.rig, observations, body, lowest_hz, carried_by(supports))]
    missing += exact_inputs_notice(manifest, entries)
    if sensor is not None and direction is not None:
        found, component = analysis.element or analysis.sensitivity, driven_component(direction, sensor.capacity)
        missing += unstated_chain(found, entries, component, signed=sensor.static_sensitivity is not None)
    notices = [
        *missing_result(inputs, analysis),
        *manifest.notices,
        *joined.notices,
        *other_edges(observations, _sights(set_ups)),
        *shaken,
        *beam_notices(entries),
    ]
    notices += [*unobserved_lines, *measured, *analysis.notices, *missing, *(drawn.notices if drawn else ())]
    return Evaluation(
        manifest=manifest,
        lines=joined.lines,
        clocks=joined.clocks,
        channels=joined.channels,
        stereo=joined.stereo,
        accelerations=analysis.accelerations,
        load=analysis.load,
        outputs=analysis.outputs,
        sensitivity=analysis.sensitivity,
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_dict(),
        versions=versions(),
        input_hashes={},
        set_ups=joined.set_ups,
        points=points,
        monte_carlo=drawn,
        element=analysis.element,
        supports=supports,
    )


# Whether a recording has its result, and the reason where it has none.


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
        fused = [a.observed for a in analysis.accelerations if a.source == "fused"]
        seen = np.any([np.zeros((len(driven), 6), np.bool_), *fused], axis=0)
        found = seen.any(axis=1) if component is None else seen[:, component]
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


def _with_sensitivity(inputs: Inputs, analysis: Analysis, component: int | None) -> BoolArray:
    """Return the lines at which the main output, or else any, has a sensitivity."""
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
