"""Chirp, noise and blows with the points of a camera pair: six components and sensitivity against a known motion."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from nonsinusoidal import matrices_of, true_matrix
from nonsinusoidal_rig import CAPACITY
from nonsinusoidal_truth import SINES_HZ, Order, write
from scipy.signal import chirp
from support import block, channel, edit

from fusion import Settings, evaluate_recording, load_for_command, load_manifest
from fusion.errors import InputError
from fusion.phasors.phasor_notices import LINES_WITHOUT_SIGNAL, ROWS_NEED_LINES
from fusion.planning.check import check
from fusion.recording.excitation import kinds_of
from fusion.recording.load import select_kinds
from fusion.report.tables import headlines
from shaker.signal_notices import EVALUATED_AS_NOISE

RATE_HZ, LENGTH_S, BAND_HZ, LINES_HZ = 4096.0, 8.0, [40.0, 300.0], [50.0, 90.0, 150.0, 260.0]
MASS_KG, SENSITIVITY, EXPOSURE_S = 2.0, 1e-6, 1e-4
RATIOS = np.array([0.02, -0.03, 1.0, 0.5, 0.8, -0.4])
"""Displacement of the load (m, m, m, rad, rad, rad) per m of its origin along z."""
NOISE_M = 2e-7


def write_recording(folder: Path, kind: str = "noise", *, rests: bool = False) -> Path:
    """Write a rigid load on a uniaxial sensor, with a laser, an accelerometer and points of a camera pair."""
    rng, count = np.random.default_rng(4), round(RATE_HZ * LENGTH_S)
    hertz, time_s = np.fft.rfftfreq(count, 1.0 / RATE_HZ), np.arange(count) / RATE_HZ
    inside = (hertz > 30.0) & (hertz < 330.0)
    spectrum = np.where(inside, rng.standard_normal(len(hertz)) + 1j * rng.standard_normal(len(hertz)), 0.0)
    if rests:  # a sweep from 35 to 330 Hz
        inside, moving = hertz > 2.0, np.clip((time_s - 0.4) / (LENGTH_S - 0.8), 0.0, 1.0)
        rise = np.minimum(1.0, 20.0 * np.minimum(moving, 1.0 - moving))
        swept = np.sin(np.pi / 2.0 * rise) ** 2 * chirp(moving * (LENGTH_S - 0.8), 35.0, LENGTH_S - 0.8, 330.0)
        spectrum = np.where(inside, np.fft.rfft(swept), 0.0)
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
            "across": RATIOS[0] * velocity + 1e-4 * rng.standard_normal(count),
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
    text = block(format=1, name="broadband", rig="rig.toml") + block("excitation", **excitation)
    text += block("[daq]", name="daq", file="daq.h5")
    place = {"body": "load", "point": [0.0, 0.0, 0.0], "scale_uncertainty": 1e-4}
    text += channel("across", "velocity", **place, direction=[1, 0, 0])  # no reference: it shows little motion
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


def test_ratios_of_a_sweep_hold_at_the_ends_of_the_band_and_only_where_it_excites(tmp_path):
    lowest_hz = 40.06  # half a line from the grid of the record
    edit(write_recording(tmp_path, "chirp", rests=True) / "recording.toml", "band = [40.0, ", f"band = [{lowest_hz}, ")
    edit(tmp_path / "recording.toml", "300.0]", "800.0]")
    edit(tmp_path / "recording.toml", "[50.0, 90.0, 150.0, 260.0]", f"[{lowest_hz}, 90.0, 500.0, 800.0]")
    evaluation = evaluate_recording(tmp_path)
    found = {one.name: one.phasors.value[:, 0] for one in evaluation.channels}
    expected = SENSITIVITY * MASS_KG * 2j * np.pi * np.array([lowest_hz, 90.0])
    assert found["Fz"] / found["laser"] == pytest.approx(expected, rel=2e-4)
    (notice,) = [one for one in evaluation.notices if one.code == LINES_WITHOUT_SIGNAL.code]
    assert notice.values["frequencies"] == "500, 800"


def test_run_requires_a_band_frequencies_within_it_and_motion(tmp_path):
    write_recording(tmp_path)
    manifest = tmp_path / "recording.toml"
    text = manifest.read_text()
    edit(manifest, "band = [40.0, 300.0]\n", "")
    with pytest.raises(InputError) as caught:
        evaluate_recording(tmp_path)
    assert (caught.value.code, caught.value.key) == ("SC-939", "excitation.band")
    manifest.write_text(text.replace("300.0]", f"{0.6 * RATE_HZ}]"))
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


def test_check_says_that_a_rolling_shutter_is_rejected(tmp_path, demo_recording):
    shutil.copytree(demo_recording, tmp_path / "demo")
    manifest = tmp_path / "demo" / "Fz-0080" / "recording.toml"
    edit(manifest, 'kind = "sine"', 'kind = "noise"\nband = [60.0, 100.0]')
    edit(manifest, 'harmonics = "auto"\n', "")
    rig = tmp_path / "demo" / "rig.toml"
    warned = []
    for line in ("[stereo.top]", "[stereo.top]\nrow_time = 1e-6"):
        edit(rig, "[stereo.top]", line)
        remarks = check(load_manifest(manifest)).remarks
        warned.append(any(ROWS_NEED_LINES.template.rstrip(".") in one for one in remarks))
    assert warned == [False, True]


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


@pytest.mark.slow
def test_six_sweeps_in_six_directions_give_the_matrix_over_frequency(tmp_path):
    fits, truth = matrices_of([Order("chirp", 1, poses=True, duration_s=8.0)], tmp_path)
    assert [hertz for hertz, *_ in fits] == pytest.approx(SINES_HZ)
    errors = np.array([(value - true_matrix(hertz, truth)).ravel() for hertz, value, _ in fits])
    variance = np.array([np.diag(uncertainty.covariance[0]) for *_, uncertainty in fits])
    covered = np.concatenate([errors.real, errors.imag], axis=1) ** 2 < 1.96**2 * variance
    assert covered.mean() >= 0.9  # the stated errors are those of one rig
    rated = np.abs(np.diag(true_matrix(SINES_HZ[0], truth))) * CAPACITY
    shares = np.sqrt(variance[:, :36]).reshape(-1, 6, 6) * CAPACITY / rated[:, None]
    assert np.median(shares) < 0.01
