"""Campaigns in object storage: each recording is fetched, evaluated, removed; results are uploaded."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

from fusion.base import PROGRAM, Settings, __version__, cleanup_on_signal, is_address
from fusion.errors import InputError
from fusion.recording.load import RECORDING_NAME
from fusion.recording.recording_notices import NO_RECORDING
from fusion.report.atomic_files import write_atomically
from fusion.report.folder import RESULT_FILE, origin_key
from fusion.report.object_store import STORE, ObjectStore
from fusion.report.recording_report import MERGED_FILES, REPLACEABLE_FILES

SOURCE_FILE = "source.json"
"""File of a result that identifies the stored files of its recording; it is written last."""
PROBE = ".shakercal-probe"


@dataclass(frozen=True)
class StoredRecording:
    """A recording in an object store.

    Attributes
    ----------
    source, target : stores of the campaign, and of the results of the recording (None: they stay local).
    address : of its recording.toml.
    folder : where the campaign is fetched to.
    files : tags of the files of the recording and of shared files that manifests name, by name in the campaign.
    key : text that `SOURCE_FILE` of its results in the target has, empty without results.
    earlier : names of its result files in the target.
    """

    source: ObjectStore
    target: ObjectStore | None
    address: str
    folder: Path
    files: Mapping[str, str]
    key: str = ""
    earlier: tuple[str, ...] = ()

    def is_current(self, results: Path, settings: Settings) -> bool:
        """Return whether results of the same stored files, settings and version exist.

        If they are in the target, the files that a campaign reads are fetched.
        """
        key, found, names = self.key_of(settings), self.key, self.earlier
        if self.target is None and results.is_dir():
            source = results / SOURCE_FILE
            found = _key_in(source.read_bytes()) if source.is_file() else ""
            names = tuple(path.name for path in results.iterdir())
        if not key or found != key or RESULT_FILE not in names:
            return False
        if self.target is not None:
            self.target.fetch([name for name in (*MERGED_FILES, RESULT_FILE) if name in names], results)
        return True

    def key_of(self, settings: Settings) -> str:
        """Return a text that identifies files, settings and version, empty without tags."""
        return origin_key(self.files, settings.as_dict(), {PROGRAM: __version__}) if all(self.files.values()) else ""

    @contextmanager
    def fetched(self) -> Iterator[None]:
        """Fetch all files, and remove those of the recording at the end.

        An `InputError` of a local copy names the file in the store.
        """
        try:
            self.source.fetch(self.files, self.folder)
            yield
        except InputError as error:
            raise InputError.together(map(self._named_in_store, error.each)) from error
        finally:
            shutil.rmtree(self.folder / PurePosixPath(self.address).parent.name, ignore_errors=True)

    def _named_in_store(self, error: InputError) -> InputError:
        return error.in_file(error.file.relative_to(self.folder)) if error.file.is_relative_to(self.folder) else error

    def finish(self, results: Path, settings: Settings) -> None:
        """Write the source of results, and upload them; obsolete files of earlier results are removed."""
        write_atomically(results / SOURCE_FILE, json.dumps({"address": self.address, "key": self.key_of(settings)}))
        if self.target is not None:
            self.target.remove([SOURCE_FILE] if SOURCE_FILE in self.earlier else [])
            names = [path.relative_to(results).as_posix() for path in results.rglob("*") if path.is_file()]
            for name in sorted(names, key=lambda name: (name == SOURCE_FILE, name == RESULT_FILE)):
                self.target.write({name: (results / name).read_bytes()})
            obsolete = set(self.earlier) - {*names}
            self.target.remove(name for name in obsolete if re.fullmatch(REPLACEABLE_FILES, name))


@dataclass(frozen=True)
class StoredCampaign:
    """A campaign or recording in an object store, whose manifests are in `path`.

    `output`: local folder of the results. `target`: store to which they are uploaded, or None. `recordings`: by the
    paths of their manifests.
    """

    path: Path
    output: Path
    target: ObjectStore | None
    recordings: Mapping[Path, StoredRecording]

    def upload(self, files: Iterable[Path]) -> None:
        """Upload joint files."""
        if self.target is not None:
            self.target.write({path.name: path.read_bytes() for path in files})

    def address_of(self, results: Path) -> str:
        """Return the address of a folder of results, empty if they stay local."""
        if self.target is None:
            return ""
        return "/".join((self.target.address, *results.relative_to(self.output).parts))


@contextmanager
def fetched_campaign(address: str, output: str | Path | None = None) -> Iterator[StoredCampaign]:
    """Fetch the manifests of a campaign or recording in an object store, for `run_path`.

    Parameters
    ----------
    address : str
        Address of a campaign or of one recording for fsspec, such as `s3://bucket/campaign`.
    output : str, Path or None
        Local folder of the results, or an address to which they are uploaded; None: ADDRESS/results.

    Yields
    ------
    StoredCampaign
        Its local files are removed at the end, except results in a local folder.

    Raises
    ------
    InputError
        The store refuses, or has no recording at this address.

    Examples
    --------
    >>> from fusion import Settings, fetched_campaign, run_path
    >>> with fetched_campaign("s3://bucket/campaign", "results") as campaign:  # doctest: +SKIP
    ...     outcomes = run_path(campaign, None, Settings())
    """
    source, alone = ObjectStore(address), ""
    tags = source.files()
    if RECORDING_NAME in tags:  # its rig may be in the folder above
        source, alone = source.below(".."), source.name
        tags = source.files()
    target = _target(ObjectStore(address), output)
    if target is not None:
        results = f"{target.address.removeprefix(f'{source.address}/')}/"
        tags = {name: tag for name, tag in tags.items() if not name.startswith(results)}
    top = Path(tempfile.mkdtemp(prefix="shakercal-")).resolve()
    with cleanup_on_signal(partial(shutil.rmtree, top, ignore_errors=True)):
        recordings = _fetch_manifests(source, target, top / source.name, tags, alone)
        local = top / "results" if target is not None else Path(str(output))
        yield StoredCampaign(top / source.name / alone, local, target, recordings)


def _target(source: ObjectStore, output: str | Path | None) -> ObjectStore | None:
    """Return the store of the results, None for a local folder.

    A refusal comes before the evaluation.
    """
    if output is not None and not is_address(str(output)):
        return None
    target = source.below("results") if output is None else ObjectStore(str(output))
    try:
        target.write({PROBE: b""})
        target.remove([PROBE])
    except InputError as error:
        if output is not None:
            raise
        reason = f"{error.values['reason']}; state -o FOLDER for the results"
        raise InputError(error.declared, error.file, error.key, reason=reason) from error
    return target


def _fetch_manifests(
    source: ObjectStore, target: ObjectStore | None, folder: Path, tags: Mapping[str, str], alone: str
) -> dict[Path, StoredRecording]:
    """Fetch manifests into a folder and return the recordings by their paths.

    A file that recordings share belongs to those whose manifests, or any table of the rig, contain its name.
    """
    places = {name.removesuffix(f"/{RECORDING_NAME}") for name in tags if name.endswith(f"/{RECORDING_NAME}")}
    names = {place for place in places if "/" not in place and alone in ("", place)}
    if not names:
        expected = f"{RECORDING_NAME} at this address or directly below it"
        raise InputError(NO_RECORDING, STORE, source.address, found="none", expected=expected)
    files: dict[str, dict[str, str]] = {name: {} for name in ("", *names)}
    for name, tag in tags.items():
        first = name.partition("/")[0]
        if first in names or first not in places:
            files[first if first in names else ""][name] = tag
    shared, by_name = files.pop(""), defaultdict[str, list[str]](list)
    for name in shared:
        by_name[name.rpartition("/")[2]].append(name)
    tables = [name for name in shared if name.endswith(".toml")]
    source.fetch([*tables, *(f"{name}/{RECORDING_NAME}" for name in names)], folder)
    common = "".join((folder / name).read_text(encoding="utf-8", errors="replace") for name in tables)
    written: dict[str, list[str]] = {}
    for path in target.files() if target is not None else ():
        first, _, rest = path.partition("/")
        written.setdefault("" if alone else first, []).append(path if alone else rest)
    sources = [f"{name}/{SOURCE_FILE}".lstrip("/") for name, below in written.items() if SOURCE_FILE in below]
    keys = target.read(sources) if target is not None else {}
    found = {}
    for name, own in files.items():
        manifest, place = folder / name / RECORDING_NAME, "" if alone else name
        text = common + manifest.read_text(encoding="utf-8", errors="replace")
        used = [*tables, *(path for last, paths in by_name.items() if last in text for path in paths)]
        found[manifest] = StoredRecording(
            source,
            None if target is None else target.below(place),
            f"{source.address}/{name}/{RECORDING_NAME}",
            folder,
            {path: shared[path] for path in used} | own,
            _key_in(keys.get(f"{place}/{SOURCE_FILE}".lstrip("/"), b"")),
            tuple(written.get(place, ())),
        )
    return found


def _key_in(content: bytes) -> str:
    """Return the key in the content of `SOURCE_FILE`, empty if it is none."""
    try:
        return str(json.loads(content)["key"])
    except (ValueError, KeyError, TypeError):
        return ""
