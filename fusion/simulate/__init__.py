"""A rig's digital twin: a campaign folder with one recording and its truth, by `shakercal simulate`."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from fusion.settings import ProgressCallback, no_progress

_JITTER_S = 30e-9


def simulate(out: Path, preset: str, seed: int, progress: ProgressCallback = no_progress, **switches: Any) -> Path:
    """Write the campaign of a preset (`demo`, `nitsche2018`) into folder `out` and return its recording's folder.

    `switches` are the fields of `SimulationOptions`. The same seed gives the same files. A folder that holds
    anything but an earlier simulation is refused; it appears whole or not at all.
    """
    from fusion.simulate.draws import Draws
    from fusion.simulate.options import SimulationOptions
    from fusion.simulate.preset import PRESETS
    from fusion.simulate.world import make_world
    from fusion.simulate.write import write_campaign

    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, found {preset!r}")
    options = SimulationOptions(**switches)
    setup = PRESETS[preset].shrunk(options.frames, options.image_scale)
    if out.exists() and not _replaceable(out):
        raise ValueError(f"out: expected a new folder or an earlier simulation, found other files in {out}")
    draws = Draws(seed, options.systematic_errors)
    world = make_world(setup, draws, _JITTER_S if options.trigger_jitter else 0.0)
    partial = out.with_name(out.name + f".partial-{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        noise = (options.image_noise, options.channel_noise)
        write_campaign(partial, world, draws, noise, options.aliased, progress)
        if out.exists():
            shutil.rmtree(out)
        os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return out / setup.recording


def _replaceable(out: Path) -> bool:
    """Say whether a folder is empty or holds nothing but one simulated campaign."""
    recordings = {path.parent.name for path in out.glob("*/truth.json")}
    allowed = {"rig.toml", "calibration", "results", *recordings}
    return out.is_dir() and {path.name for path in out.iterdir()} <= allowed
