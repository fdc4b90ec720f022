"""Amplitude of a motion by an event camera and by frames of the same duration: a model of its thresholds.

    python benchmarks/event_motion.py [--draws 40] [--write]

A pixel of slope s (of the logarithm of its intensity, per px) sends an event whenever s·u has changed by its threshold.
The model is that of Gallego et al. 2022, IEEE Trans. Pattern Anal. Mach. Intell. 44, 154, section 2.4. Background
events, refractory time and saturation of the bus are absent: the model is the best case.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from marked import markdown_row, markdown_table, write_marked
from poor_surfaces import ELECTRONS, INNER, READ_ELECTRONS, SURFACES, FloatArray

PAGE = Path(__file__).resolve().parents[1] / "docs" / "poor-surfaces.md"
THRESHOLD = 0.12  # change of the logarithm, nominal
MISMATCH = 0.021  # of the threshold between pixels, standard deviation (Lichtsteiner et al. 2008)
EVENT_NOISE = 0.01  # of a single event's change
JITTER_S = 50e-6
LINE_HZ, CYCLES, FRAMES = 80.0, 8, 100
AMPLITUDES_PX = (0.01, 0.1, 1.0)


def first_event_px(slope: FloatArray | float) -> FloatArray:
    """Return the amplitude of a sine whose range 2·A·s is one threshold."""
    return np.asarray(THRESHOLD / (2.0 * np.abs(slope)))


def log_slopes(name: str, seed: int) -> tuple[FloatArray, float]:
    """Return slopes (P,) of the logarithm of the intensity along x, per px, and the mean intensity."""
    surface = SURFACES[name](np.random.default_rng(seed))
    after, before = (surface.image(np.array([sign * 0.005, 0.0]))[INNER, INNER] for sign in (-1.0, 1.0))
    return np.log(after / before).ravel() / 0.01, float(after.mean())


def amplitude_by_events(slopes: FloatArray, amplitude_px: float, rng: np.random.Generator) -> tuple[float, int]:
    """Return the amplitude of A·cos ωt by least squares over all events, and their number; NaN for none.

    Each event states that s·(u(t) − u(t of the one before)) is the nominal threshold.
    """
    threshold = np.maximum(THRESHOLD + MISMATCH * rng.standard_normal(len(slopes)), THRESHOLD / 4.0)
    size = np.abs(slopes)
    last, last_s = np.full(len(slopes), amplitude_px), np.zeros(len(slopes))
    product = square = 0.0
    events = 0
    for half in range(2 * CYCLES):
        sign = -1.0 if half % 2 == 0 else 1.0
        active = np.arange(len(slopes))
        while len(active):
            needed = threshold[active] + EVENT_NOISE * rng.standard_normal(len(active))
            place = last[active] + sign * np.maximum(needed, THRESHOLD / 8.0) / size[active]
            active, place = active[np.abs(place) <= amplitude_px], place[np.abs(place) <= amplitude_px]
            angle = np.arccos(-sign * place / amplitude_px) + np.pi * half
            seen_s = angle / (2.0 * np.pi * LINE_HZ) + JITTER_S * rng.standard_normal(len(active))
            phases = 2.0 * np.pi * LINE_HZ * np.array([seen_s, last_s[active]])
            model = size[active] * sign * (np.cos(phases[0]) - np.cos(phases[1]))
            product, square = product + THRESHOLD * float(model.sum()), square + float(np.sum(model**2))
            last[active], last_s[active], events = place, seen_s, events + len(active)
    return (product / square if events else float("nan")), events


def frames_bound_px(slopes: FloatArray, mean: float) -> float:
    """Return the standard deviation of the amplitude by frames of the same pixels, √(2/F)·σ/√Σs²."""
    relative = np.sqrt(mean * ELECTRONS + READ_ELECTRONS**2) / (mean * ELECTRONS)
    return float(relative * np.sqrt(2.0 / FRAMES / np.sum(slopes**2)))


def rows(draws: int) -> list[str]:
    """Return the rows of the table."""
    table = []
    for name in ("speckle of 5 px", "one printed edge", "brushed metal, 3 %"):
        for amplitude in AMPLITUDES_PX:
            found, counts, firsts, bounds = [], [], [], []
            for draw in range(draws):
                slopes, mean = log_slopes(name, draw)
                value, events = amplitude_by_events(slopes, amplitude, np.random.default_rng([7, draw]))
                found.append(value)
                counts.append(events)
                firsts.append(float(first_event_px(np.quantile(np.abs(slopes), 0.99))))
                bounds.append(frames_bound_px(slopes, mean))
            used = np.array(found)[np.isfinite(found)]
            several = len(used) > draws / 2
            error = f"{100 * (used.mean() / amplitude - 1):+.1f}" if several else "-"
            scatter = f"{1e3 * used.std(ddof=1):.2f}" if several else "no event"
            cells = f"{amplitude:g}", f"{np.median(firsts):.2f}", f"{np.median(counts) / CYCLES:.0f}", error, scatter
            table.append(markdown_row(name, *cells, f"{1e3 * np.median(bounds):.2f}"))
    return table


HEAD = markdown_row(
    "surface", "amplitude / px", "first event at / px", "events per period", "error / %", "events, std / mpx",
    "frames, bound / mpx",
)  # fmt: skip


def main() -> None:
    """Print the table, or write it into the documents."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    table = markdown_table(HEAD, rows(arguments.draws))
    print(table)
    if arguments.write:
        write_marked(PAGE, {"events": table})


if __name__ == "__main__":
    main()
