"""models.json and load.json: models of outputs, and of a sensor over its load, written and read to the last bit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fusion.errors import InputError
from fusion.recording.toml import check_values, read_text
from fusion.recording.values import describe
from shaker.arrays import FloatArray, check_shape
from shaker.labels import mechanical_units
from shaker.lti.system import ModalModel
from shaker.release.load_model import PARAMETERS, LoadModel

R = TypeVar("R")
FORMAT = 1
LARGEST_FILE = 50_000_000  # bytes, of thousands of models
MODELS_FILE = "models.json"
LOAD_MODEL_FILE = "load.json"


@dataclass(frozen=True)
class ModelEntry:
    """The model of one output `channel` for one load `component` (Fx … Mz), in output `unit` per N or N·m.

    `method`: what identified it; `sample_rate_hz`: of the records; `noise`: standard deviation of the output's noise at
    that rate, in output units; `recording`: folders of the recordings it rests on, separated by ", ". `dof`: degrees of
    freedom of `scatter`, the part of its covariance that rests on what records scatter by, all of it where None;
    infinite where there is none. `scope`: over what U of the model holds, in words, empty where nobody said it;
    `outside`: what it leaves out, None likewise.
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
    scope: str = ""
    scatter: FloatArray | None = None
    outside: str | None = None


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

    def parsed(content: dict[str, Any]) -> ModelsFile:
        sensor, entries = content["sensor"], tuple(_read_entry(item) for item in content["models"])
        return ModelsFile(str(content["name"]), str(sensor["name"]), str(sensor["serial"]), entries)

    return read_model_file(path, MODELS_FILE, "step", parsed)


def read_model_file(
    path: Path, name: str, command: str, parse: Callable[[dict[str, Any]], R], content_label: str = "models"
) -> R:
    """Return what a file of models, or of `what`, that a command wrote holds, or the one of this name in a folder."""
    file = path / name if path.is_dir() else path
    try:
        content = json.loads(read_text(file, LARGEST_FILE, content_label))
        check_values(content, file)
        if content["format"] != FORMAT:
            told, expected = f"format {content['format']}", f"format {FORMAT}; shakercal {command} writes it anew"
            raise InputError(file, "format", found=told, expected=expected)
        return parse(content)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        told = f"no key {error}" if isinstance(error, KeyError) else describe(str(error), plain=True)
        raise InputError(
            file, "", found=told, expected=f"{content_label} as shakercal {command} writes them"
        ) from error


def _entry(entry: ModelEntry) -> dict[str, Any]:
    """One model as nested dictionaries; what a reader wants to see beside what is read back."""
    model, system = entry.model, entry.model.system
    named = ("channel", "component", "unit", "method", "recording", "sample_rate_hz", "noise")
    modes = zip(model.frequency_hz.tolist(), model.damping_ratio.tolist(), model.residue.tolist(), strict=True)
    reals = zip(model.real_hz.tolist(), model.real_residue.tolist(), strict=True)
    return {
        **{name: getattr(entry, name) for name in named},
        "dof": entry.dof if np.isfinite(entry.dof) else None,
        "scope": entry.scope,
        "outside": entry.outside,
        "static_gain": model.static_gain,
        "modes": [
            {"frequency_hz": f, "damping_ratio": z, "residue_re": r.real, "residue_im": r.imag} for f, z, r in modes
        ],
        "real_poles": [{"frequency_hz": f, "residue": r} for f, r in reals],
        "parameters": list(model.names),
        "covariance": None if model.covariance is None else model.covariance.tolist(),
        "covariance_of_scatter": None if entry.scatter is None else entry.scatter.tolist(),
        "zeros": [[zero.real, zero.imag] for zero in system.zeros.tolist()],
        "poles": [[pole.real, pole.imag] for pole in system.poles.tolist()],
        "gain": system.gain,
    }


def _read_entry(item: dict[str, Any]) -> ModelEntry:
    """One model from its dictionary."""
    modes, reals = item["modes"], item["real_poles"]

    def numbers(items: list[dict[str, Any]], key: str) -> FloatArray:
        return np.array([one[key] for one in items], dtype=np.float64)

    model = ModalModel(
        frequency_hz=numbers(modes, "frequency_hz"),
        damping_ratio=numbers(modes, "damping_ratio"),
        residue=numbers(modes, "residue_re") + 1j * numbers(modes, "residue_im"),
        real_hz=numbers(reals, "frequency_hz"),
        real_residue=numbers(reals, "residue"),
        covariance=_matrix(item["covariance"]),
    )
    if not np.all(np.isfinite(model.vector)):
        raise ValueError(f"expected finite parameters, found {model.vector.tolist()}")
    told: dict[str, Any] = {key: str(item[key]) for key in ("channel", "component", "unit", "method", "recording")}
    told |= {key: float(item[key]) for key in ("sample_rate_hz", "noise")}
    told |= {"scope": str(item.get("scope", "")), "outside": item.get("outside")}
    told["scatter"] = _matrix(item.get("covariance_of_scatter"))
    if told["scatter"] is not None:
        check_shape("covariance_of_scatter", told["scatter"], (len(model.vector),) * 2)
    return ModelEntry(**told, model=model, dof=_freedom(item["dof"]))


def _freedom(stored: float | None) -> float:
    """Degrees of freedom, infinite where none are stored."""
    return float("inf") if stored is None else float(stored)


def _matrix(rows: list[list[float]] | None) -> FloatArray | None:
    """A covariance as it is stored, None where it is not known."""
    return None if rows is None else np.array(rows, dtype=np.float64)


class UncertaintyBasis(NamedTuple):
    """On what U of a model over the load rests: degrees of freedom of its k, over what it holds, what it leaves out."""

    dof: float = np.inf
    scope: str = "within the records of the model"
    outside: str | None = None


def model_text(models: Sequence[tuple[LoadModel, UncertaintyBasis]], campaign: str, sensor: str, program: str) -> str:
    """Return the content of load.json: one entry per component, or one per solution that the data cannot tell apart."""
    content = {
        "format": FORMAT,
        "campaign": campaign,
        "sensor": sensor,
        "program": program,
        "models": [_load_entry(*model) for model in models],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def read_load_models(path: str | Path) -> tuple[LoadModel, ...]:
    """Read load.json, or the one in a folder of results; `InputError` names what cannot be read.

    Where one load cannot tell two solutions apart both are there, with `solutions` = 2.

    >>> from fusion import read_load_models
    >>> models = read_load_models("my-loads/load")  # doctest: +SKIP
    """

    return tuple(model for model, _ in read_loads(Path(path)))


def read_loads(path: Path) -> tuple[tuple[LoadModel, UncertaintyBasis], ...]:
    """Read the models of load.json with what their U rests on."""

    def rests(item: dict[str, Any]) -> UncertaintyBasis:
        known = {name: item[name] for name in ("scope", "outside") if name in item}
        return UncertaintyBasis(_freedom(item.get("dof")), **known)

    def parsed(content: dict[str, Any]) -> tuple[tuple[LoadModel, UncertaintyBasis], ...]:
        return tuple((_load_model(item), rests(item)) for item in content["models"])

    return read_model_file(path, LOAD_MODEL_FILE, "load", parsed)


def parameter_units(component: str) -> dict[str, str]:
    """Return the units of a model's numbers, of a force or of a moment."""
    stiffness, damping, inertia = mechanical_units(component)
    return dict(zip((*PARAMETERS, "moving_mass"), (*(stiffness, damping) * 2, inertia), strict=True))


def _load_entry(model: LoadModel, rests: UncertaintyBasis) -> dict[str, Any]:
    """One model as nested dictionaries; numbers are SI, covariances in the order of the parameters, then the mass."""
    total, units = model.total_covariance, parameter_units(model.component)
    u = [None] * len(model.vector) if total is None else np.sqrt(np.diag(total)).tolist()
    return {
        "component": model.component,
        "channel": model.channel,
        "unit": model.unit,
        "structure": "two masses" if model.is_rigid else "three masses",
        "solution": model.solution,
        "solutions": model.solutions,
        "load_masses": list(model.load_masses),
        **rests._asdict(),
        "dof": rests.dof if np.isfinite(rests.dof) else None,
        "moving_mass": {"value": model.moving_mass, "u": model.u_moving_mass, "unit": units["moving_mass"]},
        "sensitivity": {"value": model.sensitivity, "u": model.u_sensitivity},
        "parameters": [
            {"name": name, "value": float(value), "u": spread, "unit": units[name]}
            for name, value, spread in zip(PARAMETERS, model.vector, u, strict=False)
        ],
        "covariance": None if model.covariance is None else model.covariance.tolist(),
        "covariance_with_mass": None if model.covariance_with_mass is None else model.covariance_with_mass.tolist(),
    }


def _load_model(item: dict[str, Any]) -> LoadModel:
    """One model from its dictionary."""
    named = {parameter["name"]: float(parameter["value"]) for parameter in item["parameters"]}
    told: dict[str, Any] = {key: str(item[key]) for key in ("component", "channel", "unit")}
    told |= {key: named[key] for key in PARAMETERS[: 2 if len(named) == 2 else 4]}
    told |= {key: int(item[key]) for key in ("solution", "solutions")}
    told |= {key: _matrix(item[key]) for key in ("covariance", "covariance_with_mass")}
    for key in ("moving_mass", "sensitivity"):
        told[key], told[f"u_{key}"] = float(item[key]["value"]), float(item[key]["u"])
    return LoadModel(**told, load_masses=tuple(float(mass) for mass in item["load_masses"]))
