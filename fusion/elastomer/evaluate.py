"""From an element's geometry to its modes: formulas, frame, solid, comparison."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from fusion.elastomer.columns import formula_column, measured_column, model_columns, stated_columns
from fusion.elastomer.definition import Definition
from fusion.elastomer.facts import mounted_chain, statics_facts
from fusion.elastomer.result import ElementEvaluation, SolidStudy
from fusion.errors import InputError
from fusion.notices import Notice
from fusion.provenance import versions
from fusion.settings import ProgressCallback, no_progress
from shaker.models.elastomer.element import FrameModel, sensitivities, solve_frame
from shaker.models.elastomer.modes import NAMES
from shaker.models.elastomer.platform_fit import PlatformFit, platform_family
from shaker.models.elastomer.solid import converged, solve_solid

KEYS = {
    "compliant_length_m": "compliant_beams.length",
    "beam_width_m": "beams.width",
    "half_size_m": "platform.half_size",
    "height_m": "platform.height",
}
"""Keys of GEOMETRY.toml by the argument that a model refuses."""
STIFF = 1e3
"""Factor on the modulus of a platform that does not bend."""
CONVERGED, FAR = 0.02, 0.10
"""Change with the mesh, and distance between frame and solid, from which the user is told."""


def evaluate_element(
    definition: Definition, hashes: dict[str, str], *, solid: bool, progress: ProgressCallback = no_progress
) -> ElementEvaluation:
    """Return everything that GEOMETRY.toml asks for; the solid model only where wanted, since it takes a minute."""
    started = time.monotonic()
    file = definition.file
    consistent = file.frame.mass_matrix == "consistent"
    half_size = file.platform.half_size
    frame = solve_frame(definition.beams, half_size, definition.platform, file.frame.pieces, consistent)
    study = _solid(definition, progress) if solid else None
    measured, notices = measured_column(definition)
    columns = [formula_column(definition), *model_columns(frame, study)]
    columns += [measured] if measured is not None else []
    columns += stated_columns(definition)
    fits = _fits(definition)
    notices += [*_of_frame(definition, frame), *_of_solid(frame, study), *_of_fits(fits)]
    return ElementEvaluation(
        name=file.name,
        definition=definition,
        facts=statics_facts(definition, frame),
        frame=frame,
        sensitivity=sensitivities(definition.beams, half_size, definition.platform),
        solid=study,
        columns=tuple(columns),
        fits=fits,
        mounted=mounted_chain(definition, frame),
        notices=tuple(notices),
        settings={"solid": int(solid), "pieces": file.frame.pieces, "mass_matrix": file.frame.mass_matrix},
        versions=versions(),
        input_hashes=hashes,
        duration_s=time.monotonic() - started,
    )


def _solid(definition: Definition, progress: ProgressCallback) -> SolidStudy:
    """The solid on all meshes; `InputError` where a key, or scikit-fem, is missing."""
    block, refinements = definition.solid_block, definition.file.solid.refinements
    if block is None:
        expected = "the thickness of the block that --solid models"
        raise InputError(definition.path, "platform.thickness", found="nothing", expected=expected)
    stiff = replace(block, stiffening=STIFF)
    wanted = [*((block, refinement) for refinement in refinements), (stiff, refinements[-2])]
    models = []
    for done, (model, refinement) in enumerate(wanted):
        progress("solid", done, len(wanted))
        try:
            models.append(solve_solid(definition.beams, model, refinement))
        except ImportError as error:
            expected = 'the package that pip install "shakercal[solid]" brings'
            raise InputError("--solid", "", found=f"none ({error})", expected=expected) from error
        except ValueError as error:
            key = KEYS.get(str(error).partition(":")[0], "")
            raise InputError.told_by(error, definition.path, key) from error
    progress("solid", len(wanted), len(wanted))
    return SolidStudy(refinements, tuple(models[:-1]), models[-1])


def _fits(definition: Definition) -> tuple[PlatformFit, ...]:
    """Platform data sought from frequencies, at every half-size."""
    wanted = definition.file.fit
    if wanted is None:
        return ()
    return platform_family(definition.beams, wanted.half_sizes, wanted.frequencies.stated)


def _of_frame(definition: Definition, frame: FrameModel) -> list[Notice]:
    """Names that fit badly, modes between, and what rules the result."""
    found = []
    own = np.diag(frame.modes.participation)
    for name, share in zip(NAMES, own, strict=True):
        if share < np.max(frame.modes.participation[:, NAMES.index(name)]):
            text = f"named after a motion of which {100.0 * share:.0f} % is in it, and more in another mode"
            found.append(Notice("info", text, name))
    if len(frame.modes.others_hz):
        told = ", ".join(f"{value:.0f}" for value in frame.modes.others_hz)
        found.append(Notice("info", f"further modes in between at {told} Hz: the beams' own", "frame"))
    if definition.file.platform.mass is not None:
        text = "mass, centre and inertia are taken as stated; every frequency stands and falls with them"
        found.append(Notice("info", text, "platform"))
    return found


def _of_solid(frame: FrameModel, study: SolidStudy | None) -> list[Notice]:
    """Whether the mesh suffices, and where frame and solid are far apart and why."""
    if study is None:
        return []
    found = []
    change = converged(study.meshes)
    if np.max(np.abs(change)) > CONVERGED:
        worst = int(np.argmax(np.abs(change)))
        text = f"{NAMES[worst]} changed by {100.0 * change[worst]:.1f} % with the last mesh; refine [solid] further"
        found.append(Notice("warning", text, "solid"))
    for place, name in enumerate(NAMES):
        one, other = frame.modes.frequency_hz[place], study.finest.frequency_hz[place]
        if abs(one / other - 1.0) > FAR:
            stiff = study.rigid.frequency_hz[place]
            told = [f"{100.0 * (one / value - 1.0):+.0f} %" for value in (other, stiff)]
            text = f"frame {told[0]} from the solid, {told[1]} from one whose platform does not bend"
            found.append(Notice("info", text, name))
    return found


def _of_fits(fits: tuple[PlatformFit, ...]) -> list[Notice]:
    """What all fits say, once; of each what is its own."""
    notices = [notice for fit in fits for notice in fit.notices]
    texts = [notice.text for notice in notices]
    shared = [Notice(n.severity, n.text, "fit") if texts.count(n.text) > 1 else n for n in notices]
    return list(dict.fromkeys(shared))
