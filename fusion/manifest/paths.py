"""Paths that stand in a manifest: resolved against its folder, kept inside the campaign, globs ordered naturally."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath, PureWindowsPath

MAGIC = re.compile(r"[*?\[]")


class PathError(ValueError):
    """A path that cannot be used; `expected` and `found` are phrases for the message."""

    def __init__(self, expected: str, found: str) -> None:
        super().__init__(expected, found)
        self.expected = expected
        self.found = found


def natural_key(name: str) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """Sort key that orders runs of digits by value: `a2` before `a10`; ties by the text itself."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts if part), name


@dataclass(frozen=True)
class PathScope:
    """Where the paths of one manifest start (`folder`) and which folder they may not leave (`root`, resolved)."""

    folder: Path
    root: Path
    allow_outside: bool = False

    def file(self, text: str) -> Path:
        """Resolve the path of one existing file."""
        path = self._inside(self._join(text), text)
        if not path.is_file():
            raise PathError("an existing file", f"a folder at {path}" if path.is_dir() else f"no file {path}")
        return path

    def files(self, text: str) -> tuple[Path, ...]:
        """Resolve one path or a glob (`*`, `?`, `[…]`) to its existing files in natural order."""
        plain = self._join(text)
        if plain.is_file():
            return (self._inside(plain, text),)
        if not MAGIC.search(text):
            return (self.file(text),)
        if "**" in text:
            raise PathError("a pattern that stays in one folder", f"'{text}' with '**'")
        matches = [path for path in self._expand(text) if path.is_file()]
        if not matches:
            raise PathError("at least one file", f"nothing that matches {plain}")
        return tuple(self._inside(path, text) for path in matches)

    def _join(self, text: str) -> Path:
        """Check the syntax of a path and put it behind the manifest's folder."""
        if not text.strip() or "\0" in text:
            raise PathError("a path", "an empty text" if not text.strip() else "a text with a NUL character")
        if "\\" in text:
            raise PathError("a path with '/' between its parts", f"'{text}'")
        absolute = PurePosixPath(text).is_absolute() or PureWindowsPath(text).drive != ""
        if absolute and not self.allow_outside:
            raise PathError("a path relative to this file", f"'{text}'")
        return self.folder / text

    def _inside(self, path: Path, text: str) -> Path:
        """Follow links and refuse what lies outside the campaign's folder."""
        resolved = path.resolve()
        if not self.allow_outside and not resolved.is_relative_to(self.root):
            raise PathError(
                f"a path inside the folder of rig.toml {self.root} (--allow-outside permits others)",
                f"'{text}', which leads to {resolved}",
            )
        return resolved

    def _expand(self, text: str) -> list[Path]:
        """Match a glob part by part, case-sensitively, each folder's entries in natural order."""
        found = [Path(PurePosixPath(text).anchor or self.folder)]
        for part in PurePosixPath(text).relative_to(PurePosixPath(text).anchor).parts:
            found = [match for folder in found for match in _matches(folder, part)]
        return found


def _matches(folder: Path, pattern: str) -> list[Path]:
    """Entries of `folder` that match one part of a glob; hidden ones only where the pattern names the dot."""
    if not MAGIC.search(pattern):
        return [folder / pattern] if (folder / pattern).exists() else []
    if not folder.is_dir():
        return []
    names = [entry.name for entry in folder.iterdir() if fnmatchcase(entry.name, pattern)]
    visible = [name for name in names if pattern.startswith(".") or not name.startswith(".")]
    return [folder / name for name in sorted(visible, key=natural_key)]
