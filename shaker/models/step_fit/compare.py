"""Every method on the same record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release
from shaker.models.step_fit.evolution import fit_evolution
from shaker.models.step_fit.fit import fit_step
from shaker.models.step_fit.result import Method, StepFit
from shaker.models.step_fit.sim import fit_sim

METHODS: tuple[Method, ...] = ("pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients")


def compare(
    record: StepRecord,
    channel: str,
    *,
    rng: np.random.Generator,
    reading: Reading | None = None,
    methods: Sequence[Method] = METHODS,
    modes: int | None = None,
    real_poles: int | None = None,
) -> tuple[StepFit, ...]:
    """Return the fits of one output by several methods, in the order of `methods`.

    All share one reading of the release. `modes` and `real_poles` are those of the two methods that take them; the
    published ones choose their order themselves or keep the published three poles. `rng` draws the first generation.
    """
    found = reading or read_release(record, channel)

    default = partial(fit_step, record, channel, reading=found, modes=modes, real_poles=real_poles)
    by: dict[Method, Callable[[], StepFit]] = {
        "pencil": lambda: default(method="pencil"),
        "arx": lambda: default(method="arx"),
        "sim": lambda: fit_sim(record, channel, reading=found, conversion="tustin"),
        "sim_zoh": lambda: fit_sim(record, channel, reading=found, conversion="zoh"),
        "evolution": lambda: fit_evolution(record, channel, reading=found, rng=rng),
        "evolution_coefficients": lambda: fit_evolution(
            record, channel, reading=found, rng=rng, parametrisation="coefficients"
        ),
    }
    return tuple(by[method]() for method in methods)
