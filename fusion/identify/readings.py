"""What every method reads from the resonance of every curve, side by side with the joint fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.errors import ARGUMENT
from fusion.identify.fit import JointFit
from fusion.identify.measured import Prepared
from fusion.notices import Notice
from shaker.models.resonance.peak import PeakReading, peak_readings, stiffness

_DEPARTS = 3.0  # residuals over the noise, rms, from which one oscillator does not explain a peak
FEWEST_LINES = 20
"""Lines of a recording below which it has no curve to be read or drawn: steps of sines."""
LABELS = {
    "maximum_bin": "line of the maximum",
    "maximum": "maximum between the lines",
    "half_power": "half-power width",
    "half_amplitude": "half-amplitude width",
    "circle": "Nyquist circle",
    "oscillator": "oscillator fit",
    "joint": "joint fit",
}
"""Words for readers, in the order in which methods are listed."""


@dataclass(frozen=True)
class Reading:
    """One method's reading of one curve, and the stiffness and damping that follow with the mass that moves.

    `width_hz`: the width the method reads, or 2ζf₀; k = (2πf₀)²m and b = 2ζ√(km) with m = load + internal mass;
    standard uncertainties of the curve's noise, of `oscillator` and `joint` of all that is stated; NaN: not told.
    """

    recording: str
    response: str
    method: str
    frequency_hz: float
    u_frequency_hz: float
    width_hz: float
    u_width_hz: float
    damping_ratio: float
    u_damping_ratio: float
    stiffness: float
    damping: float
    note: str = ""


def read_curves(fit: JointFit, internal_mass: float) -> tuple[tuple[Reading, ...], tuple[Notice, ...]]:
    """Return all readings of all curves of a joint fit, and why some could not be read."""
    found: list[Reading] = []
    notices: list[Notice] = []
    for item in fit.prepared:
        if len(item.measured.ratio.frequency_hz) < FEWEST_LINES:
            continue
        for response in item.measured.ratio.channels:
            moved = item.load_kg + internal_mass
            try:
                found += [_reading(item, response, reading, moved) for reading in _readings(item, response)]
            except ValueError as error:
                where = f"{item.measured.name}: {response}"
                notices.append(Notice("info", f"no peak was read ({ARGUMENT.sub('', str(error))})", where))
                continue
            found += _joint(fit, item, response, moved)
    return tuple(found), tuple(notices)


def _readings(item: Prepared, response: str) -> Iterator[PeakReading]:
    """What the methods that look at one curve read."""
    measured = item.measured
    ratio = measured.ratio.select([response])
    correlation = measured.line_correlation
    yield from peak_readings(ratio.frequency_hz, ratio.value[:, 0], ratio.covariance, line_correlation=correlation).all
    own = [found for found in item.resonances if found.response == response]
    if own:
        highest = max(own, key=lambda found: abs(found.fit.model(np.array([found.fit.frequency_hz]))[0]))
        f0, zeta = highest.fit.frequency_hz, highest.fit.damping_ratio
        u_zeta = highest.u_damping_ratio
        width = 2.0 * zeta * f0
        departs = float(np.sqrt(highest.fit.chi_squared / highest.fit.dof))
        note = f"departs from one oscillator by {departs:.2g} times the noise" if departs > _DEPARTS else ""
        yield PeakReading("oscillator", f0, highest.u_frequency_hz, width, 2.0 * u_zeta * f0, zeta, u_zeta, note)


def _joint(fit: JointFit, item: Prepared, response: str, moved: float) -> Iterator[Reading]:
    """What the joint fit says of the modes of one recording."""
    for mode in fit.identification.modes:
        if mode.record == item.measured.name:
            f0, zeta = mode.frequency_hz, mode.damping_ratio
            width, u_width = 2.0 * zeta * f0, 2.0 * mode.u_damping_ratio * f0
            own = PeakReading("joint", f0, mode.u_frequency_hz, width, u_width, zeta, mode.u_damping_ratio)
            yield _reading(item, response, own, moved)


def _reading(item: Prepared, response: str, reading: PeakReading, moved: float) -> Reading:
    """A reading as a row: equations 9 and 10 of Nitsche et al. 2018 with the mass that moves."""
    k = stiffness(reading.frequency_hz, moved)
    return Reading(
        recording=item.measured.name,
        response=response,
        method=reading.method,
        frequency_hz=reading.frequency_hz,
        u_frequency_hz=reading.u_frequency_hz,
        width_hz=reading.width_hz,
        u_width_hz=reading.u_width_hz,
        damping_ratio=reading.damping_ratio,
        u_damping_ratio=reading.u_damping_ratio,
        stiffness=k,
        damping=2.0 * reading.damping_ratio * float(np.sqrt(k * moved)),
        note=reading.note,
    )


def of_curve(readings: Sequence[Reading], recording: str, response: str) -> list[Reading]:
    """Return the readings of one curve in the order of `LABELS`."""
    own = [reading for reading in readings if (reading.recording, reading.response) == (recording, response)]
    return sorted(own, key=lambda reading: list(LABELS).index(reading.method))
