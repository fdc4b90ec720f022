"""The figures that describe how a sensor follows a load that changes."""

from __future__ import annotations

from dataclasses import dataclass

from shaker.notice import Notice

UNITS = {"hz": "Hz", "s": "s"}
LABELS = {
    "static_gain": "static gain",
    "natural_hz": "natural frequency of the dominant mode",
    "damped_hz": "damped frequency of the dominant mode",
    "damping_ratio": "damping ratio of the dominant mode",
    "peak_hz": "frequency of the highest gain",
    "peak_gain": "highest gain over the static gain",
    "quadrature_hz": "frequency at 90° of phase",
    "half_power_hz": "−3 dB",
    "band_5_hz": "±5 % of the static gain up to",
    "band_10_hz": "±10 % of the static gain up to",
    "band_5_nominal_hz": "±5 % of the nominal gain up to",
    "band_10_nominal_hz": "±10 % of the nominal gain up to",
    "overshoot": "overshoot",
    "rise_s": "rise time, 10 to 90 %",
    "settling_5_s": "settling time, ±5 %",
    "settling_2_s": "settling time, ±2 %",
}
"""The figures of `Indices` in the order of a table, with the words for them."""


@dataclass(frozen=True)
class Mode:
    """An oscillating mode: pole in rad/s, f_n = |p|/2π, f_d = Im p/2π, ζ = -Re p/|p|.

    `step_share`: amplitude of its oscillation after a step over the static gain, None where poles coincide.
    """

    pole: complex
    natural_hz: float
    damped_hz: float
    damping_ratio: float
    step_share: float | None


@dataclass(frozen=True)
class Indices:
    """Figures of one system; None where the system has no such figure.

    `modes` by natural frequency and `dominant`, the one that oscillates most after a step; `natural_hz`, `damped_hz`
    and `damping_ratio` are its. `peak_gain` is over the static gain. Bands end where |H| first leaves ±5 or ±10 % of
    |H(0)|, or of the nominal gain; infinite where it never does (at half the rate for samples); `half_power_hz`: where
    it first falls below |H(0)|/√2; `quadrature_hz`: where the phase first is 90° from that at rest. `overshoot`: the
    highest value after a step beyond the final one over the final one; `rise_s` from its first 10 % to its first 90 %;
    `settling_2_s`, `settling_5_s`: from where on the response stays within 2 or 5 % of the final value.
    """

    static_gain: float
    stable: bool
    modes: tuple[Mode, ...]
    dominant: Mode | None
    real_poles_hz: tuple[float, ...]
    peak_hz: float | None
    peak_gain: float | None
    quadrature_hz: float | None
    half_power_hz: float | None
    band_5_hz: float | None
    band_10_hz: float | None
    band_5_nominal_hz: float | None
    band_10_nominal_hz: float | None
    overshoot: float | None
    rise_s: float | None
    settling_2_s: float | None
    settling_5_s: float | None
    notices: tuple[Notice, ...] = ()

    @property
    def natural_hz(self) -> float | None:
        """f_n of the dominant mode."""
        return None if self.dominant is None else self.dominant.natural_hz

    @property
    def damped_hz(self) -> float | None:
        """f_d of the dominant mode."""
        return None if self.dominant is None else self.dominant.damped_hz

    @property
    def damping_ratio(self) -> float | None:
        """ζ of the dominant mode."""
        return None if self.dominant is None else self.dominant.damping_ratio

    def figures(self) -> dict[str, float | None]:
        """Return every figure by its name, in the order of `LABELS`."""
        return {name: getattr(self, name) for name in LABELS}


@dataclass(frozen=True)
class UncertainIndices:
    """Figures of a model with standard uncertainties by name; None where a figure has none."""

    indices: Indices
    u: dict[str, float | None]


def unit_of(name: str) -> str:
    """Return the unit of a figure: Hz, s, or none."""
    return UNITS.get(name.rsplit("_", 1)[-1], "")
