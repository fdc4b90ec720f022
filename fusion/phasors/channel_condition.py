"""Phasors of channels with clipped, lost or coarse samples, and the errors that these cause."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import InputError
from fusion.instruments.channel import NOISE_REACH, ChannelRelativeError
from fusion.instruments.transducer import chain_name
from fusion.phasors.phasor_notices import CLIPPED_CHANNEL, COARSE_CONVERTER, REJECTED_SAMPLES, UNUSABLE_CHANNEL
from shaker.io.channel import Stacked
from shaker.io.condition import FEWEST_STEPS, Defect, converter_step
from shaker.sine.sine_fit import quantisation_error
from shaker.sine.solve import SineFit
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.recording.daq_records import DaqRecord
    from fusion.recording.manifest import ChannelEntry

MIN_USABLE_SHARE = 0.25
"""Smallest share of samples that are neither clipped nor lost (chosen); with fewer there is no result."""
DEPTH, NARROWER = 4.0, 0.1
"""Distance of used samples from a limit in deviations of the residual; further distance of a second fit, over the
amplitude (chosen)."""
MATTERS = 0.05
"""Change by converter steps over the noise of a line above which U includes it (chosen)."""
Fitter = Callable[[Stacked], SineFit]


def require_usable(record: DaqRecord, channel: ChannelEntry) -> None:
    """Raise if too few samples of a channel are neither clipped nor lost."""
    raw, defects = record.raw[channel.name], record.defects(channel)
    if sum(defect.count for defect in defects) > (1.0 - MIN_USABLE_SHARE) * len(raw.samples):
        raise _unusable(record, channel, defects)


def _unusable(record: DaqRecord, channel: ChannelEntry, defects: Sequence[Defect]) -> InputError:
    defects_found = " and ".join(_described(record, channel, defect) for defect in defects)
    expected = f"at least {100 * MIN_USABLE_SHARE:g} % of the samples, at all phases, within the range of the recorder"
    found = f"a channel that {defects_found}"
    return InputError(UNUSABLE_CHANNEL, record.entry.file, channel.stored_name, found=found, expected=expected)


def _described(record: DaqRecord, channel: ChannelEntry, defect: Defect) -> str:
    return defect.text(record.time_s(channel.name), record.raw[channel.name].unit)


def fit_usable(
    record: DaqRecord, group: Sequence[ChannelEntry], fitted: Fitter, time_s: FloatArray
) -> tuple[SineFit, Stacked, ComplexArray | None]:
    """Fit lines to samples that are neither lost nor clipped.

    Returns the fit and the values used (S, C). A channel with such samples is alone in its group. The fitted curve
    decides which samples are clipped, so that noise near a limit does not select them. The third result is the relative
    change of the lines, as Re and Im, if the fit keeps a larger distance from the limits: filters, or a saturating
    amplifier, round samples near them. None without clipping.
    """
    channel, values = group[0], record.usable_samples(group)
    require_usable(record, channel)
    fit = fitted(values)
    clipped = next((defect for defect in record.defects(channel) if defect.kind == "clipped"), None)
    if clipped is None:
        return fit, values, None
    column = values[:]
    low, high = sorted(level * channel.scale for level in clipped.levels)
    for more in (0.0, 0.0, NARROWER):
        curve, before = fit.model(time_s)[:, 0], fit
        depth = DEPTH * float(fit.residual_rms[0]) + more * float(np.ptp(curve)) / 2.0
        inside = (curve > low + depth) & (curve < high - depth)
        if np.count_nonzero(inside & np.isfinite(column[:, 0])) < MIN_USABLE_SHARE * len(values):
            raise _unusable(record, channel, [clipped])
        used = Stacked.from_array(np.where(inside[:, None], column, np.nan))
        try:
            fit = fitted(used)
        except ValueError as error:  # samples that are synchronous with a line show it at too few phases
            raise _unusable(record, channel, [clipped]) from error
        values = values if more else used
    change = fit.phasors.value[:, 0] / before.phasors.value[:, 0] - 1.0
    return before, values, np.asarray(np.abs(change) * (1.0 + 1.0j))


def assess_condition(
    record: DaqRecord, index: int, fit: SineFit, time_s: FloatArray, clipped: ComplexArray | None, seen: BoolArray
) -> tuple[list[ChannelRelativeError], list[Notice]]:
    """Return the errors of a fitted channel caused by its samples, and notices.

    `clipped`: third result of `fit_usable`. The errors are those of all lines (K,), of which the fit contains those
    `seen` first.
    """
    channel = next(entry for entry in record.entry.channel if entry.name == fit.phasors.channels[index])
    step = abs(channel.scale) * converter_step(record.raw[channel.name].samples)
    rounded = _rounded(fit, index, step, time_s)
    where = f"{record.entry.name}, {channel.name}"
    errors, notices = list[ChannelRelativeError](), list[Notice]()
    for kind, change in (("clipping", clipped), ("converter steps", rounded)):
        if change is not None:
            errors += _errors(channel, kind, change, seen)
    for defect in record.defects(channel):
        text = _described(record, channel, defect)
        if defect.kind == "clipped" and clipped is not None:
            u_percent = 100.0 * float(clipped.real[0])
            notices.append(Notice(CLIPPED_CHANNEL, where, defect=text, u_percent=u_percent))
        else:
            notices.append(Notice(REJECTED_SAMPLES, where, defect=text))
    size = float(np.max(np.abs(fit.phasors.value[:, index])))
    if rounded is not None and size < FEWEST_STEPS * step:
        bound_percent = 100.0 * float(np.sqrt(3.0) * rounded.real[0])
        notices.append(Notice(COARSE_CONVERTER, where, steps=size / step, bound_percent=bound_percent))
    return errors, notices


def _rounded(fit: SineFit, index: int, step: float, time_s: FloatArray) -> ComplexArray | None:
    """Return the relative u (K,) by converter steps as Re and Im, None if negligible.

    The change has a uniform distribution between its bounds.
    """
    size = np.abs(fit.phasors.value[:, index])
    if not step > 0.0 or not size.any():
        return None
    noise = np.hypot(fit.phasors.u_re[:, index], fit.phasors.u_im[:, index])
    u = quantisation_error(fit, index, time_s, step) / np.sqrt(3.0)
    u[size <= NOISE_REACH * noise] = 0.0
    return u if np.any(np.abs(u) * size > MATTERS * noise) else None


def _errors(channel: ChannelEntry, kind: str, change: ComplexArray, seen: BoolArray) -> Iterator[ChannelRelativeError]:
    """Yield the errors of amplitude and phase of a channel."""
    for part, relative in (("amplitude", change.real + 0.0j), ("phase", 1j * change.imag)):
        effect = np.zeros((len(seen), 1), dtype=np.complex128)
        effect[seen, 0] = relative[: np.count_nonzero(seen)]
        yield ChannelRelativeError(
            f"{channel.name}: {kind}, {part}", f"{chain_name(channel)}: {kind}", 1.0, "1", effect
        )
