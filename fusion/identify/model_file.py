"""model.json: what a correction of the sensor's output needs, written and read back to the last bit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from fusion.errors import InputError
from fusion.identify.result import ComponentResult, IdentifyEvaluation
from fusion.identify.rows import plain
from fusion.load import LOAD_COMPONENTS
from shaker.models.sensor.chain_shape import CHAIN_PARAMETERS, Chain, ChainKind
from shaker.models.sensor.sensor_model import SENSOR_PARAMETERS, SensorModel

FORMAT = 1
MODEL_FILE = "model.json"


@dataclass(frozen=True)
class ComponentModel:
    """The model of one component: output `channel` for the load `component` (Fx … Mz), from data in `range_hz`.

    `structure`: what the resonances were explained by. `sensitivity_measured`: whether S(f) was evaluated, without
    which the chain is unknown and the static sensitivity that of the rig, or one.
    """

    component: str
    channel: str
    structure: str
    sensor: SensorModel
    range_hz: tuple[float, float]
    sensitivity_measured: bool


@dataclass(frozen=True)
class SensorFile:
    """The models of a sensor's components."""

    name: str
    serial: str
    campaign: str
    components: tuple[ComponentModel, ...]

    def __getitem__(self, component: str) -> ComponentModel:
        """Return the model of a load component, such as "Fz"."""
        for model in self.components:
            if model.component == component:
                return model
        names = ", ".join(model.component for model in self.components)
        raise ValueError(f"component: expected one of {names}, found {component}")


def model_text(evaluation: IdentifyEvaluation) -> str:
    """Return the content of model.json."""
    sensor = evaluation.sensor
    content = {
        "format": FORMAT,
        "campaign": evaluation.name,
        "program": evaluation.versions.get("shakercal", ""),
        "sensor": {"name": "" if sensor is None else sensor.name, "serial": "" if sensor is None else sensor.serial},
        "components": [_component(component) for component in evaluation.components],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def read_model(path: Path) -> SensorFile:
    """Read model.json, or the one in a folder of results; `InputError` names what cannot be read."""
    file = path / MODEL_FILE if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            found = f"format {content['format']}"
            raise InputError(
                file, "format", found=found, expected=f"format {FORMAT}; shakercal identify writes it anew"
            )
        components = tuple(_read_component(item) for item in content["components"])
        sensor = content["sensor"]
        return SensorFile(str(sensor["name"]), str(sensor["serial"]), str(content["campaign"]), components)
    except OSError as error:
        raise InputError(file, "", found=error.strerror or str(error), expected="a file that can be read") from error
    except (KeyError, TypeError, ValueError) as error:
        found = f"no key {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(file, "", found=found, expected="a model as shakercal identify writes it") from error


def _component(component: ComponentResult) -> dict[str, Any]:
    """One component as nested dictionaries; numbers are SI, the covariance in the order of its parameters."""
    model, measured = component.model, component.sensitivity
    values = [model.sensitivity, model.stiffness, model.damping, model.internal_mass, *model.chain.parameters.tolist()]
    u = np.sqrt(model.covariance.diagonal()).tolist()
    names = [*SENSOR_PARAMETERS, *model.chain.names]
    units = [model.unit, *_units(component), *("s^2" if name == "square_s2" else "s" for name in model.chain.names)]
    load = LOAD_COMPONENTS[component.fit.component]
    return {
        "component": load,
        "channel": load if measured is None else measured.measured.channel,
        "structure": component.fit.model,
        "sensitivity_measured": measured is not None,
        "frequency_range_hz": list(component.range_hz),
        "chain": model.chain.kind,
        "parameters": [
            {"name": name, "value": value, "u": spread, "unit": unit}
            for name, value, spread, unit in zip(names, values, u, units, strict=True)
        ],
        "covariance": model.covariance.tolist(),
        "usable_bands": [
            {"load": mass, "permitted": band.permitted, "upper_hz": _finite(band.upper_hz), "u": band.u_upper_hz}
            for mass, band in zip(component.loads, component.bands, strict=True)
        ],
    }


def _units(component: ComponentResult) -> list[str]:
    """Units of stiffness, damping and internal mass."""
    axis, found = component.name, component.fit.identification
    damper = next(estimate for estimate in found.estimates if estimate.name.startswith(f"damping_{axis}"))
    return [plain(unit) for unit in (found[f"stiffness_{axis}"].unit, damper.unit, component.internal_mass.unit)]


def _finite(value: float) -> float | None:
    """A number that JSON has, none where there is no limit."""
    return value if np.isfinite(value) else None


def _read_component(item: dict[str, Any]) -> ComponentModel:
    """One component from its dictionary."""
    kind = item["chain"]
    if kind not in get_args(ChainKind):
        raise ValueError(f"expected a chain of {', '.join(get_args(ChainKind))}, found {kind}")
    named = {parameter["name"]: float(parameter["value"]) for parameter in item["parameters"]}
    shape = cast("ChainKind", kind)
    sensitivity, stiffness, damping, internal_mass = (named[name] for name in SENSOR_PARAMETERS)
    sensor = SensorModel(
        sensitivity=sensitivity,
        stiffness=stiffness,
        damping=damping,
        internal_mass=internal_mass,
        chain=Chain(shape, np.array([named[name] for name in CHAIN_PARAMETERS[shape]], dtype=np.float64)),
        covariance=np.array(item["covariance"], dtype=np.float64),
        unit=str(item["parameters"][0]["unit"]),
    )
    low, high = item["frequency_range_hz"]
    return ComponentModel(
        component=str(item["component"]),
        channel=str(item["channel"]),
        structure=str(item["structure"]),
        sensor=sensor,
        range_hz=(float(low), float(high)),
        sensitivity_measured=bool(item["sensitivity_measured"]),
    )
