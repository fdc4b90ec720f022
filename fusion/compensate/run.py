"""The command `shakercal compensate`: models → filters, result folder."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from fusion.compensate.evaluate import evaluate_compensation
from fusion.compensate.page import PAGE_FILE
from fusion.compensate.recording import OutputRecord, read_outputs, with_load
from fusion.compensate.results import H5_FILE, write_compensation
from fusion.compensate.sources import Sources, read_sources, stated
from fusion.compensate.tables import printed
from fusion.compensate.wish import COMMAND, Wish
from fusion.errors import InputError
from fusion.evaluated import log_notices
from fusion.provenance import check_folder, hash_files
from shaker.models.compensation.dynamics import SensorDynamics, single_mode

log = logging.getLogger("shakercal")
DEFAULT_FOLDER = "compensate"


def run_compensate(
    models: Sequence[Path],
    sensor: tuple[float | None, float | None],
    wish: Wish,
    output: Path | None,
    *,
    recording: Path | None = None,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Make the filters of some models or of a stated `sensor` (Hz, damping ratio), write them and print the summary.

    Results stand in folder `compensate` beside the first model, or in the working folder, or in `output`.
    """
    sources = _sources(models, sensor)
    record = None if recording is None else read_outputs(recording, allow_outside=allow_outside)
    beside = sources.files[0].parent if sources.files else Path.cwd()
    _check_loads(sources, wish)
    folder = beside / DEFAULT_FOLDER if output is None else output
    hashes = hash_files([*sources.files, *_files(record)], beside)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    evaluation = evaluate_compensation(sources, with_load(wish, sources, record), record, hashes)
    log_notices(evaluation, log)
    write_compensation(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")


def _sources(models: Sequence[Path], sensor: tuple[float | None, float | None]) -> Sources:
    """Models from files, or the stated sensor; one of the two."""
    frequency, damping = sensor
    if models:
        if frequency is not None or damping is not None:
            expected = "either models or --sensor-frequency with --sensor-damping"
            raise InputError(COMMAND, "", found="both", expected=expected)
        return read_sources(models)
    if frequency is None or damping is None:
        expected = "models.json, load.json, a folder with one, or --sensor-frequency with --sensor-damping"
        raise InputError(COMMAND, "", found="nothing of it", expected=expected)
    return stated(_single(frequency, damping))


def _check_loads(sources: Sources, wish: Wish) -> None:
    """Refuse loads where no model follows the load."""
    if wish.load_masses and not any(subject.is_scheduled for subject in sources.subjects):
        found = ", ".join(f"{mass:g} kg" for mass in wish.load_masses)
        raise InputError(COMMAND, "--load-mass", found=found, expected="a model over the load (load.json) for it")


def _single(frequency: float, damping: float) -> SensorDynamics:
    """The stated sensor."""
    if not damping < 1.0:
        expected = "a damping ratio below 1, of a sensor that oscillates"
        raise InputError(COMMAND, "--sensor-damping", found=f"{damping:g}", expected=expected)
    return single_mode(frequency, damping)


def _files(record: OutputRecord | None) -> tuple[Path, ...]:
    """The files of a recording."""
    return () if record is None else tuple(record.manifest.files)
