"""Files, page and printed lines of a decoupling, and the command."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from markupsafe import Markup

from fusion.base import K2, count_text
from fusion.campaign.executor import one_blas_thread
from fusion.recording.load import load_for_command
from fusion.report.figure import BLUE, COLOURS, GREY, ORANGE, Figure, empty_figure
from fusion.report.folder import CommandReport, subject_of
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    columns_of,
    common_exponent,
    csv_text,
    page_column,
    table,
)
from fusion.sensor.decouple.decoupling_evaluation import (
    FILTER_FILE,
    DecoupleEvaluation,
    DecoupleSettings,
    evaluate_decoupling,
    filter_text,
)
from fusion.sensor.unmodelled_effects import budget_table
from shaker.decoupling.common_pole_fit import ReleaseFit
from shaker.decoupling.common_pole_search import PoleCountTrial
from shaker.decoupling.filter import stage_readers, step_readings, step_times
from shaker.decoupling.release_problem import SHAPE_NAMES
from shaker.labels import load_unit, sensitivity_unit
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import (
    DASH,
    number_text,
    quantity_text,
    scaled_text,
    signed_text,
    small,
    times_ten,
    typeset,
)

STAGE_COLOURS = {"raw": GREY, "static": ORANGE, "filtered": BLUE}
COLUMNS = 2
MIN_SHOWN = 1e-6  # %, lower limit of a logarithmic axis
STAGE_NAMES = {"raw": "each output alone", "static": "static matrix", "filtered": "filter"}
SHOWN_S = 5e-3


class ModelRow(NamedTuple):
    """One number of model.csv; fields that do not apply are empty."""

    quantity: str
    number: int | str
    channel: str
    component: str
    value: float
    u: float | str
    U: float | str
    k: float | str
    unit: str


class CrosstalkRow(NamedTuple):
    """One reading of one load in crosstalk.csv; `rated` is in rated loads."""

    stage: str
    quantity: str
    frequency_hz: float | str
    reading: str
    load: str
    magnitude: float
    phase_rad: float | str
    U: float
    k: float
    unit: str
    rated: float
    U_rated: float


def model_rows(evaluation: DecoupleEvaluation) -> Iterator[ModelRow]:
    """Yield the rows of model.csv: poles, ranks, static gains and residues."""
    model, u = evaluation.fit.model, evaluation.fit.model.u

    def row(name: str, number: int | str, outputs: tuple[str, str], value: Any, spread: Any, unit: str) -> ModelRow:
        return ModelRow(name, number, *outputs, float(value), float(spread), K2 * float(spread), K2, unit)

    for name, unit in (("frequency_hz", "Hz"), ("damping_ratio", "1"), ("real_hz", "Hz")):
        for i, (value, spread) in enumerate(zip(getattr(model, name), getattr(u, name), strict=True)):
            yield row(name, i + 1, ("", ""), value, spread, unit)
    for i, rank in enumerate(evaluation.fit.ranks):
        kind, index = ("rank", i) if i < len(model.frequency_hz) else ("real_rank", i - len(model.frequency_hz))
        yield ModelRow(kind, index + 1, "", "", rank.rank, "", "", "", "1")
    static, spread_static = model.static_gain, static_u(evaluation)
    residues = (
        ("residue_re", model.residue.real, u.residue.real),
        ("residue_im", model.residue.imag, u.residue.imag),
        ("real_residue", model.real_residue, u.real_residue),
    )
    for d, component in enumerate(model.components):
        unit = sensitivity_unit(model.unit, component)
        for c, channel in enumerate(model.channels):
            yield row("static_gain", "", (channel, component), static[c, d], spread_static[c, d], unit)
            for name, residue, spreads in residues:
                for i, (value, spread) in enumerate(zip(residue[:, c, d], spreads[:, c, d], strict=True)):
                    yield row(name, i + 1, (channel, component), value, spread, f"{unit}/s")


def static_u(evaluation: DecoupleEvaluation) -> FloatArray:
    """Return standard uncertainties (C, D) of the static gains."""
    model = evaluation.fit.model
    found = np.zeros((len(model.channels), len(model.components)))
    for d in range(len(model.components)):
        slope, covariance = model.column_sensitivity(d, np.zeros(1))
        found[:, d] = np.sqrt(np.einsum("cp,pq,cq->c", slope[0].real, covariance, slope[0].real))
    return found


def crosstalk_rows(evaluation: DecoupleEvaluation) -> Iterator[CrosstalkRow]:
    """Yield the rows of crosstalk.csv: every reading of every load at every stage."""
    for stage in evaluation.stages:
        frequency = ["", *stage.frequency_hz.tolist()]
        quantity = ["step_peak", *["response"] * len(stage.frequency_hz)]
        for (i, reading), (j, load) in product(enumerate(stage.components), repeat=2):
            unit = f"{load_unit(reading)}/{'N' if load_unit(load) == 'N' else '(N.m)'}"
            size = np.append(stage.peak[i, j], np.abs(stage.value[:, i, j]))
            phase = ["", *np.angle(stage.value[:, i, j]).tolist()]
            U = K2 * np.append(stage.u_peak[i, j], stage.u[:, i, j])
            rated = (float(evaluation.ratio[i, j]) * part for part in (size, U))
            numbers = zip(size.tolist(), phase, U.tolist(), *(part.tolist() for part in rated), strict=True)
            for name, at_hz, (value, angle, expanded, *of_rated) in zip(quantity, frequency, numbers, strict=True):
                yield CrosstalkRow(stage.stage, name, at_hz, reading, load, value, angle, expanded, K2, unit, *of_rated)


def largest(evaluation: DecoupleEvaluation) -> Iterator[tuple[str, float, float, str]]:
    """Yield the largest cross-talk in a step of every stage, in % of rated loads."""
    ratio = 100 * np.where(np.eye(len(evaluation.scale), dtype=np.bool_), np.nan, evaluation.ratio)
    for stage in evaluation.stages:
        size, U = stage.peak * ratio, K2 * stage.u_peak * ratio
        if np.any(np.isfinite(ratio)):
            i, j = np.unravel_index(np.nanargmax(size + np.nan_to_num(U)), ratio.shape)
            which = f"{stage.components[i]} while {stage.components[j]} steps"
            yield f"cross-talk in a step, {STAGE_NAMES[stage.stage]}", float(size[i, j]), float(U[i, j]), which


def headlines(evaluation: DecoupleEvaluation) -> list[Headline]:
    """Return the largest cross-talk at every stage, and the dynamics behind the filter."""
    lines = [
        Headline(capitalise(what), quantity_text(value, U, "%"), which) for what, value, U, which in largest(evaluation)
    ]
    target = evaluation.decoupler
    label = f"{number_text(target.target_hz[0], 6)} Hz, ζ = {number_text(target.target_damping[0], 6)}"
    late = 1e6 * target.delay / target.sample_rate_hz
    remark = f"{count_text(target.delay, 'sample')} ({number_text(late)} µs) late"
    return [*lines, Headline("Dynamics behind the filter", label, remark)]


def modes_table(evaluation: DecoupleEvaluation) -> Table:
    """Return the common poles with their ranks."""
    model, u = evaluation.fit.model, evaluation.fit.model.u
    rows: list[tuple[str, ...]] = []
    scale = evaluation.fit.amplitude / evaluation.fit.noise[:, None]
    for i in np.argsort(model.frequency_hz):
        rank = evaluation.fit.ranks[i]
        c, d = np.unravel_index(int(np.argmax(np.abs(model.residue[i]) * scale)), scale.shape)
        hertz = quantity_text(float(model.frequency_hz[i]), K2 * float(u.frequency_hz[i]))
        damping = quantity_text(100 * float(model.damping_ratio[i]), 100 * K2 * float(u.damping_ratio[i]))
        rows.append((hertz, damping, str(rank.rank), f"{model.channels[c]} by {model.components[d]}"))
    for q in np.argsort(model.real_hz):
        rank = evaluation.fit.ranks[len(model.frequency_hz) + q]
        value = quantity_text(float(model.real_hz[q]), K2 * float(u.real_hz[q]))
        rows.append((value, "real pole", str(rank.rank), DASH))
    head = ("frequency / Hz", "damping ratio / %", "shapes", "clearest in")
    caption = f"Poles that all outputs share, with U (k = 2) {evaluation.influences.scope}"
    return Table(caption, head, "rrrl", tuple(rows))


def modes_budgets(evaluation: DecoupleEvaluation) -> list[Table]:
    """Return the budgets of frequencies and damping ratios of the modes, with influences not assessed."""
    model, influences = evaluation.fit.model, evaluation.influences
    effects = influences.effects(lambda *part: model.altered(*part).vector)
    whole = np.diag(np.asarray(model.covariance))
    tables, count = [], len(model.frequency_hz)
    for what, first in (("frequencies", 0), ("damping ratios", count)):
        part = slice(first, first + count)
        names = [f"mode at {number_text(hertz, 5)} Hz" for hertz in model.frequency_hz]
        numbers = dict(zip(names, model.vector[part].tolist(), strict=True))
        parts = influences.budget(whole[part], effects[:, part], "releases and loads")
        tables.append(budget_table(f"Budget of the {what}", numbers, parts, influences))
    return tables


def peak_tables(evaluation: DecoupleEvaluation) -> list[Table]:
    """Return the readings while each load makes a step, in % of rated loads."""
    names, ratio, tables = evaluation.fit.model.components, 100 * evaluation.ratio, []
    unit = "rated load" if evaluation.capacity is not None else "the step"
    for stage in evaluation.stages:
        values, expanded = (stage.peak * ratio).tolist(), (K2 * stage.u_peak * ratio).tolist()
        rows = tuple((name, *map(quantity_text, *cells)) for name, *cells in zip(names, values, expanded, strict=True))
        caption = f"Largest reading in a step, {STAGE_NAMES[stage.stage]}: % of {unit}, with U (k = 2)"
        head = ("reading", *(f"step of {name}" for name in names))
        tables.append(Table(caption, head, "l" + "r" * len(names), rows))
    return tables


def static_table(evaluation: DecoupleEvaluation) -> Table:
    """Return the static outputs with U for rated loads, without these per unit of load."""
    model = evaluation.fit.model
    value, expanded = model.static_gain * evaluation.scale, K2 * static_u(evaluation) * evaluation.scale
    exponent = common_exponent(value.astype(np.complex128))
    rows = tuple(
        (channel, *(scaled_text(float(value[c, d]), float(expanded[c, d]), exponent) for d in range(value.shape[1])))
        for c, channel in enumerate(model.channels)
    )
    head = ("output", *model.components)
    reference = "for the rated load" if evaluation.capacity is not None else "per N and per N·m"
    caption = Markup("Output at rest {}, in {}, with U (k = 2)").format(reference, times_ten(exponent, model.unit))
    return Table(caption, head, "l" + "r" * value.shape[1], rows)


NOISE: list[TableColumn[tuple[str, float, float]]] = [
    page_column("load", lambda row: row[0], "l"),
    page_column("static matrix", lambda row: number_text(row[1] / row[2])),
    page_column("filter", lambda row: number_text(row[1])),
    page_column("gain", lambda row: number_text(row[2])),
    page_column("unit", lambda row: typeset(load_unit(row[0])), "l"),
]
"""Noise of the loads behind the filter and with the static matrix: rows of load, noise, gain."""


def _ms(value_s: float, u_s: float) -> str:
    return quantity_text(1e3 * value_s, 1e3 * K2 * u_s)


RELEASES: list[TableColumn[ReleaseFit]] = [
    page_column("recording", lambda release: release.record, "l"),
    page_column("load", lambda release: release.component, "l"),
    page_column("released by", lambda release: release.release or DASH, "l"),
    page_column("middle / ms", lambda release: _ms(release.middle_s, release.u_middle_s)),
    page_column("duration / ms", lambda r: _ms(r.duration_s, r.u_duration_s) if r.duration_s else "step"),
    page_column("along", lambda release: SHAPE_NAMES[release.shape], "l"),
    page_column("size − mean / %", lambda release: quantity_text(100 * (release.gain - 1), 100 * K2 * release.u_gain)),
    page_column("misfit", lambda release: small(float(release.misfit.max()))),
]
TRIALS: list[TableColumn[PoleCountTrial]] = [
    page_column("modes", lambda trial: str(trial.modes)),
    page_column("real poles", lambda trial: str(trial.reals)),
    page_column("residual² over noise²", lambda trial: f"{trial.misfit:.4f}"),
    page_column("criterion", lambda trial: signed_text(trial.criterion, ".0f")),
    page_column("selected", lambda trial: "yes" if trial.accepted else "no", "l"),
]


# Figures: cross-talk over frequency, and readings while a load makes a step.


def draw_crosstalk(evaluation: DecoupleEvaluation) -> Figure:
    """Draw the largest reading of any other load over frequency, before and after the filter."""
    names, ratio = evaluation.fit.model.components, 100 * evaluation.ratio
    others = {j: [i for i in range(len(names)) if i != j and np.isfinite(ratio[i, j])] for j in range(len(names))}
    loads = [j for j in others if others[j]]
    rows, frequency = -(-len(loads) // COLUMNS), evaluation.frequency_hz
    drawn = empty_figure("decouple-crosstalk", 1.9 * rows + 0.8, rows, COLUMNS, shared_y=True)
    for index, (panel, j) in enumerate(zip(drawn.panels, loads, strict=False)):
        for stage in evaluation.stages:
            size = np.abs(stage.value[:, others[j], j]) * ratio[others[j], j]
            worst, u = np.argmax(size, axis=1)[:, None], stage.u[:, others[j], j] * ratio[others[j], j]
            value = np.take_along_axis(size, worst, axis=1)[:, 0]
            expanded = K2 * np.take_along_axis(u, worst, axis=1)[:, 0]
            label, colour = STAGE_NAMES[stage.stage], STAGE_COLOURS[stage.stage]
            panel.line(frequency, np.maximum(value, MIN_SHOWN), label, colour=colour)
            low, high = np.maximum(value - expanded, MIN_SHOWN), np.maximum(value + expanded, MIN_SHOWN)
            panel.band(frequency, low, high, label, colour=colour)
        panel.rule(evaluation.fit.model.frequency_hz, "modes", along="x", colour=GREY, width=0.6)
        panel.rule(evaluation.decoupler.target_hz[0], "target", along="x", colour=GREY, dashed=True)
        panel.x.log = panel.y.log = True
        panel.x.limits, panel.y.limits = (float(frequency[0]), float(frequency[-1])), (1e-3, 1e3)
        panel.x.label, panel.title = "frequency / Hz", f"{names[j]} oscillates"
        if index % COLUMNS == 0:
            panel.y.label = "cross-talk / %"
    for panel in drawn.panels[len(loads) :]:
        panel.blank = True
    compared = "load while one oscillates, in rated loads"
    if evaluation.capacity is None:
        compared = "load of its unit while one oscillates, over that one"
    caption = (
        f"Largest reading of any other {compared}. Shaded: U (k = 2) by the uncertainty of the model. Vertical lines: "
        "modes; dashed: target frequency."
    )
    return drawn.with_title("Cross-talk over frequency", caption, main=True)


def draw_step(evaluation: DecoupleEvaluation) -> Figure:
    """Draw other readings during the step of the largest cross-talk, in comparable units."""
    model, ratio = evaluation.fit.model, 100 * evaluation.ratio
    static = next(stage for stage in evaluation.stages if stage.stage == "static")
    size = np.nan_to_num(static.peak * ratio)
    np.fill_diagonal(size, 0.0)
    load = int(np.argmax(size.max(axis=0)))
    time_s = step_times(model, evaluation.decoupler)
    time_s = time_s[time_s <= SHOWN_S]
    readers = stage_readers(model, evaluation.decoupler, evaluation.fit.noise)
    readings = {stage: step_readings(model, reader, time_s) for stage, reader in readers.items()}
    name = model.components[load]
    drawn = empty_figure(f"decouple-step-{name}", 1.5 * len(readings) + 0.6, len(readings))
    for panel, (stage, value) in zip(drawn.panels, readings.items(), strict=True):
        for d, reading in enumerate(model.components):
            if d != load and np.isfinite(ratio[d, load]):
                share = value[:, d, load] * ratio[d, load]
                panel.line(1e3 * time_s, share, reading, colour=COLOURS[d], width=0.8)
        panel.y.label, panel.title = "reading / %", f"step of {name}: {STAGE_NAMES[stage]}"
    drawn.panels[-1].x.label = "time after the step / ms"
    rated = "all other loads by the model, in per cent of their rated loads for a step of the rated one"
    bare = "the other loads of its unit by the model, in per cent of the step"
    caption = f"Readings of {rated if evaluation.capacity is not None else bare}."
    return drawn.with_title(f"Other loads while {name} makes a step", caption)


# Page, files and printed lines.


def printed(evaluation: DecoupleEvaluation) -> Iterator[str]:
    """Yield the printed lines."""
    model, u = evaluation.fit.model, evaluation.fit.model.u
    pairs = zip(model.frequency_hz.tolist(), (K2 * u.frequency_hz).tolist(), strict=True)
    modes = [f"({quantity_text(*pair)})" for pair in sorted(pairs)]
    yield f"{len(modes)} modes common to {len(model.channels)} outputs: {', '.join(modes)} Hz (k = 2)"
    for what, value, U, which in largest(evaluation):
        yield f"{what}: {quantity_text(value, U, '%')}, {which}"
    target, gain = evaluation.decoupler, evaluation.noise_gain
    yield (
        f"filter to {target.target_hz[0]:.6g} Hz, damping ratio {target.target_damping[0]:.6g}: "
        f"{len(target.poles)} poles, {count_text(target.delay, 'sample')} of delay, "
        f"noise gain {number_text(gain.min())} to {number_text(gain.max())}"
    )


def _context(evaluation: DecoupleEvaluation) -> dict[str, Any]:
    """Return the content of the page."""
    fit, names = evaluation.fit, evaluation.fit.model.components
    counts = [f"{name} {sum(release.component == name for release in fit.releases)}" for name in names]
    outputs = f"{', '.join(fit.model.channels)} at {number_text(fit.sample_rate_hz, 6)} Hz"
    within = evaluation.frequency_hz <= evaluation.decoupler.target_hz.max()
    comparable = np.count_nonzero(np.isfinite(evaluation.ratio)) > len(names)
    noise = zip(names, evaluation.noise.tolist(), evaluation.noise_gain.tolist(), strict=True)
    return {
        "subject": [*subject_of(evaluation.manifests[0].rig), ("Releases", ", ".join(counts)), ("Outputs", outputs)],
        "rated": evaluation.capacity is not None,
        "crosstalk": [draw_crosstalk(evaluation)] if comparable else [],
        "peaks": peak_tables(evaluation),
        "steps": [draw_step(evaluation)] if comparable else [],
        "modes": modes_table(evaluation),
        "budgets": modes_budgets(evaluation),
        "static": static_table(evaluation),
        "noise": table("Noise of a sample (standard deviation) by the outputs' noise", NOISE, noise),
        "releases": table("Releases, with U (k = 2); misfit: largest residual over the noise", RELEASES, fit.releases),
        "trials": table("Numbers of poles that were tried (around the releases)", TRIALS, fit.trials),
        "deviation": number_text(100 * float(evaluation.deviation[within].max()), 2),
    }


MODEL_FIELDS = ("channels", "components", "unit", "frequency_hz", "damping_ratio", "residue", "real_hz", "real_residue")


def _fill(file: h5py.File, evaluation: DecoupleEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["name"] = evaluation.name
    file.attrs["model"] = "H(s) = sum R/(s-p) + conj + sum R_q/(s-p_q); poles in rad/s; k = 1"
    file.attrs["scope"], file.attrs["outside"] = evaluation.influences.scope, evaluation.influences.outside
    fit = evaluation.fit
    model = file.create_group("model", track_order=True)
    for name in (*MODEL_FIELDS, "covariance"):
        write_value(model, name, getattr(fit.model, name))
    fit_group = file.create_group("fit", track_order=True)
    for name in ("noise", "sample_rate_hz", "amplitude", "u_amplitude", "variance_accounted", "losses"):
        write_value(fit_group, name, getattr(fit, name))
    releases = file.create_group("releases", track_order=True)
    for release in fit.releases:
        write_fields(releases.create_group(releases.free_name(release.record), track_order=True), release)
    write_fields(file.create_group("filter", track_order=True), evaluation.decoupler)
    for name in ("noise", "noise_gain", "deviation"):
        write_value(file["filter"], f"{name}_of_loads" if name == "noise" else name, getattr(evaluation, name))
    stages = file.create_group("crosstalk", track_order=True)
    for stage in evaluation.stages:
        write_fields(stages.create_group(stage.stage, track_order=True), stage)


DECOUPLE = CommandReport(
    "decouple",
    "decouple",
    (FILTER_FILE, "model.csv", "crosstalk.csv"),
    lambda evaluation: {
        FILTER_FILE: filter_text(evaluation.decoupler, evaluation.fit.model),
        "model.csv": csv_text(columns_of(ModelRow), model_rows(evaluation)),
        "crosstalk.csv": csv_text(columns_of(CrosstalkRow), crosstalk_rows(evaluation)),
    },
    _fill,
    _context,
    printed,
    headlines,
)


def run_decouple(
    path: Path, output: Path | None, settings: DecoupleSettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Evaluate all releases of a campaign together, write the results and print the summary."""
    manifests = load_for_command([path], DECOUPLE.name, allow_outside=allow_outside)

    def evaluate(hashes: dict[str, str]) -> DecoupleEvaluation:
        with one_blas_thread():
            return evaluate_decoupling(manifests[0].rig.name, manifests, settings, hashes)

    folder = (path if path.is_dir() else path.parent) / DECOUPLE.name
    DECOUPLE.run_recordings([path], manifests, folder if output is None else output, evaluate, force=force)
