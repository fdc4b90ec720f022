"""Coverage of the 6x6 matrix, of its cross-talk and of means over repeats, every systematic error drawn.

    python benchmarks/coverage_matrix.py [--trials 1000] [--seed 1]

Eight recordings (axial, off the axis, transverse; every one mounted anew) of a sensor with ±2 % cross-talk at rated
loads, at the level of loads and outputs (`simulated_drives`): scales, times, masses, centres of mass, inertia and
the pose of the instruments are common to the recordings that share them. Then: the same without systematic errors, in
truth and in what is stated; one recording of the eight with 1 % that nobody states; recordings on axis only; means over
four mountings of three recordings that scatter by 0.3 % and 0.1 %; means over two, three and six mountings. Some
eighteen minutes on one core.

And the sensor's element recording by recording: the uniaxial campaign of the preset `matrix` (lasers and accelerometer,
transverse motion of 1 to 2 %, cross-talk of 2 %), driven along x, y, z, Mx, My, Mz, after the phasors; the static
matrix differs from the true one by 0.1 % (cross-talk: of the rated output), and a spring-damper and a filter make the
course over frequency. Beside it what the bare ratio covers of that element.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from coverage_statistics import HEAD, Tally, row
from numpy.typing import NDArray
from scipy.stats import chi2
from simulated_drives import CAPACITY, DriveErrors, drive_setup, eight_setups, simulate_drives, true_matrix
from simulated_phasors import Channel, PhasorSetup, lines_at, simulate_phasors
from violations import without_heads

from fusion.campaign.excited_line import ExcitedLine
from fusion.campaign.matrix import cross_talk, fit_matrix
from fusion.campaign.matrix_solve import MissingExcitationError
from fusion.campaign.repeats import find_repeats
from fusion.estimation.coverage import coverage_factor
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, polar_elements
from fusion.instruments.channel import ChainUncertainty
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import Sensor
from fusion.sensitivity.analyse import analyse
from fusion.sensitivity.moving_body import make_moving_part
from fusion.simulate.sines import Run, recording_tables, runs, sensor_keys
from fusion.simulate.world import Draws, sensitivity, static_sensitivity
from shaker.labels import LOAD_COMPONENTS

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

MAIN = np.eye(6, dtype=np.bool_)


class Tallies:
    """Errors of the elements of matrices."""

    def __init__(self) -> None:
        self.elements = [Tally() for _ in range(36)]

    def add(self, value: ComplexArray, truth: ComplexArray, uncertainty: Uncertainty) -> None:
        """Take in one matrix."""
        errors, stated = (value - truth).ravel().tolist(), polar_elements(value.reshape(1, -1), uncertainty)[0]
        for tally, error, own in zip(self.elements, errors, stated, strict=True):
            tally.add(error, own)

    def chosen(self, mask: BoolArray) -> list[Tally]:
        """Return the elements of a mask (6, 6)."""
        return [tally for tally, wanted in zip(self.elements, mask.ravel(), strict=True) if wanted]

    def normalised(self) -> str:
        """Return the largest normalised error and the share below 2."""
        values = np.abs(np.concatenate([tally.normalised for tally in self.elements]))
        return f"largest {values.max():.2f} u; {100 * np.mean(values < 2.0):.1f} % below 2 u"


def eight_recordings(trials: int, rng: np.random.Generator) -> None:
    """Everything stated and drawn."""
    elements, shares, chi2 = Tallies(), Tallies(), []
    for _ in range(trials):
        truth = true_matrix(rng)
        fit = fit_matrix(simulate_drives(eight_setups(rng), truth, DriveErrors(rng)))
        elements.add(fit.value, truth, fit.uncertainty)
        talk = cross_talk(fit, CAPACITY.tolist())
        shares.add(talk.value, _cross_talk(truth), talk.uncertainty)
        chi2.append(fit.chi2 / fit.dof)
    for quantity, mask in (("main elements", MAIN), ("cross elements", ~MAIN)):
        print(row("eight recordings", quantity, elements.chosen(mask)))
    print(row("eight recordings", "cross-talk", shares.chosen(~MAIN)))
    print(f"\nAll elements: {elements.normalised()}; mean χ²/ν {np.mean(chi2):.3f}.\n")


def no_systematic_errors(trials: int, rng: np.random.Generator) -> None:
    """Noise only, in truth and as stated: errors at rated loads relative to the main element of the row."""
    worst = np.zeros((6, 6))
    for _ in range(trials):
        truth = true_matrix(rng)
        drives = simulate_drives(eight_setups(rng), truth, DriveErrors(rng, systematic=False))
        fit = fit_matrix([_noise_only(drive) for drive in drives])
        worst = np.maximum(worst, np.abs(fit.value - truth) * CAPACITY / (np.abs(np.diag(truth)) * CAPACITY)[:, None])
    print(
        f"Without systematic errors, {trials} times: main elements within {worst[MAIN].max():.2g}, cross elements "
        f"within {worst[~MAIN].max():.2g} of the main one at rated loads.\n"
    )


def one_disagrees(trials: int, rng: np.random.Generator) -> None:
    """One recording of nine reads 1 % too much."""
    elements, named, failed = Tallies(), 0, 0
    for trial in range(trials):
        truth = true_matrix(rng)
        setups = [*eight_setups(rng), drive_setup(rng, "9 z", "z", (0.0, -0.15, 0.08), "9")]
        wrong = trial % len(setups)
        setups[wrong] = replace(setups[wrong], step=0.01)
        fit = fit_matrix(simulate_drives(setups, truth, DriveErrors(rng)))
        failed += fit.discrepancy > 0.0
        named += fit.worst is not None and fit.worst.recording == setups[wrong].recording
        elements.add(fit.value, truth, fit.uncertainty)
    print(row("one of nine 1 % high", "all elements", elements.elements))
    print(f"\nNoticed {failed} times of {trials}, the right one named {named} times.\n")


def on_axis_only(trials: int, rng: np.random.Generator) -> None:
    """Recordings that differ in what they drive along three axes, but in no lever arm."""
    refused = 0
    for _ in range(trials):
        setups = [drive_setup(rng, f"{n}", axis, (0.0, 0.0, 0.05)) for n, axis in enumerate("xyzxyz")]
        for place, setup in enumerate(setups):
            pure = np.where(np.arange(6) == "xyz".index("xyzxyz"[place]), setup.acceleration, 0.0)
            setups[place] = replace(setup, acceleration=pure)
        try:
            fit_matrix(simulate_drives(setups, true_matrix(rng), DriveErrors(rng)))
        except MissingExcitationError as error:
            refused += 1
            told = str(error)
    print(f"Six dependent recordings refused {refused} times of {trials}: “{told}”.\n")


def repeats(trials: int, rng: np.random.Generator) -> None:
    """Four mountings of three recordings; the mean of the ratio along z."""
    tally, truth = Tally(), true_matrix(rng, 0.0)
    base = drive_setup(rng, "", "z", (0.0, 0.0, 0.08))
    for _ in range(trials):
        mounted = 3e-3 * rng.standard_normal(4)
        setups = [
            replace(base, recording=f"{m}-{n}", mounting=f"{m}", step=mounted[m] + 1e-3 * rng.standard_normal())
            for m in range(4)
            for n in range(3)
        ]
        (found,) = find_repeats(simulate_drives(setups, truth, DriveErrors(rng)))
        tally.add(complex(found.value[2] - truth[2, 2]), polar_elements(found.value[None], found.uncertainty)[0][2])
    print(row("four mountings of three recordings", "ratio Fz/Fz", [tally]))


FEW = (
    "| mountings (recordings) | scatter between mountings / noise | u shared: magnitude, phase | magnitude covered | "
    "phase covered | region covered | U / half-width: magnitude, phase | t / 1.96 |\n|---|---|---|---|---|---|---|---|"
)


def few_mountings(trials: int, rng: np.random.Generator) -> None:
    """Two, three and six mountings: magnitude and phase of the mean, each with a part that all share and is known."""
    print(FEW)
    for each in ((1, 1), (1, 1, 1), (1, 2, 3), (1, 1, 2, 2, 3, 3)):
        for mounted in (0.0, 3.0):
            for shared in ((0.0, 0.0), (0.0, 10.0), (10.0, 0.0), (0.5, 0.5)):
                size = max(mounted, 1.0) * np.array(shared)
                found = np.array([_mean_of_few(rng, each, mounted, size) for _ in range(trials)])
                errors, expanded, off = found[:, :2], found[:, 2:4], found[:, 4]
                held = 100.0 * np.mean(errors <= expanded, axis=0)
                wide = np.median(expanded, axis=0) / np.quantile(errors, 0.95, axis=0)
                # What Student's t with as many degrees of freedom cannot avoid: its median U over that of a known u.
                free = len(each) - 1.0
                t_over = coverage_factor(free) * np.sqrt(chi2.median(free) / free) / coverage_factor(np.inf)
                print(
                    f"| {len(each)} ({', '.join(map(str, each))}) | {mounted:g} | {shared[0]:g}, {shared[1]:g} | "
                    f"{held[0]:.1f} % | {held[1]:.1f} % | {100.0 * np.mean(off <= 1.0):.1f} % | "
                    f"{wide[0]:.2f}, {wide[1]:.2f} | {t_over:.2f} |"
                )
    print()


def _mean_of_few(rng: np.random.Generator, each: Sequence[int], mounted: float, shared: FloatArray) -> list[float]:
    """Errors and U of magnitude and phase of one mean, and how far out it lies, over the edge of its region.

    All sizes in the noise of a recording, 1e-4, which is stated.
    """
    noise, unit = 1e-4, np.eye(1, 6, 2)[0]

    def normal(size: float) -> complex:
        return size * noise * complex(*rng.standard_normal(2))

    effects = [np.concatenate([unit, 0.0 * unit]), np.concatenate([0.0 * unit, unit])]
    influences = tuple(
        Influence(name, name, 1.0, "1", noise * size * effect[None], "rig")
        for name, size, effect in zip(("scale", "delay"), shared, effects, strict=True)
    )
    of_load = Uncertainty((Contribution("noise", "A", np.zeros((1, 12, 12))),), influences)
    of_output = Uncertainty((Contribution("output noise", "A", noise**2 * np.eye(2)[None], np.array([50.0])),))
    same = 1.0 + complex(*(noise * shared * rng.standard_normal(2)))
    drives = []
    for m, count in enumerate(each):
        here = same + normal(mounted)
        for n in range(count):
            output, places = np.array([here + normal(1.0)]), (f"{m}-{n}", f"{m}", 100.0, 100.0, (0.0, 0.0, 1.0))
            drives.append(ExcitedLine(*places, unit + 0j, of_load, output, of_output, ("U",)))
    (found,) = find_repeats(drives)
    ((element,),) = polar_elements(found.value[None], found.uncertainty)
    assert element is not None
    error = np.array([element.re - 1.0, element.im])
    off = float(np.sqrt(error @ np.linalg.solve(element.region_matrix, error)))
    return [
        abs(element.magnitude - 1.0),
        abs(element.phase_rad),
        element.expanded_magnitude,
        element.expanded_phase_rad,
        off,
    ]


DRIVEN = (
    ("5-x", "Fx"), ("7-y", "Fy"), ("1-z", "Fz"), ("4-z-mass-+y", "Mx"), ("2-z-mass-+x", "My"), ("6-x-mass-+y", "Mz"),
    ("6-x-mass-+y", "Fx"), ("8-y-mass-+x", "Fy"),
)  # fmt: skip
"""Recordings of the preset `matrix`, and the element that each is evaluated for."""
ELEMENT_HEAD = (
    "| driven | f / Hz | ratio / element − 1 | ratio: U, covered | element: U, covered | U, times |\n"
    "|---|---|---|---|---|---|"
)


@dataclass
class ElementCounts:
    """Errors of the element and of the bare ratio as they are read as one, by recording and line, relative to it."""

    element: Tally
    ratio: Tally
    bias: list[complex]


def uniaxial_setup(run: Run, driven: int, stated: dict[str, float]) -> PhasorSetup:
    """Return what is stated of one recording that drives a load; `stated`: of the sensor beside its static matrix."""
    run = replace(run, preset=without_heads(run.preset))
    preset = run.preset
    static, _ = static_sensitivity(preset, Draws(1, False))
    motion = np.array(preset.acceleration)
    lines = lines_at(preset.fundamental_hz * np.array(preset.multiples), np.ones(len(preset.multiples)))
    channels: dict[bool, list[Channel]] = {True: [], False: []}
    velocity = np.abs(motion).max(axis=1) / (2 * np.pi * lines.frequency_hz)
    sizes = {"velocity": velocity, "acceleration": np.abs(motion).max(axis=1)}
    (daq,) = recording_tables(run)["daq"]
    for entry in daq["channel"]:
        output = entry["quantity"] == "output"
        if output or entry["quantity"] in sizes:
            known = ChannelEntry.model_validate({key: v for key, v in entry.items() if key != "response"})
            chain = ChainUncertainty(np.full(3, 1e-4), np.full(3, 1e-4)) if output else ChainUncertainty()
            size = 1e-4 * np.ones(3) if output else sizes[known.quantity]
            channels[output].append(Channel(known, 2e-5 * size, 300.0, chain))
    return PhasorSetup(
        lines=lines,
        acceleration=motion,
        pairs=(),
        channels=tuple(channels[False]),
        outputs=tuple(channels[True]),
        sensitivity=np.zeros((3, 6, 6), np.complex128),
        parts=tuple(
            make_moving_part(
                part.name, part.mass, part.centre_of_mass, np.diag(part.inertia),
                (part.mass_uncertainty, part.centre_of_mass_uncertainty, part.inertia_uncertainty),
            )
            for part in (preset.load, preset.internal, *preset.parts)
        ),
        gravity_mps2=tuple(9.8125 * np.array(preset.down)),
        sensor=Sensor.model_validate(sensor_keys(preset, static) | stated),
        direction=tuple(np.eye(6)[driven].tolist()),
        clock_uncertainty=1e-6,
    )  # fmt: skip


def uniaxial_truth(run: Run, rng: np.random.Generator, cross_change: float = 1e-3) -> ComplexArray:
    """Return a true matrix (K, 6, 6): the static one, changed by 0.1 % and by `cross_change` of the rated output."""
    preset = run.preset
    static, _ = static_sensitivity(preset, Draws(1, False))
    rated = np.array(preset.capacity)
    signal = np.diag(static) * rated
    change = rng.standard_normal((6, 6)) * cross_change * signal[:, None] / rated
    change[MAIN] = rng.standard_normal(6) * 1e-3 * np.diag(static)
    frequency = preset.fundamental_hz * np.array(preset.multiples)
    return sensitivity(frequency, static + change, np.array(preset.damping_s), preset.lag_s)


def count_elements(
    name: str, load: str, seeds: range, stated: dict[str, float], cross_change: float = 1e-3
) -> list[ElementCounts]:
    """Simulate and evaluate one recording of the campaign again and again; one count per line."""
    run, driven = next(run for run in runs("matrix") if run.preset.recording == name), LOAD_COMPONENTS.index(load)
    setup = uniaxial_setup(run, driven, stated)
    counts = [ElementCounts(Tally(), Tally(), []) for _ in run.preset.multiples]
    for seed in seeds:
        matrix = uniaxial_truth(run, np.random.default_rng([18, seed]), cross_change)
        known, _ = simulate_phasors(replace(setup, sensitivity=matrix), Draws(seed, True))
        found = analyse(known)
        assert found.sensitivity is not None
        for k, count in enumerate(counts):
            true = complex(matrix[k, driven, driven])
            for tally, result in ((count.element, found.element), (count.ratio, found.sensitivity)):
                if result is not None:
                    own = result.polar[k][result.elements.index((driven, driven))]
                    tally.add(complex(result.value[k, driven, driven] - true), own)
            count.bias.append(complex(found.sensitivity.value[k, driven, driven] / true - 1.0))
    return counts


def element_rows(name: str, load: str, trials: int, seed: int, stated: dict[str, float]) -> list[str]:
    """Return the rows of the table for one recording."""
    run = next(run for run in runs("matrix") if run.preset.recording == name)
    driven, rows = f"{load}{' with Mz' if name[0] in '68' and load != 'Mz' else ''}", []
    counts = count_elements(name, load, range(seed, seed + trials), stated)
    for count, hertz in zip(counts, run.nominal_hz, strict=True):
        (u_element, element), (u_ratio, ratio) = (
            (1.96 * float(np.median([one.u_magnitude / one.magnitude for one in tally.stated])), tally.covered.mean())
            for tally in (count.element, count.ratio)
        )
        cells = [driven, f"{hertz:g}", f"{100 * np.mean(count.bias).real:+.3f} %"]
        cells += [f"{100 * u:.3f} %, {100 * share:.1f} %" for u, share in ((u_ratio, ratio), (u_element, element))]
        rows.append("| " + " | ".join([*cells, f"{u_element / u_ratio:.2f}"]) + " |")
    return rows


def elements(trials: int, seed: int) -> None:
    """The uniaxial campaign recording by recording."""
    print(ELEMENT_HEAD)
    for name, load in DRIVEN:
        print("\n".join(element_rows(name, load, trials, seed, {"static_sensitivity_uncertainty": 1e-3})), flush=True)


def _noise_only(drive: ExcitedLine) -> ExcitedLine:
    """A drive of which only its noise is stated."""
    parts = (drive.load_uncertainty, drive.outputs_uncertainty)
    load, outputs = (Uncertainty(part.random) for part in parts)
    return replace(drive, load_uncertainty=load, outputs_uncertainty=outputs)


def _cross_talk(matrix: ComplexArray) -> ComplexArray:
    """True cross-talk at rated loads."""
    return np.asarray(matrix * CAPACITY / (np.diag(matrix) * CAPACITY)[:, None])


def main(arguments: Sequence[str] = ()) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    rng = np.random.default_rng(options.seed)
    print(HEAD)
    repeats(options.trials, rng)
    eight_recordings(options.trials, rng)
    no_systematic_errors(max(options.trials // 10, 1), rng)
    on_axis_only(max(options.trials // 10, 1), rng)
    print(HEAD)
    one_disagrees(max(options.trials // 5, 1), rng)
    few_mountings(options.trials, rng)
    elements(options.trials, options.seed)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
