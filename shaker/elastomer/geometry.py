"""Cross-beam element: material and dimensions, beam matrices, stiffness by beam formulas."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from shakercal._common.arrays import FloatArray


@dataclass(frozen=True)
class ElasticMaterial:
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
        """G = E/(2(1 + ν)); the publication of the wrist sensor omits the 2."""
        return self.youngs_modulus_pa / (2.0 * (1.0 + self.poisson_ratio))


@dataclass(frozen=True)
class Section:
    """A rectangular section, `width_m` in the plane of the cross, `height_m` across it."""

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
        """Torsion constant of the rectangle after Roark, within 0.5 % of Saint-Venant's.

        a·b³·(1/3 - 0.21·b/a·(1 - b⁴/12a⁴)), a ≥ b.
        """
        a, b = max(self.width_m, self.height_m), min(self.width_m, self.height_m)
        return a * b**3 * (1.0 / 3.0 - 0.21 * b / a * (1.0 - b**4 / (12.0 * a**4)))


@dataclass(frozen=True)
class CrossBeams:
    """A cross of four beams, each joined at its outer end to a compliant beam.

    The compliant beam is clamped in two rims; the joint is at its middle. x and y are along the cross beams, z is
    across the plane. `span_m` l: between the axes of opposite compliant beams, through the platform. `beam_width_m` in
    the plane (h of Table 1), `beam_height_m` along z (b). Compliant beams: `compliant_thickness_m` along the cross beam
    (h2), `compliant_length_m` between the rims (l2), `compliant_height_m` along z. `shear_factor`: K of K·G·A, 5/6 for
    a rectangle.
    """

    material: ElasticMaterial
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
        """Return the free length of a cross beam outside the platform."""
        arm = 0.5 * self.span_m - half_size_m
        if half_size_m < 0.0 or arm <= 0.0:
            raise ValueError(f"half_size_m: expected from 0 to below half the span {self.span_m}, found {half_size_m}")
        return arm


def _check_positive(owner: object, names: tuple[str, ...]) -> None:
    for name in names:
        if not getattr(owner, name) > 0.0:
            raise ValueError(f"{name}: expected a number above 0, found {getattr(owner, name)}")


# Stiffness and mass of a straight Timoshenko beam in space, 12 × 12.

IN_PLANE, ACROSS = [1, 5, 7, 11], [2, 4, 8, 10]
"""Deflection and slope of both ends in the planes xy and xz; in xz a positive slope is a negative rotation."""
ALONG, TWIST = [0, 6], [3, 9]


def beam_matrices(
    material: ElasticMaterial, section: Section, length_m: float, shear_factor: float
) -> tuple[FloatArray, FloatArray]:
    """Return stiffness and consistent mass (12, 12) of a Timoshenko beam, x along the beam.

    Over (ux uy uz rx ry rz) of the two ends. Axial, torsion, two bending planes with shear and rotary inertia, Φ =
    12EI/(KGAL²); exact in statics. Przemieniecki 1968, sections 5.6 and 11.3 (cubic functions of a beam with shear).
    """
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))
    modulus, shear = material.youngs_modulus_pa, material.shear_modulus_pa
    area, density = section.area_m2, material.density_kgm3
    planes = ((section.bending_in_plane_m4, IN_PLANE, 1.0), (section.bending_across_m4, ACROSS, -1.0))
    polar = section.bending_in_plane_m4 + section.bending_across_m4
    for indices, elastic, inert in (
        (ALONG, modulus * area, density * area),
        (TWIST, shear * section.torsion_m4, density * polar),
    ):
        stiffness[np.ix_(indices, indices)] += elastic / length_m * np.array([[1.0, -1.0], [-1.0, 1.0]])
        mass[np.ix_(indices, indices)] += inert * length_m / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
    for second_moment, indices, sense in planes:
        phi = 12.0 * modulus * second_moment / (shear_factor * shear * area * length_m**2)
        turn, square = np.outer(*(np.array([1.0, sense, 1.0, sense]),) * 2), length_m**2
        bending = _symmetric(12.0, 6.0 * length_m, (4.0 + phi) * square, (2.0 - phi) * square) / (1.0 + phi)
        slope = (1.0 / 10.0 - phi / 2.0) * length_m
        rotary = (2.0 / 15.0 + phi / 6.0 + phi**2 / 3.0) * square, (-1.0 / 30.0 - phi / 6.0 + phi**2 / 6.0) * square
        rotation = _symmetric(1.2, slope, *rotary) / (1.0 + phi) ** 2
        inert_part = density * area * length_m * _translation(phi, length_m)
        inert_part += density * second_moment / length_m * rotation
        stiffness[np.ix_(indices, indices)] += turn * (modulus * second_moment / length_m**3 * bending)
        mass[np.ix_(indices, indices)] += turn * inert_part
    return stiffness, mass


def lump_mass(mass: FloatArray) -> FloatArray:
    """Return a diagonal mass (12, 12): half the beam's mass at each end."""
    total = float(mass[np.ix_(ALONG, ALONG)].sum())
    twist = float(mass[np.ix_(TWIST, TWIST)].sum())
    parts = np.array([total, total, total, twist, 0.0, 0.0]) / 2.0
    for index, plane in ((5, IN_PLANE), (4, ACROSS)):
        turn = mass[np.ix_(plane, plane)]
        parts[index] = float(turn[1, 1] + turn[3, 3]) / 2.0
    return np.diag(np.concatenate([parts, parts]))


def _symmetric(force: float, a: float, b: float, c: float) -> FloatArray:
    """Return a matrix (4, 4) over both ends, zero for a common deflection."""
    return np.array([[force, a, -force, a], [a, b, -a, c], [-force, -a, force, -a], [a, c, -a, b]])


def _translation(phi: float, length: float) -> FloatArray:
    """Return the mass (4, 4) of the deflection, divided by ρAL."""
    a = 13.0 / 35.0 + 7.0 * phi / 10.0 + phi**2 / 3.0
    b = (11.0 / 210.0 + 11.0 * phi / 120.0 + phi**2 / 24.0) * length
    c = 9.0 / 70.0 + 3.0 * phi / 10.0 + phi**2 / 6.0
    d = (13.0 / 420.0 + 3.0 * phi / 40.0 + phi**2 / 24.0) * length
    e = (1.0 / 105.0 + phi / 60.0 + phi**2 / 120.0) * length**2
    f = (1.0 / 140.0 + phi / 60.0 + phi**2 / 120.0) * length**2
    rows = [[a, b, c, -d], [b, e, d, -f], [c, d, a, -b], [-d, -f, -b, e]]
    return np.array(rows) / (1.0 + phi) ** 2


# Stiffness of the element by beam formulas: published and correct ones.


@dataclass(frozen=True)
class PublishedStatics:
    """Published beam formulas as printed, for comparison.

    Equations 5 to 11 of J. Sensors 2018, 6216979. They deviate from mechanics in four points. The shear modulus is
    twice too large. Compliant beams are cantilevers of half their length (eq. 6); by symmetry the slope at mid-span is
    zero, which makes them four times as stiff. Their shear is four times too large (eq. 6). The platform is a point.
    """

    beams: CrossBeams

    @property
    def shear_modulus_pa(self) -> float:
        """G = E/(1 + μ), as printed below equation 6."""
        material = self.beams.material
        return material.youngs_modulus_pa / (1.0 + material.poisson_ratio)

    @property
    def beam_compliance(self) -> float:
        """ω(l/2)/F_e = l³/48EI + l/4KGA in m/N, equation 5."""
        length, section = self.beams.span_m, self.beams.beam
        bending = self.beams.material.youngs_modulus_pa * section.bending_in_plane_m4
        shear = self.beams.shear_factor * self.shear_modulus_pa * section.area_m2
        return length**3 / (48.0 * bending) + length / (4.0 * shear)

    @property
    def force_ratio(self) -> float:
        """F_Q/F_c by bending alone; equation 10 gives 8, which Table 1 does not."""
        beams = self.beams
        ratio = beams.beam.bending_in_plane_m4 / beams.compliant.bending_in_plane_m4
        return ratio * beams.compliant_length_m**3 / beams.span_m**3

    @property
    def beam_share(self) -> float:
        """Share F_Q/F = r/(2r + 4) of that ratio; equation 10 gives 0.4."""
        return self.force_ratio / (2.0 * self.force_ratio + 4.0)

    def stiffness(self, beam_share: float = 0.4) -> float:
        """Return k = 1/(2F_Q/F·ω/F_e) in N/m, equation 11."""
        return 1.0 / (2.0 * beam_share * self.beam_compliance)


@dataclass(frozen=True)
class BeamStiffness:
    """Forces per displacement in N/m of a platform without rotation."""

    x: float
    z: float


def guided_stiffness(beams: CrossBeams) -> float:
    """Return k in N/m in the plane, of a point on hinged cross beams.

    1/(l³/48EI + l/4KGA) + 4/(l_c³/96EI_c + l_c/2KGA_c), compliant beams guided at mid-span: the published model with
    correct equation 6 and G.
    """
    modulus, shear = beams.material.youngs_modulus_pa, beams.shear_factor * beams.material.shear_modulus_pa
    length, beam = beams.span_m, beams.beam
    compliant, half = beams.compliant_length_m, beams.compliant
    across = length**3 / (48.0 * modulus * beam.bending_in_plane_m4) + length / (4.0 * shear * beam.area_m2)
    along = compliant**3 / (96.0 * modulus * half.bending_in_plane_m4) + compliant / (2.0 * shear * half.area_m2)
    return 1.0 / across + 4.0 / along


def beam_stiffness(beams: CrossBeams, half_size_m: float) -> BeamStiffness:
    """Return the stiffnesses of a rigid platform of half-size p without rotation, in closed form.

    Every arm of length l/2 - p is guided by the platform and supported at its outer end by the compliant beam: by its
    bending and elongation in the plane, by its bending and torsion across it. Two arms bend and two are pulled along x;
    all four bend along z. Shear is included by Timoshenko's theory.
    """
    material, arm = beams.material, beams.arm_m(half_size_m)
    modulus, half = material.youngs_modulus_pa, 0.5 * beams.compliant_length_m
    beam, compliant = beams.beam, beams.compliant
    bent = 2.0 * _end(beams, half, compliant.bending_in_plane_m4, compliant.area_m2)
    pulled = 2.0 * modulus * compliant.area_m2 / half
    sideways = _on_support(_end(beams, arm, beam.bending_in_plane_m4, beam.area_m2), pulled, bent[1, 1])
    along = 1.0 / (arm / (modulus * beam.area_m2) + 1.0 / bent[0, 0])
    raised = 2.0 * _end(beams, half, compliant.bending_across_m4, compliant.area_m2)
    twisted = 2.0 * material.shear_modulus_pa * compliant.torsion_m4 / half
    upward = _on_support(_end(beams, arm, beam.bending_across_m4, beam.area_m2), raised[0, 0], twisted)
    return BeamStiffness(float(2.0 * sideways + 2.0 * along), float(4.0 * upward))


def _end(beams: CrossBeams, length: float, bending_m4: float, area_m2: float) -> FloatArray:
    """Return the stiffness (2, 2) of a beam's free end."""
    bending = beams.material.youngs_modulus_pa * bending_m4
    shear = beams.shear_factor * beams.material.shear_modulus_pa * area_m2
    compliance = np.array([[length**2 / 3.0, length / 2.0], [length / 2.0, 1.0]]) * length / bending
    compliance[0, 0] += length / shear
    return np.asarray(np.linalg.inv(compliance))


def _on_support(end: FloatArray, spring: float, turn: float) -> float:
    """Return the force per displacement of an arm's guided end, its other end on springs."""
    outer = end + np.diag([spring, turn])
    pushed = np.array([-end[0, 0], -end[0, 1]])
    return float(end[0, 0] - pushed @ np.linalg.solve(outer, pushed))
