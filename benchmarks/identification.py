"""Stiffness, damping and internal mass from simulated transfer functions with every error drawn: errors and coverage.

    python benchmarks/identification.py [--trials 4000] [--seed 1]

Truth is written out here in closed form, independent of the models that are fitted. Drawn in every trial: the noise of
every line, what the load masses are off by, scale and delay of every accelerometer, the clock; of the pitching load the
centre of mass and the moment of inertia too. Prints the rows that docs/performance.md summarises.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shaker.identification.measured_curves import (
    CurveError,
    InertiaError,
    MeasuredSensitivity,
    MeasuredTransfer,
    Placement,
)
from shaker.identification.sensitivity import SensitivityComparison, SpringPrior, fit_sensitivity
from shaker.identification.structure_fit import Identification, identify
from shaker.identification.structures import SpringSuspension
from shaker.sine.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

AXIAL = {"stiffness_z": 4.5e8, "damping_z": 900.0, "internal_mass": 0.769}
PITCH = {"stiffness_x": 7.0e8, "stiffness_ry": 1.07e6, "damping_x": 2500.0, "damping_ry": 4.0, "internal_mass": 0.904}
SPREAD = {"stiffness": 0.01, "damping": 0.2, "internal": 0.05}  # of the truth from trial to trial, largest, relative
LOADS_KG = (4.236, 8.798)
PITCHING = ((4.236, 0.012, 0.0182), (6.962, -0.002, 0.0118))  # kg, m, kg·m²
TOPS_M = (0.06, -0.03)
SIX_TOPS = (  # m, axis
    ((0.05, 0.0, 0.06), 1),
    ((0.05, 0.0, 0.06), 2),
    ((-0.05, 0.02, 0.06), 2),
    ((0.0, 0.05, -0.03), 0),
    ((0.0, 0.05, 0.06), 0),
    ((-0.05, 0.02, -0.03), 1),
)
SIX = (  # kg, m, kg·m²
    (4.236, (0.002, -0.003, 0.012), (0.018, 0.017, 0.02)),
    (6.962, (-0.003, 0.001, -0.004), (0.012, 0.014, 0.016)),
)
PAPER_HZ = 0.78125
NOISE = 1e-3  # of a line of 0.78125 Hz, in parts of the base's motion
U_MASS, U_SCALE, U_DELAY, U_CLOCK, U_HEIGHT, U_INERTIA = 3e-4, 2e-3, 0.2e-6, 1e-6, 5e-5, 2e-5
STEPS_HZ = 53.7 * np.array([1, 2, 3, 5, 7, 9, 11, 13, 14, 15, 17, 19])
S_0, LAG_S, U_S, U_RATIO = 2.0e-7, 50e-6, 3e-4, 3e-4
COVERAGE_K = 1.96
Make = Callable[[np.random.Generator, float], tuple[list[MeasuredTransfer], dict[str, float]]]
Case = tuple[str, int, Make, float, SpringSuspension, dict[str, tuple[float, float]]]


@dataclass(frozen=True)
class Drawn:
    """What a measurement is off by: scale and delay (s) of base and tops, relative rate of the clock."""

    scale: FloatArray
    delay: FloatArray
    clock: float


def drawn(rng: np.random.Generator, tops: int) -> Drawn:
    """Return the errors of instruments that are the same in all recordings of a trial."""
    scale, delay = U_SCALE * rng.standard_normal(1 + tops), U_DELAY * rng.standard_normal(1 + tops)
    return Drawn(scale, delay, U_CLOCK * float(rng.standard_normal()))


def curve(
    rng: np.random.Generator,
    name: str,
    truth: Callable[[FloatArray], ComplexArray],
    frequency_hz: FloatArray,
    errors: Drawn,
    **load_facts: object,
) -> MeasuredTransfer:
    """Return tops over base as measured: `truth` (K, C) at the true frequencies, with errors and noise."""
    spacing = float(np.diff(frequency_hz).min())
    value = truth(frequency_hz * (1.0 + errors.clock))
    count = value.shape[1]
    turn = np.asarray(-2j * np.pi * frequency_hz[:, None], dtype=np.complex128)
    off = errors.scale[1:] - errors.scale[0] + turn * (errors.delay[1:] - errors.delay[0])
    sigma = NOISE * np.sqrt(PAPER_HZ / spacing * (1.0 + np.abs(value) ** 2))
    random = sigma * (rng.standard_normal(value.shape) + 1j * rng.standard_normal(value.shape))
    variance = np.concatenate([sigma, sigma], axis=1) ** 2
    names = tuple(f"top {number}" for number in range(1, count + 1))
    return MeasuredTransfer(
        name=name,
        ratio=Phasors(
            frequency_hz=frequency_hz,
            value=value * np.exp(off) + random,
            covariance=variance[:, :, None] * np.eye(2 * count),
            channels=names,
            unit=("1",) * count,
            dof=np.full(len(frequency_hz), np.inf),
        ),
        errors=tuple(_instrument_errors(names, turn)),
        u_clock=U_CLOCK,
        **load_facts,  # type: ignore[arg-type]
    )


def _instrument_errors(names: Sequence[str], turn: ComplexArray) -> Iterator[CurveError]:
    """Yield scale and delay of base and tops as named errors."""
    count, lines = len(names), len(turn)
    for number, name in enumerate(("base", *names)):
        share = -np.ones(count) if number == 0 else np.eye(count)[number - 1]
        yield CurveError(f"{name}: scale", np.tile(U_SCALE * share, (lines, 1)).astype(np.complex128))
        yield CurveError(f"{name}: delay", U_DELAY * turn * share)


def near(resonances_hz: Sequence[float] | FloatArray, half_width: float, spacing_hz: float) -> FloatArray:
    """Return the lines of a grid from below the first to above the last resonance, relative `half_width`."""
    low, high = min(resonances_hz) * (1.0 - half_width), max(resonances_hz) * (1.0 + half_width)
    return np.asarray(spacing_hz * np.arange(np.ceil(low / spacing_hz), np.floor(high / spacing_hz) + 1.0))


def varied(rng: np.random.Generator, nominal: dict[str, float]) -> dict[str, float]:
    """Return the truth of one trial: resonances stand anywhere between the lines of a grid."""
    return {
        name: value * (1.0 + SPREAD[name.partition("_")[0]] * float(rng.uniform(-1.0, 1.0)))
        for name, value in nominal.items()
    }


def axial(rng: np.random.Generator, spacing_hz: float) -> tuple[list[MeasuredTransfer], dict[str, float]]:
    """Return recordings of two loads on the axial spring, H = (k + bs)/((m + m_i) s² + bs + k), and the truth."""
    true, errors, records = varied(rng, AXIAL), drawn(rng, 1), []
    k, b, m_i = true.values()
    place = Placement(np.array([0.0, 0.0, 0.05]), np.array([0.0, 0.0, 1.0]))
    for number, stated in enumerate(LOADS_KG):
        mass = stated + U_MASS * float(rng.standard_normal()) + m_i

        def ratio(frequency_hz: FloatArray, mass: float = mass) -> ComplexArray:
            s = 2j * np.pi * frequency_hz[:, None]
            return np.asarray((k + b * s) / (mass * s * s + b * s + k))

        lines = near([np.sqrt(k / mass) / (2.0 * np.pi)], 0.05, spacing_hz)
        facts = {
            "tops": (place,),
            "base": place,
            "drive": np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
            "mass_matrix": np.diag([stated] * 3 + [0.01] * 3),
            "inertia_errors": (InertiaError(f"mass of load {number}", np.diag([U_MASS] * 3 + [0.0] * 3)),),
        }
        records.append(curve(rng, f"load {number}", ratio, lines, errors, **facts))
    return records, true


def pitching(rng: np.random.Generator, spacing_hz: float) -> tuple[list[MeasuredTransfer], dict[str, float]]:
    """Return recordings of two loads that shift along x and pitch about y, and the truth.

    Newton and Euler about the sensor origin, with x'' = X(s) s² the motion of the origin, θ the pitch, h the height of
    the centre of mass: (m + m_i) x'' + m h θ'' = -(k_x + b_x s)(x - x_base), m h x'' + J θ'' = -(k_θ + b_θ s) θ, solved
    by Cramer's rule.
    """
    true, errors, records = varied(rng, PITCH), drawn(rng, len(TOPS_M)), []
    k_x, k_ry, b_x, b_ry, m_i = true.values()
    axis = np.array([1.0, 0.0, 0.0])
    for number, (mass, height, inertia) in enumerate(PITCHING):
        off = np.array([U_MASS, U_HEIGHT, U_INERTIA]) * rng.standard_normal(3)
        m, h, j = np.array([mass, height, inertia]) + off
        whole, coupling, turning = m + m_i, m * h, j + m * h * h
        resonances = _two_resonances(k_x, k_ry, whole, coupling, turning)

        def ratio(
            frequency_hz: FloatArray, whole: float = whole, coupling: float = coupling, turning: float = turning
        ) -> ComplexArray:
            s = 2j * np.pi * frequency_hz
            shift, pitch = whole * s * s + b_x * s + k_x, turning * s * s + b_ry * s + k_ry
            divisor = shift * pitch - (coupling * s * s) ** 2
            x = (k_x + b_x * s) * pitch / divisor
            theta = -coupling * s * s * (k_x + b_x * s) / divisor
            return np.stack([x + z * theta for z in TOPS_M], axis=1)

        facts = {
            "tops": tuple(Placement(np.array([0.05, 0.0, z]), axis) for z in TOPS_M),
            "base": Placement(np.array([-0.12, 0.0, 0.0]), axis),
            "drive": np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
            "mass_matrix": _rigid(mass, height, inertia),
            "inertia_errors": _load_errors(number, mass, height, inertia),
        }
        records.append(curve(rng, f"load {number}", ratio, near(resonances, 0.1, spacing_hz), errors, **facts))
    return records, true


def _two_resonances(k_x: float, k_ry: float, whole: float, coupling: float, turning: float) -> FloatArray:
    """Return the undamped resonances (Hz) of the pitching load, the roots of its characteristic polynomial in ω²."""
    squares = np.roots([whole * turning - coupling**2, -(whole * k_ry + turning * k_x), k_x * k_ry])
    return np.asarray(np.sqrt(np.sort(squares.real)) / (2.0 * np.pi))


def _rigid(mass: float, height: float, inertia: float) -> FloatArray:
    """Return the mass matrix (6, 6) of a body whose centre of mass lies on the z axis."""
    matrix = np.diag([mass] * 3 + [inertia + mass * height**2] * 2 + [inertia])
    matrix[0, 4] = matrix[4, 0] = mass * height
    matrix[1, 3] = matrix[3, 1] = -mass * height
    return matrix


def _load_errors(number: int, mass: float, height: float, inertia: float) -> tuple[InertiaError, ...]:
    """Return what is uncertain of a load: mass, height of its centre of mass, moment of inertia."""
    steps = {"mass": (U_MASS, 0.0, 0.0), "height": (0.0, U_HEIGHT, 0.0), "inertia": (0.0, 0.0, U_INERTIA)}
    stated = np.array([mass, height, inertia])
    return tuple(
        InertiaError(
            f"{name} of load {number}", 0.5 * (_rigid(*(stated + np.array(step))) - _rigid(*(stated - np.array(step))))
        )
        for name, step in steps.items()
    )


def six_components(rng: np.random.Generator) -> tuple[list[MeasuredTransfer], FloatArray]:
    """Return two loads, each moved along two directions, on springs of all six components, with the true parameters."""
    inertia = np.array([5.2, 5.2, 5.2, 0.02, 0.02, 0.024])
    omega = 2.0 * np.pi * 400.0 * 1.4 ** np.arange(6)
    springs, dampers, internal = omega**2 * inertia, 0.02 * omega * inertia, np.array([0.9, 2e-3, 2e-3, 3e-3])
    moving, frequency_hz, records = np.diag([*internal[[0, 0, 0]], *internal[1:]]), np.linspace(250.0, 3200.0, 300), []
    tops = tuple(Placement(np.array(point), np.eye(3)[axis]) for point, axis in SIX_TOPS)
    for mass, centre, about in SIX:
        cross = np.cross(np.eye(3), centre)
        load = np.block([[mass * np.eye(3), mass * cross.T], [mass * cross, np.diag(about) + mass * cross @ cross.T]])
        for along in (np.array([1.0, 0.3, 0.2]), np.array([0.2, 0.4, 1.0])):
            drive = np.concatenate([along, np.zeros(3)])
            base = Placement(np.array([-0.12, 0.0, 0.0]), np.eye(3)[np.argmax(along)])

            def ratio(
                frequency_hz: FloatArray,
                whole: FloatArray = load + moving,
                forced: FloatArray = (load + moving) @ drive,
                drive: FloatArray = drive,
                base: Placement = base,
            ) -> ComplexArray:
                s = 2j * np.pi * frequency_hz[:, None, None]
                dynamic = s * s * whole + s * np.diag(dampers) + np.diag(springs)
                motion = drive - (s * s * np.linalg.solve(dynamic, forced[:, None]))[:, :, 0]
                return np.asarray(motion @ np.stack([top.row for top in tops]).T / float(base.row @ drive))

            facts = {"tops": tops, "base": base, "drive": drive, "mass_matrix": load}
            errors = Drawn(np.zeros(7), np.zeros(7), 0.0)
            measured = curve(rng, f"{mass} kg along {along}", ratio, frequency_hz, errors, **facts)
            records.append(replace(measured, errors=(), u_clock=0.0))
    return records, np.concatenate([springs, dampers, internal])


@dataclass
class Counted:
    """Relative errors and errors over u of every trial, by parameter."""

    relative: dict[str, list[float]]
    normalised: dict[str, list[float]]

    def add(self, found: Identification, true: dict[str, float]) -> None:
        """Count one trial."""
        for name, value in true.items():
            error = found.value(name) - value
            self.relative.setdefault(name, []).append(error / value)
            self.normalised.setdefault(name, []).append(error / found.u(name))

    def rows(self, case: str, bars: dict[str, float]) -> Iterator[str]:
        """Yield a Markdown row for every parameter."""
        for name, errors in self.relative.items():
            size = np.abs(errors)
            inside = 100.0 * np.mean(np.abs(self.normalised[name]) <= COVERAGE_K)
            bar = bars.get(name)
            met = "" if bar is None else f"{100.0 * bar:g} %: {100.0 * np.mean(size <= bar):.2f} %"
            yield (
                f"| {case} | {name} | {100 * np.median(size):.3g} % | {100 * np.quantile(size, 0.95):.3g} % "
                f"| {100 * size.max():.3g} % | {met} | {inside:.2f} % | {len(errors)} |"
            )


def fitted(
    rng: np.random.Generator,
    trials: int,
    make: Make,
    spacing_hz: float,
    structure: SpringSuspension,
    known: dict[str, tuple[float, float]],
) -> tuple[Counted, FloatArray]:
    """Return what fits found in so many trials, and what eq. 9 on the bin maxima misses (N, 3).

    That is the stiffness from either load with its mass known, and the internal mass from both, all relative.
    """
    counted, by_bin = Counted({}, {}), []
    for _ in range(trials):
        records, true = make(rng, spacing_hz)
        counted.add(identify(records, structure, stated_values=known), true)
        stiffness, m_i = true[next(iter(true))], true["internal_mass"]
        places = [int(np.argmax(np.abs(record.ratio.value[:, 0]))) for record in records]
        square = [
            (2.0 * np.pi * record.ratio.frequency_hz[place]) ** 2 for record, place in zip(records, places, strict=True)
        ]
        loads = [record.mass_matrix[0, 0] for record in records]
        pull = [s * (m + m_i) for s, m in zip(square, loads, strict=True)]
        internal = (square[1] * loads[1] - square[0] * loads[0]) / (square[0] - square[1])
        by_bin.append([pull[0] / stiffness - 1.0, pull[1] / stiffness - 1.0, internal / m_i - 1.0])
    return counted, np.array(by_bin)


def sensitivity(rng: np.random.Generator) -> tuple[MeasuredSensitivity, SpringPrior, float]:
    """Return S(f) = S₀ / ((1 + jωb/k)(1 + jωτ)) at the published frequencies, what a resonance says, and b/k."""
    true = varied(rng, AXIAL)
    k, b = true["stiffness_z"], true["damping_z"]
    s = np.asarray(2j * np.pi * STEPS_HZ, dtype=np.complex128)
    scale, delay = U_S * float(rng.standard_normal()), U_DELAY * float(rng.standard_normal())
    value = S_0 * np.exp(scale - s * delay) / ((1.0 + s * b / k) * (1.0 + s * LAG_S))
    sigma = U_RATIO * S_0
    value = value + sigma * (rng.standard_normal(len(s)) + 1j * rng.standard_normal(len(s)))
    errors = (
        CurveError("scale", np.full((len(s), 1), U_S, dtype=np.complex128)),
        CurveError("delay", -U_DELAY * s[:, None]),
    )
    covariance = np.tile(sigma**2 * np.eye(2), (len(s), 1, 1))
    measured = MeasuredSensitivity("Fz", "Fz", STEPS_HZ, value, covariance, "(V/V)/N", errors)
    u_k, u_b = 2e-4 * k, 0.005 * b
    prior = SpringPrior(k + u_k * float(rng.standard_normal()), u_k, b + u_b * float(rng.standard_normal()), u_b, 0.0)
    return measured, prior, b / k


def chain_rows(rng: np.random.Generator, trials: int) -> Iterator[str]:
    """Yield rows on the 50 µs lag beside the spring: found within U, other explanations refuted, contradiction told."""
    lags, springs, refuted, told, supported = [], [], [], [], []
    for _ in range(trials):
        measured, prior, spring_s = sensitivity(rng)
        found: SensitivityComparison = fit_sensitivity(measured, prior)
        lag = found["lag"]
        lags.append((lag.chain.lag_s - LAG_S) / lag.u("lag_s"))
        springs.append((lag.spring_time_s - spring_s) / lag.u("spring_time_s"))
        verdict = {fit.chain.kind: says for fit, says in zip(found.fits, found.verdict, strict=True)}
        supported.append(verdict["lag"] == "supported")
        refuted.append(all(verdict[kind] == "refuted" for kind in ("none", "delay")))
        told.append(found.damping is not None and found.damping.contradicts)
    for name, errors in (("lag of the chain, 50 µs", lags), ("b/k of the spring, 2 µs", springs)):
        yield f"| {name}, inside 95 % interval | {100 * np.mean(np.abs(errors) <= COVERAGE_K):.2f} % of {trials} |"
    yield f"| first-order lag supported | {100 * np.mean(supported):.2f} % |"
    yield f"| no chain and pure delay both refuted | {100 * np.mean(refuted):.2f} % |"
    yield f"| no chain: contradiction with the resonance's width told | {np.sum(told)} of {trials} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trials", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng, trials = np.random.default_rng(options.seed), options.trials
    bars = {"stiffness_z": 5e-4, "damping_z": 0.02, "internal_mass": 3e-3, "stiffness_x": 2e-3}
    cases: tuple[Case, ...] = (
        ("two loads, grid 0.78125 Hz", trials, axial, PAPER_HZ, SpringSuspension((2,)), {}),
        ("two loads, grid 0.1 Hz", trials // 10, axial, 0.1, SpringSuspension((2,)), {}),
        (
            "pitching, grid 0.78125 Hz",
            trials // 8,
            pitching,
            PAPER_HZ,
            SpringSuspension((0, 4)),
            {"internal_inertia_ry": (0.0, 0.0)},
        ),
    )
    print("| case | parameter | error, median | 95 % of trials | largest | within bar | in 95 % interval | trials |")
    print("|---|---|---|---|---|---|---|---|")
    bins = []
    for case, count, make, spacing, structure, known in cases:
        started = time.process_time()
        counted, by_bin = fitted(rng, count, make, spacing, structure, known)
        print("\n".join(counted.rows(case, bars)), flush=True)
        size = 100.0 * np.abs(by_bin)
        k, m_i = size[:, :2].ravel(), size[:, 2]
        time_ms = 1e3 * (time.process_time() - started) / count
        cells = (
            f"{np.median(k):.2g} % ({k.max():.2g} %) | {np.median(m_i):.2g} % ({m_i.max():.2g} %) | {time_ms:.0f} ms"
        )
        bins.append(f"| {case} | {cells} |")
    print(
        "\n| eq. 9 on the bin maxima: error, median (largest) | k, masses known | internal mass | CPU time of a fit |"
    )
    print("|---|---|---|---|")
    print("\n".join(bins))
    six, true = six_components(rng)
    started = time.process_time()
    found = identify(six, SpringSuspension(tuple(range(6))))
    time_s = time.process_time() - started
    off = np.abs([(found.value(name) - value) / found.u(name) for name, value in zip(found.names, true, strict=True)])
    print(f"\nsix free components, four recordings: {time_s:.1f} s of CPU time, largest error {off.max():.1f} u")
    print("\n| sensitivity at twelve frequencies | |")
    print("|---|---|")
    print("\n".join(chain_rows(rng, trials // 4)))


if __name__ == "__main__":
    main()
