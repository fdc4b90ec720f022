"""The code blocks of a page, run one after another in a folder, and their output compared with the page.

    python docs/walkthrough.py docs/tutorials/own-laboratory.md FOLDER

prints every command with its output as it is now. A block is run unless a comment above it states what it is:

| comment above the block | the block |
|---|---|
| none | commands after `$ ` with their output in a block `console`; a line per command without a language; Python |
| `<!-- not run: REASON -->` | is only read |
| `<!-- file: PATH -->` | is written to this file |
| `<!-- change: PATH -->` | has lines of a TOML file that replace those with the same key, which may be commented out |
| `<!-- part of: PATH -->` | has lines of this file |
| `<!-- output -->` | is the output of the Python block above |

Lines after `> ` are typed in reply to questions of `shakercal init`. A line `…` in an output leaves lines out.
"""

from __future__ import annotations

import argparse
import io
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

from fusion.cli import main

ROOT = Path(__file__).resolve().parent.parent
WIDTH = "110"  # characters of a line of the terminal
FENCE = re.compile(
    r"^(?:<!-- (?P<note>[^\n]*?) -->\n)?(?P<fence>```+)(?P<language>\S*).*?\n(?P<text>.*?)^(?P=fence)$", re.M | re.S
)
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]\d+)?")
MINUS_ZERO = re.compile(r"[-−](?=0(?:\.0*)?(?![\d.]))")
LEFT_OUT = "…"
LANGUAGES = ("", "console", "python")
"""Of blocks that are run."""


@dataclass(frozen=True)
class Block:
    """A block of code: its language, text, and the kind and argument of the comment above it."""

    language: str
    text: str
    kind: str
    argument: str


@dataclass
class Step:
    """A command of a page: the output that the page shows, the real one, the exit status, what is typed."""

    command: str
    shown: list[str] = field(default_factory=list)
    printed: str = ""
    status: int = 0
    complete: bool = False  # whether the page shows the whole output

    @property
    def typed(self) -> list[str]:
        """Replies to questions."""
        return [line[2:] for line in self.shown if line.startswith("> ")]

    @property
    def differences(self) -> list[str]:
        """Shown lines that the output does not have in this order."""
        printed = [line.rstrip() for line in self.printed.splitlines() if line.strip()]
        position, follows, missing = 0, True, []
        for line in self.shown:
            if not line.strip():
                continue
            if line.strip() == LEFT_OUT:
                follows = False
                continue
            places = [position] if follows else range(position, len(printed))
            found = next((i for i in places if i < len(printed) and same_line(line, printed[i])), None)
            if found is None:
                missing.append(line)
            else:
                position = found + 1
            follows = True
        if self.complete and follows and position < len(printed):
            missing += [f"not shown: {line}" for line in printed[position:]]
        return missing


def blocks(page: Path) -> list[Block]:
    """Return the blocks of code of a page; included files are left out."""
    found = []
    for match in FENCE.finditer(page.read_text(encoding="utf-8")):
        kind, _, argument = (match["note"] or "").partition(": ")
        if not match["language"].startswith("{"):
            found.append(Block(match["language"], match["text"], kind, argument.strip()))
    return found


def same_line(shown: str, printed: str) -> bool:
    """Compare lines whose numbers may differ by 5 % or two units of their last digit, and times at will."""
    one, other = (re.sub(r"[\s─━]+", " ", MINUS_ZERO.sub("", line)).strip() for line in (shown, printed))
    if NUMBER.sub("#", one) != NUMBER.sub("#", other):
        return False
    return all(_close(a, b) for a, b in zip(NUMBER.findall(one), NUMBER.findall(other), strict=True))


def _close(shown: str, printed: str) -> bool:
    places = len(shown.partition("e")[0].partition(".")[2])
    slack = 2.0 * 10.0**-places if places else 0.0
    return math.isclose(float(shown), float(printed), rel_tol=0.05 if places else 0.0, abs_tol=slack)


def follow(page: Path, folder: Path) -> Iterator[Step]:
    """Run the blocks of a page in a folder, and yield each command after it has run."""
    found = blocks(page)
    for block, following in zip(found, [*found[1:], None], strict=True):
        if block.kind == "file":
            (folder / block.argument).write_text(block.text, encoding="utf-8")
        elif block.kind == "change":
            _change(folder / block.argument, block.text)
        elif block.kind == "part of":
            content = (folder / block.argument).read_text(encoding="utf-8").splitlines()
            lines = block.text.splitlines()
            missing = [line for line in lines if not any(same_line(line, present) for present in content)]
            yield Step(f"part of {block.argument}", status=int(bool(missing)), printed="\n".join(missing))
        elif block.kind not in ("not run", "output"):
            for step in _steps(block):
                if following is not None and following.kind == "output":
                    step.shown, step.complete = following.text.splitlines(), True
                _run(step, folder, block.language)
                yield step


def _steps(block: Block) -> list[Step]:
    """Return the commands of a block that is run."""
    if block.language not in LANGUAGES:
        raise ValueError(f"expected a comment above a block of {block.language}: {block.text[:60]}")
    if block.language == "python":
        return [Step(block.text)]
    if block.language == "":
        lines = (line.partition(" #")[0].strip() for line in block.text.splitlines())
        return [Step(line) for line in lines if line and not line.startswith("#")]
    steps: list[Step] = []
    for line in block.text.splitlines():
        if line.startswith("$ "):
            steps.append(Step(line[2:], complete=True))
        else:
            steps[-1].shown.append(line)
    return steps


def _change(path: Path, text: str) -> None:
    """Replace lines of a TOML file by those with the same table and key."""
    lines, table, wanted = path.read_text(encoding="utf-8").splitlines(), "", ""
    for line in text.splitlines():
        if line.startswith("["):
            wanted = line
            continue
        key, table = line.partition(" = ")[0], ""
        for number, present in enumerate(lines):
            table = present.removeprefix("# ").partition("  #")[0] if re.match(r"(# )?\[", present) else table
            if table == wanted and re.match(rf"(# )?{re.escape(key)} = ", present):
                lines[number] = line
                break
        else:
            raise ValueError(f"{path}: expected the key {key} in {wanted}, found none")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


class _Terminal(io.StringIO):
    """A text stream that takes itself for a terminal."""

    def isatty(self) -> bool:
        return True


def _run(step: Step, folder: Path, language: str) -> None:
    """Run a command in a folder, with its replies where it asks."""
    words = [] if language == "python" else shlex.split(step.command)
    environment = {**os.environ, "COLUMNS": WIDTH, "PYTHONPATH": str(ROOT)}
    with mock.patch.dict(os.environ, environment), chdir(folder):
        if language == "python":
            step.status, step.printed = _subprocess([sys.executable, "-c", step.command])
        elif words[0] == "shakercal":
            step.status, step.printed = _shakercal(words[1:], step.typed)
        elif words[0] == "cp":
            for source in [path for word in words[2:-1] for path in sorted(Path().glob(word))]:
                shutil.copytree(source, Path(words[-1]) / source.name, dirs_exist_ok=True)
        elif words[0] == "mkdir":
            Path(words[1]).mkdir()
        else:
            step.status, step.printed = _subprocess([sys.executable if words[0] == "python" else words[0], *words[1:]])


def _subprocess(words: list[str]) -> tuple[int, str]:
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return done.returncode, done.stdout


def _shakercal(words: list[str], typed: list[str]) -> tuple[int, str]:
    """Return exit status and output of the command; with replies, as on a terminal."""
    screen = _Terminal() if typed else io.StringIO()
    replies = iter(typed)

    def reply(prompt: str) -> str:
        text = next(replies)
        screen.write(f"{prompt}{text}\n")
        return text

    keyboard = _Terminal() if typed else io.StringIO()
    with (
        redirect_stdout(screen),
        redirect_stderr(screen),
        mock.patch("builtins.input", reply),
        mock.patch("sys.stdin", keyboard),
    ):
        status = main(words)
    left = list(replies)
    return status, re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.getvalue()) + "".join(f"not asked: {x}\n" for x in left)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    if not given.page.is_file():
        parser.error(f"page: expected a file, found none: {given.page}")
    if not given.folder.is_dir():
        parser.error(f"folder: expected a folder, found none: {given.folder}")
    for done in follow(given.page.resolve(), given.folder):
        print(f"$ {done.command}\n{done.printed}", end="")
        if done.status or done.differences:
            print(f"[status {done.status}; not in the output: {done.differences}]")
