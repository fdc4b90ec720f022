"""Load models against state-space matrices, published resonances, closed formulas and records that scipy integrated."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from contracts import coverage_contract, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from release_factory import other_numbers, reading_of, two_masses
from scipy.integrate import solve_ivp
from scipy.signal import StateSpace, lsim

from shaker.model_notices import (
    AMBIGUOUS_SOLUTIONS,
    LOADS_AMPLITUDE_DEPENDENT,
    LOSS_FACTOR,
    MASS_CONTRADICTED,
    SECOND_MODE_EXCLUDED,
    SERIES_SCATTER,
    THREE_MASSES,
)
from shaker.release.load_model import (
    LoadModel,
    change_limit,
    figures_u,
    first_mode_hz,
    formula_limit,
    frequency_limit,
    load_curve,
    rigid_formula_hz,
    upper_poles,
    working_bands,
)
from shaker.release.load_modes import (
    FreeDecay,
    Resonances,
    SeriesMasses,
    SeriesOutput,
    as_resonances,
    free_decay,
    project_amplitudes,
    record_modes,
    stated_masses,
    stated_resonances,
)
from shaker.release.load_series import fit_resonances, identify_loads
from shaker.release.record import StepRecord

LOADS = np.array([0.0, 0.008, 0.048, 0.098, 0.198])
PUBLISHED_HZ, MOVING = np.array([500.0, 486.0, 450.0, 393.0, 320.0]), 0.240
OUTPUT = SeriesOutput("Fy", "Fy", "V")
NUMBERS = (2.36e6, 6.0, 1.89e6, 4.0)
U = np.diag([2e2, 1e-2, 1e3, 5e-2])
MODEL = LoadModel("Fy", "Fy", "V", MOVING, *NUMBERS, covariance=U**2, u_moving_mass=1e-4)
RIGID = LoadModel("Fy", "Fy", "V", MOVING, *NUMBERS[:2], covariance=np.diag([1e4, 1e-2]) ** 2, u_moving_mass=1e-3)


def state_poles(m: float, ml: float, numbers: np.ndarray) -> np.ndarray:
    """Poles as eigenvalues of the two equations of motion, by magnitude and, within a pair, by imaginary part."""
    poles = np.linalg.eigvals(two_masses(m, ml, numbers))
    return poles[np.lexsort((poles.imag, np.round(np.abs(poles) / np.abs(poles).max(), 9)))]


masses, springs = st.floats(0.005, 2.0), st.floats(1e5, 1e8)
ratios = st.floats(1e-4, 0.05)


@settings(max_examples=30, deadline=None)
@given(masses, masses, springs, springs, ratios, ratios)
def test_poles_and_their_derivatives(m, ml, k, kl, zeta, other):
    numbers = np.array([k, 2.0 * zeta * np.sqrt(k * m), kl, 2.0 * other * np.sqrt(kl * min(m, ml))])
    poles, moved = upper_poles(numbers, m, ml)
    every = state_poles(m, ml, numbers)
    np.testing.assert_allclose(poles, every[every.imag > 0], rtol=1e-7)
    whole = np.array([*numbers, m, ml])
    for index, value in enumerate(whole):
        step = np.where(np.arange(6) == index, 1e-5 * value, 0.0)
        up, down = (upper_poles(v[:4], v[4], v[5])[0] for v in (whole + step, whole - step))
        slope, scale = (up - down) / (2e-5 * value), np.abs(poles) / value
        np.testing.assert_allclose(moved[:, index] / scale, slope / scale, atol=2e-5)


def test_published_series():
    found = identify_loads(stated_resonances(PUBLISHED_HZ), stated_masses(MOVING, 0.0, LOADS), OUTPUT)
    model = found.model
    assert not model.is_rigid
    assert (model.solutions, model.stiffness) == (1, pytest.approx(2.355e6, rel=1e-3))
    assert model.coupling_stiffness == pytest.approx(1.892e6, rel=1e-3)
    curve = load_curve(model, LOADS)
    assert np.max(np.abs(curve.frequency_hz[:, 0] / PUBLISHED_HZ - 1.0)) < 0.01
    np.testing.assert_allclose(curve.frequency_hz[1:, 1], [2490.0, 1117.0, 884.0, 767.0], rtol=1e-3)
    formula = np.array([rigid_formula_hz(replace(model, stiffness=2.36e6), float(load)) for load in LOADS])
    np.testing.assert_allclose(formula, [499.1, 491.0, 455.6, 420.6, 369.4], atol=0.06)
    assert 100.0 * (formula[-1] / PUBLISHED_HZ[-1] - 1.0) == pytest.approx(15.4, abs=0.1)
    notice = next(notice for notice in found.notices if notice.code == THREE_MASSES.code)
    assert notice.values["two_percent"] > 10.0 * notice.values["three_percent"]
    assert formula_limit(model, 0.05).load_mass == pytest.approx(0.081, abs=0.002)


def test_free_moving_mass_of_a_rigid_load():
    fit = fit_resonances(
        stated_resonances(PUBLISHED_HZ, np.full(5, 1e-2)), stated_masses(MOVING, 10.0, LOADS), rigid=True
    )
    moving = MOVING + 10.0 * fit[0].deviates[0]
    assert fit[0].numbers[0] == pytest.approx(1.43e6, rel=0.02)
    assert moving == pytest.approx(0.142, rel=0.02)
    assert np.max(np.abs(fit[0].frequency_hz[:, 0] / PUBLISHED_HZ - 1.0)) == pytest.approx(0.03, abs=0.003)


def exact(model: LoadModel, loads: np.ndarray, u: float, *, second: bool = True) -> Resonances:
    """Resonances and dampings as the matrices have them."""
    f, z = np.full((len(loads), 2), np.nan), np.full((len(loads), 2), np.nan)
    for r, load in enumerate(loads):
        poles = state_poles(model.moving_mass, float(load), model.vector)
        upper = poles[poles.imag > 0]
        f[r, : len(upper)], z[r, : len(upper)] = np.abs(upper) / (2 * np.pi), -upper.real / np.abs(upper)
    if not second:
        f[:, 1] = z[:, 1] = np.nan
    return Resonances(tuple("abcdefg"[: len(loads)]), f, u * f, z, 1e2 * u * z)


def identify_exact(loads: np.ndarray, u: float = 0.0, *, u_moving: float = 0.0, second: bool = True):
    """What exact resonances of some loads tell."""
    return identify_loads(exact(MODEL, loads, u, second=second), stated_masses(MOVING, u_moving, loads), OUTPUT)


def test_one_load_gives_both_solutions_and_a_second_separates_them():
    found = identify_exact(np.array([0.048]), 1e-5, u_moving=1e-4)
    assert [(model.solution, model.solutions) for model in found.models] == [(1, 2), (2, 2)]
    np.testing.assert_allclose(found.models[0].vector, MODEL.vector, rtol=1e-6)
    np.testing.assert_allclose(found.models[1].vector, other_numbers(MODEL.vector, MOVING, 0.048), rtol=1e-6)
    poles = [np.sort_complex(model.poles(0.048)) for model in found.models]
    np.testing.assert_allclose(poles[0], poles[1], rtol=1e-6)
    (notice,) = (notice for notice in found.notices if notice.code == AMBIGUOUS_SOLUTIONS.code)
    assert notice.values["count"] == 2
    (model,) = identify_exact(np.array([0.008, 0.048]), 1e-4, second=False).models
    np.testing.assert_allclose(model.vector, MODEL.vector, rtol=1e-5)


def test_modes_of_something_else_are_left_out():
    loads = np.array([0.0, 0.048, 0.198])
    seen = exact(MODEL, loads, 1e-4)
    f, z = seen.frequency_hz.copy(), seen.damping_ratio.copy()
    f[:2, 1], z[:2, 1] = [700.0, 640.0], 0.01
    strange = replace(seen, frequency_hz=f, u_frequency_hz=1e-4 * f, damping_ratio=z, u_damping_ratio=1e-2 * z)
    found = identify_loads(strange, stated_masses(MOVING, 0.0, loads), OUTPUT)
    np.testing.assert_allclose(found.model.vector, MODEL.vector, rtol=1e-4)
    assert found.notices[0].code == SECOND_MODE_EXCLUDED.code
    assert re.findall(r"[\d.]+", found.notices[0].values["modes"]) == ["700", "640", "0.048"]


def test_a_rigid_load_is_recognised_and_assumed_for_too_few_data():
    rng = np.random.default_rng(3)
    f = np.sqrt(2e6 / (MOVING + LOADS)) / (2 * np.pi)
    seen = f * (1.0 + 1e-3 * rng.standard_normal(5))
    found = identify_loads(stated_resonances(seen, 1e-3 * f), stated_masses(MOVING, 0.0, LOADS), OUTPUT)
    assert found.model.is_rigid
    assert (found.model.stiffness, formula_limit(found.model, 0.05)) == (pytest.approx(2e6, rel=3e-3), None)
    seen = stated_resonances(np.array([450.0]), np.array([1.0]))
    found = identify_loads(seen, stated_masses(MOVING, 0.0, LOADS[2:3]), OUTPUT)
    assert (found.model.is_rigid, found.elastic) == (True, ())
    assert found.model.stiffness == pytest.approx((2 * np.pi * 450.0) ** 2 * 0.288)


def test_masses_are_unknowns_with_their_uncertainty():
    plain, uncertain = (identify_exact(LOADS, 1e-6, u_moving=u).model for u in (0.0, 2.4e-4))
    assert uncertain.u_moving_mass == pytest.approx(2.4e-4, rel=0.01) or uncertain.u_moving_mass < 2.4e-4
    single = identify_exact(np.zeros(1), 1e-6, u_moving=2.4e-4).model
    u_plain, u_uncertain, u_single = (
        np.sqrt(m.total_covariance[0, 0]) / m.stiffness for m in (plain, uncertain, single)
    )
    assert u_uncertain > 1.5 * u_plain
    assert u_single == pytest.approx(1e-3, rel=1e-3)
    assert load_curve(single, np.zeros(1)).u_frequency_hz[0, 0] < 2e-6 * 499.1


def test_a_wrong_mass_gives_a_notice():
    stated = LOADS.copy()
    stated[3] += 5e-4
    found = identify_loads(exact(MODEL, LOADS, 1e-5), stated_masses(MOVING, 1e-5, stated, np.full(5, 1e-4)), OUTPUT)
    contradicted = {notice.values["cause"] for notice in found.notices if notice.code == MASS_CONTRADICTED.code}
    scattered = any(notice.code == SERIES_SCATTER.code for notice in found.notices)
    assert "load mass 0.0985 kg" in contradicted or scattered


def test_shared_parts_are_one_unknown():
    effect = np.array([[0.0], [1e-4], [1e-4]])
    masses = SeriesMasses(MOVING, LOADS[:3], ("adapter",), np.zeros(1), effect)
    moving, loads = masses.at(np.array([2.0]))
    assert moving == MOVING
    np.testing.assert_allclose(loads, LOADS[:3] + np.array([0.0, 2e-4, 2e-4]))
    np.testing.assert_allclose(masses.u_load, [0.0, 1e-4, 1e-4])


def test_limits_of_a_rigid_load():
    change, limit = change_limit(RIGID, 0.05), frequency_limit(RIGID, 400.0)
    assert change.load_mass == pytest.approx(MOVING * (0.95**-2 - 1.0), rel=1e-9)
    assert change.u == pytest.approx(1e-3 * (0.95**-2 - 1.0), rel=1e-4)
    omega = 2 * np.pi * 400.0
    assert limit.load_mass == pytest.approx(2.36e6 / omega**2 - MOVING, rel=1e-9)
    assert limit.u == pytest.approx(np.hypot(1e4 / omega**2, 1e-3), rel=1e-4)
    assert frequency_limit(RIGID, 600.0) is None


def test_limits_of_an_elastic_coupling():
    limit = formula_limit(MODEL, 0.05)
    assert rigid_formula_hz(MODEL, limit.load_mass) == pytest.approx(1.05 * first_mode_hz(MODEL, limit.load_mass))
    numbers = np.append(MODEL.vector, MOVING)
    moved = [numbers + step for step in np.diag(np.sqrt(np.diag(MODEL.total_covariance)))]
    limits = [formula_limit(replace(MODEL.with_numbers(one), covariance=None), 0.05).load_mass for one in moved]
    assert limit.u == pytest.approx(np.linalg.norm(np.array(limits) - limit.load_mass), rel=0.02)
    assert first_mode_hz(MODEL, frequency_limit(MODEL, 400.0).load_mass) == pytest.approx(400.0)
    assert formula_limit(replace(MODEL, coupling_stiffness=2.36e8), 0.05) is None


def test_bands_by_the_closed_formula():
    omega, zeta = np.sqrt(2.36e6 / MOVING), 6.0 / (2.0 * np.sqrt(2.36e6 * MOVING))
    bands = working_bands(RIGID, 0.0)
    for share, edge in zip((0.05, 0.10), bands, strict=True):
        ratio = (2 * np.pi * edge / omega) ** 2
        assert 1.0 / np.hypot(1.0 - ratio, 2 * zeta * np.sqrt(ratio)) == pytest.approx(1.0 + share, rel=1e-9)
    assert bands[1] == pytest.approx(150.5, abs=0.3)
    np.testing.assert_allclose(working_bands(replace(RIGID, damping=0.0), 0.0), bands, rtol=1e-4)


TRUE = MODEL.vector
RATE, DURATION, ONSET, RELEASE = 25e3, 0.5, 0.02, 0.4e-3
LEVEL = 4.0


@cache
def clean(load: float, smooth: bool = False) -> np.ndarray:
    """Output in V while a force vanishes from the load: 4 V before, 0 V at the end."""
    a = two_masses(MOVING, load, TRUE)
    b, row = np.zeros((len(a), 1)), np.eye(1, len(a))
    b[-1] = 1.0 / (load or MOVING)
    t = np.arange(round(RATE * DURATION)) / RATE
    done = np.clip((t - ONSET) / RELEASE, 0.0, 1.0)
    gone = 0.5 - 0.5 * np.cos(np.pi * done) if smooth else done
    change = lsim(StateSpace(a, b, row * TRUE[0], np.zeros((1, 1))), gone, t)[1]
    return np.asarray(LEVEL * (1.0 - change))


def decay_of(load: float, snr_db: float, rng: np.random.Generator, smooth: bool) -> FreeDecay:
    """The free oscillation of one record with noise and a 16-bit converter of ±10 V."""
    y = clean(load, smooth)
    y = y + LEVEL * 10.0 ** (-snr_db / 20.0) * rng.standard_normal(len(y))
    volts = np.round(y / (20.0 / 2**16)) * (20.0 / 2**16)
    record = StepRecord(f"{1e3 * load:g} g", ("Fy",), "V", volts[None], RATE, "Fy", -10.0)
    return free_decay(record, "Fy", reading_of(record, ONSET, RELEASE, u_onset_s=1e-4, u_release_s=1e-4))


def identified(loads, snr_db, seed, smooth=False, stated=None):
    """The whole way from records to the model; `stated`: masses that are taken for the true ones."""
    rng = np.random.default_rng(seed)
    decays = tuple(decay_of(load, snr_db, rng, smooth) for load in loads)
    modes = [record_modes(decay) for decay in decays]
    masses = stated_masses(MOVING, 0.0, np.array(stated or loads))
    return identify_loads(as_resonances(modes), masses, OUTPUT, decays, np.array([item.noise for item in modes]))


@pytest.mark.parametrize(
    ("loads", "snr_db", "seed", "smooth", "bars"),
    [
        (tuple(LOADS), 40.0, 1, False, [2e-5, 2e-3, 1e-4, 1e-2]),
        (tuple(LOADS), 20.0, 2, False, [2e-4, 2e-2, 1e-3, 1e-1]),
        ((0.048, 0.198), 40.0, 1, True, [5e-5, 5e-3, 2e-4, 2e-2]),
    ],
    ids=["five loads", "noisy", "smooth release"],
)
def test_records_of_several_loads_jointly(loads, snr_db, seed, smooth, bars):
    found = identified(loads, snr_db, seed, smooth)
    assert found.from_records
    assert found.model.solutions == 1
    assert np.all(np.abs(found.model.vector / TRUE - 1.0) < bars)


def test_records_that_contradict_the_model():
    loads = (0.0, 0.048, 0.098, 0.198)
    found = identified(loads, 40.0, 5, stated=(0.0, 0.048, 0.0990, 0.198))
    assert not found.from_records
    assert found.chosen[0].scatter[0] > 1e-4
    assert SERIES_SCATTER.code in {notice.code for notice in found.notices}
    u = np.sqrt(np.diag(found.model.covariance))
    assert np.all(np.abs(found.model.vector - TRUE)[::2] < 4.0 * u[::2])


@pytest.mark.parametrize("load", [0.048, 0.198])
def test_one_load(load):
    found = identified((load,), 40.0, 3)
    expected = sorted([TRUE, other_numbers(TRUE, MOVING, load)], key=lambda numbers: -numbers[2])
    for model, numbers in zip(found.models, expected, strict=True):
        np.testing.assert_allclose(model.vector, numbers, rtol=2e-2)
        np.testing.assert_allclose(model.vector[::2], numbers[::2], rtol=1e-4)


def test_a_bare_sensor_has_two_masses():
    found = identified((0.0,), 40.0, 4)
    assert found.model.is_rigid
    np.testing.assert_allclose(found.model.vector, TRUE[:2], rtol=2e-3)


def test_projection_removes_its_modes_completely():
    t = np.arange(400) / 8e3
    poles = np.array([-30.0 + 2j * np.pi * 400.0, -80.0 + 2j * np.pi * 900.0])
    amplitude = np.array([1.0 - 0.4j, 0.2 + 0.3j])
    decay = FreeDecay("sum", t, 0.7 + (np.exp(t[:, None] * poles) @ amplitude).real, 1)
    residual, slope = project_amplitudes(decay, poles)
    assert np.max(np.abs(residual)) < 1e-12
    for index in range(4):
        moved = poles + np.where(np.arange(2) == index // 2, (1e-3, 1e-3j)[index % 2], 0.0)
        np.testing.assert_allclose(project_amplitudes(decay, moved)[0] / 1e-3, slope[:, index], atol=2e-6)


def test_refusals():
    hertz, kilograms = stated_resonances(np.ones(1)), stated_masses(0.1, 0.0, np.ones(1))
    refused("^moving: ", stated_masses, 0.0, 0.0, LOADS)
    refused("^load: ", stated_masses, 0.1, 0.0, -LOADS)
    refused("^frequency_hz: ", stated_resonances, np.array([-1.0]))
    refused("^masses: ", fit_resonances, stated_resonances(PUBLISHED_HZ), kilograms, rigid=True)
    refused("^measured: ", fit_resonances, hertz, kilograms, rigid=False)
    refused("^permitted: ", change_limit, MODEL, 1.5)
    refused("^target_hz: ", frequency_limit, MODEL, 0.0)
    refused("^covariance: ", replace(MODEL, covariance=None).propagate, lambda m: m.vector)
    t = np.arange(40) / RATE
    short = StepRecord("short", ("Fy",), "V", np.tile(t, (1, 1)), RATE, "Fy", 1.0)
    uncertain = reading_of(short, ONSET, baseline=LEVEL, steady=0.0)
    refused("^record: .*short", free_decay, short, "Fy", uncertain)


@pytest.mark.slow
def test_intervals_cover_the_truth():
    def estimate(trial: int) -> tuple[np.ndarray, np.ndarray]:
        model = identified((0.008, 0.048, 0.198), 40.0, 100 + trial).model
        return model.vector, model.covariance

    alone = [estimate(trial) for trial in range(16)]
    coverage_contract(lambda trial: alone[trial], TRUE, 16)
    coverage_contract(lambda trial: (alone[trial][0], 1.96 * np.sqrt(np.diag(alone[trial][1]))), TRUE, 16)


@pytest.mark.parametrize(("damping_ratio", "u_damping"), [(0.02, 0.1), (0.56, 0.03)])
def test_u_of_a_band_covers_the_ends_of_sampled_models(damping_ratio, u_damping):
    """Light damping, where a band goes with the root of the stiffness; and a peak that may touch +10 %, where it jumps.

    Of one mode |H|² = 1/[(1 - x)² + 4ζ²x], x = (f/fn)²: where it first leaves 0.9 to 1.1, solved for every draw.
    """
    mass, spring = 0.24, 2.4e6
    damper = 2.0 * damping_ratio * np.sqrt(spring * mass)
    covariance = np.diag([(0.01 * spring) ** 2, (u_damping * damper) ** 2])
    model = LoadModel("Fz", "Fz", "V", mass, spring, damper, covariance=covariance)
    u, seen = figures_u(model, lambda one: working_bands(one, 0.0, (0.1,)))
    drawn = np.random.default_rng(6).multivariate_normal([spring, damper], covariance, size=4000)
    zeta, hertz = drawn[:, 1] / 2.0 / np.sqrt(drawn[:, 0] * mass), np.sqrt(drawn[:, 0] / mass) / (2.0 * np.pi)
    middle = 1.0 - 2.0 * zeta**2
    up, down = (middle**2 - 1.0 + level**-2 for level in (1.1, 0.9))
    high, low = middle - np.sqrt(np.maximum(up, 0.0)), middle + np.sqrt(down)
    bands = hertz * np.sqrt(np.where((up > 0.0) & (middle > 0.0), high, low))
    (value,) = working_bands(model, 0.0, (0.1,))
    assert np.mean(np.abs(bands - value) < 1.96 * u[0]) > 0.94
    if damping_ratio < 0.1:
        assert u[0] == pytest.approx(0.5 * 0.01 * value, rel=1e-2)  # f goes with the root of k
        assert u[0] == pytest.approx(np.std(bands), rel=0.05)
    else:
        assert seen.low[0] < 0.8 * value  # at the two ends of the model the band ends before and behind the peak


SPRING, DAMPER = 2.36e6, 6.0


def _decay_of(load: float, softening: float, drag: float, rng: np.random.Generator) -> FreeDecay:
    """Decay of a rigid load from a displacement of 1, integrated: k·(1 - s·q²), c·(1 + d·|q'|/ω)."""
    mass, omega = MOVING + load, float(np.sqrt(SPRING / (MOVING + load)))

    def motion(_: float, x: np.ndarray) -> list[float]:
        damping = DAMPER / mass * (1.0 + drag * abs(x[1]) / omega)
        return [x[1], -(omega**2) * x[0] * (1.0 - softening * x[0] ** 2) - damping * x[1]]

    time_s = np.arange(2000) / 8e3
    found = solve_ivp(motion, (0.0, 0.25), [1.0, 0.0], "DOP853", time_s, rtol=1e-9, atol=1e-12)
    return FreeDecay(f"{load:g}", time_s, found.y[0] + 0.003 * rng.standard_normal(2000), 1)


def _identified(softening: float, drag: float):
    rng, loads = np.random.default_rng(3), np.array([0.0, 0.05, 0.2])
    decays = tuple(_decay_of(load, softening, drag, rng) for load in loads)
    modes = [record_modes(decay) for decay in decays]
    noise = np.array([one.noise for one in modes])
    masses = stated_masses(MOVING, 2e-5, loads, 0.0 * loads)
    return identify_loads(as_resonances(modes), masses, OUTPUT, decays, noise, tuple(one.poles for one in modes))


@pytest.mark.parametrize(("softening", "drag"), [(0.005, 0.0), (0.0, 0.5)])
def test_linear_models_within_the_amplitudes_are_in_the_uncertainty(softening, drag):
    found = _identified(softening, drag)
    assert LOADS_AMPLITUDE_DEPENDENT.code in {notice.code for notice in found.notices}
    off = np.abs(found.model.vector - [SPRING, DAMPER])
    assert np.all(off < 2.0 * np.sqrt(np.diag(found.model.covariance)))


def test_a_linear_spring_depends_on_no_amplitude():
    assert LOADS_AMPLITUDE_DEPENDENT.code not in {notice.code for notice in _identified(0.0, 0.0).notices}


def test_a_constant_loss_factor_is_named_and_its_dampers_are_in_the_uncertainty():
    eta, loads = 0.008, np.array([0.0, 0.05, 0.1, 0.2])
    first = np.sqrt(SPRING / (MOVING + loads)) / (2.0 * np.pi)
    seen = stated_resonances(first, 1e-5 * first)
    zeta = np.stack([np.full(4, eta / 2.0), np.full(4, np.nan)], axis=1)
    seen = replace(seen, damping_ratio=zeta, u_damping_ratio=3e-3 * zeta)
    found = identify_loads(seen, stated_masses(MOVING, 0.0, loads), OUTPUT)
    assert LOSS_FACTOR.code in {notice.code for notice in found.notices}
    dampers = eta * np.sqrt(SPRING * (MOVING + loads))
    assert np.all(np.abs(found.model.damping - dampers) < 2.0 * np.sqrt(found.model.covariance[1, 1]))
