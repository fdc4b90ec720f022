"""Chirp, noise and blows with the points of a camera pair: six components and sensitivity against a known motion."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from nonsinusoidal_truth import Order, write
from support import block, channel, edit

from fusion import Settings, evaluate_recording, load_for_command, load_manifest
from fusion.errors import InputError
from fusion.phasors.phasor_notices import EVALUATED_AS_NOISE
from fusion.recording.excitation import kinds_of
from fusion.recording.load import select_kinds
from fusion.report.tables import headlines

RATE_HZ, LENGTH_S, BAND_HZ, LINES_HZ = 4096.0, 8.0, [40.0, 300.0], [50.0, 90.0, 150.0, 260.0]
MASS_KG, SENSITIVITY, EXPOSURE_S = 2.0, 1e-6, 1e-4
RATIOS = np.array([0.02, -0.03, 1.0, 0.5, 0.8, -0.4])
"""Displacement of the load (m, m, m, rad, rad, rad) per m of its origin along z."""
NOISE_M = 2e-7


def write_recording(folder: Path, kind: str = "noise") -> Path:
    """Write a rigid load on a uniaxial sensor, with a laser, an accelerometer and points of a camera pair."""
    rng, count = np.random.default_rng(4), round(RATE_HZ * LENGTH_S)
    hertz, time_s = np.fft.rfftfreq(count, 1.0 / RATE_HZ), np.arange(count) / RATE_HZ
    inside = (hertz > 30.0) & (hertz < 330.0)
    spectrum = np.where(inside, rng.standard_normal(len(hertz)) + 1j * rng.standard_normal(len(hertz)), 0.0)
    spectrum *= 12.0 / np.std(np.fft.irfft(spectrum, count))
    acceleration = np.fft.irfft(spectrum, count)
    turn = np.where(inside, 2j * np.pi * hertz, 1.0)
    velocity = np.fft.irfft(spectrum / turn, count)
    edges_s = 0.1 + np.arange(400) / 51.3
    moved = spectrum[inside] / turn[inside] ** 2 * np.sinc(hertz[inside] * EXPOSURE_S) * 2.0 / count
    middle_s = edges_s + 0.5 * EXPOSURE_S
    z = (np.exp(2j * np.pi * np.multiply.outer(middle_s, hertz[inside])) @ moved).real
    last = np.searchsorted(edges_s, time_s, side="right") - 1
    high = (last >= 0) & (time_s - edges_s[last] < 5e-3)
    with h5py.File(folder / "daq.h5", "w") as file:
        file.attrs["sample_rate"] = RATE_HZ
        for name, values in {
            "laser": velocity + 1e-6 * rng.standard_normal(count),
            "side": RATIOS[0] * acceleration + 1e-3 * rng.standard_normal(count),
            "Fz": SENSITIVITY * MASS_KG * acceleration + 1e-9 * rng.standard_normal(count),
            "trigger": 5.0 * high,
        }.items():
            file[name] = values
    places = np.stack(np.meshgrid([-0.03, 0.0, 0.03], [-0.03, 0.0, 0.03], [0.02]), axis=-1).reshape(-1, 3)
    rows = ["frame,id,x,y,z"]
    for frame, height in enumerate(z):
        shift = height * (RATIOS[:3] + np.cross(RATIOS[3:], places)) + NOISE_M * rng.standard_normal(places.shape)
        rows += [f"{frame},{n},{x:.12f},{y:.12f},{h:.12f}" for n, (x, y, h) in enumerate(places + shift)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    centre, inertia = [0.0, 0.0, 0.0], 1e-3 * np.eye(3)
    internal = {"internal_centre_of_mass": centre, "internal_inertia": (0.0 * inertia).tolist()}
    rig = block(format=1, name="load on a uniaxial sensor")
    rig += block("sensor", name="uniaxial", channels=["Fz"], unit="V/V", sense="on_load", internal_mass=0.0, **internal)
    rig += block("load", mass=MASS_KG, mass_uncertainty=1e-4, centre_of_mass=centre, inertia=inertia.tolist())
    camera = {"rotation": np.eye(3).tolist(), "translation": centre, "pose_uncertainty": [1e-6] * 6}
    rig += block("stereo.top", body="load", exposure=EXPOSURE_S, scale_uncertainty=1e-4, **camera)
    (folder / "rig.toml").write_text(rig)
    excitation = {"kind": kind, "direction": [0, 0, 1], "band": BAND_HZ, "frequencies": LINES_HZ}
    text = block(format=1, name="broadband", rig="rig.toml") + block("excitation", **excitation, reference=["laser"])
    text += block("[daq]", name="daq", file="daq.h5")
    place = {"body": "load", "point": [0.0, 0.0, 0.0], "scale_uncertainty": 1e-4}
    text += channel("laser", "velocity", **place, direction=[0, 0, 1])
    text += channel("side", "acceleration", **place, direction=[1, 0, 0])
    text += channel("Fz", "output", channel="Fz", scale_uncertainty=1e-4) + channel("trigger", "trigger")
    points = {"stereo": "top", "files": "points.csv", "columns": ["frame", "id", "x", "y", "z"], "trigger": "trigger"}
    (folder / "recording.toml").write_text(text + block("[points]", **points))
    return folder


def test_noise_with_points_gives_six_components_and_sensitivity(tmp_path):
    evaluation = evaluate_recording(write_recording(tmp_path), Settings())
    assert evaluation.lines.nominal_hz == pytest.approx(LINES_HZ)
    seen = evaluation.stereo[0].phasors
    ratio = seen.value / seen.value[:, 2:3]
    u = np.abs(ratio) * 0.0 + np.hypot(seen.u_re, seen.u_im) / np.abs(seen.value[:, 2:3])
    assert np.all(np.abs(ratio - RATIOS) < 4.0 * u + 1e-6)
    assert np.median(u[:, 3:]) < 2.0  # rad per m
    found = evaluation.sensitivity
    assert found is not None
    value, covariance = found.value[:, 0, 2], found.covariance[:, 0, 2]
    assert np.abs(value / SENSITIVITY - 1.0).max() < 2e-3
    assert np.all(np.abs(value - SENSITIVITY) < 3.5 * np.sqrt(np.trace(covariance, axis1=1, axis2=2)))
    assert not any("m/s²" in headline.value for headline in headlines(evaluation))  # of equivalent sines


def test_a_chirp_that_does_not_begin_at_rest_is_named(tmp_path):
    evaluation = evaluate_recording(write_recording(tmp_path, "chirp"))
    (notice,) = [one for one in evaluation.notices if one.code == EVALUATED_AS_NOISE.code]
    assert notice.values["end"] == "beginning"


def test_run_requires_a_band_frequencies_within_it_and_motion(tmp_path):
    write_recording(tmp_path)
    manifest = tmp_path / "recording.toml"
    text = manifest.read_text()
    edit(manifest, "band = [40.0, 300.0]\n", "")
    with pytest.raises(InputError) as caught:
        evaluate_recording(tmp_path)
    assert (caught.value.code, caught.value.key) == ("SC-939", "excitation.band")
    manifest.write_text(text.replace("260.0]", "600.0]"))
    with pytest.raises(InputError) as caught:
        evaluate_recording(tmp_path)
    assert (caught.value.code, caught.value.key) == ("SC-939", "excitation.frequencies")
    manifest.write_text(text.partition("[[points]]")[0])
    with pytest.raises(InputError) as caught:
        evaluate_recording(tmp_path)
    assert caught.value.key == "excitation.kind"
    assert select_kinds([manifest], kinds_of("run"), images=True) == [manifest]  # none: all, for the message
    manifest.write_text(text)
    assert [one.is_broadband for one in load_for_command([tmp_path], "run")] == [True]
    assert load_manifest(tmp_path).excitation.kind == "noise"


@pytest.mark.slow
def test_a_sweep_agrees_with_the_closed_form_of_a_rig_in_the_time_domain(tmp_path):
    order = Order(kind="chirp", draw=1, poses=True, duration_s=12.0)
    truth = write(order, tmp_path / "sweep")
    evaluation = evaluate_recording(tmp_path / "sweep")
    found, hertz = evaluation.element, np.array(truth["frequencies"])
    assert found is not None
    place = found.elements.index((2, 2))
    true = np.array(truth["sensitivity"]["re"])[:, 2, 2] + 1j * np.array(truth["sensitivity"]["im"])[:, 2, 2]
    value = found.value[:, 2, 2]
    expected = np.interp(evaluation.lines.frequency_hz, hertz, true.real)
    u = np.array([line[place].expanded_magnitude for line in found.polar])
    assert np.mean(np.abs(value.real - expected) < u) >= 0.8
