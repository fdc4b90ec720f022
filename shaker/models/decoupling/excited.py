"""Whether loads were excited, and whether the outputs tell them apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from shaker._checks import FloatArray

LOADS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
_SEPARATE = 1e-3


def in_order(components: Iterable[str]) -> tuple[str, ...]:
    """Return the load components that occur, once each, Fx first."""
    named = dict.fromkeys(components)
    return tuple(sorted(named, key=lambda name: (LOADS.index(name) if name in LOADS else len(LOADS), name)))


def missing_loads(
    channels: Sequence[str], components: Sequence[str], static_sensitivity: FloatArray | None = None
) -> tuple[str, ...]:
    """Return the loads that a sensor measures and no record or response excites.

    It measures those that its outputs are named after, and those of which `static_sensitivity` (C, 6) holds a number
    other than 0.
    """
    named = {name for name in LOADS if name in channels}
    if static_sensitivity is not None:
        named |= {name for name, column in zip(LOADS, static_sensitivity.T, strict=True) if np.any(column)}
    return tuple(name for name in LOADS if name in named and name not in components)


def check_separable(static_gain: FloatArray, channels: Sequence[str], components: Sequence[str]) -> None:
    """Raise `ValueError` with the loads (D,) that outputs of a static matrix (C, D) do not tell apart.

    Columns are compared by direction: the smallest singular value of the matrix of unit columns must reach 0.001.
    """
    if len(channels) < len(components):
        raise ValueError(
            f"channels: expected at least as many as loads, {len(components)} ({', '.join(components)}), "
            f"found {len(channels)}"
        )
    size = np.linalg.norm(static_gain, axis=0)
    silent = [name for name, value in zip(components, size, strict=True) if not value > 0]
    if silent:
        raise ValueError(f"components: expected loads that move an output, found none for {', '.join(silent)}")
    _, singular, right = np.linalg.svd(static_gain / size)
    if singular[-1] < _SEPARATE:
        mixed = [name for name, share in zip(components, np.abs(right[-1]), strict=True) if share > 0.3]
        raise ValueError(f"components: expected loads that the outputs tell apart, found {' and '.join(mixed)} alike")
