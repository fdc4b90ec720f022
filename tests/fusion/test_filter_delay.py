"""A delay that may be a low-pass's has the attenuation of such a filter in U; a pure one has none."""

from __future__ import annotations

import numpy as np
import pytest
from bench_factory import ACCELERATION, FORCE_OUTPUT, SENSITIVITY, Bench, write_bench
from scipy import signal
from support import evaluated, refusals

from fusion.instruments.channel import DELAY_OF_FILTER
from fusion.phasors.phasor_notices import FILTER_DELAY
from shaker.frf.chain import filters_of_delay

SCALED = {"scale": 1.0, "scale_uncertainty": 1e-4}


def filtered(kind: str, order: int, corner_hz: float, hertz: float) -> tuple[complex, float]:
    """Response of a filter as scipy has it, and its delay at low frequencies."""
    design = signal.butter if kind == "butter" else signal.bessel
    b, a = design(order, 2 * np.pi * corner_hz, analog=True, **({} if kind == "butter" else {"norm": "mag"}))
    low = 1e-4 * corner_hz
    (_, (response, at_low)) = signal.freqs(b, a, 2 * np.pi * np.array([hertz, low]))
    return complex(response / abs(at_low)), float(-np.angle(at_low) / (2 * np.pi * low))


def run_with(tmp_path, response: complex, delay: float, hertz: float, **keys):
    output = Bench(FORCE_OUTPUT.phasor * response, "V/V", "output", {**SCALED, "delay": delay, **keys})
    channels = {"acc": Bench(ACCELERATION, "m/s^2", keys={"scale": 1.0, "scale_uncertainty": 5e-4}), "Fz": output}
    return write_bench(tmp_path, channels, hertz=hertz)


@pytest.mark.parametrize(("kind", "order"), [("bessel", 1), ("bessel", 8), ("butter", 2), ("butter", 8)])
@pytest.mark.parametrize(("corner_hz", "hertz"), [(2e3, 319.0), (5e3, 1020.0)])
def test_a_filter_stated_as_delay_is_in_U(tmp_path, kind, order, corner_hz, hertz):
    response, delay = filtered(kind, order, corner_hz, hertz)
    found = evaluated(run_with(tmp_path, response, delay, hertz))
    off = abs(found.sensitivity.value[0, 0, 2]) / abs(SENSITIVITY) - 1.0
    assert off == pytest.approx(abs(response) - 1.0, abs=1e-6)
    (element,) = found.sensitivity.polar[0]
    assert abs(off) <= element.expanded_magnitude / element.magnitude
    assert abs(np.angle(found.sensitivity.value[0, 0, 2] / SENSITIVITY)) <= element.expanded_phase_rad
    lines = {entry.label for entry in found.sensitivity.budget}
    assert any(DELAY_OF_FILTER in label for label in lines)
    (notice,) = (n for n in found.notices if n.code == FILTER_DELAY.code)
    assert notice.where.endswith("channel.Fz.delay")


def test_a_pure_delay_has_no_uncertainty(tmp_path):
    response, delay = np.exp(-2j * np.pi * 319.0 * 168e-6), 168e-6
    budgets = {}
    for name, keys in {"pure": {"delay_of": "pure"}, "unknown": {}, "filter": {"delay_of": "filter"}}.items():
        found = evaluated(run_with(tmp_path / name, response, delay, 319.0, **keys))
        assert abs(found.sensitivity.value[0, 0, 2] / SENSITIVITY - 1.0) < 1e-5
        budgets[name] = [entry.label for entry in found.sensitivity.budget if DELAY_OF_FILTER in entry.label]
        assert any(n.code == FILTER_DELAY.code for n in found.notices) == (name == "unknown")
    assert budgets["pure"] == []
    assert budgets["filter"] == budgets["unknown"] != []


def test_small_delays_do_not_matter(tmp_path):
    found = evaluated(run_with(tmp_path, np.exp(-2j * np.pi * 1000.0 * 1e-6), 1e-6, 1000.0))
    own = [e.u_relative[0, 0] for e in found.sensitivity.budget if DELAY_OF_FILTER in e.label]
    assert 0.0 < max(own) < 2e-5
    assert not [n for n in found.notices if n.code == FILTER_DELAY.code]


def test_filters_of_a_delay_have_this_delay():
    delay = 1e-4
    low = filters_of_delay(np.array([1.0]), delay)[:, 0]
    np.testing.assert_allclose(np.angle(low), 0.0, atol=1e-9)
    # (2πfτ)²/2 of a first order, (2πfτ)²/(2(2n - 1)) of Bessel's order n.
    x = 2 * np.pi * 50.0 * delay
    loss = 1.0 - np.abs(filters_of_delay(np.array([50.0]), delay)[:, 0])
    np.testing.assert_allclose(loss[:8], x**2 / (2 * (2 * np.arange(1, 9) - 1)), rtol=2e-3)
    assert np.all(loss[9:] < 0.02 * loss[0])


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"delay_of": "pure", "delay": 0.0}, "delay_of"),
        ({"delay_of": "filter", "delay": -1e-4}, "delay_of"),
        ({"delay_of": "bessel", "delay": 1e-4}, "delay_of"),
    ],
)
def test_a_kind_of_delay_without_that_delay_is_refused(tmp_path, capsys, keys, said):
    channels = {"acc": Bench(ACCELERATION, "m/s^2"), "Fz": Bench(FORCE_OUTPUT.phasor, "V/V", "output", keys)}
    assert said in refusals(capsys)("check", write_bench(tmp_path, channels))
