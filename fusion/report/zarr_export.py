"""Export of results as a Zarr store, one group for each labelled array."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fusion.base import PROGRAM
from fusion.errors import OUTPUT_EXISTS, InputError
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.report.atomic_files import write_together
from fusion.report.folder import provenance_of
from fusion.report.h5 import open_results
from fusion.report.labelled_results import Results, read_results
from fusion.report.object_store import archive_packages

MARKER = ".zgroup"
FORMAT = 2
"""Version of Zarr: its version 3 does not specify texts yet."""


def export_zarr(path: Path, output: Path, *, force: bool = False) -> list[str]:
    """Write all labelled arrays of results, and return the names of their groups.

    xarray opens each group. Raises `InputError` for a path without results, or an existing folder unless it is a Zarr
    store and `force`.
    """
    with archive_packages():
        import zarr
    if output.exists() and not (force and (output / MARKER).is_file()):
        expected = "a new folder (--force replaces a Zarr store)"
        raise InputError(OUTPUT_EXISTS, output, found="a file or folder of this name", expected=expected)
    results = read_results(path)
    with open_results(results.path, "provenance") as file:
        program = provenance_of(file).versions.get(PROGRAM, "")
    parts = dict(_parts(results))

    def make(folder: Path) -> list[str]:
        top = zarr.open_group(folder, mode="w", zarr_format=FORMAT)
        top.attrs.update({"name": results.name, "program": f"{PROGRAM} {program}".strip()})
        for name, part in parts.items():
            labelled = part.to_xarray()
            labelled.to_zarr(folder, group=name, mode="a", zarr_format=FORMAT, consolidated=False)
        zarr.consolidate_metadata(folder, zarr_format=FORMAT)
        names = [file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()]
        return sorted(names, key=lambda name: (name == MARKER, name))

    earlier = [file.relative_to(output).as_posix() for file in output.rglob("*") if file.is_file()]
    write_together(output, make, lambda: earlier)
    return list(parts)


def _parts(results: Results) -> Iterator[tuple[str, LabelledPhasors]]:
    """Yield the arrays of results with the names of their groups."""
    for name in ("sensitivity", "element", "load"):
        part = getattr(results, name)
        if part is not None:
            yield name, part
    yield from ((f"acceleration/{name.replace('/', '_')}", part) for name, part in results.acceleration.items())
    for name, parts in (("curve", results.curve), ("matrix", results.matrix)):
        yield from ((f"{name}/{number}", part) for number, part in enumerate(parts))
