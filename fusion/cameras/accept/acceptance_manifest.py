"""acceptance.toml as checked values: calibration, images of each test, stated steps, tolerances.

The keys are in the tables of `docs/acceptance.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from fusion.cameras.camera_notices import NEEDS_STEREO_PAIR
from fusion.errors import InputError, as_input_error
from fusion.recording.toml import read_toml, validate
from fusion.recording.values import (
    Angle,
    Context,
    Direction,
    ExistingFile,
    ExistingFiles,
    ManifestBlock,
    Mask,
    NotNegative,
    PathScope,
    Positive,
    Region,
    Share,
    Text,
    Version,
    array_of_tables,
    describe,
    is_number,
    refusal,
    repeated_name,
)
from photogram.calibration.calibration_file import is_single, read_calibration
from photogram.camera import StereoRig

FILE_NAME = "acceptance.toml"
FEWEST_STATIONARY = 32
"""Frames of a stationary scene, the fewest of which `shaker.survey_lines` finds a spectrum."""
FEWEST_MOVED = 3
"""Frames of a translation: two do not show whether the path is straight."""
FEWEST_ROTATED = 2
"""Frames of a rotation: the first one, and a turned one."""
MOST_FRAMES = 100_000


def _numbers(value: object) -> tuple[float, ...]:
    """Check a list of finite numbers."""
    if not isinstance(value, list | tuple) or not all(is_number(item) for item in value):
        raise refusal("a list of numbers, one for each image", describe(value))
    if len(set(value)) < 2:
        raise refusal("at least two different numbers", describe(value))
    return tuple(float(item) for item in value)


Numbers = Annotated[tuple[float, ...], BeforeValidator(_numbers)]
Blocks = BeforeValidator(array_of_tables)


class ImagePair(ManifestBlock):
    """Images of both cameras, in the same order."""

    left: ExistingFiles
    right: ExistingFiles


class StationaryBlock(ImagePair):
    """A scene at rest.

    `frame_rate`: Hz; without it drift and vibration are over the frame number.
    """

    frame_rate: Positive | None = None


class TranslationBlock(ImagePair):
    """A body moved along a stage without rotation.

    `positions`: of the stage for each image, m. Standard uncertainties: of each position (m), relative of all of them,
    of the rotation of the stage over the whole travel (rad) and of its straightness (m).
    """

    name: Text
    positions: Numbers | None = None
    position_uncertainty: NotNegative = 0.0
    scale_uncertainty: Share = 0.0
    rotation_uncertainty: Angle = 0.0
    straightness_uncertainty: NotNegative = 0.0


class RotationBlock(ImagePair):
    """A body turned by known angles (rad) about a fixed axis.

    `axis`: in the left camera's frame, x right, y down, z away; positive angles by the right-hand rule.
    """

    name: Text
    angles: Numbers
    angle_uncertainty: Angle = 0.0
    axis: Direction | None = None
    axis_uncertainty: Angle = 0.0


class Tolerances(ManifestBlock):
    """Largest permitted magnitudes; `_px` are pixels of the left camera on the object."""

    noise_ratio: Positive = 1.5
    drift_px: Positive = 0.02
    vibration_px: Positive = 0.02
    epipolar_px: Positive = 0.05
    scale: Positive = 5e-4
    scale_variation: Positive = 5e-4
    position_px: Positive = 0.05
    straightness_px: Positive = 0.05
    rotation: Positive = 1e-4
    strain: Positive = 1e-4
    bending_px: Positive = 0.02
    angle: Positive = 5e-3
    axis: Positive = 0.02


class AcceptanceTables(ManifestBlock):
    """All tables of acceptance.toml."""

    format: Version
    name: Text = "stereo rig"
    calibration: ExistingFile
    region: Region | None = None
    mask: Mask = ()
    bit_depth: Annotated[int, Field(ge=8, le=16)] | None = None
    stationary: StationaryBlock | None = None
    translation: Annotated[tuple[TranslationBlock, ...], Blocks] = ()
    rotation: Annotated[tuple[RotationBlock, ...], Blocks] = ()
    tolerance: Tolerances | None = None

    @property
    def tolerances(self) -> Tolerances:
        """The stated tolerances, or their defaults."""
        return self.tolerance or Tolerances()

    @model_validator(mode="after")
    def _has_tests(self) -> Self:
        if self.stationary is None and not self.translation and not self.rotation:
            raise refusal("at least one of [stationary], [[translation]], [[rotation]]", "no test")
        for kind, blocks in (("translation", self.translation), ("rotation", self.rotation)):
            repeated = repeated_name([block.name for block in blocks])
            if repeated is not None:
                raise refusal("different names", f'"{repeated}" twice', key=kind)
        return self


@dataclass(frozen=True)
class AcceptanceFile:
    """A checked acceptance.toml and its calibration."""

    path: Path
    tables: AcceptanceTables
    rig: StereoRig

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that the tests read."""
        stationary = () if self.tables.stationary is None else (self.tables.stationary,)
        pairs: tuple[ImagePair, ...] = (*stationary, *self.tables.translation, *self.tables.rotation)
        return (self.path, self.tables.calibration, *(file for pair in pairs for file in (*pair.left, *pair.right)))


def read_acceptance(given: Path, *, allow_outside: bool = False) -> AcceptanceFile:
    """Return the tests of a folder with acceptance.toml, or of such a file."""
    path = given / FILE_NAME if given.is_dir() else given
    folder = path.absolute().parent.resolve()
    scope = PathScope(folder, folder, allow_outside, f"of {FILE_NAME}")
    tables = validate(AcceptanceTables, read_toml(path), path, Context(scope))
    with as_input_error(path, "calibration"):
        if is_single(tables.calibration):
            found = f"{tables.calibration.name}, of one camera"
            raise InputError(NEEDS_STEREO_PAIR, path, "calibration", found=found, expected="that of a pair")
        rig = read_calibration(tables.calibration)
    return AcceptanceFile(path, tables, rig)
