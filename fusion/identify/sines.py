"""From the results of sine recordings to the sensitivity over frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.drive import Drive, over_lines
from fusion.identify.campaign import EvaluatedSines
from fusion.identify.sine_transfers import relative_errors
from fusion.load import LOAD_COMPONENTS
from fusion.read_results import Recorded, SensorFacts, read_recorded
from fusion.repeats import drive_ratio
from fusion.results_csv import sensitivity_unit
from fusion.sensitivity import driven_component
from fusion.uncertainty import Uncertainty
from shaker.models.measured import MeasuredSensitivity, RelativeError

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
    """Results of one sine recording: `recorded` as it stands there under a name of its own."""

    item: EvaluatedSines
    recorded: Recorded


def read_sines(item: EvaluatedSines, name: str) -> SineRecording:
    """Read the results of a sine recording by the `name` that tells it from the others."""
    recorded = read_recorded(item.results)
    drives = tuple(replace(drive, recording=name) for drive in recorded.drives)
    return SineRecording(item, replace(recorded, name=name, drives=drives))


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


def _without_internal_mass(uncertainty: Uncertainty) -> Uncertainty:
    """An uncertainty without that of the internal mass stated."""
    kept = tuple(influence for influence in uncertainty.influences if influence.label != INTERNAL_MASS)
    return replace(uncertainty, influences=kept)
