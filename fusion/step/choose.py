"""Which releases of a component make its model, and of which structure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fusion.step.releases import structure_of
from fusion.step.result import UNNAMED, Release

LONGEST_RELEASE = 0.5
"""Periods of the first mode that a release may last for its rope to be used beside the fastest one."""


class Chosen(NamedTuple):
    """Releases that make a model, and why these."""

    releases: tuple[Release, ...]
    reason: str


def choose_releases(releases: Sequence[Release]) -> Chosen:
    """Return the releases of the fastest rope, and of others whose release lasts half a period of the first mode.

    A load that changes for the time T drives a mode at f by sin(πfT)/(πfT) of what a step would: from half a period on,
    0.64, the model depends on how the load changed meanwhile, which is known of no rope.
    """
    fitted = [release for release in releases if release.fit is not None and release.fit.model is not None]
    if not fitted:
        return Chosen((), "no release could be fitted")
    names = dict.fromkeys(release.input.record.release for release in fitted)
    length = {name: _middle([r.release_s for r in fitted if r.input.record.release == name]) for name in names}
    fastest = min(names, key=lambda name: length[name])
    periods = {name: length[name] * _first_mode_hz(fitted, fastest) for name in names}
    kept = [name for name in names if name == fastest or periods[name] <= LONGEST_RELEASE]
    chosen = tuple(release for release in fitted if release.input.record.release in kept)
    return Chosen(chosen, _reason(kept, periods, fastest))


def common_structure(releases: Sequence[Release]) -> tuple[int, int]:
    """Return the number of modes that most models have, and the largest number of real poles among these.

    A real pole far above the modes shows in few releases; one that has it tells of it, one that has not is silent.
    """
    found = [structure for r in releases if r.fit is not None and (structure := structure_of(r.fit)) is not None]
    counts = Counter(modes for modes, _ in found)
    modes = max(counts, key=lambda number: (counts[number], number))
    return modes, max(reals for number, reals in found if number == modes)


def _first_mode_hz(releases: Sequence[Release], rope: str) -> float:
    """Middle of the lowest natural frequencies that the releases of a rope show, 0 where none oscillates."""
    models = [r.fit.model for r in releases if r.fit is not None and r.input.record.release == rope]
    lowest = [float(model.frequency_hz.min()) for model in models if model is not None and len(model.frequency_hz)]
    return _middle(lowest) if lowest else 0.0


def _middle(values: Sequence[float]) -> float:
    """The median."""
    return float(np.median(values))


def _reason(kept: Sequence[str], periods: dict[str, float], fastest: str) -> str:
    """Why these ropes."""
    if len(periods) == 1:
        return "all releases"
    names = ", ".join(name or UNNAMED for name in kept)
    others = [f"{name or UNNAMED} {periods[name]:.2g}" for name in periods if name not in kept]
    if not others:
        return f"releases by {names}: each lasts at most half a period of the first mode"
    why = "the fastest" if len(kept) == 1 else "at most half a period of the first mode"
    return f"releases by {names}, {why} ({periods[fastest]:.2g} periods; left out: {', '.join(others)} periods)"
