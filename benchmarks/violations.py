"""What the program does where its assumptions are broken: noticed, covered, harmless, or silently wrong.

    python benchmarks/violations.py [--draws 200] [--only NAME ...] [--write docs/assumptions-tables.md]

Each case is a recording of the simulator with some violations (`shakercal simulate --violate`), evaluated from its
files as a user would; the same seed without them tells what they change. Truth is the sensor's own element at its
reference temperature, and the acceleration of the material point at the sensor origin. 200 draws take about two hours
on one core.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from marked import existing_file, write_marked
from numpy.typing import NDArray
from scipy.stats import binom

from fusion.base import Settings
from fusion.errors import ComputeError, InputError
from fusion.estimation.coverage import Polar
from fusion.estimation.uncertainty import polar_elements
from fusion.recording.load import load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.preset import ChannelSpec, Preset, read_preset
from fusion.simulate.sines import camera_rate, driven, rendered_run, write_run
from fusion.simulate.violations import CATALOGUE, violations
from fusion.simulate.world import Draws, make_world

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
DRIVEN, RATE_HZ, JITTER_S = 2, 8000.0, 30e-9
NOTICED, COVERED, HARMLESS = 0.95, 0.90, 0.10
HEAD = (
    "| violated | rig | noticed | element covered | accelerations covered (worst of six) | shift / U | U / needed "
    "| verdict |\n|---|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True)
class Rig:
    """A light uniaxial recording: driven frequency (Hz), frames, and a camera rate (0: about 0.3 cycles a frame)."""

    frequency_hz: float = 106.25
    frames: int = 48
    rate_hz: float = 0.0
    across: bool = True
    images: bool = False
    head: bool = False
    clocks: bool = False


RIGS = {
    "full": Rig(),
    "slow beat": Rig(frames=200, rate_hz=52.874),
    "53.7 Hz": Rig(53.7),
    "1020.3 Hz": Rig(1020.3),
    "axial": Rig(across=False),
    "head": Rig(across=False, head=True),
    "images": Rig(80.0, 24, images=True),
    "clocks": Rig(clocks=True),
}
"""`full`: four laser points and a triaxial accelerometer on the load, an accelerometer on the base, points of a stereo
pair on either. `axial`: without what sees transverse motion of the load. `head`: the same, its laser points stated as
beams of one head, which shifts and turns. `images`: two small rendered pairs. `clocks`: `full`, its camera
rate drawn within 1/300, its trigger's jitter from 1 ns to 20 us, as the estimate takes both for possible."""
LASERS, CAMERAS = ("velocity", "laser", "vibrometer", "beam"), ("stereo", "camera", "points")
EXPECTED: dict[str, tuple[str, ...]] = {
    "head-tilt": (*LASERS, "head"),
    "scanner-fan": (*LASERS, "head", "mirror"),
    "camera-shake": (*CAMERAS, "shake", "floor"),
    "laser-shake": (*LASERS, "head", "floor"),
    "floor-shake": ("floor", "share", "optical", *LASERS, *CAMERAS),
    "elastic-axial": ("elastic", "rigid", "natural frequency", "joint"),
    "elastic-bending": ("elastic", "rigid", "natural frequency", "joint", "bending"),
    "cable": ("cable", "parallel", "stiffness"),
    "transverse-motion": ("transverse", "unobserved", "not observed", "other load"),
    "warm-sensor": ("temperature",),
    "converter-nonlinearity": ("linear", "harmonic of", "converter"),
    "folded-harmonic": ("alias", "fold", "beside the line", "drift", "stationar"),
    "trigger-jitter": ("trigger", "edge", "jitter", *CAMERAS),
    "locked-clocks": ("same places", "simple multiple"),
    "lens-drift": (*CAMERAS, "epipolar", "drift", "top"),
    "frames-lost": ("frame", "edge", *CAMERAS, "top"),
    "lamp-flicker": ("light", "bright", "lamp", "flicker", *CAMERAS),
    "foil-repeats": ("repeat", "period", "speckle", "match", *CAMERAS),
    "bit-depth": ("bit", "bright", "dark", "grey"),
    "mass": ("mass",),
    "inertia": ("inertia",),
    "point": ("velocity_1", *LASERS),
    "direction": ("velocity_1", *LASERS),
    "laser-reversed": ("velocity_1", "velocity_2", *LASERS),
    "output-reversed": ("sign", "revers", "static sensitivity", "Fz"),
    "lasers-exchanged": ("velocity_1", "velocity_2", *LASERS),
    "outputs-exchanged": ("exchang", "static sensitivity", "output", "swap"),
    "unit-mistaken": ("acceleration", "accelerometer", "unit"),
}
"""Words of notices with the right cause of a violation, or with its group."""
NAMED_BY: dict[str, tuple[str, ...]] = {
    "scanner-fan": ("SC-191",),
    "camera-shake": ("SC-471",),
    "laser-shake": ("SC-471",),
    "floor-shake": ("SC-471",),
    "elastic-axial": ("rigid",),
    "elastic-bending": ("rigid",),
    "cable": ("SC-469",),
    "transverse-motion": ("SC-485", "SC-486"),
    "warm-sensor": ("SC-468",),
    "point": ("SC-467",),
    "direction": ("SC-467",),
}
"""Codes of notices that always name the violated assumption."""
CASES: tuple[tuple[str, tuple[str, ...]], ...] = (
    *((rig, ()) for rig in RIGS),
    ("full", ("transverse-motion",)),
    ("axial", ("transverse-motion",)),
    ("full", ("head-tilt",)),
    ("full", ("head-tilt", "transverse-motion")),
    ("axial", ("head-tilt", "transverse-motion")),
    ("head", ("transverse-motion",)),
    ("head", ("head-tilt", "transverse-motion")),
    ("full", ("scanner-fan",)),
    ("axial", ("scanner-fan",)),
    ("full", ("camera-shake",)),
    ("full", ("laser-shake",)),
    ("axial", ("laser-shake",)),
    ("full", ("floor-shake",)),
    ("1020.3 Hz", ("elastic-axial",)),
    ("1020.3 Hz", ("elastic-bending",)),
    ("53.7 Hz", ("cable",)),
    ("full", ("warm-sensor",)),
    ("full", ("converter-nonlinearity",)),
    ("full", ("folded-harmonic",)),
    ("full", ("trigger-jitter",)),
    ("slow beat", ("trigger-jitter",)),
    ("full", ("locked-clocks",)),
    ("slow beat", ("lens-drift",)),
    ("full", ("frames-lost",)),
    ("slow beat", ("frames-lost",)),
    ("full", ("mass",)),
    ("full", ("inertia",)),
    ("full", ("point",)),
    ("full", ("direction",)),
    ("full", ("direction", "transverse-motion")),
    ("full", ("laser-reversed",)),
    ("axial", ("laser-reversed",)),
    ("full", ("output-reversed",)),
    ("full", ("lasers-exchanged",)),
    ("full", ("outputs-exchanged",)),
    ("full", ("unit-mistaken",)),
    ("axial", ("unit-mistaken",)),
    ("images", ("lens-drift",)),
    ("images", ("lamp-flicker",)),
    ("images", ("foil-repeats",)),
    ("images", ("bit-depth",)),
)
"""Rig and what is violated; every name of the catalogue at least once."""


@lru_cache
def preset_of(rig: Rig) -> Preset:
    """Return the rig with short records: of the rendered ones the demo's, of the others the sweep's."""
    if rig.images:
        return read_preset(Preset, "demo").reduced(rig.frames, 0.45)
    whole = read_preset(Preset, "sweep")
    vibrometer, bridge = whole.daqs
    accelerometer = next(spec for spec in vibrometer.channels if spec.quantity == "acceleration")
    base = replace(
        accelerometer, name="base_acceleration", body="base", point=(0.12, 0.0, -0.045), direction=(0.0, 0.0, 1.0)
    )
    left_out = {f"velocity_{n}" for n in range(5, 9)} | (set() if rig.across else {"acceleration_x", "acceleration_y"})
    channels = [_wider(spec) for spec in vibrometer.channels if spec.name not in left_out]
    daqs = (replace(vibrometer, channels=(*channels, base)), bridge)
    preset = replace(
        whole,
        frames=rig.frames,
        stereo=whole.stereo if rig.across else whole.stereo[1:],
        daqs=tuple(replace(daq, sample_rate_hz=RATE_HZ * (1.0 - 0.05 * n)) for n, daq in enumerate(daqs)),
    )
    preset = preset if rig.head else without_heads(preset)
    return replace(preset, camera_rate_hz=rig.rate_hz or camera_rate(preset, rig.frequency_hz))


def without_heads(preset: Preset) -> Preset:
    """Return a set-up with the beams of its heads as lasers each by itself, which nothing is stated to join."""
    lasers = (s for daq in read_preset(Preset, "nitsche2018").daqs for s in daq.channels if s.quantity == "velocity")
    alone = next(lasers).stated
    daqs = [
        replace(daq, channels=tuple(replace(s, head="", stated=alone) if s.head else s for s in daq.channels))
        for daq in preset.daqs
    ]
    return replace(preset, heads=(), daqs=tuple(daqs))


def _wider(spec: ChannelSpec) -> ChannelSpec:
    """Return a laser's channel at twice its distance from the axis; others as they are."""
    x, y, z = spec.point
    return replace(spec, point=(2.0 * x, 2.0 * y, z)) if spec.quantity == "velocity" else spec


@dataclass(frozen=True)
class Draw:
    """One recording: notices, or the refusal; error of the element and of six accelerations over what is stated.

    `distance`: Mahalanobis distance over the 95 % region's, element first, NaN where not given. `error`, `expanded`: of
    the same seven, what they are off by and their U along the longer axis of the region. `probability`: of the fused
    estimate's chi-square.
    """

    notices: tuple[str, ...]
    refusal: str = ""
    distance: FloatArray | None = None
    error: ComplexArray | None = None
    expanded: FloatArray | None = None
    probability: float = np.nan


def draw(rig: Rig, names: Sequence[str], seed: int) -> Draw:
    """Simulate and evaluate one recording in a folder of its own."""
    preset, jitter_s = preset_of(rig), JITTER_S
    if rig.clocks:
        rng = np.random.default_rng([seed, 20])
        preset = replace(preset, camera_rate_hz=preset.camera_rate_hz * (1.0 + rng.uniform(-1.0, 1.0) / 300.0))
        jitter_s = float(np.exp(rng.uniform(*np.log([1e-9, 2e-5]))))
    if not rig.images:
        motion = np.array([[0.24, 0.18, 60.0, 1.3, 2.0, 1.2], [0.01, 0.01, 0.24, 0.05, 0.05, 0.05]])
        phases = np.exp(2j * np.pi * np.random.default_rng([seed, 18]).uniform(size=motion.shape))
        preset = driven(preset, "Fz", rig.frequency_hz * (1.0 + 2.4e-6), motion * phases)
        # Trigger edges fall on other places between the samples in every draw, or its clocks err alike in all.
        first, *later = np.random.default_rng([seed, 19]).uniform(0.0, 1e-3, len(preset.daqs)).tolist()
        daqs = [replace(d, start_s=d.start_s + s) for d, s in zip(preset.daqs, [0.0, *later], strict=True)]
        preset = replace(preset, first_frame_s=preset.first_frame_s + first, daqs=tuple(daqs))
    draws = Draws(seed, True, violations=violations(names, preset))
    world = make_world(preset, draws, jitter_s)
    with tempfile.TemporaryDirectory() as scratch:
        recording = write_run(Path(scratch), rendered_run(preset), world, draws)
        try:
            found = evaluate_recording(load_manifest(recording), Settings())
        except (InputError, ComputeError) as error:
            return Draw((), str(error).replace(scratch, ""))
    element = driven_element(found)
    truth = np.concatenate([[world.sensitivity[0, DRIVEN, DRIVEN]], world.motion["load"].acceleration[0]])
    fused = next(a for a in found.accelerations if (a.body, a.source) == ("load", "fused"))
    line = int(np.argmin(np.abs(fused.phasors.frequency_hz - rig.frequency_hz)))
    main = np.nan if element is None else complex(element.re, element.im)
    value = np.concatenate([[main], fused.phasors.value[line]])
    stated = [element, *polar_elements(fused.phasors.value, fused.uncertainty)[line]]
    distance, expanded = np.full(7, np.nan), np.full(7, np.nan)
    for place, (off, own) in enumerate(zip(value - truth, stated, strict=True)):
        if own is not None and np.isfinite(own.region_matrix).all():
            matrix, both = own.region_matrix, np.array([off.real, off.imag])
            distance[place] = np.sqrt(both @ np.linalg.solve(matrix, both))
            expanded[place] = np.sqrt(np.linalg.eigvalsh(matrix)[-1])
    notices = tuple(
        f"{notice.code}: {notice.explanation} {notice.possible_size} [{notice.where}]" for notice in found.notices
    )
    return Draw(notices, "", distance, value - truth, expanded, fused.probability)


def driven_element(found: Evaluation) -> Polar | None:
    """Return the program's best statement of the driven element, None where there is none."""
    sensitivity = getattr(found, "element", None) or found.sensitivity  # a ratio where nothing is known of the matrix
    if sensitivity is None:
        return None
    return sensitivity.polar[int(np.argmin(found.lines.multiple))][sensitivity.elements.index((DRIVEN, DRIVEN))]


def opening(text: str) -> str:
    """Return the first words of a notice without its numbers: which kind of notice it is."""
    return " ".join(re.sub(r"[-+−]?\d[\d.]*", "#", text).split()[:4])


@dataclass(frozen=True)
class Row:
    """One case over all its draws; shares of draws, and medians."""

    rig: str
    names: tuple[str, ...]
    draws: int
    noticed: float
    listed: float
    suspects: tuple[str, ...]
    refused: float
    element: float
    accelerations: float
    worst: float
    shift: float
    needed: float

    @property
    def verdict(self) -> str:
        """Say how the case ends, by the bars at the head of this file."""
        # Few draws: what a coverage of 90 % undercuts once in twenty times is no evidence against it.
        bar = COVERED if self.draws >= 100 else 1.0 - float(binom.ppf(0.95, self.draws, 1.0 - COVERED)) / self.draws
        covered = min(self.element, self.worst) >= bar
        if not self.names:
            return "as stated" if covered else "TOO SMALL A U"
        if self.noticed >= NOTICED:
            return "noticed"
        if covered:
            return "harmless" if self.shift < HARMLESS else "covered"
        return "listed" if self.listed >= NOTICED else "refused" if self.refused >= NOTICED else "**SILENT**"

    def cells(self) -> str:
        """Return the row as Markdown."""
        violated = ", ".join(f"`{name}={CATALOGUE[name].size:g}` {CATALOGUE[name].unit}" for name in self.names)
        cells = (
            violated or "nothing",
            self.rig,
            f"{self.noticed:.0%}" if self.names else "–",
            f"{self.element:.0%}",
            f"{self.accelerations:.0%} ({self.worst:.0%})",
            f"{self.shift:.2f}" if self.names else "–",
            "–" if self.names else f"{self.needed:.2f}",
            self.verdict,
        )
        return "| " + " | ".join("–" if "nan" in cell else cell for cell in cells) + " |"


def _largest_median(shifts: Sequence[FloatArray]) -> float:
    """Return the largest of the medians (7,) over all draws, of those quantities that any draw gives; NaN if none."""
    columns = np.array(shifts).reshape(-1, 7).T
    return max((float(np.nanmedian(own)) for own in columns if np.isfinite(own).any()), default=np.nan)


def judge(rig: str, names: tuple[str, ...], found: Sequence[Draw], plain: Mapping[int, Draw]) -> Row:
    """Return what all draws of a case say together; `plain`: the same seeds without violations."""
    expects = {word.lower() for name in names for word in EXPECTED[name]}
    noticed, told, suspects = 0, 0, Counter[str]()
    for seed, one in enumerate(found, 1):
        usual = {opening(text) for text in plain[seed].notices}
        new = [text for text in (*one.notices, one.refusal) if text and opening(text) not in usual]
        named = {word for word in expects for text in new if word in text.lower()}
        standing = {word for name in names for word in NAMED_BY.get(name, ())}
        noticed += bool(named)
        told += any(word in text for word in standing for text in one.notices)
        suspects.update(named)
    given = [one for one in found if one.distance is not None]
    empty = np.full((1, 7), np.nan)
    distance = np.stack([one.distance for one in given if one.distance is not None]) if given else empty
    inside = np.where(np.isfinite(distance), distance <= 1.0, np.nan)
    shares = [float(np.nanmean(column)) if np.isfinite(column).any() else np.nan for column in inside.T]
    shift = [
        np.abs(one.error - same.error) / same.expanded
        for one, same in ((one, plain[seed]) for seed, one in enumerate(found, 1))
        if one.error is not None and same.error is not None and same.expanded is not None
    ]
    return Row(
        rig,
        names,
        len(found),
        noticed / len(found),
        told / len(found),
        tuple(word for word, _ in suspects.most_common(3)),
        float(np.mean([bool(one.refusal) for one in found])),
        shares[0],
        float(np.nanmean(inside[:, 1:])) if np.isfinite(inside[:, 1:]).any() else np.nan,
        float(np.nanmin(shares[1:])) if np.isfinite(shares[1:]).any() else np.nan,
        _largest_median(shift),
        1.0 / float(np.nanquantile(distance[:, 0], 0.95)) if np.isfinite(distance[:, 0]).any() else np.nan,
    )


def rows(draws: int, cases: Sequence[tuple[str, tuple[str, ...]]]) -> list[Row]:
    """Return one row per case, printed as they come."""
    plain: dict[str, dict[int, Draw]] = {}
    done = []
    for rig, names in cases:
        if rig not in plain:
            plain[rig] = {seed: draw(RIGS[rig], (), seed) for seed in range(1, draws + 1)}
        found = [draw(RIGS[rig], names, seed) if names else plain[rig][seed] for seed in range(1, draws + 1)]
        done.append(judge(rig, names, found, plain[rig]))
        print(done[-1].cells(), flush=True)
    return done


def catalogue() -> str:
    """Return what can be violated, as a table."""
    lines = [f"| `{name}` | {v.size:g} {v.unit} | {v.about} | {v.needs} |" for name, v in CATALOGUE.items()]
    return "\n".join(["| name | size where none is given | what happens | needs |", "|---|---|---|---|", *lines])


def main(arguments: Sequence[str] = ()) -> None:
    """Print the table, and write it into a document where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--write", type=existing_file)
    options = parser.parse_args(arguments)
    chosen = [case for case in CASES if options.only is None or set(case[1]) & set(options.only)]
    print(HEAD)
    table = "\n".join([HEAD, *(row.cells() for row in rows(options.draws, chosen))])
    if options.write:
        write_marked(options.write, {"violations": table, "catalogue": catalogue()})


if __name__ == "__main__":
    main(sys.argv[1:])
