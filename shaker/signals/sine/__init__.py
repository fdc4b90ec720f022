"""Sine approximation with known and unknown frequencies, above and below the Nyquist rate, of records of any length."""

from shaker.signals.folding import alias_frequency, beat_phase, exposure_gain, folded_harmonics
from shaker.signals.sine.dense import SineSolution, sine_amplitudes, solve_sines
from shaker.signals.sine.fit import fit_sines
from shaker.signals.sine.result import SineFit
from shaker.signals.sine.solve import SineModel
from shaker.signals.sine.times import UniformTimes

__all__ = [
    "SineFit",
    "SineModel",
    "SineSolution",
    "UniformTimes",
    "alias_frequency",
    "beat_phase",
    "exposure_gain",
    "fit_sines",
    "folded_harmonics",
    "sine_amplitudes",
    "solve_sines",
]
