"""What a series of loads consists of before any model: records with their masses, or a table of resonances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.errors import InputError
from fusion.identify.measured import inertia_errors, rigid_load
from fusion.load import LOAD_COMPONENTS
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.step.releases import read_recording
from fusion.step.result import Release
from shaker._checks import FloatArray
from shaker.models.load_series.decay import FreeDecay, free_decay
from shaker.models.load_series.identify import Output
from shaker.models.load_series.masses import SeriesMasses
from shaker.models.load_series.modes import as_resonances, record_modes
from shaker.models.load_series.resonances import Resonances

FORCES = 3
MOVING = "moving mass of the sensor"


@dataclass(frozen=True)
class LoadSeries:
    """R records or table rows of one component: names, resonances, masses, the decays behind them (none of a table).

    `noise` (R,): standard deviations of the records, in output units, None of a table.
    """

    output: Output
    names: tuple[str, ...]
    measured: Resonances
    masses: SeriesMasses
    decays: tuple[FreeDecay, ...]
    noise: FloatArray | None


def read_series(manifests: Sequence[Manifest]) -> tuple[tuple[LoadSeries, ...], tuple[Notice, ...]]:
    """Return a series for every component that recordings of a campaign release, and what had to be done.

    Raises `InputError` for what the user can mend in the files.
    """
    releases: list[tuple[Manifest, Release]] = []
    notices: list[Notice] = []
    for manifest in manifests:
        release, told = read_recording(manifest)
        releases.append((manifest, release))
        notices += told
    found = []
    refused: list[InputError] = []
    for place, component in enumerate(LOAD_COMPONENTS):
        own = [pair for pair in releases if pair[1].reading.component == component]
        if own and (missing := _missing_mass(own[0][0], place)) is not None:
            refused.append(missing)
            notices.append(
                Notice("warning", f"left out: {missing.key} is 0, so that stiffness cannot be told", component)
            )
        elif own:
            found.append(_series(own, place))
    if not found and refused:
        raise refused[0]
    return tuple(found), tuple(notices)


def _series(releases: list[tuple[Manifest, Release]], component: int) -> LoadSeries:
    """The records of one component with their masses, the lightest load first."""
    masses = [_load(manifest, component) for manifest, _ in releases]
    order = sorted(range(len(releases)), key=lambda place: masses[place][0])
    releases, masses = [releases[place] for place in order], [masses[place] for place in order]
    decays, modes = [], []
    for manifest, release in releases:
        try:
            decays.append(free_decay(release.input.record, release.driven, release.reading))
            modes.append(record_modes(decays[-1]))
        except ValueError as error:
            raise InputError.told_by(error, manifest.path, f"daq.channel.{release.driven}") from error
    return LoadSeries(
        output=_output(releases),
        names=tuple(release.name for _, release in releases),
        measured=as_resonances(modes),
        masses=_masses([manifest for manifest, _ in releases], masses, component),
        decays=tuple(decays),
        noise=np.array([item.noise for item in modes]),
    )


def _output(releases: Sequence[tuple[Manifest, Release]]) -> Output:
    """Driven output and its static sensitivity: the mean of all releases, which must agree on the channel."""
    first = releases[0][1]
    for manifest, release in releases:
        if release.driven != first.driven:
            expected = f"{first.driven}, the output that is driven in {first.name}"
            raise InputError(manifest.path, "daq.channel", found=release.driven, expected=expected)
    gains = np.array([release.reading.static_gain for _, release in releases])
    u = np.array([release.reading.u_static_gain for _, release in releases])
    between = float(np.std(gains, ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0
    spread = max(between, float(np.sqrt(np.sum(u**2))) / len(u))
    reading = first.reading
    return Output(reading.component, reading.channel, reading.unit, float(np.mean(gains)), spread)


def _load(manifest: Manifest, component: int) -> tuple[float, dict[str, float]]:
    """Load mass along a component with what each of its named errors changes; nothing without a [load]."""
    if manifest.rig.load is None:
        stranded = next((part.name for part in manifest.part if part.body == "load"), None)
        if stranded is not None:
            expected = f"the [load] that the part {stranded} belongs to"
            raise InputError(manifest.rig_path, "load", found="nothing", expected=expected)
        return 0.0, {}
    body = rigid_load(manifest)
    changes = {error.name: float(error.change[component, component]) for error in inertia_errors(manifest, body)}
    return float(body.mass_matrix[component, component]), {name: value for name, value in changes.items() if value}


def _masses(
    manifests: Sequence[Manifest], loads: Sequence[tuple[float, dict[str, float]]], component: int
) -> SeriesMasses:
    """All masses; an error that several recordings name alike is one unknown."""
    moving, u_moving = _moving(manifests, component)
    names = list(dict.fromkeys(name for _, changes in loads for name in changes))
    own = [MOVING] if u_moving > 0.0 else []
    effect = np.array([[changes.get(name, 0.0) for name in [*own, *names]] for _, changes in loads])
    moved = np.array([u_moving] * len(own) + [0.0] * len(names))
    mass = np.array([load for load, _ in loads])
    return SeriesMasses(moving, mass, (*own, *names), moved, effect.reshape(len(loads), len(moved)))


def _moving(manifests: Sequence[Manifest], component: int) -> tuple[float, float]:
    """Moving mass, or moment of inertia, of the sensor, which all rigs must state alike."""
    first = _stated(manifests[0], component)
    for manifest in manifests[1:]:
        own = _stated(manifest, component)
        if own != first:
            expected = f"{first[0]:g} as in {manifests[0].rig_path.name}"
            raise InputError(manifest.rig_path, _mass_key(component), found=f"{own[0]:g}", expected=expected)
    return first


def _stated(manifest: Manifest, component: int) -> tuple[float, float]:
    """What a rig states of the moving mass or moment of inertia, with its standard uncertainty."""
    sensor = manifest.rig.sensor
    if sensor is None:
        raise InputError(manifest.rig_path, "sensor", found="nothing", expected="[sensor] with internal_mass")
    if component < FORCES:
        return sensor.internal_mass, sensor.internal_mass_uncertainty
    axis = component - FORCES
    return float(sensor.internal_inertia[axis][axis]), float(sensor.internal_inertia_uncertainty[axis][axis])


def _missing_mass(manifest: Manifest, component: int) -> InputError | None:
    """The refusal of a rig that does not state what moves with the spring."""
    if _stated(manifest, component)[0] > 0.0:
        return None
    expected = "what of the sensor moves with its spring, above 0: only ratios of masses show in a resonance"
    return InputError(manifest.rig_path, _mass_key(component), found="0", expected=expected)


def _mass_key(component: int) -> str:
    """Key of the moving mass or moment of inertia."""
    return "sensor.internal_mass" if component < FORCES else "sensor.internal_inertia"
