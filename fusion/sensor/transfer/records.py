"""Records of chirp, noise and blows, and what their transfer functions are uncertain by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from fusion.base import InputError
from fusion.phasors.timing import ClockResult, TimeBase, tie_daqs
from fusion.recording.files import DaqRecord, read_daqs
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.response import read_response
from shaker.arrays import ComplexArray, FloatArray, Notice
from shaker.frf.chain import ChainResponse
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.identification.oscillator import Resonance
from shaker.timebase.edges import PASS_BAND, kernel_reach, resampled

# What an evaluated transfer recording consists of, and what a user may choose about it.


EstimatorChoice = Literal["auto", "periodic", "local", "H1", "H2", "Hv"]
Quantity = Literal["displacement", "velocity", "acceleration"]


@dataclass(frozen=True)
class TransferSettings:
    """Choices that change results: the estimator, the line spacing of averaged spectra (Hz), the motion's quantity.

    None leaves the line spacing to the record's length, and every motion in the quantity in which it was measured.

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
        return {
            "estimator": self.estimator,
            "resolution_hz": resolution,
            "quantity": self.quantity or "as measured",
        }


@dataclass(frozen=True)
class CommonError:
    """One cause of error that acts on all lines at once.

    `relative` (K, C): complex relative deviation of every transfer function for one standard deviation of the cause.
    """

    name: str
    relative: ComplexArray


@dataclass(frozen=True)
class FoundResonance:
    """A resonance of one `response` over its reference, fitted over the lines between `band_hz`.

    `u_frequency_hz`, `u_damping_ratio`: standard uncertainties, noise and all common errors together; `budget`: by
    cause what one standard deviation changes of frequency (Hz) and damping ratio.
    """

    response: str
    reference: str
    fit: Resonance
    band_hz: tuple[float, float]
    u_frequency_hz: float
    u_damping_ratio: float
    budget: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class ReferenceResult:
    """All transfer functions over one reference (`name`).

    `transfer`: delays and responses taken off, quantity as wanted, covariance of noise and common errors together.
    `random_covariance` (K, 2C, 2C): that of the noise alone. `errors`: what is common to the lines. `resonances`: found
    in the curves.
    """

    name: str
    transfer: TransferFunction
    random_covariance: FloatArray
    errors: tuple[CommonError, ...]
    resonances: tuple[FoundResonance, ...]


@dataclass(frozen=True)
class TransferEvaluation:
    """One evaluated recording: transfer functions over every reference, clocks where blocks were tied, origin."""

    manifest: Manifest
    references: tuple[ReferenceResult, ...]
    clocks: tuple[ClockResult, ...]
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float

    @property
    def name(self) -> str:
        """Return the name of the recording."""
        return self.manifest.name


# Errors that act on all lines of a transfer function at once: scale, delay, chain response, clock.


@dataclass(frozen=True)
class ChannelChain:
    """A channel as recorded, with its chain at K lines and the uncertainty of its block's tie to the first clock."""

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
        """Complex relative error (K,) of the corrected phasor by the name of its cause, one standard deviation each.

        Channels of one `common` name share scale, delay and response, hence these names.
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
        if self.response is not None:
            for cause, error in zip(self.response.causes, self.response.errors, strict=True):
                found[f"{shared}: {cause}"] = -error
        return found


def channel_chain(entry: ChannelEntry, frequency_hz: FloatArray, clock: str, u_clock_s: float) -> ChannelChain:
    """Return a channel with its response file read at frequencies (K,)."""
    response = None if entry.response is None else read_response(entry.response, frequency_hz)
    return ChannelChain(entry, frequency_hz, response, clock, u_clock_s)


def ratio_errors(reference: ChannelChain, responses: Sequence[ChannelChain]) -> tuple[CommonError, ...]:
    """Return the common errors of the ratios (K, C) responses over reference; what both share cancels."""
    below, above = reference.errors, [chain.errors for chain in responses]
    zero = np.zeros(len(reference.frequency_hz), dtype=np.complex128)
    names = dict.fromkeys([*below, *(name for errors in above for name in errors)])
    found = []
    for name in names:
        relative = np.stack([errors.get(name, zero) - below.get(name, zero) for errors in above], axis=1)
        if np.any(relative != 0.0):
            found.append(CommonError(name, relative))
    return tuple(found)


# Reference and responses of a recording on one clock and at one rate.


@dataclass(frozen=True)
class Located:
    """A channel, the block that recorded it, and the standard uncertainty of that block's tie to the first clock."""

    entry: ChannelEntry
    record: DaqRecord
    u_clock_s: float

    @property
    def rate_hz(self) -> float:
        """Sampling rate on the block's own clock."""
        return self.record.raw[self.entry.name].sample_rate_hz


@dataclass(frozen=True)
class Together:
    """One reference and its responses with their samples on one grid.

    `highest_hz`: up to where the samples may be used, None where they are those of the file. `base`: the clocks, where
    they had to be tied. `u_clock`: relative standard uncertainty of the clock that counts the time.
    """

    reference: Located
    responses: tuple[Located, ...]
    samples: TransferRecord
    u_clock: float
    highest_hz: float | None
    base: TimeBase | None
    notices: tuple[Notice, ...]


def read_together(manifest: Manifest) -> tuple[Together, ...]:
    """Read the channels that the excitation names; one entry per reference.

    Without `response` every other channel but triggers is one. Raises `InputError`.
    """
    excitation = manifest.excitation
    if not excitation.reference:
        expected = "the name of the channel over which the others are taken, such as the force or the base acceleration"
        raise InputError(manifest.path, "excitation.reference", found="nothing", expected=expected)
    places = _places(manifest)
    named = excitation.response or [name for name in places if name not in excitation.reference]
    if not named:
        expected = "a channel beside the reference"
        raise InputError(manifest.path, "excitation.response", found="none", expected=expected)
    for key, names in (("reference", excitation.reference), ("response", named)):
        for name in names:
            _check_named(manifest, key, name, places)
    records = read_daqs(manifest)
    return tuple(_together(manifest, records, places, [name, *named]) for name in excitation.reference)


def _places(manifest: Manifest) -> dict[str, list[tuple[str, ChannelEntry]]]:
    """Return where a name is found: blocks and entries of the channels that are no triggers."""
    found: dict[str, list[tuple[str, ChannelEntry]]] = {}
    for daq in manifest.daq:
        for entry in daq.channel:
            if entry.quantity != "trigger":
                found.setdefault(entry.name, []).append((daq.name, entry))
    return found


def _check_named(manifest: Manifest, key: str, name: str, places: dict[str, list[tuple[str, ChannelEntry]]]) -> None:
    """Refuse a name that is a trigger's, that two blocks have, or that is reference and response at once."""
    where = places.get(name, [])
    if len(where) != 1:
        blocks = " and ".join(block for block, _ in where)
        found = f'"{name}", which is in the blocks {blocks}' if where else f'"{name}", a trigger'
        raise InputError(manifest.path, f"excitation.{key}", found=found, expected="a name that one channel has")
    if key == "response" and name in manifest.excitation.reference:
        expected = "other channels than the references"
        raise InputError(manifest.path, "excitation.response", found=f'"{name}"', expected=expected)


def _together(
    manifest: Manifest,
    records: Sequence[DaqRecord],
    places: dict[str, list[tuple[str, ChannelEntry]]],
    names: Sequence[str],
) -> Together:
    """Return channels, the reference first, as they were sampled together or else on a common grid."""
    found = align(manifest, records, [places[name][0] for name in names], "excitation.response")
    units = [manifest.rig.unit_of(channel.entry) for channel in found.channels]
    samples = TransferRecord(
        reference=found.values[0],
        responses=np.stack(found.values[1:], axis=1),
        sample_rate_hz=found.rate_hz,
        reference_name=names[0],
        reference_unit=units[0],
        channels=tuple(names[1:]),
        unit=tuple(units[1:]),
    )
    clock = records[0] if found.base is not None else found.channels[0].record
    highest_hz, u_clock = found.highest_hz, clock.entry.clock_uncertainty
    return Together(
        found.channels[0], tuple(found.channels[1:]), samples, u_clock, highest_hz, found.base, found.notices
    )


@dataclass(frozen=True)
class Aligned:
    """Channels and their samples (N,) each at the same times: from `start_s` on the first clock with `rate_hz`.

    `highest_hz`: up to where they may be used, None where they are those of the file. `base`: the clocks, where they
    had to be tied.
    """

    channels: tuple[Located, ...]
    values: tuple[FloatArray, ...]
    rate_hz: float
    start_s: float
    highest_hz: float | None
    base: TimeBase | None
    notices: tuple[Notice, ...]


def align(
    manifest: Manifest, records: Sequence[DaqRecord], wanted: Sequence[tuple[str, ChannelEntry]], key: str
) -> Aligned:
    """Return channels, each with the name of its block, as they were sampled together or else on a common grid.

    Raises `InputError` at `key` where they do not overlap.
    """
    blocks = {record.entry.name: record for record in records}
    used = dict.fromkeys(block for block, _ in wanted)
    base = None
    if len(used) > 1:
        base = tie_daqs(manifest, [record for record in records if record is records[0] or record.entry.name in used])
    channels = tuple(Located(entry, blocks[name], _u_clock_s(base, blocks[name], entry.name)) for name, entry in wanted)
    alike = {(c.record.entry.name, c.rate_hz, c.record.lag_s(c.entry.name), _length(c)) for c in channels}
    if len(alike) == 1:
        values = tuple(c.record.values(c.entry) for c in channels)
        start_s = channels[0].record.lag_s(channels[0].entry.name)
        return Aligned(channels, values, channels[0].rate_hz, start_s, None, base, ())
    grid = _common_grid(manifest, channels, base, key)
    values = tuple(grid.read(c, base) for c in channels)
    highest_hz = PASS_BAND * grid.rate_hz
    return Aligned(channels, values, grid.rate_hz, float(grid.time_s[0]), highest_hz, base, (grid.notice(),))


def _length(channel: Located) -> int:
    """Return the number of samples of a channel."""
    return len(channel.record.raw[channel.entry.name].samples)


def _u_clock_s(base: TimeBase | None, record: DaqRecord, name: str) -> float:
    """Return the standard uncertainty of a block's tie in the middle of a channel's record."""
    tie = None if base is None else base.ties[record.entry.name]
    return 0.0 if tie is None else float(tie.u_to_base_s(np.asarray(record.time_s(name).mean())))


@dataclass(frozen=True)
class _Grid:
    """Times (T,) on the first clock at which all channels are read: those of the slowest one."""

    time_s: FloatArray
    rate_hz: float
    slowest: str

    def read(self, channel: Located, base: TimeBase | None) -> FloatArray:
        """Return the samples (T,) of a channel at the times of the grid."""
        values = channel.record.values(channel.entry)
        return resampled(values, _position(channel, base, self.time_s), min(1.0, self.rate_hz / channel.rate_hz))

    def notice(self) -> Notice:
        """Say what was done."""
        text = (
            f"channels of different clocks or rates are read at the times of {self.slowest}, {self.rate_hz:.9g} Hz of "
            f"the first clock, and used up to {PASS_BAND * self.rate_hz:.6g} Hz"
        )
        return Notice("info", text, self.slowest)


def _position(channel: Located, base: TimeBase | None, time_s: FloatArray) -> FloatArray:
    """Return where times of the first clock lie in a channel's record, in samples from its first one."""
    tie = None if base is None else base.ties[channel.record.entry.name]
    own = time_s if tie is None else (time_s - tie.offset_s) / tie.rate
    return np.asarray((own - channel.record.lag_s(channel.entry.name)) * channel.rate_hz)


def _common_grid(manifest: Manifest, channels: Sequence[Located], base: TimeBase | None, key: str) -> _Grid:
    """Return the times of the slowest channel that lie well inside the records of all."""
    slowest = min(channels, key=lambda channel: channel.rate_hz)
    own = slowest.record.time_s(slowest.entry.name)
    name = slowest.record.entry.name
    time_s = own if base is None else base.to_base_s(name, own)
    tie = None if base is None else base.ties[name]
    rate_hz = slowest.rate_hz if tie is None else slowest.rate_hz / tie.rate
    inside = np.ones(len(time_s), dtype=np.bool_)
    for channel in channels:
        position = _position(channel, base, time_s)
        reach = kernel_reach(min(1.0, rate_hz / channel.rate_hz))
        inside &= (position >= reach) & (position <= _length(channel) - 1 - reach)
    if np.count_nonzero(inside) < 2 * len(channels):
        expected = "channels that were recorded at the same time"
        raise InputError(manifest.path, key, found="records that do not overlap", expected=expected)
    return _Grid(time_s[inside], rate_hz, slowest.entry.name)
