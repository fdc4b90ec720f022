"""Digital twin of a rig for `shakercal simulate`: campaign folders, images of a target."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from fusion.base import ProgressCallback, no_progress
from fusion.errors import InputError
from fusion.report.atomic_files import write_together
from fusion.simulate.simulation_notices import SIMULATION_FOLDER_IN_USE

RECORDINGS = ("demo", "nitsche2018", "bending", "room", "single", "laboratory", "sweep", "multisine", "matrix")
"""Presets of sines, with the switches of `SimulationOptions`."""
GRAVITY_TESTS = ("rotation", "orientations")
CHIRPS = ("chirp", "masses", "pitching")
CAMERA_TESTS = ("targets", "acceptance")
PRESETS = (*RECORDINGS, "files", *CAMERA_TESTS, *CHIRPS, *GRAVITY_TESTS, "steps", "loads", "elastomer")


def simulate(
    out: str | Path, preset: str, seed: int, progress: ProgressCallback = no_progress, **switches: Any
) -> Path:
    """Write a simulated recording, campaign or geometry into a folder.

    Parameters
    ----------
    out : str or Path
        New folder, or one with an earlier simulation.
    preset : str
        One of `PRESETS`.
    seed : int
        Of all random numbers: the same seed gives the same files.
    progress : ProgressCallback
        Called with stage, done and total (default: none).
    **switches : Any
        Fields of `SimulationOptions`, for presets of sines.

    Returns
    -------
    Path
        The recording, or the folder or file to evaluate.

    Raises
    ------
    InputError
        If the folder has other files. It is written completely or not at all.
    ValueError
        For unknown presets and switches.

    Examples
    --------
    >>> import tempfile
    >>> from fusion import find_recordings, simulate_preset
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     campaign = simulate_preset(f"{folder}/turned", "rotation", seed=1)
    ...     len(find_recordings(campaign))
    2
    """
    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, found {preset!r}")
    violated = preset == "acceptance" and [*switches] == ["violate"]
    if switches and preset not in (*RECORDINGS, "files") and not violated:
        raise ValueError(f"{next(iter(switches))}: expected one of the presets {', '.join(RECORDINGS)}, found {preset}")
    out = Path(out)
    _check_out(out)

    def make(folder: Path) -> list[str]:
        _write(folder, preset, seed, progress, switches)
        return _files(folder)

    write_together(out, make, lambda: _files(out))
    if preset == "elastomer":
        return out / "elastomer.toml"
    recordings = list(out.glob("*/recording.toml"))
    return recordings[0].parent if len(recordings) == 1 else out


simulate_preset = simulate
"""The function's name in `fusion`, where `simulate` is this package."""


def _write(folder: Path, preset: str, seed: int, progress: ProgressCallback, switches: dict[str, Any]) -> None:
    """Write a preset into an empty folder, with imports for this preset only."""
    if preset in RECORDINGS:
        from fusion.simulate.sines import SimulationOptions, write_runs

        write_runs(folder, preset, seed, progress, SimulationOptions(**switches))
    elif preset == "files":
        from fusion.simulate.laboratory_files import write_laboratory_files
        from fusion.simulate.sines import SimulationOptions

        write_laboratory_files(folder, seed, progress, SimulationOptions(**switches))
    elif preset in CHIRPS:
        from fusion.simulate.chirp import write_chirp, write_masses, write_pitching

        if preset == "masses":
            write_masses(folder, seed, progress)
        else:
            (write_chirp if preset == "chirp" else write_pitching)(folder, seed)
    elif preset == "acceptance":
        from fusion.simulate.acceptance import write_acceptance

        write_acceptance(folder, seed, progress, **switches)
    elif preset in ("steps", "loads"):
        from fusion.simulate.releases import write_loads, write_steps

        (write_steps if preset == "steps" else write_loads)(folder, seed)
    else:
        from fusion.simulate.statics import write_element, write_rotation, write_session

        if preset == "targets":
            write_session(folder, seed, progress)
        elif preset in GRAVITY_TESTS:
            write_rotation(folder, seed, posed=preset == "orientations")
        else:
            write_element(folder, seed)


def _check_out(out: Path) -> None:
    """Refuse a path that is not a new folder or an unchanged earlier simulation."""
    from fusion.report.folder import check_folder

    other = _not_simulated(out) if out.is_dir() else out if out.exists() else None
    if other is not None:
        expected = "a new folder, or an earlier simulation as it was written"
        found = "a file" if other == out else f"{other.relative_to(out).as_posix()} in it"
        raise InputError(SIMULATION_FOLDER_IN_USE, out, found=found, expected=expected)
    check_folder(out, {}, force=True)


def _files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def _listed(truth: Path) -> list[str]:
    """Return the present files that a truth lists, none if it is damaged."""
    try:
        stated = json.loads(truth.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    images = [f"{side}/{number:02d}.png" for side in ("left", "right") for number in range(10)]
    listed = stated.get("files", images if "left" in stated else None) if isinstance(stated, dict) else None
    return [name for name in _files(truth.parent) if name in listed] if isinstance(listed, list) else []


def _not_simulated(out: Path) -> Path | None:
    """Return a path in a folder that is no part of a simulation, else None."""
    from fusion.recording.load import load_manifest

    element = {(out / name).resolve() for name in ("elastomer.toml", "models.json", "truth.json")}
    written = element if all(file.is_file() for file in element) else set()
    written.update((out / name).resolve() for name in _listed(out / "truth.json"))
    for truth in out.glob("*/truth.json"):
        with suppress(InputError):
            written.update(load_manifest(truth.parent).files, [truth.resolve()])
    if written:
        written.add((out / "truth.json").resolve())
    allowed = written | {folder for file in written for folder in file.parents}
    return next((path for path in sorted(out.rglob("*")) if path.resolve() not in allowed), None)
