"""Result files read back: uncertainties with their correlations, exactly as they were written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from fusion.uncertainty import Contribution, Influence, Kind, Scope, Uncertainty


def read_uncertainty(group: h5py.Group) -> Uncertainty:
    """Return the `Uncertainty` that `fusion.results_h5.write_uncertainty` put into a group, to the last bit."""
    random = tuple(_read_contribution(part) for part in group["random"].values())
    texts = {field: group[field].asstr()[()] for field in ("name", "label", "unit", "scope", "type")}
    u, effect = group["u"][()], group["effect"][()]
    return Uncertainty(random, tuple(_influence(texts, e, float(u[e]), effect[e]) for e in range(len(u))))


def _read_contribution(group: h5py.Group) -> Contribution:
    """One random contribution."""
    dof = group["dof"][()] if "dof" in group else None
    return Contribution(str(group.attrs["label"]), _kind(group.attrs["type"]), group["covariance"][()], dof)


def _influence(texts: Mapping[str, Any], place: int, u: float, effect: NDArray[np.float64]) -> Influence:
    """One influence from its place in the packed arrays."""
    scope = texts["scope"][place]
    if scope not in get_args(Scope):
        raise ValueError(f"scope: expected one of {get_args(Scope)}, found {scope!r}")
    return Influence(
        name=texts["name"][place],
        label=texts["label"][place],
        u=u,
        unit=texts["unit"][place],
        effect=effect,
        scope=cast("Scope", scope),
        type=_kind(texts["type"][place]),
    )


def _kind(text: object) -> Kind:
    """Type A or B of an evaluation."""
    if text not in get_args(Kind):
        raise ValueError(f"type: expected one of {get_args(Kind)}, found {text!r}")
    return cast("Kind", text)
