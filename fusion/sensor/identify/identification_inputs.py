"""Inputs of an identification: transfer functions of several loads, and positions of transducers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from fusion.errors import InputError
from fusion.instruments.channel import geometry_errors
from fusion.phasors.timing import EdgeGrid
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.placement import LaserBeams, measuring_point, unit_direction
from fusion.recording.transducer import TRANSDUCERS
from fusion.report.folder import RESULT_FILE, InputFiles, hash_files, read_provenance
from fusion.sensitivity.elastic import InstrumentPosition, NaturalModes
from fusion.sensitivity.moving_body import JOINT, Body, inertia_errors, joint_unknown, load_body, rigid_load
from fusion.sensor import response_notices as declared
from fusion.sensor.transfer.transfer_evaluation import KINDS, evaluate_transfer
from fusion.sensor.transfer.transfer_records import REPEAT, FoundResonance, ReferenceResult, TransferSettings
from shaker.identification.measured_curves import (
    REFERENCE_INDEX,
    Bending,
    CurveError,
    MeasuredTransfer,
    Placement,
    PlacementError,
)
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, mechanical_units
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.digits import typeset
from shakercal._common.notices import Notice

# Choices of an identification.


ModelChoice = Literal["auto", "translation", "pitching", "adapter"]
DampingChoice = Literal["auto", "common", "each"]
MassChoice = Literal["auto", "free", "stated"]


@dataclass(frozen=True)
class IdentifySettings:
    """Choices that change results.

    `model`, `damping` (one damper for all recordings or one for each), `internal_mass` (fitted, or as in rig.toml);
    "auto" is decided from the recordings. `band_hz`: lines that are fitted, None for all. `load_masses_kg`: for which
    corrections and usable bands are given, none for those of the recordings. `permitted`: error of the magnitude up to
    which a band counts as usable.
    """

    model: ModelChoice = "auto"
    damping: DampingChoice = "auto"
    internal_mass: MassChoice = "auto"
    band_hz: tuple[float, float] | None = None
    load_masses_kg: tuple[float, ...] = ()
    permitted: float = 0.05

    def __post_init__(self) -> None:
        for name, choices in (("model", ModelChoice), ("damping", DampingChoice), ("internal_mass", MassChoice)):
            if getattr(self, name) not in get_args(choices):
                raise ValueError(f"{name}: expected {', '.join(get_args(choices))}, found {getattr(self, name)}")
        if self.band_hz is not None and not 0.0 <= self.band_hz[0] < self.band_hz[1]:
            raise ValueError(f"band_hz: expected the lower frequency first, found {self.band_hz}")
        if any(not mass > 0.0 for mass in self.load_masses_kg):
            raise ValueError(f"load_masses_kg: expected masses above 0, found {self.load_masses_kg}")
        if not 0.0 < self.permitted < 1.0:
            raise ValueError(f"permitted: expected a share between 0 and 1, found {self.permitted}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        masses = ", ".join(f"{mass:.12g}" for mass in self.load_masses_kg)
        band = "all lines" if self.band_hz is None else f"{self.band_hz[0]:.12g} to {self.band_hz[1]:.12g}"
        return {
            "model": self.model,
            "damping": self.damping,
            "internal_mass": self.internal_mass,
            "band_hz": band,
            "load_masses_kg": masses or "those of the recordings",
            "permitted": self.permitted,
        }


# Positions of the channels of a transfer recording and their errors, under names common to all commands.


def transducer_placement(entry: ChannelEntry) -> Placement:
    """Return position and direction of a channel, of an angular velocity its axis."""
    turning = TRANSDUCERS[entry.quantity].rotational
    return Placement(np.zeros(3) if turning else measuring_point(entry), unit_direction(entry), turning)


def placement_errors(base: ChannelEntry, tops: Sequence[ChannelEntry], mounting: str) -> tuple[PlacementError, ...]:
    """Return the errors of positions and directions of reference and responses.

    An unknown has the same value until the transducer is mounted again. It is one unknown in all recordings of a
    mounting, and has the same name in the results of sines.
    """
    beams = LaserBeams.of([base, *tops])
    placed = [(base, REFERENCE_INDEX), *((entry, index) for index, entry in enumerate(tops))]
    return tuple(
        PlacementError(f"{error.name} [{mounting}]", index, error.effect)
        for entry, index in placed
        for error in geometry_errors(TRANSDUCERS[entry.quantity], entry, beams)
    )


# The recordings of a campaign by kind.


RESULTS = "results"


@dataclass(frozen=True)
class EvaluatedSines:
    """A recording of sines, and the folder with its results."""

    manifest: Manifest
    results: Path


@dataclass(frozen=True)
class IdentificationInputs:
    """Recordings with transfer functions, evaluated sines, and notices of recordings that are not used.

    `inputs`: every input file by its path relative to `folder`.
    """

    name: str
    folder: Path
    transfers: tuple[Manifest, ...]
    sines: tuple[EvaluatedSines, ...]
    inputs: InputFiles
    notices: tuple[Notice, ...]


def read_campaign(path: Path, *, allow_outside: bool = False) -> IdentificationInputs:
    """Read the manifests of a campaign folder, or of one recording.

    All must be of one sensor. Sines are used if they have results of the same input files. Raises `InputError` without
    any transfer function.
    """
    folder = (path.parent if path.is_file() else path).resolve()
    manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in find_recordings(path)]
    transfers = tuple(manifest for manifest in manifests if manifest.excitation.kind in KINDS)
    if not transfers:
        kinds = ", ".join(dict.fromkeys(manifest.excitation.kind for manifest in manifests))
        where = manifests[0].path if len(manifests) == 1 else path
        expected = f"{', '.join(KINDS[:-1])} or {KINDS[-1]}"
        raise InputError(declared.NO_TRANSFER_RECORDING, where, "excitation.kind", found=kinds, expected=expected)
    results = [(manifest, _results(manifest)) for manifest in manifests if manifest.excitation.kind == "sine"]
    sines = tuple(EvaluatedSines(manifest, folder) for manifest, folder in results if folder is not None)
    missing = [manifest.name for manifest, folder in results if folder is None]
    notices = []
    if missing:
        name = missing[0] if len(missing) == 1 else "campaign"
        notices.append(Notice(declared.SINES_NOT_EVALUATED, name, count=len(missing)))
    used = [*transfers, *(item.manifest for item in sines)]
    check_sensor(used)
    files = [file for manifest in used for file in manifest.files]
    read = {path: seen for manifest in used for path, seen in manifest.file_identities.items()}
    inputs = hash_files([*files, *(item.results / RESULT_FILE for item in sines)], folder, read)
    return IdentificationInputs(folder.name, folder, transfers, sines, inputs, tuple(notices))


def check_sensor(manifests: Sequence[Manifest]) -> None:
    """Raise `InputError` where recordings are not all of one sensor."""
    named = [(manifest, manifest.rig.sensor) for manifest in manifests if manifest.rig.sensor is not None]
    for (manifest, sensor), key in product(named[1:], ("name", "serial")):
        first, one, other = named[0][0], getattr(named[0][1], key), getattr(sensor, key)
        if one != other:
            path, where, file = manifest.rig_path, f"sensor.{key}", str(first.rig_path)
            raise InputError(declared.DIFFERENT_SENSOR, path, where, expected=one, file=file, found=other)


def _results(manifest: Manifest) -> Path | None:
    """Return the folder with results of a recording, None without any; outdated results are refused."""
    folders = (manifest.folder / RESULTS, manifest.folder.parent / RESULTS / manifest.folder.name)
    found = [(folder, read_provenance(folder)) for folder in folders]
    available = [(folder, origin) for folder, origin in found if origin is not None]
    if not available:
        return None
    hashes = hash_files(manifest.files, manifest.root, manifest.file_identities).hashes
    for folder, origin in available:
        if origin.input_hashes == hashes:
            return folder
    raise InputError(declared.OUTDATED_SINE_RESULTS, available[0][0] / RESULT_FILE)


# From an evaluated transfer recording and its rig to the curve that a model of the sensor is fitted to.


SETTINGS = TransferSettings(quantity="acceleration")
"""Every motion as an acceleration, so that a ratio has no unit."""
CLOCK = "clock "
"""Prefix of the names of clock errors."""
_MIN_ALONG = 1e-3  # part of the drive that the reference must measure


@dataclass(frozen=True)
class PreparedTransfer:
    """A curve to be fitted, with its recording and the resonances of its single responses.

    `grids`: positions of trigger edges between the samples of every block, empty if no clocks were tied. `reference`:
    name of the channel of the base, empty for results of sines. `peak`: largest acceleration of the load, about that at
    the highest line, in m/s² or rad/s²; 0 if not known.
    """

    manifest: Manifest
    measured: MeasuredTransfer
    resonances: tuple[FoundResonance, ...] = ()
    grids: tuple[EdgeGrid, ...] = ()
    reference: str = ""
    peak: float = 0.0

    @property
    def amplitude_change(self) -> tuple[float, float]:
        """Largest relative changes of natural frequency and damping ratio with the amplitude."""
        found = [one.amplitude for one in self.resonances if one.amplitude is not None]
        changes = [(0.0, 0.0), *((one.frequency_change, one.damping_change) for one in found)]
        frequency, damping = (max(parts, key=abs) for parts in zip(*changes, strict=True))
        return frequency, damping

    @property
    def component(self) -> int:
        """Index of the component that is driven most."""
        return component_of(self.measured.drive)

    @property
    def load_kg(self) -> float:
        """Mass, or moment of inertia, on the sensor along the driven component."""
        return float(self.measured.mass_matrix[self.component, self.component])

    @property
    def amplitude(self) -> float:
        """Largest force, or moment, of the load in N or N·m; 0 if not known."""
        return self.load_kg * self.peak

    @property
    def u_load_kg(self) -> float:
        """Standard uncertainty of `load_kg`."""
        changes = [error.change[self.component, self.component] for error in self.measured.inertia_errors]
        return float(np.sqrt(np.sum(np.square(changes))))

    def peaks_hz(self, response: str) -> tuple[float, ...]:
        """Return the frequencies of the resonances of one response, ascending."""
        return tuple(sorted(found.fit.frequency_hz for found in self.resonances if found.response == response))


def prepare(
    manifest: Manifest, name: str, band_hz: tuple[float, float] | None
) -> tuple[PreparedTransfer, tuple[Notice, ...]]:
    """Evaluate a recording, and return its curves of load over base under a unique `name`.

    Of several references on the base the first is used. Responses that measure no translation of the load (or no
    rotation of a rotating rig) are left out. Notices of single oscillators are left to the readings. Raises
    `InputError`.
    """
    entries = {entry.name: entry for daq in manifest.daq for entry in daq.channel if entry.quantity != "trigger"}
    drive, body = drive_of(manifest), rigid_load(manifest)
    base = _base_entry(manifest, entries, drive)
    evaluation = evaluate_transfer(manifest, SETTINGS, {})
    result = next(result for result in evaluation.references if result.name == base.name)
    measured_by = [entries[channel] for channel in result.transfer.ratio.channels]
    tops = [entry for entry in measured_by if entry.body == "load" and _shows_motion(entry, drive)]
    if not tops:
        raise _missing_channel(manifest, "response", drive, "load", "none on the load")
    blocks = [daq for daq in manifest.daq if any(entry in daq.channel for entry in (base, *tops))]
    clock = blocks[0] if len(blocks) == 1 else manifest.daq[0]
    ratio, errors = _load_over_base(manifest, _linearised(result), [entry.name for entry in tops], name, band_hz)
    placed, bent = tuple(transducer_placement(entry) for entry in tops), FlexibleLoad.of(manifest, ratio.frequency_hz)
    measured = MeasuredTransfer(
        name=name,
        ratio=ratio,
        tops=placed,
        base=transducer_placement(base),
        drive=drive,
        mass_matrix=body.mass_matrix,
        errors=errors,
        inertia_errors=inertia_errors(manifest, body),
        line_correlation=result.transfer.line_correlation,
        added_decay_per_s=result.transfer.added_decay_per_s,
        clock=f"clock of {clock.name}",
        u_clock=clock.clock_uncertainty,
        placement_errors=placement_errors(base, tops, manifest.mounting),
        bending=None if bent is None else bent.bending(placed, manifest.mounting, _on_load(manifest, tops)),
    )
    found = tuple(item for item in result.resonances if item.response in ratio.channels)
    of_curves = {f"{channel}/{base.name}" for channel in result.transfer.ratio.channels}
    general = declared.CHANGES_WITH_AMPLITUDE.code
    taken = [one for one in evaluation.notices if one.where not in of_curves or one.code == general]
    notices = [notice.at(f"{name}: {notice.where}" if notice.where else name) for notice in taken]
    others = [reference for reference in manifest.excitation.reference if reference != base.name]
    if others:
        notices.append(Notice(declared.REFERENCES_NOT_USED, name, used=base.name, unused=", ".join(others)))
    if bent is not None:
        notices.append(Notice(declared.ELASTIC_LOAD, name, stated=bent.stated))
    grids = tuple(clock.grid for clock in evaluation.clocks if clock.grid is not None)
    complete = grids if len(grids) == len(evaluation.clocks) else ()
    peak = _peak_acceleration(result, tops)
    return PreparedTransfer(manifest, measured, found, complete, base.name, peak), tuple(notices)


def _linearised(result: ReferenceResult) -> ReferenceResult:
    """Return curves without the forces of cubic springs and dry friction: those of vanishing amplitude."""
    ratio = result.transfer.ratio
    value = ratio.value.copy()
    for one in result.resonances:
        if one.amplitude is not None:
            value[:, ratio.channels.index(one.response)] -= one.amplitude.contribution
    return replace(result, transfer=replace(result.transfer, ratio=replace(ratio, value=value)))


def _peak_acceleration(result: ReferenceResult, tops: Sequence[ChannelEntry]) -> float:
    """Return the largest reading of the responses as an acceleration.

    Displacements and velocities count at the frequency of the highest line.
    """
    ratio, readings = result.transfer.ratio, []
    for entry in tops:
        channel = ratio.channels.index(entry.name)
        highest_hz = float(ratio.frequency_hz[np.argmax(np.abs(ratio.value[:, channel]))])
        readings.append(result.peaks[channel] / (2.0 * np.pi * highest_hz) ** TRANSDUCERS[entry.quantity].order)
    return max(readings)


def add_clock_errors(item: PreparedTransfer, start: str) -> PreparedTransfer:
    """Return a curve whose clock errors are common to all recordings of one `start` (`fusion.campaign.drive`)."""
    suffix, measured = f" [{item.measured.name}]", item.measured
    errors = tuple(
        replace(error, name=f"{error.name.removesuffix(suffix)} [{start}]") if error.name.startswith(CLOCK) else error
        for error in measured.errors
    )
    return replace(item, measured=replace(measured, errors=errors))


def _on_load(manifest: Manifest, tops: Sequence[ChannelEntry]) -> list[InstrumentPosition]:
    """Return the positions of channels on an elastic load; empty for a rigid one."""
    if manifest.rig.load is None or not manifest.rig.load.elastic:
        return []
    for entry in tops:
        if entry.point is None:
            expected = f"the position of {entry.name} on the load, which is elastic (load.elastic of rig.toml)"
            raise InputError(
                declared.MISSING_IDENTIFICATION_ENTRY, manifest.path, "daq.channel.point", expected=expected
            )
    return [InstrumentPosition(entry.name, measuring_point(entry)) for entry in tops]


@dataclass(frozen=True)
class FlexibleLoad:
    """Elastic, jointed or cabled load and parts of a recording at K lines.

    Without the internal mass of the sensor. `inertia` (K, 6, 6): wrench per acceleration of the foot of the elastic
    part, above the joint. `follow` (K, 6): motion above the joint over that below.
    """

    body: Body
    frequency_hz: FloatArray
    inertia: ComplexArray
    follow: ComplexArray

    @classmethod
    def of(cls, manifest: Manifest, frequency_hz: FloatArray) -> FlexibleLoad | None:
        """Return None if modes, joint, first natural frequency and cables are not stated."""
        body = load_body(manifest.rig.model_copy(update={"sensor": None}), manifest.part)
        if body is None:
            return None
        follow = np.ones((len(frequency_hz), 6), np.complex128)
        if body.joint is not None:
            follow = body.joint.follow(frequency_hz)
        bent = cls(body.weightless, frequency_hz, body.weightless.load_matrix(frequency_hz), follow)
        return bent if bent.stated else None

    @property
    def stated(self) -> str:
        """Names of the stated properties."""
        body = self.body
        cables = np.any(body.cable_npm) or np.any(body.u_cable_npm)
        first = body.first_frequency_hz is not None
        properties = {"modes": body.elastic, "joint": body.joint, "first natural frequency": first, "cables": cables}
        return ", ".join(word for word, is_stated in properties.items() if is_stated)

    def bending(
        self, tops: Sequence[Placement], mounting: str, positions: Sequence[InstrumentPosition] = ()
    ) -> Bending:
        """Return the readings of responses and the wrench per motion below the joint.

        `positions`: positions of the responses on the elastic part, empty if they measure the motion of its foot.
        """
        body, frequency, rows = self.body, self.frequency_hz, np.stack([top.row for top in tops])
        zero = np.zeros((len(frequency), *rows.shape), np.complex128)

        def stretched(modes: NaturalModes) -> ComplexArray:
            readings = [row @ modes.stretch(frequency, at) for row, at in zip(rows, positions, strict=False)]
            return np.stack(readings, axis=1) if readings else zero

        seen = rows + sum((part.act(stretched) for part in body.elastic), zero)
        over = 1.0 / self.follow[:, None]
        terms = {"": (self.inertia * over - body.mass_matrix, seen * over - rows)}
        reads = {change.name: change.effect for part in body.elastic for change in part.changes(stretched)}
        rigid = {change.name for change in Body(body.parts).matrix_changes(np.ones(1))}
        for change in body.matrix_changes(frequency):
            if change.name not in rigid and change.label != JOINT:
                name = change.name if change.scope == "rig" else f"{change.name} [{mounting}]"
                # The sign is that of the results of sines: of a number stated too high.
                terms[name] = -change.effect * over, -reads.get(change.name, zero) * over
        if body.joint is not None:
            parts = tuple(part for part in body.parts if not part.below_joint)
            above = replace(body, parts=parts).load_matrix(frequency)
            later = body.joint.change(frequency)[:, None] * over**2
            for axis, natural, one in zip(MOTION_COMPONENTS, body.joint.frequency_hz, np.eye(6), strict=True):
                terms[f"{joint_unknown(natural, axis)} [{mounting}]"] = above * later * one, seen * later * one
        pulls, stretches = zip(*terms.values(), strict=True)
        return Bending(tuple(terms)[1:], np.stack(pulls), np.stack(stretches))


def drive_of(manifest: Manifest) -> FloatArray:
    """Return the direction (6,) in which the base is driven."""
    direction = manifest.excitation.direction or ()
    return np.asarray([*direction, *[0.0] * (6 - len(direction))], dtype=np.float64)


def component_of(drive: FloatArray) -> int:
    """Return which of the six components is driven most."""
    return int(np.argmax(np.abs(drive)))


def load_along(manifest: Manifest, component: int) -> float:
    """Return the mass, or moment of inertia, on the sensor along a component."""
    return float(rigid_load(manifest).mass_matrix[component, component])


def mass_unit(component: int) -> str:
    """Return the printed unit of the mass, or moment of inertia, of a component."""
    return typeset(mechanical_units(LOAD_COMPONENTS[component]).inertia)


def _base_entry(manifest: Manifest, entries: dict[str, ChannelEntry], drive: FloatArray) -> ChannelEntry:
    """Return the first reference that measures the base; raise `InputError` without one."""
    named = [entries[name] for name in manifest.excitation.reference if name in entries]
    for entry in named:
        if entry.body == "base" and _shows_motion(entry, drive):
            if abs(float(transducer_placement(entry).row @ drive)) < _MIN_ALONG * float(np.linalg.norm(drive)):
                raise InputError(
                    declared.REFERENCE_ACROSS_DRIVE, manifest.path, "excitation.reference", found=entry.name
                )
            return entry
    channels = ", ".join(f'"{entry.name}" ({entry.quantity} of {entry.body or "no body"})' for entry in named)
    raise _missing_channel(manifest, "reference", drive, "base", channels or "none")


def _shows_motion(entry: ChannelEntry, drive: FloatArray) -> bool:
    """Return whether a channel measures a translation, or the rotation of a rotating rig."""
    seen = TRANSDUCERS.get(entry.quantity)
    return seen is not None and (not seen.rotational or bool(np.any(drive[3:] != 0.0)))


def _missing_channel(manifest: Manifest, key: str, drive: FloatArray, body: str, found: str) -> InputError:
    """Return the refusal of a recording without a channel that measures the motion along `drive`."""
    shown = [t.quantity.replace("_", " ") for t in TRANSDUCERS.values() if not t.rotational or np.any(drive[3:] != 0.0)]
    expected, key = f"{', '.join(shown[:-1])} or {shown[-1]}", f"excitation.{key}"
    return InputError(declared.MISSING_MOTION_CHANNEL, manifest.path, key, expected=expected, body=body, found=found)


def _load_over_base(
    manifest: Manifest,
    result: ReferenceResult,
    channels: Sequence[str],
    recording: str,
    band_hz: tuple[float, float] | None,
) -> tuple[Phasors, tuple[CurveError, ...]]:
    """Return ratios of some responses in the band, and their common errors.

    The covariance of the ratios is that of their noise. A delay has the same sign as in a run: positive for a signal
    later than stated. Clock errors are those of the recording (`add_clock_errors`).
    """
    ratio = replace(result.transfer.ratio, covariance=result.random_covariance).select(channels)
    frequency, chosen = ratio.frequency_hz, np.ones(len(ratio.frequency_hz), dtype=np.bool_)
    if band_hz is not None:
        chosen = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
        if not np.any(chosen):
            raise InputError(
                declared.BAND_WITHOUT_LINES,
                manifest.path,
                "excitation.band",
                first_hz=float(frequency[0]),
                last_hz=float(frequency[-1]),
                low_hz=band_hz[0],
                high_hz=band_hz[1],
            )
    columns = [result.transfer.ratio.channels.index(channel) for channel in channels]
    errors = []
    for error in result.errors:
        relative = error.relative[:, columns] * (-1.0 if error.name.endswith(": delay") else 1.0)
        name = f"{error.name} [{recording}]" if error.name.startswith((CLOCK, REPEAT)) else error.name
        if np.any(relative != 0.0):
            errors.append(CurveError(name, relative[chosen]))
    return ratio.at_lines(chosen), tuple(errors)
