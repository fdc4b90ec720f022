"""elastomer.html: one self-contained page with comparison, stiffness, shapes and origin of an element's models."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.elastomer import tables
from fusion.elastomer.result import ElementEvaluation
from fusion.elastomer.shapes import frame_shapes, solid_shapes
from fusion.evaluated import page_frame
from fusion.page import render_page
from fusion.plots.elastomer import Compared, HandCurve, draw_compared, draw_hand, draw_shapes
from fusion.plots.style import Picture
from shaker.models.elastomer.modes import NAMES

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
        "headlines": tables.headlines(evaluation),
        "comparison": tables.comparison_table(evaluation),
        "compared": [draw_compared(_compared(evaluation))],
        "shapes": shapes,
        "participation": tables.participation_table(evaluation),
        "stiffness": tables.stiffness_table(evaluation),
        "statics": tables.statics_table(evaluation),
        "convergence": tables.convergence_table(evaluation),
        "sensitivity": tables.sensitivity_table(evaluation),
        "platform": tables.platform_table(evaluation),
        "mounted": tables.mounted_table(evaluation),
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
