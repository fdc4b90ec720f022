"""Clipped, lost and coarse samples of one channel through a whole evaluation: within U, or refused for that reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import AT_ORIGIN, block, channel, evaluated, recording_head, write_daq

from fusion.errors import InputError
from fusion.sensitivity.analyse import Evaluation
from shakercal._common.arrays import FloatArray

RATE_HZ, LINE_HZ, MASS = 2000.0, 106.25, 2.0
ACCELERATION, SENSITIVITY = 50.0 * np.exp(0.4j), 2e-6 * np.exp(-0.05j)
TIME = np.arange(20_000) / RATE_HZ
Change = Callable[[FloatArray], FloatArray]


def _evaluated(folder: Path, change: Change) -> Evaluation:
    """Evaluate an accelerometer on a load of 2 kg, its samples changed, and one output of the sensor below."""
    rng = np.random.default_rng(5)
    size = {"acc": (ACCELERATION, 1e-3), "Fz": (SENSITIVITY * MASS * ACCELERATION, 1e-9)}
    turn = np.exp(2j * np.pi * LINE_HZ * TIME)
    signals = {
        name: (value * turn).real + noise * rng.standard_normal(len(TIME)) for name, (value, noise) in size.items()
    }
    run = folder / "run"
    run.mkdir()
    write_daq(run / "daq.h5", RATE_HZ, signals | {"acc": change(signals["acc"])})
    sensor = block("sensor", name="S", channels=["Fz"], unit="V/V", sense="on_load", internal_mass=0.0)
    inertia = [[1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1e-3]]
    load = block("load", mass=MASS, mass_uncertainty=1e-4, centre_of_mass=[0.0, 0.0, 0.0], inertia=inertia)
    shaker = block("shaker", transverse_motion=1e-3, rocking_motion=1e-3)
    (folder / "rig.toml").write_text(block(format=1, name="bench") + sensor + load + shaker)
    channels = channel("acc", "acceleration", body="load", scale=1.0, scale_uncertainty=1e-4, **AT_ORIGIN)
    channels += channel("Fz", "output", channel="Fz", scale=1.0)
    (run / "recording.toml").write_text(recording_head("run", LINE_HZ) + channels)
    return evaluated(run)


def _within(low: float, high: float) -> Change:
    return lambda samples: np.clip(samples, low, high)


def _lost(begin: float, end: float, value: float) -> Change:
    noise = 0.02 * np.random.default_rng(6).standard_normal(len(TIME))
    inside = (begin <= TIME) & (end > TIME)
    return lambda samples: np.where(inside, noise if np.isinf(value) else value, samples)


def _filtered_after_clipping(samples: FloatArray) -> FloatArray:
    """A sine clipped at 80 % before an ideal low-pass: its Fourier series up to the fifth harmonic, in closed form."""
    angle, crest = 2.0 * np.pi * LINE_HZ * TIME + 0.4, np.arccos(0.8)
    series = np.zeros(len(TIME))
    for n in (1, 3, 5):
        x = np.linspace(-np.pi, np.pi, 20_001)
        series += np.mean(np.clip(np.cos(x), -np.cos(crest), np.cos(crest)) * np.cos(n * x)) * 2.0 * np.cos(n * angle)
    return np.asarray(50.0 * series + samples - 50.0 * np.cos(angle))


@pytest.mark.parametrize(
    ("change", "expected", "widest"),
    [
        (lambda samples: samples, "", 3e-4),
        (_within(-40.0, 40.0), "−40 and 40", 1e-3),
        (_within(-100.0, 30.0), " 30: ", 1e-3),
        (_filtered_after_clipping, "istortion", 0.3),
        (_lost(2.0, 8.0, 80.0), " 2 s to 7.9995 s", 1e-3),
        (_lost(4.0, 5.0, np.nan), " 4 s to 4.9995 s", 1e-3),
        (_lost(4.0, 8.0, np.inf), " 7.9985 s", 1e-3),
        (lambda samples: 10.0 * np.rint(samples / 10.0), " 5 ", 0.1),
        (lambda samples: 2e-3 * np.rint(samples / 2e-3), "", 3e-4),
    ],
)
def test_defects_of_samples_are_reported_and_included_in_u(
    tmp_path: Path, change: Change, expected: str, widest: float
) -> None:
    found = _evaluated(tmp_path, change)
    warned = [
        notice.text for notice in found.notices if notice.severity == "warning" and "acc" in notice.where + notice.text
    ]
    assert any(expected in text for text in warned) if expected else not warned
    assert found.sensitivity is not None
    line = int(np.argmin(np.abs(found.sensitivity.frequency_hz - LINE_HZ)))
    value = complex(found.sensitivity.value[line, 0, 2])
    u = float(np.sqrt(np.trace(found.sensitivity.uncertainty.covariance[line])))
    assert abs(value - SENSITIVITY) < 2.5 * u < 2.5 * widest * abs(SENSITIVITY)


@pytest.mark.parametrize(
    ("change", "numbers"),
    [(_within(-20.0, 20.0), "−20 and 20: 14750 "), (_lost(0.5, 9.6, 0.0), "0.5 s to 9.5995 s: 18200 ")],
)
def test_a_channel_with_too_few_usable_samples_is_refused(tmp_path: Path, change: Change, numbers: str) -> None:
    with pytest.raises(InputError, match=rf"daq\.h5: acc: .*{numbers}.* 20000 "):
        _evaluated(tmp_path, change)
