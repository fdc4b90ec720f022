"""One joint fit per driven component: which model, which internal mass, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.body import COMPONENTS
from fusion.errors import ARGUMENT, ComputeError, InputError
from fusion.identify.measured import Prepared, mass_unit
from fusion.identify.settings import IdentifySettings
from fusion.manifest import Sensor
from fusion.notices import Notice
from shaker.models.identification import Identification, Structure, identify
from shaker.models.mass_chain import ChainStructure
from shaker.models.suspension import Suspension

_DIFFERENT = 0.01  # relative difference of load masses from which they tell mass from stiffness
_MISFIT = 3.0  # residuals over their uncertainty, rms, from which one translation does not explain the curves
_BETTER = 0.5  # share of χ² per degree of freedom that a richer model has to reach
_PITCHES_WITH = {0: 4, 1: 3, 3: 1, 4: 0}
INTERNAL_MASS = "internal_mass"
"""Name of the mass that moves with the load inside the sensor among the parameters."""


@dataclass(frozen=True)
class JointFit:
    """The model fitted to all curves of one driven component, why this one, and what it found.

    `mass_is_free`: the internal mass was fitted instead of stated.
    """

    component: int
    model: str
    reason: str
    structure: Structure
    mass_is_free: bool
    identification: Identification
    prepared: tuple[Prepared, ...]
    notices: tuple[Notice, ...]

    @property
    def axis(self) -> str:
        """Name of the component: x, y, z, rx, ry or rz."""
        return COMPONENTS[self.component]


def joint_fits(prepared: Sequence[Prepared], settings: IdentifySettings) -> tuple[JointFit, ...]:
    """Return one fit per driven component, each over all recordings that drive it.

    What moves with the load inside the sensor can differ between axes, so that components share no parameter.
    """
    groups: dict[int, list[Prepared]] = {}
    for item in prepared:
        groups.setdefault(item.component, []).append(item)
    return tuple(_joint_fit(component, group, settings) for component, group in sorted(groups.items()))


def _joint_fit(component: int, group: Sequence[Prepared], settings: IdentifySettings) -> JointFit:
    """Fit one component."""
    free = _mass_is_free(component, group, settings)
    model, reason, found = _chosen(component, group, settings, free=free)
    structure = _structure(model, component, group)
    notices = (*found.notices, *_misfit(component, group, found, model))
    return JointFit(component, model, reason, structure, free, found, tuple(group), notices)


def _chosen(
    component: int, group: Sequence[Prepared], settings: IdentifySettings, *, free: bool
) -> tuple[str, str, Identification]:
    """Return the model, why it was taken, and its fit: translation, unless a second peak asks for pitching.

    Two peaks that pitching explains need no other fit; what it does not explain is compared with one translation.
    """
    if settings.model != "auto":
        return settings.model, "as wanted", _fitted(settings.model, component, group, settings, free=free)
    coupled = component in _PITCHES_WITH and len(_most_peaks(group)) > 1
    pitching = _fitted("pitching", component, group, settings, free=free) if coupled else None
    if pitching is not None and departure(pitching) < _MISFIT:
        return "pitching", _pitches(group, pitching), pitching
    alone = _fitted("translation", component, group, settings, free=free)
    if pitching is not None and pitching.chi_squared / pitching.dof < _BETTER * alone.chi_squared / alone.dof:
        return "pitching", f"{_pitches(group, pitching)}, one translation {departure(alone):.3g}", pitching
    return (
        "translation",
        f"one spring and damper leave residuals of {departure(alone):.3g} times their uncertainty",
        alone,
    )


def _structure(model: str, component: int, group: Sequence[Prepared]) -> Structure:
    """Return the structure of a model for a driven component."""
    if model == "translation":
        return Suspension((component,))
    if model == "adapter":
        return ChainStructure(component)
    if component not in _PITCHES_WITH:
        expected = (
            "a drive along x or y for --model pitching, or about them, which shifts and turns a load whose centre of "
            "mass is not at the origin"
        )
        raise InputError(group[0].manifest.path, "excitation.direction", found=COMPONENTS[component], expected=expected)
    return Suspension((component, _PITCHES_WITH[component]))


def _fitted(
    model: str, component: int, group: Sequence[Prepared], settings: IdentifySettings, *, free: bool
) -> Identification:
    """Fit a model to all curves of a group; what is `free` inside the sensor is fitted, else as stated."""
    structure = _structure(model, component, group)
    names = [parameter.name for parameter in structure.parameters]
    each = [name for name in names if name.startswith("damping_")] if settings.damping == "each" else []
    inside = {} if free else {mass_name(component): component for component in reversed(range(6))}
    known = {name: _stated_in(inside[name], group) for name in names if name in inside}
    records = [item.measured for item in group]
    try:
        return identify(records, structure, known=known, each_recording=each)
    except (ValueError, np.linalg.LinAlgError) as error:
        told = f"no model was fitted to {', '.join(record.name for record in records)}: {ARGUMENT.sub('', str(error))}"
        raise ComputeError(f"{told}; --band chooses the lines of one resonance") from error


def _mass_is_free(component: int, group: Sequence[Prepared], settings: IdentifySettings) -> bool:
    """Whether the internal mass is fitted; refused where the loads are alike."""
    loads = [item.load_kg for item in group]
    differ = max(loads) > (1.0 + _DIFFERENT) * min(loads)
    if settings.internal_mass == "free" and not differ:
        unit = mass_unit(component)
        expected = (
            "load masses that differ where the internal mass is to be fitted (--internal-mass stated takes sensor's)"
        )
        listed = (
            f"{loads[0]:.6g} {unit}" if len(loads) == 1 else f"{loads[0]:.6g} {unit} in all {len(loads)} recordings"
        )
        raise InputError(group[0].manifest.rig_path, "load.mass", found=listed, expected=expected)
    return differ if settings.internal_mass == "auto" else settings.internal_mass == "free"


def _stated_in(component: int, group: Sequence[Prepared]) -> tuple[float, float]:
    """Return the internal mass, or moment of inertia, that a rig of the group states, with its standard uncertainty."""
    sensor = next((item.manifest.rig.sensor for item in group if item.manifest.rig.sensor is not None), None)
    if sensor is None:
        expected = "[sensor] with internal_mass, which recordings of one load mass cannot tell from the stiffness"
        raise InputError(group[0].manifest.rig_path, "sensor", found="nothing", expected=expected)
    return stated_mass(sensor, component)


def stated_mass(sensor: Sensor, component: int) -> tuple[float, float]:
    """Return what moves with the load inside the sensor along a component as the rig states it, and its u."""
    if component < 3:
        return sensor.internal_mass, sensor.internal_mass_uncertainty
    axis = component - 3
    return float(sensor.internal_inertia[axis][axis]), float(sensor.internal_inertia_uncertainty[axis][axis])


def mass_name(component: int) -> str:
    """Name of the parameter that moves with the load inside the sensor."""
    return INTERNAL_MASS if component < 3 else f"internal_inertia_{COMPONENTS[component]}"


def departure(found: Identification) -> float:
    """Return √(χ²/dof): residuals over their uncertainty, rms."""
    return float(np.sqrt(found.chi_squared / found.dof))


def _most_peaks(group: Sequence[Prepared]) -> tuple[float, ...]:
    """Return the resonances (Hz) of the response that has most of them."""
    return max((item.peaks_hz(name) for item in group for name in item.measured.ratio.channels), key=len)


def _pitches(group: Sequence[Prepared], found: Identification) -> str:
    """Why pitching was taken."""
    listed = " and ".join(f"{peak:.6g} Hz" for peak in _most_peaks(group)[:2])
    return (
        f"the curves have peaks at {listed}, of which one translation makes one; translation and pitching together "
        f"leave residuals of {departure(found):.3g} times their uncertainty"
    )


def _misfit(component: int, group: Sequence[Prepared], found: Identification, model: str) -> tuple[Notice, ...]:
    """Say what else could explain a second peak that the model leaves over."""
    if departure(found) < _MISFIT or model != "translation" or len(_most_peaks(group)) < 2:
        return ()
    text = "one translation does not explain the second peak; --model adapter or pitching, or --band, may"
    return (Notice("warning", text, f"model {COMPONENTS[component]}"),)
