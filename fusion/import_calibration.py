"""The command `shakercal import-calibration`: another program's calibration → a calibration file of this one."""

from __future__ import annotations

import logging
from pathlib import Path

from fusion.errors import InputError
from fusion.output import check_new_file
from photogram.calibration_file import write_calibration
from photogram.calibration_import import LengthUnit, import_calibration

log = logging.getLogger("shakercal")


def convert_calibration(
    source: tuple[Path, Path | None],
    output: Path,
    image_size: tuple[int, int] | None,
    length_unit: LengthUnit | None,
    force: bool = False,
) -> str:
    """Write the calibration of `source` (file, extrinsics apart from it or None) to `output` and return the format.

    What the user should know is logged, also the remarks that are no warnings: they say how the file was understood.
    """
    check_new_file(output, force=force)
    path, extrinsics = source
    try:
        imported = import_calibration(path, image_size, length_unit, extrinsics)
    except OSError as error:
        raise InputError.told_by(error, path) from error
    except ValueError as error:
        told = str(error).replace(": image_size: ", ": --image-size: ").replace(": length_unit: ", ": --length-unit: ")
        raise InputError.told_by(ValueError(told), path) from error
    try:
        write_calibration(output, imported.rig)
    except OSError as error:
        raise InputError.told_by(error, output) from error
    for notice in imported.notices:
        level = logging.WARNING if notice.severity == "warning" else logging.INFO
        log.log(level, "%s: %s", notice.where, notice.text)
    return imported.format
