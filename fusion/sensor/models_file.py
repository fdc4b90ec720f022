"""models.json: models identified from step responses, written and read back to the last bit."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import InputError
from shaker.lti.system import ModalModel

FORMAT = 1
MODELS_FILE = "models.json"


@dataclass(frozen=True)
class ModelEntry:
    """The model of one output `channel` for one load `component` (Fx … Mz), in output `unit` per N or N·m.

    `method`: what identified it; `sample_rate_hz`: of the records; `noise`: standard deviation of the output's noise at
    that rate, in output units; `recording`: folders of the recordings it rests on, separated by ", ". `dof`: degrees of
    freedom behind its covariance, infinite where that is of noise alone.
    """

    channel: str
    component: str
    unit: str
    method: str
    model: ModalModel
    sample_rate_hz: float
    noise: float
    recording: str
    dof: float = np.inf


@dataclass(frozen=True)
class ModelsFile:
    """The models of a sensor; `name` of the campaign or recording, `sensor`, `serial` as rig.toml has them."""

    name: str
    sensor: str
    serial: str
    entries: tuple[ModelEntry, ...]

    def __getitem__(self, key: tuple[str, str]) -> ModelEntry:
        """Return the model of an output channel for a load component, such as ["Fz", "Fz"]."""
        found = next((entry for entry in self.entries if (entry.channel, entry.component) == key), None)
        if found is None:
            known = ", ".join(f"{entry.channel} for {entry.component}" for entry in self.entries)
            raise ValueError(f"key: expected one of {known}, found {key[0]} for {key[1]}")
        return found

    def __contains__(self, key: object) -> bool:
        """Return whether an output channel has a model for a load component."""
        return any((entry.channel, entry.component) == key for entry in self.entries)

    def __iter__(self) -> Iterator[ModelEntry]:
        """Return the models one after another."""
        return iter(self.entries)

    @property
    def driven(self) -> tuple[ModelEntry, ...]:
        """Return the models of channels for the component of their own name."""
        return tuple(entry for entry in self.entries if entry.channel == entry.component)


def models_text(models: ModelsFile) -> str:
    """Return the content of models.json."""
    content = {
        "format": FORMAT,
        "name": models.name,
        "sensor": {"name": models.sensor, "serial": models.serial},
        "conventions": "H(s) = sum r/(s - p) + conj. + sum r/(s - p); p in rad/s; output over load; covariance k = 1",
        "models": [_entry(entry) for entry in models.entries],
    }
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def read_models(path: Path) -> ModelsFile:
    """Read models.json, or the one in a folder of results; `InputError` names what cannot be read."""
    file = path / MODELS_FILE if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            found = f"format {content['format']}"
            raise InputError(file, "format", found=found, expected=f"format {FORMAT}; shakercal step writes it anew")
        sensor = content["sensor"]
        entries = tuple(_read_entry(item) for item in content["models"])
        return ModelsFile(str(content["name"]), str(sensor["name"]), str(sensor["serial"]), entries)
    except OSError as error:
        raise InputError(file, "", found=error.strerror or str(error), expected="a file that can be read") from error
    except (KeyError, TypeError, ValueError) as error:
        found = f"no key {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(file, "", found=found, expected="models as shakercal step writes them") from error


def _entry(entry: ModelEntry) -> dict[str, Any]:
    """One model as nested dictionaries; what a reader wants to see beside what is read back."""
    model = entry.model
    system = model.system
    return {
        "channel": entry.channel,
        "component": entry.component,
        "unit": entry.unit,
        "method": entry.method,
        "recording": entry.recording,
        "sample_rate_hz": entry.sample_rate_hz,
        "noise": entry.noise,
        "dof": entry.dof if np.isfinite(entry.dof) else None,
        "static_gain": model.static_gain,
        "modes": [
            {"frequency_hz": f, "damping_ratio": z, "residue_re": r.real, "residue_im": r.imag}
            for f, z, r in zip(
                model.frequency_hz.tolist(), model.damping_ratio.tolist(), model.residue.tolist(), strict=True
            )
        ],
        "real_poles": [
            {"frequency_hz": f, "residue": r}
            for f, r in zip(model.real_hz.tolist(), model.real_residue.tolist(), strict=True)
        ],
        "parameters": list(model.names),
        "covariance": None if model.covariance is None else model.covariance.tolist(),
        "zeros": [[zero.real, zero.imag] for zero in system.zeros.tolist()],
        "poles": [[pole.real, pole.imag] for pole in system.poles.tolist()],
        "gain": system.gain,
    }


def _read_entry(item: dict[str, Any]) -> ModelEntry:
    """One model from its dictionary."""
    modes, reals, covariance = item["modes"], item["real_poles"], item["covariance"]
    model = ModalModel(
        frequency_hz=_numbers(modes, "frequency_hz"),
        damping_ratio=_numbers(modes, "damping_ratio"),
        residue=np.array([complex(mode["residue_re"], mode["residue_im"]) for mode in modes], dtype=np.complex128),
        real_hz=_numbers(reals, "frequency_hz"),
        real_residue=_numbers(reals, "residue"),
        covariance=None if covariance is None else np.array(covariance, dtype=np.float64),
    )
    if not np.all(np.isfinite(model.vector)):
        raise ValueError(f"expected finite parameters, found {model.vector.tolist()}")
    return ModelEntry(
        channel=str(item["channel"]),
        component=str(item["component"]),
        unit=str(item["unit"]),
        method=str(item["method"]),
        model=model,
        sample_rate_hz=float(item["sample_rate_hz"]),
        noise=float(item["noise"]),
        recording=str(item["recording"]),
        dof=np.inf if item["dof"] is None else float(item["dof"]),
    )


def _numbers(items: list[dict[str, Any]], key: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """One number of every dictionary."""
    return np.array([item[key] for item in items], dtype=np.float64)
