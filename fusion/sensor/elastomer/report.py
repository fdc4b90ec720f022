"""Result folder and page of an elastic element."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fusion.base import ProgressCallback, no_progress
from fusion.estimation.uncertainty import DASH, rounded
from fusion.report.csv_files import Row, csv_text
from fusion.report.h5 import write_fields, write_value
from fusion.report.numbers import measured
from fusion.report.provenance import check_folder, hash_files
from fusion.report.recording import ResultFolder, log_notices, page_frame
from fusion.report.style import Picture
from fusion.report.tables import Headline, Table, render_page
from fusion.sensor.elastomer.definition import read_definition
from fusion.sensor.elastomer.evaluate import (
    Column,
    ElementEvaluation,
    Fact,
    evaluate_element,
    frame_shapes,
    solid_shapes,
)
from fusion.sensor.elastomer.figures import Compared, HandCurve, draw_compared, draw_hand, draw_shapes
from shaker.elastomer.frame import NAMES
from shaker.elastomer.solid import converged

# The numbers of an elastic element as rows and tables: csv files, the page's tables, and what the command prints.


MODES = ["model", "refinement", "unknowns", "mode", "frequency_hz", *(f"participation_{name}" for name in NAMES)]
STIFFNESS = ["model", "component", "stiffness", "unit"]
COMPARISON = ["column", "kind", "mode", "frequency_hz", "u_hz"]
STATICS = ["name", "printed", "right", "unit", "remark"]
PLATFORM = ["half_size_m", "mass_kg", "height_m", "gyration_x_m", "gyration_z_m", "largest_misfit"]
SPREAD = "spread"
"""Column of comparison.csv: (max - min)/max of a mode over all columns, as a ratio."""
DIMENSION_LABELS = {
    "span_m": "span l",
    "beam_width_m": "beam width",
    "beam_height_m": "beam height",
    "compliant_thickness_m": "compliant beam's thickness",
    "compliant_length_m": "compliant beam's length",
    "compliant_height_m": "compliant beam's height",
    "half_size_m": "platform's half-size, its mass as it is",
    "mass_kg": "platform's mass, moments in proportion",
    "height_m": "platform's centre of mass",
    "inertia_kgm2": "platform's moments of inertia",
}
MILLI = 1e3


def mode_rows(evaluation: ElementEvaluation) -> Iterator[Row]:
    """One row per mode of the frame, then of the solid on every mesh, and with a platform that does not bend."""
    frame = evaluation.frame
    for place, name in enumerate(NAMES):
        share = frame.modes.participation[place].tolist()
        frequency = float(frame.modes.frequency_hz[place])
        yield ["frame", 0, len(frame.modes.shape), name, frequency, *share]
    if evaluation.solid is None:
        return
    study = evaluation.solid
    models = [("solid", *pair) for pair in zip(study.refinements, study.meshes, strict=True)]
    for label, refinement, model in [*models, ("solid, rigid platform", study.refinements[-2], study.rigid)]:
        for place, name in enumerate(NAMES):
            frequency = float(model.frequency_hz[place])
            yield [label, refinement, model.unknowns, name, frequency, *([np.nan] * 6)]


def stiffness_rows(evaluation: ElementEvaluation) -> Iterator[Row]:
    """One row per model and direction: load per displacement of the platform in its own direction."""
    found = {"frame": evaluation.frame.stiffness}
    if evaluation.solid is not None:
        found["solid"] = evaluation.solid.finest.stiffness
        found["solid, rigid platform"] = evaluation.solid.rigid.stiffness
    for label, stiffness in found.items():
        for place, name in enumerate(NAMES):
            yield [label, f"k{name}", float(stiffness[place]), "N/m" if place < 3 else "N.m/rad"]


def comparison_rows(evaluation: ElementEvaluation) -> Iterator[Row]:
    """One row per column and mode, then the spread of every mode."""
    for column in evaluation.columns:
        for place, name in enumerate(NAMES):
            if np.isfinite(column.frequency_hz[place]):
                yield [column.name, column.kind, name, float(column.frequency_hz[place]), float(column.u_hz[place])]
    for name, spread in zip(NAMES, evaluation.spread, strict=True):
        yield [SPREAD, "(max - min)/max", name, float(spread), np.nan]


def statics_rows(evaluation: ElementEvaluation) -> Iterator[Row]:
    """One row per number of the beam formulas."""
    for fact in evaluation.facts:
        printed = np.nan if fact.printed is None else fact.printed
        yield [fact.name, printed, np.nan if fact.right is None else fact.right, fact.unit, fact.remark]


def platform_rows(evaluation: ElementEvaluation) -> Iterator[Row]:
    """One row per half-size for which platform data were fitted."""
    for fit in evaluation.fits:
        part = fit.platform
        gyration = part.gyration_m
        numbers: Row = [part.mass_kg, part.height_m, float(gyration[0]), float(gyration[2]), fit.misfit]
        yield [fit.half_size_m, *numbers]


def headlines(evaluation: ElementEvaluation) -> list[Headline]:
    """Frequencies of the frame, those of the solid below."""
    found, solid = [], evaluation.solid
    frequency = evaluation.frame.modes.frequency_hz
    for label, place in (("Tx", 0), ("Tz", 2), ("Rx", 3), ("Rz", 5)):
        remark = "" if solid is None else f"solid: {solid.finest.frequency_hz[place]:.0f} Hz"
        found.append(Headline(f"{label}, frame", f"{frequency[place]:.1f} Hz", remark))
    return found


def comparison_table(evaluation: ElementEvaluation) -> Table:
    """Natural frequencies by every model and measurement, and how far they are apart."""
    rows = []
    for column in evaluation.columns:
        texts = [_texts(column, place) for place in range(6)]
        rows.append((column.name, *(value for value, _ in texts)))
        if any(expanded for _, expanded in texts):
            rows.append((f"U of {column.name}", *(expanded or DASH for _, expanded in texts)))
    rows.append(("(max − min)/max / %", *(_percent(value) for value in evaluation.spread)))
    caption = "Natural frequencies in Hz; U: k = 2"
    return Table(caption, ("model", *NAMES), "lrrrrrr", tuple(rows))


def statics_table(evaluation: ElementEvaluation) -> Table:
    """The beam formulas."""
    rows = [
        (fact.label, _number(fact.printed, fact), _number(fact.right, fact), fact.unit.replace("1", "–"), fact.remark)
        for fact in evaluation.facts
    ]
    head = ("quantity", "formula as printed", "right", "unit", "remark")
    return Table("Beam formulas", head, "lrrll", tuple(rows))


def stiffness_table(evaluation: ElementEvaluation) -> Table:
    """Static stiffness of the platform by model."""
    by_model: dict[str, list[str]] = {}
    for row in stiffness_rows(evaluation):
        by_model.setdefault(str(row[0]), []).append(_plain(float(row[2])))
    head = ("model", *(f"{name} / (N/m)" for name in NAMES[:3]), *(f"{name} / (N·m/rad)" for name in NAMES[3:]))
    caption = "Static stiffness: load per displacement in its own direction, the others free"
    return Table(caption, head, "lrrrrrr", tuple((label, *cells) for label, cells in by_model.items()))


def participation_table(evaluation: ElementEvaluation) -> Table:
    """What each mode of the frame consists of."""
    modes = evaluation.frame.modes
    rows = [
        (name, f"{modes.frequency_hz[place]:.1f}", *(f"{100.0 * share:.1f}" for share in modes.participation[place]))
        for place, name in enumerate(NAMES)
    ]
    caption = "Frame: share of each rigid motion's mass that moves in a mode / %"
    return Table(caption, ("mode", "Hz", *NAMES), "lrrrrrrr", tuple(rows))


def convergence_table(evaluation: ElementEvaluation) -> Table | None:
    """The solid on every mesh."""
    study = evaluation.solid
    if study is None:
        return None
    rows = []
    for refinement, model in zip(study.refinements, study.meshes, strict=True):
        rows.append((f"mesh {refinement}", f"{model.unknowns}", *(f"{value:.1f}" for value in model.frequency_hz)))
    rows.append(("change with the last mesh / %", "", *(_percent(value) for value in converged(study.meshes))))
    label = f"mesh {study.refinements[-2]}, platform that does not bend"
    rows.append((label, f"{study.rigid.unknowns}", *(f"{value:.1f}" for value in study.rigid.frequency_hz)))
    frame = evaluation.frame.modes.frequency_hz
    rows.append(("frame less solid / %", "", *(_percent(value) for value in frame / study.finest.frequency_hz - 1.0)))
    apart = frame / study.rigid.frequency_hz - 1.0
    rows.append(("frame less that of a rigid platform / %", "", *(_percent(value) for value in apart)))
    caption = "Solid: natural frequencies in Hz as the mesh gets finer"
    return Table(caption, ("mesh", "unknowns", *NAMES), "lrrrrrrr", tuple(rows))


def sensitivity_table(evaluation: ElementEvaluation) -> Table:
    """Percent of frequency per percent of a dimension."""
    rows = [
        (DIMENSION_LABELS[name], *(_signed(value) for value in values))
        for name, values in evaluation.sensitivity.items()
    ]
    caption = "What tolerances do: change of the frame's frequencies in % per % of"
    return Table(caption, ("dimension", *NAMES), "lrrrrrr", tuple(rows))


def platform_table(evaluation: ElementEvaluation) -> Table | None:
    """Platform data that give the wanted frequencies."""
    rows = []
    for half_size, mass, height, across, along, misfit in platform_rows(evaluation):
        lengths = (f"{MILLI * float(value):.2f}" for value in (height, across, along))
        share = 100.0 * float(misfit)
        told = "< 0.01" if share < 0.01 else f"{share:.2g}"
        rows.append((f"{MILLI * float(half_size):g}", f"{MILLI * float(mass):.2f}", *lengths, told))
    head = ("half-size / mm", "mass / g", "height / mm", "gyration x, y / mm", "gyration z / mm", "misfit / %")
    caption = "Platforms that have the wanted frequencies: any of them, so none is validated"
    return Table(caption, head, "rrrrrr", tuple(rows)) if rows else None


def mounted_table(evaluation: ElementEvaluation) -> Table | None:
    """Modes of the chain of hand, sensor and pedestal."""
    mounted = evaluation.mounted
    if mounted is None:
        return None
    rows = [
        (f"{n + 1}", f"{f:.1f}", f"{z:.4f}", f"{f * np.sqrt(1.0 - z * z):.1f}" if z < 1.0 else DASH)
        for n, (f, z) in enumerate(zip(mounted.frequency_hz, mounted.damping_ratio, strict=True))
    ]
    caption = f"Hand, sensor, pedestal in a row along {mounted.direction}: roots of det Z = 0"
    return Table(caption, ("mode", "natural frequency / Hz", "damping ratio", "damped / Hz"), "lrrr", tuple(rows))


def printed(evaluation: ElementEvaluation) -> Iterator[str]:
    """Lines for the terminal."""
    width = max(len(column.name) for column in evaluation.columns)
    yield f"{'':{width}}  " + "  ".join(f"{name:>14}" for name in NAMES) + "  Hz"
    for column in evaluation.columns:
        cells = (_cell(column, place) for place in range(6))
        yield f"{column.name:{width}}  " + "  ".join(f"{cell:>14}" for cell in cells)
    label = "spread"
    yield f"{label:{width}}  " + "  ".join(f"{_percent(value) + ' %':>14}" for value in evaluation.spread)
    stiffness = evaluation.frame.stiffness
    yield f"stiffness (frame): kx {stiffness[0]:.4g} N/m, kz {stiffness[2]:.4g} N/m"
    if evaluation.mounted is not None:
        told = ", ".join(f"{value:.1f}" for value in evaluation.mounted.frequency_hz)
        yield f"mounted, {evaluation.mounted.direction}: {told} Hz"
    for fit in evaluation.fits:
        part = fit.platform
        lengths = ", ".join(f"{MILLI * value:.1f}" for value in (part.height_m, part.gyration_m[0], part.gyration_m[2]))
        told = f"{MILLI * part.mass_kg:.2f} g, height and gyrations {lengths} mm"
        yield f"fitted platform, half-size {MILLI * fit.half_size_m:g} mm: {told}"


def _cell(column: Column, place: int) -> str:
    """One frequency, with U where it is measured."""
    value, expanded = _texts(column, place)
    return f"{value} ± {expanded}" if expanded else value


def _texts(column: Column, place: int) -> tuple[str, str]:
    """One frequency and its U, which is empty of what is not measured."""
    value, u = float(column.frequency_hz[place]), float(column.u_hz[place])
    if not np.isfinite(value):
        return DASH, ""
    if column.kind != "measured" or not np.isfinite(u):
        return f"{value:.6g}" if column.kind == "stated" else f"{value:.1f}", ""
    text = rounded(value, 2.0 * u, 0)
    return text.value, text.expanded


def _number(value: float | None, fact: Fact) -> str:
    """A number of the beam formulas."""
    if value is None:
        return DASH
    return _plain(value) if fact.unit in ("N/m", "Pa") else f"{value:.4g}"


def _plain(value: float) -> str:
    """Four significant digits with a power of ten, as HTML."""
    return measured(float(f"{value:.4g}"), 0.0)


def _percent(value: float) -> str:
    """A ratio as percent."""
    return DASH if not np.isfinite(value) else f"{100.0 * value:.2f}".replace("-", "\N{MINUS SIGN}")


def _signed(value: float) -> str:
    """A number with two decimals."""
    return f"{value + 0.0:.2f}".replace("-0.00", "0.00").replace("-", "\N{MINUS SIGN}")


# elastomer.html: one self-contained page with comparison, stiffness, shapes and origin of an element's models.


PAGE_FILE = "elastomer.html"
SHAPE_FILES = ("shapes-frame.png", "shapes-solid.png")


def shape_pictures(evaluation: ElementEvaluation) -> dict[str, tuple[Picture, bytes]]:
    """Return the pictures of the shapes by the name of their file."""
    found = {}
    shapes = frame_shapes(evaluation.definition, evaluation.frame)
    found[SHAPE_FILES[0]] = draw_shapes("elastomer-shapes-frame", "Mode shapes of the frame", shapes)
    if evaluation.solid is not None:
        outside = solid_shapes(evaluation.solid.meshes[0], evaluation.solid.finest)
        found[SHAPE_FILES[1]] = draw_shapes("elastomer-shapes-solid", "Mode shapes of the solid", outside)
    return found


def render_element_page(evaluation: ElementEvaluation, shapes: list[Picture]) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("elastomer.html", _context(evaluation, shapes))


def _context(evaluation: ElementEvaluation, shapes: list[Picture]) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": headlines(evaluation),
        "comparison": comparison_table(evaluation),
        "compared": [draw_compared(_compared(evaluation))],
        "shapes": shapes,
        "participation": participation_table(evaluation),
        "stiffness": stiffness_table(evaluation),
        "statics": statics_table(evaluation),
        "convergence": convergence_table(evaluation),
        "sensitivity": sensitivity_table(evaluation),
        "platform": platform_table(evaluation),
        "mounted": mounted_table(evaluation),
        "hand": _hand(evaluation),
        **page_frame(evaluation),
    }


def _subject(evaluation: ElementEvaluation) -> list[tuple[str, str]]:
    """What the element is made of."""
    beams, part = evaluation.definition.beams, evaluation.definition.platform
    size = evaluation.definition.file.platform.half_size
    material = beams.material
    cross = f"span {1e3 * beams.span_m:g} mm, {1e3 * beams.beam_width_m:g} × {1e3 * beams.beam_height_m:g} mm"
    compliant = f"{1e3 * beams.compliant_length_m:g} mm long, {1e3 * beams.compliant_thickness_m:g} × "
    compliant += f"{1e3 * beams.compliant_height_m:g} mm"
    gyration = part.gyration_m * 1e3
    rigid = f"{2e3 * size:g} mm square, {1e3 * part.mass_kg:.4g} g, centre {1e3 * part.height_m:.4g} mm high, "
    rigid += f"gyration {gyration[0]:.4g}, {gyration[1]:.4g}, {gyration[2]:.4g} mm"
    return [
        (
            "Material",
            f"E {1e-9 * material.youngs_modulus_pa:g} GPa, ν {material.poisson_ratio:g}, "
            f"{material.density_kgm3:g} kg/m³",
        ),
        ("Cross beams", cross),
        ("Compliant beams", compliant),
        ("Platform and parts", rigid),
    ]


def _compared(evaluation: ElementEvaluation) -> Compared:
    """The columns as the figure takes them."""
    columns = evaluation.columns
    return Compared(
        columns=tuple(column.name for column in columns),
        modes=NAMES,
        frequency_hz=np.stack([column.frequency_hz for column in columns]),
        expanded_hz=np.stack([2.0 * column.u_hz for column in columns]),
        reference=next(i for i, column in enumerate(columns) if column.kind == "frame"),
    )


def _hand(evaluation: ElementEvaluation) -> list[Picture]:
    """The mounted resonance over the hand's mass."""
    mounted, told = evaluation.mounted, evaluation.definition.file.mounting
    if mounted is None or told is None:
        return []
    unit = "kg" if mounted.direction.startswith("T") else "kg·m²"
    curve = HandCurve(
        mounted.direction, unit, mounted.hand_mass, mounted.mounted_hz, told.hand_mass, mounted.frequency_hz
    )
    return [draw_hand(curve)]


# The folder of an element's models: tables, pictures, HDF5 file and page, whole or not at all.


FORMAT = 1
H5_FILE = "elastomer.h5"
OWN_FILE = re.compile(
    r"(modes|stiffness|comparison|statics|platform)\.csv|shapes-(frame|solid)\.png|elastomer\.(h5|html)"
)


def write_element(evaluation: ElementEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    return ResultFolder(H5_FILE, OWN_FILE, _results_texts, _fill).write(evaluation, folder, force=force)


def _results_texts(evaluation: ElementEvaluation) -> dict[str, str | bytes]:
    """Tables, pictures and page."""
    shapes = shape_pictures(evaluation)
    found: dict[str, str | bytes] = {
        "comparison.csv": csv_text(COMPARISON, comparison_rows(evaluation)),
        "modes.csv": csv_text(MODES, mode_rows(evaluation)),
        "stiffness.csv": csv_text(STIFFNESS, stiffness_rows(evaluation)),
        "statics.csv": csv_text(STATICS, statics_rows(evaluation)),
    }
    if evaluation.fits:
        found["platform.csv"] = csv_text(PLATFORM, platform_rows(evaluation))
    found.update({name: png for name, (_, png) in shapes.items()})
    found[PAGE_FILE] = render_element_page(evaluation, [picture for picture, _ in shapes.values()])
    return found


def _fill(file: h5py.File, evaluation: ElementEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["name"] = evaluation.name
    file.attrs["shapes"] = "unknowns ux uy uz rx ry rz of the platform's point in the plane of the beams, then of nodes"
    definition = evaluation.definition
    write_value(file, "beams", definition.beams)
    write_value(file, "platform", definition.platform)
    _write_frame(file.create_group("frame", track_order=True), evaluation)
    if evaluation.solid is not None:
        group = file.create_group("solid", track_order=True)
        for refinement, model in zip(evaluation.solid.refinements, evaluation.solid.meshes, strict=True):
            write_fields(group.create_group(f"mesh_{refinement}", track_order=True), model)
        write_fields(group.create_group("rigid_platform", track_order=True), evaluation.solid.rigid)
    columns = file.create_group("comparison", track_order=True)
    for column in evaluation.columns:
        write_fields(columns.create_group(column.name, track_order=True), column)
    write_value(file, "sensitivity", evaluation.sensitivity)
    for fit in evaluation.fits:
        own = file.require_group("fits").create_group(f"half_size_{fit.half_size_m:g}", track_order=True)
        write_value(own, "platform", fit.platform)
        write_value(own, "frequency_hz", fit.frequency_hz)
        own.attrs["largest_misfit"] = fit.misfit
    write_value(file, "mounted", evaluation.mounted)


def _write_frame(group: h5py.Group, evaluation: ElementEvaluation) -> None:
    """Nodes, beams and modes of the frame."""
    model = evaluation.frame
    for name in ("node_m", "beam", "rigid", "clamped"):
        write_value(group, name, getattr(model.frame, name))
    write_value(group, "modes", model.modes)
    write_value(group, "stiffness", model.stiffness)
    write_value(group, "node_motion", model.frame.reduction @ model.modes.shape)


# The command `shakercal elastomer`: GEOMETRY.toml → models, result folder.


log = logging.getLogger("shakercal")
DEFAULT_FOLDER, FILE_NAME = "elastomer", "elastomer.toml"


def run_elastomer(
    path: Path,
    output: Path | None,
    *,
    solid: bool = False,
    force: bool = False,
    progress: ProgressCallback = no_progress,
) -> None:
    """Model the element that a file (or elastomer.toml in a folder) states, write the results, print the comparison.

    Results stand in the folder `elastomer` beside the file, or in `output`.
    """
    file = path / FILE_NAME if path.is_dir() else path
    definition = read_definition(file)
    folder = file.parent / DEFAULT_FOLDER if output is None else output
    hashes = hash_files(definition.files, file.parent)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    evaluation = evaluate_element(definition, hashes, solid=solid, progress=progress)
    log_notices(evaluation, log)
    write_element(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")
