"""One curve over frequency: which recordings make it, relative to static, and interpolation with uncertainty."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contracts import refused
from numpy.typing import ArrayLike, NDArray
from simulated_drives import CAPACITY, MAIN, DriveErrors, drive_setup, eight_setups, simulate_drives, true_matrix

from fusion.campaign.campaign_figures import IN_LEGEND, SPREAD_OVER, _draw_mountings
from fusion.campaign.curve import (
    INTERPOLATION,
    MIN_POINTS,
    interpolate,
    interpolation_weights,
    matrix_curve,
    ratio_curves,
    relative_curve,
)
from fusion.campaign.excited_line import ExcitedLine
from fusion.campaign.matrix import fit_matrix
from fusion.report.figure import Panel, Points
from fusion.sensitivity.ratio import StatedMatrix
from shaker.labels import LOAD_COMPONENTS

AnyArray = NDArray[Any]
RESONANCE_HZ = 2500.0


def response(frequency_hz: ArrayLike) -> AnyArray:
    return np.asarray(1.0 / (1.0 - (np.asarray(frequency_hz) / RESONANCE_HZ) ** 2))


def sweep(lines: int = 12) -> tuple[list[ExcitedLine], AnyArray]:
    """Two mountings of an axial recording at every frequency, below a resonance; and the matrix at rest."""
    rng = np.random.default_rng(1)
    truth, errors = true_matrix(rng), DriveErrors(rng)
    found: list[ExcitedLine] = []
    for frequency in np.geomspace(50.0, 1000.0, lines).tolist():
        base = replace(drive_setup(rng, "", "z", (0.0, 0.0, 0.08)), frequency_hz=frequency)
        setups = [replace(base, recording=f"{frequency:.0f}-{m}", mounting=f"{m}") for m in range(2)]
        found += simulate_drives(setups, truth * response(frequency), errors)
    return found, truth


def test_elements_make_a_curve_that_lies_on_the_true_one_where_ratios_do_not():
    drives, truth = sweep()
    stated = StatedMatrix(LOAD_COMPONENTS, CAPACITY, truth.real, 1e-4, None, 1e-4)
    (element,) = ratio_curves(drives, CAPACITY.tolist(), stated)
    (ratio,) = ratio_curves(drives, CAPACITY.tolist())
    assert (element.kind, ratio.kind) == ("element", "ratio")
    true = truth[2, 2] * response(element.frequency_hz)
    off = np.abs(element.value[:, 2] / true - 1.0)
    assert np.all(off < 4.0 * np.sqrt(element.uncertainty.covariance[:, 2, 2]) / abs(truth[2, 2]))
    # What the ratio contains beside: cross-talk times the other loads. Its phase differs from the driven element's.
    load = np.array([drive.load for drive in drives[::2]])
    beside = np.delete(load * truth[2], 2, axis=1).sum(axis=1) / load[:, 2] * response(element.frequency_hz)
    taken_off = ratio.value[:, 2] - element.value[:, 2]
    assert np.all(np.abs(taken_off - beside) < 0.1 * np.abs(beside) + 1e-4 * np.abs(true))
    assert np.max(np.abs(beside / true)) > 5e-4
    # One unknown of the matrix at all frequencies, also where the curve is taken relative to it.
    relative = relative_curve(element, truth.real, 1e-4 * np.abs(truth))
    names = [i.name for i in relative.uncertainty.influences if i.name.startswith("static")]
    assert len(set(names)) == len(names) == 36


def test_ratios_make_one_curve_per_driven_component():
    drives, truth = sweep()
    rng = np.random.default_rng(3)
    setup = replace(drive_setup(rng, "x", "x", (0.0, 0.0, 0.05)), frequency_hz=drives[0].frequency_hz)
    along_x, along_z = ratio_curves([*simulate_drives([setup], truth, DriveErrors(rng)), *drives], CAPACITY.tolist())
    assert along_x.elements == tuple((c, 0) for c in range(6))
    assert along_z.elements == tuple((c, 2) for c in range(6))
    assert along_z.value.shape == (12, 6)
    assert along_z.recordings[0] == ("50-0", "50-1")
    assert along_z.name(2) == "Fz/Fz"
    u = np.sqrt(along_z.uncertainty.covariance[:, 2, 2])
    true = truth[2, 2].real * response(along_z.frequency_hz)
    # Other components of the motion, one per cent of it, come in by the cross-talk of two per cent.
    assert np.all(np.abs(along_z.value[:, 2].real - true) < 4.0 * u + 2e-3 * np.abs(true))
    assert along_z.kind == "ratio"
    refused("^recordings: .*12", replace, along_z, recordings=())


def test_of_several_lever_arms_the_purest_is_on_the_curve():
    rng = np.random.default_rng(5)
    setups = [drive_setup(rng, name, "z", (x, 0.0, 0.08)) for name, x in (("arm", 0.15), ("axis", 0.0), ("far", -0.2))]
    (curve,) = ratio_curves(simulate_drives(setups, true_matrix(rng), DriveErrors(rng)), CAPACITY.tolist())
    assert curve.recordings == (("axis",),)


def test_a_missing_output_of_a_frequency_is_nan():
    drives, _ = sweep(lines=6)
    forces = slice(3)
    fewer = [
        replace(d, outputs=d.outputs[forces], outputs_uncertainty=d.outputs_uncertainty.at([0, 1, 2]),
                channels=LOAD_COMPONENTS[forces])
        for d in drives[:2]
    ]  # fmt: skip
    (curve,) = ratio_curves([*fewer, *drives[2:]], CAPACITY.tolist())
    assert curve.channels == LOAD_COMPONENTS
    assert np.isnan(curve.value[0, 3:]).all()
    assert np.isfinite(curve.value[0, :3]).all()
    covariance = curve.uncertainty.covariance
    assert np.isnan(covariance[0, 3, 3])
    assert np.isfinite(covariance[0, :3, :3]).all()
    assert np.isfinite(covariance[1:]).all()
    wanted = np.array([200.0, 500.0])
    between = interpolate(curve, wanted)
    assert np.isfinite(between.value).all()
    few = interpolate(replace(curve, value=np.where(np.arange(6)[:, None] < 2, np.nan, curve.value)), wanted)
    assert np.isnan(few.value).all()
    assert np.isnan(few.uncertainty.covariance[0, 0, 0])


def test_matrices_make_a_curve_that_shares_its_unknowns():
    rng = np.random.default_rng(7)
    truth, errors = true_matrix(rng), DriveErrors(rng)
    setups = eight_setups(rng)
    fits = []
    for frequency in (200.0, 100.0):
        there = [replace(setup, frequency_hz=frequency) for setup in setups]
        fits.append(fit_matrix(simulate_drives(there, truth * response(frequency), errors)))
    curve = matrix_curve(fits)
    assert curve.frequency_hz.tolist() == [100.0, 200.0]
    assert curve.kind == "matrix"
    assert curve.value.shape == (2, 36)
    assert len(curve.recordings[0]) == 8
    effects = {i.name: i.effect for i in curve.uncertainty.influences}
    assert np.all(effects["laser: scale"][:, 14] != 0.0)
    covariance = np.concatenate([fits[1].uncertainty.covariance, fits[0].uncertainty.covariance])
    np.testing.assert_allclose(curve.uncertainty.covariance, covariance, rtol=1e-9, atol=1e-30)
    refused("^fits: ", matrix_curve, [fits[0], replace(fits[1], channels=LOAD_COMPONENTS[::-1])])


def test_relative_to_static():
    drives, _ = sweep()
    (curve,) = ratio_curves(drives, CAPACITY.tolist())
    found = relative_curve(curve, np.diag(MAIN), 1e-3 * np.diag(MAIN))
    assert found.elements == ((2, 2),)
    np.testing.assert_allclose(found.value[:, 0], curve.value[:, 2] / MAIN[2])
    parts = {part.label: part.covariance for part in found.uncertainty.grouped()}
    np.testing.assert_allclose(np.sqrt(parts["static sensitivity"][:, 0, 0]), 1e-3 * found.value[:, 0].real, rtol=1e-6)
    exact = relative_curve(curve, np.diag(MAIN), np.zeros((6, 6)))
    assert len(exact.uncertainty.influences) == len(curve.uncertainty.influences)
    assert relative_curve(curve, np.zeros((6, 6)), np.zeros((6, 6))) is None


def test_interpolation_keeps_common_errors_of_all_points():
    drives, truth = sweep()
    (curve,) = ratio_curves(drives, CAPACITY.tolist())
    found = interpolate(curve, np.linspace(60.0, 950.0, 9))
    true = truth[2, 2] * response(found.frequency_hz)
    covariance = found.uncertainty.covariance
    u = np.sqrt(covariance[:, 2, 2])
    assert np.all(np.abs((found.value[:, 2] - true).real) < 4.0 * u + 2e-3 * np.abs(true))
    effects = {i.name: i.effect[:, 2] for i in found.uncertainty.influences}
    np.testing.assert_allclose(effects["laser: scale"] / -found.value[:, 2].real, 2.5e-4, rtol=1e-3)
    # Scales of motion, amplifier and channel, and the mass.
    assert np.all(u / np.abs(found.value[:, 2]) > np.linalg.norm([2.5e-4, 1e-4, 1e-4, 1e-3 / 9.73]) * 0.999)
    assert INTERPOLATION in {part.label for part in found.uncertainty.random}
    assert found.recordings == ((),) * 9
    refused("^target_hz: .*2000", interpolate, curve, np.array([2000.0]))


def test_weights_reproduce_a_parabola_and_points_without_noise():
    rng = np.random.default_rng(0)
    frequency = np.sort(rng.uniform(50.0, 1000.0, 14))
    value = response(frequency) + 1e-4 * rng.standard_normal(14)
    wanted = np.linspace(frequency[0], frequency[-1], 21)
    found = interpolation_weights(frequency, value, np.full(14, 1e-8), wanted)
    np.testing.assert_allclose(found.weight.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(found.weight @ frequency**2, wanted**2, rtol=1e-6)
    assert found.dof == 11.0
    predicted = found.weight @ value
    error = np.abs(predicted - response(wanted))
    noise = found.weight**2 @ np.full(14, 1e-8)
    assert np.all(error < 4.5 * np.sqrt(found.variance + noise))
    exact = interpolation_weights(frequency, value, np.zeros(14), frequency)
    np.testing.assert_allclose(exact.weight @ value, value, rtol=1e-6)
    assert np.all(exact.variance < 1e-10)
    few = np.arange(1.0, MIN_POINTS)
    refused(f"^frequency_hz: .*{MIN_POINTS}.*{MIN_POINTS - 1}", interpolation_weights, few, few, few, few)


@pytest.mark.slow
def test_interpolated_values_are_covered():
    from scipy.stats import t

    rng, inside, ratio = np.random.default_rng(1), [], []
    for _ in range(60):
        frequency = np.sort(np.concatenate([[50.0, 1000.0], rng.uniform(50.0, 1000.0, 10)]))
        resonance = rng.uniform(1400.0, 3000.0)
        wanted = np.linspace(60.0, 980.0, 40)
        noise = 10.0 ** rng.uniform(-5.0, -3.0)
        value = 1.0 / (1.0 - (frequency / resonance) ** 2) + noise * rng.standard_normal(12)
        found = interpolation_weights(frequency, value, np.full(12, noise**2), wanted)
        u = np.sqrt(found.variance + found.weight**2 @ np.full(12, noise**2))
        error = found.weight @ value - 1.0 / (1.0 - (wanted / resonance) ** 2)
        inside.append(np.abs(error) <= t.ppf(0.975, found.dof) * u)
        ratio.append(np.median(u) / noise)
    assert 0.9 < np.mean(inside) < 0.99
    assert np.median(ratio) < 10.0


def test_a_legend_of_many_mountings_counts_the_others():
    panel, mountings = Panel(), [f"{number:03d}" for number in range(300)]
    _draw_mountings(panel, [(80.0, mounting) for mounting in mountings], np.zeros(300), 1000.0)
    drawn = [mark for mark in panel.marks if isinstance(mark, Points)]
    right = max(mark.x.max() for mark in drawn)
    labels = list(dict.fromkeys(mark.label for mark in drawn))
    assert labels[0] == "mounting 000"
    assert labels[-1] == f"{300 - IN_LEGEND} more mountings"
    assert len(labels) == IN_LEGEND + 1
    assert drawn[-1].names == ("mounting 299",)
    assert 80.0 < right <= 80.0 + SPREAD_OVER * 1000.0 + 1e-9
