"""Identification with tied clocks: the remaining time error is shared by recordings with the same start."""

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
    """Two loads, twice each; only noise and loads of a curve are uncertain."""
    folder = write_campaign(tmp_path_factory.mktemp("starts") / "campaign", replace(SMALL, tops={"top": (0, 0, 0.1)}))
    loads = [prepare(load_manifest(folder / f"chirp-{name}"), name, BELOW_HZ)[0] for name in SMALL.loads]
    return [
        replace(item, measured=replace(item.measured, name=f"{item.measured.name} {number}", errors=()))
        for item in loads
        for number in (1, 2)
    ]


def late(item: PreparedTransfer, by_s: float, rng: np.random.Generator) -> PreparedTransfer:
    """Curve of the stated loads with noise, its response delayed by an error of a clock tie (`TIE_S`)."""
    measured, none = item.measured, Draws(0, False)
    load = true_part(SMALL.loads[measured.name[:3]], none)
    ratio = measured.ratio
    turn = 2j * np.pi * ratio.frequency_hz[:, None]
    true = SMALL.transfer(load, true_part(SMALL.internal, none), (0.0, 0.0, 0.1), ratio.frequency_hz)[:, None]
    parts = np.linalg.cholesky(ratio.covariance) @ rng.standard_normal((len(true), 2, 1))
    value = true * np.exp(-turn * by_s) + parts[:, :1, 0] + 1j * parts[:, 1:, 0]
    errors = (CurveError(f"{CLOCK}b [{measured.name}]", -TIE_S * turn),)
    return replace(item, measured=replace(measured, ratio=replace(ratio, value=value), errors=errors))


def errors_of_damping(prepared: list[PreparedTransfer], separate_starts: bool, shared: bool, trials: int) -> np.ndarray:
    """Errors over u of campaigns, the ties of the curves named as those of one start or of separate starts."""
    rng, found = np.random.default_rng(3), []
    for _ in range(trials):
        tie = TIE_S * rng.standard_normal(len(prepared))
        drawn = [late(item, tie[n if separate_starts else 0], rng) for n, item in enumerate(prepared)]
        named = [add_clock_errors(item, "first" if shared else item.measured.name) for item in drawn]
        (fit,) = joint_fits(named, IdentifySettings(internal_mass="stated"))
        damping = fit.identification["damping_z"]
        found.append((damping.value - DAMPING) / damping.u)
    return np.array(found)


@pytest.mark.slow
def test_u_of_damping_covers_shared_and_separate_starts(prepared):
    """Errors over u are 1 rms; if one shared tie is named as separate ties, they are half too large."""
    cases = ((False, True), (False, False), (True, False))
    shared, misnamed, separate = (errors_of_damping(prepared, *case, trials=40) for case in cases)
    for found in (shared, separate):
        assert 0.7 < np.sqrt(np.mean(found**2)) < 1.3
    assert np.sqrt(np.mean(misnamed**2)) > 1.3


def on_two_clocks(folders: Iterable[Path], second: str, periods: int, separate_starts: bool) -> None:
    """Move one channel of every recording to a separate block, delayed by part of a sample, tied by a trigger.

    Records consist of `periods` periods, which a transform moves exactly.
    """
    rng = np.random.default_rng(8)
    edge, delay = 40.0, 0.3
    for folder in folders:
        edge, delay = (rng.uniform(0.0, PERIOD), rng.uniform()) if separate_starts else (edge, delay)
        manifest = tomllib.loads((folder / "recording.toml").read_text())
        (daq,) = manifest["daq"]
        with h5py.File(folder / daq["file"]) as file:
            samples = {name: np.asarray(file[name], dtype=np.float64) for name in file}
        turn = samples[second].reshape(periods, -1)
        shifted = np.fft.rfft(turn, axis=1) * np.exp(2j * np.pi * np.fft.rfftfreq(turn.shape[1]) * delay)
        moved = np.fft.irfft(shifted, turn.shape[1], axis=1).ravel()
        del samples[second]
        blocks = {"first": samples, "second": {second: moved}}
        daqs = []
        for name, signals in blocks.items():
            time = np.arange(len(moved)) + (delay if name == "second" else 0.0)
            trigger = 5.0 * ((time - edge) % PERIOD < PERIOD / 4.0)
            write_daq(folder / f"{name}.h5", RATE_HZ, {**signals, "camera": trigger})
            channels = [channel for channel in daq["channel"] if channel["name"] in signals]
            channels.append({"name": "camera", "quantity": "trigger", "threshold": 2.5})
            daqs.append({**daq, "name": name, "file": f"{name}.h5", "first_edge": 0, "channel": channels})
        del daqs[0]["first_edge"]
        (folder / "recording.toml").write_text(to_toml({**manifest, "daq": daqs}), encoding="utf-8")


@pytest.mark.parametrize("separate_starts", [pytest.param(False, marks=pytest.mark.slow), True])
def test_chirps_with_the_same_start_share_one_tie(tmp_path, separate_starts):
    folder = write_campaign(tmp_path / "campaign", replace(SMALL, tops={"top": (0, 0, 0.1)}))
    on_two_clocks(sorted(folder.glob("chirp-*")), "top", 4, separate_starts)
    (component,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    names = {unknown.name for unknown in component.fit.identification.unknowns}
    assert sum(name.startswith(f"{CLOCK}second") for name in names) == (2 if separate_starts else 1)


@pytest.mark.slow
@pytest.mark.parametrize("separate_starts", [False, True])
def test_sines_with_the_same_start_share_one_tie(tmp_path, separate_starts, monkeypatch):
    folder = write_campaign(tmp_path / "campaign")
    on_two_clocks(write_sines(folder), "bridge", 1, separate_starts)
    without_pages(monkeypatch)
    assert [outcome.error for outcome in run_path(folder, None, Settings())] == [None] * len(SINES_HZ)
    (component,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    names = [error.name for error in component.sensitivity.measured.errors]
    assert sum(name.startswith(f"{CLOCK}second: time") for name in names) == (len(SINES_HZ) if separate_starts else 1)
    chain = component.sensitivity.comparison.best
    assert abs(chain.chain.lag_s - LAG_S) < 2.0 * chain.u("lag_s")
