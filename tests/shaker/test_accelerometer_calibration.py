"""A real accelerometer: the model fitted to its sinusoidal calibration predicts and corrects its shock calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real_data import SHOCK, SHOCK_RATE_HZ, Shock, as_sensor, read_shock

from shaker.identification.sensor import NO_CHAIN, Load, SensorModel, correct_record, usable_band

SEISMIC = Load(1.0, "force")


@pytest.fixture(scope="module")
def shock(data_dir: Path) -> Shock:
    folder = data_dir / "accelerometer_calibration"
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} does not exist")
    return read_shock(folder)


def test_files_are_labelled_right_and_phases_are_degrees(shock: Shock) -> None:
    assert (len(shock.frequency_hz), len(shock.input), len(shock.output)) == (49, 18000, 18000)
    ratio = np.abs(np.fft.rfft(shock.output)[1:6] / np.fft.rfft(shock.input)[1:6])
    assert ratio == pytest.approx(np.abs(shock.value[0]), rel=0.025)
    # Read as rad the table would delay the output by 28 µs; the shock says less than 1 µs.
    assert abs(shock.delay_s()) < 1e-6
    fit = shock.fit(delay=False)
    assert fit.damping_ratio / (np.pi * fit.frequency_hz) < 1e-6


def test_model_of_the_table_predicts_the_shock(shock: Shock) -> None:
    fit = shock.fit(delay=True)
    assert fit.chi_squared / fit.dof == pytest.approx(1.0, abs=0.3)
    error = shock.error(fit.model)
    assert error.std() < 0.021
    assert error[SHOCK].std() < 0.05
    static = shock.error(lambda f: np.full(len(f), np.abs(shock.value[0]) + 0j))
    assert error.std() < 0.9 * static.std()
    assert np.abs(error).max() < 0.65 * np.abs(static).max()


def test_what_the_model_lacks_is_the_ringing(shock: Shock) -> None:
    error = np.abs(np.fft.rfft(shock.error(shock.fit(delay=True).model))) ** 2
    frequency = np.fft.rfftfreq(len(shock.input), 1.0 / SHOCK_RATE_HZ)
    ringing = (frequency > 40e3) & (frequency < 70e3)
    assert error[ringing].sum() > 0.7 * error.sum()


@pytest.mark.parametrize(("permitted", "tolerance"), [(0.01, 0.04), (0.05, 0.03), (0.10, 0.01)])
def test_band_of_the_model_is_where_the_table_rises(shock: Shock, permitted: float, tolerance: float) -> None:
    band = usable_band(as_sensor(shock.fit(delay=True)), SEISMIC, permitted)
    rise = np.abs(shock.value) / np.abs(shock.value[0])
    measured = float(np.interp(1.0 + permitted, rise, shock.frequency_hz))
    assert band.limit == "rise"
    assert band.upper_hz == pytest.approx(measured, rel=tolerance)


def test_corrected_output_has_the_peak_of_the_shock(shock: Shock) -> None:
    fit = shock.fit(delay=True)
    sensor, rigid = as_sensor(fit), SensorModel(1.0, 1e20, 0.0, 0.0, NO_CHAIN, np.zeros((4, 4)), "1/N")
    assert np.allclose(sensor.output_factor(shock.frequency_hz, SEISMIC), fit.model(shock.frequency_hz), rtol=2e-3)
    true, plain = (
        correct_record(record, SHOCK_RATE_HZ, rigid, SEISMIC, 20e3).force for record in (shock.input, shock.output)
    )
    corrected = correct_record(shock.output, SHOCK_RATE_HZ, sensor, SEISMIC, 20e3).force
    assert corrected.max() / true.max() == pytest.approx(1.0, abs=0.008)
    assert plain.max() / true.max() / np.abs(shock.value[0]) > 1.025
