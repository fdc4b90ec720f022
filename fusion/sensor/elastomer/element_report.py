"""Files, page and printed lines of models of an elastic element, and the command."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from fusion.base import DASH, MILLI, PERCENT, FileIdentity, ProgressCallback, no_progress, round_to_uncertainty
from fusion.report.figure import BLACK, BLUE, COLOURS, GREY, RED, empty_figure
from fusion.report.figure import Figure as Drawing
from fusion.report.figure_files import PrintedFigure, drawing, figure_bytes, finish, new_figure
from fusion.report.folder import CommandReport, hash_files
from fusion.report.h5 import write_value
from fusion.report.report_scene import Scene, SceneMotion, scene_page
from fusion.report.scene_views import SceneShape
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    columns_of,
    csv_text,
    page_column,
    quantity_html,
    signed_text,
    table,
    text_column,
)
from fusion.sensor.elastomer.element_definition import read_definition
from fusion.sensor.elastomer.element_evaluation import (
    ComparedColumn,
    DrawnShape,
    ElementEvaluation,
    StaticsFact,
    evaluate_element,
    frame_shapes,
    solid_shapes,
    spread,
)
from shaker.elastomer.frame import MODE_NAMES, PlatformFit, RigidPart
from shaker.elastomer.solid import SolidModel, mesh_change
from shakercal._common.arrays import FloatArray

PLATFORMS = "Platforms with the target frequencies: all are possible, none is validated"
SPREAD = "spread"
"""Column of comparison.csv: (max - min)/max of a mode over all columns, as a ratio."""
DIMENSION_LABELS = {
    "span_m": "span l",
    "beam_width_m": "beam width",
    "beam_height_m": "beam height",
    "compliant_thickness_m": "compliant beam's thickness",
    "compliant_length_m": "compliant beam's length",
    "compliant_height_m": "compliant beam's height",
    "half_size_m": "platform's half-size at constant mass",
    "mass_kg": "platform's mass, moments in proportion",
    "height_m": "platform's centre of mass",
    "inertia_kgm2": "platform's moments of inertia",
}


class ModeRow(NamedTuple):
    """One mode of a model in modes.csv; participation of the solid's modes is not computed."""

    model: str
    refinement: int
    unknowns: int
    mode: str
    frequency_hz: float
    participation: FloatArray


def _participation(index: int) -> TableColumn[ModeRow]:
    """Return the column of the share of one rigid motion in a mode."""
    return TableColumn(f"participation_{MODE_NAMES[index]}", lambda row: float(row.participation[index]))


MODES: list[TableColumn[ModeRow]] = [*columns_of(ModeRow)[:-1], *map(_participation, range(len(MODE_NAMES)))]


class StiffnessRow(NamedTuple):
    """Load per displacement of the platform in the same direction, by one model."""

    model: str
    component: str
    stiffness: float
    unit: str


class ComparisonRow(NamedTuple):
    """One mode by one model or measurement, or its relative range over all."""

    column: str
    kind: str
    mode: str
    frequency_hz: float
    u_hz: float


def _number(fact: StaticsFact, value: float) -> str:
    """Return a number of the beam formulas as text."""
    if np.isnan(value):
        return DASH
    return _plain(value) if fact.unit in ("N/m", "Pa") else f"{value:.4g}"


def _plain(value: float) -> str:
    """Return four significant digits with a power of ten, as HTML."""
    return quantity_html(float(f"{value:.4g}"), 0.0)


STATICS: list[TableColumn[StaticsFact]] = [
    text_column("name", lambda fact: fact.name),
    page_column("quantity", lambda fact: fact.label, "l"),
    TableColumn("printed", lambda fact: fact.printed, "formula as printed", lambda fact: _number(fact, fact.printed)),
    TableColumn("right", lambda fact: fact.right, "right", lambda fact: _number(fact, fact.right)),
    TableColumn("unit", lambda fact: fact.unit, "unit", lambda fact: fact.unit.replace("1", DASH), "l"),
    text_column("remark", lambda fact: fact.remark, "remark"),
]


def _in_milli(name: str, head: str, value: Callable[[RigidPart], float]) -> TableColumn[PlatformFit]:
    """Return a column of the fitted platform, on pages in thousandths of its unit."""
    return TableColumn(name, lambda fit: float(value(fit.platform)), head, lambda f: f"{MILLI * value(f.platform):.2f}")


def _misfit(ratio: float) -> str:
    return "< 0.01" if ratio < 1e-4 else f"{100.0 * ratio:.2g}"


PLATFORM: list[TableColumn[PlatformFit]] = [
    TableColumn("half_size_m", lambda fit: fit.half_size_m, "half-size / mm", lambda f: f"{MILLI * f.half_size_m:g}"),
    _in_milli("mass_kg", "mass / g", lambda part: part.mass_kg),
    _in_milli("height_m", "height / mm", lambda part: part.height_m),
    _in_milli("gyration_x_m", "gyration x, y / mm", lambda part: part.gyration_m[0]),
    _in_milli("gyration_z_m", "gyration z / mm", lambda part: part.gyration_m[2]),
    TableColumn("largest_misfit", lambda fit: fit.misfit, "misfit / %", lambda fit: _misfit(fit.misfit)),
]


def mode_rows(evaluation: ElementEvaluation) -> Iterator[ModeRow]:
    """Yield one row per mode of the frame and of the solid on every mesh."""
    modes, study = evaluation.frame.modes, evaluation.solid
    for index, name in enumerate(MODE_NAMES):
        frequency = float(modes.frequency_hz[index])
        yield ModeRow("frame", 0, len(modes.shape), name, frequency, modes.participation[index])
    if study is not None:
        models = [("solid", *pair) for pair in zip(study.refinements, study.meshes, strict=True)]
        for label, refinement, model in [*models, ("solid, rigid platform", study.refinements[-2], study.rigid)]:
            for name, frequency in zip(MODE_NAMES, model.frequency_hz.tolist(), strict=True):
                yield ModeRow(label, refinement, model.unknowns, name, frequency, np.full(len(MODE_NAMES), np.nan))


def stiffnesses(evaluation: ElementEvaluation) -> dict[str, FloatArray]:
    """Return the stiffness (6,) of every model."""
    solid = evaluation.solid
    models = {} if solid is None else {"solid": solid.finest, "solid, rigid platform": solid.rigid}
    return {"frame": evaluation.frame.stiffness, **{name: model.stiffness for name, model in models.items()}}


def comparison_rows(evaluation: ElementEvaluation) -> Iterator[ComparisonRow]:
    """Yield one row per column and mode, then the relative range of every mode."""
    for column in evaluation.columns:
        for name, frequency, u in zip(MODE_NAMES, column.frequency_hz.tolist(), column.u_hz.tolist(), strict=True):
            if np.isfinite(frequency):
                yield ComparisonRow(column.name, column.kind, name, frequency, u)
    for name, ratio in zip(MODE_NAMES, spread(evaluation.columns).tolist(), strict=True):
        yield ComparisonRow(SPREAD, "(max - min)/max", name, ratio, np.nan)


def headlines(evaluation: ElementEvaluation) -> list[Headline]:
    """Return the frequencies of the frame, with those of the solid."""
    frame, solid = evaluation.frame.modes.frequency_hz, evaluation.solid
    of_solid = [""] * len(MODE_NAMES)
    if solid is not None:
        of_solid = [f"solid: {value:.0f} Hz" for value in solid.finest.frequency_hz]
    shown = [MODE_NAMES.index(name) for name in ("Tx", "Tz", "Rx", "Rz")]
    return [Headline(f"{MODE_NAMES[index]}, frame", f"{frame[index]:.1f} Hz", of_solid[index]) for index in shown]


def _by_mode(caption: str, head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Table:
    """Return a table whose last columns are the modes."""
    return Table(caption, (*head, *MODE_NAMES), "l" + "r" * (len(head) + 5), tuple(rows))


def comparison_table(evaluation: ElementEvaluation) -> Table:
    """Return the natural frequencies by every model and measurement, with their relative range."""
    rows = []
    for column in evaluation.columns:
        values, expanded = zip(*(_with_u(column, index) for index in range(6)), strict=True)
        rows.append((column.name, *values))
        if any(expanded):
            rows.append((f"U of {column.name}", *(text or DASH for text in expanded)))
    rows.append(("(max − min)/max / %", *(signed_text(PERCENT * value) for value in spread(evaluation.columns))))
    return _by_mode("Natural frequencies in Hz; U: k = 2", ("model",), rows)


def stiffness_table(evaluation: ElementEvaluation) -> Table:
    """Return the static stiffness of the platform by model."""
    rows = tuple((label, *map(_plain, values.tolist())) for label, values in stiffnesses(evaluation).items())
    head = ("model", *(f"{name} / (N{'/m' if name.startswith('T') else '·m/rad'})" for name in MODE_NAMES))
    caption = "Static stiffness: load per displacement in the same direction, the others free"
    return Table(caption, head, "lrrrrrr", rows)


def participation_table(evaluation: ElementEvaluation) -> Table:
    """Return the shares of the rigid motions in each mode of the frame."""
    modes = evaluation.frame.modes
    rows = [
        (name, f"{modes.frequency_hz[index]:.1f}", *(f"{100.0 * share:.1f}" for share in modes.participation[index]))
        for index, name in enumerate(MODE_NAMES)
    ]
    return _by_mode("Frame: share of each rigid motion's mass that moves in a mode / %", ("mode", "Hz"), rows)


def convergence_table(evaluation: ElementEvaluation) -> Table | None:
    """Return the frequencies of the solid on every mesh."""
    study, frame = evaluation.solid, evaluation.frame.modes.frequency_hz
    if study is None:
        return None

    def on_mesh(label: str, model: SolidModel) -> tuple[str, ...]:
        return label, f"{model.unknowns}", *(f"{value:.1f}" for value in model.frequency_hz)

    def deviations(label: str, ratios: FloatArray) -> tuple[str, ...]:
        return label, "", *(signed_text(PERCENT * value) for value in ratios)

    rows = [on_mesh(f"mesh {n}", model) for n, model in zip(study.refinements, study.meshes, strict=True)]
    rows += [
        deviations("change with the last mesh / %", mesh_change(study.meshes)),
        on_mesh(f"mesh {study.refinements[-2]}, platform that does not bend", study.rigid),
        deviations("frame less solid / %", frame / study.finest.frequency_hz - 1.0),
        deviations("frame less that of a rigid platform / %", frame / study.rigid.frequency_hz - 1.0),
    ]
    return _by_mode("Solid: natural frequencies in Hz as the mesh gets finer", ("mesh", "unknowns"), rows)


def sensitivity_table(evaluation: ElementEvaluation) -> Table:
    """Return the relative change of frequency per relative change of a dimension."""
    rows = [(DIMENSION_LABELS[name], *map(signed_text, values)) for name, values in evaluation.sensitivity.items()]
    return _by_mode("Effect of tolerances: change of the frame's frequencies in % per % of", ("dimension",), rows)


def mounted_table(evaluation: ElementEvaluation) -> Table | None:
    """Return the modes of the chain of hand, sensor and pedestal."""
    mounted = evaluation.mounted
    if mounted is None:
        return None
    rows = [
        (f"{n + 1}", f"{f:.1f}", f"{z:.4f}", f"{f * np.sqrt(1.0 - z * z):.1f}" if z < 1.0 else DASH)
        for n, (f, z) in enumerate(zip(mounted.frequency_hz, mounted.damping_ratio, strict=True))
    ]
    caption = f"Hand, sensor, pedestal in a row along {mounted.direction}: roots of det Z = 0"
    return Table(caption, ("mode", "natural frequency / Hz", "damping ratio", "damped / Hz"), "lrrr", tuple(rows))


# Figures: mode shapes in space, models against one another, the resonance under a hand.

ENLARGED = 0.08
"""Largest displacement drawn, over the size of the element."""
SHOWN_M = 1e-6
"""Largest displacement of a mode in space, magnified by the page."""
VIEW = {"elev": 26.0, "azim": -58.0}
METHOD_COLOURS = (BLACK, *COLOURS, GREY)
MARKERS = ("circle", "square", "diamond", "triangle", "inverted_triangle", "cross", "x", "plus")


def draw_shapes(name: str, title: str, shapes: Sequence[DrawnShape]) -> tuple[PrintedFigure, bytes]:
    """Draw six modes in space, deformed in colour; return figure and PNG file."""
    with drawing(name):
        figure = new_figure(4.6)
        for index, shape in enumerate(shapes):
            _panel(figure, index, shape)
        figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.96, wspace=0.0, hspace=0.06)
        caption = (
            "Grey lines: at rest. Colour: displacement, from none (dark) to the largest (bright); the same largest "
            "displacement is drawn in every panel, far larger than any real one."
        )
        return finish(figure, name, title, caption), figure_bytes(figure, "png")


def element_scene(name: str, shapes: Sequence[DrawnShape]) -> Scene:
    """Return the modes of an element as motions of its faces in space."""
    corners = np.concatenate([shapes[0].rest_m, *(shape.motion for shape in shapes)], axis=2)
    corners = corners.reshape(-1, corners.shape[2])
    _, first, which = np.unique(np.round(corners, 9), axis=0, return_index=True, return_inverse=True)
    faces = tuple(map(tuple, which.reshape(-1, 4).tolist()))
    text = f"{len(faces)} faces; largest displacement of every mode set to {1e6 * SHOWN_M:g} µm"
    shape = SceneShape("element", name, text, corners[first, :3], faces, body="load", fill=1.0, surface=name)
    motions = []
    for mode, drawn in enumerate(shapes):
        moved = corners[first, 3 * mode + 3 : 3 * mode + 6]
        largest = float(np.linalg.norm(moved, axis=1).max()) or 1.0
        deflection = {name: (SHOWN_M / largest * moved).astype(np.complex128)}
        frequency = f"natural frequency {drawn.frequency_hz:.5g} Hz; the amplitude of a mode is arbitrary"
        title = f"{drawn.name}: {drawn.frequency_hz:.5g} Hz"
        motions.append(SceneMotion(title, drawn.frequency_hz, (frequency,), {}, deflection))
    return Scene(name, (shape,), tuple(motions))


def draw_compared(evaluation: ElementEvaluation) -> Drawing:
    """Draw the deviation of every column's frequencies from those of the frame."""
    columns = evaluation.columns
    frame = next(column for column in columns if column.kind == "frame")
    positions, width = np.arange(len(MODE_NAMES)), 0.7 / len(columns)
    drawn = empty_figure("elastomer-comparison", 3.0)
    (panel,) = drawn.panels
    panel.rule(0.0, colour=GREY)
    for c, column in enumerate(columns):
        departure = 100.0 * (column.frequency_hz / frame.frequency_hz - 1.0)
        expanded = np.nan_to_num(200.0 * column.u_hz / frame.frequency_hz)
        look = {"marker": MARKERS[c % len(MARKERS)], "colour": METHOD_COLOURS[c % len(METHOD_COLOURS)]}
        finite, shift = np.isfinite(departure), (c - 0.5 * (len(columns) - 1)) * width
        if finite.any():
            panel.points(positions[finite] + shift, departure[finite], column.name, half_y=expanded[finite], **look)
    panel.x.names, panel.y.label, panel.title = tuple(MODE_NAMES), f"less {frame.name} / %", "natural frequencies"
    caption = "Departure of every column from the frame. Bars: expanded uncertainty U (k = 2) where there is one."
    return drawn.with_title("Models against one another", caption, main=True)


def draw_hand(evaluation: ElementEvaluation) -> Drawing | None:
    """Draw the resonance over the mass of a hand, rigidly joined and on springs."""
    mounted, stated = evaluation.mounted, evaluation.definition.file.mounting
    if mounted is None or stated is None:
        return None
    scale, unit = (1e3, "g") if mounted.direction.startswith("T") else (1e6, "kg·mm²")
    drawn = empty_figure("elastomer-mounted", 2.8)
    (panel,) = drawn.panels
    label = "hand joined without a spring (eq. 17)"
    panel.line(scale * mounted.hand_mass, mounted.mounted_hz, label, colour=BLUE)
    positions = np.full(len(mounted.frequency_hz), scale * stated.hand_mass)
    panel.points(positions, mounted.frequency_hz, "hand, sensor and pedestal on springs", colour=RED)
    panel.y.limits = (0.0, 1.1 * float(max(mounted.frequency_hz.max(), mounted.mounted_hz.max())))
    panel.x.label = f"{'mass' if unit == 'g' else 'moment of inertia'} of the hand / {unit}"
    panel.y.label, panel.title = "natural frequency / Hz", f"mounted sensor, {mounted.direction}"
    caption = "Natural frequency of the element with a hand or gripper."
    return drawn.with_title(f"Resonance of the mounted sensor, {mounted.direction}", caption)


def _panel(figure: Figure, index: int, shape: DrawnShape) -> None:
    """Draw one mode."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    axes: Any = figure.add_subplot(2, 3, index + 1, projection="3d", computed_zorder=False)
    size = np.linalg.norm(shape.motion, axis=2)
    largest = float(size.max()) or 1.0
    extent = float(np.ptp(shape.rest_m[..., 0]))
    moved = 1e3 * (shape.rest_m + shape.motion * (ENLARGED * extent / largest))
    rest = 1e3 * np.concatenate([shape.rest_m, shape.rest_m[:, :1]], axis=1)
    faces = Poly3DCollection(moved, facecolors=colormaps["viridis"](size.mean(axis=1) / largest), zorder=2)
    faces.set_edgecolor((0.0, 0.0, 0.0, 0.25))
    faces.set_linewidth(0.25)
    lines = Line3DCollection(rest, colors=GREY, linewidths=0.3, alpha=0.5, zorder=1)
    for drawn in (lines, faces):
        drawn.set_rasterized(True)
        drawn.set_clip_on(False)
        axes.add_collection3d(drawn)
    half = 0.5e3 * extent
    axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-0.35 * half, 0.35 * half))
    axes.set_box_aspect((1.0, 1.0, 0.35), zoom=1.45)
    axes.view_init(**VIEW)
    axes.set_axis_off()
    foot = half * np.array([0.80, -1.12, 0.0])
    for along, label in zip(0.2 * half * np.eye(3), "xyz", strict=True):
        axes.plot(*np.stack([foot, foot + along], axis=1), color=BLACK, linewidth=0.8, clip_on=False)
        axes.text(*(foot + 1.3 * along), label, fontsize=7.0, ha="center", va="center")
    title = f"{shape.name}   {shape.frequency_hz:.0f} Hz"
    axes.set_title(title, fontsize=8.5, fontweight="bold", pad=-6.0, loc="center")


# Page, files and printed lines.


def printed(evaluation: ElementEvaluation) -> Iterator[str]:
    """Yield the printed lines."""
    lines: list[tuple[str, ...]] = [("", *MODE_NAMES)]
    for column in evaluation.columns:
        pairs = [_with_u(column, index) for index in range(6)]
        lines.append((column.name, *(f"{value} ± {expanded}" if expanded else value for value, expanded in pairs)))
    lines.append(("spread", *(f"{signed_text(PERCENT * value)} %" for value in spread(evaluation.columns))))
    width = max(len(column.name) for column in evaluation.columns)
    for label, *cells in lines:
        yield f"{label:{width}}  {'  '.join(f'{cell:>14}' for cell in cells)}{'' if label else '  Hz'}"
    stiffness = evaluation.frame.stiffness
    yield f"stiffness (frame): kx {stiffness[0]:.4g} N/m, kz {stiffness[2]:.4g} N/m"
    if evaluation.mounted is not None:
        frequencies = ", ".join(f"{value:.1f}" for value in evaluation.mounted.frequency_hz)
        yield f"mounted, {evaluation.mounted.direction}: {frequencies} Hz"
    for fit in evaluation.fits:
        part = fit.platform
        lengths = ", ".join(f"{MILLI * value:.1f}" for value in (part.height_m, part.gyration_m[0], part.gyration_m[2]))
        numbers = f"{MILLI * part.mass_kg:.2f} g, height and gyrations {lengths} mm"
        yield f"fitted platform, half-size {MILLI * fit.half_size_m:g} mm: {numbers}"


def _with_u(column: ComparedColumn, index: int) -> tuple[str, str]:
    """Return one frequency and its U, empty if not measured."""
    value, u = float(column.frequency_hz[index]), float(column.u_hz[index])
    if not np.isfinite(value):
        return DASH, ""
    if column.kind != "measured" or not np.isfinite(u):
        return f"{value:.6g}" if column.kind == "stated" else f"{value:.1f}", ""
    text = round_to_uncertainty(value, 2.0 * u, 0)
    return text.value, text.expanded


def _context(evaluation: ElementEvaluation) -> dict[str, Any]:
    """Return the content of the page."""
    return {
        "subject": _subject(evaluation),
        "comparison": comparison_table(evaluation),
        "compared": [draw_compared(evaluation)],
        "element": scene_page(element_scene("frame", frame_shapes(evaluation.definition, evaluation.frame))),
        "shapes": [figure for figure, _ in mode_shape_figures(evaluation).values()],
        "participation": participation_table(evaluation),
        "stiffness": stiffness_table(evaluation),
        "statics": table("Beam formulas", STATICS, evaluation.facts),
        "convergence": convergence_table(evaluation),
        "sensitivity": sensitivity_table(evaluation),
        "platform": table(PLATFORMS, PLATFORM, evaluation.fits),
        "mounted": mounted_table(evaluation),
        "hand": [figure for figure in [draw_hand(evaluation)] if figure is not None],
    }


def _subject(evaluation: ElementEvaluation) -> list[tuple[str, str]]:
    """Return material and dimensions of the element."""
    beams, part = evaluation.definition.beams, evaluation.definition.platform
    size = evaluation.definition.file.platform.half_size
    material = beams.material
    cross = f"span {1e3 * beams.span_m:g} mm, {1e3 * beams.beam_width_m:g} × {1e3 * beams.beam_height_m:g} mm"
    compliant = f"{1e3 * beams.compliant_length_m:g} mm long, {1e3 * beams.compliant_thickness_m:g} × "
    compliant += f"{1e3 * beams.compliant_height_m:g} mm"
    gyration = part.gyration_m * 1e3
    rigid = f"{2e3 * size:g} mm square, {1e3 * part.mass_kg:.4g} g, centre {1e3 * part.height_m:.4g} mm high, "
    rigid += f"gyration {gyration[0]:.4g}, {gyration[1]:.4g}, {gyration[2]:.4g} mm"
    elastic = f"E {1e-9 * material.youngs_modulus_pa:g} GPa, ν {material.poisson_ratio:g}, "
    return [
        ("Material", f"{elastic}{material.density_kgm3:g} kg/m³"),
        ("Cross beams", cross),
        ("Compliant beams", compliant),
        ("Platform and parts", rigid),
    ]


def mode_shape_figures(evaluation: ElementEvaluation) -> dict[str, tuple[PrintedFigure, bytes]]:
    """Return the figures of the mode shapes by file name, drawn once."""
    drawn: dict[str, tuple[PrintedFigure, bytes]] | None = vars(evaluation).get("mode_shape_figures")
    if drawn is None:
        shapes = {"frame": frame_shapes(evaluation.definition, evaluation.frame)}
        if evaluation.solid is not None:
            shapes["solid"] = solid_shapes(evaluation.solid.meshes[0], evaluation.solid.finest)
        drawn = {
            f"shapes-{model}.png": draw_shapes(f"elastomer-shapes-{model}", f"Mode shapes of the {model}", of_model)
            for model, of_model in shapes.items()
        }
        vars(evaluation)["mode_shape_figures"] = drawn  # as `cached_property` does
    return drawn


def _fill(file: h5py.File, evaluation: ElementEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["name"] = evaluation.name
    file.attrs["shapes"] = "unknowns ux uy uz rx ry rz of the platform's point in the plane of the beams, then of nodes"
    model, study = evaluation.frame, evaluation.solid
    write_value(file, "beams", evaluation.definition.beams)
    write_value(file, "platform", evaluation.definition.platform)
    nodes = {name: getattr(model.frame, name) for name in ("node_m", "beam", "rigid", "clamped")}
    motion = {"node_motion": model.frame.reduction @ model.modes.shape}
    write_value(file, "frame", {**nodes, "modes": model.modes, "stiffness": model.stiffness, **motion})
    if study is not None:
        meshes = {f"mesh_{n}": mesh for n, mesh in zip(study.refinements, study.meshes, strict=True)}
        write_value(file, "solid", {**meshes, "rigid_platform": study.rigid})
    write_value(file, "comparison", {column.name: column for column in evaluation.columns})
    write_value(file, "sensitivity", evaluation.sensitivity)
    fits = {}
    for fit in evaluation.fits:
        values = {"platform": fit.platform, "frequency_hz": fit.frequency_hz, "largest_misfit": fit.misfit}
        fits[f"half_size_{fit.half_size_m:g}"] = values
    if fits:
        write_value(file, "fits", fits)
    write_value(file, "mounted", evaluation.mounted)


def _files(evaluation: ElementEvaluation) -> dict[str, str | bytes]:
    """Return tables and figures."""
    stiffness = (
        StiffnessRow(label, f"k{name}", value, "N/m" if name.startswith("T") else "N.m/rad")
        for label, values in stiffnesses(evaluation).items()
        for name, value in zip(MODE_NAMES, values.tolist(), strict=True)
    )
    tables = {
        "comparison.csv": csv_text(columns_of(ComparisonRow), comparison_rows(evaluation)),
        "modes.csv": csv_text(MODES, mode_rows(evaluation)),
        "stiffness.csv": csv_text(columns_of(StiffnessRow), stiffness),
        "statics.csv": csv_text(STATICS, evaluation.facts),
    }
    platforms = {"platform.csv": csv_text(PLATFORM, evaluation.fits)} if evaluation.fits else {}
    return {**tables, **platforms, **{name: png for name, (_, png) in mode_shape_figures(evaluation).items()}}


TABLES = ("modes.csv", "stiffness.csv", "comparison.csv", "statics.csv", "platform.csv")
ELASTOMER = CommandReport(
    "elastomer",
    "elastomer",
    (*TABLES, "shapes-frame.png", "shapes-solid.png"),
    _files,
    _fill,
    _context,
    printed,
    headlines,
)


def run_elastomer(
    path: Path,
    output: Path | None,
    *,
    solid: bool = False,
    force: bool = False,
    allow_outside: bool = False,
    progress: ProgressCallback = no_progress,
) -> None:
    """Model GEOMETRY.toml, or elastomer.toml of a folder, write the results and print them."""
    file = path / "elastomer.toml" if path.is_dir() else path
    read = {file.resolve(): seen} if (seen := FileIdentity.of(file)) else None
    definition = read_definition(file, allow_outside=allow_outside)

    def evaluate(hashes: dict[str, str]) -> ElementEvaluation:
        return evaluate_element(definition, hashes, solid=solid, progress=progress)

    folder = file.parent / ELASTOMER.name if output is None else output
    ELASTOMER.run(hash_files(definition.files, file.parent, read), folder, evaluate, force=force)
