"""The recordings of a campaign sorted by what they say of the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fusion.errors import InputError
from fusion.manifest import Manifest, find_recordings, load_manifest
from fusion.notices import Notice
from fusion.provenance import RESULT_FILE, hash_files, read_provenance
from fusion.transfer.evaluate import KINDS

RESULTS = "results"


@dataclass(frozen=True)
class EvaluatedSines:
    """A recording of sines, and the folder with its results."""

    manifest: Manifest
    results: Path


@dataclass(frozen=True)
class Campaign:
    """What is there to be read: recordings with transfer functions, evaluated sines, and what is said of the others.

    `input_hashes`: SHA-256 of every file that is used, by its path seen from `folder`.
    """

    name: str
    folder: Path
    transfers: tuple[Manifest, ...]
    sines: tuple[EvaluatedSines, ...]
    input_hashes: dict[str, str]
    notices: tuple[Notice, ...]


def read_campaign(path: Path, *, allow_outside: bool = False) -> Campaign:
    """Read the manifests of a campaign folder, or of one recording, and check that they tell of one sensor.

    Raises `InputError` where no recording has transfer functions.
    """
    folder = (path.parent if path.is_file() else path).resolve()
    manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in find_recordings(path)]
    transfers = tuple(manifest for manifest in manifests if manifest.excitation.kind in KINDS)
    if not transfers:
        kinds = ", ".join(dict.fromkeys(manifest.excitation.kind for manifest in manifests))
        where = manifests[0].path if len(manifests) == 1 else path
        expected = f"a recording of the kind {', '.join(KINDS[:-1])} or {KINDS[-1]}, which shows a transfer function"
        raise InputError(where, "excitation.kind", found=f"only {kinds}", expected=expected)
    sines, notices = _sines([manifest for manifest in manifests if manifest.excitation.kind == "sine"])
    _check_one_sensor([*transfers, *(item.manifest for item in sines)])
    files = [file for manifest in (*transfers, *(item.manifest for item in sines)) for file in manifest.files]
    hashes = hash_files([*files, *(item.results / RESULT_FILE for item in sines)], folder)
    return Campaign(folder.name, folder, transfers, sines, hashes, notices)


def _sines(manifests: list[Manifest]) -> tuple[tuple[EvaluatedSines, ...], tuple[Notice, ...]]:
    """Return the recordings of sines with results of these very files, and a remark on those without."""
    found, missing = [], []
    for manifest in manifests:
        results = _results(manifest)
        if results is None:
            missing.append(manifest.name)
        else:
            found.append(EvaluatedSines(manifest, results))
    if not missing:
        return tuple(found), ()
    text = (
        f"{len(missing)} recordings of sines have no results of `shakercal run`, which would add their sensitivity"
        if len(missing) > 1
        else "this recording of sines has no results of `shakercal run`, which would add its sensitivity"
    )
    return tuple(found), (Notice("info", text, missing[0] if len(missing) == 1 else "campaign"),)


def _results(manifest: Manifest) -> Path | None:
    """Return the folder with results of a recording, its own or the campaign's; results of other files are refused."""
    places = (manifest.folder / RESULTS, manifest.folder.parent / RESULTS / manifest.folder.name)
    found = [(place, read_provenance(place)) for place in places]
    there = [(place, origin) for place, origin in found if origin is not None]
    if not there:
        return None
    hashes = hash_files(manifest.files, manifest.root)
    for place, origin in there:
        if origin.input_hashes == hashes:
            return place
    expected = "the results of these very input files; shakercal run evaluates the recording anew"
    raise InputError(there[0][0] / RESULT_FILE, "", found="results of other input files", expected=expected)


def _check_one_sensor(manifests: list[Manifest]) -> None:
    """Refuse rigs whose sensors have other names or serial numbers than the first one's."""
    named = [manifest for manifest in manifests if manifest.rig.sensor is not None]
    for manifest in named[1:]:
        first, own = named[0].rig.sensor, manifest.rig.sensor
        for key in ("name", "serial"):
            one, other = getattr(first, key), getattr(own, key)
            if one != other:
                expected = f'the sensor of {named[0].rig_path}, "{one}"'
                raise InputError(manifest.rig_path, f"sensor.{key}", found=f'"{other}"', expected=expected)
