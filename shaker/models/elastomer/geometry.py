"""What a cross-beam elastic element is made of: material, beams, compliant beams."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Material:
    """An isotropic elastic material: `youngs_modulus_pa` E, `poisson_ratio` ν, `density_kgm3`."""

    youngs_modulus_pa: float
    poisson_ratio: float
    density_kgm3: float

    def __post_init__(self) -> None:
        _check_positive(self, ("youngs_modulus_pa", "density_kgm3"))
        if not -1.0 < self.poisson_ratio < 0.5:
            raise ValueError(f"poisson_ratio: expected between -1 and 0.5, found {self.poisson_ratio}")

    @property
    def shear_modulus_pa(self) -> float:
        """G = E/(2(1 + ν)); the publication of the wrist sensor leaves out the 2."""
        return self.youngs_modulus_pa / (2.0 * (1.0 + self.poisson_ratio))


@dataclass(frozen=True)
class Section:
    """A rectangle: `width_m` along the local y axis (in the plane of the cross), `height_m` along z (across it)."""

    width_m: float
    height_m: float

    def __post_init__(self) -> None:
        _check_positive(self, ("width_m", "height_m"))

    @property
    def area_m2(self) -> float:
        """A = b·h."""
        return self.width_m * self.height_m

    @property
    def bending_in_plane_m4(self) -> float:
        """Second moment of area for bending in the plane of the cross, about z."""
        return self.height_m * self.width_m**3 / 12.0

    @property
    def bending_across_m4(self) -> float:
        """Second moment of area for bending across the plane of the cross, about y."""
        return self.width_m * self.height_m**3 / 12.0

    @property
    def torsion_m4(self) -> float:
        """Torsion constant a·b³·(1/3 - 0.21·b/a·(1 - b⁴/12a⁴)), a ≥ b: within 0.5 % of Saint-Venant's (Roark)."""
        a, b = max(self.width_m, self.height_m), min(self.width_m, self.height_m)
        return a * b**3 * (1.0 / 3.0 - 0.21 * b / a * (1.0 - b**4 / (12.0 * a**4)))


@dataclass(frozen=True)
class CrossBeams:
    """A cross of four beams, each joined at its outer end to the middle of a compliant beam clamped in two rims.

    x and y run along the cross beams, z across the plane. `span_m` l: between the axes of opposite compliant beams,
    through the platform. `beam_width_m` in the plane (h of Table 1), `beam_height_m` along z (b). Compliant beams:
    `compliant_thickness_m` along the cross beam (h2), `compliant_length_m` between the rims (l2),
    `compliant_height_m` along z. `shear_factor`: K of K·G·A, 5/6 of a rectangle.
    """

    material: Material
    span_m: float
    beam_width_m: float
    beam_height_m: float
    compliant_thickness_m: float
    compliant_length_m: float
    compliant_height_m: float
    shear_factor: float = 5.0 / 6.0

    def __post_init__(self) -> None:
        lengths = [field.name for field in fields(self) if field.name.endswith("_m")]
        _check_positive(self, (*lengths, "shear_factor"))

    @property
    def beam(self) -> Section:
        """Section of a cross beam."""
        return Section(self.beam_width_m, self.beam_height_m)

    @property
    def compliant(self) -> Section:
        """Section of a compliant beam."""
        return Section(self.compliant_thickness_m, self.compliant_height_m)

    def arm_m(self, half_size_m: float) -> float:
        """Return the free length of a cross beam, from the platform's face to the compliant beam's axis."""
        arm = 0.5 * self.span_m - half_size_m
        if half_size_m < 0.0 or arm <= 0.0:
            raise ValueError(f"half_size_m: expected from 0 to below half the span {self.span_m}, found {half_size_m}")
        return arm


def _check_positive(owner: object, names: tuple[str, ...]) -> None:
    """Raise unless the named numbers are above zero."""
    for name in names:
        if not getattr(owner, name) > 0.0:
            raise ValueError(f"{name}: expected a number above 0, found {getattr(owner, name)}")
