"""Signals and mechanics of shaker measurements. Knows nothing of images.

Everything named here is public; a name is imported when it is first used, so that `import shaker` costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shaker.frf.chain import ChainResponse
    from shaker.frf.impact import transfer_impact
    from shaker.frf.periodic import transfer_periodic
    from shaker.frf.random import transfer_random
    from shaker.frf.result import TransferRecord
    from shaker.io import read_channels
    from shaker.io.channel import RawChannel
    from shaker.lines.detection import survey_lines
    from shaker.lines.rate_planner import Sampling, lines_of, plan_at
    from shaker.sine.fit import fit_sines
    from shaker.sine.phasor import Phasors
    from shaker.sine.solve import SineModel
    from shaker.timebase.edges import find_edges
    from shaker.timebase.tie import tie_clocks
    from shaker.timebase.trigger import fit_trigger

_MODULES = {
    "ChainResponse": "shaker.frf.chain",
    "Phasors": "shaker.sine.phasor",
    "RawChannel": "shaker.io.channel",
    "Sampling": "shaker.lines.rate_planner",
    "SineModel": "shaker.sine.solve",
    "TransferRecord": "shaker.frf.result",
    "find_edges": "shaker.timebase.edges",
    "fit_sines": "shaker.sine.fit",
    "fit_trigger": "shaker.timebase.trigger",
    "lines_of": "shaker.lines.rate_planner",
    "plan_at": "shaker.lines.rate_planner",
    "read_channels": "shaker.io",
    "survey_lines": "shaker.lines.detection",
    "tie_clocks": "shaker.timebase.tie",
    "transfer_impact": "shaker.frf.impact",
    "transfer_periodic": "shaker.frf.periodic",
    "transfer_random": "shaker.frf.random",
}
"""Where each public name lives."""

__all__ = [
    "ChainResponse",
    "Phasors",
    "RawChannel",
    "Sampling",
    "SineModel",
    "TransferRecord",
    "__version__",
    "find_edges",
    "fit_sines",
    "fit_trigger",
    "lines_of",
    "plan_at",
    "read_channels",
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
