"""Figures of the pages on uncertainty, assumptions, validation and other physics."""

from __future__ import annotations

import re
import sys
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from scipy.stats import chi2, ncx2
from style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    RED,
    ROOT,
    blank,
    flow_arrow,
    flow_box,
    marked_table,
    new_figure,
)

from fusion import Settings, evaluate_recording, load_manifest
from fusion.estimation.coverage import coverage_factor, polar, region_factor
from fusion.planning.validation.validation_run import validate


def measurement_model() -> Figure:
    """Draw the chain from recordings to the sensitivity, and the influences that enter at each step."""
    figure, axes = new_figure(3.9)
    blank(axes, (0.0, 10.0), (0.0, 5.2), "auto")
    size = 1.85, 0.8
    for place, text in enumerate(
        (
            "camera images\n→ pose per frame",
            "laser and\naccelerometer samples",
            "trigger edges of\nevery recorder",
            "samples of the\nsensor's outputs",
        )
    ):
        flow_box(axes, (0.0, 4.3 - 0.98 * place), size, text, GREY)
        flow_arrow(axes, (1.85, 4.7 - 0.98 * place), (2.35, 3.0 - 0.28 * (place - 1.5)))
    flow_box(axes, (2.35, 2.35), (1.45, 1.1), "sine\napproximation\nat the exact\ninstants", BLUE)
    flow_box(axes, (4.25, 3.35), (1.75, 1.1), "readings\n$y = X\\,A + C\\,ε + e$\nleast squares → $A$", BLUE)
    flow_box(axes, (6.4, 3.35), (1.5, 1.1), "load\n$L = M\\,A$\n+ tilted weight", BLUE)
    flow_box(axes, (8.3, 2.35), (1.6, 1.1), "sensitivity\n$S = V / L$,\nelement $S_{cd}$", GREEN)
    flow_arrow(axes, (3.8, 3.2), (4.25, 3.7), BLUE)
    flow_arrow(axes, (6.0, 3.9), (6.4, 3.9), BLUE)
    flow_arrow(axes, (7.9, 3.7), (8.45, 3.45), BLUE)
    flow_arrow(axes, (3.8, 2.6), (8.3, 2.6), BLUE)
    axes.text(6.14, 2.68, "phasors $V$ of the outputs", ha="center", fontsize=7.6, color=BLUE)
    for x, width, text, target in (
        (2.3, 1.55, "noise, jitter,\nclock ties,\nfrequencies", (3.0, 2.35)),
        (4.1, 2.0, "scales, delays, responses,\npoints, directions, heads,\npose, calibration", (5.1, 3.35)),
        (6.3, 1.75, "mass, centre, inertia,\njoint, modes, cables,\ngravity, air", (7.15, 3.35)),
        (8.2, 1.75, "static matrix,\ntemperature,\ndistortion, drift", (9.1, 2.35)),
    ):
        flow_box(axes, (x, 0.35), (width, 1.0), text, ORANGE)
        flow_arrow(axes, (x + width / 2, 1.35), target, ORANGE)
    axes.text(0.0, 0.8, "influences ε:\none name is\none unknown", fontsize=7.6, color=ORANGE, va="center")
    axes.set_title("From recordings to the sensitivity: influences enter at four steps")
    return figure


def demo_budget() -> Figure:
    """Draw the largest contributions to magnitude and phase of the demo recording."""
    evaluation = evaluate_recording(load_manifest(ROOT / "sample_images/demo/Fz-0080"), Settings())
    element = evaluation.element
    assert element is not None
    place = element.elements.index((2, 2))
    figure, both = new_figure(3.1, 1, 2)
    for axes, part, unit, colour in zip(both, ("magnitude", "phase"), ("%", "mrad"), (BLUE, ORANGE), strict=True):
        factor = 100.0 if part == "magnitude" else 1e3
        name = "u_relative" if part == "magnitude" else "u_phase_rad"
        sizes = {entry.label: factor * float(getattr(entry, name)[0, place]) for entry in element.budget}
        total = float(np.sqrt(np.sum(np.square(list(sizes.values())))))
        largest = sorted(sizes, key=sizes.__getitem__)[-9:]
        axes.barh(largest, [sizes[label] for label in largest], color=colour, height=0.7)
        for row, label in enumerate(largest):
            share = 100 * (sizes[label] / total) ** 2
            axes.text(sizes[label], row, f" {share:.0f} %" if share >= 0.5 else " < 1 %", va="center", fontsize=7)
        axes.tick_params(axis="y", labelsize=7)
        axes.set_xlim(0.0, 1.22 * max(sizes.values()))
        axes.set_xlabel(f"contribution to u / {unit}")
        axes.set_title(f"{part}: u = {total:.2g} {unit}")
    return figure


def undetected_error() -> Figure:
    """Draw how far the error of one laser point moves a rotation, and how often the test detects it."""
    figure, (left, right) = new_figure(2.7, 1, 2)
    error = np.linspace(0.0, 14.0, 200)
    for count, colour in ((4, ORANGE), (8, BLUE)):
        angle = 2.0 * np.pi * np.arange(count) / count
        design = np.stack([np.ones(count), np.sin(angle), -np.cos(angle)], axis=1)  # z, rx, ry at unit radius
        gain = np.linalg.pinv(design)
        redundancy = 1.0 - float((design @ gain)[0, 0])
        shift = abs(gain[2, 0]) / np.linalg.norm(gain[2]) / region_factor(np.inf) * error
        free = 2 * (count - 3)  # real and imaginary part of every contrast
        left.plot(error, shift, color=colour, label=f"{count} points")
        detected = ncx2.sf(chi2.isf(0.01, free), free, redundancy * error**2)
        right.plot(error, 100.0 * detected, color=colour, label=f"{count} points")
    left.axhline(1.0, color=GREY, lw=0.8, ls=":")
    left.set(
        xlabel="error of one point / its u", ylabel="shift of a rotation / its U", title="Effect", ylim=(0.0, None)
    )
    right.set(xlabel="error of one point / its u", ylabel="detected at 1 % / %", title="Detection")
    left.legend()
    return figure


def inclined_drive() -> Figure:
    """Draw the limit of an error by unobserved motion over the angle between drive and measured direction."""
    figure, axes = new_figure(2.5)
    angle = np.linspace(0.0, 88.0, 400)
    q = np.cos(np.radians(angle))
    for limit, colour in ((0.02, GREEN), (0.05, BLUE), (0.1, ORANGE)):
        error = limit * np.sqrt(1.0 - q**2) / q
        axes.plot(
            angle[error < 1.0], 100.0 * error[error < 1.0], color=colour, label=f"other motion below {100 * limit:g} %"
        )
    axes.set(
        xlabel="angle between driven and measured direction / °",
        ylabel="largest error / %",
        ylim=(0.0, 60.0),
        xlim=(0.0, 90.0),
    )
    axes.set_title("Error of the driven motion by motion that no instrument observes")
    axes.legend()
    return figure


def coverage_factors() -> Figure:
    """Draw the coverage factors of intervals and of regions over the degrees of freedom."""
    figure, axes = new_figure(2.7)
    dof = np.geomspace(1.0, 100.0, 300)
    for colour, factor, text, limit in (
        (
            BLUE,
            np.array([coverage_factor(one) for one in dof]),
            "k of an interval, $t_{0.975}(ν)$",
            coverage_factor(np.inf),
        ),
        (ORANGE, region_factor(dof), "K of a half-width of a region", float(region_factor(np.inf))),
    ):
        axes.loglog(dof, factor, color=colour, label=text)
        axes.axhline(limit, color=colour, lw=0.8, ls=":")
        axes.text(100.0, 1.04 * limit, f"{limit:.2f} ", color=colour, fontsize=8, ha="right", va="bottom")
    for mountings in (2, 3, 6):
        k = coverage_factor(mountings - 1.0)
        axes.plot(mountings - 1.0, k, "o", color=BLUE, ms=5)
        arrow = {"arrowstyle": "-", "color": GREY, "lw": 0.8}
        text, place = f"{mountings} mountings: k = {k:.3g}", (1.3 * mountings**1.2, 2.3 * k**0.9)
        axes.annotate(text, (mountings - 1.0, k), place, fontsize=8, arrowprops=arrow)
    axes.set(xlabel="degrees of freedom ν", ylabel="coverage factor", ylim=(1.5, 30.0), xlim=(0.93, 105.0))
    axes.set_yticks([2, 3, 5, 10, 20], ["2", "3", "5", "10", "20"])
    axes.set_xticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.legend()
    axes.set_title("Coverage factors for 95 % over the degrees of freedom")
    return figure


def complex_region() -> Figure:
    """Draw the 95 % region of a complex value beside its intervals of magnitude and phase."""
    value, along, across = 1.0 * np.exp(0.35j), 0.05, 0.09
    turn = np.array([[value.real, -value.imag], [value.imag, value.real]]) / abs(value)
    covariance = turn @ np.diag([along**2, (across * abs(value)) ** 2]) @ turn.T
    figure, both = new_figure(3.0, 1, 2, width_ratios=(1.0, 1.25))
    for axes, freedom, title in (
        (both[0], (np.inf, np.inf), "both u known"),
        (both[1], (4.0, np.inf), "u of the magnitude with ν = 4"),
    ):
        stated = polar(value, covariance, np.inf, freedom)
        half, angle = stated.region.half_axes, np.degrees(stated.region.angle_rad)
        axes.add_patch(
            Ellipse((value.real, value.imag), 2 * half[0], 2 * half[1], angle=angle, fc=PALE[BLUE], ec=BLUE, lw=1.6)
        )
        phases = stated.phase_rad + np.linspace(-1.0, 1.0, 60) * stated.expanded_phase_rad
        edges = stated.magnitude + np.array([-1.0, 1.0]) * stated.expanded_magnitude
        outline = np.concatenate([edges[0] * np.exp(1j * phases), edges[1] * np.exp(1j * phases[::-1])])
        axes.plot(*np.append(outline, outline[0]).view(float).reshape(-1, 2).T, color=ORANGE, lw=1.3)
        axes.plot([0.0, value.real], [0.0, value.imag], color=GREY, lw=0.9)
        axes.plot(value.real, value.imag, "o", color=BLUE, ms=4)
        axes.set(xlabel="real part", xlim=(0.55, 1.25), ylim=(-0.09, 0.63), aspect="equal", title=title)
    both[0].set_ylabel("imaginary part")
    both[0].text(
        0.57, -0.07, "orange: |X| ± U and arg X ± U,\nno joint 95 % region\nblue: 95 % region of X", fontsize=7.6
    )
    return figure


def coverage_histogram() -> Figure:
    """Draw errors over u of 200 simulated recordings beside the normal distribution."""
    benchmark = _benchmark("coverage_phasors")
    counts = benchmark.run_case(benchmark.CASES[0], range(1, 201))
    figure, both = new_figure(2.6, 1, 3, sharey=True)
    grid = np.linspace(-4.5, 4.5, 300)
    for axes, name in zip(both, ("acceleration", "load", "sensitivity"), strict=True):
        tallies = getattr(counts, name)
        errors = np.concatenate([tally.normalised for tally in tallies])
        covered = np.concatenate([tally.covered for tally in tallies])
        axes.hist(errors, bins=np.arange(-4.5, 4.75, 0.25), density=True, color=PALE[BLUE], ec=BLUE, lw=0.6)
        axes.plot(grid, np.exp(-0.5 * grid**2) / np.sqrt(2.0 * np.pi), color=ORANGE)
        axes.set(xlabel="error / u", ylim=(0.0, 0.52), title=name)
        axes.text(
            0.98,
            0.96,
            f"{100.0 * covered.mean():.1f} % covered\nrms {np.sqrt(np.mean(errors**2)):.2f}",
            transform=axes.transAxes,
            ha="right",
            va="top",
            fontsize=8,
        )
    both[0].set_ylabel("density")
    return figure


def shared_errors() -> Figure:
    """Draw U of a mean over mountings where one part of the error is equal in all."""
    figure, axes = new_figure(2.7)
    count = np.arange(2, 31)
    for shared, colour in ((0.0, GREEN), (0.5, ORANGE), (1.0, RED)):
        u_scatter = 1.0 / np.sqrt(count)
        u = np.hypot(u_scatter, shared)
        # Welch and Satterthwaite with the enlarged variance of the part that was estimated (`Uncertainty.dof_along`).
        wide = u_scatter**2 * (1.0 + 5.0 / (count - 1.0) ** 2)
        dof = (count - 1.0) * ((wide + shared**2) / wide) ** 2
        expanded = u * np.array([coverage_factor(one) for one in dof])
        axes.plot(count, expanded, "o-", ms=3, color=colour, label=f"u shared by all mountings: {shared:g}")
        if shared:
            axes.axhline(coverage_factor(np.inf) * shared, color=colour, lw=0.8, ls=":")
    axes.set(xlabel="number of mountings", ylabel="U of the mean", ylim=(0.0, 9.2), xlim=(1.5, 30.5))
    axes.legend()
    axes.set_title("U of a mean approaches k·u of the shared part (dotted); u of one mounting is 1")
    return figure


def influence_scopes() -> Figure:
    """Draw which results share an unknown, by its scope."""
    figure, axes = new_figure(2.6)
    blank(axes, (0.0, 10.0), (0.0, 4.6), "auto")
    left, width = 3.15, 1.1
    names = ("recording 1", "recording 2", "recording 3", "recording 4", "recording 5", "recording 6")
    for place, name in enumerate(names):
        axes.text(left + width * (place + 0.5), 4.15, name, ha="center", fontsize=7.4)
    axes.text(left + 1.5 * width, 4.5, "mounting A", ha="center", fontsize=7.8, fontweight="bold")
    axes.text(left + 4.5 * width, 4.5, "mounting B", ha="center", fontsize=7.8, fontweight="bold")
    rows = (
        ("rig: scales, delays, pose, masses", ((0, 6),), BLUE),
        ("mounting: points, directions, tilt", ((0, 3), (3, 6)), GREEN),
        ("start: clock tie, trigger times", ((0, 2), (2, 3), (3, 4), (4, 6)), ORANGE),
        ("recording: noise, unobserved motion", tuple((n, n + 1) for n in range(6)), GREY),
    )
    for row, (text, spans, colour) in enumerate(rows):
        y = 3.15 - 0.95 * row
        axes.text(0.0, y + 0.32, text, fontsize=7.8, va="center")
        for first, last in spans:
            axes.add_patch(
                Rectangle(
                    (left + width * first + 0.05, y), width * (last - first) - 0.1, 0.64, fc=PALE[colour], ec=colour
                )
            )
            axes.text(
                left + width * (first + last) / 2, y + 0.32, "one unknown", fontsize=6.6, ha="center", va="center"
            )
    figure.suptitle(
        "The scope of an influence: results in one box share one error",
        fontsize=9.5,
        fontweight="bold",
        x=0.01,
        ha="left",
    )
    return figure


def violated_assumptions() -> Figure:
    """Draw how far each violated assumption moves a result, and what the program does about it."""
    rows = [row for row in marked_table("assumptions-tables.md", "violations") if row[0] != "nothing" and row[5] != "–"]
    rows.sort(key=lambda row: float(row[5]))
    colours = {"noticed": GREEN, "covered": BLUE, "harmless": GREY, "listed": ORANGE}
    figure, axes = new_figure(6.4)
    labels = [re.sub(r"`([\w-]+)=[^`]*` [^,]*", r"\1", row[0]).replace(", ", " + ") + f" ({row[1]})" for row in rows]
    axes.barh(labels, [max(float(row[5]), 0.012) for row in rows], color=[colours[row[-1]] for row in rows], height=0.7)
    axes.axvline(1.0, color="#222222", lw=0.9, ls="--")
    axes.set_xscale("log")
    axes.set(
        xlim=(0.01, 800.0),
        ylim=(-0.6, len(rows) - 0.4),
        xlabel="median shift of the most affected result / larger half-axis of its 95 % region",
    )
    axes.set_xticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    axes.tick_params(axis="y", labelsize=6.8)
    texts = {
        "noticed": "a notice names the cause",
        "covered": "U covers it",
        "harmless": "U covers it; shift below 0.1",
        "listed": "listed as not assessed",
    }
    handles = [Rectangle((0, 0), 1, 1, color=colour) for colour in colours.values()]
    axes.legend(handles, texts.values(), loc="lower right", fontsize=8)
    axes.set_title("Shift of a result by each violated assumption (rig in brackets)")
    return figure


def validation_deviations() -> Figure:
    """Draw the deviation of every quantity of the software validation over its tolerance."""
    cases = validate().cases
    figure, axes = new_figure(2.8)
    for row, case in enumerate(reversed(cases)):
        shares = np.maximum([quantity.share for quantity in case.quantities], 1e-12)
        axes.semilogx(shares, np.full(len(shares), row), "|", color=BLUE, ms=11, mew=1.2)
    axes.axvline(1.0, color=RED, lw=1.2)
    axes.text(0.8, len(cases) - 0.45, "tolerance", color=RED, fontsize=8, ha="right", va="bottom")
    axes.set_yticks(range(len(cases)), [case.name for case in reversed(cases)])
    axes.set(
        xlabel="deviation from the reference / tolerance (10⁻¹²: none)",
        xlim=(5e-13, 5.0),
        ylim=(-0.6, len(cases) - 0.3),
    )
    axes.set_title(f"{sum(len(case.quantities) for case in cases)} quantities of the software validation", pad=10)
    return figure


def other_physics_coverage() -> Figure:
    """Draw U over the necessary size of every case under other physics."""
    rows = marked_table("other-physics.md", "other physics")
    commands = list(dict.fromkeys(row[0] for row in rows))
    figure, axes = new_figure(2.8)
    for place, command in enumerate(commands):
        own = [row for row in rows if row[0] == command and row[4]]
        ratios = np.array([float(row[4].partition(",")[0]) for row in own])
        spread = place + np.linspace(-0.3, 0.3, len(own))
        named = np.array([bool(row[5]) for row in own])
        axes.semilogy(
            spread[~named],
            ratios[~named],
            "o",
            color=BLUE,
            ms=4,
            label="" if place else "no notice, or none needed",
        )
        axes.semilogy(
            spread[named],
            ratios[named],
            "s",
            color=ORANGE,
            ms=4,
            label="" if place else "a notice names the departure",
        )
    axes.axhline(1.0, color=GREY, lw=0.8)
    axes.set_xticks(range(len(commands)), commands)
    axes.set(ylabel="U / needed (median over quantities)", ylim=(0.4, 8.0))
    axes.yaxis.label.set_size(8)
    axes.set_yticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
    axes.minorticks_off()
    axes.legend(fontsize=8, loc="upper right")
    axes.set_title("Size of U in every case, relative to the errors")
    return figure


def _benchmark(name: str) -> Any:
    """Import a module of the benchmarks."""
    import importlib

    folder = str(ROOT / "benchmarks")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module(name)


DRAWINGS = (
    measurement_model,
    demo_budget,
    undetected_error,
    inclined_drive,
    coverage_factors,
    complex_region,
    coverage_histogram,
    shared_errors,
    influence_scopes,
    violated_assumptions,
    validation_deviations,
    other_physics_coverage,
)
