"""Static gains of every output, and what releases by different ropes have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fusion.load import LOAD_COMPONENTS
from fusion.manifest import ChannelEntry, Manifest
from fusion.step.pool import effective_dof
from fusion.step.result import Release, Rope, StaticGain
from shaker._checks import FloatArray
from shaker.models.step.compare import compare_releases


def static_gains(releases: Sequence[Release]) -> Iterator[StaticGain]:
    """Yield the static gain of every output for the load of some releases, the driven output first.

    The mean of the releases by weight 1/u²; where they scatter by more than is stated of each, u is that of the
    scatter, with its degrees of freedom. The load's and the output's scale err for all releases alike.
    """
    channels = dict.fromkeys(reading.channel for release in releases for reading in release.readings)
    for channel in channels:
        found = [reading for release in releases for reading in release.readings if reading.channel == channel]
        value = np.array([reading.static_gain for reading in found])
        u = np.array([reading.u_static_gain for reading in found])
        mean, u_mean, dof = mean_with_scatter(value, u)
        own = abs(mean) * scale_uncertainty(releases[0].input.manifest, channel)
        stated, u_stated = stated_gain(releases[0].input.manifest, channel, releases[0].input.record.component)
        total = float(np.hypot(u_mean, own))
        wide = dof * (total / u_mean) ** 4 if np.isfinite(dof) and u_mean > 0.0 else dof
        yield StaticGain(channel, mean, total, float(wide), len(found), stated, u_stated)


def mean_with_scatter(value: FloatArray, u: FloatArray) -> tuple[float, float, float]:
    """Return the weighted mean of values (N,) with u (N,), its u and degrees of freedom.

    u² is that of the weights times χ²/(N - 1) where this is above 1 (Birge's ratio), with the degrees of freedom of
    `pool.effective_dof`.
    """
    if not np.all(u > 0.0):
        u = np.ones(len(value))
    weight = 1.0 / u**2
    mean = float(weight @ value / weight.sum())
    stated = 1.0 / float(weight.sum())
    if len(value) < 2:
        return mean, stated**0.5, float(np.inf)
    freedom = len(value) - 1
    ratio = float(weight @ (value - mean) ** 2) / freedom
    if ratio <= 1.0:
        return mean, stated**0.5, float(np.inf)
    part = stated * (ratio - 1.0 if freedom == 1 else ratio)
    dof = effective_dof(np.array([stated * ratio]), np.array([part]), freedom)
    return mean, (stated * ratio) ** 0.5, float(dof[0])


def scale_uncertainty(manifest: Manifest, channel: str) -> float:
    """Return the relative standard uncertainty of output over load that all releases share: of both scales."""
    entry = _entry(manifest, channel)
    parts = (manifest.excitation.step_uncertainty, entry.scale_uncertainty, entry.individual_uncertainty)
    return float(np.sqrt(np.sum(np.square(parts))))


def stated_gain(manifest: Manifest, channel: str, component: str) -> tuple[float | None, float]:
    """Return the static sensitivity that rig.toml states for an output and a component, None without, and its u."""
    sensor = manifest.rig.sensor
    if sensor is None or sensor.static_sensitivity is None or channel not in sensor.channels:
        return None, 0.0
    value = float(sensor.static_sensitivity[sensor.channels.index(channel)][LOAD_COMPONENTS.index(component)])
    return value, abs(value) * sensor.static_sensitivity_uncertainty


def ropes(releases: Sequence[Release], used: Sequence[str]) -> tuple[Rope, ...]:
    """Return the releases by what let go, the fastest rise first; how long the load changed is told by the models."""
    readings = [replace(r.reading, release_s=r.release_s, u_release_s=r.u_release_s) for r in releases]
    found = []
    for kind in compare_releases(readings):
        own = tuple(r.name for r in releases if r.input.record.release == kind.release)
        found.append(Rope(kind, own, any(name in used for name in own)))
    return tuple(found)


def _entry(manifest: Manifest, channel: str) -> ChannelEntry:
    """The entry of an output channel."""
    entries = [entry for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    return next(entry for entry in entries if (entry.channel or entry.name) == channel)
