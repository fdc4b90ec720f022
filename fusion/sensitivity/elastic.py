"""Elastic load: natural modes of rods and plates on the sensor, and their effects.

The modes are those of the load with its foot clamped. If the foot moves by A, a mode of natural frequency f_i, damping
ratio ζ and participation L_i (6,) moves by φ_i·G·L_iᵀ·A, with G = r²/(1 - r² + 2jζr) and r = f/f_i. The foot carries
L_i·G·L_iᵀ·A in addition to the load's rigid inertia (Craig and Bampton 1968, AIAA Journal 6, 1313; modal mass 1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from fusion.estimation.uncertainty import Scope, Unknown, as_complex, real_stack
from fusion.recording.placement import perpendicular_axes
from shakercal._common.arrays import ComplexArray, FloatArray, IntArray

ONLY_NAMED = 1.0 / np.sqrt(3.0)
"""Standard uncertainty of an effect uniform between plus and minus the whole, over the whole."""


def response(frequency_hz: FloatArray, natural_hz: FloatArray, damping: FloatArray | float) -> ComplexArray:
    """Return the motion of modes over their foot's, G = r²/(1 - r² + 2jζr)."""
    r = frequency_hz[:, None] / natural_hz
    return np.asarray(r * r / (1.0 - r * r + 2j * damping * r))


# Modes with their participation, wherever they come from.


@dataclass(frozen=True)
class InstrumentPosition:
    """Position `point_m` (3,) on the load of a channel or stereo pair by its `name`."""

    name: str
    point_m: FloatArray


@dataclass(frozen=True)
class MeasuredModes:
    """Measured responses of M modes at the K lines of a recording.

    `pair`: stereo pair that measures the modes `which`. `response` (K, M): motion of the modes over that of their foot.
    `gain` (K, 2M, 2M): its weight in the mean with the stated one, of all real and all imaginary parts. `share` (M, 6):
    rigid motion of the sensor origin that a unit of each mode adds to the motion measured by the pair.
    """

    pair: str
    which: IntArray
    response: ComplexArray
    gain: FloatArray
    share: FloatArray

    def mean(self, stated: ComplexArray) -> ComplexArray:
        """Return responses (K, N) of all modes as they are stated and measured."""
        mean = stated.copy()
        off = self.response - stated[:, self.which]
        mean[:, self.which] += as_complex(np.einsum("kij,kj->ki", self.gain, real_stack(off)))
        return mean


@dataclass(frozen=True)
class NaturalModes:
    """N natural modes of a load with clamped foot, of modal mass 1 kg.

    `frequency_hz`, `damping` (N,). `participation` (N, 6): wrench at the sensor origin for a unit acceleration of each
    mode. `motion` of a position: (N, 6), its displacement and rotation. `measured`: measured responses of some modes at
    the lines of a recording; only these lines can then be evaluated.
    """

    frequency_hz: FloatArray
    damping: FloatArray
    participation: FloatArray
    motion: Callable[[InstrumentPosition], FloatArray]
    measured: tuple[MeasuredModes, ...] = ()

    def moved(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, N): motion of the modes in proportion to that of their foot."""
        moved = response(frequency_hz, self.frequency_hz, self.damping)
        for measured in self.measured:
            moved = measured.mean(moved)
        return moved

    def wrench(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return matrices (K, 6, 6) from the foot's acceleration to the elastic load."""
        moved = self.moved(frequency_hz)
        return np.asarray(np.einsum("kn,ni,nj->kij", moved, self.participation, self.participation))

    def stretch(self, frequency_hz: FloatArray, position: InstrumentPosition) -> ComplexArray:
        """Return matrices (K, 6, 6) of the motion of a position relative to the foot.

        They act on the acceleration of the foot. The motion is expressed as that of the sensor origin of a rigid body,
        so that the rows of an instrument apply to it.
        """
        motion = self.motion(position)
        about = np.concatenate([motion[:, :3] - np.cross(motion[:, 3:], position.point_m), motion[:, 3:]], axis=1)
        for measured in self.measured:
            if measured.pair == position.name:
                about[measured.which] = measured.share
        moved = self.moved(frequency_hz)
        return np.asarray(np.einsum("kn,ni,nj->kij", moved, about, self.participation))


def join_modes(families: Sequence[NaturalModes]) -> NaturalModes:
    """Return the modes of several families as one set."""
    return NaturalModes(
        np.concatenate([family.frequency_hz for family in families]),
        np.concatenate([family.damping for family in families]),
        np.concatenate([family.participation for family in families]),
        motion=lambda position: np.concatenate([family.motion(position) for family in families]),
    )


ModalQuantity = Callable[[NaturalModes], ComplexArray]


@dataclass(frozen=True)
class Variant:
    """An uncertain number of the modes, with the modes one standard uncertainty above and below."""

    name: str
    label: str
    u: float
    unit: str
    scope: Scope
    above: NaturalModes
    below: NaturalModes


@dataclass(frozen=True)
class ElasticPart:
    """An elastic part of a load: its `modes` and their uncertain numbers.

    Without `variants` the part is only named: the result is not corrected, and the whole correction is uncertain as one
    unknown. `mass_kg`: of the bending part, None if a table states only its modes.
    """

    name: str
    modes: NaturalModes
    variants: tuple[Variant, ...]
    mass_kg: float | None = None

    def act(self, quantity: ModalQuantity) -> ComplexArray:
        """Return the correction of a quantity, zero for a part only named."""
        whole = quantity(self.modes)
        return whole if self.variants else np.zeros_like(whole)

    def changes(self, quantity: ModalQuantity) -> tuple[Unknown[ComplexArray], ...]:
        """Return the changes of a quantity per standard uncertainty of each unknown.

        Rows of instruments and load are such quantities; equal names act on both.
        """
        if not self.variants:
            title, whole = f"elastic {self.name}", quantity(self.modes) * ONLY_NAMED
            named = f"{title} {self.modes.frequency_hz.min():.9g} Hz: only named"
            return (Unknown(named, title, 1.0, "1", whole, "mounting"),)
        return tuple(
            Unknown(v.name, v.label, v.u, v.unit, (quantity(v.above) - quantity(v.below)) / 2.0, v.scope)
            for v in self.variants
        )


# Modes of a clamped rod and of a plate clamped at its middle, by Ritz: Legendre polynomials that vanish at the clamp.


TERMS = 10
"""Polynomials per field: the first natural frequencies have eight digits, static deflections are exact."""
NODES, WEIGHTS = (np.asarray(values) for values in legendre.leggauss(3 * TERMS))
AT, SHARE = (NODES + 1.0) / 2.0, WEIGHTS / 2.0
PLATE_SHEAR = 5.0 / 6.0
"""Shear coefficient of plates (Reissner 1945, J. Appl. Mech. 12, A69)."""
Rows = Sequence[tuple[float | FloatArray, FloatArray]]


def polynomials(at: FloatArray) -> FloatArray:
    """Return s·P(2s - 1) (Q, TERMS) from s = 0, the clamp, to 1."""
    return np.asarray(at[:, None] * legendre.legvander(2.0 * at - 1.0, TERMS - 1))


VALUE = polynomials(AT)
SLOPE = VALUE / AT[:, None] + 2.0 * AT[:, None] * legendre.legval(NODES, legendre.legder(np.eye(TERMS))).T
"""The polynomials and their slopes at the nodes."""


def ritz(strains: Rows, masses: Rows) -> tuple[FloatArray, FloatArray]:
    """Return natural frequencies (N,) in Hz and coefficients (N, P) of modes.

    Their modal mass is 1. `strains`, `masses`: moduli and masses per unit of s, numbers or (Q,), with their rows (Q,
    P).
    """
    from scipy.linalg import eigh

    stiffness, mass = (
        np.sum([(rows.T * (SHARE * size)) @ rows for size, rows in terms], axis=0) for terms in (strains, masses)
    )
    square, vectors = eigh(stiffness, mass)
    return np.sqrt(square) / (2.0 * np.pi), np.asarray(vectors.T)


@dataclass(frozen=True)
class Rod:
    """A round rod or tube on its foot, by drawing.

    `axis` (3,): unit vector from the foot at `foot_m` to the free end. `tip_mass_kg`: a point mass on that end.
    """

    foot_m: FloatArray
    axis: FloatArray
    length_m: float
    diameter_m: float
    inner_diameter_m: float
    young_modulus_pa: float
    density_kgpm3: float
    poisson_ratio: float
    tip_mass_kg: float = 0.0

    @property
    def _section(self) -> tuple[float, float]:
        """Area and second moment of area."""
        outer, inner = self.diameter_m, self.inner_diameter_m
        return np.pi / 4.0 * (outer**2 - inner**2), np.pi / 64.0 * (outer**4 - inner**4)

    @property
    def mass_kg(self) -> float:
        """Mass of the rod with its tip mass."""
        return self.density_kgpm3 * self._section[0] * self.length_m + self.tip_mass_kg

    def families(self) -> dict[str, NaturalModes]:
        """Return modes along the axis (Love: lateral contraction has inertia), of bending (Timoshenko), of torsion."""
        (area, second), nu = self._section, self.poisson_ratio
        shear = self.young_modulus_pa / (2.0 * (1.0 + nu))
        hole = (self.inner_diameter_m / self.diameter_m) ** 2
        # Shear coefficient of tubes (Cowper 1966, J. Appl. Mech. 33, 335, table 1).
        tube = 6.0 * (1.0 + nu) * (1.0 + hole) ** 2
        shear_area = area * tube / ((7.0 + 6.0 * nu) * (1.0 + hole) ** 2 + (20.0 + 12.0 * nu) * hole)
        value, slope = VALUE, SLOPE / self.length_m
        none, along = np.zeros_like(value), self.length_m * self.young_modulus_pa
        inertia, twist = self.length_m * self.density_kgpm3, 2.0 * second
        # The mass at the end, distributed as its value at the end.
        end = np.repeat(polynomials(np.ones(1)), len(AT), axis=0)
        axial = ritz(
            [(along * area, slope)],
            [(inertia * area, value), (inertia * nu**2 * twist, slope), (self.tip_mass_kg, end)],
        )
        bending = ritz(
            [
                (along * second, np.hstack([none, slope])),
                (self.length_m * shear * shear_area, np.hstack([slope, -value])),
            ],
            [
                (inertia * area, np.hstack([value, none])),
                (inertia * second, np.hstack([none, value])),
                (self.tip_mass_kg, np.hstack([end, none])),
            ],
        )
        torsion_hz, torsion = ritz([(self.length_m * shear * twist, slope)], [(inertia * twist, value)])
        none = np.zeros((TERMS, TERMS))
        sides = perpendicular_axes(self.axis)
        return {
            "axial": self._modes(axial[0], np.hstack([axial[1], none]), self.axis, np.zeros(3)),
            "bending": join_modes([self._modes(*bending, side, np.cross(self.axis, side)) for side in sides]),
            "torsion": self._modes(torsion_hz, np.hstack([none, torsion]), np.zeros(3), self.axis),
        }

    def _modes(
        self, frequency_hz: FloatArray, coefficients: FloatArray, shift: FloatArray, turn: FloatArray
    ) -> NaturalModes:
        """Return modes of two fields: sections move along `shift` (3,) and turn about `turn` (3,)."""
        area, second = self._section
        # About a diameter the section has its second moment once, about the axis twice.
        second = second * (1.0 if np.any(shift) else 2.0)

        def fields(at: FloatArray) -> tuple[FloatArray, FloatArray]:
            value = polynomials(at).T
            return coefficients[:, :TERMS] @ value, coefficients[:, TERMS:] @ value

        def motion(position: InstrumentPosition) -> FloatArray:
            offset = position.point_m - self.foot_m
            at = float(np.clip(offset @ self.axis / self.length_m, 0.0, 1.0))
            displacement, rotation = fields(np.array([at]))
            off_axis = np.cross(turn, offset - at * self.length_m * self.axis)
            return np.hstack([displacement * shift + rotation * off_axis, rotation * turn])

        (displacement, rotation), tip = fields(AT), fields(np.ones(1))[0] * self.tip_mass_kg
        line = self.density_kgpm3 * self.length_m * SHARE
        arms = np.cross(self.foot_m + AT[:, None] * self.length_m * self.axis, shift)
        force = (displacement @ line)[:, None] * area + tip
        moment = displacement @ (line[:, None] * arms) * area
        moment += tip * np.cross(self.foot_m + self.length_m * self.axis, shift)
        moment += (rotation @ line)[:, None] * second * turn
        return NaturalModes(frequency_hz, np.zeros(len(frequency_hz)), np.hstack([force * shift, moment]), motion)


@dataclass(frozen=True)
class Plate:
    """A round plate clamped within `clamped_diameter_m` about its middle `foot_m` (3,), with a free rim.

    `axis`: its normal. It bends by Mindlin's theory and is rigid in its plane.
    """

    foot_m: FloatArray
    axis: FloatArray
    thickness_m: float
    diameter_m: float
    clamped_diameter_m: float
    young_modulus_pa: float
    density_kgpm3: float
    poisson_ratio: float

    @property
    def mass_kg(self) -> float:
        """Mass of the whole plate."""
        return float(self.density_kgpm3 * self.thickness_m * np.pi / 4.0 * self.diameter_m**2)

    @property
    def _rim(self) -> tuple[float, float]:
        """Radius of the clamp, and the logarithm of the rim's radius over it."""
        return self.clamped_diameter_m / 2.0, float(np.log(self.diameter_m / self.clamped_diameter_m))

    def families(self) -> dict[str, NaturalModes]:
        """Return modes without a nodal diameter, driven axially, and with one, driven by tilts.

        Fields over the radius: deflection W, slopes P along and Q across it; deflection W cos nφ, slopes P cos nφ and Q
        sin nφ.
        """
        (clamp, width), h, nu = self._rim, self.thickness_m, self.poisson_ratio
        stiffness = self.young_modulus_pa * h**3 / (12.0 * (1.0 - nu**2))
        shear = PLATE_SHEAR * self.young_modulus_pa * h / (2.0 * (1.0 + nu))
        radius = clamp * np.exp(AT * width)
        value, slope = VALUE, SLOPE / (radius * width)[:, None]
        over = value / radius[:, None]
        none = np.zeros_like(value)
        found: dict[int, NaturalModes] = {}
        for n in (0, 1):
            ring = radius**2 * width * np.pi * (2 - n)
            along, around = np.hstack([none, slope, none]), np.hstack([none, over, n * over])
            twist = np.hstack([none, -n * over, slope - over])
            strains = [
                (ring * stiffness * (1.0 + nu) / 2.0, along + around),
                (ring * stiffness * (1.0 - nu) / 2.0, along - around),
                (ring * stiffness * (1.0 - nu) / 2.0, twist),
                (ring * shear, np.hstack([slope, -value, none])),
                (ring * shear, np.hstack([-n * over, none, -value])),
            ]
            rows = np.hstack([value, none, none]), np.hstack([none, value, none]), np.hstack([none, none, value])
            sizes = (ring * self.density_kgpm3 * size for size in (h, h**3 / 12.0, h**3 / 12.0))
            masses = list(zip(sizes, rows, strict=True))
            # Without a nodal diameter Q, a turning about the axis, is no bending.
            lowest = slice(0, (2 + n) * TERMS)
            natural, coefficients = ritz(
                *([(size, row[:, lowest]) for size, row in terms] for terms in (strains, masses))
            )
            fields = np.zeros((len(natural), 3, TERMS))
            fields.reshape(len(natural), -1)[:, lowest] = coefficients
            found[n] = join_modes(
                [self._modes(natural, fields, n, side) for side in perpendicular_axes(self.axis)[: n + 1]]
            )
        return {"axial": found[0], "bending": found[1]}

    def _modes(self, frequency_hz: FloatArray, fields: FloatArray, n: int, side: FloatArray) -> NaturalModes:
        """Return modes by their `fields` (N, 3, TERMS).

        Modes of one nodal diameter are largest at a `side`.
        """
        (clamp, width), h = self._rim, self.thickness_m

        def motion(position: InstrumentPosition) -> FloatArray:
            offset = position.point_m - self.foot_m
            flat = offset - (offset @ self.axis) * self.axis
            distance = float(np.linalg.norm(flat))
            out = flat / distance if distance > 0.0 else side
            radius = float(np.clip(distance, clamp, clamp * np.exp(width)))
            around = np.cross(self.axis, out)
            # cos nφ and sin nφ of the angle from `side`, which is 0 on the axis.
            cosine, sine = (float(out @ side), float(-around @ side)) if n else (1.0, 0.0)
            deflection, along, across_it = (fields @ polynomials(np.log([radius / clamp]) / width)[0]).T[:, :, None]
            rotation = np.cross(along * cosine * out + across_it * sine * around, self.axis)
            shift = deflection * cosine * self.axis + np.cross(rotation, offset - radius * out)
            return np.hstack([shift, rotation])

        deflection, along, across_it = (fields @ VALUE.T).swapaxes(0, 1)
        radius = clamp * np.exp(AT * width)
        ring = self.density_kgpm3 * h * np.pi * (2 - n) * width * radius**2 * SHARE
        if n == 0:
            force = (deflection @ ring)[:, None] * self.axis
            participation = np.hstack([force, np.cross(self.foot_m, force)])
        else:
            tilt = deflection @ (ring * radius) + h**2 / 12.0 * (along - across_it) @ ring
            participation = np.hstack([np.zeros((len(tilt), 3)), tilt[:, None] * np.cross(side, self.axis)])
        return NaturalModes(frequency_hz, np.zeros(len(frequency_hz)), participation, motion)
