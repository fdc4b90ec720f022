"""Stiffness of the element by beam formulas: those of the publication by name, and what is right in their place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray
from shaker.models.elastomer.geometry import CrossBeams


@dataclass(frozen=True)
class PublishedStatics:
    """Equations 4 to 17 of J. Sensors 2018, 6216979, as printed, on a geometry.

    They are here to recompute what was published. They depart from mechanics in: the shear modulus (twice too large),
    compliant beams as cantilevers of half their length (eq. 6; symmetry keeps the slope at mid-span zero, which makes
    them four times as stiff), the shear of those (eq. 6; four times too large), and in the platform, which is a point.
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
        length, bending, shear = self.beams.span_m, self._bending, self._shear
        return length**3 / (48.0 * bending) + length / (4.0 * shear)

    def deflection(self, place_m: float) -> float:
        """Return ω(x)/F_e in m/N of a beam on two supports with its load at mid-span, equation 4."""
        length = self.beams.span_m
        if not 0.0 <= place_m <= length:
            raise ValueError(f"place_m: expected from 0 to {length}, found {place_m}")
        x = min(place_m, length - place_m)
        return (length**2 * x / 16.0 - x**3 / 12.0) / self._bending + x / (2.0 * self._shear)

    @property
    def compliant_compliance(self) -> float:
        """ΔX_c/F_c = l_c³/24EI_c + 2l_c/KGA_c in m/N, equation 6: a cantilever of length l_c/2."""
        beams, section = self.beams, self.beams.compliant
        bending = beams.material.youngs_modulus_pa * section.bending_in_plane_m4
        shear = beams.shear_factor * self.shear_modulus_pa * section.area_m2
        return beams.compliant_length_m**3 / (24.0 * bending) + 2.0 * beams.compliant_length_m / shear

    @property
    def force_ratio(self) -> float:
        """F_Q/F_c by bending alone; equation 10 gives 8, which Table 1 does not."""
        beams = self.beams
        ratio = beams.beam.bending_in_plane_m4 / beams.compliant.bending_in_plane_m4
        return ratio * beams.compliant_length_m**3 / beams.span_m**3

    @property
    def beam_share(self) -> float:
        """F_Q/F of that ratio r: F = 2F_Q + 4F_c, so r/(2r + 4); equation 10 gives 0.4."""
        return self.force_ratio / (2.0 * self.force_ratio + 4.0)

    def stiffness(self, beam_share: float = 0.4) -> float:
        """Return k = 1/(2F_Q/F·ω/F_e) in N/m, equation 11; with F_Q = 0.4F it is 1/(l³/60EI + l/5KGA)."""
        return 1.0 / (2.0 * beam_share * self.beam_compliance)

    @property
    def _bending(self) -> float:
        """E·I of the cross beam in its plane, equation 7."""
        return self.beams.material.youngs_modulus_pa * self.beams.beam.bending_in_plane_m4

    @property
    def _shear(self) -> float:
        """K·G·A of the cross beam with the printed G."""
        return self.beams.shear_factor * self.shear_modulus_pa * self.beams.beam.area_m2


@dataclass(frozen=True)
class BeamStiffness:
    """Forces per displacement of a platform that does not turn, in N/m: along x (and y), and along z."""

    x: float
    z: float


def guided_stiffness(beams: CrossBeams) -> float:
    """Return k in N/m in the plane of a point on hinged cross beams, compliant beams guided at mid-span.

    k = 1/(l³/48EI + l/4KGA) + 4/(l_c³/96EI_c + l_c/2KGA_c): the publication's model with equation 6 and G put right.
    """
    modulus, shear = beams.material.youngs_modulus_pa, beams.shear_factor * beams.material.shear_modulus_pa
    length, beam = beams.span_m, beams.beam
    compliant, half = beams.compliant_length_m, beams.compliant
    across = length**3 / (48.0 * modulus * beam.bending_in_plane_m4) + length / (4.0 * shear * beam.area_m2)
    along = compliant**3 / (96.0 * modulus * half.bending_in_plane_m4) + compliant / (2.0 * shear * half.area_m2)
    return 1.0 / across + 4.0 / along


def beam_stiffness(beams: CrossBeams, half_size_m: float) -> BeamStiffness:
    """Return the stiffnesses of a rigid platform of half-size p that is moved without turning, in closed form.

    Every arm of length l/2 - p is guided by the platform and rests at its outer end on the compliant beam: on its
    bending and elongation in the plane, on its bending and torsion across it. Two arms bend and two are pulled along
    x; all four bend along z. Shear by Timoshenko's theory throughout.
    """
    material, arm = beams.material, beams.arm_m(half_size_m)
    modulus, half = material.youngs_modulus_pa, 0.5 * beams.compliant_length_m
    beam, compliant = beams.beam, beams.compliant
    turned = 2.0 * _end(beams, half, compliant.bending_in_plane_m4, compliant.area_m2)
    pulled = 2.0 * modulus * compliant.area_m2 / half
    sideways = _on_support(_end(beams, arm, beam.bending_in_plane_m4, beam.area_m2), pulled, turned[1, 1])
    along = 1.0 / (arm / (modulus * beam.area_m2) + 1.0 / turned[0, 0])
    raised = 2.0 * _end(beams, half, compliant.bending_across_m4, compliant.area_m2)
    twisted = 2.0 * material.shear_modulus_pa * compliant.torsion_m4 / half
    upward = _on_support(_end(beams, arm, beam.bending_across_m4, beam.area_m2), raised[0, 0], twisted)
    return BeamStiffness(float(2.0 * sideways + 2.0 * along), float(4.0 * upward))


def oscillator_hz(stiffness: float, mass_kg: float) -> float:
    """Return f = √(k/m)/2π in Hz, equation 17 as a frequency."""
    if stiffness <= 0.0 or mass_kg <= 0.0:
        raise ValueError(f"stiffness, mass_kg: expected both above 0, found {stiffness} and {mass_kg}")
    return float(np.sqrt(stiffness / mass_kg) / (2.0 * np.pi))


def required_stiffness(frequency_hz: float, mass_kg: float) -> float:
    """Return the stiffness k = m(2πf)² in N/m that a frequency asks for."""
    return float(mass_kg * (2.0 * np.pi * frequency_hz) ** 2)


def _end(beams: CrossBeams, length: float, bending_m4: float, area_m2: float) -> FloatArray:
    """Stiffness (2, 2) of a beam's end against deflection and slope, its other end clamped."""
    bending = beams.material.youngs_modulus_pa * bending_m4
    shear = beams.shear_factor * beams.material.shear_modulus_pa * area_m2
    compliance = np.array([[length**2 / 3.0, length / 2.0], [length / 2.0, 1.0]]) * length / bending
    compliance[0, 0] += length / shear
    return np.asarray(np.linalg.inv(compliance))


def _on_support(end: FloatArray, spring: float, turn: float) -> float:
    """Force per displacement of an arm's guided end whose other end rests on a spring and a torsion spring."""
    outer = end + np.diag([spring, turn])
    pushed = np.array([-end[0, 0], -end[0, 1]])
    return float(end[0, 0] - pushed @ np.linalg.solve(outer, pushed))
