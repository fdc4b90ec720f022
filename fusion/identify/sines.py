"""From results of sine recordings: the sensitivity over frequency, and load over base acceleration as a transfer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import h5py
import numpy as np
from numpy.typing import NDArray

from fusion.body import COMPONENTS
from fusion.drive import Drive, between_recordings, over_lines
from fusion.estimate import real_design
from fusion.identify.campaign import EvaluatedSines
from fusion.identify.measured import component_of, drive_of, inertia_errors, rigid_load
from fusion.load import LOAD_COMPONENTS
from fusion.provenance import RESULT_FILE
from fusion.read_results import Recorded, SensorFacts, read_recorded, read_uncertainty
from fusion.repeats import drive_ratio
from fusion.results_csv import sensitivity_unit
from fusion.sensitivity import driven_component
from fusion.uncertainty import Uncertainty
from shaker.models.measured import MeasuredSensitivity, MeasuredTransfer, RelativeError, Sight
from shaker.signals.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_ORIGIN_OF_MOTION = "fused"
INTERNAL_MASS = "internal mass: mass"
"""Label under which a load names the uncertainty of the mass inside the sensor."""


@dataclass(frozen=True)
class Referral:
    """The internal mass found in place of the one stated: what is found, `mass_kg` with `u_mass_kg`, and by recording
    `stated_kg` and `load_kg`, the mass along the component of what is mounted on the sensor.
    """

    mass_kg: float
    u_mass_kg: float
    stated_kg: Mapping[str, float]
    load_kg: Mapping[str, float]

    def factor(self, recording: str) -> float:
        """Return the factor of a sensitivity, (m + m_i stated)/(m + m_i found)."""
        load = self.load_kg[recording]
        return (load + self.stated_kg[recording]) / (load + self.mass_kg)

    def relative(self, recording: str) -> float:
        """Return the relative change of a sensitivity for one standard uncertainty of the internal mass."""
        return -self.u_mass_kg / (self.load_kg[recording] + self.mass_kg)


@dataclass(frozen=True)
class SineRecording:
    """Results of one sine recording: `recorded` as it stands there under a name of its own, `transfer` where load and
    base acceleration are both known.
    """

    item: EvaluatedSines
    recorded: Recorded
    transfer: MeasuredTransfer | None


def read_sines(item: EvaluatedSines, name: str, band_hz: tuple[float, float] | None) -> SineRecording:
    """Read the results of a sine recording by the `name` that tells it from the others."""
    recorded = read_recorded(item.results)
    drives = tuple(replace(drive, recording=name) for drive in recorded.drives)
    recorded = replace(recorded, name=name, drives=drives)
    return SineRecording(item, recorded, _transfer(item, name, band_hz))


def sensitivities(
    recordings: Sequence[SineRecording], referrals: Mapping[int, Referral]
) -> tuple[MeasuredSensitivity, ...]:
    """Return the sensitivity of the output of every driven component over frequency, all recordings together.

    `referrals`: for the load components whose internal mass was found, with which the loads are taken anew.
    """
    sensor = next((item.recorded.sensor for item in recordings if item.recorded.sensor is not None), None)
    drives = [drive for item in recordings for drive in item.recorded.drives]
    if sensor is None or not drives:
        return ()
    capacity = None if sensor.capacity is None else sensor.capacity.tolist()
    groups: dict[int, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(driven_component(drive.direction, capacity), []).append(drive)
    found = [_sensitivity(sensor, j, group, referrals.get(j)) for j, group in sorted(groups.items())]
    return tuple(item for item in found if item is not None)


def _sensitivity(
    sensor: SensorFacts, component: int, drives: Sequence[Drive], referral: Referral | None
) -> MeasuredSensitivity | None:
    """Return output over load of one component at every driven line, ascending in frequency."""
    channel = main_output(sensor, component, drives)
    usable = [drive for drive in drives if np.isfinite(drive.outputs[drive.channels.index(channel)])]
    if not usable:
        return None
    usable = sorted(usable, key=lambda drive: drive.frequency_hz)
    parts = [drive_ratio(drive, component, [channel]) for drive in usable]
    value, whole = np.array([ratio[0] for ratio, _ in parts]), over_lines([part for _, part in parts])
    errors: tuple[RelativeError, ...] = ()
    if referral is not None:
        factor = np.array([referral.factor(drive.recording) for drive in usable], dtype=np.complex128)
        value, whole = value * factor, _without_internal_mass(whole).scaled(factor[:, None])
        own = np.array([[referral.relative(drive.recording)] for drive in usable], dtype=np.complex128)
        errors = (RelativeError(INTERNAL_MASS, own),)
    place = sensor.channels.index(channel)
    static = None if sensor.static is None else float(sensor.static[place, component])
    return MeasuredSensitivity(
        channel=channel,
        component=LOAD_COMPONENTS[component],
        frequency_hz=np.array([drive.frequency_hz for drive in usable]),
        value=value,
        covariance=np.sum([part.covariance for part in whole.random], axis=0),
        unit=sensitivity_unit(sensor.unit, LOAD_COMPONENTS[component]),
        errors=(*relative_errors(whole, value[:, None]), *errors),
        static=static or None,
        u_static=abs(static or 0.0) * sensor.u_static,
    )


def main_output(sensor: SensorFacts, component: int, drives: Sequence[Drive]) -> str:
    """Return which output belongs to a load component: that of its name, else the largest, static or as found."""
    channels = drives[0].channels
    if LOAD_COMPONENTS[component] in channels:
        return LOAD_COMPONENTS[component]
    if sensor.static is not None:
        rows = [sensor.channels.index(channel) for channel in channels]
        return channels[int(np.argmax(np.abs(sensor.static[rows, component])))]
    size = np.nansum([np.abs(drive.outputs) / np.abs(drive.load[component]) for drive in drives], axis=0)
    return channels[int(np.argmax(size))]


def relative_errors(uncertainty: Uncertainty, value: ComplexArray) -> tuple[RelativeError, ...]:
    """Return the named unknowns of values (K, C) as complex relative deviations for one standard uncertainty."""
    count = value.shape[1]
    return tuple(
        RelativeError(influence.name, (influence.effect[:, :count] + 1j * influence.effect[:, count:]) / value)
        for influence in uncertainty.influences
        if np.any(influence.effect != 0.0)
    )


def _without_internal_mass(uncertainty: Uncertainty) -> Uncertainty:
    """An uncertainty without that of the internal mass stated."""
    kept = tuple(influence for influence in uncertainty.influences if influence.label != INTERNAL_MASS)
    return replace(uncertainty, influences=kept)


def _transfer(item: EvaluatedSines, name: str, band_hz: tuple[float, float] | None) -> MeasuredTransfer | None:
    """Return load over base acceleration along the drive at the driven lines, None where one is not known."""
    manifest = item.manifest
    drive = drive_of(manifest)
    component = component_of(drive)
    if manifest.rig.load is None:
        return None
    with h5py.File(item.results / RESULT_FILE, "r") as file:
        groups = [f"accelerations/{body}-{_ORIGIN_OF_MOTION}" for body in ("load", "base")]
        if any(group not in file for group in groups):
            return None
        frequency = file["lines/frequency_hz"][()]
        driven = file["lines/multiple"][()] == 1
        values = [file[group]["phasors/value"][()][:, component] for group in groups]
        parts = [read_uncertainty(file[group]["uncertainty"]).at([component]) for group in groups]
    chosen = driven & np.isfinite(values[0]) & np.isfinite(values[1])
    if band_hz is not None:
        chosen &= (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    if not np.any(chosen):
        return None
    ratio, whole = _quotient([value[chosen] for value in values], [_at_lines(part, chosen) for part in parts])
    whole = between_recordings(whole, name, manifest.mounting)
    body = rigid_load(manifest)
    along = Sight(np.zeros(3), _axis(component)) if component < 3 else None
    if along is None:
        return None
    clock = manifest.daq[0] if manifest.daq else None
    return MeasuredTransfer(
        name=name,
        ratio=Phasors(
            frequency_hz=frequency[chosen],
            value=ratio[:, None],
            covariance=np.sum([part.covariance for part in whole.random], axis=0),
            channels=(f"load {COMPONENTS[component]}",),
            unit=("1",),
            dof=whole.dof()[:, 0],
        ),
        tops=(along,),
        base=along,
        drive=drive,
        mass_matrix=body.mass_matrix,
        errors=relative_errors(whole, ratio[:, None]),
        inertia_errors=inertia_errors(manifest, body),
        clock=f"clock of {clock.name}" if clock else f"clock of {name}",
        u_clock=clock.clock_uncertainty if clock else 0.0,
    )


def _axis(component: int) -> FloatArray:
    """Unit vector of a translation."""
    return np.asarray(np.eye(3)[component])


def _at_lines(uncertainty: Uncertainty, chosen: NDArray[np.bool_]) -> Uncertainty:
    """Uncertainty of the values at some lines."""
    random = tuple(
        replace(part, covariance=part.covariance[chosen], dof=None if part.dof is None else part.dof[chosen])
        for part in uncertainty.random
    )
    return Uncertainty(random, tuple(i.acting(i.effect[chosen]) for i in uncertainty.influences))


def _quotient(values: Sequence[ComplexArray], parts: Sequence[Uncertainty]) -> tuple[ComplexArray, Uncertainty]:
    """Return the first values (K,) over the second and the uncertainty of that; what both share acts on both."""
    top, base = values
    ratio = top / base
    above = parts[0].transformed(real_design((1.0 / base)[:, None, None]))
    below = parts[1].transformed(real_design((-ratio / base)[:, None, None]))
    relabelled = tuple(replace(part, label=f"base: {part.label}") for part in below.random)
    return ratio, above.plus(replace(below, random=relabelled))
