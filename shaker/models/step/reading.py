"""What a record shows of its release before any model is identified."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from shaker.notice import Notice

Shape = Literal["step", "ramp", "smooth", "measured"]
"""How the load goes: at once, along a straight line, along half a cosine, or as the force channel shows."""


@dataclass(frozen=True)
class SpectrumPeak:
    """A peak of the response's amplitude spectrum: frequency with standard uncertainty in Hz, and amplitude over that
    of the highest peak (`share`) with its standard uncertainty."""

    frequency_hz: float
    u_frequency_hz: float
    share: float
    u_share: float


@dataclass(frozen=True)
class Reading:
    """One release as one output shows it; times in s of the record's clock, levels in the output's `unit`.

    `onset_s`: when the load begins to change, `release_s`: how long it changes, `shape`: how; all with standard
    uncertainties `u_…`. `baseline`, `steady`: output before and long after; `sign` of their difference. `rise_s`: from
    10 % to 90 % of it. `static_gain`: (steady - baseline)/amplitude, in output unit per N or N·m. `noise`: standard
    deviation of a sample. `clipped`: whether the output ran into its limit. `peaks`: first and second of the spectrum.
    `record`, `release`: names of the record and of what let go.
    """

    record: str
    channel: str
    component: str
    unit: str
    release: str
    onset_s: float
    u_onset_s: float
    sign: int
    baseline: float
    u_baseline: float
    steady: float
    u_steady: float
    rise_s: float
    u_rise_s: float
    shape: Shape
    release_s: float
    u_release_s: float
    static_gain: float
    u_static_gain: float
    noise: float
    clipped: bool
    peaks: tuple[SpectrumPeak, ...] = ()
    notices: tuple[Notice, ...] = ()
