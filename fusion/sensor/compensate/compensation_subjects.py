"""Models and settings of a compensation, and its results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import InputError
from fusion.estimation.coverage import coverage_factor
from fusion.recording.values import repeated_name
from fusion.sensor import model_notices as declared
from fusion.sensor.model_files import (
    LOAD_MODEL_FILE,
    MODELS_FILE,
    UncertaintyBasis,
    read_loads,
    read_model_file,
    read_models,
)
from fusion.sensor.step.step_pool import effective_dof
from shaker.compensation.effects import target_for_bandwidth, target_for_frequency
from shaker.compensation.filter import (
    Compensation,
    CompensationTarget,
    Discretisation,
    Sections,
    SensorDynamics,
    loaded_dynamics,
    modal_dynamics,
    single_mode,
)
from shaker.labels import load_unit, mechanical_units
from shaker.lti.indices import Indices
from shaker.lti.system import ModalModel
from shaker.release.load_model import LoadModel
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text, typeset
from shakercal._common.notices import Notice

# Settings of a compensation.

COMMAND = "shakercal compensate"
UNSTATED_BASIS = UncertaintyBasis(scope="")
MAX_DOF = 1e6
"""Degrees of freedom above which the scatter is rounding only."""
OPTIONS = {
    "modes": "--modes",
    "frequency_hz": "--frequency",
    "damping_ratio": "--damping",
    "bandwidth_hz": "--bandwidth",
    "permitted_error": "--permitted-error",
    "real_hz": "--real-pole",
    "low_pass_hz": "--low-pass",
    "load_mass": "--load-mass",
    "sample_rate_hz": "--sample-rate",
}
"""Options of the command by the arguments that the design may refuse."""
STATED = "sensor"
"""Channel of a sensor that is stated by numbers."""


def wrong_option(found: str, expected: str, option: str = "") -> InputError:
    """Return the refusal of an option of the command."""
    return InputError(declared.WRONG_COMPENSATION_OPTION, COMMAND, option, found=found, expected=expected)


@dataclass(frozen=True)
class CompensationSettings:
    """Target dynamics and options of compensation filters.

    Attributes
    ----------
    frequency_hz, damping_ratio : target; without `damping_ratio` that with the widest band for `permitted_error`.
    bandwidth_hz : alternatively, the band within which the gain stays within ± `permitted_error` of the static gain.
    permitted_error : ratio. Default 0.1.
    real_hz : target of the real poles; None (default) leaves them.
    low_pass_hz : corner of a low-pass in the filter; None (default) for none.
    modes : number of compensated modes. Default 1.
    sample_rate_hz : None (default) uses that of the recording or of the model.
    discretisation : "matched" (default) or "tustin".
    calibrated : whether the filter also divides by the static gain.
    load_masses : kg, of a sensor with a load model.
    channels : selected channels, empty for all.
    ball_stiffness : stiffness of the virtual ball of a force-feedback check, N/m; None (default) for no check.
    """

    frequency_hz: float | None = None
    damping_ratio: float | None = None
    bandwidth_hz: float | None = None
    permitted_error: float = 0.1
    real_hz: float | None = None
    low_pass_hz: float | None = None
    modes: int = 1
    sample_rate_hz: float | None = None
    discretisation: Discretisation = "matched"
    calibrated: bool = False
    load_masses: tuple[float, ...] = ()
    channels: tuple[str, ...] = ()
    ball_stiffness: float | None = None

    def __post_init__(self) -> None:
        if (self.frequency_hz is None) == (self.bandwidth_hz is None):
            raise wrong_option("none" if self.frequency_hz is None else "both", "either --frequency or --bandwidth")
        if self.bandwidth_hz is not None and self.damping_ratio is not None:
            expected = "no --damping together with --bandwidth, which determines it"
            raise wrong_option(number_text(self.damping_ratio, 6), expected, "--damping")
        if not 0 < self.permitted_error < 1:
            expected = "a permitted error above 0 and below 100 %"
            raise wrong_option(f"{number_text(100 * self.permitted_error, 6)} %", expected, "--permitted-error")

    def target(self, sensor: SensorDynamics) -> CompensationTarget:
        """Return the target for a sensor."""
        more = (self.permitted_error, self.real_hz, self.low_pass_hz)
        if self.bandwidth_hz is not None:
            return target_for_bandwidth(sensor, self.bandwidth_hz, *more)
        frequency = float(self.frequency_hz or 0.0)
        if self.damping_ratio is None:
            return target_for_frequency(sensor, frequency, *more)
        return CompensationTarget(frequency, self.damping_ratio, self.real_hz, self.low_pass_hz)

    @property
    def settings(self) -> dict[str, str | float | int]:
        """The settings for the results."""
        lists = {"load_masses_kg": ", ".join(f"{mass:.12g}" for mass in self.load_masses)}
        lists["channels"] = ", ".join(self.channels)
        stated = {**vars(self), "calibrated": int(self.calibrated), "load_masses": None, **lists}
        return {name: value for name, value in stated.items() if value not in (None, "")}


# Subjects: models of step responses, models over the load, or a frequency and a damping ratio.


@dataclass(frozen=True)
class CompensationSubject:
    """An output channel for a load component (Fx … Mz) with its model.

    Attributes
    ----------
    component : empty of a stated sensor.
    model : fitted to releases, over the load, or stated.
    source : origin of the model, in words.
    sample_rate_hz, noise : rate of the records, and standard deviation of the output at it; None if not known.
    basis : basis of the model's U.
    scatter : (P, P), part of the covariance with the degrees of freedom of the basis; None: all of it.
    file : file of the model, None of a stated sensor.
    """

    channel: str
    component: str
    unit: str
    model: ModalModel | LoadModel | SensorDynamics
    source: str
    sample_rate_hz: float | None = None
    noise: float | None = None
    basis: UncertaintyBasis = UNSTATED_BASIS
    scatter: FloatArray | None = None
    file: Path | None = None

    @property
    def scope(self) -> str:
        """The use that U of the model covers, in words."""
        return self.basis.scope

    @property
    def name(self) -> str:
        """Channel, with the component if it differs."""
        return self.channel if self.component in (self.channel, "") else f"{self.channel} for {self.component}"

    @property
    def load_unit(self) -> str:
        """Unit of the load."""
        return load_unit(self.component) if self.component else "1"

    @property
    def is_scheduled(self) -> bool:
        """Whether the filter depends on the load."""
        return isinstance(self.model, LoadModel)

    def load_text(self, load: float) -> str:
        """Return a load in g, of a moment in kg·m²."""
        if self.load_unit == "N":
            return f"{number_text(1e3 * load, 4)} g"
        return f"{number_text(load, 4)} {typeset(mechanical_units(self.component).inertia)}"

    @property
    def scatter_covariance(self) -> FloatArray | None:
        """Part of the model's covariance (P, P) by the scatter of records, None without scatter."""
        if isinstance(self.model, SensorDynamics) or not np.isfinite(self.basis.dof):
            return None
        whole = self.model.total_covariance if isinstance(self.model, LoadModel) else self.model.covariance
        return whole if self.scatter is None else self.scatter

    def factors(self, u: FloatArray, u_scatter: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return degrees of freedom and k (95 %) of u (Q,), `u_scatter` of it scatter."""
        from scipy.special import stdtrit

        if not np.isfinite(self.basis.dof):
            return np.full(u.shape, np.inf), np.full(u.shape, coverage_factor(np.inf))
        dof = effective_dof(u**2, np.minimum(u, u_scatter) ** 2, self.basis.dof)
        dof = np.where(dof < MAX_DOF, dof, np.inf)
        return dof, np.asarray(np.where(dof < MAX_DOF, stdtrit(dof, 0.975), coverage_factor(np.inf)))

    def dynamics(self, load_mass: float | None, modes: int, real_poles: bool) -> SensorDynamics:
        """Return the dynamics of the sensor with a load, which a filter cancels."""
        if isinstance(self.model, LoadModel):
            made = loaded_dynamics(self.model, load_mass or 0.0, modes=modes)
            return replace(made, scatter=made.covariance if np.isfinite(self.basis.dof) else None)
        if isinstance(self.model, ModalModel):
            made, scatter = modal_dynamics(self.model, modes=modes, real_poles=real_poles), self.scatter_covariance
            if scatter is None:
                return made
            part = modal_dynamics(replace(self.model, covariance=scatter), modes=modes, real_poles=real_poles)
            return replace(made, scatter=part.covariance)
        if modes != 1:
            raise ValueError(f"modes: expected 1 of a sensor stated by frequency and damping, found {modes}")
        return self.model


@dataclass(frozen=True)
class CompensationSources:
    """All models with their files and notices."""

    name: str
    subjects: tuple[CompensationSubject, ...]
    files: tuple[Path, ...]
    notices: tuple[Notice, ...] = ()


def read_sources(paths: Sequence[Path]) -> CompensationSources:
    """Read models.json or load.json; of a folder with both, load.json."""
    sources = [_read(path) for path in paths]
    subjects = tuple(subject for one in sources for subject in one.subjects)
    twice = repeated_name([subject.name for subject in subjects])
    if twice is not None:
        raise InputError(declared.DUPLICATE_MODEL, paths[-1], channel=twice)
    files, notices = (sum((getattr(one, name) for one in sources), ()) for name in ("files", "notices"))
    return CompensationSources(sources[0].name, subjects, files, notices)


def stated_sensor(frequency_hz: float, damping_ratio: float) -> CompensationSources:
    """Return a sensor of one mode that is stated by numbers."""
    if not damping_ratio < 1.0:
        expected = "a damping ratio below 1, of a sensor that oscillates"
        raise wrong_option(number_text(damping_ratio, 6), expected, "--sensor-damping")
    source = f"stated: {number_text(frequency_hz, 6)} Hz, ζ = {number_text(damping_ratio, 6)}"
    subject = CompensationSubject(STATED, "", "1", single_mode(frequency_hz, damping_ratio), source)
    return CompensationSources("stated sensor", (subject,), ())


def select_subjects(sources: CompensationSources, channels: Sequence[str]) -> tuple[CompensationSubject, ...]:
    """Return the subjects of some channels, or all; `InputError` for an unknown channel."""
    available = [subject.channel for subject in sources.subjects]
    for name in channels:
        if name not in available:
            raise wrong_option(name, f"one of {', '.join(dict.fromkeys(available))}", "--channel")
    return tuple(subject for subject in sources.subjects if not channels or subject.channel in channels)


def _read(path: Path) -> CompensationSources:
    """Return the subjects of one file or folder."""
    offered = [path / LOAD_MODEL_FILE, path / MODELS_FILE] if path.is_dir() else [path]
    file = next((one for one in offered if one.is_file()), path)
    if file.is_dir():
        expected = f"{MODELS_FILE} of shakercal step or {LOAD_MODEL_FILE} of shakercal load in it"
        raise InputError(declared.NO_MODEL_FILE, path, expected=expected)

    def over_loads(content: dict[str, Any]) -> bool:
        return bool(content["models"]) and "moving_mass" in content["models"][0]

    return _of_loads(file) if read_model_file(file, "", "step or load", over_loads) else _of_steps(file)


def _of_steps(file: Path) -> CompensationSources:
    """Return one subject per channel: for the component of its name, else the largest gain."""
    models = read_models(file)
    if not models.entries:
        raise InputError(declared.NO_MODEL_FILE, file, "models", expected="at least one model")
    subjects = []
    for channel in dict.fromkeys(entry.channel for entry in models):
        offered = [entry for entry in models if entry.channel == channel]
        one = max(offered, key=lambda entry: (entry.component == entry.channel, abs(entry.model.static_gain)))
        source = f"{one.method}, {one.recording}"
        basis = UncertaintyBasis(one.dof, one.scope or UncertaintyBasis().scope, one.outside)
        values = one.sample_rate_hz, one.noise, basis, one.scatter
        subjects.append(CompensationSubject(channel, one.component, one.unit, one.model, source, *values, file))
    return CompensationSources(models.name, tuple(subjects), (file,))


def _of_loads(file: Path) -> CompensationSources:
    """Return one subject per component, of several solutions the first, with a notice."""
    subjects, notices = [], []
    for model, basis in read_loads(file):
        if model.solution > 1:
            continue
        if model.solutions > 1:
            notices.append(Notice(declared.EQUIVALENT_SOLUTIONS, model.channel, count=model.solutions))
        source = "two masses" if model.is_rigid else "three masses"
        subject = CompensationSubject(model.channel, model.component, model.unit, model, source, basis=basis, file=file)
        if model.load_masses:
            loads = ", ".join(subject.load_text(load) for load in model.load_masses)
            subject = replace(subject, source=f"{source}, fitted to loads of {loads}")
        subjects.append(subject)
    return CompensationSources(file.parent.resolve().name, tuple(subjects), (file,), tuple(notices))


# Parts of a compensation.


@dataclass(frozen=True)
class IndexEstimates:
    """Indices of a system with u and degrees of freedom by name.

    u is None if not known. `notices`: indices for which first order is not sufficient.
    """

    indices: Indices
    u: dict[str, float | None]
    dof: dict[str, float]
    notices: tuple[Notice, ...] = ()

    def expanded(self, name: str) -> float | None:
        """Return U (95 %) of an index, None if not known."""
        u = self.u[name]
        return None if u is None else coverage_factor(self.dof[name]) * u


@dataclass(frozen=True)
class LoadFilter:
    """The filter of a `subject` with one load, continuous and sampled, with its effects.

    Attributes
    ----------
    load_mass : kg, None without a load model.
    noise_gain : gain for white noise at the sampling rate.
    noise : standard deviation after the filter in its output unit, None if that of the output is not known.
    discretisation_error : largest |G_d/G_c - 1| up to `band_hz`.
    off_frequency, off_ringing : (K,), relative error of the sensor's frequency, and residual ringing with it.
    off_load, load_ringing : (L,), other loads in kg, and residual ringing with them; empty without a load model.
    after_s : time after the step from which ringing is evaluated.
    """

    subject: CompensationSubject
    load_mass: float | None
    compensation: Compensation
    sections: Sections
    before: IndexEstimates
    after: IndexEstimates
    noise_gain: float
    noise: float | None
    band_hz: float
    discretisation_error: float
    after_s: float
    off_frequency: FloatArray
    off_ringing: FloatArray
    off_load: FloatArray
    load_ringing: FloatArray

    @property
    def name(self) -> str:
        """Channel and load."""
        load = "" if self.load_mass is None else f", load {self.subject.load_text(self.load_mass)}"
        return f"{self.subject.name}{load}"

    @property
    def sensor_dof(self) -> FloatArray:
        """Degrees of freedom (P,) of the standard uncertainties of the cancelled dynamics."""
        sensor = self.compensation.sensor
        part = np.zeros_like(sensor.u) if sensor.scatter is None else np.sqrt(np.diag(sensor.scatter))
        return self.subject.factors(sensor.u, part)[0]

    @property
    def output_unit(self) -> str:
        """Unit of the filter's output: that of the load if it is calibrated."""
        return self.subject.load_unit if self.compensation.calibrated else self.subject.unit

    @property
    def noise_factor(self) -> float:
        """Standard deviation of white noise behind the filter over that before, at static gain 1."""
        return self.noise_gain / abs(self.sections.gain)


@dataclass(frozen=True)
class SubjectResult:
    """The filters of one channel, one per load."""

    subject: CompensationSubject
    filters: tuple[LoadFilter, ...]


@dataclass(frozen=True)
class CompensatedChannel:
    """A channel of a recording after its filter: `value` with u (N,).

    `u_noise` is the part of u by noise. `raw` (N,): before the filter, times its static gain. `k` (N,): coverage
    factors (95 %).
    """

    channel: str
    unit: str
    raw: FloatArray
    value: FloatArray
    u: FloatArray
    u_noise: float
    k: FloatArray

    @property
    def expanded(self) -> FloatArray:
        """Expanded uncertainty U (N,) for 95 %."""
        return np.asarray(self.k * self.u)


@dataclass(frozen=True)
class CompensatedRecording:
    """The compensated channels of a recording at `start_s` + n/`sample_rate_hz`."""

    name: str
    sample_rate_hz: float
    start_s: float
    channels: tuple[CompensatedChannel, ...]

    @property
    def time_s(self) -> FloatArray:
        """Time of every sample (N,) in s."""
        return np.asarray(self.start_s + np.arange(len(self.channels[0].value)) / self.sample_rate_hz)
