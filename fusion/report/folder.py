"""Folders of results: provenance of input files, pages, and the output of commands."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar
from urllib.parse import quote

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from fusion.base import PROGRAM, CommandEvaluation, FileIdentity, __version__, check_names, usable_cores
from fusion.errors import ComputeError, InputError
from fusion.report.atomic_files import file_lock, is_internal_name, write_files, write_together
from fusion.report.figure import Figure
from fusion.report.report_notices import (
    CHANGED_INPUT,
    HASHING_ENDED,
    NO_BOKEH,
    OTHER_CONTENT,
    OUTPUT_IS_FILE,
    OUTPUT_NOT_WRITABLE,
    UNREADABLE_INPUT,
)
from fusion.report.static_figure import static_svg
from fusion.report.summary_pdf import write_requested_pdf
from fusion.report.table import Headline, Table, code_html, csv_rows, notice_frame
from fusion.report.terminal import AS_JSON, log_notices, print_text, show_activity
from shakercal._common.digits import number_text
from shakercal._common.notices import Notice, warnings_first

if TYPE_CHECKING:
    import h5py

    from fusion.recording.load import Manifest
    from fusion.recording.rig import Rig
    from fusion.report.h5_tree import Group

# Provenance: hashes of the input files, versions, and whether results are current.


RESULT_FILE, RESULT_FORMAT = "result.h5", 2
SENSITIVITY_FILE, CURVE_FILE = "sensitivity.csv", "curve.csv"
TEMPLATES = Path(__file__).with_name("templates")
Setting = str | float | int


RECORDED_AT = ("recording_from_results", "recording_path")
"""Attributes of a result: path of recording.toml from the folder of the results, and its absolute path."""


class ResultOrigin(Protocol):
    """Provenance of a result."""

    @property
    def settings(self) -> dict[str, Setting]:
        """Settings of the user."""

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the program and its libraries."""

    @property
    def input_hashes(self) -> dict[str, str]:
        """Hashes of all input files."""


@dataclass(frozen=True)
class Provenance:
    """Provenance of a results folder: SHA-256 of inputs by path, settings, versions, written files."""

    input_hashes: dict[str, str]
    settings: dict[str, Setting]
    versions: dict[str, str]
    files: tuple[str, ...]


@dataclass(frozen=True)
class InputFiles:
    """SHA-256 of every input file by name, and its identity when it was hashed.

    `unsettled`: files that were changed shortly before; they are hashed again. A file without a hash must be identical.
    """

    hashes: dict[str, str] = field(default_factory=dict)
    identities: dict[Path, tuple[FileIdentity, str]] = field(default_factory=dict)
    unsettled: frozenset[Path] = frozenset()

    def check(self) -> None:
        """Raise `InputError` for a file that is missing or has changed since it was hashed."""
        for path, (before, digest) in self.identities.items():
            now = FileIdentity.of(path)
            if now is None or now[:2] != before[:2]:
                raise _changed(path, now)
            if (path in self.unsettled or now != before) and (not digest or sha256(path) != digest):
                raise _changed(path, now)

    @classmethod
    def without_hashes(cls, files: Iterable[Path]) -> InputFiles:
        """Return files without hashes, such as results that this program never changes."""
        return cls(identities={path: (now, "") for path in files if (now := FileIdentity.of(path)) is not None})


def _changed(path: Path, now: FileIdentity | None) -> InputError:
    return InputError(CHANGED_INPUT, path, change="disappeared" if now is None else "changed")


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(UNREADABLE_INPUT, path, reason=error.strerror or str(error)) from error


def hash_files(files: Iterable[Path], root: Path, read: Mapping[Path, FileIdentity] | None = None) -> InputFiles:
    """Return the SHA-256 of every file, sorted by its path relative to `root`.

    A file outside `root` has its absolute path. `read`: identities of files that were read before. A file that has
    changed since then, or while it is hashed, is refused.
    """
    started = hashing(files, root, read)
    try:
        return started.all()
    finally:
        started.end()


def hashing(files: Iterable[Path], root: Path, read: Mapping[Path, FileIdentity] | None = None) -> Hashing:
    """Start `hash_files` in a thread, so that files can be read at the same time.

    If a file was changed so recently that a further change may not show, all files are hashed before this returns.
    """
    files = set(files)
    check_names(files)
    earlier, before, base = read or {}, list[tuple[Path, Path, FileIdentity | None]](), root.resolve()
    for path in files:
        resolved = path.resolve()
        before.append((path, resolved, earlier.get(resolved) or FileIdentity.of(path)))
    ended = Event()

    def hashed(entry: tuple[Path, Path, FileIdentity | None]) -> tuple[str, FileIdentity | None]:
        path, _, first = entry
        if ended.is_set():
            raise ComputeError(HASHING_ENDED)
        if first is not None and not path.exists():
            raise _changed(path, None)
        return sha256(path), FileIdentity.of(path)

    def collected(threads: int) -> InputFiles:
        hashes, identities, unsettled = {}, {}, set()
        with ThreadPoolExecutor(threads) as readers:  # a hash is computed without Python's lock
            for (path, resolved, first), (digest, now) in zip(before, readers.map(hashed, before), strict=True):
                key = resolved.relative_to(base) if resolved.is_relative_to(base) else resolved
                if first is None or now is None or now[:2] != first[:2]:
                    raise _changed(path, now)
                hashes[key.as_posix()], identities[path] = digest, (now, digest)
                if now != first or not now.is_settled:
                    unsettled.add(path)
        return InputFiles(dict(sorted(hashes.items())), identities, frozenset(unsettled))

    pool = ThreadPoolExecutor(1)
    found = Hashing(pool.submit(collected, usable_cores()), ended)
    pool.shutdown(wait=False)
    if not all(first is not None and first.is_settled for _, _, first in before):
        found.all()
    return found


class Hashing(Mapping[str, str]):
    """SHA-256 of every file by name, computed by a thread.

    Each access waits for all of them.

    `all`: returns them with the identities of the files; `end`: stops before the next file.
    """

    def __init__(self, found: Future[InputFiles], ended: Event) -> None:
        self.all, self.end = found.result, ended.set

    def __getitem__(self, name: str) -> str:
        return self.all().hashes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.all().hashes)

    def __len__(self) -> int:
        return len(self.all().hashes)


def is_current(folder: Path, hashes: Mapping[str, str], settings: Mapping[str, Setting]) -> bool:
    """Return whether `folder` has complete results of these inputs, settings and program version."""
    found = read_provenance(folder)
    if found is None or not all((folder / name).is_file() for name in found.files):
        return False
    same_program = found.versions.get(PROGRAM) == __version__
    return same_program and found.settings == dict(settings) and found.input_hashes == dict(hashes)


def origin_key(hashes: Mapping[str, str], settings: Mapping[str, Setting], versions: Mapping[str, str]) -> str:
    """Return one hash of inputs, settings and versions of program and libraries."""
    whole = json.dumps([dict(hashes), dict(settings), dict(versions)], sort_keys=True)
    return hashlib.sha256(whole.encode()).hexdigest()[:32]


def check_folder(folder: Path, hashes: Mapping[str, str], *, force: bool, marker: str = RESULT_FILE) -> None:
    """Refuse a place for results that is not a folder or has other contents.

    Results of the same data are replaced, also with an edited manifest. `marker`: the file with the provenance.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(OUTPUT_IS_FILE, folder)
    above = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        what = "a folder without write permission" if above.is_dir() else "a file"
        raise InputError(OUTPUT_NOT_WRITABLE, folder, found=what, above=str(above))
    if force or not folder.exists() or all(is_internal_name(entry.name) for entry in folder.iterdir()):
        return
    found = read_provenance(folder, marker)
    if found is None or not _is_same_data(found.input_hashes, hashes):
        damaged = f"a damaged {marker}" if (folder / marker).is_file() else "other files"
        raise InputError(OTHER_CONTENT, folder, found=damaged if found is None else "results of other input files")


def _is_same_data(before: Mapping[str, str], now: Mapping[str, str]) -> bool:
    """Return whether results are of the same recordings, also if their manifests were edited since.

    Files that recordings share, such as certificates and tables of the rig, may differ. Files of a recording must be
    equal if both manifests name them.
    """
    from fusion.recording.load import RECORDING_NAME

    if before == now:
        return True
    then, named = ({Path(name) for name in names if Path(name).name == RECORDING_NAME} for names in (before, now))
    common = [name for name in before if name in now and Path(name).suffix != ".toml"]
    recorded = [name for name in common if not named or any(path.parent in Path(name).parents for path in named)]
    return then == named and bool(recorded) and all(before[name] == now[name] for name in recorded)


def read_provenance(folder: Path, marker: str = RESULT_FILE, *, provenance_only: bool = False) -> Provenance | None:
    """Return the provenance of the results in a folder, None if there are none.

    `provenance_only`: the other groups of the file are not checked.
    """
    import h5py  # pages alone do without

    from fusion.report.h5 import open_results

    path = folder / marker
    if not path.is_file() or not h5py.is_hdf5(path):
        return None
    only = ("provenance",) if provenance_only else ()
    with suppress(InputError), open_results(path, *only) as file:
        return provenance_of(file)
    return None


def provenance_of(file: h5py.File) -> Provenance:
    """Return the provenance of open results; raise `KeyError` if they have none."""
    group = file["provenance"]
    # Thousands of recordings have the same names, versions and files.
    names, digests, files = (
        map(sys.intern, group[name].asstr()[()]) for name in ("input_file", "input_sha256", "files")
    )
    settings, versions = (dict(group[name].attrs) for name in ("settings", "versions"))
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in settings.items()}
    versions = {sys.intern(name): sys.intern(str(version)) for name, version in versions.items()}
    return Provenance(dict(zip(names, digests, strict=True)), plain, versions, tuple(files))


def write_provenance(file: Group, origin: ResultOrigin, files: Sequence[str]) -> None:
    """Write the group `provenance` into an open result file.

    `files` are the names of all result files.
    """
    from fusion.report.h5_tree import TEXT

    group = file.create_group("provenance")
    hashes = origin.input_hashes
    for name, texts in (("input_file", list(hashes)), ("input_sha256", list(hashes.values())), ("files", files)):
        group[name] = np.array(texts, dtype=TEXT)
    group.create_group("settings").attrs.update(origin.settings)
    group.create_group("versions").attrs.update(origin.versions)


# Pages.


SECTION = re.compile(r'<section id="(.*?)" aria-label="(.*?)">')


def render_page(template: str, context: Mapping[str, Any]) -> str:
    """Return the HTML text of a template.

    Style and figures are included, no other file is loaded.
    """
    shown: list[Figure] = []

    def live(figure: Figure) -> str:
        """Register a figure that the browser draws, and return its name."""
        shown.append(figure)
        return figure.name

    def figures_data() -> Markup:
        """Return the data of all registered figures."""
        return compress_for_page(f"[{','.join(figure.json() for figure in shown)}]".encode())

    def figures_paper() -> Markup:
        """Return the images for paper of all figures whose image is not in the text."""
        images = {one.name: [static_svg(part) for part in one.sheets()] for one in shown if not one.main}
        return compress_for_page(json.dumps(images).encode())

    page = {"shown": shown, "live": live, "figures_data": figures_data, "figures_paper": figures_paper}
    return _environment().get_template(template, globals=page).render(context) + "\n"


@cache
def _environment() -> Environment:
    """Return what all pages share; templates are compiled once."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "data_uri": data_uri,
        "sections": sections,
        "static_svg": static_svg,
        "summary_svg": summary_svg,
        "code_html": code_html,
        "number": number_text,
    }
    environment.globals |= {
        "figures_library": bokeh_library,
        "figures_program": lambda: Markup((TEMPLATES / "figures.js").read_text(encoding="utf-8")),
    }
    return environment


def summary_svg(figure: Figure, width_in: float, most_in: float) -> str:
    """Return a figure for the summary, of a width and at most of a height."""
    return static_svg(replace(figure, width_in=width_in, height_in=min(figure.height_in, most_in)))


def compress_for_page(data: bytes, level: int = 1) -> Markup:
    """Return compressed data as text for a page; the default level is fast."""
    return Markup(base64.b64encode(gzip.compress(data, level, mtime=0)).decode("ascii"))


@cache
def bokeh_library() -> Markup:
    """Return BokehJS, compressed, from the files of the installed package, which is not imported."""
    spec = find_spec("bokeh")
    if spec is None or not spec.submodule_search_locations:
        raise ComputeError(NO_BOKEH)
    scripts = Path(spec.submodule_search_locations[0]) / "server/static/js"
    files = [scripts / name for name in ("bokeh.min.js", "bokeh-api.min.js")]
    return compress_for_page(b"\n".join(file.read_bytes() for file in files), 6)


def sections(page: str) -> list[tuple[Markup, Markup]]:
    """Return identifier and label of every section of a page in order."""
    return [(Markup(name), Markup(label)) for name, label in SECTION.findall(page)]


def subject_of(rig: Rig) -> list[tuple[str, str]]:
    """Return rig and sensor as every page names them."""
    sensor = [] if rig.sensor is None else [("Sensor", f"{rig.sensor.name} {rig.sensor.serial}".strip())]
    return [("Rig", rig.name), *sensor]


def origin_frame(origin: ResultOrigin, notices: Iterable[Notice]) -> dict[str, Any]:
    """Return the common context of all pages: notices, settings, versions, input files, program."""
    settings = tuple((name, str(value)) for name, value in origin.settings.items())
    inputs = tuple((name, Markup("<code>{}</code>").format(digest)) for name, digest in origin.input_hashes.items())
    return {
        **notice_frame(notices),
        "origin": [
            Table("Versions", ("program or library", "version"), "ll", tuple(origin.versions.items())),
            Table("Settings", ("name", "value"), "ll", settings),
        ],
        "inputs": Table("Input files", ("file", "SHA-256"), "ll", inputs),
        "program": f"{PROGRAM} {origin.versions.get(PROGRAM, '')}".strip(),
    }


def data_uri(svg: str) -> Markup:
    """Return SVG text as the source of an HTML image element.

    Percent encoding is shorter than base64 for text.
    """
    flat = re.sub(r"\s*\n\s*", " ", svg[svg.index("<svg") :]).replace('"', "'")
    return Markup("data:image/svg+xml,{}").format(Markup(quote(flat, safe=" ='/:;,.()+-_!*@?$[]{}|~")))


# Commands.


FORMAT = 1
"""Format number of the HDF5 files of commands."""
MOST_ROWS = 500
"""Largest table that is printed as JSON; longer ones are in their files only (chosen)."""
log = logging.getLogger("shakercal")


E = TypeVar("E", bound=CommandEvaluation)


def _no_headlines(_: object) -> Iterable[Headline]:
    return ()


def command_json(command: str, **parts: Any) -> str:
    """Return the results of a command as JSON, after program, version and command."""
    content = {"program": PROGRAM, "version": __version__, "command": command, **parts}
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)


@dataclass(frozen=True)
class CommandReport(Generic[E]):
    """Output of a command: a folder with files and a page, and terminal lines.

    `name`: of the command and of the folder. `stem`: page and HDF5 file are STEM.html and STEM.h5; the template of the
    page is NAME.html. `texts`: the other files by name, texts or images; `files`: all names that they may have. `fill`
    writes the evaluation into the HDF5 file. `context`: further context of the template. `lines`: those of the
    terminal. `headlines`: the main results, at the top of page and JSON.
    """

    name: str
    stem: str
    files: tuple[str, ...]
    texts: Callable[[E], Mapping[str, str | bytes]]
    fill: Callable[[Group, E], None]
    context: Callable[[E], Mapping[str, Any]]
    lines: Callable[[E], Iterable[str]]
    headlines: Callable[[E], Iterable[Headline]] = _no_headlines

    @property
    def h5_file(self) -> str:
        """Name of the HDF5 file, which is present only in a complete folder."""
        return f"{self.stem}.h5"

    @property
    def page_file(self) -> str:
        """Name of the page."""
        return f"{self.stem}.html"

    def run(self, inputs: InputFiles, folder: Path, evaluate: Callable[[dict[str, str]], E], *, force: bool) -> E:
        """Evaluate inputs, write results to `folder`, print results and notices, and return the evaluation.

        A place that cannot be used is refused before the evaluation. Inputs that change are refused before files are
        written.
        """
        check_folder(folder, inputs.hashes, force=force, marker=self.h5_file)
        with file_lock(folder), show_activity(self.name):
            evaluation = evaluate(inputs.hashes)
            files = self.write(evaluation, folder, inputs, force=force)
        if AS_JSON.get():
            print(self.json(evaluation, files))
        else:
            for line in (evaluation.name, *self.lines(evaluation)):
                print_text(line)
            print(f"report: {folder / self.page_file}")
            log_notices((notice, "") for notice in warnings_first(evaluation.notices))
        write_requested_pdf(folder / self.page_file)
        return evaluation

    def json(self, evaluation: E, files: Sequence[Path]) -> str:
        """Return the evaluation as JSON: headlines, short tables, notices and paths of files."""
        tables = {path.name: csv_rows(path.read_text(encoding="utf-8")) for path in files if path.suffix == ".csv"}
        return command_json(
            self.name,
            name=evaluation.name,
            headlines=[
                {"label": one.label, "value": Markup(one.value).striptags(), "remark": Markup(one.remark).striptags()}
                for one in self.headlines(evaluation)
            ],
            tables={name: rows for name, rows in tables.items() if len(rows) <= MOST_ROWS},
            notices=[notice.as_dict() for notice in warnings_first(evaluation.notices)],
            files=[str(path) for path in files],
        )

    def run_recordings(
        self,
        paths: Sequence[Path],
        manifests: Sequence[Manifest],
        output: Path | None,
        evaluate: Callable[[dict[str, str]], E],
        *,
        force: bool,
    ) -> E:
        """Evaluate the recordings at some paths together, as `run` does.

        Results are written to `output`. Its default is a folder named after the command, in the campaign or the only
        recording; for several paths it is next to the rig of the first recording.
        """
        first, acknowledged = manifests[0], [one for manifest in manifests for one in manifest.acknowledged]

        from fusion.recording.acknowledged import acknowledge

        def acknowledging(hashes: dict[str, str]) -> E:
            evaluation: Any = evaluate(hashes)
            notices, simulated = acknowledge(evaluation.notices, acknowledged), any(one.simulated for one in manifests)
            made: E = replace(evaluation, notices=notices, simulated=simulated)
            return made

        parent = first.root if len(paths) > 1 else first.folder if paths[0].is_file() else paths[0]
        read = {path: seen for manifest in manifests for path, seen in manifest.file_identities.items()}
        inputs = hash_files([file for manifest in manifests for file in manifest.files], first.root, read)
        return self.run(inputs, parent / self.name if output is None else output, acknowledging, force=force)

    def write(
        self, evaluation: E, folder: Path, inputs: InputFiles | None = None, *, force: bool = False
    ) -> list[Path]:
        """Write every file and return the paths.

        Folders with other contents are refused unless `force`; changed inputs are refused always.
        """
        from fusion.report.h5 import h5_content, write_value

        replaceable = re.compile("|".join(re.escape(name) for name in (*self.files, self.page_file, self.h5_file)))

        def make(temporary: Path) -> list[str]:
            texts = {**self.texts(evaluation), self.page_file: self.page(evaluation)}
            names = [*texts, self.h5_file]

            def fill(file: Group) -> None:
                write_provenance(file, evaluation, names)
                file.attrs["format"] = FORMAT
                self.fill(file, evaluation)
                if "notices" not in file:
                    write_value(file, "notices", evaluation.notices)

            return write_files(temporary, {**texts, self.h5_file: h5_content(fill)})

        inputs = InputFiles(evaluation.input_hashes) if inputs is None else inputs
        return write_folder(folder, inputs, make, force=force, marker=self.h5_file, replaceable=replaceable)

    def page(self, evaluation: E) -> str:
        """Return the HTML text of the page, including style and figures."""
        frame = {**origin_frame(evaluation, evaluation.notices), "duration_s": evaluation.duration_s}
        simulated, headlines = evaluation.simulated, list(self.headlines(evaluation))
        heading = {"name": evaluation.name, "simulated": simulated, "headlines": headlines}
        return render_page(f"{self.name}.html", {**heading, **self.context(evaluation), **frame})


# Folders.


def write_folder(
    folder: Path,
    inputs: InputFiles,
    fill: Callable[[Path], Sequence[str]],
    *,
    force: bool,
    marker: str,
    replaceable: re.Pattern[str],
) -> list[Path]:
    """Write a folder of results of some inputs and return the paths of its files.

    `fill` writes all files into a temporary folder and returns their names; then they are moved. A failure leaves
    `folder` unchanged; inputs that have changed since they were hashed are a failure. `marker`: the file with the
    provenance. A folder with other contents is refused unless `force`. Even then only files whose names match
    `replaceable` are replaced.
    """

    def make(temporary: Path) -> list[str]:
        return sorted(fill(temporary), key=lambda name: name == marker)

    def earlier() -> list[str]:
        before = read_provenance(folder, marker, provenance_only=True)
        named = before.files if before is not None else ()
        return [name for name in named if replaceable.fullmatch(name) and ".." not in Path(name).parts]

    check_folder(folder, inputs.hashes, force=force, marker=marker)
    return write_together(folder, make, earlier, inputs.check)
