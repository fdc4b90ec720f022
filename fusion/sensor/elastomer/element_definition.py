"""The definition of an elastic element: GEOMETRY.toml as checked values (docs/elastomer.md)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from fusion.recording.toml import read_toml, validate
from fusion.recording.values import (
    DENSITY,
    HERTZ,
    MODULUS,
    Context,
    ExistingFile,
    ManifestBlock,
    Mass,
    NotNegative,
    Number,
    PathScope,
    Positive,
    Text,
    Version,
    array_of_tables,
    describe,
    refusal,
    repeated_name,
    size_range,
    vector,
)
from shaker.elastomer.frame import MODE_NAMES, RigidPart, block, join_bodies
from shaker.elastomer.geometry import CrossBeams
from shaker.elastomer.geometry import ElasticMaterial as MaterialData
from shaker.elastomer.solid import SolidBlock

MAX_SIZES = 1000  # far above any study, far below a limit of time
MAX_REFINEMENT = 6
"""Largest refinement of the solid's mesh: beyond it the memory is exhausted without a gain in accuracy."""


def _inertia(value: object) -> tuple[float, ...]:
    """Check three moments of inertia that a body can have."""
    moments = vector(3)(value)
    if min(moments) < 0.0 or max(moments) > 1.01 * (sum(moments) - max(moments)):
        raise refusal("three moments of inertia, none negative or above the sum of the others", f"{list(moments)}")
    return moments


def _refinements(value: object) -> tuple[int, ...]:
    """Check the meshes of the solid: whole numbers that grow."""
    expected = f"two or more whole numbers from 1 to {MAX_REFINEMENT} that grow"
    if not isinstance(value, list | tuple):
        raise refusal(expected, describe(value))
    whole = [v for v in value if isinstance(v, int) and not isinstance(v, bool) and 1 <= v <= MAX_REFINEMENT]
    if len(whole) != len(value) or len(whole) < 2 or sorted(set(whole)) != whole:
        raise refusal(expected, f"{list(value)}")
    return tuple(whole)


def _sizes(value: object) -> tuple[float, ...]:
    """Check a list of numbers above zero."""
    if not isinstance(value, list | tuple) or not value:
        raise refusal("a list of numbers above 0", describe(value))
    if len(value) > MAX_SIZES:
        raise refusal(f"at most {MAX_SIZES} numbers", f"{len(value)}")
    sizes = vector(len(value))(value)
    if min(sizes) <= 0.0:
        raise refusal("a list of numbers above 0", f"{min(sizes):g} in it")
    return sizes


SMALL = size_range(1e-6, 2.0, "m", mm=1e-3)
Size = Annotated[Positive, SMALL]
Offset = Annotated[Number, size_range(0.0, 2.0, "m", mm=1e-3)]
Inertia3 = Annotated[tuple[float, float, float], BeforeValidator(_inertia)]
Sizes = Annotated[tuple[float, ...], BeforeValidator(_sizes), SMALL]


class ElementMaterial(ManifestBlock):
    """Pa, -, kg/m³."""

    youngs_modulus: Annotated[Positive, MODULUS]
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5, allow_inf_nan=False)]
    density: Annotated[Positive, DENSITY]


class ElementBeams(ManifestBlock):
    """The cross beams, in m."""

    span: Size
    width: Size
    height: Size
    shear_factor: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 5.0 / 6.0


class CompliantBeams(ManifestBlock):
    """The compliant beams, in m."""

    thickness: Size
    length: Size
    height: Size | None = None


class ElementPlatform(ManifestBlock):
    """The platform: a block, or stated data (m, kg, kg·m²)."""

    half_size: Size
    thickness: Size | None = None
    height: Offset = 0.0
    mass: Mass | None = None
    centre_of_mass: Offset = 0.0
    inertia: Inertia3 | None = None

    @model_validator(mode="after")
    def _has_mass_or_block(self) -> ElementPlatform:
        if (self.mass is None) != (self.inertia is None):
            key = "inertia" if self.inertia is None else "mass"
            raise refusal("mass and inertia together", "only one of them", key)
        if self.mass is None and self.thickness is None:
            raise refusal("the thickness of the block, or mass and inertia", "neither", "thickness")
        if self.mass is None and "centre_of_mass" in self.model_fields_set:
            expected = "height, the centre of the block, where no mass is stated"
            raise refusal(expected, "centre_of_mass", "centre_of_mass")
        return self


class AttachedPart(ManifestBlock):
    """A rigid part on the platform, in kg, m, kg·m²."""

    name: Text
    mass: Mass
    centre_of_mass: Offset
    inertia: Inertia3


class FrameOptions(ManifestBlock):
    """How the frame is divided."""

    pieces: Annotated[int, Field(ge=1, le=50)] = 6
    mass_matrix: Literal["consistent", "lumped"] = "consistent"


class SolidOptions(ManifestBlock):
    """The meshes of the solid model."""

    refinements: Annotated[tuple[int, ...], BeforeValidator(_refinements)] = (1, 2, 3)


class Frequencies(ManifestBlock):
    """Natural frequencies in Hz by the name of their mode."""

    Tx: Annotated[Positive, HERTZ] | None = None
    Ty: Annotated[Positive, HERTZ] | None = None
    Tz: Annotated[Positive, HERTZ] | None = None
    Rx: Annotated[Positive, HERTZ] | None = None
    Ry: Annotated[Positive, HERTZ] | None = None
    Rz: Annotated[Positive, HERTZ] | None = None

    @property
    def values_hz(self) -> dict[str, float]:
        """The stated frequencies by mode."""
        return {name: value for name in MODE_NAMES if (value := getattr(self, name)) is not None}


class StatedFrequencies(Frequencies):
    """A column of the comparison."""

    name: Text


class PlatformFitOptions(ManifestBlock):
    """Platform data to be estimated from frequencies."""

    half_sizes: Sizes
    frequencies: Frequencies


class ElementMounting(ManifestBlock):
    """Hand, sensor and pedestal in series along one direction, in kg, N/m, N·s/m.

    Along a rotation in kg·m², N·m/rad and N·m·s/rad.
    """

    direction: Literal["Tx", "Ty", "Tz", "Rx", "Ry", "Rz"]
    hand_mass: NotNegative
    hand_stiffness: Positive
    hand_damping: NotNegative = 0.0
    sensor_damping: NotNegative = 0.0
    pedestal_mass: Positive
    pedestal_stiffness: Positive
    pedestal_damping: NotNegative = 0.0


class ElementFile(ManifestBlock):
    """GEOMETRY.toml."""

    format: Version
    name: Text
    material: ElementMaterial
    beams: ElementBeams
    compliant_beams: CompliantBeams
    platform: ElementPlatform
    part: Annotated[tuple[AttachedPart, ...], BeforeValidator(array_of_tables)] = ()
    frame: FrameOptions = FrameOptions()
    solid: SolidOptions = SolidOptions()
    stated: Annotated[tuple[StatedFrequencies, ...], BeforeValidator(array_of_tables)] = ()
    measured: ExistingFile | None = None
    fit: PlatformFitOptions | None = None
    mounting: ElementMounting | None = None

    @model_validator(mode="after")
    def _fits(self) -> ElementFile:
        sizes = [("platform", self.platform.half_size)]
        sizes += [("fit", size) for size in (self.fit.half_sizes if self.fit else ())]
        for key, size in sizes:
            if size >= 0.5 * self.beams.span:
                raise refusal(f"a half-size below half the span, {0.5 * self.beams.span:g} m", f"{size:g} m", key)
        side, gap = 2.0 * self.platform.half_size, 0.5 * self.beams.span - self.platform.half_size
        compliant = self.compliant_beams
        for key, size, limit, limited_by in (
            ("beams.width", self.beams.width, side, "the side of the platform"),
            ("compliant_beams.thickness", compliant.thickness, gap, "the gap next to the platform"),
            ("compliant_beams.thickness", compliant.thickness, compliant.length, "the length of the compliant beam"),
        ):
            if size > limit:
                raise refusal(f"at most {limited_by}, {limit:g} m", f"{size:g} m", key)
        for key, blocks in (("part", self.part), ("stated", self.stated)):
            twice = repeated_name([item.name for item in blocks])
            if twice is not None:
                raise refusal("different names", f'"{twice}" twice', key)
        return self


@dataclass(frozen=True)
class ElementDefinition:
    """An element as stated: the checked file, and its meaning for the models."""

    path: Path
    file: ElementFile

    @cached_property
    def beams(self) -> CrossBeams:
        """The cross with its compliant beams."""
        file = self.file
        material = MaterialData(file.material.youngs_modulus, file.material.poisson_ratio, file.material.density)
        height = file.compliant_beams.height
        return CrossBeams(
            material=material,
            span_m=file.beams.span,
            beam_width_m=file.beams.width,
            beam_height_m=file.beams.height,
            compliant_thickness_m=file.compliant_beams.thickness,
            compliant_length_m=file.compliant_beams.length,
            compliant_height_m=file.beams.height if height is None else height,
            shear_factor=file.beams.shear_factor,
        )

    @cached_property
    def bare(self) -> RigidPart:
        """The platform without attached parts."""
        stated = self.file.platform
        if stated.mass is not None and stated.inertia is not None:
            return RigidPart(stated.mass, stated.centre_of_mass, np.array(stated.inertia))
        if stated.thickness is None:
            raise ValueError("thickness: expected that of the block, found none")
        return block(self.file.material.density, stated.half_size, stated.thickness, stated.height)

    @cached_property
    def platform(self) -> RigidPart:
        """The platform with all attached parts."""
        return join_bodies([self.bare, *self._parts])

    @property
    def solid_block(self) -> SolidBlock | None:
        """The platform of the solid model, None without a stated thickness."""
        stated = self.file.platform
        if stated.thickness is None:
            return None
        has_block_mass = stated.mass is None
        rigid = self._parts if has_block_mass else (self.bare, *self._parts)
        return SolidBlock(
            half_size_m=stated.half_size,
            thickness_m=stated.thickness,
            height_m=stated.height,
            density_kgm3=self.file.material.density if has_block_mass else 0.0,
            attached=join_bodies(rigid) if rigid else None,
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """Every input file."""
        return (self.path, *([self.file.measured] if self.file.measured is not None else []))

    @property
    def _parts(self) -> tuple[RigidPart, ...]:
        """Rigid parts on the platform."""
        return tuple(RigidPart(part.mass, part.centre_of_mass, np.array(part.inertia)) for part in self.file.part)


def read_definition(path: Path, *, allow_outside: bool = False) -> ElementDefinition:
    """Read and check GEOMETRY.toml; `InputError` names file and key.

    Relative paths start at its folder. They must be in the folder above it, which also contains results of other
    commands.
    """
    text = read_toml(path)
    folder = path.parent.resolve()
    context = Context(PathScope(folder, folder.parent, allow_outside, "above this file"))
    return ElementDefinition(path, validate(ElementFile, text, path, context))
