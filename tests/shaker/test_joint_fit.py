"""One model fitted to several releases together, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from shaker.release.joint_fit import ReleasesFit, fit_jointly
from shaker.release.load_response import every_sample
from shaker.release.output_error import OutputErrorFit
from shaker.release.reading import read_release
from shaker.release.record import StepRecord
from shaker.release.step_fit import fit_step

FloatArray = NDArray[np.float64]
RATE_HZ, HERTZ, ZETA = 20e3, 500.0, 0.02
POLE = 2.0 * np.pi * HERTZ * (-ZETA + 1j * np.sqrt(1.0 - ZETA**2))


def ramp_response(time_s: FloatArray, length_s: float) -> FloatArray:
    """One mode of static gain 1 for a load that goes evenly within a length: the mean of its step responses."""
    swing = -1.0 / (1.0 - POLE / POLE.conjugate())  # 1 + 2·Re(swing·exp(pt)) starts at 0 without a slope

    def area(since: FloatArray) -> FloatArray:
        past = np.maximum(since, 0.0)
        return past + 2.0 * np.real(swing / POLE * np.expm1(POLE * past))

    return np.asarray((area(time_s) - area(time_s - length_s)) / length_s)


def record(seed: int, length_s: float, gain: float = 1.0, hum: float = 0.0, noise: float = 0.01) -> StepRecord:
    rng = np.random.default_rng(seed)
    time_s = np.arange(1600) / RATE_HZ
    volts = gain * ramp_response(time_s - 0.02 - rng.random() / RATE_HZ, length_s)
    volts += noise * rng.standard_normal(1600) + hum * np.sin(2 * np.pi * 50.0 * time_s + 1.0)
    return StepRecord(f"{seed}", ("Fz",), "V", volts[None], RATE_HZ, "Fz", 1.0)


def joint(records: list[StepRecord]) -> ReleasesFit:
    fits = [fit_step(one, "Fz", release="ramp").solution for one in records]
    wholes = [every_sample(one.samples[0], one.time_s, 1.0 / RATE_HZ) for one in records]
    found = [fit for fit in fits if fit is not None]
    return fit_jointly(found, wholes, found[0].problem.structure)


@pytest.fixture(scope="module")
def records() -> list[StepRecord]:
    return [record(seed, length) for seed, length in enumerate((3e-4, 5e-4, 7e-4, 4e-4))]


def test_one_model_of_four_releases_contains_the_truth_and_has_half_the_uncertainty_of_one(records):
    found, single = joint(records), joint(records[:1])
    u = np.sqrt(np.diag(found.model.covariance))
    assert found.consistent
    assert found.model.frequency_hz[0] == pytest.approx(HERTZ, abs=3.0 * u[0])
    assert found.model.damping_ratio[0] == pytest.approx(ZETA, abs=3.0 * u[1])
    assert found.model.static_gain == pytest.approx(1.0, abs=2e-3)
    assert u[:2] == pytest.approx(0.5 * np.sqrt(np.diag(single.model.covariance))[:2], rel=0.2)


def test_the_contributions_of_the_releases_cancel_and_are_as_large_as_stated(records):
    found = joint(records)
    u = np.sqrt(np.diag(found.model.covariance))[:2]
    assert np.all(np.abs(found.moves.mean(axis=0)[:2]) < 0.3 * u)
    assert found.covariances.mean(axis=0)[:2, :2] / 4.0 == pytest.approx(found.model.covariance[:2, :2], rel=1e-6)
    stated = np.sqrt(np.mean([np.diag(one)[:2] for one in found.covariances], axis=0))
    assert np.all(np.std(found.moves[:, :2], axis=0, ddof=1) < 2.5 * stated)


def test_a_release_of_more_noise_counts_less(records):
    noisy = [*records[:3], record(3, 4e-4, noise=0.1)]
    found = joint(noisy)
    variance = found.covariances[:, 0, 0]
    assert variance[3] < 0.1 * variance[:3].min()  # weight² times a variance 100 times as large


def test_releases_of_other_gains_do_not_share_a_model(records):
    assert not joint([*records[:3], record(3, 4e-4, gain=1.02)]).consistent


def test_hum_is_no_mode():
    clean, hum = record(5, 4e-4), record(5, 4e-4, hum=0.05)
    models = [fit_step(one, "Fz", reading=read_release(clean, "Fz")).model for one in (clean, hum)]
    assert [len(one.frequency_hz) for one in models if one is not None] == [1, 1]


def test_a_structure_that_no_fit_has_is_refused(records):
    fit = fit_step(records[0], "Fz", release="ramp").solution
    assert fit is not None
    whole = every_sample(records[0].samples[0], records[0].time_s, 1.0 / RATE_HZ)
    with pytest.raises(ValueError, match="structure"):
        fit_jointly([fit], [whole], replace(fit.problem.structure, modes=3))


def test_one_good_fit_of_a_release_is_enough_to_start_from(records):
    """Single fits may end at a lag and a release of the wrong size; the model of all must not."""
    fits = [fit for one in records if (fit := fit_step(one, "Fz", release="ramp").solution) is not None]
    order = fits[0].problem.structure.order

    def strayed(fit: OutputErrorFit) -> OutputErrorFit:
        vector = fit.vector.copy()
        vector[order - 1] -= 1.5  # a lag of 4.5 times the size
        vector[order + 1] += 1.2  # a release of 3.3 times the length
        return replace(fit, vector=vector)

    wholes = [every_sample(one.samples[0], one.time_s, 1.0 / RATE_HZ) for one in records]
    good = fit_jointly(fits, wholes, fits[0].problem.structure)
    found = fit_jointly([fits[0], *map(strayed, fits[1:])], wholes, fits[0].problem.structure)
    assert found.cost == pytest.approx(good.cost, abs=0.5)
    assert found.model.frequency_hz[0] == pytest.approx(HERTZ, abs=3.0 * np.sqrt(found.model.covariance[0, 0]))
