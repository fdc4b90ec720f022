"""Evaluation of dynamic cross-talk of several outputs, and the decoupling filter."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import ComputeError, InputError
from fusion.recording.load import Manifest, check_one_rig
from fusion.sensor import model_notices as declared
from fusion.sensor.model_files import model_file_text, pairs, read_model_file
from fusion.sensor.step.step_records import StepInput, read_step
from fusion.sensor.unmodelled_effects import ModelInfluences, coverage_notice, stated_influences
from shaker.decoupling.common_pole_fit import MultiFit, fit_steps
from shaker.decoupling.filter import (
    Crosstalk,
    DecouplingFilter,
    DecouplingTarget,
    SignalLevels,
    crosstalks,
    design_decoupling,
    static_inverse,
)
from shaker.decoupling.model import MultiModel, missing_loads
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

# Choices of a decoupling, and parts of its evaluation.


@dataclass(frozen=True)
class DecoupleSettings:
    """Choices of a decoupling filter.

    Attributes
    ----------
    frequency_hz : target frequency of the loads behind the filter in Hz; None: half that of the lowest mode.
    damping_ratio : target damping ratio. Default 0.6.
    seed : seed of the random draws. Default 1.

    Examples
    --------
    >>> from fusion import DecoupleSettings
    >>> DecoupleSettings(frequency_hz=400.0).damping_ratio
    0.6
    """

    frequency_hz: float | None = None
    damping_ratio: float = 0.6
    seed: int = 1

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        target = "half that of the lowest mode" if self.frequency_hz is None else self.frequency_hz
        return {"frequency_hz": target, "damping_ratio": self.damping_ratio, "seed": self.seed}


@dataclass(frozen=True)
class DecoupleEvaluation(CommandEvaluation):
    """Model of all outputs, decoupling filter, and cross-talk at every stage.

    Attributes
    ----------
    capacity : (D,), rated loads of the model's components, None if not stated.
    noise_gain : (D,), noise of each load behind the filter over that with the static matrix.
    noise : (D,), noise behind the filter in N or N·m.
    influences : influences on the model that the records do not show, included in its covariance.
    deviation : (K,), largest |D·H - T| over all elements, in rated loads, at the frequencies of the cross-talk.
    """

    manifests: tuple[Manifest, ...]
    fit: MultiFit
    influences: ModelInfluences
    decoupler: DecouplingFilter
    stages: tuple[Crosstalk, ...]
    capacity: FloatArray | None
    noise: FloatArray
    noise_gain: FloatArray
    deviation: FloatArray

    @property
    def frequency_hz(self) -> FloatArray:
        """Return the frequencies (K,) of the cross-talk."""
        return self.stages[0].frequency_hz

    @property
    def scale(self) -> FloatArray:
        """Return the reference of loads (D,): rated loads, otherwise 1 N and 1 N·m."""
        return np.ones(len(self.fit.model.components)) if self.capacity is None else self.capacity

    @property
    def ratio(self) -> FloatArray:
        """Factors (D, D) from readings over loads to rated loads; NaN if not comparable."""
        kind = np.array([name[0] for name in self.fit.model.components])
        different = (self.capacity is None) & (kind[:, None] != kind)
        return np.where(different, np.nan, self.scale / self.scale[:, None])


# From releases of several loads to a model of all outputs and a filter against cross-talk.

DRAWS = 30  # Monte Carlo draws of the peak cross-talk in a step
LINES = 150  # frequencies of the cross-talk, in addition to the modes
FREQUENCY_MARGIN = 1.5
"""Cross-talk is shown up to this multiple of the highest mode or of the target, whichever is higher."""
MAX_DEVIATION = 0.05


def evaluate_decoupling(
    name: str, manifests: Sequence[Manifest], settings: DecoupleSettings, input_hashes: dict[str, str]
) -> DecoupleEvaluation:
    """Design the decoupling filter of one sensor: releases → model → filter → cross-talk.

    Parameters
    ----------
    name
        Name of the evaluation in the results.
    manifests
        Recordings of kind step that release every load the sensor measures.
    settings
        Target dynamics and seed.
    input_hashes
        SHA-256 of the input files by name, for the results.

    Returns
    -------
    DecoupleEvaluation : model, filter, and cross-talk at every stage.

    Raises
    ------
    InputError : a file or key that the user has to correct, such as a load that no recording releases.
    ComputeError : no model or no filter was found.

    Examples
    --------
    >>> from fusion import DecoupleSettings, evaluate_decoupling, load_for_command
    >>> releases = load_for_command(["steps"], "step")  # doctest: +SKIP
    >>> evaluation = evaluate_decoupling("steps", releases, DecoupleSettings(), {})  # doctest: +SKIP
    """
    started = time.monotonic()
    inputs = _read(manifests)
    try:
        fit = fit_steps([item.record for item in inputs])
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise _unexplained(error, manifests[0]) from error
    mountings = [manifest.mounting for manifest in manifests]
    influences = stated_influences(manifests[0].rig, mountings, mounting_scatter=False)
    fit = replace(fit, model=influences.on_outputs(fit.model))
    target = _target(fit, settings)
    modes_hz = fit.model.frequency_hz
    highest = max(float(modes_hz.max()), float(target.frequency_hz.max()))
    top_hz = min(FREQUENCY_MARGIN * highest, 0.45 * fit.sample_rate_hz)
    spaced = np.geomspace(float(modes_hz.min()) / 100.0, top_hz, LINES)
    frequency_hz = np.unique(np.concatenate([spaced, modes_hz]))
    try:
        decoupler = design_decoupling(fit.model, target, SignalLevels(fit.sample_rate_hz, fit.noise, fit.amplitude))
        stages = crosstalks(fit.model, decoupler, fit.noise, frequency_hz, np.random.default_rng(settings.seed), DRAWS)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise ComputeError(declared.NO_DECOUPLING_FILTER, reason=str(error)) from error
    sensor, names = manifests[0].rig.sensor, fit.model.components
    stated = (None if sensor is None else sensor.capacity) or (0.0,) * len(LOAD_COMPONENTS)
    rated = np.array([stated[LOAD_COMPONENTS.index(name)] for name in names])
    capacity = rated if np.all(rated > 0) else None
    difference = np.abs(stages[-1].value - decoupler.target(frequency_hz)[:, :, None] * np.eye(len(names)))
    if capacity is None:  # loads with themselves alone
        deviation = np.einsum("kii->ki", difference).max(axis=1)
    else:
        deviation = (difference * (capacity / capacity[:, None])).max(axis=(1, 2))
    static = np.sqrt(static_inverse(fit.model, fit.noise) ** 2 @ fit.noise**2)
    noise = decoupler.noise(fit.noise)
    notices = [notice for item in inputs for notice in item.notices]
    notices.append(coverage_notice(influences.scope, influences.outside, "models"))
    notices += [*fit.notices, *_notices(fit, target, deviation, frequency_hz, capacity)]
    return DecoupleEvaluation(
        name=name,
        manifests=tuple(manifests),
        fit=fit,
        influences=influences,
        decoupler=decoupler,
        stages=stages,
        capacity=capacity,
        noise=noise,
        noise_gain=noise / static,
        deviation=deviation,
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_dict(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _read(manifests: Sequence[Manifest]) -> list[StepInput]:
    """Return all records, with the same outputs at one rate, and releases of every load."""
    first = manifests[0]
    check_one_rig(manifests)
    inputs = [read_step(manifest) for manifest in manifests]
    record = inputs[0].record
    for item in inputs[1:]:
        for key in ("channels", "unit", "sample_rate_hz"):
            found, expected = getattr(item.record, key), getattr(record, key)
            if found != expected:
                path, where, name = item.manifest.path, f"daq.channel ({key})", first.folder.name
                raise InputError(
                    declared.DIFFERENT_RECORDS, path, where, expected=str(expected), recording=name, found=str(found)
                )
    stated = None if first.rig.sensor is None else first.rig.sensor.static_sensitivity
    static = None if stated is None else np.asarray(stated, dtype=np.float64)
    released = list(dict.fromkeys(item.record.component for item in inputs))
    missing = missing_loads(record.channels, released, static)
    if missing:
        folder, found = first.rig_path.parent, ", ".join(released)
        raise InputError(
            declared.MISSING_RELEASES, folder, "excitation.component", missing=", ".join(missing), found=found
        )
    return inputs


def _unexplained(error: Exception, manifest: Manifest) -> InputError | ComputeError:
    """Return the error of a fit; inseparable loads are an error of the files."""
    key = str(error).partition(": ")[0]
    if key not in ("channels", "components"):
        return ComputeError(declared.NO_COMMON_MODEL, reason=str(error))
    return InputError.from_exception(error, manifest.rig_path.parent, key, declared.LOADS_NOT_SEPARABLE)


def _target(fit: MultiFit, settings: DecoupleSettings) -> DecouplingTarget:
    """Return the target dynamics, equal for all loads."""
    count = len(fit.model.components)
    target_hz = 0.5 * float(fit.model.frequency_hz.min()) if settings.frequency_hz is None else settings.frequency_hz
    if target_hz >= 0.25 * fit.sample_rate_hz:
        raise ComputeError(declared.TARGET_ABOVE_LIMIT, rate_hz=fit.sample_rate_hz, frequency_hz=target_hz)
    return DecouplingTarget(np.full(count, target_hz), np.full(count, settings.damping_ratio))


def _notices(
    fit: MultiFit,
    target: DecouplingTarget,
    deviation: FloatArray,
    frequency_hz: FloatArray,
    capacity: FloatArray | None,
) -> list[Notice]:
    """Return the notices of target and comparison."""
    found = []
    within = frequency_hz <= target.frequency_hz.max()
    if deviation[within].max() > MAX_DEVIATION:
        first_hz = float(frequency_hz[within][deviation[within] > MAX_DEVIATION][0])
        limit = 100 * MAX_DEVIATION
        found.append(Notice(declared.TARGET_NOT_REACHED, "filter", frequency_hz=first_hz, limit_percent=limit))
    if capacity is None:
        found.append(Notice(declared.NO_RATED_LOADS, "sensor.capacity"))
    exact = [c for c, u in zip(fit.model.components, fit.u_amplitude, strict=True) if u == 0.0]
    if exact:
        found.append(Notice(declared.RELEASED_LOADS_EXACT, "excitation.step_amplitude", components=", ".join(exact)))
    return found


# decoupling.json: the filter with its model, at full precision.

FILTER_FILE = "decoupling.json"
KIND = "shakercal decoupling"
RECURSION = (
    "f[n] = sum_k taps[k] y[n-k] + Re sum_i shown[:,i] x_i[n-L]; x_i[n+1] = poles[i] x_i[n] + driven[i] y[n]; "
    "L = len(taps)-1; complex numbers as [re, im]"
)


def filter_text(decoupler: DecouplingFilter, model: MultiModel) -> str:
    """Return the text of decoupling.json, with the model and its standard uncertainties."""
    names = ("frequency_hz", "damping_ratio", "real_hz", "real_residue")
    parameters = {**{name: getattr(model, name).tolist() for name in names}, "residue": pairs(model.residue)}
    u: dict[str, Any] = {}
    if model.covariance is not None:
        u = {f"u_{name}": getattr(model.u, name).tolist() for name in names[:3]}
        u |= {"u_residue": pairs(model.u.residue), "u_real_residue": model.u.real_residue.tolist()}
    content = {
        "kind": KIND,
        "recursion": RECURSION,
        "channels": list(decoupler.channels),
        "components": list(decoupler.components),
        "unit": decoupler.unit,
        "sample_rate_hz": decoupler.sample_rate_hz,
        "delay_samples": decoupler.delay,
        "target": {"frequency_hz": decoupler.target_hz.tolist(), "damping_ratio": decoupler.target_damping.tolist()},
        "taps": decoupler.taps.tolist(),
        **{name: pairs(getattr(decoupler, name)) for name in ("poles", "driven", "shown")},
        "model": {**parameters, **u},
    }
    return model_file_text(content, indent=1, allow_nan=True)


def read_decoupling_filter(path: str | Path) -> DecouplingFilter:
    """Read the decoupling filter of decoupling.json without loss of precision.

    Parameters
    ----------
    path
        The file, or a folder that contains it.

    Returns
    -------
    DecouplingFilter : the filter.

    Raises
    ------
    InputError : the file is missing, or damaged at the named entry.

    Examples
    --------
    >>> from fusion import read_decoupling_filter
    >>> decoupler = read_decoupling_filter("my-steps/decouple/decoupling.json")  # doctest: +SKIP
    """

    def parsed(content: dict[str, Any]) -> DecouplingFilter:
        if content["kind"] != KIND:
            raise ValueError(f"kind {content['kind']!r}")
        target = {name: np.array(value, dtype=np.float64) for name, value in content["target"].items()}
        return DecouplingFilter(
            channels=tuple(content["channels"]),
            components=tuple(content["components"]),
            unit=content["unit"],
            sample_rate_hz=float(content["sample_rate_hz"]),
            taps=np.array(content["taps"], dtype=np.float64),
            **{name: _complex(content[name]) for name in ("poles", "driven", "shown")},
            target_hz=target["frequency_hz"],
            target_damping=target["damping_ratio"],
        )

    return read_model_file(Path(path), FILTER_FILE, "decouple", parsed, "filters")


def _complex(pairs: Any) -> ComplexArray:
    """Return the complex numbers of [re, im]."""
    both = np.array(pairs, dtype=np.float64)
    return np.asarray(both[..., 0] + 1j * both[..., 1])
