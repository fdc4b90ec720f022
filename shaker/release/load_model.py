"""Two-mass and three-mass models of a loaded sensor: poles, load characteristics, bands, load limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from shaker.lti.indices import FigureRange, find_figure_range
from shaker.lti.responses import band_end, gain_curve
from shaker.lti.system import LinearSystem
from shaker.mechanics import fixed_base_chain, poles
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape
from shakercal._common.propagation import derivatives

# The sensor and its load as masses in a row on a rigid base.

PARAMETERS = ("stiffness", "damping", "coupling_stiffness", "coupling_damping")


@dataclass(frozen=True, repr=False)
class LoadModel(Arrays):
    """Sensor and load as two masses in a row.

    The moving mass m_E is on the sensor's spring k, c; the load mass m_L is on it by k_L, c_L. `coupling_stiffness` k_L
    and `coupling_damping` c_L are None for a rigid coupling. Output U = n·x_E over a force on the load (eqs. 2, 3 of
    the publication named in `docs/load.md`): H(s) = n (c_L s + k_L)/B(s), B(s) = m_L m_E s⁴ + [m_L (c + c_L) + m_E c_L]
    s³ + [m_L (k + k_L) + c c_L + m_E k_L] s² + (k c_L + c k_L) s + k k_L; rigid: H(s) = n/[(m_E + m_L) s² + c s + k].

    `moving_mass` in kg with `u_moving_mass`, stiffnesses in N/m, dampings in N·s/m, `sensitivity` = n/k in output unit
    per N. For a moment: inertias instead of masses, N·m/rad instead of N/m. `covariance` (P, P) of `PARAMETERS`, the
    first two for a rigid load, for the stated masses. `covariance_with_mass` (P + 1, P + 1) of [*parameters, moving
    mass], including the uncertainty of the masses. Both are None if they are not available. `load_masses`: masses of
    the fitted records. `solution` of `solutions`: number among the solutions that the data cannot distinguish.
    """

    component: str
    channel: str
    unit: str
    moving_mass: float
    stiffness: float
    damping: float
    coupling_stiffness: float | None = None
    coupling_damping: float | None = None
    sensitivity: float = 1.0
    u_moving_mass: float = 0.0
    covariance: FloatArray | None = None
    u_sensitivity: float = 0.0
    covariance_with_mass: FloatArray | None = None
    load_masses: tuple[float, ...] = ()
    solution: int = 1
    solutions: int = 1

    def __post_init__(self) -> None:
        if (self.coupling_stiffness is None) != (self.coupling_damping is None):
            raise ValueError("coupling_stiffness, coupling_damping: expected both or none, found one")
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (len(self.vector),) * 2)
        if self.covariance_with_mass is not None:
            check_shape("covariance_with_mass", self.covariance_with_mass, (len(self.vector) + 1,) * 2)

    @property
    def is_rigid(self) -> bool:
        """Whether load and moving mass move as one (two-mass model)."""
        return self.coupling_stiffness is None

    @property
    def vector(self) -> FloatArray:
        """The parameters (P,) in the order of `PARAMETERS`."""
        values = (self.stiffness, self.damping, self.coupling_stiffness, self.coupling_damping)
        return np.array([value for value in values if value is not None])

    @property
    def total_covariance(self) -> FloatArray | None:
        """Covariance (P + 1, P + 1) of [*parameters, moving mass], independent unless known."""
        if self.covariance_with_mass is not None or self.covariance is None:
            return self.covariance_with_mass
        size = len(self.vector)
        total = np.zeros((size + 1, size + 1))
        total[:size, :size], total[size, size] = self.covariance, self.u_moving_mass**2
        return total

    def with_numbers(self, numbers: FloatArray) -> LoadModel:
        """Return the model of other [*parameters, moving mass] (P + 1,), with the same covariances."""
        *values, mass = (float(number) for number in numbers)
        k, c = values[:2]
        kl, cl = values[2:] if not self.is_rigid else (None, None)
        return replace(self, moving_mass=mass, stiffness=k, damping=c, coupling_stiffness=kl, coupling_damping=cl)

    def jacobian(self, function: Callable[[LoadModel], FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return a function's values (Q,) and derivatives (Q, P) by all numbers, as central differences."""
        total = self.total_covariance
        if total is None:
            raise ValueError("covariance: expected that of the parameters, found none")
        most = np.where(self.numbers == 0.0, np.inf, 1e-3 * np.abs(self.numbers))
        moves = np.minimum(1e-2 * np.sqrt(np.diag(total)), most)
        return function(self), derivatives(lambda move: function(self.with_numbers(self.numbers + move)), moves)

    @property
    def numbers(self) -> FloatArray:
        """All numbers (P,) of `total_covariance`: `vector` and the moving mass."""
        return np.append(self.vector, self.moving_mass)

    def propagate(self, function: Callable[[LoadModel], FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return a function's values (Q,) and their covariance (Q, Q) by its `jacobian`."""
        value, slope = self.jacobian(function)
        return value, np.asarray(slope @ np.asarray(self.total_covariance) @ slope.T)

    def altered(self, frequency: float = 0.0, damping_ratio: float = 0.0, gain: float = 0.0) -> LoadModel:
        """Return the model with relative changes of natural frequencies, damping ratios, sensitivity."""
        spring, damper = (1.0 + frequency) ** 2, (1.0 + frequency) * (1.0 + damping_ratio)
        factors = np.append(np.tile([spring, damper], len(self.vector) // 2), 1.0)
        return replace(self.with_numbers(factors * self.numbers), sensitivity=(1.0 + gain) * self.sensitivity)

    def poles(self, load_mass: float) -> ComplexArray:
        """Return all 2 or 4 poles in rad/s with a load mass in kg."""
        return self.system(load_mass).poles

    def system(self, load_mass: float) -> LinearSystem:
        """Return output over force on a load, in output unit per N."""
        if not load_mass >= 0:
            raise ValueError(f"load_mass: expected 0 or more, found {load_mass}")
        m, k, c, n = self.moving_mass, self.stiffness, self.damping, self.sensitivity * self.stiffness
        kl, cl, ml = self.coupling_stiffness, self.coupling_damping, load_mass
        if kl is None or cl is None or ml == 0:
            return LinearSystem.from_coefficients(np.array([n]), np.array([m + ml, c, k]))
        below = [ml * m, ml * (c + cl) + m * cl, ml * (k + kl) + c * cl + m * kl, k * cl + c * kl, k * kl]
        return LinearSystem.from_coefficients(n * np.array([cl, kl]), np.array(below))


# Poles of the loaded sensor and their derivatives by stiffness, damping and mass.


def upper_poles(numbers: FloatArray, moving_mass: float, load_mass: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the upper poles (M,) in rad/s, ascending, with derivatives (M, P + 2).

    `numbers` (P,): stiffness and damping, and those of the coupling unless the load is rigid. Derivatives by the
    numbers, the moving mass and the load mass. A load without mass has one mode; overdamped modes are missing.
    """
    if len(numbers) == 2 or load_mass == 0.0:
        weights, terms, columns = [moving_mass + load_mass, *numbers[:2]], [1, 2, 0, 0], [0, 1, -2, -1]
    else:
        k, c, kl, cl = numbers
        weights, terms, columns = [moving_mass, load_mass, k, kl, c, cl], [2, 4, 3, 5, 0, 1], [0, 1, 2, 3, -2, -1]
    roots, slopes = poles(fixed_base_chain(len(weights) // 3), np.array([1.0, *weights]))
    upper = roots.imag > 0.0
    rates = np.zeros((np.count_nonzero(upper), len(numbers) + 2), dtype=np.complex128)
    rates[:, columns] = slopes[upper][:, terms]
    return roots[upper], rates


# Resonance and damping of a sensor over the load mass, with uncertainties.


@dataclass(frozen=True, repr=False)
class LoadCurve(
    Arrays, shapes="load_mass K; frequency_hz K 2; damping_ratio K 2; u_frequency_hz K 2; u_damping_ratio K 2"
):
    """Frequencies and damping ratios of two modes over load masses.

    Load masses (K,) in kg; frequencies are natural frequencies in Hz. `frequency_hz`, `damping_ratio` and their
    standard uncertainties (K, 2), NaN without a second mode or a covariance. f = |p|/2π and ζ = -Re p/|p| of the poles
    p of `LoadModel.system`.
    """

    load_mass: FloatArray
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    u_frequency_hz: FloatArray
    u_damping_ratio: FloatArray


def load_curve(model: LoadModel, load_mass: FloatArray, u_load_mass: FloatArray | None = None) -> LoadCurve:
    """Return frequencies and damping ratios of both modes over load masses (K,)."""
    masses = np.asarray(load_mass, dtype=np.float64)
    if model.total_covariance is None:
        values = _modes(model, masses)
        spread = np.full_like(values, np.nan)
    else:
        values, covariance = model.propagate(lambda changed: _modes(changed, masses))
        spread = np.sqrt(np.diag(covariance))
        if u_load_mass is not None and np.any(u_load_mass > 0):
            change = _modes(model, masses + u_load_mass) - _modes(model, np.maximum(masses - u_load_mass, 0.0))
            spread = np.hypot(spread, 0.5 * change)
    f, z = values.reshape(2, len(masses), 2)
    u_f, u_z = spread.reshape(2, len(masses), 2)
    return LoadCurve(masses, f, z, np.where(np.isnan(f), np.nan, u_f), np.where(np.isnan(z), np.nan, u_z))


def first_mode_hz(model: LoadModel, load_mass: float) -> float:
    """Return the natural frequency of the lowest mode with a load mass, in Hz."""
    poles, _ = upper_poles(model.vector, model.moving_mass, load_mass)
    return float(np.abs(poles[0])) / (2.0 * np.pi) if len(poles) else float("nan")


def rigid_formula_hz(model: LoadModel, load_mass: float) -> float:
    """Return √(k/(m_E + m_L))/2π in Hz, the resonance of a rigid load (eq. 6)."""
    return float(np.sqrt(model.stiffness / (model.moving_mass + load_mass)) / (2.0 * np.pi))


def _modes(model: LoadModel, masses: FloatArray) -> FloatArray:
    """Return frequencies, then damping ratios, (2 K 2,) by mode; NaN without a second one."""
    modes = np.full((2, len(masses), 2), np.nan)
    for index, mass in enumerate(masses):
        upper, _ = upper_poles(model.vector, model.moving_mass, float(mass))
        modes[:, index, : len(upper)] = np.abs(upper) / (2.0 * np.pi), -upper.real / np.abs(upper)
    return modes.ravel()


# Working bands of a loaded sensor.

TOLERANCES = (0.05, 0.10)  # deviations of the gain from the static one, as usual in data sheets
SMALLEST_DAMPING = 1e-4  # damping ratio for an undamped model: bands do not depend on it


def working_bands(model: LoadModel, load_mass: float, tolerances: tuple[float, ...] = TOLERANCES) -> FloatArray:
    """Return the frequencies (T,) in Hz up to which |H|/|H(0)| stays within tolerances.

    A band without an end is NaN. A model without damping, from resonances alone, has the bands of very light damping.
    """
    if model.damping == 0.0:
        light = 2.0 * SMALLEST_DAMPING * np.sqrt(model.stiffness * model.moving_mass)
        coupling = model.coupling_stiffness
        other = None if coupling is None else light * coupling / model.stiffness
        model = replace(model, damping=light, coupling_damping=other)
    system = model.system(load_mass)
    curve, level = gain_curve(system), system.static_gain
    ends = [band_end(curve, level, tolerance) for tolerance in tolerances]
    return np.array([np.nan if end is None or np.isinf(end) else end for end in ends])


MIN_PARAMETER_SHARE = 0.02
"""Smallest share of a stiffness, damping or mass that remains when a model is varied within its uncertainty."""


def figures_u(model: LoadModel, figures: Callable[[LoadModel], FloatArray]) -> tuple[FloatArray, FigureRange]:
    """Return u (Q,) of figures, NaN where there is none, and their range."""
    total, slope = np.asarray(model.total_covariance, dtype=np.float64), model.jacobian(figures)[1]

    def moved(move: FloatArray) -> FloatArray:
        return figures(model.with_numbers(np.maximum(model.numbers + move, MIN_PARAMETER_SHARE * model.numbers)))

    seen = find_figure_range(total, slope, moved)
    return np.asarray(seen.factor * np.sqrt(np.maximum(np.einsum("qp,pr,qr->q", slope, total, slope), 0.0))), seen


# Load limits: masses above which the resonance, or a formula for it, deviates by more than permitted.

ROUNDING = 1e-9  # relative uncertainty from the rounding of a root
HEAVIEST = 1e4  # load mass over the moving mass, upper end of the search for limits


class LoadLimit(NamedTuple):
    """A load mass in kg, or kg·m², with its standard uncertainty or NaN."""

    load_mass: float
    u: float


def formula_limit(model: LoadModel, permitted: float) -> LoadLimit | None:
    """Return the load above which √(k/(m_E + m_L)) is too high by a share.

    None if this never happens. For large loads the formula is too high by √(1 + k/k_L).
    """
    _check_share(permitted)
    most = 1.0 + permitted
    return _limit(model, lambda changed, load: rigid_formula_hz(changed, load) / first_mode_hz(changed, load) - most)


def change_limit(model: LoadModel, permitted: float) -> LoadLimit | None:
    """Return the load mass that lowers the resonance by a share `permitted`."""
    _check_share(permitted)
    least = 1.0 - permitted
    return _limit(model, lambda changed, load: least - first_mode_hz(changed, load) / first_mode_hz(changed, 0.0))


def frequency_limit(model: LoadModel, target_hz: float) -> LoadLimit | None:
    """Return the load mass up to which the resonance is at least `target_hz`."""
    if not target_hz > 0:
        raise ValueError(f"target_hz: expected a frequency above 0, found {target_hz}")
    if first_mode_hz(model, 0.0) < target_hz:
        return None
    return _limit(model, lambda changed, load: target_hz / first_mode_hz(changed, load) - 1.0)


def _check_share(permitted: float) -> None:
    if not 0.0 < permitted < 1.0:
        raise ValueError(f"permitted: expected a share between 0 and 1, found {permitted}")


def _limit(model: LoadModel, beyond: Callable[[LoadModel, float], float]) -> LoadLimit | None:
    """Return the root of a rising function of the load, with its uncertainty."""
    from scipy.optimize import brentq

    def root(changed: LoadModel) -> float:
        low, high = 0.0, 1e-3 * changed.moving_mass
        while beyond(changed, high) <= 0.0:
            low, high = high, 2.0 * high
            if high > HEAVIEST * changed.moving_mass:
                return float("nan")
        return float(brentq(lambda load: beyond(changed, load), low, high, xtol=1e-14 * changed.moving_mass))

    value = root(model)
    if np.isnan(value):
        return None
    if model.total_covariance is None:
        return LoadLimit(value, float("nan"))
    u = float(np.sqrt(model.propagate(lambda changed: np.array([root(changed)]))[1][0, 0]))
    return LoadLimit(value, u if u > ROUNDING * value else 0.0)
