"""Linear systems by zeros, poles and gain, their conversions, and modal models with covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape
from shakercal._common.propagation import derivatives

Conversion = Literal["tustin", "zoh"]
MIN_LAG, MAX_DAMPING = 0.02, 0.999  # smallest share of a shifted lag or frequency; largest |ζ|; chosen
_NO_ZERO = 1e-10  # remaining share of a leading coefficient that is rounding: a zero 1e10 times beyond the poles
MAX_TERM_RATIO = 1e5
"""How much larger than their sum the parts of a response may be; beyond, poles count as coinciding."""


@dataclass(frozen=True, repr=False)
class LinearSystem(Arrays):
    """Linear system, continuous or sampled, by zeros, poles and gain.

    H = gain·Π(x - zeros)/Π(x - poles), x = s in rad/s, or x = z of samples. Polynomial coefficients are computed only
    where a format needs them and never stored: rounded ones move the poles of an oversampled system.

    Attributes
    ----------
    zeros, poles : (Z,) and (P,), complex, in conjugate pairs where not real; Z ≤ P.
    gain : leading coefficient.
    sample_rate_hz : rate of the samples in Hz; None for a continuous system.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import LinearSystem
    >>> omega = 2 * np.pi * 300.0  # one mode at 300 Hz, damped by 5 %
    >>> sensor = LinearSystem.from_coefficients(np.array([omega**2]), np.array([1.0, 0.1 * omega, omega**2]))
    >>> print(sensor.poles.round())
    [-94.+1883.j -94.-1883.j]
    """

    zeros: ComplexArray
    poles: ComplexArray
    gain: float
    sample_rate_hz: float | None = None

    def __post_init__(self) -> None:
        for name in ("zeros", "poles"):
            value = np.asarray(getattr(self, name), dtype=np.complex128)
            check_shape(name, value, (None,))
            object.__setattr__(self, name, pair_conjugates(value, name))
        if len(self.zeros) > len(self.poles):
            raise ValueError(f"zeros: expected at most as many as poles, {len(self.poles)}, found {len(self.zeros)}")

    @staticmethod
    def from_coefficients(
        numerator: FloatArray, denominator: FloatArray, sample_rate_hz: float | None = None
    ) -> LinearSystem:
        """Return the system of polynomials in falling powers of s or z."""
        top, bottom = (np.trim_zeros(np.asarray(part, float), "f") for part in (numerator, denominator))
        if not len(top) or not len(bottom):
            raise ValueError("numerator, denominator: expected a coefficient other than 0 in both, found none")
        zeros, poles = (np.asarray(np.roots(part) + 0j) for part in (top, bottom))
        return LinearSystem(zeros, poles, float(top[0] / bottom[0]), sample_rate_hz)

    @staticmethod
    def from_residues(
        poles: ComplexArray, residues: ComplexArray, direct: float = 0.0, sample_rate_hz: float | None = None
    ) -> LinearSystem:
        """Return the system direct + Σ residue/(x - pole) of different poles (P,).

        The numerator is computed in powers of x minus the x of frequency zero, in units of the poles' typical distance
        from it. Poles of oversampled signals, all near z = 1, thus keep their digits. Leading coefficients within
        rounding are dropped.
        """
        p, r = np.asarray(poles, dtype=np.complex128), np.asarray(residues, dtype=np.complex128)
        rest = 0.0 if sample_rate_hz is None else 1.0
        distance = np.abs(p - rest)
        scale = float(np.exp(np.mean(np.log(distance[distance > 0])))) if np.any(distance > 0) else 1.0
        near = (p - rest) / scale
        terms = [direct * np.atleast_1d(np.poly(near))]
        for i, residue in enumerate(r):
            terms.append(np.concatenate([[0.0], residue / scale * np.atleast_1d(np.poly(np.delete(near, i)))]))
        total, size = np.sum(terms, axis=0).real, np.sum(np.abs(terms), axis=0)
        significant = np.flatnonzero(np.abs(total) > _NO_ZERO * size)
        if not len(significant):
            raise ValueError("residues: expected a residue other than 0, found none")
        first = int(significant[0])
        zeros = np.asarray(np.roots(total[first:]) * scale + rest + 0j)
        return LinearSystem(zeros, p, float(total[first]) * scale**first, sample_rate_hz)

    def coefficients(self) -> tuple[FloatArray, FloatArray]:
        """Return numerator and monic denominator of equal lengths in falling powers."""
        top = np.atleast_1d(self.gain * np.real(np.poly(self.zeros)))
        bottom = np.atleast_1d(np.real(np.poly(self.poles)))
        return np.concatenate([np.zeros(len(bottom) - len(top)), top]), bottom

    @property
    def static_point(self) -> complex:
        """The s or z of frequency zero."""
        return 0j if self.sample_rate_hz is None else 1 + 0j

    @property
    def static_gain(self) -> float:
        """H at frequency zero."""
        return float(self.at(np.array([self.static_point]))[0].real)

    def at(self, x: ComplexArray) -> ComplexArray:
        """Return H (K,) at s or z (K,), infinite at a pole, factor by factor."""
        point = np.asarray(x, dtype=np.complex128)[:, None]
        above = np.full((len(point), len(self.poles)), 1.0 + 0j)
        above[:, : len(self.zeros)] = point - self.zeros
        below = point - self.poles
        hit = np.any(below == 0, axis=1)
        value = self.gain * np.prod(above / np.where(below == 0, 1.0, below), axis=1)
        return np.asarray(np.where(hit, np.inf + 0j, value))

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return H (K,) at frequencies (K,) in Hz: s = jω or z = exp(jω/fs)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        return self.at(np.asarray(s if self.sample_rate_hz is None else np.exp(s / self.sample_rate_hz)))

    @property
    def stable(self) -> bool:
        """Whether every pole decays."""
        return bool(np.all(self.poles.real < 0) if self.sample_rate_hz is None else np.all(np.abs(self.poles) < 1))

    def sections(self) -> FloatArray:
        """Return a sampled system as second-order sections (S, 6) for `scipy.signal.sosfilt`."""
        from scipy.signal import zpk2sos

        if self.sample_rate_hz is None:
            raise ValueError("sample_rate_hz: expected a sampled system, found a continuous one")
        rows = np.asarray(zpk2sos(self.zeros, self.poles, self.gain))
        late = len(self.poles) - len(self.zeros)
        for row in rows:  # zpk2sos fills up with zeros at z = 0, each of which makes the output a sample early
            while late and row[2] == 0:
                row[:3] = 0.0, row[0], row[1]
                late -= 1
        return rows

    @property
    def direct(self) -> float:
        """H at infinite s or z: the direct feedthrough."""
        return self.gain if len(self.zeros) == len(self.poles) else 0.0

    def residues(self) -> ComplexArray:
        """Return the residues (P,) of H - direct, infinite where poles coincide."""
        parts = np.full(len(self.poles), self.gain, dtype=np.complex128)
        with np.errstate(divide="ignore", invalid="ignore"):
            for i, pole in enumerate(self.poles):
                above, below = np.ones((2, len(self.poles)), dtype=np.complex128)
                above[: len(self.zeros)] = pole - self.zeros
                below[:] = pole - self.poles
                below[i] = 1.0
                parts[i] *= np.prod(above / below)
        return np.asarray(np.where(np.isfinite(parts), parts, np.inf))

    def step_terms(self) -> tuple[ComplexArray, bool]:
        """Return terms a (P,) of the step response, and whether poles are separate."""
        if self.sample_rate_hz is not None or np.any(self.poles == 0):
            raise ValueError("system: expected a continuous system without a pole at 0")
        parts = self.residues()
        if not np.all(np.isfinite(parts)):
            return parts, False
        terms = parts / self.poles
        return terms, bool(np.sum(np.abs(terms)) < MAX_TERM_RATIO * max(abs(self.static_gain), abs(self.direct)))

    def step(self, time_s: FloatArray) -> FloatArray:
        """Return the response (N,) to a unit step at t = 0."""
        return self._respond(time_s, step=True)

    def impulse(self, time_s: FloatArray) -> FloatArray:
        """Return the response (N,) to a unit impulse, or to a unit sample."""
        return self._respond(time_s, step=False)

    def _respond(self, time_s: FloatArray, step: bool) -> FloatArray:
        """Return a response by poles where they are separate, else by the matrix exponential."""
        time = np.asarray(time_s, dtype=np.float64)
        late = time >= 0
        response, t = np.zeros(len(time)), time[late]
        if not len(t):
            return response
        terms, separate = self._terms()
        if self.sample_rate_hz is not None:
            from scipy.signal import sosfilt

            index = np.floor(t * self.sample_rate_hz + 1e-6).astype(np.int64)
            drive = np.ones(int(index.max()) + 1)
            drive[1:] = 1.0 if step else 0.0
            response[late] = sosfilt(self.sections(), drive)[index]
        elif not separate:
            response[late] = self._by_matrix(t, step)
        elif step:
            response[late] = self.direct + np.real(np.expm1(t[:, None] * self.poles) @ terms)
        else:
            response[late] = np.real(np.exp(t[:, None] * self.poles) @ (terms * self.poles))
        return response

    def _terms(self) -> tuple[ComplexArray, bool]:
        """Return `step_terms`; poles of samples, or with one at 0, count as coinciding."""
        return (self.poles, False) if self.sample_rate_hz or np.any(self.poles == 0) else self.step_terms()

    def step_between(self, begin_s: float, end_s: float, count: int) -> FloatArray:
        """Return the response (count,) to a unit step at evenly spaced times."""
        terms, separate = self._terms()
        if not separate:
            return self.step(np.linspace(begin_s, end_s, count))
        return self.static_gain + exponentials_between(self.poles, terms, begin_s, end_s, count)

    def _by_matrix(self, time_s: FloatArray, step: bool) -> FloatArray:
        """Return a continuous response at times (N,) from a chain of first-order systems."""
        from scipy.linalg import expm

        state, drive, output = self._chain()
        if step:  # the load is one more state, which stays at 1
            state = np.block([[state, drive[:, None]], [np.zeros((1, len(drive) + 1))]])
            drive, output = np.append(np.zeros(len(drive)), 1.0), np.append(output, self.direct)
        steps = np.diff(time_s)
        if len(steps) < 2 or np.ptp(steps) > 1e-9 * np.max(np.abs(steps)):
            return np.asarray((expm(time_s[:, None, None] * state) @ drive @ output).real)
        now, onward = expm(time_s[0] * state) @ drive, expm(np.mean(steps) * state)
        states = np.empty((len(time_s), len(now)), dtype=np.complex128)
        for row in range(len(states)):
            states[row] = now
            now = onward @ now
        return np.asarray((states @ output).real)

    def _chain(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return state (P, P), drive (P,) and output (P,) of first-order factors in series."""
        count = len(self.poles)
        state = np.diag(self.poles).astype(np.complex128)
        drive, output = np.zeros((2, count), dtype=np.complex128)
        through, passing = np.zeros(count, dtype=np.complex128), 1.0
        for i, pole in enumerate(self.poles):
            state[i, :i], drive[i] = through[:i], passing
            if i < len(self.zeros):
                through[i] = pole - self.zeros[i]
            else:
                through[:] = 0.0
                through[i], passing = 1.0, 0.0
        output[:] = self.gain * through
        return state, drive, output

    def sampled(self, rate_hz: float, method: Conversion = "zoh") -> LinearSystem:
        """Return the system of samples at `rate_hz` equivalent to this continuous one.

        `zoh`: the same response to a load that is constant between samples, poles exp(p/fs). `tustin`: s = c (z - 1)/(z
        + 1), c = 2 fs.
        """
        if self.sample_rate_hz is not None:
            raise ValueError(f"system: expected a continuous system, found samples at {self.sample_rate_hz} Hz")
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: expected a positive number, found {rate_hz}")
        if method == "tustin":
            from scipy.signal import bilinear_zpk

            zeros, poles, gain = bilinear_zpk(self.zeros, self.poles, self.gain, rate_hz)
            return LinearSystem(zeros, poles, float(gain), rate_hz)
        z, residues = np.exp(self.poles / rate_hz), self._hold_residues() * hold_factor(self.poles, rate_hz)
        return LinearSystem.from_residues(z, residues, self.direct, rate_hz)

    def continuous(self, method: Conversion = "tustin") -> LinearSystem:
        """Return the continuous equivalent of a sampled system, the inverse of `sampled`."""
        rate = self.sample_rate_hz
        if rate is None:
            raise ValueError("sample_rate_hz: expected a sampled system, found a continuous one")
        zeros, poles = self.zeros, self.poles
        left = zeros[zeros != -1]  # those at z = -1 go to infinity
        if method == "tustin":
            if np.any(poles == -1):
                raise ValueError("poles: expected no pole at z = -1 for the Tustin conversion, found one")
            c, far = 2.0 * rate, len(poles) - len(zeros)
            moved = np.concatenate([c * (left - 1) / (left + 1), np.full(far, c + 0j)])
            factor = np.prod(left + 1) * (2 * c) ** (len(zeros) - len(left)) * (-1.0) ** far / np.prod(poles + 1)
            return LinearSystem(moved, c * (poles - 1) / (poles + 1), float(np.real(self.gain * factor)))
        p = logarithms(poles, rate)
        return LinearSystem.from_residues(p, self._hold_residues() / hold_factor(p, rate), self.direct)

    def _hold_residues(self) -> ComplexArray:
        """Return residues of different poles, as the zoh conversion needs."""
        parts = self.residues()
        if not np.all(np.isfinite(parts)):
            expected = "separate poles for the zoh conversion"
            raise ValueError(f"poles: expected {expected}, found some that coincide; use tustin")
        return parts

    def times(self, other: LinearSystem) -> LinearSystem:
        """Return the product of two systems without cancellation."""
        if self.sample_rate_hz != other.sample_rate_hz:
            raise ValueError(
                f"other: expected a system at {self.sample_rate_hz}, found one at {other.sample_rate_hz} Hz"
            )
        zeros, poles = np.concatenate([self.zeros, other.zeros]), np.concatenate([self.poles, other.poles])
        return LinearSystem(zeros, poles, self.gain * other.gain, self.sample_rate_hz)


# Roots: conjugate pairs, and conversion between s and z.


def pair_conjugates(roots: ComplexArray, name: str) -> ComplexArray:
    """Return roots (N,) with exact conjugate pairs by size, then real ones; refuse lone ones."""
    scale = 1e-9 * np.abs(roots)
    above = roots[roots.imag > scale]
    below = roots[roots.imag < -scale]
    real = roots[np.abs(roots.imag) <= scale].real
    left = list(below.conj())
    for root in above:
        near = int(np.argmin(np.abs(np.array(left) - root))) if left else -1
        if near < 0 or abs(left[near] - root) > 1e-6 * abs(root):
            raise ValueError(f"{name}: expected conjugate pairs, found {root} without its conjugate")
        left.pop(near)
    if left:
        raise ValueError(f"{name}: expected conjugate pairs, found {left[0].conjugate()} without its conjugate")
    above = above[np.argsort(np.abs(above), kind="stable")]
    return np.concatenate([np.stack([above, above.conj()], axis=1).ravel(), np.sort(real) + 0j])


def hold_factor(poles: ComplexArray, rate_hz: float) -> ComplexArray:
    """Return the factor of residues by a hold, (exp(p/fs) - 1)/p."""
    factor = np.expm1(poles / rate_hz) / np.where(poles == 0, 1.0, poles)
    return np.where(poles == 0, 1 / rate_hz, factor)


def logarithms(z: ComplexArray, rate_hz: float) -> ComplexArray:
    """Return ln(z)·fs; a z that no real continuous system has is refused."""
    alone = z[(z.imag == 0) & (z.real <= 0)]
    if len(alone):
        raise ValueError(
            f"system: expected no real pole or zero at or below z = 0, found {alone[0].real:.6g}. It changes its sign "
            "with every sample, which no continuous system does; use tustin"
        )
    return np.asarray(np.log(z) * rate_hz)


# A system as a sum of modes, as fitted to a record, with its covariance.


def modal_poles(omega: FloatArray, damping_ratio: FloatArray, rate: FloatArray) -> ComplexArray:
    """Return the upper poles (…, M) of modes, then -`rate` (…, Q), in rad/s."""
    upper = omega * (-damping_ratio + 1j * np.sqrt(1 - damping_ratio**2))
    return np.concatenate([upper, -rate + 0j], axis=-1)


@dataclass(frozen=True, repr=False)
class ModalModel(Arrays, shapes="frequency_hz M; damping_ratio M; residue M; real_hz Q; real_residue Q"):
    """Sum of modes with covariance: output over load.

    H(s) = Σ_m [r_m/(s - p_m) + r̄_m/(s - p̄_m)] + Σ_q r_q/(s - p_q). Oscillating modes m have p = -ζω + jω√(1 - ζ²),
    real poles q have p = -2π·`real_hz`. ζ < 1; a negative ζ or `real_hz` is an unstable model.

    Attributes
    ----------
    frequency_hz : (M,), ω/2π in Hz.
    damping_ratio : (M,), ζ.
    residue : (M,), complex, in output unit per load unit and second.
    real_hz, real_residue : (Q,), of the real poles.
    covariance : (P, P), P = 4M + 2Q, of `vector`, None where unknown.
    """

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    residue: ComplexArray
    real_hz: FloatArray
    real_residue: FloatArray
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (len(self.vector),) * 2)
        if np.any(np.abs(self.damping_ratio) >= 1.0):
            raise ValueError(
                f"damping_ratio: expected below 1, found {self.damping_ratio.tolist()}; use two real poles"
            )

    @property
    def vector(self) -> FloatArray:
        """All parameters (P,) in the order of `covariance`."""
        parts = (self.frequency_hz, self.damping_ratio, self.residue.real, self.residue.imag, self.real_hz)
        return np.concatenate([*parts, self.real_residue])

    def with_vector(self, vector: FloatArray) -> ModalModel:
        """Return the model of another vector (P,), with the same covariance."""
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        f, z, re, im, hz, r = np.split(np.asarray(vector), np.cumsum([modes] * 4 + [reals]))
        return replace(self, frequency_hz=f, damping_ratio=z, residue=re + 1j * im, real_hz=hz, real_residue=r)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters with the number of mode or real pole."""
        modes = ("frequency_hz", "damping_ratio", "residue_re", "residue_im")
        of_modes = [f"{name}_{m + 1}" for name in modes for m in range(len(self.frequency_hz))]
        of_reals = [f"{name}_{q + 1}" for name in ("real_hz", "real_residue") for q in range(len(self.real_hz))]
        return (*of_modes, *of_reals)

    @property
    def poles(self) -> ComplexArray:
        """Poles in rad/s: the upper ones of the modes (M,), then the real ones (Q,)."""
        return modal_poles(2 * np.pi * self.frequency_hz, self.damping_ratio, 2 * np.pi * self.real_hz)

    @property
    def terms(self) -> tuple[ComplexArray, ComplexArray]:
        """Poles and residues (2M + Q,) of all partial fractions, including conjugates."""
        upper, real = np.split(self.poles, [len(self.frequency_hz)])
        residues = np.concatenate([self.residue, self.residue.conj(), self.real_residue + 0j])
        return np.concatenate([upper, upper.conj(), real]), residues

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return H (K,) at frequencies (K,) in Hz."""
        poles, residues = self.terms
        return np.asarray((residues / (2j * np.pi * np.asarray(frequency_hz)[:, None] - poles)).sum(axis=1))

    @property
    def static_gain(self) -> float:
        """H(0), the static sensitivity of the model."""
        return float(self.response(np.zeros(1))[0].real)

    def step(self, time_s: FloatArray) -> FloatArray:
        """Return the response (N,) to a unit step: Σ r/p·(exp(pt) - 1)."""
        t = np.maximum(np.asarray(time_s, dtype=np.float64), 0.0)[:, None]
        return np.real(np.expm1(self.poles * t) @ (self._doubled / self.poles))

    def impulse(self, time_s: FloatArray) -> FloatArray:
        """Return the response (N,) to a unit impulse: Σ r·exp(pt)."""
        time = np.asarray(time_s, dtype=np.float64)
        t = np.maximum(time, 0.0)[:, None]
        return np.asarray(np.real(np.exp(self.poles * t) @ self._doubled) * (time >= 0))

    @property
    def _doubled(self) -> ComplexArray:
        """Residues of `poles`, doubled for modes to include their conjugates."""
        return np.concatenate([2.0 * self.residue, self.real_residue + 0j])

    @property
    def system(self) -> LinearSystem:
        """The model as zeros, poles and gain."""
        return LinearSystem.from_residues(*self.terms)

    def jacobian(
        self, function: Callable[[ModalModel], FloatArray], step: float = 1e-2
    ) -> tuple[FloatArray, FloatArray]:
        """Return a function's values (Q,) and their derivatives (Q, P) by central differences.

        `step`: shift of a parameter in standard uncertainties; at most 1 % of a real pole, and half way to ζ = 1.
        """
        moves, modes = step * np.sqrt(np.maximum(np.diag(self._require_covariance()), 0.0)), len(self.damping_ratio)
        moves[modes : 2 * modes] = np.minimum(moves[modes : 2 * modes], 0.5 * (1.0 - np.abs(self.damping_ratio)))
        reals = slice(4 * len(self.frequency_hz), 4 * len(self.frequency_hz) + len(self.real_hz))
        moves[reals] = np.minimum(moves[reals], 0.01 * np.abs(self.real_hz))
        return function(self), derivatives(lambda move: function(self.with_vector(self.vector + move)), moves)

    def propagate(
        self, function: Callable[[ModalModel], FloatArray], step: float = 1e-2
    ) -> tuple[FloatArray, FloatArray]:
        """Return a function's values (Q,) and their covariance (Q, Q) by its `jacobian`."""
        value, slope = self.jacobian(function, step)
        return value, np.asarray(slope @ self._require_covariance() @ slope.T)

    def with_move(self, move: FloatArray) -> ModalModel:
        """Return the model with its parameters shifted by `move` (P,).

        The shift is of first order, and linear in `to_coordinates`: smoothness and static gain stay constant for large
        shifts. Frequencies and lags keep their sign and at least `MIN_LAG` of their size.
        """
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        frame, coordinates, slope = self._linear_coordinates
        by = slope @ move
        by[np.abs(by) < 1e-9 * coordinate_sizes(coordinates, reals)] = 0.0  # rounding, which would make a far zero
        far = coordinates + by
        signed = np.r_[:modes, 2 * modes : 2 * modes + reals]
        far[signed] = coordinates[signed] * np.maximum(far[signed] / coordinates[signed], MIN_LAG)
        return self.with_vector(from_coordinates(far, modes, reals, frame))

    @cached_property
    def _linear_coordinates(self) -> tuple[CoordinateFrame, FloatArray, FloatArray]:
        """Frame, `to_coordinates` (2P,) and their derivatives (2P, P) by the parameters."""
        frame = frame_of(self)
        return frame, *self.jacobian(lambda at: to_coordinates(at, frame))

    def altered(self, frequency: float = 0.0, damping_ratio: float = 0.0, gain: float = 0.0) -> ModalModel:
        """Return the model with relative changes of all frequencies, damping ratios, and the gain.

        Modes and zeros become H(s/(1 + `frequency`)), as with uniformly stiffer springs; their odd powers of s grow by
        `damping_ratio`. Real poles, those of the amplifier, and the static gain are constant unless `gain` is given.
        """
        modes, reals, frame = len(self.frequency_hz), len(self.real_hz), CoordinateFrame(scale_of(self))
        powers = np.arange(2 * modes + reals)
        numerator = (1.0 + gain) * (1.0 + frequency) ** -powers.astype(np.float64)
        numerator *= np.where(powers % 2 == 1, 1.0 + damping_ratio, 1.0)
        poles = np.repeat([1.0 + frequency, 1.0 + damping_ratio, 1.0], [modes, modes, reals])
        other = to_coordinates(self, frame) * np.concatenate([poles, numerator])
        return self.with_vector(from_coordinates(other, modes, reals, frame))

    def _require_covariance(self) -> FloatArray:
        """Return the covariance, or raise `ValueError`."""
        if self.covariance is None:
            raise ValueError("covariance: expected the covariance of the parameters, found none")
        return self.covariance


def even_exponentials(rates: ComplexArray, begin_s: float, step_s: float, count: int) -> tuple[ComplexArray, ...]:
    """Return factors (P, m) whose products are evenly spaced exponentials.

    exp(rate·(begin + kΔ)) = coarse[:, k // m]·fine[:, k % m] for k below `count`: 2√count exponentials per rate.
    """
    size = int(np.sqrt(count - 1)) + 1
    steps, p = np.arange(size), rates[:, None]
    return np.exp(p * (size * step_s * steps)), np.exp(p * (begin_s + step_s * steps))


def exponentials_between(
    rates: ComplexArray, weights: ComplexArray, begin_s: float, end_s: float, count: int
) -> FloatArray:
    """Return Re Σ weight·exp(rate·t) (count,) at evenly spaced times."""
    coarse, fine = even_exponentials(rates, begin_s, (end_s - begin_s) / (count - 1), count)
    return np.asarray(((coarse.T * weights) @ fine).real.ravel()[:count])


# Coordinates of models for means and large shifts: well determined properties are linear in them.


class CoordinateFrame(NamedTuple):
    """Frequency `scale` ω0 in rad/s, and numbers of modes that zeros nearly cancel."""

    scale: float
    cancelled: tuple[int, ...] = ()

    def cancelling(self, frequency_hz: FloatArray, damping_ratio: FloatArray) -> FloatArray:
        """Return Π(1 + 2ζs/ω + s²/ω²) of these modes by rising powers of s/ω0."""
        product = np.ones(1)
        for mode in self.cancelled:
            ratio = self.scale / (2.0 * np.pi * frequency_hz[mode])
            product = np.convolve(product, [1.0, 2.0 * damping_ratio[mode] * ratio, ratio**2])
        return product


def frame_of(model: ModalModel) -> CoordinateFrame:
    """Return the frame of a model, with as many cancelled modes as it has zeros."""
    plain, modes = CoordinateFrame(scale_of(model)), len(model.frequency_hz)
    numerator = np.abs(to_coordinates(model, plain)[len(model.terms[0]) :])
    highest = int(np.flatnonzero(numerator > 1e-9 * numerator.max(initial=0.0)).max(initial=0))
    by_size = np.argsort(np.abs(model.residue / model.poles[:modes]))
    return plain._replace(cancelled=tuple(by_size[: max(0, min(modes - 1, highest // 2))].tolist()))


def to_coordinates(model: ModalModel, frame: CoordinateFrame) -> FloatArray:
    """Return smooth coordinates (2P,) of a model, P = 2M + Q.

    They are [f_n (M), ζ (M), 1/real_hz² (Q), n_0 … n_{P-1}]. H(s) = Σ n_k (s/ω0)^k/Π(1 - s/p), ω0 = `frame.scale` in
    rad/s; n_0 is the static gain. The other n_k are less n_0 times the numerator that cancels the modes
    `frame.cancelled`: zeros then move with the poles that they nearly cancel. A smooth start has zero for the highest
    n_k. A record determines the square of a lag, which changes the gain, better than the lag, which delays.
    """
    (poles, residues), scale = model.terms, frame.scale
    parts = [r * np.poly(np.delete(poles, index) / scale)[::-1] / scale for index, r in enumerate(residues)]
    numerator = (np.sum(parts, axis=0) / np.prod(-poles / scale)).real
    near = frame.cancelling(model.frequency_hz, model.damping_ratio)
    numerator[1 : len(near)] -= numerator[0] * near[1:]
    squares = np.sign(model.real_hz) / model.real_hz**2
    return np.concatenate([model.frequency_hz, model.damping_ratio, squares, numerator])


def from_coordinates(coordinates: FloatArray, modes: int, reals: int, frame: CoordinateFrame) -> FloatArray:
    """Return the vector (2P,) of a `ModalModel` from `to_coordinates`, with |ζ| < 1."""
    order, scale = 2 * modes + reals, frame.scale
    frequency, damping, squares, above = np.split(coordinates, [modes, 2 * modes, order])
    damping = np.clip(damping, -MAX_DAMPING, MAX_DAMPING)
    near, numerator = frame.cancelling(frequency, damping), above.copy()
    numerator[1 : len(near)] += numerator[0] * near[1:]
    real = np.sign(squares) / np.sqrt(np.abs(squares))
    blank = ModalModel(frequency, damping, np.zeros(modes, dtype=np.complex128), real, np.zeros(reals))
    unscaled, _ = blank.terms
    poles, real_hz = unscaled / scale, -unscaled[2 * modes :].real / (2 * np.pi)
    # residues over the scale of Σ n_k x^k/Π(1 - x/p)
    retained = [*range(modes), *range(2 * modes, order)]
    top = -poles * np.polyval(numerator[::-1], poles)
    residues = scale * np.array(
        [top[index] / np.prod(1.0 - poles[index] / np.delete(poles, index)) for index in retained]
    )
    of_modes, of_reals = np.split(residues.astype(np.complex128), [modes])
    return np.concatenate([frequency, damping, of_modes.real, of_modes.imag, real_hz, of_reals.real])


def coordinate_sizes(coordinates: FloatArray, reals: int) -> FloatArray:
    """Return the magnitudes of coordinates (2P,); of numerator and lags the largest."""
    half = len(coordinates) // 2
    size: FloatArray = np.abs(coordinates)
    size[half:] = size[half:].max()
    lags = slice(half - reals, half)
    size[lags] = size[lags].max(initial=0.0)
    return size


def scale_of(model: ModalModel) -> float:
    """Return the geometric mean of a model's poles in rad/s."""
    return float(np.exp(np.mean(np.log(np.abs(model.terms[0])))))
