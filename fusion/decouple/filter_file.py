"""decoupling.json: the filter with the model it comes from, at full precision."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import InputError
from shaker.models.decoupling.filter import DecouplingFilter
from shaker.models.decoupling.model import MultiModel

FORMAT = 1
KIND = "shakercal decoupling"
RECURSION = (
    "f[n] = sum_k taps[k] y[n-k] + Re sum_i shown[:,i] x_i[n-L]; x_i[n+1] = poles[i] x_i[n] + driven[i] y[n]; "
    "L = len(taps)-1; complex numbers as [re, im]"
)


def filter_text(decoupler: DecouplingFilter, model: MultiModel) -> str:
    """Return the text of decoupling.json."""
    content = {
        "format": FORMAT,
        "kind": KIND,
        "recursion": RECURSION,
        "channels": list(decoupler.channels),
        "components": list(decoupler.components),
        "unit": decoupler.unit,
        "sample_rate_hz": decoupler.sample_rate_hz,
        "delay_samples": decoupler.delay,
        "target": {
            "frequency_hz": decoupler.target_hz.tolist(),
            "damping_ratio": decoupler.target_damping.tolist(),
        },
        "taps": decoupler.taps.tolist(),
        "poles": _pairs(decoupler.poles),
        "driven": _pairs(decoupler.driven),
        "shown": _pairs(decoupler.shown),
        "model": _model(model),
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def read_filter(path: Path) -> DecouplingFilter:
    """Return the filter of a decoupling.json, to the last bit; raises `InputError`."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.get("kind") != KIND or content.get("format") != FORMAT:
            found = f"kind {content.get('kind')!r}, format {content.get('format')!r}"
            raise InputError(path, "kind", found=found, expected=f"{KIND}, format {FORMAT}")
        return DecouplingFilter(
            channels=tuple(content["channels"]),
            components=tuple(content["components"]),
            unit=content["unit"],
            sample_rate_hz=float(content["sample_rate_hz"]),
            taps=np.array(content["taps"], dtype=np.float64),
            poles=_complex(content["poles"]),
            driven=_complex(content["driven"]),
            shown=_complex(content["shown"]),
            target_hz=np.array(content["target"]["frequency_hz"], dtype=np.float64),
            target_damping=np.array(content["target"]["damping_ratio"], dtype=np.float64),
        )
    except (OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        expected = "a decoupling.json written by shakercal decouple"
        raise InputError(path, "", found=str(error), expected=expected) from error


def _model(model: MultiModel) -> dict[str, Any]:
    """The model with standard uncertainties."""
    found: dict[str, Any] = {
        name: getattr(model, name).tolist() for name in ("frequency_hz", "damping_ratio", "real_hz", "real_residue")
    }
    found["residue"] = _pairs(model.residue)
    if model.covariance is not None:
        found["u_frequency_hz"] = model.u.frequency_hz.tolist()
        found["u_damping_ratio"] = model.u.damping_ratio.tolist()
        found["u_real_hz"] = model.u.real_hz.tolist()
        found["u_residue"] = _pairs(model.u.residue)
        found["u_real_residue"] = model.u.real_residue.tolist()
    return found


def _pairs(values: NDArray[np.complex128]) -> Any:
    """Complex numbers as [re, im]."""
    return np.stack([values.real, values.imag], axis=-1).tolist()


def _complex(pairs: Any) -> NDArray[np.complex128]:
    """Complex numbers of [re, im]."""
    both = np.array(pairs, dtype=np.float64)
    return np.asarray(both[..., 0] + 1j * both[..., 1])
