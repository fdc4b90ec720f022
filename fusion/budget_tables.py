"""The report's tables of uncertainty: budgets of the driven component, and what other loads explain of the outputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from fusion.budget import BudgetEntry, budget
from fusion.evaluation import Evaluation
from fusion.highlights import (
    COMPONENTS,
    LOAD_COMPONENTS,
    acceleration,
    driven_channel,
    driven_component,
    driven_element,
    main_line,
    static_sensitivity,
)
from fusion.other_loads import OtherLoads, other_loads
from fusion.polar import DASH, typeset
from fusion.report_numbers import degrees_of_freedom, factor, fixed, short, small
from fusion.report_tables import Table
from fusion.uncertainty import Uncertainty
from shaker._checks import ComplexArray, FloatArray

SMALLEST_SHARE = 0.05
"""Share of the variance in % from which a contribution has a row of its own."""
SMALLEST_SLOPE = 1e-6
"""Share of the variance in % below which a sensitivity coefficient is rounding."""


def budget_tables(evaluation: Evaluation) -> list[Table]:
    """Budgets of the driven sensitivity, load and acceleration at the strongest line, largest contributions first."""
    line, component = main_line(evaluation), driven_component(evaluation)
    found, load = evaluation.sensitivity, evaluation.load
    tables = []
    if found is not None and np.isfinite(found.value[line, driven_channel(evaluation), component]):
        what = f"{found.channels[driven_channel(evaluation)]} per {LOAD_COMPONENTS[component]}"
        tables.append(_budget_table(found.budget, line, driven_element(evaluation), what, found.frequency_hz[line]))
    if load is not None and load.observed[line, component]:
        what, value = f"load {LOAD_COMPONENTS[component]}", load.value[:, [component]]
        entries = _budget_of(load.uncertainty, value, component)
        tables.append(_budget_table(entries, line, 0, what, load.frequency_hz[line]))
    motion = acceleration(evaluation, "load", "fused")
    if motion is not None and motion.observed[line, component]:
        what, value = f"acceleration {COMPONENTS[component]} of the load", motion.phasors.value[:, [component]]
        entries = _budget_of(motion.uncertainty, value, component)
        tables.append(_budget_table(entries, line, 0, what, motion.phasors.frequency_hz[line]))
    return tables


def _budget_of(uncertainty: Uncertainty, value: ComplexArray, component: int) -> tuple[BudgetEntry, ...]:
    """Budget of one component, of values (K, 1)."""
    return budget(uncertainty.at([component]), value)


def _budget_table(entries: Sequence[BudgetEntry], line: int, place: int, what: str, frequency_hz: float) -> Table:
    """One budget: what acts, how much of it, how it acts, and what it contributes to magnitude and phase."""
    u = np.array([[entry.u_relative[line, place], entry.u_phase_rad[line, place]] for entry in entries])
    total = np.sqrt(np.sum(u**2, axis=0))
    share = 100.0 * np.divide(u**2, total**2, out=np.zeros_like(u), where=total > 0.0)
    order = np.argsort(-np.sum(u**2, axis=1), kind="stable")
    shown = [int(place) for place in order if np.max(share[place]) >= SMALLEST_SHARE]
    rows: list[tuple[str, ...]] = []
    for number in shown:
        entry = entries[number]
        slopes = (_slope(entry.coefficient[part, line, place], share[number, part]) for part in (0, 1))
        kind = f"{entry.type}, {degrees_of_freedom(entry.dof[line])}"
        rows.append((entry.label, kind, _input(entry), *slopes, *_contribution(u[number], share[number])))
    rest = np.delete(np.arange(len(entries)), shown)
    if len(rest):
        left = _contribution(np.sqrt(np.sum(u[rest] ** 2, axis=0)), np.sum(share[rest], axis=0))
        rows.append((f"{len(rest)} smaller ones together", "", "", "", "", *left))
    rows.append((Markup("<b>combined, k = 1</b>"), "", "", "", "", *_contribution(total, np.sum(share, axis=0))))
    head = (
        *("contribution", "type, dof", "u of the input", "magnitude per unit", "rad per unit"),
        *("u(magnitude) / %", "share / %", "u(phase) / mrad", "share / %"),
    )
    return Table(f"Budget of {what} at {frequency_hz:.4f} Hz", head, "llrrrrrrr", tuple(rows))


def _contribution(u: FloatArray, share: FloatArray) -> tuple[str, str, str, str]:
    """Contribution (2,) to relative magnitude and phase, each with its share of the variance in %."""
    return small(100.0 * u[0]), f"{share[0]:.1f}", small(1e3 * u[1]), f"{share[1]:.1f}"


def _input(entry: BudgetEntry) -> str:
    """Standard uncertainty of the unknown with its unit; a dash for noise."""
    if not np.isfinite(entry.u):
        return f"{entry.count} unknowns" if entry.count > 1 else DASH
    unit = "" if entry.unit == "1" else typeset(entry.unit)
    each = f", {entry.count} times" if entry.count > 1 else ""
    return Markup("{} {}").format(short(entry.u), unit).strip() + each


def _slope(value: float, share: float) -> str:
    """Sensitivity coefficient, with its sign; of what contributes nothing only that it is about zero."""
    if not np.isfinite(value):
        return DASH
    return short(value) if share >= SMALLEST_SLOPE else "≈ 0"


def other_loads_table(evaluation: Evaluation) -> Table | None:
    """What the other load components explain of each output at the strongest line, by the static sensitivity."""
    found, outputs, load = evaluation.sensitivity, evaluation.outputs, evaluation.load
    sensor, static = evaluation.manifest.rig.sensor, static_sensitivity(evaluation)
    if found is None or outputs is None or load is None or sensor is None or static is None:
        return None
    line, component = main_line(evaluation), driven_component(evaluation)
    shares = other_loads(outputs, load, static, component, sensor.static_sensitivity_uncertainty)
    rows = [_share_row(shares, line, c, name) for c, name in enumerate(outputs.phasors.channels)]
    frequency = f"{found.frequency_hz[line]:.4f}"
    head = ("output", "in phase / %", "across / %", "k", "dof")
    caption = f"Share of each output that loads beside {LOAD_COMPONENTS[component]} explain at {frequency} Hz, with U"
    return Table(caption, head, "lrrrr", tuple(rows))


def _share_row(shares: OtherLoads, line: int, channel: int, name: str) -> tuple[str, ...]:
    """Share of one output, as parts in phase with it and across."""
    if not np.isfinite(shares.value[line, channel]):
        return name, DASH, DASH, DASH, DASH
    share = shares.element(line, channel)
    parts = (
        fixed(100.0 * part, 100.0 * share.k * u, 0) for part, u in ((share.re, share.u_re), (share.im, share.u_im))
    )
    return name, *parts, factor(share.k), degrees_of_freedom(share.dof)
