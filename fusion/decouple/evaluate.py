"""From releases of several loads to a model of all outputs and a filter against cross-talk."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from fusion.decouple.result import DecoupleEvaluation, DecoupleSettings
from fusion.errors import ComputeError, InputError
from fusion.load import LOAD_COMPONENTS
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.provenance import versions
from fusion.step.records import StepInput, read_step
from shaker._checks import FloatArray
from shaker.models.decoupling.crosstalk import Crosstalk, crosstalks, static_inverse
from shaker.models.decoupling.design import Recorded, Target, design_decoupling
from shaker.models.decoupling.excited import missing_loads
from shaker.models.decoupling.filter import DecouplingFilter
from shaker.models.decoupling.step_result import MultiFit
from shaker.models.decoupling.steps import fit_steps

DRAWS = 30
LINES = 150
FARTHEST = 1.5
"""Cross-talk is shown up to this multiple of the highest mode or of the target, whichever is higher."""
DEVIATES = 0.05


def evaluate_decoupling(
    name: str, manifests: Sequence[Manifest], settings: DecoupleSettings, input_hashes: dict[str, str]
) -> DecoupleEvaluation:
    """Return model, filter and cross-talk of one sensor: records of releases → fit → filter → before and after.

    Raises `InputError` for what the user can mend in the files, such as a load that no recording releases.
    """
    started = time.monotonic()
    inputs = _read(manifests)
    fit = _fitted(manifests, inputs)
    target = _target(fit, settings)
    decoupler = _designed(fit, target)
    frequency_hz = _lines(fit, target)
    stages = crosstalks(fit.model, decoupler, fit.noise, frequency_hz, np.random.default_rng(settings.seed), DRAWS)
    capacity = _capacity(manifests[0], fit.model.components)
    deviation = _deviation(decoupler, stages[-1], capacity)
    static = np.sqrt(static_inverse(fit.model, fit.noise) ** 2 @ fit.noise**2)
    noise = decoupler.noise(fit.noise)
    notices = [notice for item in inputs for notice in item.notices]
    notices += [*fit.notices, *_notices(fit, target, deviation, frequency_hz, capacity)]
    return DecoupleEvaluation(
        name=name,
        manifests=tuple(manifests),
        fit=fit,
        decoupler=decoupler,
        stages=stages,
        capacity=capacity,
        noise=noise,
        noise_gain=noise / static,
        deviation=deviation,
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_dict(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _read(manifests: Sequence[Manifest]) -> list[StepInput]:
    """All records, of one rig, with the same outputs at one rate, and of every load that the sensor measures."""
    first = manifests[0]
    for manifest in manifests:
        if manifest.rig_path.resolve() != first.rig_path.resolve():
            expected = f"{first.rig_path}, the rig of {first.folder.name}"
            raise InputError(manifest.path, "rig", found=str(manifest.rig_path), expected=expected)
    inputs = [read_step(manifest) for manifest in manifests]
    record = inputs[0].record
    for item in inputs[1:]:
        for key in ("channels", "unit", "sample_rate_hz"):
            found, expected = getattr(item.record, key), getattr(record, key)
            if found != expected:
                told = f"{expected} as in {first.folder.name}"
                raise InputError(item.manifest.path, f"daq.channel ({key})", found=str(found), expected=told)
    missing = missing_loads(record.channels, [item.record.component for item in inputs], _static(first))
    if missing:
        expected = f"a release of every load that the sensor measures; missing: {', '.join(missing)}"
        found = ", ".join(dict.fromkeys(item.record.component for item in inputs))
        raise InputError(first.rig_path.parent, "excitation.component", found=found, expected=expected)
    return inputs


def _static(manifest: Manifest) -> FloatArray | None:
    """The stated static sensitivities (C, 6), None where there are none."""
    sensor = manifest.rig.sensor
    if sensor is None or sensor.static_sensitivity is None:
        return None
    return np.asarray(sensor.static_sensitivity, dtype=np.float64)


def _fitted(manifests: Sequence[Manifest], inputs: Sequence[StepInput]) -> MultiFit:
    """The model; what the loads do not tell apart is a matter of the files."""
    try:
        return fit_steps([item.record for item in inputs])
    except ValueError as error:
        text = str(error)
        if text.startswith(("channels:", "components:")):
            key, _, rest = text.partition(": ")
            expected, _, found = rest.removeprefix("expected ").partition(", found ")
            raise InputError(manifests[0].rig_path.parent, key, found=found, expected=expected) from error
        raise ComputeError(f"no model of the releases was found: {text}") from error


def _target(fit: MultiFit, settings: DecoupleSettings) -> Target:
    """The wanted dynamics, alike for all loads."""
    count = len(fit.model.components)
    wanted = 0.5 * float(fit.model.frequency_hz.min()) if settings.frequency_hz is None else settings.frequency_hz
    if wanted >= 0.25 * fit.sample_rate_hz:
        raise ComputeError(
            f"wanted frequency {wanted:g} Hz: expected below a quarter of the sampling rate, {fit.sample_rate_hz:g} Hz"
        )
    return Target(np.full(count, wanted), np.full(count, settings.damping_ratio))


def _designed(fit: MultiFit, target: Target) -> DecouplingFilter:
    """The filter for the noise of the records and loads of the size of the releases."""
    try:
        return design_decoupling(fit.model, target, Recorded(fit.sample_rate_hz, fit.noise, fit.amplitude))
    except (ValueError, np.linalg.LinAlgError) as error:
        raise ComputeError(f"no filter was found: {error}") from error


def _lines(fit: MultiFit, target: Target) -> FloatArray:
    """Frequencies in Hz, evenly spaced on a logarithmic scale, and those of the modes."""
    highest = max(float(fit.model.frequency_hz.max()), float(target.frequency_hz.max()))
    top = min(FARTHEST * highest, 0.45 * fit.sample_rate_hz)
    low = float(fit.model.frequency_hz.min()) / 100.0
    spaced = np.geomspace(low, top, LINES)
    return np.unique(np.concatenate([spaced, fit.model.frequency_hz]))


def _capacity(manifest: Manifest, components: Sequence[str]) -> FloatArray | None:
    """Rated loads of the components, None where they are not stated for all."""
    sensor = manifest.rig.sensor
    if sensor is None or sensor.capacity is None:
        return None
    stated = dict(zip(LOAD_COMPONENTS, np.asarray(sensor.capacity, dtype=np.float64), strict=False))
    found = np.array([stated.get(component, 0.0) for component in components])
    return found if np.all(found > 0) else None


def _deviation(decoupler: DecouplingFilter, filtered: Crosstalk, capacity: FloatArray | None) -> FloatArray:
    """Largest |D·H - T| at every frequency, in rated loads; without them of the loads with themselves."""
    wanted = decoupler.target(filtered.frequency_hz)[:, :, None] * np.eye(len(filtered.components))
    difference = np.abs(filtered.value - wanted)
    if capacity is None:
        return np.asarray(np.einsum("kii->ki", difference).max(axis=1))
    return np.asarray(filtered.rated(capacity, difference).max(axis=(1, 2)))


def _notices(
    fit: MultiFit, target: Target, deviation: FloatArray, frequency_hz: FloatArray, capacity: FloatArray | None
) -> list[Notice]:
    """What the user should know of target and comparison."""
    found = []
    within = frequency_hz <= target.frequency_hz.max()
    if deviation[within].max() > DEVIATES:
        place = frequency_hz[within][deviation[within] > DEVIATES][0]
        text = (
            f"from {place:.0f} Hz on loads and wanted dynamics differ by more than {100 * DEVIATES:g} %: the outputs "
            "tell too little there over their noise; a lower frequency is within reach"
        )
        found.append(Notice("warning", text, "filter"))
    if capacity is None:
        text = "no rated loads (sensor.capacity): cross-talk between forces and moments is not compared"
        found.append(Notice("info", text, "sensor.capacity"))
    unknown = [c for c, u in zip(fit.model.components, fit.u_amplitude, strict=True) if u == 0.0]
    if unknown:
        text = f"released loads of {', '.join(unknown)} count as exact: U holds noise and fit"
        found.append(Notice("info", text, "excitation.step_amplitude"))
    return found
