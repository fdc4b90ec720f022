"""Wrong manifests and options through the command line: does each end with one sentence, and does `check` agree.

Usage: python benchmarks/fuzz_manifests.py [--examples 300] [--only KIND …]

Valid inputs of every kind are simulated. Of each, one or two keys are changed: to a value that a user could mean
(another unit, another sign, a neighbour's value, keys of the model that the file lacks) or to one that nobody means
(1e300, NaN, a path out of the folder, control characters, deep nesting). Every one is given to the command that
evaluates it, in this process, without its page. A run may end with 0, with 2 and one sentence, or with 1 and a sentence
that is no internal error, within 10 s of processor time (options that ask for work: 60 s), and leaves nothing
temporary and no results where it failed.
Printed: a row for each kind with the exits, what broke these rules, and the share of the inputs that `run` refuses and
`check` does too. Exit status 1 where a rule was broken.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import date, time
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin
from unittest.mock import patch

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from fusion.cameras.align_manifest import AlignmentFile
from fusion.cli import main as shakercal
from fusion.recording.manifest import RecordingFile
from fusion.recording.response import MeasuringChainFile
from fusion.recording.rig import Rig
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES
from fusion.sensor.elastomer.element_definition import ElementFile
from fusion.simulate import simulate

SECONDS = 10.0  # of the processor
SECONDS_OF_OPTIONS = {"elastomer": 60.0, "decouple": 60.0}  # valid ones ask for work: 12 s of a slow processor
PAGES = (
    "fusion.report.recording_report.render_report",
    "fusion.campaign.joint_report.render_campaign",
    "fusion.report.folder.CommandReport.page",
)
STRANGE: tuple[Any, ...] = (
    True, "", " ", "\0", "a\0b", "\x1b[31mred", "=1+1", "CON", "a:b", "a/b", "/", ".", "..", "uncertainty",
    "x" * 100_000, "\N{SNOWMAN}", float("nan"),
    float("inf"), 1e300, -1e300, 1e-300, 5e-324, 10**9, 10**18, 10**400, -1, 0, [], {}, [[]], [[], [1.0]], [{}],
    date(1, 1, 1), date(9999, 12, 31), time(1), [1e300] * 3, [0.0] * 3, [1.0] * 100_000,
)  # fmt: skip
PATHS = (".", "..", "../rig.toml", "/etc/passwd", "loop", "fifo", "empty", "none/none", "*", "**", "[", "C:/x", "a\\b",
         "~", "outside", "recording.toml", "x" * 5000, "x/" * 1000)  # fmt: skip
CHANGES = ("scaled",) * 5 + ("typed",) * 3 + ("strange", "other", "left out", "twice", "added")
FACTORS = (-1.0, 0.0, 1e-3, 1e-2, 1e2, 1e3, 1e6, 0.0174532925, 57.29577951, 9.81, 2.0)


# A document and what may be changed in it.


def toml(value: Any) -> str:
    """Write a value as TOML, tables inline."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(str(key))} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    return value.isoformat() if isinstance(value, date | time) else repr(value)


def difference(old: Any, new: Any, here: str = "") -> Iterator[str]:
    """Yield what of a document is otherwise, key by key."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            yield from difference(old.get(key), new.get(key), f"{here}.{key}")
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for number, (one, other) in enumerate(zip(old, new, strict=True), 1):
            yield from difference(one, other, f"{here}[{number}]")
    elif type(old) is not type(new) or repr(old) != repr(new):
        yield f"{here[:80]}: {repr(old)[:60]} -> {repr(new)[:160]}"


def document(content: dict[str, Any], suffix: str) -> str:
    """Write a document, its top level as lines."""
    if suffix == ".json":
        return json.dumps(content, default=str)
    return "".join(f"{toml(str(key))} = {toml(item)}\n" for key, item in content.items())


def places(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the way to every value below a value."""
    steps = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, child in steps for place in ((*here, key), *places(child, (*here, key)))]


def at(value: Any, way: Sequence[Any]) -> Any:
    """Return what stands at the end of a way."""
    for step in way:
        value = value[step]
    return value


def models_of(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that an annotation names."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from models_of(argument)


def model_at(model: type[BaseModel] | None, way: Sequence[Any]) -> type[BaseModel] | None:
    """Return the model of the table at the end of a way, None where there is none."""
    for step in way:
        if model is not None and isinstance(step, str) and step in model.model_fields:
            model = next(models_of(model.model_fields[step].annotation), None)
    return model


def valued(annotation: Any) -> st.SearchStrategy[Any]:  # noqa: PLR0911
    """Values of the type that a key of a model has, of any size."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return valued(arguments[0])
    if origin in (Union, UnionType):
        return st.one_of([valued(item) for item in arguments if item is not type(None)])
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return st.lists(valued(arguments[0]), max_size=3)
    if origin is tuple:
        return st.tuples(*map(valued, arguments)).map(list)
    if origin is dict:
        return st.dictionaries(st.sampled_from(["top", "base", "Fz", "x"]), valued(arguments[1]), max_size=2)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        fields = annotation.model_fields
        needed = {key: valued(item.annotation) for key, item in fields.items() if item.is_required()}
        return st.fixed_dictionaries(
            needed, optional={k: valued(f.annotation) for k, f in fields.items() if k not in needed}
        )
    simple: dict[Any, st.SearchStrategy[Any]] = {
        bool: st.booleans(),
        int: st.sampled_from([0, 1, 2, 3, 8, 100, 10**6]),
        float: st.sampled_from([0.0, 1e-9, 1e-4, 1e-3, 0.05, 0.5, 1.0, 3.0, 50.0, 1e3, 1e6]),
        str: st.sampled_from(["a", "Fz", "top", "Fx", "auto", "a/b", ".", "value"]) | st.text(max_size=8),
        date: st.dates(),
        Path: st.sampled_from(PATHS),
    }
    return simple.get(annotation, st.sampled_from(STRANGE))


@st.composite
def changed(draw: st.DrawFn, base: dict[str, Any], model: type[BaseModel] | None) -> dict[str, Any]:
    """Draw a document with one or two of its keys changed."""
    content = copy.deepcopy(base)
    for _ in range(draw(st.sampled_from((1, 1, 2)))):
        ways = places(content)
        if not ways:
            break
        *way, last = draw(st.sampled_from(ways))
        table, value = at(content, way), at(content, [*way, last])
        tables = [place for place in [(), *ways] if isinstance(at(content, place), dict)]
        change = draw(st.sampled_from(CHANGES))
        if change == "scaled" and type(value) in (int, float) and abs(value) < 1e300:
            table[last] = value * draw(st.sampled_from(FACTORS))
        elif change == "scaled" and isinstance(value, list) and value:
            table[last] = draw(st.permutations(value)) if draw(st.booleans()) else value[:-1]
        elif change == "scaled" and isinstance(value, str):
            table[last] = draw(st.sampled_from([*PATHS, value.upper(), value + " ", value[:-1]]))
        elif change == "other":
            table[last] = copy.deepcopy(at(content, draw(st.sampled_from(ways))))
        elif change == "left out":
            del table[last]
        elif change == "twice" and isinstance(table, list):
            table.insert(last, copy.deepcopy(value))
        elif change in ("added", "typed") and model is not None:
            place = draw(st.sampled_from(tables)) if change == "added" else way
            own, into = model_at(model, place), at(content, place)
            if own is not None and isinstance(into, dict):
                keys = [key for key in own.model_fields if change == "added" or key == last]
                for key in draw(st.lists(st.sampled_from(keys), max_size=1)) if keys else ():
                    into[key] = draw(valued(own.model_fields[key].annotation))
        else:
            table[last] = draw(st.sampled_from(STRANGE))
    return content


# What is fuzzed, and the rules.


@dataclass(frozen=True)
class Kind:
    """A kind of input: the folder of a valid one, the file that is changed, its model, and the command's arguments."""

    name: str
    preset: str
    file: str
    model: type[BaseModel] | None
    arguments: tuple[str, ...]
    check: str = ""


RELEASE = "Fx-fishing-line-1"
KINDS = (
    Kind("recording", "matrix", "1-z/recording.toml", RecordingFile, ("run", "1-z"), "1-z"),
    Kind("rig", "matrix", "rig-z.toml", Rig, ("run", "1-z"), "1-z"),
    Kind("lines", "matrix", "1-z/recording.toml", RecordingFile, ("lines", "1-z")),
    Kind("chirp", "chirp", "chirp/recording.toml", RecordingFile, ("transfer", "chirp"), "chirp"),
    Kind("chain", "chirp", "chirp/amplifier.toml", MeasuringChainFile, ("transfer", "chirp"), "chirp"),
    Kind("rotation", "rotation", "with-load/recording.toml", RecordingFile, ("rotate", "."), "with-load"),
    Kind("rotation rig", "rotation", "rig.toml", Rig, ("rotate", "."), "with-load"),
    Kind("orientations", "orientations", "with-load/recording.toml", RecordingFile, ("rotate", "."), "with-load"),
    Kind("step", "steps", f"{RELEASE}/recording.toml", RecordingFile, ("step", RELEASE), RELEASE),
    Kind("step rig", "steps", "rig.toml", Rig, ("step", RELEASE), RELEASE),
    Kind("loads", "loads", "step-048g/recording.toml", RecordingFile, ("load", "."), "."),
    Kind("loads rig", "loads", "rig-048g.toml", Rig, ("load", "."), "."),
    Kind("identify", "masses", "chirp-4kg/recording.toml", RecordingFile, ("identify", "."), "."),
    Kind("element", "elastomer", "elastomer.toml", ElementFile, ("elastomer", ".")),
    Kind("measured", "elastomer", "models.json", None, ("elastomer", ".")),
    Kind("models", "elastomer", "models.json", None, ("compensate", "models.json", "--frequency", "900")),
    Kind("alignment", "alignment", "alignment.toml", AlignmentFile, ("align", "alignment.toml")),
    Kind("calibration", "alignment", "pair.json", None, ("align", "alignment.toml")),
)
KEPT = {"matrix": "1-z", "masses": "chirp-"}
"""Recordings that are kept of a campaign, where not all are."""
OPTIONS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "plan": ("", ("--frequencies", "106.25", "--frames", "211", "--max-rate", "80", "--rate-step", "0.1"), (
        "--frequencies", "--frames", "--max-rate", "--rate", "--min-rate", "--rate-step", "--exposure", "--harmonics",
        "--together", "--corner", "--tolerance", "--noise", "--amplitude", "--acceleration", "--settle", "--csv")),
    "run": ("matrix", ("1-z",), ("--subset-radius", "--monte-carlo", "--seed", "--workers", "-o")),
    "transfer": ("chirp", ("chirp",), ("--estimator", "--resolution", "--quantity", "-o")),
    "lines": ("chirp", ("chirp/accelerometers.h5",), ("--channel", "--sample-rate", "--band", "--csv")),
    "step": ("steps", (RELEASE,), ("--method", "--modes", "--real-poles", "--release", "-o")),
    "load": ("loads", (".",), ("--moving-mass", "--load-mass", "--permitted", "--wanted", "--frequencies", "-o")),
    "identify": ("masses", (".",), ("--model", "--damping", "--internal-mass", "--band", "--load-mass", "--permitted")),
    "compensate": ("elastomer", ("models.json", "--frequency", "900"), (
        "--sensor-frequency", "--sensor-damping", "--channel", "--load-mass", "--modes", "--frequency", "--damping",
        "--bandwidth", "--permitted-error", "--real-pole", "--low-pass", "--calibrated", "--sample-rate",
        "--discretisation", "--apply", "--ball", "-o")),
    "decouple": ("steps", (".",), ("--frequency", "--damping", "--seed", "-o")),
    "elastomer": ("elastomer", (".",), ("--solid", "-o")),
    "align": ("alignment", ("alignment.toml",), ("-o", "--device", "--force")),
}  # fmt: skip
WORDS = ("0", "-1", "1", "2", "3", "10", "80", "1000", "1e300", "1e-300", "nan", "inf", "10:20", "20:10", "1:1e9:10",
         "1:100:1000000000", "1:2:3:log", "x", "", "\0", "CON", "../x", "/dev/null/x", "auto", "fifo", "loop",
         "99999999999999999999", "0.05", "Fz", "Fx", "top", "x" * 5000)  # fmt: skip


@dataclass
class Told:
    """What became of the inputs of a kind."""

    exits: Counter[int] = field(default_factory=Counter)
    broken: list[tuple[str, str]] = field(default_factory=list)
    refused: int = 0
    unnoticed: list[tuple[str, str]] = field(default_factory=list)


class TookLong(BaseException):
    """A command that used more than its share of time."""


def _took_long(*_: Any) -> None:
    raise TookLong


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Stop what uses more processor time than that, or thirty times as long by the clock."""
    for name in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(name, _took_long)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, 30 * seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)


def ended(arguments: Sequence[str], seconds: float) -> tuple[int, str]:
    """Run a command without pages; return its exit status, -1 where it took long, -2 where it raised, and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as stack:
        for place in PAGES:
            stack.enter_context(patch(place, lambda *_: "<!doctype html>\n"))
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        try:
            with limited(seconds):
                return shakercal([*arguments]), err.getvalue() + (out.getvalue() if arguments[0] == "check" else "")
        except SystemExit as error:
            return int(error.code or 0), err.getvalue()
        except TookLong:
            return -1, f"more than {seconds:g} s"
        except BaseException as error:
            return -2, f"{type(error).__name__}: {error}"


def fault(status: int, told: str, folder: Path, before: set[Path]) -> str:
    """Say which rule a command broke, nothing where it kept them."""
    if status not in (0, 1, 2):
        return f"exit {status}: {told[-300:]}"
    if "internal error" in told or "Traceback" in told:
        return told[-500:]
    if status and not told.strip():
        return f"exit {status} without a word"
    if re.search(r"[\x00-\x08\x0b-\x1f\x7f]", told):
        return f"control characters: {told[-300:]!r}"
    if max(map(len, told.splitlines() or [""])) > 3000:
        return f"a line of {max(map(len, told.splitlines()))} characters: {told[:200]}"
    new = set(folder.rglob("*")) - before
    finished = status == 0 or (status == 1 and NO_RESULT_AT_LINES.code in told)  # with results of the other lines
    left = [path for path in new if path.name.startswith(".") or not finished]
    return f"exit {status} left {left[0].relative_to(folder)}: {told[-200:]}" if left else ""


def tried(arguments: Sequence[str], folder: Path, told: Told, what: str, seconds: float = SECONDS) -> tuple[int, str]:
    """Run a command in a folder, count how it ended, and take away what it left."""
    before = set(folder.rglob("*"))
    here = Path.cwd()
    os.chdir(folder)
    try:
        status, text = ended(arguments, seconds)
    finally:
        os.chdir(here)
    told.exits[status] += 1
    wrong = fault(status, text, folder, before)
    if wrong:
        told.broken.append((what, wrong))
    for path in sorted(set(folder.rglob("*")) - before, reverse=True):
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    return status, text


# Valid inputs.


def prepared(folder: Path, preset: str) -> Path:
    """Write the valid inputs of a preset, with the traps that wrong paths lead to, once."""
    place = folder / preset
    if place.exists():
        return place
    if preset == "alignment":
        place.mkdir()
        write_alignment(place)
    else:
        simulate(place, preset, 1)
    for entry in place.iterdir():
        if entry.is_dir() and not entry.name.startswith(KEPT.get(preset, "")):
            shutil.rmtree(entry)
    for below in (place, *(entry for entry in place.iterdir() if entry.is_dir())):
        (below / "loop").symlink_to("loop")
        os.mkfifo(below / "fifo")
        (below / "empty").write_bytes(b"")
        (below / "outside").symlink_to("/etc/hostname")
    return place


def write_alignment(folder: Path) -> None:
    """Write alignment.toml with fiducials that a calibrated pair sees."""
    import numpy as np

    rng = np.random.default_rng(1)
    matrix = np.array([[3200.0, 0, 640], [0, 3200, 512], [0, 0, 1]])
    pair = {
        "format": 1,
        "image_size": [1280, 1024],
        **{side: {"matrix": matrix.tolist(), "distortion": [0.0] * 5} for side in ("left", "right")},
        "rotation": np.eye(3).tolist(),
        "translation": [-0.15, 0.0, 0.0],
        "reprojection_rms": 0.05,
        "covariance": None,
    }
    (folder / "pair.json").write_text(json.dumps(pair), encoding="utf-8")
    content: dict[str, Any] = {
        "format": 1, "stereo": "top", "calibration": "pair.json", "scale_uncertainty": 1e-4, "point": []
    }  # fmt: skip
    for number, place in enumerate(rng.uniform(-0.03, 0.03, (5, 3))):
        seen = place * [1, -1, -1] + [0.0, 0.0, 0.5]
        left, right = (matrix @ (seen + shift) for shift in ([0, 0, 0], [-0.15, 0, 0]))
        point = {"name": f"p{number}", "position": place.tolist(), "position_uncertainty": 1e-5}
        content["point"].append(
            {**point, "left": (left / left[2])[:2].tolist(), "right": (right / right[2])[:2].tolist(),
             "pixel_uncertainty": 0.02}
        )  # fmt: skip
    (folder / "alignment.toml").write_text(document(content, ".toml"), encoding="utf-8")


# The fuzzing itself.


def drawn(strategy: st.SearchStrategy[Any], examples: int, use: Callable[[Any], None], start: int) -> None:
    """Give values of a strategy to a function, the same ones every time."""

    @seed(start)
    @settings(
        max_examples=examples, deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(strategy)
    def one(value: Any) -> None:
        use(value)

    one()


def fuzzed(kind: Kind, folder: Path, examples: int, start: int = 1) -> Told:
    """Change a valid file of a kind, and run its command on each; the file is as before in the end."""
    place, told = prepared(folder, kind.preset), Told()
    file = place / kind.file
    original = file.read_bytes()
    read = json.loads if file.suffix == ".json" else tomllib.loads
    valid = read(original.decode("utf-8"))

    def use(content: dict[str, Any]) -> None:
        file.write_text(document(content, file.suffix), encoding="utf-8")
        text = "; ".join(difference(valid, content))
        more = () if kind.arguments[0] in ("lines", "align") else ("-o", "fresh")
        status, sentence = tried([*kind.arguments, *more], place, told, text)
        if kind.check and status == 2:
            told.refused += 1
            again = Told()
            if tried(["check", kind.check], place, again, text)[0] != 2:
                told.unnoticed.append((text, sentence))
            told.broken += again.broken

    try:
        use(valid)
        assert told.exits[0] == 1, f"{kind.name}: the valid input is refused"
        drawn(changed(valid, kind.model), examples, use, start)
    finally:
        file.write_bytes(original)
    return told


def fuzzed_options(command: str, folder: Path, examples: int, start: int = 1) -> Told:
    """Run a command on valid input with options that are likely wrong."""
    preset, base, options = OPTIONS[command]
    place, told = (prepared(folder, preset) if preset else folder), Told()
    word = st.sampled_from(WORDS).map(lambda word: [word]) | st.just(list[str]())
    pair = st.tuples(st.sampled_from(options), word).map(lambda item: [item[0], *item[1]])

    def use(more: list[list[str]]) -> None:
        arguments = [command, *base, *(word for one in more for word in one)]
        tried(arguments, place, told, " ".join(arguments), SECONDS_OF_OPTIONS.get(command, SECONDS))

    drawn(st.lists(pair, min_size=1, max_size=2), examples, use, start)
    return told


def main() -> None:
    """Print what becomes of wrong inputs of every kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=300, help="inputs of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=[], help="kinds, or commands of which the options are changed")
    parser.add_argument("--show", type=int, default=20, help="how many inputs that broke a rule are shown of a kind")
    options = parser.parse_args()
    jobs = [(kind.name, partial(fuzzed, kind, examples=options.examples, start=options.seed)) for kind in KINDS]
    jobs += [
        (f"options of {name}", partial(fuzzed_options, name, examples=options.examples, start=options.seed))
        for name in OPTIONS
    ]
    any_broken = False
    print("| input | exit 0 | exit 1 | exit 2 | rules broken | refused by run, by check |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, job in jobs:
            if options.only and name not in options.only:
                continue
            told = job(Path(folder))
            exits = " | ".join(str(told.exits[status]) for status in (0, 1, 2))
            agreed = f"{told.refused}, {told.refused - len(told.unnoticed)}" if told.refused else ""
            print(f"| {name} | {exits} | {len(told.broken)} | {agreed} |", flush=True)
            any_broken |= bool(told.broken)
            for title, items in (("broke", told.broken), ("check", told.unnoticed)):
                for what, wrong in {wrong[:80]: (what, wrong) for what, wrong in reversed(items)}.values():
                    print(f"    {title}: {wrong}\n      {what[:600]}", file=sys.stderr)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"\nlargest memory: {peak:.2f} GB")
    sys.exit(any_broken)


if __name__ == "__main__":
    main()
