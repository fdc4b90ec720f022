"""The columns of the comparison: beam formulas, frame, solid, measured models, stated frequencies."""

from __future__ import annotations

import numpy as np

from fusion.elastomer.definition import Definition
from fusion.elastomer.result import Column, FloatArray, SolidStudy
from fusion.models_file import read_models
from fusion.notices import Notice
from shaker.models.elastomer.element import FrameModel
from shaker.models.elastomer.modes import NAMES
from shaker.models.elastomer.statics import beam_stiffness, oscillator_hz
from shaker.models.modal import ModalModel

MODE_OF = dict(zip(("Fx", "Fy", "Fz", "Mx", "My", "Mz"), NAMES, strict=True))
"""Which mode a load component excites."""


def formula_column(definition: Definition) -> Column:
    """Return √(k/m)/2π along the axes from the closed form and the platform's mass; turns have none."""
    beams, mass = definition.beams, definition.platform.mass_kg
    stiffness = beam_stiffness(beams, definition.file.platform.half_size)
    along = oscillator_hz(stiffness.x, mass)
    return _exact("beam formulas", "formula", {"Tx": along, "Ty": along, "Tz": oscillator_hz(stiffness.z, mass)})


def model_columns(frame: FrameModel, solid: SolidStudy | None) -> list[Column]:
    """Return frame and, where it was asked for, solid."""
    found = [Column("frame", "frame", frame.modes.frequency_hz, np.zeros(6))]
    return found + ([Column("solid", "solid", solid.finest.frequency_hz, np.zeros(6))] if solid else [])


def stated_columns(definition: Definition) -> list[Column]:
    """Return the columns of GEOMETRY.toml."""
    return [_exact(item.name, "stated", item.stated) for item in definition.file.stated]


def measured_column(definition: Definition) -> tuple[Column | None, list[Notice]]:
    """Return the mode of every measured model that swings most after a step, with its standard uncertainty."""
    path = definition.file.measured
    if path is None:
        return None, []
    value, u = np.full(6, np.nan), np.full(6, np.nan)
    notices = []
    for entry in read_models(path).driven:
        name = MODE_OF.get(entry.component)
        if name is None or not len(entry.model.frequency_hz):
            text = f"{entry.component}: no oscillating mode in {path.name}"
            notices.append(Notice("info", text, "measured"))
            continue
        place = NAMES.index(name)
        value[place], u[place] = dominant(entry.model)
    return Column("measured", "measured", value, u), notices


def dominant(model: ModalModel) -> tuple[float, float]:
    """Return frequency in Hz and u of the oscillating mode with the largest |r/p|; u is NaN without covariance."""
    count = len(model.frequency_hz)
    place = int(np.argmax(np.abs(model.residue / model.poles[:count])))
    u = np.nan if model.covariance is None else float(np.sqrt(model.covariance[place, place]))
    return float(model.frequency_hz[place]), u


def _exact(name: str, kind: str, known: dict[str, float]) -> Column:
    """A column of numbers without uncertainty."""
    value: FloatArray = np.array([known.get(mode, np.nan) for mode in NAMES])
    return Column(name, kind, value, np.zeros(6))
