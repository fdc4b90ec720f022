"""Rival models of one set of curves: joints, laws of damping, filters, amplitudes; and what U covers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identification_factory import ALONG_Z, ComplexArray, FloatArray, recording, rigid_mass

from shaker.identification.amplitude import ExcitedLines, amplitude_effect
from shaker.identification.measured_curves import CurveError, MeasuredCurve, MeasuredTransfer
from shaker.identification.oscillator import fit_resonance
from shaker.identification.rival_models import (
    FittedRival,
    ModelChoice,
    RivalModel,
    added_uncertainty,
    choose_model,
    covering,
    unstated_lag_s,
    with_unstated_filters,
    without_uncertainty,
)
from shaker.identification.structure_fit import Identification, identify
from shaker.identification.structures import ChainStructure, SpringSuspension

K, B, MI, ETA = 4.5e8, 900.0, 0.766, 0.016
LOADS = (4.236, 8.798)
LINES = np.arange(300.0, 2400.0, 4.0)
LOSS_HZ = 1200.0


def _curves(
    ratio: Callable[[ComplexArray, float], ComplexArray], *, seed: int = 1, noise: float = 1e-3, **words: Any
) -> list[MeasuredTransfer]:
    """Two loads, each with one response; stated scale (0.2 %) and delay (0.2 µs), noise a share of the curve."""
    rng, s, found = np.random.default_rng(seed), 2j * np.pi * LINES, []
    for load in LOADS:
        value = ratio(s, load + MI)
        errors = [
            CurveError("top: scale", np.full((len(s), 1), 2e-3 + 0j)),
            CurveError("top: delay", -2e-7 * s[:, None]),
        ]
        curve = LINES, value, rigid_mass(load), ALONG_Z
        size = noise * (0.5 + np.abs(value))[:, None]
        found.append(recording(f"{load} kg", *curve, noise=size, rng=rng, errors=errors, **words))
    return found


def _spring(s: ComplexArray, mass: float, k: complex = K, b: float = B) -> ComplexArray:
    return np.asarray((k + b * s) / (k + b * s + mass * s * s))


def _mounted(s: ComplexArray, mass: float) -> ComplexArray:
    """Load on the sensor, whose foot of 2 kg stands on a mount ten times as stiff: two equations by Cramer's rule."""
    spring, mount = K + B * s, 10.0 * K + 2000.0 * s
    foot, load = 2.0 * s * s + spring + mount, mass * s * s + spring
    return np.asarray(spring * mount / (foot * load - spring**2))


def _fitted(records: Sequence[MeasuredTransfer]) -> Callable[[RivalModel], Identification | None]:
    def fitted(model: RivalModel) -> Identification | None:
        loss_hz = LOSS_HZ if model.loss_factor else 0.0
        structure = SpringSuspension((2,), loss_hz) if model.structure == "translation" else ChainStructure(2)
        curves = with_unstated_filters(records, ["base"] * len(records), model.filtered)
        try:
            return identify(curves, structure, each_recording=["damping_z"] if model.each else [])
        except ValueError:
            return None

    return fitted


def _richer(best: FittedRival) -> list[RivalModel]:
    model = best.model
    if best.identification.is_explained:
        return []
    others = [replace(model, structure="adapter"), replace(model, each=True, loss_factor=False)]
    return others + [replace(model, filtered=(*model.filtered, name)) for name in ("base", "top 1")]


def _choice(records: Sequence[MeasuredTransfer]) -> ModelChoice:
    return choose_model([RivalModel(), RivalModel(loss_factor=True)], _richer, _fitted(records))


def _within(found: Identification, name: str, true: float) -> bool:
    return abs(found.value(name) - true) < 3.0 * found.u(name)


def test_a_linear_damper_is_kept_and_no_other_model_is_tried():
    choice = _choice(_curves(_spring))
    assert choice.best.model == RivalModel()
    assert len(choice.tried) == 2
    assert covering(choice) is choice.best.identification
    assert _within(choice.best.identification, "stiffness_z", K)


def test_a_loss_factor_is_found_with_its_stiffness():
    choice = _choice(_curves(lambda s, mass: _spring(s, mass, K * (1.0 + 1j * ETA), 0.0)))
    found = choice.best.identification
    assert choice.best.model == RivalModel(loss_factor=True)
    assert found["loss_factor_z"].value == pytest.approx(ETA, abs=3.0 * found.u("loss_factor_z"))
    assert _within(found, "stiffness_z", K)
    for mode, load in zip(found.modes, LOADS, strict=True):
        assert mode.frequency_hz == pytest.approx(np.sqrt(K / (load + MI)) / (2.0 * np.pi), rel=1e-4)
        assert mode.damping_ratio == pytest.approx(0.5 * ETA, rel=1e-3)


def test_a_mount_that_gives_is_found_in_place_of_a_softer_sensor():
    choice = _choice(_curves(_mounted, noise=3e-4))
    found = covering(choice)
    assert choice.best.model.structure == "adapter"
    assert _within(found, "stiffness_z", K)
    simplest = next(rival for rival in choice.tried if rival.model == RivalModel())
    assert simplest.identification.value("stiffness_z") < 0.95 * K
    assert not simplest.identification.is_explained


def test_an_unstated_lag_is_found_in_its_channel():
    def lagged(s: ComplexArray, mass: float) -> ComplexArray:
        return np.asarray(_spring(s, mass) / (1.0 + 8e-6 * s))

    choice = _choice(_curves(lagged))
    assert len(choice.best.model.filtered) == 1
    found = covering(choice)
    for name, true in (("stiffness_z", K), ("damping_z", B), ("internal_mass", MI)):
        assert _within(found, name, true)
    lag_s, change = unstated_lag_s(found, choice.best.model.filtered[0], float(LINES[-1]))
    sign = 1.0 if choice.best.model.filtered[0] == "top 1" else -1.0
    assert sign * lag_s == pytest.approx(8e-6, rel=0.1)
    assert abs(change) == pytest.approx(0.5 * (2.0 * np.pi * LINES[-1] * 8e-6) ** 2, rel=0.3)


def test_different_dampings_are_separate():
    def ratio(s: ComplexArray, mass: float) -> ComplexArray:
        return _spring(s, mass, b=B if mass < 6.0 else 2.0 * B)

    choice = _choice(_curves(ratio))
    assert choice.best.model == RivalModel(each=True)
    values = [item.value for item in choice.best.identification.estimates if item.name.startswith("damping_z")]
    assert values == pytest.approx([B, 2.0 * B], rel=3e-3)


def test_where_every_model_is_rejected_the_simplest_has_no_u():
    def odd(s: ComplexArray, mass: float) -> ComplexArray:
        return np.asarray(_spring(s, mass) * (1.0 + 0.05 * np.sin(s.imag / 300.0)))

    choice = _choice(_curves(odd))
    assert choice.best.model in (RivalModel(), RivalModel(loss_factor=True))
    assert choice.best.identification.is_rejected
    assert choice.undecided == ()
    bare = without_uncertainty(choice.best.identification)
    assert bare.value("stiffness_z") == choice.best.identification.value("stiffness_z")
    assert np.isnan(bare.u("stiffness_z"))
    assert np.all(np.isnan(bare.covariance))


def test_u_covers_a_model_that_is_not_decided_against():
    best, other = (_fitted(_curves(_spring))(RivalModel(each=each)) for each in (False, True))
    assert best is not None
    assert other is not None
    moved = tuple(replace(item, value=1.1 * item.value) for item in other.estimates)
    rival = FittedRival(RivalModel("adapter"), replace(other, estimates=moved))
    found = covering(ModelChoice(FittedRival(RivalModel(), best), (), (rival,)))
    assert 2.0 * found.u("stiffness_z") > 1.1 * other.value("stiffness_z") - best.value("stiffness_z")
    assert found.u("stiffness_z") == pytest.approx(np.sqrt(found.covariance[0, 0]), rel=1e-9)
    total = np.sqrt(np.sum([change**2 for change in found.budget.values()], axis=0))
    np.testing.assert_allclose(total, [item.u for item in found.estimates], rtol=1e-6)


@pytest.mark.parametrize(("other", "u_other", "expected"), [(0.0, 1.0, 0.0), (10.0, 1.0, 5.73), (-10.0, 0.0, -4.9)])
def test_what_another_model_adds(other, u_other, expected):
    # Its value at half of k = 2, with 1.645/2 of its u for the side beyond; u = 1 is there already.
    assert added_uncertainty(0.0, 1.0, other, u_other) == pytest.approx(expected, abs=0.02)


def test_levels_of_one_load_show_a_change_with_the_amplitude():
    records = []
    for level in (-0.5, 0.5):
        of_level = _curves(
            lambda s, mass, level=level: _spring(s, mass, K * (1.0 - 0.01 * level), B * (1.0 + 0.1 * level))
        )
        records += [replace(one, name=f"{one.name} {level}", level=level) for one in of_level]
    found = identify(records, SpringSuspension((2,), by_amplitude=True))
    assert found.is_explained
    assert found.value("change_stiffness_z") == pytest.approx(-0.01 * K, rel=0.01)
    assert found.value("change_damping_z") == pytest.approx(0.1 * B, rel=0.05)
    assert _within(found, "internal_mass", MI)
    assert not [notice for notice in found.notices if notice.where.startswith("change")]
    choice = ModelChoice(FittedRival(RivalModel(by_amplitude=True), found), (), ())
    assert 2.0 * covering(choice).u("stiffness_z") > 0.005 * K


F0, ZETA, RATE, PERIOD = 100.0, 0.01, 1600.0, 1.0


def _shaken(softening: float, friction: float) -> tuple[MeasuredCurve, ExcitedLines]:
    """One settled period of a mass on a base, by the classical Runge-Kutta method.

    Both are shares of the largest linear force.
    """
    fine, harmonic = 8, np.arange(20, 400)
    count = round(RATE * PERIOD)
    spectrum = np.zeros(fine * count // 2 + 1, complex)
    spectrum[harmonic] = 0.5 * fine * count * np.exp(-1j * np.pi * np.arange(len(harmonic)) ** 2 / len(harmonic))
    base, w0 = np.fft.irfft(spectrum, fine * count), 2.0 * np.pi * F0
    s = 2j * np.pi * harmonic / PERIOD
    linear = np.zeros(fine * count // 2 + 1, complex)
    linear[harmonic] = -spectrum[harmonic] / (s * s + 2.0 * ZETA * w0 * s + w0 * w0)
    largest = float(np.abs(np.fft.irfft(linear, fine * count)).max())
    samples, step = [*base.tolist(), base[0]], 2.0 / (fine * RATE)

    def slope(y: float, v: float, a: float) -> float:
        rub = friction * largest * float(np.tanh(v / (1e-3 * w0 * largest)))
        return -2.0 * ZETA * w0 * v - w0 * w0 * (y - softening * y**3 / largest**2 + rub) - a

    y = v = 0.0
    motion = np.zeros(len(base) // 2)
    for period in range(3):
        for i in range(len(motion)):
            a0, a1, a2 = samples[2 * i : 2 * i + 3]
            motion[i] = -slope(y, v, 0.0) if period == 2 else 0.0
            k1 = slope(y, v, a0)
            k2 = slope(y + 0.5 * step * v, v + 0.5 * step * k1, a1)
            k3 = slope(y + 0.5 * step * (v + 0.5 * step * k1), v + 0.5 * step * k2, a1)
            k4 = slope(y + step * (v + 0.5 * step * k2), v + step * k3, a2)
            y, v = y + step * (v + step * (k1 + k2 + k3) / 6.0), v + step * (k1 + 2.0 * (k2 + k3) + k4) / 6.0
    phasor = np.exp(-1j * np.pi * np.arange(len(harmonic)) ** 2 / len(harmonic))
    top = -np.fft.rfft(motion)[harmonic] * 2.0 / len(motion)
    rng = np.random.default_rng(3)
    ratio = top / phasor + 3e-3 * (rng.standard_normal(len(top)) + 1j * rng.standard_normal(len(top)))
    frequency = harmonic / PERIOD
    excited = ExcitedLines(frequency, ratio, phasor)
    near: FloatArray = (frequency > 90.0) & (frequency < 112.0)
    return MeasuredCurve(frequency, ratio, np.tile(9e-6 * np.eye(2), (len(top), 1, 1))).at_lines(near), excited


@pytest.mark.parametrize(("softening", "friction"), [(0.0, 0.0), (0.01, 0.0), (0.0, 1e-3)])
def test_a_cubic_spring_and_dry_friction_are_found_in_one_record(softening, friction):
    curve, excited = _shaken(softening, friction)
    fit = fit_resonance(curve, "transmissibility")
    found = amplitude_effect(curve, fit, excited)
    if not softening and not friction:
        assert found is None
        assert fit.frequency_hz == pytest.approx(F0, rel=1e-4)
        return
    assert found is not None
    assert found.stiffening == pytest.approx(-softening, rel=0.15, abs=3e-4)
    assert found.friction == pytest.approx(friction, rel=0.3, abs=1e-4)
    assert fit.frequency_hz / (1.0 + found.frequency_change) == pytest.approx(F0, rel=3e-4)
    assert fit.damping_ratio / (1.0 + found.damping_change) == pytest.approx(ZETA, rel=0.03)
