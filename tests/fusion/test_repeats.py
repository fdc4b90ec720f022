"""Repeats and linearity: variance components against their formulae, what does not average away, what counts as one."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contracts import refused
from excited_line_factory import make_excited_line, uncertainty
from numpy.typing import NDArray
from scipy.stats import binom
from simulated_drives import CAPACITY, DriveErrors, drive_setup, eight_setups, simulate_drives, true_matrix
from violations import JITTER_S, Rig, preset_of

from fusion.base import Settings
from fusion.campaign.campaign_notices import ONE_MOUNTING, TWO_REPEATS
from fusion.campaign.curve import _slope, find_linearity
from fusion.campaign.excited_line import (
    DiskStore,
    ExcitedLine,
    excited_lines_of,
    group_by_frequency,
    join_lines,
    with_campaign_names,
    with_starts,
)
from fusion.campaign.repeats import (
    BETWEEN,
    PHASE_DIFFERENCES,
    RepeatMean,
    find_repeats,
    frequencies_text,
    group_excitations,
    mean_ratio,
    repeat_notices,
    split_covariance,
)
from fusion.estimation.coverage import coverage_factor
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, polar_elements
from fusion.phasors.timing import EdgeGrid
from fusion.recording.load import load_manifest
from fusion.sensitivity.ratio import StatedMatrix
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.sines import driven, rendered_run, write_run
from fusion.simulate.world import Draws, make_world

AnyArray = NDArray[Any]
LOAD = np.array([3.0, 1.0, 1000.0, 0.5, 0.1, 0.2])
NOISE = 1e-9 * LOAD


def recorded(value: complex, recording: str, mounting: str = "1", **changes: Any) -> ExcitedLine:
    """A drive of 1000 N along z with one output per newton, and a scale of load and outputs that the rig shares."""
    scale = changes.pop("scale", 1e-3)
    load = changes.pop("load", LOAD)
    outputs = np.array([value * load[2], 0.1 * value * load[2]])
    of_load = uncertainty(NOISE, [("laser: scale", "rig", scale * load)])
    return make_excited_line(
        load, outputs, of_load, uncertainty(NOISE[:2]), recording=recording, mounting=mounting, **changes
    )


def test_variance_components_are_those_of_an_unbalanced_analysis_of_variance():
    # The textbook formulae, with real numbers by hand: groups of three, two and one.
    groups = {"a": [1.002, 1.004, 1.003], "b": [0.998, 0.997], "c": [1.001]}
    drives = [recorded(v, f"{m}{n}", m) for m, values in groups.items() for n, v in enumerate(values)]
    (found,) = find_repeats(drives)
    everything = np.concatenate(list(groups.values()))
    relative = {m: np.array(v) / everything.mean() for m, v in groups.items()}
    within = sum(np.sum((v - v.mean()) ** 2) for v in relative.values()) / 3
    between = sum(len(v) * (v.mean() - 1.0) ** 2 for v in relative.values()) / 2
    each = (6 - (9 + 4 + 1) / 6) / 2
    assert found.within_dof == 3
    assert found.between_dof == 2
    np.testing.assert_allclose(found.within, np.sqrt(within), rtol=1e-5)
    np.testing.assert_allclose(found.between, np.sqrt((between - within) / each), rtol=1e-5)
    weights = 1.0 / ((between - within) / each + within / np.array([3, 2, 1]))
    weights = weights / weights.sum()
    mean = sum(w * np.mean(v) for w, v in zip(weights, groups.values(), strict=True))
    np.testing.assert_allclose(found.value, [mean, 0.1 * mean], rtol=1e-9)
    parts = {part.label: part for part in found.uncertainty.random}
    # U rests on what the means of the mountings differ by alone (Hartung & Knapp 2001): nothing is taken off.
    means = np.array([np.mean(v) for v in groups.values()])
    expected = np.sum(weights * (means - mean) ** 2) / 2.0
    assert list(parts) == [BETWEEN, PHASE_DIFFERENCES]
    assert parts[BETWEEN].covariance[0, 0, 0] == pytest.approx(expected, rel=1e-5)
    assert parts[BETWEEN].dof == pytest.approx([2.0])


def test_common_errors_of_all_recordings_do_not_average_out():
    rng = np.random.default_rng(2)
    drives = [recorded(1.0 + 1e-6 * rng.standard_normal(), f"{n}", f"{n % 5}") for n in range(25)]
    (found,) = find_repeats(drives)
    u = np.sqrt(found.uncertainty.covariance[0, 0, 0])
    assert u == pytest.approx(1e-3, rel=1e-4)
    assert np.all(found.within < 3e-6)
    assert found.recordings[:2] == ("0", "1")
    assert found.weight.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("mountings", ["11", "112", "123"])
def test_unobserved_motion_does_not_average_out(mountings):
    """A bound of 2 % of the load in either part, the same in every recording, which therefore agree to 1e-6."""
    along = 2e-2 * LOAD[2] * np.isin(np.arange(12), (2, 8))
    drives = []
    for n, mounting in enumerate(mountings):
        drive = recorded(1.0 + 1e-6 * n, f"r{n}", mounting)
        hidden = Contribution("unobserved rx", "B", np.diag(along**2)[None])
        own = replace(drive.load_uncertainty, random=(*drive.load_uncertainty.random, hidden))
        drives.append(replace(drive, load_uncertainty=own, observed=(True, True, True, False, True, True)))
    (found,) = find_repeats(drives)
    u = np.sqrt(found.uncertainty.covariance[0].diagonal()).reshape(2, 2) / np.abs(found.value)
    np.testing.assert_allclose(u, [[np.hypot(2e-2, 1e-3)] * 2, [2e-2] * 2], rtol=1e-4)
    unknown = [replace(drive, observed=(True, True, False, True, True, True)) for drive in drives]
    assert not find_repeats(unknown), "of a load that is no result, no mean"


def test_stated_errors_of_a_recording_are_not_counted_as_scatter():
    # Trigger times of 1e-3 rad scatter the phases as stated: nothing is left for a further component on average.
    rng, left = np.random.default_rng(4), []
    for _ in range(30):
        drives = []
        for n in range(6):
            turn = [("trigger: time", "recording", -1e-3j * LOAD)]
            late = 1.0 - 1e-3j * rng.standard_normal()
            numbers = LOAD * late, np.array([1000.0]), uncertainty(NOISE, turn), uncertainty([1e-6])
            drives.append(make_excited_line(*numbers, recording=f"{n}", mounting=f"{n // 2}"))
        (found,) = find_repeats(drives)
        left.append([found.within[0] ** 2, found.between[0] ** 2])
    # The positive part of an estimate about zero keeps some of its spread.
    assert np.all(np.sqrt(np.mean(left, axis=0)) < 0.8e-3)
    assert np.mean(np.array(left) == 0.0) > 0.4


def test_definition_of_a_repeat_and_of_one_frequency():
    first = recorded(1.0, "a")
    louder = recorded(1.0, "b", load=1.5 * LOAD)
    eccentric = recorded(1.0, "c", load=LOAD + 30.0 * np.eye(6)[4])
    along_x = replace(first, recording="d", direction=(1.0, 0.0, 0.0))
    late = replace(first, recording="e", load=1j * LOAD, outputs=1j * first.outputs)
    upside = replace(first, recording="f", direction=(0.0, 0.0, -1.0), load=-LOAD, outputs=-first.outputs)
    apart = replace(first, recording="g", frequency_hz=100.1)
    groups = [set(r.recordings) for r in find_repeats([first, louder, eccentric, along_x, late, upside, apart])]
    assert {"a", "e", "f"} in groups
    assert len(groups) == 5
    merged = [
        {drive.recording for drive in g} for g in group_excitations([first, louder, late], separate_amplitudes=False)
    ]
    assert merged == [{"a", "b", "e"}]
    drives = [replace(first, frequency_hz=f) for f in (200.0, 100.0, 100.9, 101.5)]
    assert [[d.frequency_hz for d in g] for g in group_by_frequency(drives)] == [[100.0, 100.9], [101.5], [200.0]]


def test_cases_without_component_mean_or_slope():
    (single,) = find_repeats([recorded(1.0, "a")])
    assert np.isnan([single.within, single.between]).all()
    (same,) = find_repeats([recorded(1.0, "a"), recorded(1.001, "b")])
    assert (same.within_dof, same.between_dof) == (1, 0)
    notice = repeat_notices([same])[0]
    assert notice.code == ONE_MOUNTING.code
    assert notice.values == {"frequencies": "100 Hz", "recordings": 2}
    partial = recorded(1.0, "b")
    partial = replace(partial, outputs=np.array([partial.outputs[0], complex(np.nan, np.nan)]))
    (found,) = find_repeats([recorded(1.0, "a"), partial])
    assert found.channels == ("U0",)
    silent = replace(partial, outputs=np.full(2, complex(np.nan, np.nan)))
    refused("^drives: ", find_repeats, [silent])
    drives = [recorded(1.0 + 1e-3 * n, f"{n}", load=n * LOAD) for n in (1, 2, 3)]
    dead = [replace(drive, outputs=drive.outputs * [1.0, 0.0]) for drive in drives]
    found = mean_ratio(dead, 2)
    assert found.value[1] == 0.0
    assert np.isfinite(found.uncertainty.covariance).all()
    (series,) = find_linearity(dead)
    assert series.channels == ("U0",)


def test_outputs_and_load_on_one_clock_forget_its_time():
    late = ("clock bridge: time", "recording")
    of_load = uncertainty(NOISE, [(*late, -1e-2j * LOAD)])
    of_outputs = uncertainty([1e-9], [(*late, np.array([-1e-2j]))])
    drive = make_excited_line(LOAD, np.array([1.0]), of_load, of_outputs)
    (found,) = find_repeats([drive])
    assert np.max(np.abs(found.uncertainty.influences[0].effect)) < 1e-15


def covered_means(rng: np.random.Generator, trials: int, each: tuple[int, ...], u: complex, mounted: float) -> AnyArray:
    """Whether magnitude and phase of means (trials, 2) hold the truth.

    `each`: recordings of every mounting, with 1e-4 of noise that is stated; `u`: standard uncertainty of magnitude and
    phase that all share; `mounted`: scatter between mountings, in noises, that nothing states.
    """

    def draw(size: float) -> complex:
        return size * complex(*rng.standard_normal(2))

    held, noise, known = [], 1e-4, 1e-4 * max(mounted, 1.0) * u
    for _ in range(trials):
        shared = complex(known.real * rng.standard_normal(), known.imag * rng.standard_normal())
        drives = []
        for m, count in enumerate(each):
            here = 1.0 + shared + draw(mounted * noise)
            of_load = uncertainty(
                NOISE, [("scale", "rig", known.real * LOAD), ("delay", "rig", 1j * known.imag * LOAD)]
            )
            for n in range(count):
                output = np.array([1000.0 * (here + draw(noise))])
                stated = uncertainty([1000.0 * noise])
                drives.append(make_excited_line(LOAD, output, of_load, stated, recording=f"{m}-{n}", mounting=f"{m}"))
        (found,) = find_repeats(drives)
        ((element,),) = polar_elements(found.value[None], found.uncertainty)
        assert element is not None
        error = complex(found.value[0]) - 1.0
        held.append((abs(error.real) <= element.expanded_magnitude, abs(error.imag) <= element.expanded_phase_rad))
    return np.array(held)


def accepted(held: AnyArray) -> bool:
    """Whether as many are covered as 93 to 97 of 100 would leave, one time in 10 000 aside."""
    few, many = binom.ppf(5e-5, len(held), 0.93), binom.ppf(1.0 - 5e-5, len(held), 0.97)
    return bool(np.all((held.sum(axis=0) >= few) & (held.sum(axis=0) <= many)))


def test_magnitudes_of_two_mountings_are_covered_where_a_stated_phase_dominates():
    held = covered_means(np.random.default_rng(21), 60, (1, 1), 10.0j, 3.0)
    assert accepted(held), held.mean(axis=0)


EACH = (1, 1), (1, 3), (1, 1, 1), (2, 2, 2), (1, 2, 3), (1, 1, 2, 2, 3, 3)
SHARED_U = 0.0j, 10.0j, 10.0 + 0.0j, 0.5 + 0.5j


@pytest.mark.slow
@pytest.mark.parametrize(  # every pair of these, and half of what they make together
    ("each", "u", "mounted"),
    [
        (each, u, mounted)
        for (i, each), (j, u), (k, mounted) in product(*map(enumerate, (EACH, SHARED_U, (0.0, 1.0, 5.0))))
        if (i + j + k) % 2 == 0
    ],
)
def test_magnitude_and_phase_of_means_are_covered(each, u, mounted):
    held = covered_means(np.random.default_rng([len(each), int(mounted)]), 400, each, u, mounted)
    assert accepted(held), held.mean(axis=0)


def test_few_mountings_and_single_recordings_are_reported():
    (two,) = find_repeats([recorded(1.0, "a", "1"), recorded(1.001, "b", "2")])
    (notice,) = repeat_notices([two])
    assert (notice.code, notice.values["frequencies"], notice.values["repeated"]) == (
        TWO_REPEATS.code,
        "100 Hz",
        "mountings",
    )
    assert notice.values["k_two"] == pytest.approx(coverage_factor(1.0))
    (notice,) = repeat_notices([replace(two, frequency_hz=300.0), two])
    assert notice.values["frequencies"] == frequencies_text([100.0, 300.0])
    (three,) = find_repeats([recorded(1.0 + 1e-3 * n, f"{n}", f"{n}") for n in range(3)])
    assert not repeat_notices([three])
    # Unknowns of one recording or mounting are in what these differ by, and counted once.
    drives = []
    for name, value in (("a", 1.0), ("b", 1.001)):
        own = [("trigger: time", "recording", -1e-3j * LOAD), ("point x", "mounting", 1e-3 * LOAD)]
        of_load = uncertainty(NOISE, [*own, ("laser: scale", "rig", 1e-3 * LOAD)])
        output = np.array([1000.0 * value])
        drives.append(make_excited_line(LOAD, output, of_load, uncertainty([1e-6]), recording=name, mounting="1"))
    (once,) = find_repeats(drives)
    assert {i.name for i in once.uncertainty.influences} == {"laser: scale", "point x [1]"}
    (anew,) = find_repeats([drives[0], replace(drives[1], mounting="2")])
    assert {i.name for i in anew.uncertainty.influences} == {"laser: scale"}


GRID = EdgeGrid(start_s=0.1, period_s=0.02, sample_s=2e-5, offset_s=0.04, width_s=2e-3)


def test_grids_are_equal_within_half_a_sample():
    grids = [(GRID, replace(GRID, start_s=0.2))] * 2
    other = (replace(GRID, start_s=0.1 + 9e-6), replace(GRID, start_s=0.2 - 9e-6, offset_s=0.04 + 9e-6))
    apart = [
        (replace(GRID, start_s=0.1 + 11e-6), grids[0][1]),
        (GRID, replace(grids[0][1], offset_s=0.04 + 11e-6)),
        (replace(GRID, period_s=0.02 * (1.0 + 2e-5)), grids[0][1]),
        (replace(GRID, width_s=2e-3 + 11e-6), grids[0][1]),
        (replace(GRID, sample_s=1e-5), grids[0][1]),
        (GRID,),
        (),
        (),
    ]
    first = recorded(1.0, "0")
    drives = [replace(first, recording=f"{n}", grids=g) for n, g in enumerate([*grids, other, *apart])]
    assert [d.start for d in with_starts(drives)] == ["0", "0", "0", *(f"{n}" for n in range(3, 11))]
    lines = [replace(first, frequency_hz=f) for f in (100.0, 200.0)]  # of one recording that tells no grid
    assert [d.start for d in with_starts(lines)] == ["0", "0"]


def test_starts_are_found_without_comparing_every_recording_with_every_other(monkeypatch: pytest.MonkeyPatch):
    """600 recordings, half of them started beside an earlier one; the rule pair by pair is the truth."""
    rng, asked, like = np.random.default_rng(7), 0, EdgeGrid.has_same_edges
    late = rng.uniform(0.0, 2.0, 300)
    late = rng.permutation(np.concatenate([late, late + rng.uniform(-1.0, 1.0, 300) * 0.7 * GRID.sample_s]))
    grids = [replace(GRID, start_s=float(start)) for start in late]
    first = recorded(1.0, "0")
    drives = [replace(first, recording=f"{n}", grids=(grid,)) for n, grid in enumerate(grids)]
    leading: list[int] = []
    expected = []
    for n, start in enumerate(late):  # edges alike: within half a sampling interval of the first that is
        found = next((m for m in leading if abs(late[m] - start) <= GRID.sample_s / 2.0), None)
        leading += [n] if found is None else []
        expected.append(f"{n if found is None else found}")

    def counted(one: EdgeGrid, other: EdgeGrid) -> bool:
        nonlocal asked
        asked += 1
        return like(one, other)

    monkeypatch.setattr(EdgeGrid, "has_same_edges", counted)
    assert [drive.start for drive in with_starts(drives)] == expected
    assert asked < 3 * len(drives)


def test_joint_covariance_is_the_sum_over_noise_and_named_unknowns():
    """Unknowns of one reading, of some and of all, against the sum of their outer products written out."""
    rng = np.random.default_rng(3)
    names = [["all", "ab", f"own {n}"] if n < 2 else ["all", f"own {n}"] for n in range(3)]
    effects = [[complex(*rng.standard_normal(2)) for _ in own] for own in names]
    values = [
        (np.array([1.0 + 0j]), uncertainty([0.1], [(name, "rig", [e]) for name, e in zip(*pair, strict=True)]))
        for pair in zip(names, effects, strict=True)
    ]
    dense = 0.01 * np.eye(6)
    for name in {name for own in names for name in own}:
        acting = np.zeros((3, 2))
        for n, own in enumerate(names):
            if name in own:
                value = effects[n][own.index(name)]
                acting[n] = value.real, value.imag
        dense += np.outer(acting, acting)
    own, shared = split_covariance(values)
    found = np.zeros((3, 2, 3, 2))
    found[range(3), :, range(3)] = own
    for rows, effect in shared:
        found[np.ix_(rows, range(2), rows)] += np.einsum("eni,emj->nimj", effect, effect)
    assert found.reshape(6, 6) == pytest.approx(dense, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("anew", [False, True])
def test_edge_times_average_out_only_for_separate_starts(anew: bool):
    """Four recordings whose edges leave 1 mrad open, one error of all or one of each, beside noise of 0.05 mrad."""
    rng, size = np.random.default_rng(31), []
    for _ in range(30):
        late, drives = rng.standard_normal(4) if anew else np.full(4, rng.standard_normal()), []
        for n in range(4):
            output = 1e3 * np.exp(-1e-3j * late[n]) * (1.0 + 5e-5 * complex(*rng.standard_normal(2)))
            of_output = uncertainty([0.05], [("clock bridge: time", "start", [-1.0j])])
            grids = (GRID, replace(GRID, start_s=0.2 + 1e-3 * n * anew))
            drive = make_excited_line(LOAD, np.array([output]), uncertainty(NOISE), of_output, recording=f"{n}")
            drives.append(replace(drive, grids=grids))
        (found,) = find_repeats(with_starts(drives))
        size.append(polar_elements(found.value[None], found.uncertainty)[0][0].u_phase_rad)
    assert np.sqrt(np.mean(np.square(size))) == pytest.approx(0.5e-3 if anew else 1e-3, rel=0.25)


def simulated_mean(folder: Path, seed: int, *, anew: bool) -> tuple[RepeatMean, RepeatMean, complex]:
    """The mean of three simulated recordings at 1020.3 Hz, the same if all unknowns by edges were each recording's own,
    and the truth. Recorders start at one and the same moment beside the trigger, or `anew` for every recording."""
    rig = Rig(1020.3)
    motion = np.zeros((2, 6), dtype=np.complex128)
    motion[:, 2] = [60.0, 0.24]
    drives, truth = [], complex(np.nan)
    for n in range(3):
        preset = driven(preset_of(rig), f"Fz-{n}", rig.frequency_hz * (1.0 + 2.4e-6), motion)
        first, later = np.random.default_rng([seed, 19, n * anew]).uniform(0.0, 1e-3, 2).tolist()
        base, bridge = preset.daqs
        daqs = (base, replace(bridge, start_s=bridge.start_s + later))
        preset = replace(preset, first_frame_s=preset.first_frame_s + first, daqs=daqs)
        draws = Draws(seed, systematic=True, recording=f"{n}")
        world = make_world(preset, draws, JITTER_S)
        recording = write_run(folder, rendered_run(preset), world, draws)
        found = excited_lines_of(evaluate_recording(load_manifest(recording), Settings()))
        drives += [replace(drive, recording=f"{n}") for drive in found]
        truth = complex(world.sensitivity[0, 2, 2])
    return mean_ratio(with_starts(drives), 2), mean_ratio(drives, 2), truth


@pytest.mark.slow
@pytest.mark.parametrize("anew", [False, True])
def test_phases_of_means_are_covered_however_the_recorders_start(tmp_path, anew: bool):
    over, draws = [], 12
    for seed in range(draws):
        *means, truth = simulated_mean(tmp_path / f"{seed}", seed, anew=anew)
        row = []
        for mean in means:
            place = mean.channels.index("Fz")
            element = polar_elements(mean.value[None], mean.uncertainty)[0][place]
            assert element is not None
            row.append([abs(np.angle(complex(mean.value[place]) / truth)), element.expanded_phase_rad])
        over.append(row)
    error, expanded = np.moveaxis(np.array(over), 2, 0)
    held = np.sum(error <= expanded, axis=0)
    assert held[0] >= binom.ppf(5e-3, draws, 0.95)
    if anew:
        np.testing.assert_array_equal(expanded[:, 0], expanded[:, 1])
    else:
        assert held[1] < binom.ppf(5e-3, draws, 0.95)


@pytest.mark.parametrize("turned", [0.01, 0.1])
def test_the_magnitude_of_a_mean_is_covered_for_different_phases(turned: float):
    # Recordings that are turned and otherwise alike: the mean is short by half the mean square of the angles.
    rng, inside, lengths = np.random.default_rng(8), [], []
    for _ in range(30):
        angles = turned * rng.standard_normal(6)
        drives = [recorded(np.exp(1j * angle), f"{n}", f"{n}", scale=0.0) for n, angle in enumerate(angles.tolist())]
        (found,) = find_repeats(drives)
        ((own, _),) = polar_elements(found.value[None], found.uncertainty)
        lengths.append(own.magnitude)
        inside.append(abs(own.magnitude - 1.0) <= own.expanded_magnitude)
    assert np.mean(lengths) == pytest.approx(1.0 - turned**2 / 2.0 * 5.0 / 6.0, abs=0.2 * turned**2)
    assert np.mean(inside) > 0.8


def test_equal_scatter_along_and_across_a_mean_causes_no_loss():
    rng, parts = np.random.default_rng(9), []
    for _ in range(40):
        values = 1.0 + 0.01 * (rng.standard_normal(6) + 1j * rng.standard_normal(6))
        (found,) = find_repeats([recorded(complex(v), f"{n}", f"{n}", scale=0.0) for n, v in enumerate(values)])
        (turns,) = (part for part in found.uncertainty.random if part.label == PHASE_DIFFERENCES)
        parts.append(np.sqrt(turns.covariance[0, 0, 0]))
    # A few hundredths of what the mean scatters by, 0.01/√6.
    assert np.max(parts) < 0.03 * 0.01 / np.sqrt(6.0)
    # Of a mean below its scatter nothing is told.
    (weak,) = find_repeats([recorded(v, f"{n}", f"{n}") for n, v in enumerate((1.0 + 1.0j, -1.0 + 1.0j, 0.1 - 1.9j))])
    (turns,) = (part for part in weak.uncertainty.random if part.label == PHASE_DIFFERENCES)
    assert not np.any(turns.covariance)


def test_linearity_finds_the_slope_and_forgets_the_scale():
    drives = [recorded(1.0 + 2e-3 * a, f"{a}", load=a * LOAD, scale=1e-2) for a in (0.5, 1.0, 1.5, 2.0)]
    (found,) = find_linearity(drives)
    mean = 1.0 + 2e-3 * 1.25
    np.testing.assert_allclose(found.change, 3e-3 / mean, rtol=1e-6)
    np.testing.assert_allclose(found.slope, 3e-3 / mean / 1500.0, rtol=1e-6)
    assert np.all(found.covariance[:, 0, 0] < 1e-10)
    assert not found.linear.any()
    assert find_linearity(drives[:1]) == ()


def test_cross_talk_of_loads_that_grow_with_the_drive_is_no_lack_of_linearity():
    """Fx is a·2 % of Fz at the amplitude a; with a stated cross-talk of 0.1 the ratio changes, the element does not."""
    matrix = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    matrix[0, [2, 0]], matrix[1, [0, 2]] = (2.0, 0.1), (3.0, 0.2)
    stated = StatedMatrix(("Fz", "Fx"), np.full(6, 2000.0), matrix, 0.0, None, 1e-4)
    drives = []
    for a in (0.5, 1.0, 1.5, 2.0):
        load = a * np.array([20.0 * a, 0.0, 1000.0, 0.0, 0.0, 0.0])
        spread = uncertainty(np.full(6, 1e-3)), uncertainty(np.full(2, 1e-3))
        drives.append(make_excited_line(load, matrix @ load, *spread, recording=f"{a}", channels=("Fz", "Fx")))
    (ratio,), (element,) = find_linearity(drives), find_linearity(drives, None, stated)
    assert (ratio.kind, element.kind, element.channels) == ("ratio", "element", ("Fz", "Fx"))
    # S = 2 + 0.1·0.02·a for Fz, 0.2 + 3·0.02·a for Fx: from 0.5 to 2 over the mean at 1.25.
    np.testing.assert_allclose(ratio.change, [0.003 / 2.0025, 0.09 / 0.275], rtol=1e-6)
    assert not ratio.linear.any()
    np.testing.assert_allclose(element.change, 0.0, atol=1e-9)
    assert element.linear.all()


@pytest.mark.slow
def test_scatter_of_a_series_enlarges_the_uncertainty_of_its_slope():
    rng, inside = np.random.default_rng(8), []
    for _ in range(80):
        values = 1.0 + 1e-3 * (rng.standard_normal(6) + 1j * rng.standard_normal(6))
        drives = [recorded(v, f"{n}", load=(1.0 + 0.2 * n) * LOAD) for n, v in enumerate(values)]
        (found,) = find_linearity(drives)
        inside.append(found.linear[0])
    assert found.dof == 8.0
    assert 0.9 < np.mean(inside) <= 1.0


def test_campaign_wide_names_and_shared_unknowns_of_joined_lines():
    effect = np.ones(1)
    parts = [("laser: scale", "rig", effect), ("point x", "mounting", effect), ("trigger: time", "recording", effect)]
    names = [i.name for i in with_campaign_names(uncertainty([1.0], parts), "Fz 100", "B").influences]
    assert names == ["laser: scale", "point x [B]", "trigger: time [Fz 100]"]
    again = with_campaign_names(with_campaign_names(uncertainty([1.0], parts), "Fz 100", "B"), "other", "C")
    assert [i.name for i in again.influences] == names
    unknowns = [("scale", "rig", [1.0]), ("time", "recording", [2.0])]
    lines = [with_campaign_names(uncertainty([0.1 * n], unknowns), str(n), "1") for n in (1, 2)]
    joined = join_lines(lines)
    effects = {i.name: i.effect[:, 0].tolist() for i in joined.influences}
    assert effects == {"scale": [1.0, 1.0], "time [1]": [2.0, 0.0], "time [2]": [0.0, 2.0]}
    np.testing.assert_allclose(joined.covariance[:, 0, 0], [5.01, 5.04])
    np.testing.assert_allclose(joined.covariance, np.concatenate([part.covariance for part in lines]))


def test_elements_are_averaged_like_ratios_and_keep_the_uncertainty_of_the_matrix():
    static = np.array([[5e-2, 0.0, 1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.1, 0.0, 0.0, 0.0]])
    stated = StatedMatrix(("Fz", "Fx"), np.full(6, 1000.0), static, 1e-3, None, 2e-3)
    load = np.array([100.0, 0.0, 1000.0, 0.0, 0.0, 0.0])
    names = [f"{n}" for n in range(8)]
    drives = [recorded(1.005, name, name, load=load, channels=("Fz", "Fx")) for name in names]
    (found,) = find_repeats(drives, stated=stated)
    assert (found.kind, found.channels) == ("element", ("Fz", "Fx"))
    # U = 1.005·1000 = h·(0.05·100 + 1·1000): h = 1, the element is 1.
    assert found.value[0] == pytest.approx(1.0, rel=1e-12)
    assert find_repeats(drives)[0].value[0] == pytest.approx(1.005)
    effects = {i.name: i.effect[0, 0] for i in found.uncertainty.influences}
    # dS = -S·L_x/L_z·dS_zx, u = 2e-3 of the rated output (and a thousandth of itself), however often it was recorded.
    assert abs(effects["static sensitivity Fz/Fx"]) == pytest.approx(0.1 * np.hypot(2e-3, 5e-5) / 1.005, rel=1e-9)
    (single,) = find_repeats(drives[:1], stated=stated)
    assert {i.name: i.effect[0, 0] for i in single.uncertainty.influences} == pytest.approx(effects)


def test_a_slope_by_blocks_is_generalised_least_squares_written_out():
    """Errors of one reading, of some, and of all, against the whole covariance inverted."""
    rng, count = np.random.default_rng(8), 7
    places, roots = np.linspace(-0.5, 0.5, count), 1e-3 * rng.standard_normal((count, 4, 4))
    own = roots @ roots.swapaxes(1, 2)
    shared = [(list(range(count)), 3e-3 * rng.standard_normal((3, count, 4)))]
    shared += [(rows, 2e-3 * rng.standard_normal((2, len(rows), 4))) for rows in ([0, 3], [3, 5], [1, 2])]
    readings = np.array([1.0, 1.0, 0.0, 0.0]) + 1e-2 * rng.standard_normal((count, 4))
    for channel in (0, 1):
        both = [channel, channel + 2]
        spread = np.zeros((count, 2, count, 2))
        for n in range(count):
            spread[n, :, n] = own[n][np.ix_(both, both)]
        for rows, effects in shared:
            for effect in effects:
                for n, row in enumerate(rows):
                    for m, other in enumerate(rows):
                        spread[row, :, other] += np.outer(effect[n, both], effect[m, both])
        weight = np.linalg.inv(spread.reshape(2 * count, -1))
        design = np.array([[1.0, 0.0, x, 0.0] if part == 0 else [0.0, 1.0, 0.0, x] for x in places for part in (0, 1)])
        values = readings[:, both].ravel()
        covariance = np.linalg.inv(design.T @ weight @ design)
        unknowns = covariance @ design.T @ weight @ values
        residual = values - design @ unknowns
        slope, _, chi2 = _slope(readings, own, shared, places, channel)
        assert slope == pytest.approx(complex(*unknowns[2:]) / complex(*unknowns[:2]), rel=1e-7)
        assert chi2 == pytest.approx(residual @ weight @ residual, rel=1e-7)


def test_uncertainties_on_disk_are_the_same_to_the_last_bit(tmp_path):
    first, second = simulate_drives(eight_setups(np.random.default_rng(1))[:2], *truth_and_errors(1))
    with (tmp_path / "shelf").open("w+b") as file:
        shelf = DiskStore(file)
        kept = [shelf.put(drive) for drive in (first, second)]
        for drive, other in [*zip(kept, (first, second), strict=True), (shelf.put(kept[0]), first)]:
            for found, known in zip(drive.campaign_uncertainties(), other.campaign_uncertainties(), strict=True):
                assert [i.name for i in found.influences] == [i.name for i in known.influences]
                assert all(a.effect.tobytes() == b.effect.tobytes() for a, b in pairs(found, known))
                assert all(
                    (a.u, a.dof, a.scope, a.unit) == (b.u, b.dof, b.scope, b.unit) for a, b in pairs(found, known)
                )
                assert found.covariance.tobytes() == known.covariance.tobytes()
                factor = np.full((1, 6), 2.0 - 1.0j)
                assert found.scaled(factor).covariance.tobytes() == known.scaled(factor).covariance.tobytes()


def pairs(found: Uncertainty, known: Uncertainty) -> Iterator[tuple[Influence, Influence]]:
    return zip(found.influences, known.influences, strict=True)


def truth_and_errors(seed: int) -> tuple[AnyArray, DriveErrors]:
    rng = np.random.default_rng(seed)
    return true_matrix(rng), DriveErrors(rng)


def test_memory_of_the_mean_grows_as_the_recordings():
    rng = np.random.default_rng(2)
    base, errors, truth, peaks = drive_setup(rng, "", "z", (0.0, 0.0, 0.08)), DriveErrors(rng), true_matrix(rng), []
    for count in (10, 60):
        setups = [replace(base, recording=f"{n}", mounting=f"{n // 2}") for n in range(count)]
        drives = simulate_drives(setups, truth, errors)
        tracemalloc.start()
        (found,) = find_repeats(drives, CAPACITY.tolist())
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(found.recordings) == count
    assert peaks[1] < 6.6 * peaks[0]
