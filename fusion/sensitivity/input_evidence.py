"""Certificates and files behind the unknowns of a result, by which results share unknowns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.uncertainty import Influence
from fusion.recording.placement import chain_name
from fusion.recording.toml import UncertainInput, quote_key
from fusion.recording.values import is_number
from fusion.sensitivity.moving_body import moving_parts

if TYPE_CHECKING:
    from fusion.recording.load import Manifest


@dataclass(frozen=True)
class InputEvidence:
    """An unknown of the rig and its source: a certificate, a file, both or neither.

    `unknown`: its name. `of`: quantity, whatever its part or channel is called, such as `mass`. `value`: as stated, NaN
    without a single number; `u` in `unit`: its standard uncertainty. `certificate`, `laboratory`, `sha256`: empty where
    there is none. `input`: file and key.
    """

    unknown: str
    of: str
    value: float
    u: float
    unit: str
    certificate: str
    laboratory: str
    sha256: str
    input: str
    valid_until: str = ""

    @property
    def proven(self) -> bool:
        """Whether a certificate or a file identifies the input."""
        return bool(self.certificate or self.sha256)


def find_evidence(
    manifest: Manifest, influences: Iterable[Influence], hashes: Mapping[str, str]
) -> tuple[InputEvidence, ...]:
    """Return the sources of all inputs with the scope of the rig.

    `hashes`: of all input files. Unknowns of one mounting or recording belong to no other result, whatever their
    certificate. An input without a source has a row without certificate and hash.
    """
    unknowns = {influence.name: influence for influence in influences if influence.scope == "rig"}
    inputs = {item.key.removesuffix("_uncertainty"): item for item in manifest.inputs}
    found: dict[tuple[str, ...], InputEvidence] = {}
    for key, stem, what, path in _stems(manifest):
        item = inputs.get(key)
        if item is None and path is None:
            continue
        number, laboratory, valid = _source(item)
        digest = "" if path is None else _digest(manifest, path, hashes)
        value = item.value if item is not None and is_number(item.value) else np.nan
        file = path if item is None else item.file
        for name in (name for name in unknowns if name == stem or name.startswith(f"{stem} ")):
            unknown = unknowns[name]
            of, where = what + name[len(stem) :], f"{file.name if file else ''}: {key}"
            row = InputEvidence(
                name, of, float(value), unknown.u, unknown.unit, number, laboratory, digest, where, valid
            )
            found.setdefault((name, number, laboratory, digest), row)
    proven = {row.unknown for row in found.values() if row.proven}
    return tuple(row for row in found.values() if row.proven or row.unknown not in proven)


def _source(item: UncertainInput | None) -> tuple[str, str, str]:
    """Return number, laboratory and end of validity of an input's certificate."""
    stated = None if item is None else item.stated
    if stated is None:
        return "", "", ""
    valid = "" if stated.valid_until is None else stated.valid_until.isoformat()
    return " ".join(stated.certificate.split()), stated.laboratory, valid


def _digest(manifest: Manifest, path: Path, hashes: Mapping[str, str]) -> str:
    """Return the SHA-256 of an input file, or an empty text."""
    whole = path.resolve()
    inside = whole.relative_to(manifest.root) if whole.is_relative_to(manifest.root) else whole
    return hashes.get(inside.as_posix(), "")


def _stems(manifest: Manifest) -> Iterator[tuple[str, str, str, Path | None]]:
    """Yield key, begin of unknown names, quantity and stating file of each input."""
    rig, keys = manifest.rig, {"load": "load.", "internal mass": "sensor.internal_"}
    for part in moving_parts(rig, manifest.part):
        key = keys.get(part.name, f"part.{quote_key(part.name)}.")
        for what in ("mass", "inertia"):
            yield key + what, f"{part.name} {part.mass_kg:.9g} kg: {what}", what, None
    yield "environment.gravity", "gravity", "gravity", None
    yield "sensor.static_sensitivity", "static sensitivity", "static sensitivity", None
    for name, pair in rig.stereo.items():
        for what, file in (("scale", None), ("delay", None), ("calibration", pair.calibration), ("surface", None)):
            yield f"stereo.{quote_key(name)}.{what}", f"stereo {name}: {what}", f"{what} of cameras", file
    for prefix, block in manifest.set_ups:
        for daq in block.daq:
            for entry in daq.channel:
                key, chain = f"{prefix}daq.{quote_key(daq.name)}.channel.{quote_key(entry.name)}", chain_name(entry)
                for what, file in (("scale", None), ("delay", None), ("response", entry.response)):
                    yield f"{key}.{what}", f"{chain}: {what}", f"{what} of {entry.quantity}", file
