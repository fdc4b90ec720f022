"""A load that is not rigid: natural modes of what stands on the sensor, by drawing, table or tap test; its joint.

Modes are those of the load with its foot held. Where the foot moves by A, a mode of natural frequency f_i, damping
ratio ζ and participation L_i (6,) moves by φ_i·G·L_iᵀ·A with G = r²/(1 - r² + 2jζr), r = f/f_i, and the foot carries
L_i·G·L_iᵀ·A beside the load's rigid inertia (Craig and Bampton 1968, AIAA Journal 6, 1313; modal mass 1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike
from scipy.linalg import eigh

from fusion.base import ComputeError
from fusion.estimation.least_squares import SCALE, build_system, hidden_motion
from fusion.estimation.measurement_model import CommonError, Deviates, Geometry, Observation
from fusion.estimation.uncertainty import Scope, Unknown
from fusion.instruments.channel import ChannelGeometry
from fusion.instruments.stereo import StereoReading
from fusion.instruments.transducer import across, placed_at, placement_name
from photogram.geometry import skew
from shaker.arrays import BoolArray, ComplexArray, FloatArray
from shaker.labels import MOTION_COMPONENTS

if TYPE_CHECKING:
    from fusion.recording.rig import Elastic, ElasticMode

ONLY_NAMED = 1.0 / np.sqrt(3.0)
"""Standard uncertainty of an effect between nothing and the whole, or its opposite, over the whole."""


def response(frequency_hz: FloatArray, natural_hz: FloatArray, damping: FloatArray | float) -> ComplexArray:
    """Return (K, N): motion of modes in proportion to that of their foot, G = r²/(1 - r² + 2jζr)."""
    r = frequency_hz[:, None] / natural_hz
    return np.asarray(r * r / (1.0 - r * r + 2j * damping * r))


# The elastic joint: the load itself stays rigid, so all its places move alike, and the fused motion is the load's own.


@dataclass(frozen=True)
class Joint:
    """The joint on which a load sits, with the instruments on the load.

    `frequency_hz` (6,): at which the load would resonate on the joint if the lower side stood still, component by
    component; `u_frequency_hz` (6,): its standard uncertainty, 0 where the joint is only named: then nothing is
    corrected, and what a correction would change is uncertain as a whole; `damping`: damping ratio of that resonance.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    damping: float

    def follow(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, 6): motion of the lower side over that of the load, 1/(1 + G) = 1 - r²/(1 + 2jζr).

        The joint carries the load's inertia, -ω²·m·x_load = (k + jωb)·(x_below - x_load).
        """
        stated = self.u_frequency_hz > 0.0
        return np.asarray(np.where(stated, 1.0 - self._stretch(frequency_hz), 1.0))

    def change(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, 6): change of `follow` for one standard uncertainty of the joint.

        Where it is corrected the derivative by f_e times its uncertainty; where it is only named the root mean square,
        1/√3 of the whole, of an error anywhere between nothing and a joint as elastic as that.
        """
        r = frequency_hz[:, None] / self.frequency_hz
        damped = 1.0 + 2j * self.damping * r
        slope = r * r * (1.0 + damped) / damped**2 / self.frequency_hz
        stated = self.u_frequency_hz > 0.0
        named = -self._stretch(frequency_hz) * ONLY_NAMED
        return np.asarray(np.where(stated, slope * self.u_frequency_hz, named))

    def _stretch(self, frequency_hz: FloatArray) -> ComplexArray:
        """Share (K, 6) of the load's motion that the joint takes up: G/(1 + G), finite at the resonance too."""
        r = frequency_hz[:, None] / self.frequency_hz
        return np.asarray(r * r / (1.0 + 2j * self.damping * r))


def make_joint(frequency_hz: ArrayLike, u_frequency_hz: ArrayLike = 0.0, damping: float = 0.0) -> Joint:
    """Return a joint; one number stands for all six components."""
    frequency = np.broadcast_to(np.asarray(frequency_hz, dtype=np.float64), (6,)).copy()
    u_frequency = np.broadcast_to(np.asarray(u_frequency_hz, dtype=np.float64), (6,)).copy()
    return Joint(frequency, u_frequency, float(damping))


# Modes with their participation, wherever they come from.


@dataclass(frozen=True)
class Place:
    """Where an instrument sits on the load: `name` of its channel or stereo pair, `point_m` (3,)."""

    name: str
    point_m: FloatArray


@dataclass(frozen=True)
class Modes:
    """N natural modes of a load whose foot is held, for a modal mass of 1 kg.

    `frequency_hz`, `damping` (N,); `participation` (N, 6): what the foot feels of a unit acceleration of each mode, as
    a wrench at the sensor origin; `motion` of a place: (N, 6) its displacement and its rotation.
    """

    frequency_hz: FloatArray
    damping: FloatArray
    participation: FloatArray
    motion: Callable[[Place], FloatArray]

    def wrench(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, 6, 6): load beside that of the rigid body = matrix · acceleration of the foot."""
        moved = response(frequency_hz, self.frequency_hz, self.damping)
        return np.asarray(np.einsum("kn,ni,nj->kij", moved, self.participation, self.participation))

    def stretch(self, frequency_hz: FloatArray, place: Place) -> ComplexArray:
        """Return (K, 6, 6): what a place moves beside its foot = matrix · acceleration of the foot.

        As that motion of the sensor origin which a rigid body would have: an instrument's rows act on it as they do on
        the foot's.
        """
        own = self.motion(place)
        about = np.concatenate([own[:, :3] - np.cross(own[:, 3:], place.point_m), own[:, 3:]], axis=1)
        moved = response(frequency_hz, self.frequency_hz, self.damping)
        return np.asarray(np.einsum("kn,ni,nj->kij", moved, about, self.participation))


def joined(families: Sequence[Modes]) -> Modes:
    """Return the modes of several families as one set."""
    return Modes(
        np.concatenate([family.frequency_hz for family in families]),
        np.concatenate([family.damping for family in families]),
        np.concatenate([family.participation for family in families]),
        motion=lambda place: np.concatenate([family.motion(place) for family in families]),
    )


Quantity = Callable[[Modes], ComplexArray]


@dataclass(frozen=True)
class Variant:
    """An uncertain number behind the modes: its name and label, and the modes one standard uncertainty to each side."""

    name: str
    label: str
    u: float
    unit: str
    scope: Scope
    above: Modes
    below: Modes


@dataclass(frozen=True)
class ElasticPart:
    """What is elastic of a load: its `modes`, and what is uncertain of them.

    Without `variants` it is only named: nothing is corrected, and the whole of what a correction would change is
    uncertain, as one unknown. `mass_kg` of what bends, None where a table tells only its modes.
    """

    name: str
    modes: Modes
    variants: tuple[Variant, ...]
    mass_kg: float | None = None

    def act(self, quantity: Quantity) -> ComplexArray:
        """Return what the modes do to some quantity, in so far as it is corrected for them."""
        whole = quantity(self.modes)
        return whole if self.variants else np.zeros_like(whole)

    def changes(self, quantity: Quantity) -> tuple[Unknown[ComplexArray], ...]:
        """Return what one standard uncertainty of each unknown changes of some quantity.

        Rows of instruments and load are such quantities: the same names act on both.
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
    """Return s·P(2s - 1) (Q, TERMS) at places s from 0, the clamp, to 1, the end."""
    return np.asarray(at[:, None] * legendre.legvander(2.0 * at - 1.0, TERMS - 1))


VALUE = polynomials(AT)
SLOPE = VALUE / AT[:, None] + 2.0 * AT[:, None] * legendre.legval(NODES, legendre.legder(np.eye(TERMS))).T
"""The polynomials and their slopes at the nodes."""


def ritz(strains: Rows, masses: Rows) -> tuple[FloatArray, FloatArray]:
    """Return natural frequencies (N,) in Hz and coefficients (N, P) of modes whose modal mass is 1.

    `strains`, `masses`: moduli and masses per unit of s, numbers or (Q,), with the rows (Q, P) that they belong to.
    """
    stiffness, mass = (
        np.sum([(rows.T * (SHARE * size)) @ rows for size, rows in terms], axis=0) for terms in (strains, masses)
    )
    square, vectors = eigh(stiffness, mass)
    return np.sqrt(square) / (2.0 * np.pi), np.asarray(vectors.T)


@dataclass(frozen=True)
class Rod:
    """A round rod or tube on its foot, by drawing; `axis` (3,), of length 1, from the foot at `foot_m` to the free end.

    `tip_mass_kg`: a point mass on that end.
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
        """Mass of the rod with what stands on its end."""
        return self.density_kgpm3 * self._section[0] * self.length_m + self.tip_mass_kg

    def families(self) -> dict[str, Modes]:
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
        # The mass at the end, as if it were everywhere what it is there.
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
        sides = across(self.axis)
        return {
            "axial": self._modes(axial[0], np.hstack([axial[1], none]), self.axis, np.zeros(3)),
            "bending": joined([self._modes(*bending, side, np.cross(self.axis, side)) for side in sides]),
            "torsion": self._modes(torsion_hz, np.hstack([none, torsion]), np.zeros(3), self.axis),
        }

    def _modes(self, frequency_hz: FloatArray, coefficients: FloatArray, shift: FloatArray, turn: FloatArray) -> Modes:
        """Return modes of which one field moves sections along `shift` (3,) and one turns them about `turn` (3,)."""
        area, second = self._section
        # About a diameter the section has its second moment once, about the axis twice.
        second = second * (1.0 if np.any(shift) else 2.0)

        def fields(at: FloatArray) -> tuple[FloatArray, FloatArray]:
            value = polynomials(at).T
            return coefficients[:, :TERMS] @ value, coefficients[:, TERMS:] @ value

        def motion(place: Place) -> FloatArray:
            offset = place.point_m - self.foot_m
            at = float(np.clip(offset @ self.axis / self.length_m, 0.0, 1.0))
            displacement, rotation = fields(np.array([at]))
            beside = np.cross(turn, offset - at * self.length_m * self.axis)
            return np.hstack([displacement * shift + rotation * beside, rotation * turn])

        (displacement, rotation), tip = fields(AT), fields(np.ones(1))[0] * self.tip_mass_kg
        line = self.density_kgpm3 * self.length_m * SHARE
        arms = np.cross(self.foot_m + AT[:, None] * self.length_m * self.axis, shift)
        force = (displacement @ line)[:, None] * area + tip
        moment = displacement @ (line[:, None] * arms) * area
        moment += tip * np.cross(self.foot_m + self.length_m * self.axis, shift)
        moment += (rotation @ line)[:, None] * second * turn
        return Modes(frequency_hz, np.zeros(len(frequency_hz)), np.hstack([force * shift, moment]), motion)


@dataclass(frozen=True)
class Plate:
    """A round plate, held within `clamped_diameter_m` about its middle `foot_m` (3,), free at its rim; `axis` normal.

    It bends by Mindlin's theory; in its plane it is rigid.
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
        """Radius of the clamp, and the logarithm of that of the rim over it, by which s counts radii."""
        return self.clamped_diameter_m / 2.0, float(np.log(self.diameter_m / self.clamped_diameter_m))

    def families(self) -> dict[str, Modes]:
        """Return modes without a nodal diameter, which an axial motion drives, and with one, which tilts drive.

        Fields over the radius: deflection W, slopes P along and Q across it; deflection W cos nφ, slopes P cos nφ and
        Q sin nφ.
        """
        (clamp, width), h, nu = self._rim, self.thickness_m, self.poisson_ratio
        stiffness = self.young_modulus_pa * h**3 / (12.0 * (1.0 - nu**2))
        shear = PLATE_SHEAR * self.young_modulus_pa * h / (2.0 * (1.0 + nu))
        radius = clamp * np.exp(AT * width)
        value, slope = VALUE, SLOPE / (radius * width)[:, None]
        over = value / radius[:, None]
        none = np.zeros_like(value)
        found: dict[int, Modes] = {}
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
            kept = slice(0, (2 + n) * TERMS)
            natural, coefficients = ritz(
                *([(size, row[:, kept]) for size, row in terms] for terms in (strains, masses))
            )
            fields = np.zeros((len(natural), 3, TERMS))
            fields.reshape(len(natural), -1)[:, kept] = coefficients
            found[n] = joined([self._modes(natural, fields, n, side) for side in across(self.axis)[: n + 1]])
        return {"axial": found[0], "bending": found[1]}

    def _modes(self, frequency_hz: FloatArray, fields: FloatArray, n: int, side: FloatArray) -> Modes:
        """Return modes by their `fields` (N, 3, TERMS); those of one nodal diameter are largest at a `side`."""
        (clamp, width), h = self._rim, self.thickness_m

        def motion(place: Place) -> FloatArray:
            offset = place.point_m - self.foot_m
            flat = offset - (offset @ self.axis) * self.axis
            distance = float(np.linalg.norm(flat))
            out = flat / distance if distance > 0.0 else side
            radius = float(np.clip(distance, clamp, clamp * np.exp(width)))
            around = np.cross(self.axis, out)
            # cos nφ and sin nφ of the angle from `side`, which is 0 on the axis.
            cosine, sine = (float(out @ side), float(-around @ side)) if n else (1.0, 0.0)
            deflection, along, across_it = (fields @ polynomials(np.log([radius / clamp]) / width)[0]).T[:, :, None]
            turned = np.cross(along * cosine * out + across_it * sine * around, self.axis)
            shift = deflection * cosine * self.axis + np.cross(turned, offset - radius * out)
            return np.hstack([shift, turned])

        deflection, along, across_it = (fields @ VALUE.T).swapaxes(0, 1)
        radius = clamp * np.exp(AT * width)
        ring = self.density_kgpm3 * h * np.pi * (2 - n) * width * radius**2 * SHARE
        if n == 0:
            force = (deflection @ ring)[:, None] * self.axis
            participation = np.hstack([force, np.cross(self.foot_m, force)])
        else:
            tilt = deflection @ (ring * radius) + h**2 / 12.0 * (along - across_it) @ ring
            participation = np.hstack([np.zeros((len(tilt), 3)), tilt[:, None] * np.cross(side, self.axis)])
        return Modes(frequency_hz, np.zeros(len(frequency_hz)), participation, motion)


# What rig.toml states of an elastic load as modes with their unknowns.


UNCERTAIN: Mapping[str, tuple[str, Scope]] = {
    "young_modulus": ("Pa", "rig"),
    "density": ("kg/m^3", "rig"),
    "poisson_ratio": ("1", "rig"),
    "length": ("m", "rig"),
    "diameter": ("m", "rig"),
    "inner_diameter": ("m", "rig"),
    "thickness": ("m", "rig"),
    "clamped_diameter": ("m", "rig"),
    "tip_mass": ("kg", "rig"),
    "axial_frequency": ("Hz", "mounting"),
    "bending_frequency": ("Hz", "mounting"),
    "damping": ("1", "mounting"),
    "frequencies": ("1", "rig"),
    "participation": ("1", "rig"),
}
"""Keys of `[[load.elastic]]` that have an uncertainty, with the unit of that and how long they keep their value."""
FACTORS = ("frequencies", "participation")
"""Of all modes together: 1, with a relative uncertainty."""


def elastic_part(table: Elastic) -> ElasticPart:
    """Return the modes that a block `[[load.elastic]]` states, and what each of its uncertain numbers does to them."""
    title, variants = f"elastic {table.name}", []

    def add(what: str, stated: float, u: float, unit: str, scope: Scope, changed: Callable[[float], Modes]) -> None:
        if u > 0.0:
            name, label = f"{title}: {what} {stated:.9g}", f"{title}: {what}"
            variants.append(Variant(name, label, u, unit, scope, changed(stated + u), changed(stated - u)))

    for key, (unit, scope) in UNCERTAIN.items():
        stated, u = 1.0 if key in FACTORS else getattr(table, key), getattr(table, f"{key}_uncertainty")

        def other(value: float, key: str = key) -> Modes:
            return _modes(table, {key: value})

        if stated is not None:
            add(key.replace("_", " "), stated, u, unit, scope, other)
    for place, mode in enumerate(table.mode):

        def shifted(frequency: float, place: int = place, mode: ElasticMode = mode) -> Modes:
            moved = mode.model_copy(update={"frequency": frequency})
            return _modes(table, {"mode": (*table.mode[:place], moved, *table.mode[place + 1 :])})

        add("frequency", mode.frequency, mode.frequency_uncertainty, "Hz", "rig", shifted)
    mass = None if table.shape == "modes" else _drawn(table).mass_kg
    return ElasticPart(table.name, _modes(table, {}), tuple(variants), mass)


def _drawn(table: Elastic) -> Rod | Plate:
    """Return the rod or plate of a block."""
    foot, axis = np.array(table.foot), np.array(table.axis or (0.0, 0.0, 1.0))
    material = table.young_modulus or 0.0, table.density or 0.0, table.poisson_ratio
    across_it = table.diameter or 0.0
    if table.shape == "rod":
        return Rod(foot, axis, table.length or 0.0, across_it, table.inner_diameter, *material, table.tip_mass)
    return Plate(foot, axis, table.thickness or 0.0, across_it, table.clamped_diameter or 0.0, *material)


def _modes(table: Elastic, change: Mapping[str, Any]) -> Modes:
    """Return the modes of a block of which some values are others."""
    table = table.model_copy(update={key: value for key, value in change.items() if key not in FACTORS})
    if table.shape == "modes":
        modes = _tabled(table)
    else:
        families = _drawn(table).families()
        for kind, tapped in (("axial", table.axial_frequency), ("bending", table.bending_frequency)):
            if tapped is not None:
                natural = families[kind].frequency_hz
                families[kind] = replace(families[kind], frequency_hz=natural * (tapped / natural.min()))
        modes = joined(list(families.values()))
        modes = replace(modes, damping=np.full(len(modes.damping), table.damping))
    return replace(
        modes,
        frequency_hz=modes.frequency_hz * change.get("frequencies", 1.0),
        participation=modes.participation * change.get("participation", 1.0),
    )


def _tabled(table: Elastic) -> Modes:
    """Return the modes that a finite element program told, brought to a modal mass of 1."""
    root = np.sqrt([mode.modal_mass for mode in table.mode])

    def motion(place: Place) -> FloatArray:
        # A channel of a later set-up is named by that, too.
        names = [name for name in (place.name, place.name.rpartition(": ")[2]) if name in table.mode[0].displacement]
        if not names:
            told = f"the load is elastic ({table.name}), but load.elastic.mode.displacement does not tell how"
            raise ComputeError(f"{told} {place.name} moves; add its place to every mode")
        rows = [mode.displacement[names[0]] for mode in table.mode]
        return np.array([[*row, *[0.0] * (6 - len(row))] for row in rows]) / root[:, None]

    return Modes(
        np.array([mode.frequency for mode in table.mode]),
        np.array([table.damping if mode.damping is None else mode.damping for mode in table.mode]),
        np.array([mode.participation for mode in table.mode]) / root[:, None],
        motion,
    )


# Instruments on an elastic load: rows that tell the motion of its foot.


@dataclass(frozen=True)
class ElasticGeometry(Geometry):
    """An instrument on an elastic load, for the Monte Carlo run: `inner`, as it is on a rigid one with rows `rigid`.

    `stretch` (K, M, 6, 6): what its places move beside the foot; `moved_places`: for uncertain places the names of the
    unknowns of the M channels and the change of `stretch` for one standard uncertainty of each; `bent`: names of the
    errors that motion nobody observes makes, which the rows see themselves when such motion is drawn.
    """

    inner: Geometry
    rigid: ComplexArray
    stretch: ComplexArray
    moved_places: tuple[tuple[tuple[str, ...], ComplexArray], ...]
    bent: frozenset[str]

    @property
    def unknowns(self) -> frozenset[str]:
        """Return the names of the unknowns that `rows` and `moved` draw."""
        return self.inner.unknowns | self.bent

    def rows(self, design: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return the rows (N, K, M, 6) at places and along directions as drawn, on the load as it is stretched."""
        rigid = self.inner.rows(self.rigid, deviates)
        total = np.repeat(self.stretch[None], deviates.count, axis=0)
        for names, change in self.moved_places:
            size = np.stack([deviates.normal(name) for name in names], axis=1)
            total += size[:, None, :, None, None] * change
        return np.asarray(rigid + np.einsum("nkmj,nkmji->nkmi", rigid, total))

    def moved(self, readings: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return readings as instruments in N other places give them."""
        return self.inner.moved(readings, deviates)


def elastic_rows(observations: Sequence[Observation], parts: Sequence[ElasticPart]) -> tuple[Observation, ...]:
    """Return instruments on the load with rows that act on the motion of its foot: design · (I + stretch).

    What is uncertain of the modes is a common error of theirs, by the name under which it acts on the load. What
    components that nobody observes do through the modes is not in the rows, where it would take the observed ones with
    it: it is an error of the readings of the size that is assumed of such components.
    """
    own = [observation for observation in observations if observation.body == "load"]
    if not parts or not own:
        return tuple(observations)
    system = build_system(own)
    start = system.acceleration(np.asarray(np.linalg.lstsq(system.design, system.readings, rcond=None)[0]))
    # What is assumed of an unseen component (K, 6), as a multiple of the component that moves most (K, 6).
    size = np.where(system.observed, np.abs(start / SCALE), -1.0)
    most = np.arange(6) == np.argmax(size, axis=1)[:, None]
    unseen = (
        hidden_motion(start, system.observed)[:, :, None]
        * np.divide(most, np.abs(start) * np.sqrt(2.0), out=np.zeros(start.shape), where=most & (start != 0.0))[
            :, None, :
        ]
    )
    return tuple(_stretched(o, parts, system.observed, unseen) if o.body == "load" else o for o in observations)


def _stretched(
    observation: Observation, parts: Sequence[ElasticPart], seen: BoolArray, unseen: FloatArray
) -> Observation:
    """Return one instrument on the elastic load.

    `seen` (K, 6): components that any instrument observes; `unseen` (K, 6, 6): what is assumed of either part of the
    others = matrix · acceleration.
    """
    frequency, rigid, inner = observation.phasors.frequency_hz, observation.design, observation.geometry
    places = _places(observation)
    whole = _stretch(parts, frequency, places, rigid.shape[1])
    stretch = np.where(seen[:, None, None, :], whole, 0.0)
    slopes = {error.name: error.slope + _rows(error.slope, stretch) for error in observation.common}
    moved_places = tuple(_moved_places(parts, frequency, inner, places))
    for names, change in moved_places:
        for place, name in enumerate(names):
            if name in slopes:
                slopes[name][:, place] += np.where(seen, _rows(rigid, change)[:, place], 0.0)
    none = np.zeros(rigid.shape[:2], np.complex128)
    common = [replace(error, slope=slopes[error.name]) for error in observation.common]
    for part in parts:
        for c in part.changes(lambda modes: _stretched_places(modes, frequency, places, rigid.shape[1])):
            # Where a number is stated too high, the readings are those of rows with less of it.
            slope = -np.where(seen[:, None, :], _rows(rigid, c.effect), 0.0)
            common.append(CommonError(c.name, c.label, c.u, c.unit, c.scope, slope, none))
    bent = set()
    for place in np.flatnonzero(~np.all(seen, axis=0)).tolist():
        slope = _rows(rigid, whole - stretch)[:, :, place, None] * unseen[:, None, place]
        label = f"unobserved {MOTION_COMPONENTS[place]} that bends the load"
        for turn, kind in ((1.0, "in phase"), (1j, "in quadrature")):
            common.append(CommonError(f"{label}: {kind}", label, 1.0, "1", "recording", turn * slope, none))
            bent.add(f"{label}: {kind}")
    geometry = ElasticGeometry(inner, rigid, whole, moved_places, frozenset(bent))
    return replace(observation, design=rigid + _rows(rigid, stretch), common=tuple(common), geometry=geometry)


def _rows(design: ComplexArray, stretch: ComplexArray) -> ComplexArray:
    """Rows (K, M, 6) of what is stretched beside the foot."""
    return np.asarray(np.einsum("kmj,kmji->kmi", design, stretch))


def _stretched_places(modes: Modes, frequency_hz: FloatArray, places: Sequence[Place], rows: int) -> ComplexArray:
    """Return what M rows are stretched (K, M, 6, 6), all at one place or each at its own."""
    each = np.stack([modes.stretch(frequency_hz, place) for place in places], axis=1)
    return np.repeat(each, rows // len(places), axis=1)


def _stretch(
    parts: Sequence[ElasticPart], frequency_hz: FloatArray, places: Sequence[Place], rows: int
) -> ComplexArray:
    """Return what M rows are stretched (K, M, 6, 6) by all parts, as far as that is corrected."""
    return np.asarray(
        sum(part.act(lambda modes: _stretched_places(modes, frequency_hz, places, rows)) for part in parts)
    )


def _moved_places(
    parts: Sequence[ElasticPart], frequency_hz: FloatArray, inner: Geometry, places: Sequence[Place]
) -> Iterator[tuple[tuple[str, ...], ComplexArray]]:
    """Yield the names of the unknowns of M uncertain places, axis by axis, and what they change of the stretch."""
    if not isinstance(inner, ChannelGeometry) or inner.transducer.turning:
        return
    for unit, letter in zip(np.eye(3), "xyz", strict=True):
        shifts = [unit * np.broadcast_to(entry.point_uncertainty, 3) for entry in inner.entries]
        if np.any(shifts):
            ahead, behind = (
                [
                    replace(place, point_m=place.point_m + sign * shift)
                    for place, shift in zip(places, shifts, strict=True)
                ]
                for sign in (1.0, -1.0)
            )
            both = (_stretch(parts, frequency_hz, side, len(places)) for side in (ahead, behind))
            change = np.subtract(*both) / 2.0
            yield tuple(placement_name(entry, "point", letter) for entry in inner.entries), np.asarray(change)


def _places(observation: Observation) -> list[Place]:
    """Return where an instrument sees the load: each of its channels, or a stereo pair the middle of its points."""
    seen, elastic = observation.geometry, "the load is elastic"
    if isinstance(seen, ChannelGeometry):
        missing = [entry.name for entry in seen.entries if entry.point is None]
        if missing:
            raise ComputeError(f"{elastic}, but channel {missing[0]} has no point; state where it sits on the load")
        return [Place(entry.name, placed_at(entry)) for entry in seen.entries]
    if isinstance(seen, StereoReading) and seen.face_m is not None:
        return [Place(seen.name, seen.face_m)]
    raise ComputeError(f"{elastic}, but where {observation.title} sees it is not known")


# What mass and size alone say of a load of which nothing elastic is stated.


SPEED_OF_SOUND_MPS = 5000.0
"""Along rods of steel, aluminium and titanium, within 3 %."""
SOLID_KGPM3 = 7800.0
SHEAR_SPEED = 0.56
"""Speed of shear waves, in effect of a section that warps, over that along rods."""
BENDING_ROOT = 1.8751040687
"""First root of cos x cosh x = -1, the cantilever's."""
TRIPLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
FREE_END = np.pi**2 / 24.0
"""Force over mass times acceleration of the free end of a uniform rod falls by this times (f/f_1)²: (kL)²/6."""


def likely_frequencies(mass_matrix: FloatArray) -> FloatArray:
    """Return (6,): first natural frequencies, Hz, that a metal body of some mass matrix (6, 6) likely has on its foot.

    The foot is taken at the sensor origin; the body reaches along each axis as far as centre of mass and moments of
    inertia tell: |c| + √3·k, k² = ∫x² dm/m, exact for rods. Along the axes: f = c/(4·reach); bending of the reach j by
    motion along i: f = 1.875²/(2π)·c·k_i/reach_j², and its shear, by Dunkerley's sum of 1/f².
    """
    mass = mass_matrix[0, 0]
    lever = mass_matrix[3:, :3] / mass
    centre = np.array([lever[2, 1], lever[0, 2], lever[1, 0]])
    inertia = mass_matrix[3:, 3:] + mass * skew(centre) @ skew(centre)
    second = np.maximum(np.trace(inertia) / 2.0 - np.diag(inertia), 0.0) / mass
    # No solid is smaller than a cube of steel: a point mass is one.
    edge = (mass / SOLID_KGPM3) ** (1.0 / 3.0)
    if second.sum() < edge**2 / 4.0:
        second = np.full(3, edge**2 / 12.0)
    gyration = np.sqrt(np.maximum(second, 1e-6 * second.max()))
    reach = np.abs(centre) + np.sqrt(3.0) * gyration
    along = SPEED_OF_SOUND_MPS / (4.0 * reach)
    bending = BENDING_ROOT**2 / (2.0 * np.pi) * SPEED_OF_SOUND_MPS * gyration[:, None] / reach**2
    softness = bending**-2.0 + (SHEAR_SPEED * along) ** -2.0
    np.fill_diagonal(softness, 0.0)
    shifts = along**-2.0 + softness.sum(axis=1)
    turns = [(SHEAR_SPEED * along[i]) ** -2.0 + softness[j, k] + softness[k, j] for i, j, k in TRIPLES]
    return np.asarray(np.concatenate([shifts, turns]) ** -0.5)
