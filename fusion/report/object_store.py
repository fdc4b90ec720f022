"""Files in object storage: listing with tags, transfer in both directions, by fsspec (`shakercal[archive]`)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fusion.base import is_address
from fusion.errors import InputError
from fusion.report.report_notices import ARCHIVE_PACKAGES_MISSING, STORE_REFUSED

TAGS = ("ETag", "etag", "md5Hash", "CRC", "mtime", "LastModified", "last_modified", "updated", "created")
"""Facts of a file that change with its content, by which stores of fsspec have them; the first one is used."""
WITH_FOLDERS = {"file", "local", "sftp", "ssh", "ftp", "smb", "hdfs", "webdav"}
"""Stores in which a folder has to exist before its files."""
PACKED = ("zip://", "tar://")
"""Beginnings of addresses in a file, which is named behind `::`."""
CREDENTIALS = re.compile(r"(?<=://)[^/@]+@")
PARENT = re.compile(r"(?<![/:])/[^/]*$|(?<=://)[^/]*$")
"""What the folder above does not have of an address."""
STORE = "object store"
TRANSFERS = 16
"""Files that are read at the same time, to wait less for the network."""


@contextmanager
def archive_packages() -> Iterator[None]:
    """Convert a missing package into an `InputError` that says what to install.

    fsspec raises the `ImportError` of a protocol from that of its package.
    """
    try:
        yield
    except ImportError as error:
        of_protocol = error.__cause__.name if isinstance(error.__cause__, ImportError) else None
        packages = of_protocol or '"shakercal[archive]"'
        raise InputError(ARCHIVE_PACKAGES_MISSING, STORE, packages=packages, reason=str(error)) from error


class ObjectStore:
    """Files below an address of fsspec, or below a folder of this machine.

    Every refusal of the store is an `InputError` with the address. `address` is without user name and password.
    """

    def __init__(self, address: str) -> None:
        self._whole = address.rstrip("/") if is_address(address) else address
        self.address = CREDENTIALS.sub("", self._whole)
        if self._whole.startswith(PACKED) and "::" not in self._whole:
            kind = self._whole.partition(":")[0]
            reason = f"expected {kind}::FILE.{kind} or {kind}://FOLDER::FILE.{kind}"
            raise InputError(STORE_REFUSED, STORE, self.address, reason=reason)
        with self._errors(), archive_packages():
            import fsspec

            self._fs, root = fsspec.core.url_to_fs(self._whole)
            self._root: str = root.rstrip("/")
            named = self._fs.protocol
            self._with_folders = bool(WITH_FOLDERS & ({named} if isinstance(named, str) else {*named}))

    def __reduce__(self) -> tuple[Any, ...]:
        return ObjectStore, (self._whole,)

    @property
    def name(self) -> str:
        """Last part of the address."""
        return self._root.rpartition("/")[2] or "archive"

    def below(self, name: str) -> ObjectStore:
        """Return the store of a folder, "" for this one, ".." for the one above."""
        if not name:
            return self
        first, chain, rest = self._whole.partition("::")
        if chain and "://" not in first:  # zip::FILE
            first += "://"
        first = PARENT.sub("", first) if name == ".." else f"{first}{'' if first.endswith('/') else '/'}{name}"
        return ObjectStore(first + chain + rest)

    def files(self) -> dict[str, str]:
        """Return the names of all files below the address with a tag each.

        A tag changes with the content of the file; it is empty if the store has none.
        """
        with self._errors():
            self._fs.invalidate_cache()
            # By default, folders that cannot be read are omitted.
            strict = {"on_error": "raise"} if self._with_folders else {}
            found: Mapping[str, Mapping[str, Any]] = self._fs.find(self._root, detail=True, **strict)
        named = {}
        for path, facts in found.items():
            name = path[len(self._root) :].strip("/")
            if ".." in name.split("/"):
                raise InputError(STORE_REFUSED, STORE, self.address, reason=f"a file has the name {name}")
            if name and not path.endswith("/"):  # some stores have empty objects for folders
                tag = next((facts[key] for key in TAGS if facts.get(key)), None)
                named[name] = "" if tag is None else f"{facts.get('size')} {tag}"
        return named

    def fetch(self, names: Iterable[str], folder: Path) -> None:
        """Copy files into a local folder under their names."""
        names = list(names)
        places = [folder / name for name in names]
        with self._errors():
            for place in {place.parent for place in places}:
                place.mkdir(parents=True, exist_ok=True)
            self._fs.get([self._path(name) for name in names], [str(place) for place in places])

    def local(self, name: str) -> Path | None:
        """Return the path of a file on this machine, None in other stores."""
        return Path(self._path(name)) if "file" in self._fs.protocol else None

    def read(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return the contents of small files, read at the same time."""
        with self._errors(), ThreadPoolExecutor(TRANSFERS) as transfers:
            return dict(zip(names, transfers.map(self._fs.cat_file, map(self._path, names)), strict=True))

    def write(self, contents: Mapping[str, bytes]) -> None:
        """Write files in order; each appears completely or not at all."""
        with self._errors():
            for name, content in contents.items():
                path = self._path(name)
                if self._with_folders:
                    self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)
                    self._fs.pipe_file(f"{path}.part", content)
                    self._fs.mv(f"{path}.part", path)
                else:  # an object appears when its transfer is complete
                    self._fs.pipe_file(path, content)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files."""
        with self._errors():
            for name in names:
                self._fs.rm_file(self._path(name))

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}" if self._root else name

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Convert what the store refuses, of whatever class, into an `InputError`."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(STORE_REFUSED, STORE, self.address, reason=CREDENTIALS.sub("", reason)) from error
