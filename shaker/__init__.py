"""Signals and mechanics of shaker measurements. Knows nothing of images.

Everything named here is public; a name is imported when it is first used, so that `import shaker` costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shaker.compensation.filter import Compensation, CompensationFilter
    from shaker.decoupling.filter import design_decoupling
    from shaker.decoupling.fit import fit_steps
    from shaker.decoupling.responses import fit_responses
    from shaker.elastomer.frame import solve_frame
    from shaker.frf.chain import ChainResponse
    from shaker.frf.impact import transfer_impact
    from shaker.frf.periodic import transfer_periodic
    from shaker.frf.random import transfer_random
    from shaker.frf.result import TransferRecord
    from shaker.identification.measured import MeasuredCurve
    from shaker.identification.oscillator import fit_resonance
    from shaker.identification.sensor import Load, correct_record
    from shaker.io import read_channels
    from shaker.io.channel import RawChannel
    from shaker.io.universal import read_universal_functions, read_universal_shapes
    from shaker.lines.detection import survey_lines
    from shaker.lines.rate_planner import Sampling, lines_of, plan_at
    from shaker.lti.indices import indices
    from shaker.lti.system import LinearSystem
    from shaker.mechanics import MassChain
    from shaker.release.fit import fit_step
    from shaker.release.load_series import identify_loads
    from shaker.release.reading import read_release
    from shaker.release.record import StepRecord
    from shaker.sine.fit import fit_sines
    from shaker.sine.phasor import Phasors
    from shaker.sine.solve import SineModel
    from shaker.static_rotation.masses import fit_weights
    from shaker.timebase.edges import find_edges
    from shaker.timebase.tie import tie_clocks
    from shaker.timebase.trigger import fit_trigger

_MODULES = {
    "ChainResponse": "shaker.frf.chain",
    "Compensation": "shaker.compensation.filter",
    "CompensationFilter": "shaker.compensation.filter",
    "LinearSystem": "shaker.lti.system",
    "Load": "shaker.identification.sensor",
    "MassChain": "shaker.mechanics",
    "MeasuredCurve": "shaker.identification.measured",
    "Phasors": "shaker.sine.phasor",
    "RawChannel": "shaker.io.channel",
    "Sampling": "shaker.lines.rate_planner",
    "SineModel": "shaker.sine.solve",
    "StepRecord": "shaker.release.record",
    "TransferRecord": "shaker.frf.result",
    "correct_record": "shaker.identification.sensor",
    "design_decoupling": "shaker.decoupling.filter",
    "find_edges": "shaker.timebase.edges",
    "fit_resonance": "shaker.identification.oscillator",
    "fit_responses": "shaker.decoupling.responses",
    "fit_sines": "shaker.sine.fit",
    "fit_step": "shaker.release.fit",
    "fit_steps": "shaker.decoupling.fit",
    "fit_trigger": "shaker.timebase.trigger",
    "fit_weights": "shaker.static_rotation.masses",
    "identify_loads": "shaker.release.load_series",
    "indices": "shaker.lti.indices",
    "lines_of": "shaker.lines.rate_planner",
    "plan_at": "shaker.lines.rate_planner",
    "read_channels": "shaker.io",
    "read_release": "shaker.release.reading",
    "read_universal_functions": "shaker.io.universal",
    "read_universal_shapes": "shaker.io.universal",
    "solve_frame": "shaker.elastomer.frame",
    "survey_lines": "shaker.lines.detection",
    "tie_clocks": "shaker.timebase.tie",
    "transfer_impact": "shaker.frf.impact",
    "transfer_periodic": "shaker.frf.periodic",
    "transfer_random": "shaker.frf.random",
}
"""Where each public name lives."""

__all__ = [
    "ChainResponse",
    "Compensation",
    "CompensationFilter",
    "LinearSystem",
    "Load",
    "MassChain",
    "MeasuredCurve",
    "Phasors",
    "RawChannel",
    "Sampling",
    "SineModel",
    "StepRecord",
    "TransferRecord",
    "__version__",
    "correct_record",
    "design_decoupling",
    "find_edges",
    "fit_resonance",
    "fit_responses",
    "fit_sines",
    "fit_step",
    "fit_steps",
    "fit_trigger",
    "fit_weights",
    "identify_loads",
    "indices",
    "lines_of",
    "plan_at",
    "read_channels",
    "read_release",
    "read_universal_functions",
    "read_universal_shapes",
    "solve_frame",
    "survey_lines",
    "tie_clocks",
    "transfer_impact",
    "transfer_periodic",
    "transfer_random",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("shakercal")
    elif name in _MODULES:
        from importlib import import_module

        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
