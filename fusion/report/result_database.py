"""Database of the sensitivities of an archive: one Parquet file, queried by SQL."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date as Date
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion.base import PROGRAM, ProgressCallback, is_address, no_progress
from fusion.errors import OUTPUT_EXISTS, OUTPUT_FOLDER_MISSING, InputError, as_input_error
from fusion.report.atomic_files import write_atomically
from fusion.report.folder import RESULT_FILE, SENSITIVITY_FILE, origin_key, provenance_of
from fusion.report.h5 import open_results
from fusion.report.object_store import STORE, TRANSFERS, ObjectStore, archive_packages
from fusion.report.report_notices import NO_RESULTS, WRONG_CONDITION
from fusion.report.table import read_rows

if TYPE_CHECKING:
    import pyarrow

TEXTS = ("path", "recording", "mounting", "rig", "sensor", "serial", "laboratory", "program", "input_hash", "result")
ELEMENT_TEXTS = ("channel", "component", "kind", "unit")
NUMBERS = ("frequency_hz", "magnitude", "u_magnitude", "k_magnitude", "phase_rad", "u_phase_rad", "k_phase")
ARCHIVE_KEY = b"shakercal.archive"
"""Key of the archive's address in the file."""
ORDER = ("serial", "channel", "component", "kind", "frequency_hz", "path")
"""Order of the rows: those of one curve are together, so that a query reads a small part of the file."""
ROWS_PER_GROUP = 50_000
COLLECT = "collect results"
# One result of each recording: that of the newest version.
QUERY = """select * exclude (tag) from read_parquet($1) where ({condition}) qualify dense_rank() over (partition by
input_hash order by [try_cast(part as int) for part in string_split(program, '.')] desc, result) = 1 order by date,
path, frequency_hz, channel, component, kind"""


@dataclass(frozen=True)
class Collected:
    """Numbers of result files: read now, unchanged, copies of others; and errors."""

    read: int
    unchanged: int
    copies: int
    errors: tuple[InputError, ...]
    rows: int


def collect_results(archive: str | Path, output: str | Path, progress: ProgressCallback = no_progress) -> Collected:
    """Write the sensitivities of all recordings of an archive into one Parquet file.

    Only result folders that are new or changed are read. Rows of folders that no longer exist are removed.

    Parameters
    ----------
    archive : str or Path
        Folder, or address of an object store, with result folders at any depth.
    output : str or Path
        Parquet file; an existing one of the same archive is renewed.
    progress : callable
        Called as (stage, done, total).

    Returns
    -------
    Collected
        Numbers of folders, and the errors of those that could not be read.

    Raises
    ------
    InputError
        The archive has no results, or the file is not a database of this archive.

    Examples
    --------
    >>> from fusion import collect_results, query_results
    >>> collect_results("archive", "results.parquet")  # doctest: +SKIP
    >>> query_results("results.parquet", "serial = '1234' and component = 'Fz'")  # doctest: +SKIP
    """
    with archive_packages():
        import pyarrow
        import pyarrow.compute
        import pyarrow.parquet
    output, stored = Path(output), is_address(str(archive))
    if not stored and not Path(archive).is_dir():
        raise InputError(OUTPUT_FOLDER_MISSING, archive, found="no such folder", expected="a folder with results")
    store = ObjectStore(str(archive if stored else Path(archive).resolve()))
    tags = {name: tag for name, tag in store.files().items() if name.rpartition("/")[2] == RESULT_FILE}
    if not tags:
        where = (STORE, store.address) if stored else (archive,)
        raise InputError(NO_RESULTS, *where, expected=RESULT_FILE)
    schema = _schema(store.address)
    before = _existing(output, schema)
    pairs = before.group_by(["path", "tag"]).aggregate([])
    known = dict(zip(pairs["path"].to_pylist(), pairs["tag"].to_pylist(), strict=True))
    unchanged = [path for path, tag in tags.items() if tag and known.get(path) == tag]
    rows = before.filter(pyarrow.compute.is_in(before["path"], pyarrow.array(unchanged, pyarrow.string())))
    results, new, errors, copies = set(rows["result"].unique().to_pylist()), list[dict[str, Any]](), [], 0
    todo = sorted(tags.keys() - unchanged)
    progress(COLLECT, 0, len(todo))
    for done, found in enumerate(_read(store, todo), 1):
        progress(COLLECT, done, len(todo))
        if isinstance(found, InputError):
            errors.append(found)
        elif found and found[0]["result"] in results:
            copies += 1
        elif found:
            results.add(found[0]["result"])
            new += [row | {"tag": tags[row["path"]]} for row in found]
    whole = pyarrow.concat_tables([rows, pyarrow.Table.from_pylist(new, schema)])
    if output.exists() and not new and whole.num_rows == before.num_rows:
        return Collected(0, len(unchanged), copies, tuple(errors), whole.num_rows)
    content = BytesIO()
    ordered = whole.sort_by([(name, "ascending") for name in ORDER])
    pyarrow.parquet.write_table(ordered, content, compression="zstd", row_group_size=ROWS_PER_GROUP)
    write_atomically(output, content.getvalue())
    return Collected(len(todo) - len(errors) - copies, len(unchanged), copies, tuple(errors), whole.num_rows)


def query_results(database: str | Path, condition: str = "true") -> list[dict[str, Any]]:
    """Return the rows of a database that a condition selects, in order of their dates.

    If a recording has several results, those of the newest program version are returned.

    Parameters
    ----------
    database : str or Path
        File of `collect_results`.
    condition : str
        Condition in the SQL of DuckDB on the columns, such as `serial = '1234' and date >= '2024-01-01'`.

    Returns
    -------
    list of dict
        Rows with the columns of the database. Magnitudes are in `unit`, phases in rad, frequencies in Hz.

    Raises
    ------
    InputError
        The file is missing, or the condition is wrong.

    Examples
    --------
    >>> from fusion import query_results
    >>> query_results("results.parquet", "component = 'Fz' and frequency_hz < 100")  # doctest: +SKIP
    """
    with archive_packages():
        import duckdb
    with as_input_error(Path(database)), Path(database).open("rb"):
        pass
    if not condition.strip():
        raise InputError(WRONG_CONDITION, database, reason="found no condition behind the question mark")
    query = QUERY.format(condition=condition)
    try:
        duckdb.extract_statements(f"select ({condition})")  # by itself, so that messages do not quote the query
        (_,) = duckdb.extract_statements(query)
        with duckdb.connect() as connection:
            answer = connection.execute(query, [str(database)])
            names = [column[0] for column in answer.description]
            return [dict(zip(names, row, strict=True)) for row in answer.fetchall()]
    except (duckdb.Error, ValueError) as error:
        message = re.split(r"LINE \d+:| at or near \"/\*", str(error))[0]
        reason = f"found {condition!r}: {' '.join(message.split())}"
        raise InputError(WRONG_CONDITION, database, reason=reason) from error


def _schema(address: str) -> pyarrow.Schema:
    """Return names and types of the columns."""
    import pyarrow

    fields = [(name, pyarrow.string()) for name in (*TEXTS, *ELEMENT_TEXTS, "tag")]
    fields += [("date", pyarrow.date32()), ("simulated", pyarrow.bool_())]
    fields += [(name, pyarrow.float64()) for name in NUMBERS]
    return pyarrow.schema(fields, metadata={ARCHIVE_KEY: address.encode()})


def _existing(file: Path, schema: pyarrow.Schema) -> pyarrow.Table:
    """Return an existing database, an empty one without a file; refuse other files."""
    import pyarrow.parquet

    if not file.exists():
        return schema.empty_table()
    try:
        table = pyarrow.parquet.read_table(file)
    except (OSError, ValueError) as error:
        raise InputError(OUTPUT_EXISTS, file, found="another file", expected="a database of results") from error
    if not table.schema.equals(schema, check_metadata=True):
        found = (table.schema.metadata or {}).get(ARCHIVE_KEY, b"another table").decode("utf-8", "replace")
        expected = f"a new file, or a database of {schema.metadata[ARCHIVE_KEY].decode()} made by this version"
        raise InputError(OUTPUT_EXISTS, file, found=found, expected=expected)
    return table


def _read(store: ObjectStore, names: Sequence[str]) -> Iterator[list[dict[str, Any]] | InputError]:
    """Yield the rows of each result file, or its error."""

    def fetched(folder: str, name: str) -> Path | InputError:
        try:
            if (local := store.local(name)) is not None:
                return local
            store.fetch([name, _table_of(name)], Path(folder))
        except InputError as error:
            return error
        return Path(folder, name)

    for start in range(0, len(names), TRANSFERS):
        some = names[start : start + TRANSFERS]
        with tempfile.TemporaryDirectory(prefix="shakercal-") as folder, ThreadPoolExecutor(TRANSFERS) as transfers:
            for name, file in zip(some, transfers.map(partial(fetched, folder), some), strict=True):
                try:
                    yield file if isinstance(file, InputError) else _rows(file, name)
                except InputError as error:
                    yield error.in_file(Path(name))


def _table_of(name: str) -> str:
    return f"{name.removesuffix(RESULT_FILE)}{SENSITIVITY_FILE}"


def _rows(file: Path, name: str) -> list[dict[str, Any]]:
    """Return one row for each frequency, output and component of a result.

    Facts are those of its HDF5 file, values those of its table. The covariances would cost eight times as much.
    """
    with open_results(file, "sensor", "provenance") as results:
        origin, attrs = provenance_of(results), results.attrs
        sensor = results["sensor"].attrs if "sensor" in results else {}
        digests = {str(number): digest for number, digest in enumerate(sorted(origin.input_hashes.values()))}
        day, program = attrs.get("date", ""), origin.versions.get(PROGRAM, "")
        facts = {
            "path": name,
            **{name: str(attrs.get(name, "")) for name in ("recording", "mounting", "rig", "laboratory")},
            "sensor": str(sensor.get("name", "")),
            "serial": str(sensor.get("serial", "")),
            "program": program,
            "input_hash": hashlib.sha256("".join(digests.values()).encode()).hexdigest()[:32],
            "result": origin_key(digests, origin.settings, {PROGRAM: program}),
            "date": Date.fromisoformat(day) if day else None,
            "simulated": bool(attrs.get("simulated", False)),
        }
    table = file.with_name(SENSITIVITY_FILE)
    with as_input_error(table):
        values = read_rows(table)
        if values and (missing := {*ELEMENT_TEXTS, *NUMBERS} - values[0].keys()):
            raise ValueError(f"expected the column {min(missing)}, found none")
        return [
            facts | {name: row[name] for name in ELEMENT_TEXTS} | {name: float(row[name]) for name in NUMBERS}
            for row in values
        ]
