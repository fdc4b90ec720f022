"""Records of transfer functions: aligned channels, chains, and common errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import InputError
from fusion.estimation.coverage import along_and_across
from fusion.instruments.channel import DELAY_OF_FILTER, u_of_filter
from fusion.phasors.timing import ClockResult
from fusion.recording.daq_records import DaqRecord, read_daqs
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.response import read_response
from fusion.sensor import response_notices as declared
from shaker.frf.chain import ChainResponse
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.identification.amplitude import AmplitudeEffect
from shaker.identification.measured_curves import CurveError
from shaker.identification.oscillator import Resonance
from shakercal._common.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from fusion.phasors.aligned_channels import AlignedChannels, LocatedChannel

EstimatorChoice = Literal["auto", "rest", "periodic", "local", "H1", "H2", "Hv"]
Quantity = Literal["displacement", "velocity", "acceleration"]


@dataclass(frozen=True)
class TransferSettings:
    """Choices of an estimate of transfer functions.

    Attributes
    ----------
    estimator : "auto" (default), "rest", "periodic", "local", "H1", "H2" or "Hv".
    resolution_hz : line spacing of averaged spectra in Hz; None derives it from the length of the record.
    quantity : "displacement", "velocity" or "acceleration" of every motion; None keeps the measured quantity.

    Examples
    --------
    >>> from fusion import TransferSettings
    >>> TransferSettings(estimator="H1", resolution_hz=0.5).estimator
    'H1'
    """

    estimator: EstimatorChoice = "auto"
    resolution_hz: float | None = None
    quantity: Quantity | None = None

    def __post_init__(self) -> None:
        if self.estimator not in get_args(EstimatorChoice):
            raise ValueError(f"estimator: expected {', '.join(get_args(EstimatorChoice))}, found {self.estimator}")
        if self.resolution_hz is not None and not self.resolution_hz > 0.0:
            raise ValueError(f"resolution_hz: expected a number above 0, found {self.resolution_hz}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        resolution = "from the record" if self.resolution_hz is None else self.resolution_hz
        return {"estimator": self.estimator, "resolution_hz": resolution, "quantity": self.quantity or "as measured"}


@dataclass(frozen=True)
class FoundResonance:
    """A resonance of one `response` over its reference, fitted over the lines between `band_hz`.

    `u_frequency_hz`, `u_damping_ratio`: standard uncertainties by noise and all common errors. `budget`: change of
    frequency (Hz) and damping ratio by one standard deviation of each cause. `amplitude`: deviation from a linear
    spring and damper, None if none is significant. A resonance that its curve refutes has NaN as uncertainties.
    """

    response: str
    reference: str
    fit: Resonance
    band_hz: tuple[float, float]
    u_frequency_hz: float
    u_damping_ratio: float
    budget: dict[str, tuple[float, float]]
    amplitude: AmplitudeEffect | None = None


@dataclass(frozen=True)
class ReferenceResult:
    """All transfer functions over one reference (`name`).

    Attributes
    ----------
    transfer : corrected for delays and responses, as the requested quantity, with the covariance of all errors.
    random_covariance : (K, 2C, 2C) of the noise only.
    errors : errors common to all lines; of repeats that differ, the effect of each, which `transfer` has in its noise.
    resonances : resonances of the curves.
    peaks : (C,), largest reading of each response from its mean, in its unit; empty if not known.
    """

    name: str
    transfer: TransferFunction
    random_covariance: FloatArray
    errors: tuple[CurveError, ...]
    resonances: tuple[FoundResonance, ...]
    peaks: tuple[float, ...] = ()


@dataclass(frozen=True)
class TransferEvaluation(CommandEvaluation):
    """One evaluated recording: transfer functions over every reference, clocks where blocks were tied."""

    manifest: Manifest
    references: tuple[ReferenceResult, ...]
    clocks: tuple[ClockResult, ...]


REPEAT = "repeat "
"""Prefix of the names of the effects of repeats."""


def repeat_errors(transfer: TransferFunction) -> tuple[CurveError, ...]:
    """Return the effect of each repeat on all lines, if repeats differ beyond noise."""
    effects = () if transfer.repeat_effects is None else transfer.repeat_effects
    return tuple(CurveError(f"{REPEAT}{number}", effect) for number, effect in enumerate(effects, 1))


# Errors that act on all lines of a transfer function at once: scale, delay, chain response, clock.


@dataclass(frozen=True)
class ChannelChain:
    """A recorded channel with its chain at K lines, and the uncertainty of its clock."""

    entry: ChannelEntry
    frequency_hz: FloatArray
    response: ChainResponse | None
    clock: str
    u_clock_s: float

    @property
    def correction(self) -> ComplexArray:
        """Factor (K,) from recorded to true phasor, exp(+jω·delay) / response(f)."""
        factor = np.exp(2j * np.pi * self.frequency_hz * self.entry.delay)
        return np.asarray(factor if self.response is None else factor / self.response.value, dtype=np.complex128)

    @property
    def errors(self) -> Mapping[str, ComplexArray]:
        """Complex relative errors (K,) of the corrected phasor by cause, for one standard deviation.

        Channels of one `common` name share scale, delay and response, and therefore these names.
        """
        entry, shared = self.entry, self.entry.common or self.entry.name
        turn = np.asarray(2j * np.pi * self.frequency_hz, dtype=np.complex128)
        flat = np.ones(len(turn), dtype=np.complex128)
        found = {
            f"{shared}: scale": entry.scale_uncertainty * flat,
            f"{shared}: delay": entry.delay_uncertainty * turn,
            f"{entry.name}: individual scale": entry.individual_uncertainty * flat,
            f"clock {self.clock}": -self.u_clock_s * turn,
        }
        magnitude, phase = u_of_filter(self.frequency_hz, entry.filter_delay_s)
        if entry.filter_delay_s:
            found[f"{shared}: {DELAY_OF_FILTER}"] = magnitude * flat
            found[f"{shared}: {DELAY_OF_FILTER}, phase"] = 1j * phase * flat
        if self.response is not None:
            for cause, error in zip(self.response.causes, self.response.errors, strict=True):
                found[f"{shared}: {cause}"] = -error
        return found


def channel_chain(channel: LocatedChannel, frequency_hz: FloatArray) -> ChannelChain:
    """Return a channel with its response file read at frequencies (K,)."""
    entry = channel.entry
    response = None
    if entry.response is not None:
        response = read_response(entry.response, frequency_hz, entry.response_result, entry.response_columns)
    return ChannelChain(entry, frequency_hz, response, channel.record.entry.name, channel.u_clock_s)


def uncertainty(value: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return u(|H|)/|H| and u(arg H) in rad (K,) of values with covariance (K, 2, 2)."""
    frame = along_and_across(value)
    along, across = np.einsum("kia,kij,kja->ak", frame, covariance, frame)
    return np.sqrt(np.maximum(along, 0.0)) / np.abs(value), np.sqrt(np.maximum(across, 0.0)) / np.abs(value)


def ratio_errors(reference: ChannelChain, responses: Sequence[ChannelChain]) -> tuple[CurveError, ...]:
    """Return the common errors of the ratios (K, C), in which shared errors cancel."""
    below, above = reference.errors, [chain.errors for chain in responses]
    zero = np.zeros(len(reference.frequency_hz), dtype=np.complex128)
    names = dict.fromkeys([*below, *(name for errors in above for name in errors)])
    found = [
        CurveError(name, np.stack([errors.get(name, zero) - below.get(name, zero) for errors in above], axis=1))
        for name in names
    ]
    return tuple(error for error in found if np.any(error.relative != 0.0))


# Reference and responses of a recording on one clock and at one rate.


@dataclass(frozen=True)
class SynchronousRecord:
    """One reference and its responses, `aligned` in this order, with their `samples` on one grid.

    `u_clock`: relative standard uncertainty of the clock that counts the time. `repeats`: the samples of further files.
    """

    aligned: AlignedChannels
    samples: TransferRecord
    u_clock: float
    repeats: tuple[TransferRecord, ...] = ()


def read_synchronous(manifest: Manifest) -> tuple[SynchronousRecord, ...]:
    """Read the channels that the excitation names; one entry per reference.

    Without `response` every other channel but triggers is one. Raises `InputError`.
    """
    excitation = manifest.excitation
    if not excitation.reference:
        expected = "the name of the channel over which the others are taken, such as the force or the base acceleration"
        raise InputError(declared.MISSING_TRANSFER_ENTRY, manifest.path, "excitation.reference", expected=expected)
    by_name: dict[str, list[tuple[str, ChannelEntry]]] = {}
    for daq in manifest.daq:
        for entry in daq.channel:
            if entry.quantity != "trigger":
                by_name.setdefault(entry.name, []).append((daq.name, entry))
    named = excitation.response or [name for name in by_name if name not in excitation.reference]
    if not named:
        expected = "a channel in addition to the reference"
        raise InputError(declared.MISSING_TRANSFER_ENTRY, manifest.path, "excitation.response", expected=expected)
    for key, name in [*(("reference", name) for name in excitation.reference), *(("response", name) for name in named)]:
        where = by_name.get(name, [])
        if len(where) != 1:
            blocks = " and ".join(block for block, _ in where)
            found = f"{name} in the blocks {blocks}" if where else f"{name} (a trigger)"
            expected = "the name of exactly one channel"
            raise InputError(
                declared.WRONG_CHANNEL_NAME, manifest.path, f"excitation.{key}", found=found, expected=expected
            )
        if key == "response" and name in excitation.reference:
            expected = "other channels than the references"
            raise InputError(
                declared.WRONG_CHANNEL_NAME, manifest.path, "excitation.response", found=name, expected=expected
            )
    selected = [by_name[name][0] for name in named]
    first, *further = (
        [_together(part, records, [by_name[name][0], *selected]) for name in excitation.reference]
        for part, records in _read(manifest)
    )
    return tuple(_joined(together, repeats) for together, *repeats in zip(first, *further, strict=True))


def _read(manifest: Manifest) -> Iterator[tuple[Manifest, Sequence[DaqRecord]]]:
    """Yield the manifest with its records, and again with those of every repeat."""
    yield manifest, read_daqs(manifest)
    for number in range(len(manifest.daq[0].further_files)):
        daq = tuple(daq.model_copy(update={"file": daq.further_files[number]}) for daq in manifest.daq)
        part = replace(manifest, daq=daq)
        try:
            yield part, read_daqs(part)
        except InputError as error:
            block, _, key = error.key.rpartition(".")
            if key != "file":
                raise
            raise error.at(f"{block}.repeats") from error


def _joined(together: SynchronousRecord, repeats: Sequence[SynchronousRecord]) -> SynchronousRecord:
    """Return the first record with the samples and the notices of all repeats."""
    notices = dict.fromkeys(notice for record in (together, *repeats) for notice in record.aligned.notices)
    limits = [record.aligned.highest_hz for record in (together, *repeats)]
    highest_hz = min((limit for limit in limits if limit is not None), default=None)
    aligned = replace(together.aligned, notices=tuple(notices), highest_hz=highest_hz)
    return replace(together, aligned=aligned, repeats=tuple(record.samples for record in repeats))


def _together(
    manifest: Manifest, records: Sequence[DaqRecord], selected: Sequence[tuple[str, ChannelEntry]]
) -> SynchronousRecord:
    """Return channels, the reference first, on a common grid."""
    from fusion.phasors.aligned_channels import align  # here, for results are read without it

    aligned = align(manifest, records, selected, "excitation.response")
    names, units = zip(*((entry.name, manifest.rig.unit_of(entry.quantity)) for _, entry in selected), strict=True)
    samples = TransferRecord(
        reference=aligned.values[0],
        responses=np.stack(aligned.values[1:], axis=1),
        sample_rate_hz=aligned.rate_hz,
        reference_name=names[0],
        reference_unit=units[0],
        channels=names[1:],
        unit=units[1:],
    )
    clock = records[0] if aligned.base is not None else aligned.channels[0].record
    return SynchronousRecord(aligned, samples, clock.entry.clock_uncertainty)
