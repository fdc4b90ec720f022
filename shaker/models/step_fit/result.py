"""What an identification from a step response returns, whatever the method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from shaker._checks import FloatArray, check_shape
from shaker.models.linear_system import LinearSystem
from shaker.models.modal import ModalModel
from shaker.models.step.reading import Shape
from shaker.notice import Notice

Method = Literal["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]


@dataclass(frozen=True)
class StepFit:
    """A model of one output for one load component.

    `model`: continuous, in output unit per load unit, None where the poles of `system` have no modal form; `system`:
    the same, or what the method itself yields, at full precision; `sample_rate_hz`, `decimation`: of the samples that
    were fitted; `fitted`, `residual` (N,) over `time_s` (N,) in output units; `onset_s`, `u_onset_s`, `release_s`,
    `u_release_s`: begin and length of the release, taken for one of `shape`; `variance_accounted`:
    1 - |residual|²/|y - mean|²; `convergence`: loss over iterations or generations, or over the order 1, 2, …;
    `order`: number of poles; `duration_s`: time taken.
    """

    method: Method
    channel: str
    component: str
    unit: str
    model: ModalModel | None
    system: LinearSystem
    time_s: FloatArray
    fitted: FloatArray
    residual: FloatArray
    sample_rate_hz: float
    decimation: int
    order: int
    variance_accounted: float
    convergence: FloatArray
    duration_s: float
    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    shape: Shape = "step"
    notices: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        check_shape("time_s", self.time_s, (None,))
        check_shape("fitted", self.fitted, self.time_s.shape)
        check_shape("residual", self.residual, self.time_s.shape)
        check_shape("convergence", self.convergence, (None,))
