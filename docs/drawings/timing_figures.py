"""Figures of the pages on signals, clocks and reliability."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from style import BLUE, GREY, ORANGE, RED, blank, flow_box, marked_table, new_figure

from shaker import find_edges, fit_trigger, tie_clocks

LINE_HZ, FRAME_HZ = 106.25, 52.874
"""Driven line and frame rate of the published set-up."""


def trigger_edges() -> Figure:
    """Draw sampled trigger edges as intervals, and the lines that satisfy all of them."""
    figure, both = new_figure(2.9, 1, 2, width_ratios=(1.0, 1.5))
    rate, period, start = 51.2e3, 1.0 / FRAME_HZ, 1.37e-3
    samples = np.arange(-3, 4)
    rise = np.clip((samples - 0.4) * 50.0, 0.0, 5.0)
    fine = np.linspace(-3.0, 3.0, 1000)
    both[0].plot(fine * 1e6 / rate, np.where(fine > 0.4, 5.0, 0.0), color=GREY, lw=1.2)
    both[0].plot(samples * 1e6 / rate, rise, "o", color=BLUE, ms=5)
    both[0].axvspan(0.0, 1e6 / rate, color=ORANGE, alpha=0.25, lw=0)
    both[0].text(-56.0, 3.9, "the edge lies\nin this interval", fontsize=8, color=ORANGE)
    both[0].set(xlabel="time / µs", ylabel="trigger / V", title="One edge, sampled every 19.5 µs")
    number = np.arange(40)
    edge = start + period * number
    later = np.ceil(edge * rate) / rate
    middle, half = 1e6 * (later - 0.5 / rate - edge), 0.5e6 / rate
    both[1].errorbar(number, middle, half, fmt="none", ecolor=ORANGE, elinewidth=2.4)
    slopes = np.linspace(-0.8, 0.8, 161)
    lowest = np.max(middle - half - slopes[:, None] * (number - 19.5), axis=1)
    highest = np.min(middle + half - slopes[:, None] * (number - 19.5), axis=1)
    possible = np.flatnonzero(lowest <= highest)
    for slope in possible:
        for offset in np.linspace(lowest[slope], highest[slope], 3):
            both[1].plot(number[[0, -1]], offset + slopes[slope] * (number[[0, -1]] - 19.5), color=BLUE, lw=0.7)
    both[1].set(
        xlabel="edge",
        ylabel="interval, relative to\nthe true edge / µs",
        title="All edges: the blue lines satisfy each interval",
    )
    return figure


def clock_tie() -> Figure:
    """Draw offset and rate between two recorders, from the edges that both have sampled."""
    rates, drift = (51.2e3, 8e3), 20e-6

    def trigger(start_s: float, rate_hz: float, clock: float) -> tuple[np.ndarray, object]:
        time_s = start_s + np.arange(int(4.2 * rate_hz)) / rate_hz * clock
        pulses = ((time_s > 0.1) & (time_s < 4.1) & (time_s % (1.0 / FRAME_HZ) < 2e-3)).astype(float)
        edges = find_edges(pulses, rate_hz)
        return edges.estimate_s, fit_trigger(edges)

    (first, base), (second, other) = trigger(0.0, rates[0], 1.0), trigger(0.0135, rates[1], 1.0 + drift)
    tie = tie_clocks(base, other)
    figure, axes = new_figure(2.8)
    shift = round((tie.to_base_s(second[:1])[0] - first[0]) * FRAME_HZ)
    count = min(len(first) - shift, len(second))
    apart = first[shift : shift + count] - second[:count]
    grid = np.linspace(0.0, 4.2, 50)
    line, u = tie.to_base_s(grid) - grid, tie.u_to_base_s(grid)
    origin = 0.0135
    axes.plot(second[:count], 1e6 * (apart - origin), ".", color=GREY, ms=4, label="difference of the sampled edges")
    axes.plot(grid, 1e6 * (line - origin), color=BLUE, label="fitted line")
    axes.fill_between(
        grid, 1e6 * (line - 2 * u - origin), 1e6 * (line + 2 * u - origin), color=BLUE, alpha=0.25, lw=0, label="± 2 u"
    )
    axes.plot(grid, 1e6 * drift * grid, color=ORANGE, lw=1.2, ls="--", label="truth")
    axes.set(xlabel="time of the second clock / s", ylabel="first − second clock\n− 13.5 ms / µs")
    axes.set_ylim(top=250.0)
    axes.legend(fontsize=8, loc="upper left", ncols=2)
    rate, expanded = 1e6 * (tie.rate - 1.0), 2e6 * tie.covariance[1, 1] ** 0.5
    axes.set_title(f"Tie of two clocks: rate ({rate:.1f} ± {expanded:.1f}) µs/s with k = 2 (true 20)")
    return figure


def aliased_line() -> Figure:
    """Draw a line of 106.25 Hz sampled by 53 frames per second, and its beat."""
    figure, both = new_figure(2.7, 1, 2)
    beat = LINE_HZ - 2.0 * FRAME_HZ
    for axes, length, title in (
        (both[0], 0.12, "Motion and frames"),
        (both[1], 4.0, f"The frames over two periods of {beat:.3f} Hz"),
    ):
        fine, frames = np.linspace(0.0, length, 2000), np.arange(0.0, length, 1.0 / FRAME_HZ)
        if length < 1.0:
            axes.plot(1e3 * fine, np.cos(2 * np.pi * LINE_HZ * fine - 0.3), color=GREY, lw=1.0, label=f"{LINE_HZ} Hz")
        else:
            axes.plot(fine, np.cos(2 * np.pi * beat * fine - 0.3), color=BLUE, lw=1.0)
        scale = 1e3 if length < 1.0 else 1.0
        axes.plot(
            scale * frames, np.cos(2 * np.pi * LINE_HZ * frames - 0.3), "o", color=ORANGE, ms=5 if length < 1.0 else 2.5
        )
        axes.set(xlabel="time / ms" if length < 1.0 else "time / s", title=title, ylim=(-1.15, 1.15))
    both[0].set_ylabel("displacement / amplitude")
    return figure


def jitter_effect() -> Figure:
    """Draw the relative error of an amplitude by random and by periodic jitter of the trigger."""
    figure, axes = new_figure(2.8)
    jitter, omega = np.geomspace(1e-7, 1e-4, 100), 2.0 * np.pi * LINE_HZ
    axes.loglog(
        1e6 * jitter,
        omega * np.sqrt(2.0) * jitter / 2.0,
        color=RED,
        label="periodic, at twice the line: ω·δ/2, δ = √2·rms",
    )
    axes.loglog(
        1e6 * jitter,
        omega * jitter / np.sqrt(211.0),
        color=ORANGE,
        label="random: scatter ω·σ/√F of the phase, F = 211 frames",
    )
    axes.loglog(
        1e6 * jitter,
        1.0 - np.exp(-0.5 * (omega * jitter) ** 2),
        color=BLUE,
        label="random: loss of amplitude, (ω·σ)²/2",
    )
    axes.axhline(1e-3, color=GREY, lw=0.8, ls=":")
    axes.text(0.105, 1.15e-3, "0.1 %", fontsize=8, color=GREY)
    axes.set(
        xlabel="rms jitter of the trigger / µs",
        ylabel="relative error at 106.25 Hz",
        ylim=(1e-8, 1e1),
        xlim=(0.1, 100.0),
    )
    axes.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    axes.legend(fontsize=8, loc="upper left")
    axes.set_title("Periodic jitter costs more than random jitter")
    return figure


def line_noise() -> Figure:
    """Draw the noise spectrum of frames with 1/f noise, and the two levels that may be stated at a slow beat."""
    rng = np.random.default_rng(5)
    frames, records = 1024, 60
    frequency = np.fft.rfftfreq(frames, 1.0 / FRAME_HZ)
    shape = np.sqrt(1.0 + (2.0 / np.maximum(frequency, frequency[1])) ** 1.5)
    spectra = np.fft.rfft(rng.standard_normal((records, frames))) * shape
    power = np.mean(np.abs(spectra) ** 2, axis=0)[1:] / frames
    one = np.abs(spectra[0]) ** 2 / frames
    beat = LINE_HZ - 2.0 * FRAME_HZ
    figure, axes = new_figure(2.7)
    axes.loglog(frequency[1:], one[1:], color=GREY, lw=0.5, label="one record")
    axes.loglog(frequency[1:], power, color=BLUE, label="mean of 60 records")
    axes.axhline(float(np.mean(one[1:])), color=ORANGE, ls="--", label="white average of the residual")
    level = float(np.interp(beat, frequency[1:], 1.0 + (2.0 / frequency[1:]) ** 1.5))
    axes.plot(beat, level, "o", color=RED, ms=7, label=f"level at the beat of {beat:.2f} Hz")
    axes.set(xlabel="frequency / Hz", ylabel="noise power (white part = 1)", xlim=(0.05, 27.0), ylim=(0.05, 1000.0))
    axes.set_xticks([0.1, 1, 10], ["0.1", "1", "10"])
    axes.legend(fontsize=8)
    axes.set_title("Noise at a slow beat exceeds the white average")
    return figure


def locked_edges() -> Figure:
    """Draw the places of trigger edges between two samples for a free, a nearly locked and a locked period."""
    figure, all_axes = new_figure(2.6, 1, 3, sharey=True)
    number = np.arange(96)
    for axes, period, title in zip(
        all_axes,
        (500.382, 500.0 + 0.6 / 95.0, 500.0),
        ("free: 500.382 samples", "nearly locked: d = 0.6", "locked: d = 0"),
        strict=True,
    ):
        place = (0.23 + period * number) % 1.0
        axes.plot(number, place, ".", color=BLUE, ms=3.5)
        gaps = np.diff(np.concatenate([np.sort(place), [np.min(place) + 1.0]]))
        largest = int(np.argmax(gaps))
        begin, width = float(np.sort(place)[largest]), float(gaps[largest])
        for low in (begin, begin - 1.0):
            if low + width > 0.0 and low < 1.0:
                axes.axhspan(max(low, 0.0), min(low + width, 1.0), color=ORANGE, alpha=0.3, lw=0)
        axes.set(xlabel="edge", ylim=(0.0, 1.0), title=f"{title}\ngap {width:.2f}")
    all_axes[0].set_ylabel("place between two samples")
    return figure


def locked_errors() -> Figure:
    """Draw the error of the outputs' time by edges alone and with the motion, from the benchmark's table."""
    rows = marked_table("clocks.md", "clocks")
    names = list(dict.fromkeys(row[0] for row in rows))
    figure, axes = new_figure(2.9)
    for shift, way, colour in ((-0.2, "edges", GREY), (0.2, "motion", BLUE)):
        chosen = [row for row in rows if row[1] == way]
        rms, u = np.array([[float(value) for value in row[7:9]] for row in chosen]).T
        place = np.arange(len(names)) + shift
        axes.bar(place, rms, 0.38, color=colour, label="edges alone" if way == "edges" else "edges and motion")
        axes.plot(place, u, "_", color=ORANGE, ms=13, mew=2, label="u" if way == "motion" else None)
    axes.set_yscale("log")
    axes.set(ylabel="rms error of the output's time / µs", ylim=(0.02, 100.0))
    axes.yaxis.label.set_size(8)
    axes.set_yticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    short = {
        "bridge at": "bridge\nat",
        "ideal low": "ideal\nlow",
        "rise of one ": "rise of\none\n",
        "RC of half a ": "RC of\nhalf a\n",
    }
    labels = [
        name.replace(", ", ",\n").replace("no lock: ", "no lock:\n").replace("500.382 samples", "500.382")
        for name in names
    ]
    for long, broken in short.items():
        labels = [label.replace(long, broken) for label in labels]
    axes.set_xticks(np.arange(len(names)), labels, fontsize=7)
    axes.legend(fontsize=8, ncols=3)
    axes.set_title("Time error of the output, over the drift of the edges in samples per record")
    return figure


def interrupted_run() -> Figure:
    """Draw the stages of a run, and what a kill at each of them leaves."""
    figure, axes = new_figure(2.5)
    blank(axes, (0.0, 10.0), (0.0, 3.6), "auto")
    stages = (
        ("read and hash\nall inputs", "nothing written"),
        ("evaluate,\nkeep checkpoints", "checkpoints;\nold results whole"),
        ("write into a\nstaging folder", "checkpoints;\nold results whole"),
        ("compare inputs\nwith their hashes", "checkpoints;\nold results whole"),
        ("move into place,\nmark complete", "old or new results,\nmark is correct"),
    )
    for place, (stage, left) in enumerate(stages):
        x = 2.0 * place + 0.05
        for y, text, colour in ((2.0, stage, BLUE), (0.35, left, ORANGE)):
            flow_box(axes, (x, y), (1.75, 0.95), text, colour)
        arrow = {"arrowstyle": "-|>", "color": GREY}
        if place < len(stages) - 1:
            axes.annotate("", (x + 2.0, 2.475), (x + 1.75, 2.475), arrowprops=arrow)
        axes.annotate("", (x + 0.875, 1.3), (x + 0.875, 2.0), arrowprops={**arrow, "linestyle": ":"})
    axes.text(0.05, 3.2, "stages of a run", fontsize=8, color=BLUE)
    axes.text(0.05, 0.05, "found after a kill at this stage", fontsize=8, color=ORANGE)
    axes.set_title("A run may end at any instant")
    return figure


DRAWINGS = (
    trigger_edges,
    clock_tie,
    aliased_line,
    jitter_effect,
    line_noise,
    locked_edges,
    locked_errors,
    interrupted_run,
)
