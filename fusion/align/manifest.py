"""alignment.toml as checked, typed values: the contract is the table in `docs/cameras.md`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, model_validator

from fusion.manifest.load import read_toml, validate
from fusion.manifest.paths import PathScope
from fusion.manifest.values import (
    ZERO3,
    ZERO6,
    Block,
    Context,
    Direction,
    ExistingFile,
    ExistingFiles,
    FreeVector,
    NotNegative,
    PoseSpread,
    Positive,
    Rotation,
    Spread3,
    Text,
    array_of_tables,
    refusal,
    repeated_name,
    vector,
)


def _size(value: Any) -> tuple[int, int]:
    """Check columns and rows of a target."""
    whole = isinstance(value, list | tuple) and len(value) == 2 and all(type(item) is int for item in value)
    if not whole or min(value) < 2:
        raise refusal("2 whole numbers of at least 2, columns and rows", f"{value}"[:60])
    return value[0], value[1]


Pixel = Annotated[tuple[float, float], BeforeValidator(vector(2))]
Blocks = BeforeValidator(array_of_tables)


class Point(Block):
    """A point of known place, and where both cameras see it."""

    name: Text
    position: FreeVector
    position_uncertainty: Spread3 = ZERO3
    left: Pixel
    right: Pixel
    pixel_uncertainty: Positive


class Face(Block):
    """A flat face of known place, and a table of points that both cameras see on it."""

    name: Text
    point: FreeVector
    normal: Direction
    offset_uncertainty: NotNegative = 0.0
    normal_uncertainty: NotNegative = 0.0
    pixels: ExistingFile
    pixel_uncertainty: Positive


class TargetBlock(Block):
    """The calibration target of the views."""

    kind: Literal["chessboard", "charuco", "dots", "asymmetric-dots"]
    spacing: Positive
    size: Annotated[tuple[int, int] | None, BeforeValidator(_size)] = None
    dictionary: Text | None = None

    @model_validator(mode="after")
    def _size_where_needed(self) -> Self:
        if self.size is None and self.kind != "dots":
            raise refusal(f"columns and rows of the {self.kind} target", "nothing", key="size")
        return self


class TargetViewBlock(Block):
    """The target mounted at a known pose, x_sensor = rotation · x_target + translation, and its pictures."""

    name: Text
    left: ExistingFiles = ()
    right: ExistingFiles = ()
    rotation: Rotation
    translation: FreeVector
    pose_uncertainty: PoseSpread = ZERO6

    @model_validator(mode="after")
    def _pictures(self) -> Self:
        if not self.left and not self.right:
            raise refusal("the pictures of at least one camera", "none", key="left")
        if self.left and self.right and len(self.left) != len(self.right):
            raise refusal(f"{len(self.left)} pictures as on the left", f"{len(self.right)}", key="right")
        return self


class CommonView(Block):
    """Pictures of the target, wherever it was held, by both stereo pairs."""

    name: Text
    left: ExistingFile
    right: ExistingFile
    other_left: ExistingFile
    other_right: ExistingFile


class OtherPair(Block):
    """The stereo pair that took part in common views; without a pose the result is relative to its left camera."""

    stereo: Text
    calibration: ExistingFile
    scale_uncertainty: NotNegative | None = None
    rotation: Rotation | None = None
    translation: FreeVector | None = None
    pose_uncertainty: PoseSpread = ZERO6

    @model_validator(mode="after")
    def _whole_pose(self) -> Self:
        if (self.rotation is None) != (self.translation is None):
            missing = "rotation" if self.rotation is None else "translation"
            raise refusal("rotation and translation, or neither", "one of them", key=missing)
        return self


class Motion(Block):
    """Recordings in one set-up, in which the sensor's origin moves along a known direction."""

    name: Text
    recordings: ExistingFiles
    direction: Direction | None = None
    direction_uncertainty: NotNegative


class AxisBlock(Block):
    """Recordings in one set-up, in which the body turns about a known axis."""

    name: Text
    recordings: ExistingFiles
    point: FreeVector
    point_uncertainty: Spread3 = ZERO3
    direction: Direction
    direction_uncertainty: NotNegative


class KnownPose(Block):
    """What was known of the pose before."""

    rotation: Rotation
    translation: FreeVector
    pose_uncertainty: PoseSpread

    @model_validator(mode="after")
    def _no_certainty(self) -> Self:
        if min(self.pose_uncertainty) <= 0.0:
            raise refusal("6 numbers above 0 (3 in m, 3 in rad)", f"{min(self.pose_uncertainty):g}", "pose_uncertainty")
        return self


class AlignmentFile(Block):
    """alignment.toml: the evidence on where a stereo pair's left camera stands in the sensor frame."""

    format: Literal[1]
    stereo: Text
    calibration: ExistingFile | None = None
    scale_uncertainty: NotNegative | None = None
    datum_uncertainty: PoseSpread = ZERO6
    pose: KnownPose | None = None
    target: TargetBlock | None = None
    other: OtherPair | None = None
    point: Annotated[tuple[Point, ...], Blocks] = ()
    face: Annotated[tuple[Face, ...], Blocks] = ()
    target_view: Annotated[tuple[TargetViewBlock, ...], Blocks] = ()
    common_view: Annotated[tuple[CommonView, ...], Blocks] = ()
    motion: Annotated[tuple[Motion, ...], Blocks] = ()
    axis: Annotated[tuple[AxisBlock, ...], Blocks] = ()

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        for key in ("point", "face", "target_view", "common_view", "motion", "axis"):
            blocks = getattr(self, key)
            twice = repeated_name([block.name for block in blocks])
            if twice is not None:
                raise refusal("different names", f'"{twice}" twice', key=key)
            if blocks and self.calibration is None and key not in ("motion", "axis"):
                raise refusal(f"the calibration that [[{key}]] needs", "nothing", key="calibration")
        if (self.target_view or self.common_view) and self.target is None:
            raise refusal("the [target] that is seen in the views", "nothing", key="target")
        if self.common_view and self.other is None:
            raise refusal("the [other] pair of the common views", "nothing", key="other")
        if self.other is not None and self.other.rotation is None:
            stray = next(
                (key for key in ("point", "face", "target_view", "motion", "axis") if getattr(self, key)), None
            )
            if stray is not None or self.pose is not None:
                raise refusal(
                    "the pose of the other pair, without which all else belongs to another frame",
                    "nothing",
                    key="other.rotation",
                )
        if not any((self.point, self.face, self.target_view, self.common_view, self.motion, self.axis)):
            raise refusal("at least one block of evidence such as [[point]] or [[motion]]", "none")
        return self


def read_alignment(path: Path, allow_outside: bool = False) -> AlignmentFile:
    """Read and check alignment.toml; its paths start in its folder and stay there."""
    folder = path.parent.resolve()
    return validate(AlignmentFile, read_toml(path), path, Context(PathScope(folder, folder, allow_outside), {}))
