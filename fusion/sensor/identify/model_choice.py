"""The choice between rival models of an identification, in words and notices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fusion.sensor import response_notices as declared
from shaker.identification.rival_models import FittedRival, ModelChoice, RivalModel, unstated_lag_s
from shaker.identification.structure_fit import Identification
from shaker.identification.structures import CHANGE
from shakercal._common.digits import number_text, typeset
from shakercal._common.notices import Notice


def departure(found: Identification) -> float:
    """Return √(χ²/dof): residuals over their uncertainty, rms."""
    return float(np.sqrt(found.chi_squared / found.dof))


def describe_choice(choice: ModelChoice, selected: str, peaks_hz: Sequence[float]) -> str:
    """Return why a model was chosen, in words."""
    best = choice.best
    reason = "as selected; " if selected != "auto" else ""
    if selected == "auto" and best.model.structure != "translation" and len(peaks_hz) > 1:
        listed = " and ".join(f"{number_text(peak, 6)} Hz" for peak in peaks_hz[:2])
        reason = f"the curves have peaks at {listed}, of which one translation explains one; "
    reason += f"its residuals are {number_text(departure(best.identification))} times their uncertainty"
    others = [rival for rival in choice.tried if rival is not best and not rival.model.contains(best.model)]
    if others:
        second = min(others, key=choice.difference)
        reason += f", those of {second.model} {number_text(departure(second.identification))} times"
    return reason


def loss_frequency_hz(found: Identification, axis: str) -> float:
    """Return the frequency at which b acts as the loss factor does."""
    rate = found.value(f"loss_factor_{axis}") * found.value(f"stiffness_{axis}") / found.value(f"damping_{axis}")
    return float(rate / (2.0 * np.pi))


def verdict(choice: ModelChoice, rival: FittedRival) -> str:
    """Return what the data say of a rival."""
    if rival is choice.best:
        return "refuted" if rival.identification.is_rejected else "chosen"
    if rival in choice.undecided:
        return "not decided"
    return "more than needed" if rival.model.contains(choice.best.model) else "refuted by a better one"


def choice_notices(choice: ModelChoice, where: str, highest_hz: float, forces: Sequence[float]) -> Iterator[Notice]:
    """Yield what the choice of a model means for the results.

    `highest_hz`: last line of all curves; `forces`: largest force of the load in every recording of known amplitude.
    """
    found, model = choice.best.identification, choice.best.model
    if found.is_rejected:
        yield Notice(declared.MODEL_REJECTED, where, model=str(model), factor=np.sqrt(found.excess))
    for channel in model.filtered:
        lag_s, change = unstated_lag_s(found, channel, highest_hz)
        values = {"lag_us": 1e6 * lag_s, "change_percent": 100.0 * change, "frequency_hz": highest_hz}
        effect = "It is fitted, and U includes its uncertainty."
        yield Notice(declared.UNSTATED_FILTER_FOUND, where, channel=channel, **values, consequence=effect)
    if choice.undecided:
        listed = "; ".join(str(rival.model) for rival in (choice.best, *choice.undecided))
        yield Notice(declared.MODELS_UNDECIDED, where, models=listed)
    yield from _joint_notices(choice, where, forces)


def _joint_notices(choice: ModelChoice, where: str, forces: Sequence[float]) -> Iterator[Notice]:
    """Yield notices of damping and mount."""
    found, model = choice.best.identification, choice.best.model
    if model.loss_factor:
        viscous = [one for one in choice.tried if one.model == RivalModel(model.structure, filtered=model.filtered)]
        difference = choice.difference(viscous[0]) if viscous else np.inf
        frequency_hz = loss_frequency_hz(found, where.rpartition(" ")[2])
        yield Notice(declared.LOSS_FACTOR_FOUND, where, difference=difference, frequency_hz=frequency_hz)
    if model.by_amplitude:
        yield _by_amplitude(found, where, forces)
    if model.each:
        axis = where.rpartition(" ")[2]
        dampings = [one for one in found.estimates if one.name.partition(": ")[0] == f"damping_{axis}"]
        values, unit = [one.value for one in dampings], typeset(dampings[0].unit)
        if np.ptp(values) > 3.0 * max(one.u for one in dampings):
            yield Notice(declared.DAMPING_DIFFERS, where, lowest=min(values), highest=max(values), unit=unit)
    if model.structure == "adapter":
        axis = where.rpartition(" ")[2]
        ratio = found.value(f"stiffness_{axis}_adapter") / found.value(f"stiffness_{axis}")
        yield Notice(declared.COMPLIANT_MOUNT_FOUND, where, ratio=ratio)
    elif not found.is_rejected:
        yield Notice(declared.MOUNT_TREATED_AS_RIGID, where)


def _by_amplitude(found: Identification, where: str, forces: Sequence[float]) -> Notice:
    """Return how much stiffness and damping change over the amplitudes of the recordings."""
    axis = where.rpartition(" ")[2]
    share = [100.0 / found.value(f"{name}_{axis}") for name in ("stiffness", "damping")]
    changes = {
        "stiffness_percent": share[0] * found.value(f"{CHANGE}stiffness_{axis}"),
        "damping_percent": share[1] * found.value(f"{CHANGE}damping_{axis}"),
    }
    over = f"loads from {number_text(min(forces))} to {number_text(max(forces))} {'N' if len(axis) == 1 else 'N·m'}"
    return Notice(declared.CHANGES_WITH_AMPLITUDE, where, **changes, range=over)
