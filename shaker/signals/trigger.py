"""The periodic model of a camera trigger: start, period, jitter, missing, doubled and spurious edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.notice import Notice
from shaker.signals.edges import EdgeKind, Edges
from shaker.signals.numbering import number_edges
from shaker.signals.posterior import Posterior, line_posterior
from shaker.signals.rise import fit_resolved

LEAST_JITTER = 1e-4  # of a sample
_IDLE = 1.05  # periods without an edge at an end of the record that show the burst to begin or end there
_LOCKED = 0.15  # of a sample: no edge over this range of phases once there are enough of them
_LOCKED_RISE = 0.1  # of a sample: interval of a reconstructed crossing's error that no other phase averages out
_RINGING = 1e-3  # of a sample: interval that the ringing of the pulse's other edge leaves open of a resolved one


@dataclass(frozen=True)
class TriggerFit:
    """Periodic model t_k = start_s + k·period_s of a trigger, in seconds from the record's first sample.

    `number` (E,): count of each edge kept (0 = first), which lies in (`lower_s`, `upper_s`] (E,); `edge_s` (E,) their
    own estimates, from which `correction_s` (E,) for the shape of the rise is taken off already. `kind`: what the model
    rests on, the intervals ("sampled") or the estimates ("resolved"); `resolution_s`: √12 times what sampling and noise
    leave open of one edge; `open_s`: of all edges alike, because they keep falling on the same places between samples
    or for the ringing of others. `covariance` (2, 2) of (start_s, period_s); `jitter_s` standard deviation of the edges
    about the model beyond what sampling explains; `missing` numbers without an edge, `doubled` and `spurious` edges
    dropped. `idle_before`, `idle_after`: the record shows that the burst begins or ends here.
    """

    start_s: float
    period_s: float
    number: IntArray
    lower_s: FloatArray
    upper_s: FloatArray
    edge_s: FloatArray
    correction_s: FloatArray
    kind: EdgeKind
    covariance: FloatArray
    jitter_s: float
    missing: tuple[int, ...]
    doubled: int
    spurious: int
    idle_before: bool
    idle_after: bool
    resolution_s: float
    open_s: float
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("number", self.number, (None,))
        for name in ("lower_s", "upper_s", "edge_s", "correction_s"):
            check_shape(name, getattr(self, name), self.number.shape)
        check_shape("covariance", self.covariance, (2, 2))

    @property
    def edges(self) -> int:
        """Number of edges from the first to the last, missing ones counted."""
        return int(self.number[-1]) + 1

    @property
    def crossing_s(self) -> FloatArray:
        """Edges as reconstructed, without the correction, (E,)."""
        return self.edge_s + self.correction_s

    @property
    def sample_s(self) -> float:
        """Sampling interval."""
        return float(np.median(self.upper_s - self.lower_s))

    def time_s(self, number: IntArray) -> FloatArray:
        """Return the modelled times of the edges numbered (any shape), seconds from the record's first sample."""
        return np.asarray(self.start_s + self.period_s * np.asarray(number, dtype=np.float64))

    def u_time_s(self, number: IntArray) -> FloatArray:
        """Return the standard uncertainty of `time_s` from the fit (the single edge's jitter is not in it)."""
        k = np.asarray(number, dtype=np.float64)
        c = self.covariance
        return np.asarray(np.sqrt(c[0, 0] + 2.0 * k * c[0, 1] + k**2 * c[1, 1]))

    def later_by(self, lag_s: float) -> TriggerFit:
        """Return the same trigger on a time axis on which it comes `lag_s` later."""
        return replace(
            self,
            start_s=self.start_s + lag_s,
            lower_s=self.lower_s + lag_s,
            upper_s=self.upper_s + lag_s,
            edge_s=self.edge_s + lag_s,
        )


def fit_trigger(edges: Edges) -> TriggerFit:
    """Fit t_k = start + k·period to the edges of a periodic trigger and number them.

    Missing edges are counted, doubled and stray ones dropped. Each true instant is known to lie in an interval one
    sample wide; the estimate is the mean of the posterior of (start, period) under Gaussian jitter of unknown size,
    which tends to the centre of the polygon of all intervals as the jitter vanishes (error ~ 1/edges) and to least
    squares as it grows (error ~ 1/√edges). Where the rise is resolved, least squares on the reconstructed crossings
    knows more; of the two the one with the smaller uncertainty counts. At least three edges are needed.
    """
    found = number_edges(edges)
    n = found.number[found.kept] - found.number[found.kept][0]
    lower, upper, estimate = edges.lower_s[found.kept], edges.upper_s[found.kept], edges.estimate_s[found.kept]
    half = n[-1] / 2.0
    place = (n - half) / half
    sample = float(np.median(upper - lower))
    kind: EdgeKind = "sampled"
    line, resolution = _from_intervals(place, lower, upper), sample
    edge, correction = (lower + upper) / 2.0, np.zeros(len(n))
    if edges.kind == "resolved":
        resolved, learnt = _from_crossings(place, estimate, (estimate - lower) / sample, edges.u_reading_s)
        if resolved.covariance[0, 0] < line.covariance[0, 0]:
            line, kind, edge, correction = resolved, "resolved", estimate - learnt, learnt
            resolution = np.sqrt(12.0) * edges.u_reading_s
    locked = _locked_gap(n, line.mean[1] / half / sample, line.jitter_s / sample)
    open_s = sample * (locked if kind == "sampled" else _LOCKED_RISE if locked else _RINGING)
    line = replace(line, covariance=line.covariance + np.diag([open_s**2 / 12.0, 0.0]))
    # From (middle, half span) to (start, period).
    jacobian = np.array([[1.0, -1.0], [0.0, 1.0 / half]])
    start, period = jacobian @ line.mean
    missing = tuple(int(i) for i in np.setdiff1d(np.arange(n[-1] + 1), n))
    fit = TriggerFit(
        start_s=float(start),
        period_s=float(period),
        number=n,
        lower_s=lower,
        upper_s=upper,
        edge_s=edge,
        correction_s=correction,
        kind=kind,
        covariance=jacobian @ line.covariance @ jacobian.T,
        jitter_s=line.jitter_s,
        missing=missing,
        doubled=found.doubled,
        spurious=found.spurious,
        idle_before=bool(start > _IDLE * period),
        idle_after=bool(edges.record_s - (start + n[-1] * period) > _IDLE * period),
        resolution_s=float(resolution),
        open_s=open_s,
        notices=(),
    )
    return replace(fit, notices=_notices(fit))


def straight_line(place: FloatArray, time: FloatArray, least_scatter: float) -> Posterior:
    """Fit time (E,) = m + h·place (E,) by least squares, with a scatter of at least `least_scatter`."""
    columns = np.stack([np.ones_like(place), place], axis=1)
    inverse = np.linalg.inv(columns.T @ columns)
    mean = inverse @ columns.T @ time
    residual = time - columns @ mean
    scatter = float(np.sqrt(residual @ residual / max(len(time) - 2, 1)))
    return Posterior(mean, inverse * max(scatter, least_scatter) ** 2, scatter)


def _from_intervals(place: FloatArray, lower: FloatArray, upper: FloatArray) -> Posterior:
    """Return (middle, half span) and jitter from intervals that hold the edges."""
    width = float(np.median(upper - lower))
    # Rounding to samples scatters by 0.29 of one, except where period and sampling are commensurate.
    start = straight_line(place, (lower + upper) / 2.0, 0.3 * width)
    return line_posterior(place, lower[None], upper[None], start, LEAST_JITTER * width)


def _from_crossings(
    place: FloatArray, time: FloatArray, phase: FloatArray, u_reading: float
) -> tuple[Posterior, FloatArray]:
    """Return (middle, half span) and jitter from resolved crossings, and the correction of each of them (E,)."""
    fit = fit_resolved(time, place, [phase])
    jitter = float(np.sqrt(max(fit.scatter_s**2 - u_reading**2, 0.0)))
    return Posterior(fit.mean, fit.covariance, jitter), fit.correction_s


def _locked_gap(number: IntArray, period: float, jitter: float) -> float:
    """Return the largest gap between the edges' places between samples if they take few, else 0; all in samples."""
    phase = np.sort(number * period % 1.0)
    gap = float(np.max(np.append(np.diff(phase), phase[0] + 1.0 - phase[-1])))
    return gap if gap > max(_LOCKED, 10.0 / len(number)) and jitter < _LOCKED else 0.0


def _notices(fit: TriggerFit) -> tuple[Notice, ...]:
    """Tell about edges that were not where the period puts them."""
    found = []
    if fit.missing:
        listed = ", ".join(str(i) for i in fit.missing[:5]) + (", …" if len(fit.missing) > 5 else "")
        found.append(Notice("warning", f"{len(fit.missing)} edges are missing (numbers {listed})", "trigger"))
    off = f"edges off the period of {fit.period_s:.6g} s"
    for count, what in ((fit.doubled, "doubled edges"), (fit.spurious, off)):
        if count:
            found.append(Notice("warning", f"{count} {what} were dropped", "trigger"))
    if fit.jitter_s > 1e-3 * fit.period_s:
        text = f"jitter of {fit.jitter_s * 1e6:.3g} us, over 0.1 % of the period"
        found.append(Notice("warning", text, "trigger"))
    if fit.open_s > _RINGING * fit.sample_s:
        u_middle = float(fit.u_time_s(np.asarray(fit.edges // 2)))
        text = (
            f"the edges always fall on the same places between two samples, which leaves their instants open to "
            f"{u_middle * 1e6:.2g} us; a period that is no simple multiple of the sampling interval removes this"
        )
        found.append(Notice("info", text, "trigger"))
    return tuple(found)
