"""A rig's digital twin, by `shakercal simulate`: campaign folders with one or many recordings, pictures of a target."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fusion.base import ProgressCallback, no_progress

_JITTER_S = 30e-9


def simulate(out: Path, preset: str, seed: int, progress: ProgressCallback = no_progress, **switches: Any) -> Path:
    """Write the campaign of a preset (`demo`, `nitsche2018`) into folder `out` and return its recording's folder.

    `switches` are the fields of `SimulationOptions`. The same seed gives the same files. A folder that holds
    anything but an earlier simulation is refused with an `InputError`; it appears whole or not at all.
    """
    from fusion.simulate.preset import PRESETS, SimulationOptions
    from fusion.simulate.world import Draws, make_world
    from fusion.simulate.write import write_campaign

    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, found {preset!r}")
    options = SimulationOptions(**switches)
    setup = PRESETS[preset].shrunk(options.frames, options.image_scale)
    draws = Draws(seed, options.systematic_errors)
    world = make_world(setup, draws, _JITTER_S if options.trigger_jitter else 0.0)
    noise = (options.image_noise, options.channel_noise)
    with _whole(out) as partial:
        write_campaign(partial, world, draws, noise, options.aliased, progress)
    return out / setup.recording


def simulate_campaign(
    out: Path, preset: str, seed: int, progress: ProgressCallback = no_progress, **switches: Any
) -> tuple[Path, ...]:
    """Write a campaign of many recordings (`sweep`, `matrix`) into folder `out` and return their folders.

    `switches` are the fields of `CampaignOptions`. The same seed gives the same files; other folders are refused as by
    `simulate`.
    """
    from fusion.simulate.write import CAMPAIGNS, CampaignOptions, write_runs

    if preset not in CAMPAIGNS:
        raise ValueError(f"preset: expected one of {', '.join(CAMPAIGNS)}, found {preset!r}")
    options = CampaignOptions(**switches)
    with _whole(out) as partial:
        write_runs(partial, preset, seed, options, progress)
    return tuple(sorted(truth.parent for truth in out.glob("*/truth.json")))


def simulate_targets(out: Path, seed: int, progress: ProgressCallback = no_progress) -> Path:
    """Write a calibration session, pictures of a ChArUco board and the true pair, into folder `out` and return it.

    The same seed gives the same files; other folders are refused as by `simulate`.
    """
    from fusion.simulate.statics import write_session

    with _whole(out) as partial:
        write_session(partial, seed, progress)
    return out


def simulate_chirp(out: Path, seed: int) -> Path:
    """Write an oscillator's chirp recording, channels only, into folder `out` and return its recording's folder.

    The same seed gives the same files; other folders are refused as by `simulate`.
    """
    from fusion.simulate.chirp import RECORDING, write_chirp

    with _whole(out) as partial:
        write_chirp(partial, seed)
    return out / RECORDING


def simulate_loads(out: Path, preset: str, seed: int, progress: ProgressCallback = no_progress) -> Path:
    """Write the campaign of two loads on a sensor's springs (`masses`, `pitching`) into folder `out` and return it.

    The same seed gives the same files; other folders are refused as by `simulate`.
    """
    from fusion.simulate.chirp import write_masses, write_pitching

    with _whole(out) as partial:
        if preset == "masses":
            write_masses(partial, seed, progress)
        else:
            write_pitching(partial, seed)
    return out


def simulate_rotation(out: Path, seed: int) -> tuple[Path, ...]:
    """Write a rotation test, a recording without and one with load, into folder `out` and return their folders.

    The same seed gives the same files; other folders are refused as by `simulate`.
    """
    from fusion.simulate.statics import BARE, LOADED, write_rotation

    with _whole(out) as partial:
        write_rotation(partial, seed)
    return out / BARE, out / LOADED


def simulate_steps(out: Path, seed: int) -> tuple[Path, ...]:
    """Write a calibration by releases, three ropes and six components, into folder `out`; return its recordings.

    The same seed gives the same files; other folders are refused as by `simulate`.
    """
    from fusion.simulate.releases import releases, write_steps

    with _whole(out) as partial:
        write_steps(partial, seed)
    return tuple(out / release.name for release in releases())


def simulate_load_series(out: Path, seed: int) -> tuple[Path, ...]:
    """Write releases of a force sensor with five load masses into folder `out`; return its recordings.

    The same seed gives the same files; other folders are refused as by `simulate`.
    """
    from fusion.simulate.releases import write_loads

    with _whole(out) as partial:
        names = [recording.name for recording in write_loads(partial, seed)]
    return tuple(out / name for name in names)


def simulate_element(out: Path, seed: int) -> Path:
    """Write a cross-beam element and the measured models of a sensor made of it into folder `out`; return its file.

    The same seed gives the same files; other folders are refused as by `simulate`.
    """
    from fusion.simulate.statics import GEOMETRY_FILE, write_element

    with _whole(out) as partial:
        write_element(partial, seed)
    return out / GEOMETRY_FILE


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """Yield a folder that takes the place of `out` when it is complete; refuse anything but an earlier simulation."""
    from fusion.base import InputError

    other = _not_simulated(out) if out.is_dir() else out if out.exists() else None
    if other is not None:
        expected = "a new folder, or an earlier simulation as it was written"
        found = "a file" if other == out else f"{other.relative_to(out).as_posix()} in it"
        raise InputError(out, "", found=found, expected=expected)
    partial = out.absolute().with_name(f".{out.absolute().name}-{os.getpid()}")
    try:
        partial.mkdir(parents=True)
    except OSError as error:
        raise InputError.told_by(error, out) from error
    try:
        yield partial
        if out.exists():
            shutil.rmtree(out)
        os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _not_simulated(out: Path) -> Path | None:
    """Return something in a folder that is neither named by a simulated recording nor its truth, None if all is."""
    from fusion.base import InputError
    from fusion.recording.load import load_manifest
    from fusion.simulate.statics import written_files

    written = written_files(out) | _element_files(out)
    for truth in out.glob("*/truth.json"):
        with suppress(InputError):
            written.update(load_manifest(truth.parent).files, [truth.resolve()])
    if written:
        written.add((out / "truth.json").resolve())
    folders = {folder for file in written for folder in file.parents}
    known = written | folders
    return next((path for path in sorted(out.rglob("*")) if path.resolve() not in known), None)


def _element_files(out: Path) -> set[Path]:
    """Return the files of a folder that `simulate_element` wrote: all of them are there, and nothing is missing."""
    from fusion.simulate.statics import WRITTEN

    files = {(out / name).resolve() for name in WRITTEN}
    return files if all(file.is_file() for file in files) else set()
