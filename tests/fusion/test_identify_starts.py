"""Identification with tied clocks: what the ties leave open is one error of all recordings that start alike."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from identify_factory import DAMPING, LAG_S, SINES_HZ, SMALL, write_campaign, write_sines
from support import without_pages, write_daq

from fusion.campaign.run import run_path
from fusion.recording.load import load_manifest
from fusion.recording.toml import to_toml
from fusion.sensitivity.recording_evaluation import Settings
from fusion.sensor.identify.identification_evaluation import evaluate_identification
from fusion.sensor.identify.identification_inputs import (
    CLOCK,
    IdentifySettings,
    PreparedTransfer,
    add_clock_errors,
    prepare,
    read_campaign,
)
from fusion.sensor.identify.joint_fit import joint_fits
from fusion.simulate.world import Draws, true_part
from shaker.identification.measured_curves import CurveError

RATE_HZ, PERIOD = 12800.0, 256.05  # of the trigger, in samples: its edges move by a sample in 20 of them
BELOW_HZ = (800.0, 815.0)  # of all resonances: there a late response looks like damping
TIE_S = 3e-7


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> list[PreparedTransfer]:
    """Two loads, twice each; of a curve nothing but its noise and loads is uncertain."""
    folder = write_campaign(tmp_path_factory.mktemp("starts") / "campaign", replace(SMALL, tops={"top": (0, 0, 0.1)}))
    loads = [prepare(load_manifest(folder / f"chirp-{name}"), name, BELOW_HZ)[0] for name in SMALL.loads]
    return [
        replace(item, measured=replace(item.measured, name=f"{item.measured.name} {number}", errors=()))
        for item in loads
        for number in (1, 2)
    ]


def late(item: PreparedTransfer, by_s: float, rng: np.random.Generator) -> PreparedTransfer:
    """The curve of loads as stated, with its noise, its response late by an error of a tie of `TIE_S`."""
    measured, none = item.measured, Draws(0, False)
    load = true_part(SMALL.loads[measured.name[:3]], none)
    ratio = measured.ratio
    turn = 2j * np.pi * ratio.frequency_hz[:, None]
    true = SMALL.transfer(load, true_part(SMALL.internal, none), (0.0, 0.0, 0.1), ratio.frequency_hz)[:, None]
    parts = np.linalg.cholesky(ratio.covariance) @ rng.standard_normal((len(true), 2, 1))
    value = true * np.exp(-turn * by_s) + parts[:, :1, 0] + 1j * parts[:, 1:, 0]
    errors = (CurveError(f"{CLOCK}b [{measured.name}]", -TIE_S * turn),)
    return replace(item, measured=replace(measured, ratio=replace(ratio, value=value), errors=errors))


def errors_of_damping(prepared: list[PreparedTransfer], anew: bool, shared: bool, trials: int) -> np.ndarray:
    """Errors over u of campaigns, the curves' ties named as those of one start or of their own."""
    rng, found = np.random.default_rng(3), []
    for _ in range(trials):
        tie = TIE_S * rng.standard_normal(len(prepared))
        drawn = [late(item, tie[n if anew else 0], rng) for n, item in enumerate(prepared)]
        named = [add_clock_errors(item, "first" if shared else item.measured.name) for item in drawn]
        (fit,) = joint_fits(named, IdentifySettings(internal_mass="stated"))
        damping = fit.identification["damping_z"]
        found.append((damping.value - DAMPING) / damping.u)
    return np.array(found)


@pytest.mark.slow
def test_damping_is_covered_however_recorders_start(prepared):
    """Errors over u are 1 rms; named as if each recording had a tie of its own, those of one tie are half too large."""
    ways = ((False, True), (False, False), (True, False))
    alike, apart, anew = (errors_of_damping(prepared, *way, trials=40) for way in ways)
    for found in (alike, anew):
        assert 0.7 < np.sqrt(np.mean(found**2)) < 1.3
    assert np.sqrt(np.mean(apart**2)) > 1.3


def on_two_clocks(folders: Iterable[Path], second: str, periods: int, anew: bool) -> None:
    """Move one channel of every recording to a block of its own, a part of a sample late, and tie both by a trigger.

    Records consist of `periods` periods, which a transform moves exactly.
    """
    rng = np.random.default_rng(8)
    edge, by = 40.0, 0.3
    for place in folders:
        edge, by = (rng.uniform(0.0, PERIOD), rng.uniform()) if anew else (edge, by)
        manifest = tomllib.loads((place / "recording.toml").read_text())
        (daq,) = manifest["daq"]
        with h5py.File(place / daq["file"]) as file:
            samples = {name: np.asarray(file[name], dtype=np.float64) for name in file}
        turn = samples[second].reshape(periods, -1)
        turned = np.fft.rfft(turn, axis=1) * np.exp(2j * np.pi * np.fft.rfftfreq(turn.shape[1]) * by)
        moved = np.fft.irfft(turned, turn.shape[1], axis=1).ravel()
        del samples[second]
        blocks = {"first": samples, "second": {second: moved}}
        daqs = []
        for name, kept in blocks.items():
            time = np.arange(len(moved)) + (by if name == "second" else 0.0)
            trigger = 5.0 * ((time - edge) % PERIOD < PERIOD / 4.0)
            write_daq(place / f"{name}.h5", RATE_HZ, {**kept, "camera": trigger})
            channels = [channel for channel in daq["channel"] if channel["name"] in kept]
            channels.append({"name": "camera", "quantity": "trigger", "threshold": 2.5})
            daqs.append({**daq, "name": name, "file": f"{name}.h5", "first_edge": 0, "channel": channels})
        del daqs[0]["first_edge"]
        (place / "recording.toml").write_text(to_toml({**manifest, "daq": daqs}), encoding="utf-8")


@pytest.mark.parametrize("anew", [False, True])
def test_chirps_have_one_tie_where_their_recorders_start_alike(tmp_path, anew):
    folder = write_campaign(tmp_path / "campaign", replace(SMALL, tops={"top": (0, 0, 0.1)}))
    on_two_clocks(sorted(folder.glob("chirp-*")), "top", 4, anew)
    (component,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    names = {unknown.name for unknown in component.fit.identification.unknowns}
    assert sum(name.startswith(f"{CLOCK}second") for name in names) == (2 if anew else 1)


@pytest.mark.slow
@pytest.mark.parametrize("anew", [False, True])
def test_sines_have_one_tie_where_their_recorders_start_alike(tmp_path, anew, monkeypatch):
    folder = write_campaign(tmp_path / "campaign")
    on_two_clocks(write_sines(folder), "bridge", 1, anew)
    without_pages(monkeypatch)
    assert [outcome.error for outcome in run_path(folder, None, Settings())] == [None] * len(SINES_HZ)
    (component,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    names = [error.name for error in component.sensitivity.measured.errors]
    assert sum(name.startswith(f"{CLOCK}second: time") for name in names) == (len(SINES_HZ) if anew else 1)
    chain = component.sensitivity.comparison.best
    assert abs(chain.chain.lag_s - LAG_S) < 2.0 * chain.u("lag_s")
