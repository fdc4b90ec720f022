"""How often the 95 % regions hold the truth of recordings simulated at the level of phasors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom
from simulated_phasors import CASES, case_setup, simulate_phasors

from fusion.estimation.uncertainty import region_factor
from fusion.sensitivity.analyse import analyse
from fusion.simulate.world import Draws

TRIALS = 60


def inside(error: complex, covariance: np.ndarray, dof: float) -> bool:
    stacked = np.array([error.real, error.imag])
    return bool(stacked @ np.linalg.solve(covariance, stacked) <= region_factor(dof) ** 2)


def test_readings_without_errors_give_the_truth_back() -> None:
    # The exact readings and the rows of the linear model have no code in common.
    setup = case_setup(CASES[2])
    (pair,) = setup.pairs
    quiet = replace(pair.reading.phasors, covariance=1e-10 * pair.reading.phasors.covariance)
    setup = replace(
        setup,
        pairs=(replace(pair, reading=replace(pair.reading, phasors=quiet)),),
        channels=tuple(replace(channel, noise=1e-5 * channel.noise) for channel in setup.channels),
    )
    known, truth = simulate_phasors(setup, Draws(1, False))
    found = analyse(known.inputs)
    assert found.load is not None
    fused = found.accelerations[0].phasors.value
    np.testing.assert_allclose(fused, truth.acceleration, atol=1e-5 * np.abs(truth.acceleration).max())
    np.testing.assert_allclose(found.load.value, truth.load, atol=1e-5 * np.abs(truth.load).max())


@pytest.mark.slow
@pytest.mark.parametrize("place", range(len(CASES)), ids=[case.name for case in CASES])
def test_regions_hold_the_truth_as_often_as_they_claim(place: int) -> None:
    case, setup = CASES[place], case_setup(CASES[place])
    driven, counts, errors = case.driven, np.zeros(3), []
    for seed in range(1, TRIALS + 1):
        known, truth = simulate_phasors(setup, Draws(seed, True))
        found = analyse(known.inputs)
        assert found.load is not None
        assert found.sensitivity is not None
        fused, load, ratio = found.accelerations[0], found.load, found.sensitivity
        pair = np.ix_([driven, driven + 6], [driven, driven + 6])
        results = (
            (fused.phasors.value[0, driven] - truth.acceleration[0, driven], fused.uncertainty.covariance[0][pair],
             fused.uncertainty.dof()[0, driven]),
            (load.value[0, driven] - truth.load[0, driven], load.uncertainty.covariance[0][pair],
             load.uncertainty.dof()[0, driven]),
            (ratio.value[0, driven, driven] - truth.outputs[0, driven] / truth.load[0, driven],
             ratio.covariance[0, driven, driven], ratio.dof[0, driven, driven]),
        )  # fmt: skip
        counts += [inside(complex(error), covariance, float(dof)) for error, covariance, dof in results]
        errors.append(results[0][0] / truth.acceleration[0, driven])
    # A program that covers 95 % passes all fifteen counts 99 times in 100.
    low, high = (binom.ppf(p, TRIALS, 0.95) for p in (0.0005, 0.9995))
    assert np.all((counts >= low) & (counts <= high)), counts
    spread = np.std(np.real(errors)) / np.sqrt(TRIALS)
    assert abs(np.mean(np.real(errors))) < 4.0 * spread + 3e-5
