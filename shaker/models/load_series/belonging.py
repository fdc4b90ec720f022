"""Which second modes belong to the coupling of the load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shaker._checks import BoolArray
from shaker.models.load_series.fit import fit_resonances
from shaker.models.load_series.masses import SeriesMasses
from shaker.models.load_series.resonances import Resonances

FARTHEST = 0.10
"""Relative distance of a second mode from where the first ones put it, from which it is another one."""


def belonging(measured: Resonances, masses: SeriesMasses) -> tuple[Resonances, tuple[int, ...]]:
    """Return the resonances without second modes that no coupling explains, and the records that had such.

    Where first resonances of several load masses tell k and k_L, they tell the second modes too. Without load there is
    none: what is seen there is of something else.
    """
    seen = np.isfinite(measured.frequency_hz[:, 1])
    foreign = seen & (masses.load == 0)
    if np.any(seen & ~foreign) and len(np.unique(np.round(masses.load / masses.moving, 3))) > 1:
        alone = _without_second(measured, np.ones(len(seen), dtype=np.bool_))
        foretold = np.array([fit.frequency_hz[:, 1] for fit in fit_resonances(alone, masses, rigid=False)])
        off = np.abs(measured.frequency_hz[:, 1] / foretold - 1.0)
        foreign |= seen & (masses.load > 0) & (np.min(off, axis=0) > FARTHEST)
    return _without_second(measured, foreign), tuple(int(place) for place in np.flatnonzero(foreign))


def _without_second(measured: Resonances, places: BoolArray) -> Resonances:
    """The resonances with the second modes of some records (R,) left out."""
    names = ("frequency_hz", "u_frequency_hz", "damping_ratio", "u_damping_ratio")
    left = {name: getattr(measured, name).copy() for name in names}
    for value in left.values():
        value[places, 1] = np.nan
    return replace(measured, **left)
