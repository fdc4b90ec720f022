"""The path on one page: from a recording folder to the complex sensitivity."""

from __future__ import annotations

import time

from fusion.base import Crew, InputError, ProgressCallback, Settings, no_progress
from fusion.phasors.setup import measure_take, open_takes, referrals
from fusion.phasors.setups import join_takes
from fusion.phasors.stereo_phasors import all_rows, unseen_fundamentals
from fusion.recording.load import Manifest
from fusion.report.provenance import versions
from fusion.sensitivity.analyse import Analysis, Evaluation, Inputs, analyse
from fusion.sensitivity.monte_carlo import Known, propagate
from fusion.sensitivity.multipoint_vibrometer import PointSpread, point_spreads, with_ratios

EVALUATED_KINDS = ("sine", "multisine")


def evaluate_recording(
    manifest: Manifest,
    settings: Settings,
    input_hashes: dict[str, str],
    progress: ProgressCallback = no_progress,
    crew: Crew | None = None,
) -> Evaluation:
    """Evaluate one sinusoidal recording: files → phasors → acceleration of load and base → load → sensitivity.

    What was recorded in several takes is referred to the first before the instruments are fused. A `crew` follows the
    images, to the same digits.

    `input_hashes` (file → SHA-256) are carried into the result. Raises `InputError` for what the user can mend in the
    files, `ComputeError` for what these files do not allow.
    """
    started = time.monotonic()
    _check_kind(manifest)
    takes = open_takes(manifest)
    tied = referrals(takes) if len(takes) > 1 else ()
    joined = join_takes([measure_take(take, settings, progress, crew) for take in takes], tied)
    seen = all_rows(manifest, joined.readings, joined.pairs)
    unseen = unseen_fundamentals(seen, joined.lines, joined.folded)
    inputs = Inputs.of(manifest, joined.lines, seen, joined.readings)
    found = analyse(inputs)
    drawn = None
    if settings.monte_carlo:
        known = Known(inputs, joined.pairs, joined.readings)
        drawn = propagate(known, found, settings.monte_carlo, settings.seed, progress)
    told = [*joined.notices, *unseen, *found.notices, *(drawn.notices if drawn else ())]
    return Evaluation(
        manifest=manifest,
        lines=joined.lines,
        clocks=joined.clocks,
        channels=joined.channels,
        stereo=joined.stereo,
        accelerations=found.accelerations,
        load=found.load,
        outputs=found.outputs,
        sensitivity=found.sensitivity,
        notices=tuple(dict.fromkeys(told)),
        settings=settings.as_dict(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
        takes=joined.takes,
        points=_points(inputs, found),
        monte_carlo=drawn,
    )


def _points(inputs: Inputs, found: Analysis) -> tuple[PointSpread, ...]:
    """Return the spread of parallel vibrometer points, with the ratio of every point where their force was driven."""
    spreads = point_spreads(inputs.observations, found.accelerations)
    sensor, body, outputs, sensitivity = inputs.sensor, inputs.body, found.outputs, found.sensitivity
    if sensor is None or body is None or outputs is None or sensitivity is None:
        return spreads
    return tuple(with_ratios(spread, outputs, sensitivity, body, sensor.sense) for spread in spreads)


def _check_kind(manifest: Manifest) -> None:
    """Refuse recordings that this command does not evaluate."""
    kind = manifest.excitation.kind
    if kind not in EVALUATED_KINDS:
        commands = {"rotation": "rotate", "step": "step", **dict.fromkeys(("chirp", "noise", "impact"), "transfer")}
        command = commands.get(kind)
        other = "" if command is None else f" (shakercal {command} takes this one)"
        expected = f"{' or '.join(EVALUATED_KINDS)}, the kinds that shakercal run evaluates{other}"
        raise InputError(manifest.path, "excitation.kind", found=kind, expected=expected)
