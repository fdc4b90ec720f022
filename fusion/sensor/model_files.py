"""models.json and load.json: models of a sensor's outputs, written and read without loss of precision."""

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
from fusion.sensor.model_notices import DAMAGED_MODEL_FILE, WRONG_MODEL_FORMAT
from shaker.labels import mechanical_units
from shaker.lti.system import ModalModel
from shaker.release.load_model import PARAMETERS, LoadModel
from shakercal._common.arrays import ComplexArray, FloatArray, check_shape

R = TypeVar("R")
FORMAT = 1
LARGEST_FILE = 50_000_000  # bytes, of thousands of models
MODELS_FILE = "models.json"
LOAD_MODEL_FILE = "load.json"


@dataclass(frozen=True)
class ModelEntry:
    """The model of an output `channel` for a load `component` (Fx … Mz).

    `unit`: of the output, per N or N·m.

    Attributes
    ----------
    method : the method that identified it.
    sample_rate_hz : sampling rate of the records.
    noise : standard deviation of the output's noise at that rate, in output units.
    recording : folders of the recordings behind it, separated by ", ".
    dof : degrees of freedom of `scatter`; infinite without scatter.
    scope : the use that U of the model covers, in words; empty if not stated.
    scatter : (P, P), part of the covariance that is based on the scatter of records; None: all of it.
    outside : influences not included in U; None if not stated.
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
    """The models of a sensor.

    `name` of the campaign or recording, `sensor` and `serial` as in rig.toml.
    """

    name: str
    sensor: str
    serial: str
    entries: tuple[ModelEntry, ...]

    def __getitem__(self, key: tuple[str, str]) -> ModelEntry:
        """Return the model of an output channel for a load component, such as ["Fz", "Fz"]."""
        found = next((entry for entry in self.entries if (entry.channel, entry.component) == key), None)
        if found is None:
            available = ", ".join(f"{entry.channel} for {entry.component}" for entry in self.entries)
            raise ValueError(f"key: expected one of {available}, found {key[0]} for {key[1]}")
        return found

    def __iter__(self) -> Iterator[ModelEntry]:
        """Return the models one after another."""
        return iter(self.entries)

    @property
    def driven(self) -> tuple[ModelEntry, ...]:
        """Return the models of channels for the component of the same name."""
        return tuple(entry for entry in self.entries if entry.channel == entry.component)


def models_text(models: ModelsFile) -> str:
    """Return the content of models.json."""
    content = {
        "name": models.name,
        "sensor": {"name": models.sensor, "serial": models.serial},
        "conventions": "H(s) = sum r/(s - p) + conj. + sum r/(s - p); p in rad/s; output over load; covariance k = 1",
        "models": [_entry(entry) for entry in models.entries],
    }
    return model_file_text(content)


def read_models(path: Path) -> ModelsFile:
    """Read models.json, or the one in a folder of results.

    Raises `InputError` at the entry that cannot be read.
    """

    def parsed(content: dict[str, Any]) -> ModelsFile:
        sensor, entries = content["sensor"], tuple(_read_entry(item) for item in content["models"])
        return ModelsFile(str(content["name"]), str(sensor["name"]), str(sensor["serial"]), entries)

    return read_model_file(path, MODELS_FILE, "step", parsed)


def model_file_text(content: dict[str, Any], *, indent: int = 2, allow_nan: bool = False) -> str:
    """Return the text of a JSON file of models, which `read_model_file` reads at full precision."""
    return json.dumps({"format": FORMAT, **content}, indent=indent, ensure_ascii=False, allow_nan=allow_nan) + "\n"


def pairs(values: ComplexArray) -> list[Any]:
    """Return complex numbers as [re, im]."""
    found: list[Any] = np.stack([values.real, values.imag], axis=-1).tolist()
    return found


def read_model_file(
    path: Path, name: str, command: str, parse: Callable[[dict[str, Any]], R], content_label: str = "models"
) -> R:
    """Return the parsed content of a JSON file of models.

    `name`: of the file if `path` is a folder. `content_label` names the content, such as "filters", in errors;
    `command` is the command that writes the file, or several such as "step or load".
    """
    file = path / name if path.is_dir() else path
    to_repeat = " or ".join(f"`shakercal {name}`" for name in command.split(" or "))
    try:
        content = json.loads(read_text(file, LARGEST_FILE, content_label))
        check_values(content, file)
        if content["format"] != FORMAT:
            found = f"{content['format']}"
            raise InputError(WRONG_MODEL_FORMAT, file, "format", found=found, expected=FORMAT, to_repeat=to_repeat)
        return parse(content)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        found = f"no key {error}" if isinstance(error, KeyError) else describe(str(error), plain=True)
        raise InputError(
            DAMAGED_MODEL_FILE, file, found=found, expected=content_label, command=command, to_repeat=to_repeat
        ) from error


def _entry(entry: ModelEntry) -> dict[str, Any]:
    """Return one model as nested dictionaries, with static gain, zeros and poles for other readers."""
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
        "zeros": pairs(system.zeros),
        "poles": pairs(system.poles),
        "gain": system.gain,
    }


def _read_entry(item: dict[str, Any]) -> ModelEntry:
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
    fields: dict[str, Any] = {key: str(item[key]) for key in ("channel", "component", "unit", "method", "recording")}
    fields |= {key: float(item[key]) for key in ("sample_rate_hz", "noise")}
    fields |= {"scope": str(item.get("scope", "")), "outside": item.get("outside")}
    fields["scatter"] = _matrix(item.get("covariance_of_scatter"))
    if fields["scatter"] is not None:
        check_shape("covariance_of_scatter", fields["scatter"], (len(model.vector),) * 2)
    return ModelEntry(**fields, model=model, dof=_freedom(item["dof"]))


def _freedom(stored: float | None) -> float:
    """Return degrees of freedom, infinite if none are stored."""
    return float("inf") if stored is None else float(stored)


def _matrix(rows: list[list[float]] | None) -> FloatArray | None:
    """Return a stored covariance, None without one."""
    return None if rows is None else np.array(rows, dtype=np.float64)


class UncertaintyBasis(NamedTuple):
    """The basis of a model's U: degrees of freedom, covered use, and exclusions."""

    dof: float = np.inf
    scope: str = "within the records of the model"
    outside: str | None = None


def model_text(models: Sequence[tuple[LoadModel, UncertaintyBasis]], campaign: str, sensor: str, program: str) -> str:
    """Return the content of load.json, one entry per component and solution."""
    entries = [_load_entry(*model) for model in models]
    content = {"campaign": campaign, "sensor": sensor, "program": program, "models": entries}
    return model_file_text(content, allow_nan=True)


def read_load_models(path: str | Path) -> tuple[LoadModel, ...]:
    """Read the models of a sensor over its load from load.json.

    Parameters
    ----------
    path
        The file, or a folder of results that contains it.

    Returns
    -------
    tuple of LoadModel : one per component. If the data cannot distinguish two solutions, both, with `solutions` = 2.

    Raises
    ------
    InputError : the file is missing, or damaged at the named entry.

    Examples
    --------
    >>> from fusion import read_load_models
    >>> models = read_load_models("my-loads/load")  # doctest: +SKIP
    """

    return tuple(model for model, _ in read_loads(Path(path)))


def read_loads(path: Path) -> tuple[tuple[LoadModel, UncertaintyBasis], ...]:
    """Read the models of load.json with the basis of their U."""

    def rests(item: dict[str, Any]) -> UncertaintyBasis:
        texts = {name: item[name] for name in ("scope", "outside") if name in item}
        return UncertaintyBasis(_freedom(item.get("dof")), **texts)

    def parsed(content: dict[str, Any]) -> tuple[tuple[LoadModel, UncertaintyBasis], ...]:
        return tuple((_load_model(item), rests(item)) for item in content["models"])

    return read_model_file(path, LOAD_MODEL_FILE, "load", parsed)


def parameter_units(component: str) -> dict[str, str]:
    """Return the units of a model's numbers, of a force or of a moment."""
    stiffness, damping, inertia = mechanical_units(component)
    return dict(zip((*PARAMETERS, "moving_mass"), (*(stiffness, damping) * 2, inertia), strict=True))


def _load_entry(model: LoadModel, rests: UncertaintyBasis) -> dict[str, Any]:
    """Return one model in SI units; covariances: the parameters, then the mass."""
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
    named = {parameter["name"]: float(parameter["value"]) for parameter in item["parameters"]}
    fields: dict[str, Any] = {key: str(item[key]) for key in ("component", "channel", "unit")}
    fields |= {key: named[key] for key in PARAMETERS[: 2 if len(named) == 2 else 4]}
    fields |= {key: int(item[key]) for key in ("solution", "solutions")}
    fields |= {key: _matrix(item[key]) for key in ("covariance", "covariance_with_mass")}
    for key in ("moving_mass", "sensitivity"):
        fields[key], fields[f"u_{key}"] = float(item[key]["value"]), float(item[key]["u"])
    return LoadModel(**fields, load_masses=tuple(float(mass) for mass in item["load_masses"]))
