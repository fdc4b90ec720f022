"""Excited lines from plain numbers: loads and outputs with noise and named unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.campaign.excited_line import ExcitedLine
from fusion.estimation.uncertainty import Contribution, Influence, Scope, Uncertainty

AnyArray = NDArray[Any]


def uncertainty(noise: ArrayLike, unknowns: Sequence[tuple[str, str, ArrayLike]] = ()) -> Uncertainty:
    """Equal noise (N,) of real and imaginary parts, and unknowns as name, scope and effect (N,)."""
    covariance = np.diag(np.tile(np.asarray(noise, dtype=np.float64) ** 2, 2))[None]
    influences = tuple(
        Influence(name, name, 1.0, "1", np.concatenate([effect.real, effect.imag])[None], cast("Scope", scope))
        for name, scope, effect in ((n, s, np.asarray(e, dtype=np.complex128)) for n, s, e in unknowns)
    )
    return Uncertainty((Contribution("noise", "A", covariance, np.array([50.0])),), influences)


def make_excited_line(
    load: ArrayLike,
    outputs: ArrayLike,
    of_load: Uncertainty,
    of_outputs: Uncertainty,
    *,
    recording: str = "a",
    mounting: str = "1",
    frequency_hz: float = 100.0,
    direction: tuple[float, ...] = (0.0, 0.0, 1.0),
    channels: Sequence[str] | None = None,
) -> ExcitedLine:
    """Return an excited line, with numbered channels unless they are named."""
    names = tuple(f"U{n}" for n in range(np.size(outputs))) if channels is None else tuple(channels)
    return ExcitedLine(
        recording=recording,
        mounting=mounting,
        frequency_hz=frequency_hz,
        nominal_hz=frequency_hz,
        direction=direction,
        load=np.asarray(load, dtype=np.complex128),
        load_uncertainty=of_load,
        outputs=np.asarray(outputs, dtype=np.complex128),
        outputs_uncertainty=of_outputs,
        channels=names,
    )
