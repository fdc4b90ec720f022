"""The load on the sensor, and the uncertainty budget of any result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.coverage import Polar
from fusion.estimation.labelled_phasors import LabelledPhasors, TabularResult
from fusion.estimation.least_squares import UNOBSERVED, UNOBSERVED_ITSELF
from fusion.estimation.measurement_model import BODY_SIZE_M
from fusion.estimation.uncertainty import (
    Contribution,
    Influence,
    Kind,
    Uncertainty,
    Unknown,
    added_up,
    polar_elements,
    real_stack,
    total_variance,
)
from fusion.sensitivity.moving_body import Body
from fusion.sensitivity.sensitivity_notices import (
    DRAWING_TOO_HEAVY,
    ELASTIC_CORRECTED,
    ELASTIC_ONLY_NAMED,
    LOAD_MAY_DEFORM,
    LOAD_UNDETERMINED,
    NEAR_RESONANCE,
    UNOBSERVED_MOTION_ASSUMED,
    UNOBSERVED_MOTION_LARGE,
)
from photogram.geometry import skew
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, MOTION_COMPONENTS
from shaker.sine.phasor import Phasors, real_stacked
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, check_shape, check_shapes
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.estimation.fuse import Acceleration

# The load at the sensor origin: mass matrix and gravity tilt applied to the acceleration, with its uncertainty.


UNOBSERVED_LIMIT = 0.05
"""Largest relative standard uncertainty of a load component by unobserved motion.

Half of the usual 10 %: the geometry must exclude half of that motion. U includes the rest.
"""
MATTERS = 0.1
"""Share of the variance above which an assumption on unobserved motion is a warning (chosen)."""
RIGID_ENOUGH = 1e-3
"""Relative elastic change of a load that is not reported, unless U is equally small (chosen)."""
MAX_MASS_RATIO = 1.02
"""Mass of an elastic part by its drawing over all moving mass: chosen as the tolerance of drawings."""
RESONANCE_BAND = 0.2
"""Relative distance from a natural frequency within which its damping determines the response."""


@dataclass(frozen=True, repr=False)
class LoadResult(TabularResult):
    """Wrench phasors at the sensor origin in N and N.m, with the manifest's sense.

    Attributes
    ----------
    frequency_hz : (K,), Hz.
    value : (K, 6), whole estimate with unobserved components of the motion at zero; NaN at lines without a reading.
    uncertainty : of all six components; unobserved motion is a separate contribution.
    observed : (K, 6), components that are results because unobserved motion has little effect on them.
    notices : notices of the load.
    both : names of unknowns that act on the load through the motion and directly, such as elastic parts; None for none.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    uncertainty: Uncertainty
    observed: BoolArray
    notices: tuple[Notice, ...]
    both: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        lines = len(self.frequency_hz)
        check_shapes(self, (lines, 6), "value", "observed")
        check_shape("covariance", self.uncertainty.covariance, (lines, 12, 12))

    def labelled(self) -> LabelledPhasors:
        """Return the components that are results, with their names and units."""
        value = np.where(self.observed, self.value, complex(np.nan, np.nan))
        kind = ("phasor",) * len(value)
        return LabelledPhasors(
            "load", self.frequency_hz, value, ("load",) * 6, LOAD_COMPONENTS, LOAD_UNITS, self.uncertainty, kind
        )

    @cached_property
    def phasors(self) -> Phasors:
        """Return the components that are results, NaN elsewhere, `dof` of the largest force."""
        mask = ~np.tile(self.observed, (1, 2))
        covariance = np.where(mask[:, :, None] | mask[:, None, :], np.nan, self.uncertainty.covariance)
        value = np.where(self.observed, self.value, complex(np.nan, np.nan))
        size = np.abs(self.value) / np.where(np.arange(6) < 3, 1.0, BODY_SIZE_M)
        largest = np.argmax(np.where(self.observed, size, -1.0), axis=1)
        dof = self.uncertainty.dof()[np.arange(len(value)), largest]
        return Phasors(self.frequency_hz, value, covariance, LOAD_COMPONENTS, LOAD_UNITS, dof)

    @cached_property
    def polar(self) -> list[list[Polar | None]]:
        """Return magnitude and phase (K lines of 6), None where one is not a result."""
        return polar_elements(self.phasors.value, self.uncertainty, self.phasors.covariance)


def load_phasors(acceleration: Acceleration, body: Body) -> LoadResult:
    """Return the wrench L = ±(M A + gravity tilt) at the sensor origin.

    It is positive in the body's sense. Its uncertainty is that of the acceleration, and one influence per uncertain
    number of body, joint, modes and gravity, (dM/dp · A) u(p). Unobserved components of the acceleration are zero
    within the amplitudes of `acceleration.unseen`, a type B contribution "unobserved NAME". A load component with more
    than 5 % from these is not a result. Lines at which a component of the acceleration is disputed have no load.
    """
    frequency = acceleration.phasors.frequency_hz
    # A line without a reading has neither a load nor an uncertainty, and neither has one with a disputed component.
    determined = np.any(acceleration.observed, axis=1)
    if acceleration.disputed is not None:
        determined = determined & ~np.any(acceleration.disputed, axis=1)
    seen = np.where(determined, 1.0, np.nan)[:, None, None]
    matrix = seen * body.load_matrix(frequency)
    changes = [replace(change, effect=seen * change.effect) for change in body.matrix_changes(frequency)]
    motion = np.nan_to_num(acceleration.phasors.value)
    value = np.einsum("kij,kj->ki", matrix, motion)
    value = np.where(_reached(acceleration, matrix, changes), complex(np.nan, np.nan), value)
    hidden = _hidden_contributions(acceleration, matrix, changes)
    spread = np.sum([np.zeros(value.shape), *(total_variance(part.covariance) for part in hidden.values())], axis=0)
    observed = np.isfinite(value) & (np.sqrt(spread) <= UNOBSERVED_LIMIT * np.abs(value))
    # Unobserved components are separate contributions, which include their effect on the others.
    others = tuple(part for part in acceleration.uncertainty.random if part.label not in UNOBSERVED_ITSELF)
    carried = replace(acceleration.uncertainty, random=others).nan_as_zero().transformed(real_stacked(matrix))
    of_parameters = tuple(c.acting(real_stack(np.einsum("kij,kj->ki", c.effect, motion))) for c in changes)
    # What is elastic acts on instruments and load by one name.
    total = Uncertainty((*carried.random, *hidden.values()), added_up((*carried.influences, *of_parameters)))
    rigid = np.einsum("kij,kj->ki", seen * body.rigid.load_matrix(frequency), motion)
    moved = {influence.name for influence in carried.influences}
    both = tuple(c.name for c in of_parameters if c.name in moved) or None
    result = LoadResult(frequency, value, total, observed, (), both)
    notices = (
        *_notices(acceleration, total, value, observed, hidden),
        *_elastic_notices(body, frequency, value, rigid),
    )
    return replace(result, notices=(*notices, *_rigidity_notices(body, result)))


def _reached(acceleration: Acceleration, matrix: ComplexArray, changes: Sequence[Unknown[ComplexArray]]) -> BoolArray:
    """Return the components of the load (K, 6) that unbounded motion changes."""
    unbounded = np.isinf(acceleration.unobserved_amplitude)[:, None, :]
    matrices = (matrix, *(change.effect for change in changes))
    return np.asarray(np.any([np.any((one != 0.0) & unbounded, axis=2) for one in matrices], axis=0))


def _hidden_contributions(
    acceleration: Acceleration, matrix: ComplexArray, changes: Sequence[Unknown[ComplexArray]]
) -> dict[str, Contribution]:
    """Return one type B contribution per unobserved component.

    Real and imaginary parts are independent. The effect on the load includes the change of observed components, with
    sign.
    """
    amplitude = acceleration.unobserved_amplitude
    u = np.where(np.isinf(amplitude), 0.0, amplitude) / np.sqrt(2.0)
    # Through the uncertain parameters an unobserved component acts even where its coefficient is zero.
    matrices = np.stack([matrix, *(c.effect for c in changes)])
    leaked = np.zeros((len(u), 12, 12)) if acceleration.leaked is None else real_stacked(matrix) @ acceleration.leaked
    hidden = {}
    for index, (name, label) in enumerate(zip(MOTION_COMPONENTS, UNOBSERVED_ITSELF, strict=True)):
        if np.any(u[:, index] > 0.0):
            columns = real_stacked(matrices[..., index, None]) * u[:, index, None, None]
            columns[0] -= leaked[:, :, [index, index + 6]]
            hidden[name] = Contribution(label, "B", np.einsum("wkia,wkja->kij", columns, columns))
    return hidden


def _notices(
    acceleration: Acceleration,
    total: Uncertainty,
    value: ComplexArray,
    observed: BoolArray,
    hidden: Mapping[str, Contribution],
) -> tuple[Notice, ...]:
    """Return notices of assumed unobserved motion and of undetermined load components."""
    notices = []
    given = np.where(observed, np.abs(value) / np.where(np.arange(6) < 3, 1.0, BODY_SIZE_M), 0.0)
    line, largest = np.unravel_index(int(np.argmax(given)), given.shape)
    if hidden and given[line, largest] > 0.0:
        whole = float(total_variance(total.covariance)[line, largest])
        # The direct effect on the load, and that through uncertain directions of observed components.
        contributions = [*hidden.values(), *(part for part in total.random if part.label == UNOBSERVED)]
        part = float(sum(total_variance(one.covariance)[line, largest] for one in contributions))
        if part > 0.0:
            share, size = part / whole, np.sqrt(part / 2.0) / np.abs(value[line, largest])
            declared = UNOBSERVED_MOTION_LARGE if share > MATTERS else UNOBSERVED_MOTION_ASSUMED
            notices.append(
                Notice(
                    declared,
                    acceleration.body,
                    components=", ".join(hidden),
                    limits=str(acceleration.unobserved_limits),
                    driven=_describe_driven(acceleration, int(line)),
                    u_percent=100.0 * size,
                    load=LOAD_COMPONENTS[largest],
                    frequency_hz=acceleration.phasors.frequency_hz[line],
                    share=share,
                )
            )
    missing = [name for index, name in enumerate(LOAD_COMPONENTS) if not np.any(observed[:, index])]
    if missing:
        notices.append(Notice(LOAD_UNDETERMINED, "load", components=", ".join(missing)))
    return tuple(notices)


def _describe_driven(acceleration: Acceleration, line: int) -> str:
    """Return the limits of the unobserved driven components at a line, as text."""
    drive, amplitude = acceleration.unobserved_limits.drive or (0.0,) * 6, acceleration.unobserved_amplitude[line]
    units = ("m/s^2",) * 3 + ("rad/s^2",) * 3
    rows = zip(MOTION_COMPONENTS, drive, amplitude.tolist(), units, strict=True)
    parts = [f"{name} up to {size:.3g} {unit}" for name, part, size, unit in rows if part and 0.0 < size < np.inf]
    return f", and by excitation.direction {', '.join(parts)}" if parts else ""


def _elastic_notices(
    body: Body, frequency_hz: FloatArray, value: ComplexArray, rigid: ComplexArray
) -> tuple[Notice, ...]:
    """Return the effect of joint and modes on the largest force, at its largest change."""
    sizes = np.nan_to_num(np.abs(rigid))
    largest, lines = np.argmax(sizes[:, :3], axis=1), np.arange(len(value))
    before, after = sizes[lines, largest], np.abs(value)[lines, largest]
    change = np.divide(after, before, out=np.full(len(value), np.nan), where=before > 0.0) - 1.0
    if (body.joint is None and not body.elastic) or not np.any(np.isfinite(change)):
        return ()
    line = int(np.nanargmax(np.abs(change)))
    component = int(largest[line])
    corrected, named = list[str](), list[tuple[str, float]]()
    if body.joint is not None:
        resonance, stated = float(body.joint.frequency_hz[component]), body.joint.u_frequency_hz[component] > 0.0
        if not stated:
            named.append(("joint of the load", resonance))
        elif not body.elastic:
            corrected.append(f"the joint of the load ({resonance:.6g} Hz)")
    for part in body.elastic:
        natural_hz = float(part.modes.frequency_hz.min())
        if part.variants:
            corrected.append(f"the elastic {part.name} ({natural_hz:.6g} Hz)")
        else:
            named.append((f"elastic {part.name} of the load", natural_hz))
    notices = []
    if corrected:
        notices.append(
            Notice(
                ELASTIC_CORRECTED,
                "load",
                parts=", ".join(corrected),
                load=LOAD_COMPONENTS[component],
                frequency_hz=frequency_hz[line],
                change_percent=100.0 * change[line],
                moving="its foot" if body.elastic else "the part above the joint",
            )
        )
    notices += [Notice(ELASTIC_ONLY_NAMED, "load", part=name, frequency_hz=hertz) for name, hertz in named]
    return (*notices, *_part_notices(body, frequency_hz))


def _part_notices(body: Body, frequency_hz: FloatArray) -> Iterator[Notice]:
    """Yield warnings of elastic parts that are heavier than the load, or near resonance."""
    total = body.rigid.mass_matrix[0, 0]
    for part in body.elastic:
        if part.mass_kg is not None and part.mass_kg > MAX_MASS_RATIO * total:
            yield Notice(DRAWING_TOO_HEAVY, "load", part=part.name, mass_kg=part.mass_kg, total_kg=total)
        near = np.abs(frequency_hz[:, None] / part.modes.frequency_hz - 1.0) < RESONANCE_BAND
        for k, mode in np.argwhere(near)[:1].tolist():
            hertz, natural_hz = frequency_hz[k], part.modes.frequency_hz[mode]
            yield Notice(NEAR_RESONANCE, "load", part=part.name, frequency_hz=hertz, natural_hz=natural_hz)


def _rigidity_notices(body: Body, load: LoadResult) -> tuple[Notice, ...]:
    """Return a warning if a load without stated elasticity may not be rigid.

    By its mass and size, at the line with the largest effect: more than 0.1 % of the largest component or more than a
    third of its U, unless U is ten times as large.
    """
    if body.elastic or body.first_frequency_hz is not None:
        return ()
    above = replace(body.rigid, parts=tuple(part for part in body.parts if not part.below_joint))
    if not above.parts:
        return ()
    natural, lines = likely_frequencies(above.mass_matrix), np.arange(len(load.value))
    size = np.nan_to_num(np.abs(load.value))
    largest = np.argmax(size / np.where(np.arange(6) < 3, 1.0, BODY_SIZE_M), axis=1)
    value, first = size[lines, largest], natural[largest]
    change = FREE_END * (load.frequency_hz / first) ** 2
    # U of the magnitude, whatever its phase.
    expanded = 2.0 * np.sqrt(np.nan_to_num(total_variance(load.uncertainty.covariance))[lines, largest])
    expanded = np.divide(expanded, value, out=np.full(len(value), np.inf), where=value > 0.0)
    matters = change > np.minimum(expanded / 3.0, np.maximum(RIGID_ENOUGH, expanded / 10.0))
    if not np.any(matters):
        return ()
    line = int(np.argmax(np.where(matters, change, -1.0)))
    notice = Notice(
        LOAD_MAY_DEFORM,
        "load",
        frequency_hz=load.frequency_hz[line],
        natural_hz=float(f"{first[line]:.2g}"),
        load=LOAD_COMPONENTS[largest[line]],
        change=min(change[line], 1.0),
    )
    return (notice,)


def describe_other_loads(load: LoadResult, component: int, capacity: Sequence[float] | None = None) -> str:
    """Return the other loads at the strongest line, relative to `component`, as text.

    Forces and moments are compared in shares of the rated `capacity` (6,) only.
    """
    rated = np.ones(6) if capacity is None else np.asarray(capacity)
    given = np.abs(np.where(load.observed, load.value, np.nan)) / rated
    if not np.any(given[:, component] > 0.0):
        return "loads that are not known"
    line = int(np.nanargmax(given[:, component]))
    share = given[line] / given[line, component]
    others = [
        f"{LOAD_COMPONENTS[i]} {100.0 * share[i]:.2f} %"
        for i in range(6)
        if i != component and (capacity is not None or i // 3 == component // 3) and np.isfinite(share[i])
    ]
    basis = "" if capacity is None else ", in shares of the rated loads"
    return f"{', '.join(others)} of {LOAD_COMPONENTS[component]}{basis}" if others else "loads that are not known"


# Likely resonances of a load without stated elasticity, by its mass and size.


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
    """Return likely first natural frequencies (6,), in Hz, of a metal body.

    By its mass matrix (6, 6), with the foot at the sensor origin. Centre of mass and moments of inertia give the reach
    along each axis: |c| + √3·k, k² = ∫x² dm/m, exact for rods. Along the axes: f = c/(4·reach). Bending of the reach j
    by motion along i: f = 1.875²/(2π)·c·k_i/reach_j², combined with shear by Dunkerley's sum of 1/f².
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


# The uncertainty budget: contribution of each cause to magnitude and phase, line by line.


@dataclass(frozen=True)
class BudgetEntry:
    """Contribution of one cause to C complex values at K lines, independent of all others.

    `label`, `type` A or B. `count`: number of unknowns, 0 for noise. `u` in `unit`: standard uncertainty of the
    unknown, NaN for noise and for unknowns of different uncertainty. `coefficient` (2, K, C): change of the relative
    magnitude and of the phase (rad) per unit of the unknown; for several unknowns of one uncertainty the root of the
    sum of squares. `u_relative`, `u_phase_rad` (K, C): contribution to the standard uncertainty of the relative
    magnitude and of the phase. `dof` (K,).
    """

    label: str
    type: Kind
    count: int
    u: float
    unit: str
    coefficient: FloatArray
    u_relative: FloatArray
    u_phase_rad: FloatArray
    dof: FloatArray


def budget(uncertainty: Uncertainty, value: ComplexArray) -> tuple[BudgetEntry, ...]:
    """Return the budget of complex values (K, C), one entry per label.

    In the order of first appearance. With dX/X = d ln|X| + j d arg X the contributions are those to X turned and
    divided by X (JCGM 102, 9.4). Effects of one unknown through outputs and load are added before any square.
    """
    relative = uncertainty.relative_to(value)
    unknowns: dict[str, list[Influence]] = {}
    for influence in relative.influences:
        unknowns.setdefault(influence.label, []).append(influence)
    entries = []
    for part in relative.grouped():
        variance = np.maximum(part.covariance.diagonal(axis1=1, axis2=2), 0.0)
        both = np.sqrt(variance).reshape(len(value), 2, -1).swapaxes(0, 1)
        members = unknowns.get(part.label, [])
        # What the unknowns of one label have in common; one alone has a sign.
        stated = {(influence.u, influence.unit) for influence in members}
        u, unit = stated.pop() if len(stated) == 1 else (np.nan, "")
        signed = members[0].effect.reshape(len(value), 2, -1).swapaxes(0, 1) if len(members) == 1 else both
        coefficient = np.asarray(signed / u) if u > 0.0 else np.full(both.shape, np.nan)
        dof = np.full(len(value), np.inf) if part.dof is None else part.dof
        entries.append(BudgetEntry(part.label, part.type, len(members), u, unit, coefficient, both[0], both[1], dof))
    return tuple(entries)
