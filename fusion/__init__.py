"""From a recording folder to the sensitivity with its uncertainty: the only place where images and signals meet.

Everything named here is public; a name is imported when it is first used, so that `import fusion` costs nothing. Paths
may be `str` or `Path`.

>>> from fusion import check, find_recordings, load_manifest
>>> (recording,) = find_recordings("sample_images/demo")
>>> manifest = load_manifest(recording)
>>> manifest.excitation.frequencies
(80.0,)
>>> check(manifest).problems
()
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fusion.base import ComputeError, InputError, Settings
    from fusion.campaign.recorded import read_recorded
    from fusion.campaign.run import run_path
    from fusion.estimation.fuse import Acceleration
    from fusion.planning.check import CheckReport, check
    from fusion.planning.plan import Request, make_plan
    from fusion.recording.load import Manifest, find_recordings, load_for_command, load_manifest
    from fusion.sensitivity.analyse import Evaluation
    from fusion.sensitivity.evaluate import evaluate_recording
    from fusion.sensitivity.load import LoadResult
    from fusion.sensitivity.ratio import Sensitivity
    from fusion.sensor.compensate.evaluate import evaluate_compensation
    from fusion.sensor.compensate.report import read_compensation_filters
    from fusion.sensor.decouple.evaluate import DecoupleSettings, evaluate_decoupling, read_decoupling_filter
    from fusion.sensor.elastomer.evaluate import evaluate_element
    from fusion.sensor.identify.evaluate import evaluate_identification
    from fusion.sensor.identify.report import read_sensor_models
    from fusion.sensor.load.evaluate import evaluate_loads
    from fusion.sensor.models_file import read_load_models
    from fusion.sensor.rotate.evaluate import evaluate_rotation
    from fusion.sensor.step.evaluate import evaluate_steps
    from fusion.sensor.step.records import StepSettings
    from fusion.sensor.transfer.evaluate import evaluate_transfer
    from fusion.sensor.transfer.records import TransferSettings
    from fusion.simulate import simulate as simulate_preset

_MODULES = {
    "Acceleration": "fusion.estimation.fuse",
    "CheckReport": "fusion.planning.check",
    "ComputeError": "fusion.base",
    "DecoupleSettings": "fusion.sensor.decouple.evaluate",
    "Evaluation": "fusion.sensitivity.analyse",
    "InputError": "fusion.base",
    "LoadResult": "fusion.sensitivity.load",
    "Manifest": "fusion.recording.load",
    "Request": "fusion.planning.plan",
    "Sensitivity": "fusion.sensitivity.ratio",
    "Settings": "fusion.base",
    "StepSettings": "fusion.sensor.step.records",
    "TransferSettings": "fusion.sensor.transfer.records",
    "check": "fusion.planning.check",
    "evaluate_compensation": "fusion.sensor.compensate.evaluate",
    "evaluate_decoupling": "fusion.sensor.decouple.evaluate",
    "evaluate_element": "fusion.sensor.elastomer.evaluate",
    "evaluate_identification": "fusion.sensor.identify.evaluate",
    "evaluate_loads": "fusion.sensor.load.evaluate",
    "evaluate_recording": "fusion.sensitivity.evaluate",
    "evaluate_rotation": "fusion.sensor.rotate.evaluate",
    "evaluate_steps": "fusion.sensor.step.evaluate",
    "evaluate_transfer": "fusion.sensor.transfer.evaluate",
    "find_recordings": "fusion.recording.load",
    "load_for_command": "fusion.recording.load",
    "load_manifest": "fusion.recording.load",
    "make_plan": "fusion.planning.plan",
    "read_compensation_filters": "fusion.sensor.compensate.report",
    "read_decoupling_filter": "fusion.sensor.decouple.evaluate",
    "read_load_models": "fusion.sensor.models_file",
    "read_recorded": "fusion.campaign.recorded",
    "read_sensor_models": "fusion.sensor.identify.report",
    "run_path": "fusion.campaign.run",
    "simulate_preset": "fusion.simulate",
}
"""Where each public name lives."""

_NAMED_THERE = {"simulate_preset": "simulate"}
"""Names that stand there under another one: `fusion.simulate` is the package."""

__all__ = [
    "Acceleration",
    "CheckReport",
    "ComputeError",
    "DecoupleSettings",
    "Evaluation",
    "InputError",
    "LoadResult",
    "Manifest",
    "Request",
    "Sensitivity",
    "Settings",
    "StepSettings",
    "TransferSettings",
    "__version__",
    "check",
    "evaluate_compensation",
    "evaluate_decoupling",
    "evaluate_element",
    "evaluate_identification",
    "evaluate_loads",
    "evaluate_recording",
    "evaluate_rotation",
    "evaluate_steps",
    "evaluate_transfer",
    "find_recordings",
    "load_for_command",
    "load_manifest",
    "make_plan",
    "read_compensation_filters",
    "read_decoupling_filter",
    "read_load_models",
    "read_recorded",
    "read_sensor_models",
    "run_path",
    "simulate_preset",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("shakercal")
    elif name in _MODULES:
        from importlib import import_module

        value = getattr(import_module(_MODULES[name]), _NAMED_THERE.get(name, name))
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
