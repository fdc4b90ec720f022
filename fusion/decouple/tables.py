"""Tables of a decoupling: what the files, the page and the terminal say."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup

from fusion.decouple.result import DecoupleEvaluation, FloatArray, K, load_unit
from fusion.polar import DASH, rounded, typeset
from fusion.report_numbers import common_exponent, fixed, measured, number, small, times_ten
from fusion.report_tables import Headline, Table
from fusion.results_csv import sensitivity_unit
from shaker.models.decoupling.crosstalk import Crosstalk

MODEL_COLUMNS = ("quantity", "number", "channel", "component", "value", "u", "U", "k", "unit")
CROSSTALK_COLUMNS = (
    *("stage", "quantity", "frequency_hz", "reading", "load"),
    *("magnitude", "phase_rad", "U", "k", "unit", "rated", "U_rated"),
)
STAGE_NAMES = {"raw": "each output alone", "static": "static matrix", "filtered": "filter"}
Row = list[str | float | int]


def model_rows(evaluation: DecoupleEvaluation) -> Iterator[Row]:
    """Rows of model.csv: poles, ranks, static gains, residues."""
    model, u = evaluation.fit.model, evaluation.fit.model.u
    poles = (
        ("frequency_hz", model.frequency_hz, u.frequency_hz, "Hz"),
        ("damping_ratio", model.damping_ratio, u.damping_ratio, "1"),
        ("real_hz", model.real_hz, u.real_hz, "Hz"),
    )
    for name, values, spreads, unit in poles:
        for i, (value, spread) in enumerate(zip(values, spreads, strict=True)):
            yield [name, i + 1, "", "", float(value), float(spread), K * float(spread), K, unit]
    for i, rank in enumerate(evaluation.fit.ranks):
        kind, place = ("rank", i) if i < len(model.frequency_hz) else ("real_rank", i - len(model.frequency_hz))
        yield [kind, place + 1, "", "", rank.rank, "", "", "", "1"]
    static, spread_static = model.static_gain, static_u(evaluation)
    residues = (
        ("residue_re", model.residue.real, u.residue.real),
        ("residue_im", model.residue.imag, u.residue.imag),
        ("real_residue", model.real_residue, u.real_residue),
    )
    for d, component in enumerate(model.components):
        unit = sensitivity_unit(model.unit, component)
        for c, channel in enumerate(model.channels):
            spread = float(spread_static[c, d])
            yield ["static_gain", "", channel, component, float(static[c, d]), spread, K * spread, K, unit]
            for name, table, spreads in residues:
                for i, (value, own) in enumerate(zip(table[:, c, d], spreads[:, c, d], strict=True)):
                    yield [name, i + 1, channel, component, float(value), float(own), K * float(own), K, f"{unit}/s"]


def static_u(evaluation: DecoupleEvaluation) -> FloatArray:
    """Return standard uncertainties (C, D) of the static gains."""
    model = evaluation.fit.model
    found = np.zeros((len(model.channels), len(model.components)))
    for d in range(len(model.components)):
        slope, covariance = model.column_sensitivity(d, np.zeros(1))
        found[:, d] = np.sqrt(np.einsum("cp,pq,cq->c", slope[0].real, covariance, slope[0].real))
    return found


def crosstalk_rows(evaluation: DecoupleEvaluation) -> Iterator[Row]:
    """Rows of crosstalk.csv: every reading of every load at every stage, in a step and over frequency."""
    for stage in evaluation.stages:
        for i, reading in enumerate(stage.components):
            for j, load in enumerate(stage.components):
                unit = f"{load_unit(reading)}/{'N' if load_unit(load) == 'N' else '(N.m)'}"
                ratio = evaluation.scale[j] / evaluation.scale[i] if evaluation.comparable(i, j) else np.nan
                names: Row = [reading, load]
                peak, spread = float(stage.peak[i, j]), K * float(stage.u_peak[i, j])
                tail: Row = [spread, K, unit, float(ratio * peak), float(ratio * spread)]
                yield [stage.stage, "step_peak", "", *names, peak, "", *tail]
                for k, frequency in enumerate(stage.frequency_hz):
                    value, spread = complex(stage.value[k, i, j]), K * float(stage.u[k, i, j])
                    tail = [spread, K, unit, float(ratio * abs(value)), float(ratio * spread)]
                    yield [stage.stage, "response", float(frequency), *names, abs(value), float(np.angle(value)), *tail]


def largest(evaluation: DecoupleEvaluation, stage: Crosstalk) -> tuple[float, float, str]:
    """Return the cross-talk in a step that may be largest, by value and U, in rated loads, and which it is."""
    ratio, best = evaluation.scale / evaluation.scale[:, None], (-1.0, 0.0, "")
    for i, reading in enumerate(stage.components):
        for j, load in enumerate(stage.components):
            value = float(stage.peak[i, j] * ratio[i, j])
            expanded = K * float(stage.u_peak[i, j] * ratio[i, j])
            if i != j and evaluation.comparable(i, j) and value + expanded > sum(best[:2]):
                best = (value, expanded, f"{reading} while {load} steps")
    return best


def headlines(evaluation: DecoupleEvaluation) -> list[Headline]:
    """Return the largest cross-talk at every stage and what the filter makes of the sensor."""
    found = []
    for stage in evaluation.stages:
        value, expanded, which = largest(evaluation, stage)
        if which:
            label = f"Cross-talk in a step, {STAGE_NAMES[stage.stage]}"
            found.append(Headline(label, measured(100 * value, 100 * expanded, "%"), which))
    target = evaluation.decoupler
    label = f"{target.target_hz[0]:.6g} Hz, ζ = {target.target_damping[0]:g}"
    late = 1e6 * target.delay / target.sample_rate_hz
    found.append(Headline("Dynamics behind the filter", label, f"{target.delay} samples ({late:.3g} µs) late"))
    return found


def modes_table(evaluation: DecoupleEvaluation) -> Table:
    """Return the common poles, and what each moves."""
    model, u = evaluation.fit.model, evaluation.fit.model.u
    rows: list[tuple[str, ...]] = []
    scale = evaluation.fit.amplitude / evaluation.fit.noise[:, None]
    for i in np.argsort(model.frequency_hz):
        rank = evaluation.fit.ranks[i]
        c, d = np.unravel_index(int(np.argmax(np.abs(model.residue[i]) * scale)), scale.shape)
        rows.append(
            (
                measured(float(model.frequency_hz[i]), K * float(u.frequency_hz[i])),
                measured(100 * float(model.damping_ratio[i]), 100 * K * float(u.damping_ratio[i])),
                str(rank.rank),
                f"{model.channels[c]} by {model.components[d]}",
            )
        )
    for q in np.argsort(model.real_hz):
        rank = evaluation.fit.ranks[len(model.frequency_hz) + q]
        value = measured(float(model.real_hz[q]), K * float(u.real_hz[q]))
        rows.append((value, "real pole", str(rank.rank), DASH))
    head = ("frequency / Hz", "damping ratio / %", "shapes", "clearest in")
    return Table("Poles that all outputs share, with U (k = 2)", head, "rrrl", tuple(rows))


def peak_tables(evaluation: DecoupleEvaluation) -> list[Table]:
    """Return for every stage what each load reads while each makes a step, in per cent of rated loads."""
    found, ratio = [], 100 * evaluation.scale / evaluation.scale[:, None]
    for stage in evaluation.stages:
        rows = []
        for i, reading in enumerate(stage.components):
            cells: list[str] = []
            for j in range(len(stage.components)):
                value, expanded = stage.peak[i, j] * ratio[i, j], K * stage.u_peak[i, j] * ratio[i, j]
                cells.append(measured(float(value), float(expanded)) if evaluation.comparable(i, j) else DASH)
            rows.append((reading, *cells))
        head = ("reading", *(f"step of {name}" for name in stage.components))
        unit = "rated load" if evaluation.capacity is not None else "the step"
        caption = f"Largest reading in a step, {STAGE_NAMES[stage.stage]}: % of {unit}, with U (k = 2)"
        found.append(Table(caption, head, "l" + "r" * len(stage.components), tuple(rows)))
    return found


def static_table(evaluation: DecoupleEvaluation) -> Table:
    """Return the static outputs with U for rated loads, without these per unit of load."""
    model = evaluation.fit.model
    value, expanded = model.static_gain * evaluation.scale, K * static_u(evaluation) * evaluation.scale
    exponent = common_exponent(value.astype(np.complex128))
    rows = tuple(
        (channel, *(fixed(float(value[c, d]), float(expanded[c, d]), exponent) for d in range(value.shape[1])))
        for c, channel in enumerate(model.channels)
    )
    head = ("output", *model.components)
    wanted = "for the rated load" if evaluation.capacity is not None else "per N and per N·m"
    caption = Markup("Output at rest {}, in {}, with U (k = 2)").format(wanted, times_ten(exponent, model.unit))
    return Table(caption, head, "l" + "r" * value.shape[1], rows)


def noise_table(evaluation: DecoupleEvaluation) -> Table:
    """Return the noise of the loads behind the filter beside that of the static matrix."""
    rows = tuple(
        (
            name,
            number(float(noise / gain)),
            number(float(noise)),
            number(float(gain)),
            typeset(load_unit(name)),
        )
        for name, noise, gain in zip(
            evaluation.fit.model.components, evaluation.noise, evaluation.noise_gain, strict=True
        )
    )
    head = ("load", "static matrix", "filter", "gain", "unit")
    return Table("Noise of a sample (standard deviation) by the outputs' noise", head, "lrrrl", rows)


def releases_table(evaluation: DecoupleEvaluation) -> Table:
    """Return what was found of every release."""
    rows = tuple(
        (
            release.record,
            release.component,
            release.release or DASH,
            measured(1e3 * release.middle_s, 1e3 * K * release.u_middle_s),
            measured(1e3 * release.duration_s, 1e3 * K * release.u_duration_s) if release.duration_s else "step",
            {"ramp": "line", "smooth": "half a cosine"}[release.shape],
            measured(100 * (release.gain - 1), 100 * K * release.u_gain),
            small(float(release.misfit.max())),
        )
        for release in evaluation.fit.releases
    )
    head = ("recording", "load", "released by", "middle / ms", "duration / ms", "along", "size − mean / %", "misfit")
    return Table("Releases, with U (k = 2); misfit: largest residual over the noise", head, "lllrrlrr", rows)


def trials_table(evaluation: DecoupleEvaluation) -> Table:
    """Return the numbers of poles that were tried."""
    rows = tuple(
        (
            str(t.modes),
            str(t.reals),
            f"{t.misfit:.4f}",
            f"{t.criterion:.0f}".replace("-", "−"),
            "yes" if t.kept else "no",
        )
        for t in evaluation.fit.trials
    )
    head = ("modes", "real poles", "residual² over noise²", "criterion", "kept")
    return Table("Numbers of poles that were tried (around the releases)", head, "rrrrl", rows)


def printed(evaluation: DecoupleEvaluation) -> Iterator[str]:
    """Lines for the terminal."""
    model, u = evaluation.fit.model, evaluation.fit.model.u
    told = []
    for i in np.argsort(model.frequency_hz):
        text = rounded(float(model.frequency_hz[i]), K * float(u.frequency_hz[i]))
        told.append(f"({text.value} ± {text.expanded})")
    yield f"{len(told)} modes common to {len(model.channels)} outputs: {', '.join(told)} Hz (k = 2)"
    for stage in evaluation.stages:
        value, expanded, which = largest(evaluation, stage)
        if which:
            text = rounded(100 * value, 100 * expanded)
            yield f"cross-talk in a step, {STAGE_NAMES[stage.stage]}: ({text.value} ± {text.expanded}) %, {which}"
    target, gain = evaluation.decoupler, evaluation.noise_gain
    yield (
        f"filter to {target.target_hz[0]:.6g} Hz, damping ratio {target.target_damping[0]:g}: "
        f"{len(target.poles)} poles, {target.delay} sample{'' if target.delay == 1 else 's'} of delay, "
        f"noise gain {gain.min():.3g} to {gain.max():.3g}"
    )
