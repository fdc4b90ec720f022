"""load.json: the load models of a sensor, written and read back to the last bit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import InputError
from shaker.models.load_series.model import PARAMETERS, LoadModel

FORMAT = 1
MODEL_FILE = "load.json"


def model_text(models: Sequence[LoadModel], campaign: str, sensor: str, program: str) -> str:
    """Return the content of load.json: one entry per component, or one per solution that the data cannot tell apart."""
    content = {
        "format": FORMAT,
        "campaign": campaign,
        "sensor": sensor,
        "program": program,
        "models": [_entry(model) for model in models],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def read_load_models(path: Path) -> tuple[LoadModel, ...]:
    """Read load.json, or the one in a folder of results; `InputError` names what cannot be read.

    Where one load cannot tell two solutions apart both are there, with `solutions` = 2.
    """
    file = path / MODEL_FILE if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            found = f"format {content['format']}"
            raise InputError(file, "format", found=found, expected=f"format {FORMAT}; shakercal load writes it anew")
        return tuple(_model(item) for item in content["models"])
    except OSError as error:
        raise InputError(file, "", found=error.strerror or str(error), expected="a file that can be read") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        found = f"no key {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(file, "", found=found, expected="models as shakercal load writes them") from error


def parameter_units(component: str) -> dict[str, str]:
    """Return the units of a model's numbers, of a force or of a moment."""
    if component.startswith("M"):
        names = ("N.m/rad", "N.m.s/rad", "N.m/rad", "N.m.s/rad", "kg.m^2")
    else:
        names = ("N/m", "N.s/m", "N/m", "N.s/m", "kg")
    return dict(zip((*PARAMETERS, "moving_mass"), names, strict=True))


def _entry(model: LoadModel) -> dict[str, Any]:
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
        "moving_mass": {"value": model.moving_mass, "u": model.u_moving_mass, "unit": units["moving_mass"]},
        "sensitivity": {"value": model.sensitivity, "u": model.u_sensitivity},
        "parameters": [
            {"name": name, "value": float(value), "u": spread, "unit": units[name]}
            for name, value, spread in zip(PARAMETERS, model.vector, u, strict=False)
        ],
        "covariance": None if model.covariance is None else model.covariance.tolist(),
        "covariance_with_mass": None if model.covariance_with_mass is None else model.covariance_with_mass.tolist(),
    }


def _model(item: dict[str, Any]) -> LoadModel:
    """One model from its dictionary."""
    named = {parameter["name"]: float(parameter["value"]) for parameter in item["parameters"]}
    matrices = {key: item[key] for key in ("covariance", "covariance_with_mass")}
    return LoadModel(
        component=str(item["component"]),
        channel=str(item["channel"]),
        unit=str(item["unit"]),
        moving_mass=float(item["moving_mass"]["value"]),
        stiffness=named["stiffness"],
        damping=named["damping"],
        coupling_stiffness=named.get("coupling_stiffness"),
        coupling_damping=named.get("coupling_damping"),
        sensitivity=float(item["sensitivity"]["value"]),
        u_sensitivity=float(item["sensitivity"]["u"]),
        u_moving_mass=float(item["moving_mass"]["u"]),
        load_masses=tuple(float(mass) for mass in item["load_masses"]),
        solution=int(item["solution"]),
        solutions=int(item["solutions"]),
        **{key: None if value is None else np.array(value, dtype=np.float64) for key, value in matrices.items()},
    )
