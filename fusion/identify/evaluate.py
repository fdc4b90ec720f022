"""From a campaign to the sensor as a mechanical system: curves → joint fits → readings, sensitivity, usable bands."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from fusion.identify.campaign import Campaign
from fusion.identify.fit import JointFit, joint_fits, mass_name, stated_mass
from fusion.identify.measured import Prepared, load_along, prepare
from fusion.identify.readings import read_curves
from fusion.identify.result import ComponentResult, IdentifyEvaluation
from fusion.identify.sensor import modelled
from fusion.identify.settings import IdentifySettings
from fusion.identify.sine_transfers import sine_transfers
from fusion.identify.sines import Referral, SineRecording, read_sines, sensitivities
from fusion.load import LOAD_COMPONENTS
from fusion.manifest import Manifest, Sensor
from fusion.notices import Notice
from fusion.provenance import versions
from shaker.models.measured import MeasuredSensitivity
from shaker.models.sensor.sensor_model import Load
from shaker.models.sensor.usable_band import usable_band


def evaluate_campaign(campaign: Campaign, settings: IdentifySettings) -> IdentifyEvaluation:
    """Return what all recordings of a campaign say of the sensor together.

    Raises `InputError` for what the user can mend in the files.
    """
    started = time.monotonic()
    names = _names([*campaign.transfers, *(item.manifest for item in campaign.sines)])
    prepared, notices = _prepared(campaign, names, settings)
    sines = [read_sines(item, names[item.manifest.path]) for item in campaign.sines]
    driven = {item.component for item in prepared}
    added = sine_transfers(campaign.sines, names, settings.band_hz)
    fits = joint_fits([*prepared, *(item for item in added if item.component in driven)], settings)
    referrals = {fit.component: _referral(fit, sines) for fit in fits if fit.mass_is_free}
    measured = {item.component: item for item in sensitivities(sines, referrals)}
    sensor = _sensor([*campaign.transfers, *(item.manifest for item in campaign.sines)])
    components = [_component(fit, measured.get(LOAD_COMPONENTS[fit.component]), sensor, settings) for fit in fits]
    told = [notice for _, own in components for notice in own]
    return IdentifyEvaluation(
        name=campaign.name,
        sensor=sensor,
        components=tuple(component for component, _ in components),
        notices=tuple(dict.fromkeys([*campaign.notices, *notices, *told])),
        settings=settings.as_dict(),
        versions=versions(),
        input_hashes=campaign.input_hashes,
        duration_s=time.monotonic() - started,
    )


def _names(manifests: Sequence[Manifest]) -> dict[Path, str]:
    """Return a name of its own for every recording, by path: a name that occurs twice gets the folder's beside it."""
    names = [manifest.name for manifest in manifests]
    return {
        manifest.path: manifest.name if names.count(manifest.name) == 1 else f"{manifest.name} [{manifest.folder.name}]"
        for manifest in manifests
    }


def _prepared(
    campaign: Campaign, names: Mapping[Path, str], settings: IdentifySettings
) -> tuple[list[Prepared], list[Notice]]:
    """Evaluate every recording with transfer functions."""
    prepared: list[Prepared] = []
    notices: list[Notice] = []
    for manifest in campaign.transfers:
        item, told = prepare(manifest, names[manifest.path], settings.band_hz)
        prepared.append(item)
        notices += told
    return prepared, notices


def _sensor(manifests: Sequence[Manifest]) -> Sensor | None:
    """Return the sensor that the rigs state."""
    return next((manifest.rig.sensor for manifest in manifests if manifest.rig.sensor is not None), None)


def _referral(fit: JointFit, sines: Sequence[SineRecording]) -> Referral:
    """Return the internal mass found, with the masses of the sine recordings."""
    found = fit.identification[mass_name(fit.component)]
    stated, loads = {}, {}
    for item in sines:
        manifest = item.item.manifest
        if manifest.rig.sensor is not None and manifest.rig.load is not None:
            loads[item.recorded.name] = load_along(manifest, fit.component)
            stated[item.recorded.name] = stated_mass(manifest.rig.sensor, fit.component)[0]
    return Referral(found.value, found.u, stated, loads)


def _component(
    fit: JointFit, measured: MeasuredSensitivity | None, sensor: Sensor | None, settings: IdentifySettings
) -> tuple[ComponentResult, tuple[Notice, ...]]:
    """Return everything of one component, and what is to be said of it."""
    mass = fit.identification[mass_name(fit.component)]
    readings, unread = read_curves(fit, mass.value)
    found = modelled(fit, measured, sensor)
    loads = settings.load_masses_kg or tuple(sorted(dict.fromkeys(item.load_kg for item in fit.prepared)))
    loads = () if fit.model == "pitching" else loads
    bands = tuple(usable_band(found.model, Load(kg, "force"), settings.permitted) for kg in loads)
    result = ComponentResult(fit, mass, readings, found.sensitivity, found.model, found.range_hz, loads, bands)
    return result, (*fit.notices, *unread, *found.notices, *_no_band(fit))


def _no_band(fit: JointFit) -> tuple[Notice, ...]:
    """Say why a load that pitches has no usable band."""
    if fit.model != "pitching":
        return ()
    text = "no usable band is given: that of a load that pitches depends on where the force acts, not on its mass alone"
    return (Notice("info", text, fit.axis),)
