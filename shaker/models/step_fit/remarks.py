"""What the user should know of an identification."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from shaker.models.modal import ModalModel
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step_fit.order import Found
from shaker.models.step_fit.output_error import Solution
from shaker.models.step_fit.uncertainty import Spread
from shaker.notice import Notice, Severity

SHAPES = {"step": "a step", "ramp": "a ramp", "smooth": "half a cosine", "measured": "the measured force"}
_UNCLEAR = 0.25  # relative standard uncertainty of a real pole or of a damping ratio that says little of it
_MORE = 1.5  # residual's variance over that of the noise before the release that a right model would leave


def remarks(record: StepRecord, reading: Reading, found: Found, model: ModalModel, known: Spread) -> tuple[Notice, ...]:
    """Return remarks on the poles, on the residual and on the release."""
    where = f"{record.name}, {reading.channel}"
    told = [*_poles(model, record.sample_rate_hz), *_residual(reading, known)]
    told += [*_release(record, found.solution, known), *_rival(found, model)]
    return tuple(Notice(severity, text, where) for severity, text in told)


def _poles(model: ModalModel, rate_hz: float) -> Iterator[tuple[Severity, str]]:
    """Yield what is wrong with poles: growing ones, ones that the sampling cannot tell, ones of no clear value."""
    assert model.covariance is not None
    u, modes = np.sqrt(np.diag(model.covariance)), len(model.frequency_hz)
    for place, (hz, zeta) in enumerate(zip(model.frequency_hz, model.damping_ratio, strict=True)):
        if zeta < 0:
            yield "warning", f"the mode at {hz:.5g} Hz grows, ζ = {zeta:.3g}: the model is unstable"
        elif u[modes + place] > _UNCLEAR * zeta or zeta > 0.6:
            yield (
                "warning",
                f"the mode at {hz:.5g} Hz, ζ = {zeta:.2g} ± {u[modes + place]:.1g}, may be none of the sensor's",
            )
        if hz > 0.4 * rate_hz:
            yield "warning", f"the mode at {hz:.5g} Hz lies near half the sampling rate of {rate_hz:.6g} Hz"
    for place, hz in enumerate(model.real_hz):
        if hz > 0.5 * rate_hz or u[4 * modes + place] > _UNCLEAR * abs(hz):
            yield (
                "warning",
                f"the real pole at {hz:.3g} ± {u[4 * modes + place]:.1g} Hz is hardly told by the record",
            )


def _residual(reading: Reading, known: Spread) -> Iterator[tuple[Severity, str]]:
    """Yield what the residual says of the model's order and of the noise."""
    ratio = float(np.std(known.residual)) / reading.noise if reading.noise > 0 else np.inf
    if ratio**2 > _MORE:
        yield (
            "warning",
            f"the residual is {ratio:.3g} times the noise before the release: the model's order is doubtful",
        )
    elif not known.white:
        yield (
            "info",
            f"the noise is coloured: the uncertainty of the poles is {np.sqrt(known.excess):.2g} times as large",
        )
    if reading.clipped:
        yield "warning", "the output ran into its limit: what was cut off bends the model"


def _release(record: StepRecord, solution: Solution, known: Spread) -> Iterator[tuple[Severity, str]]:
    """Yield what the release leaves open."""
    load, samples = solution.problem.load, solution.problem.samples
    if not load.timed:
        return
    middle, length = solution.problem.release(solution.vector)
    fastest = float(np.exp(np.max(solution.vector[: solution.problem.structure.modes]))) / (2 * np.pi)
    if known.u_onset_s > 0.1 / fastest:
        yield (
            "info",
            f"the onset is known to {known.u_onset_s:.1g} s only, and with it the phases of the residues; "
            "poles and static gain do not depend on it",
        )
    coarse = samples.time_s[samples.length > 1]
    if np.any(np.abs(coarse - middle) < 0.5 * length):
        yield "warning", f"the release at {middle:.6g} s lies outside the part of the record where it was looked for"
    if record.onset_s is not None and abs(record.onset_s - middle + 0.5 * length) > 1.0 / fastest:
        yield (
            "warning",
            f"the onset found, {middle - 0.5 * length:.6g} s, is not the one stated, {record.onset_s:.6g} s",
        )


def _rival(found: Found, model: ModalModel) -> Iterator[tuple[Severity, str]]:
    """Yield what another shape of the release, which the record does not exclude, would make of the real poles."""
    assert model.covariance is not None
    if found.rival is None or not len(model.real_hz):
        return
    structure = found.rival.problem.structure
    others = np.sort(-structure.poles(found.rival.vector)[structure.modes :].real / (2 * np.pi))
    own, u = np.sort(model.real_hz), np.sqrt(np.diag(model.covariance))[4 * structure.modes :][: len(model.real_hz)]
    if len(others) == len(own) and np.all(np.abs(others - own) < u[np.argsort(model.real_hz)]):
        return
    shapes = [SHAPES[solution.problem.load.shape] for solution in (found.solution, found.rival)]
    values = [" and ".join(f"{hz:.3g}" for hz in poles) for poles in (own, others)]
    yield (
        "info",
        f"the record does not tell whether the release is {shapes[0]} or {shapes[1]}: the real pole is {values[0]} Hz "
        f"or {values[1]} Hz, and gains between rest and resonance depend on which",
    )
