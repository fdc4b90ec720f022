"""What every manifest passes before any key is looked at: paths, sizes, texts, depth; and what nobody can mean."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args

import fuzz_manifests
import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError
from support import RefusedCommand, edit

from fusion.cameras.align_manifest import AlignmentFile
from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.recording.manifest import RecordingFile
from fusion.recording.recording_notices import FILE_TOO_LARGE, INVALID_SYNTAX, INVALID_VALUE, VALUE_OUT_OF_RANGE
from fusion.recording.response import MeasuringChainFile
from fusion.recording.rig import Rig
from fusion.recording.toml import LARGEST_TOML, read_toml
from fusion.recording.values import Context, PathScope
from fusion.sensor.elastomer.element_definition import ElementFile, read_definition
from fusion.simulate import simulate

MANIFESTS = (Rig, RecordingFile, AlignmentFile, ElementFile, MeasuringChainFile)
PATH_KEYS = {
    "Stereo.calibration", "ChannelEntry.response", "Daq.file", "Daq.repeats", "Images.left", "Images.right",
    "Images.displaced_left",    "Images.displaced_right", "PointFiles.files",
    "ExcitationEntry.file", "AlignmentFile.calibration", "OtherPair.calibration", "FaceBlock.pixels",
    "TargetViewBlock.left", "TargetViewBlock.right", "CommonView.left", "CommonView.right", "CommonView.other_left",
    "CommonView.other_right", "MotionBlock.recordings", "AxisBlock.recordings", "ElementFile.measured",
    "ChannelDefaults.response", "ElasticMode.surface", "SensorOfCamera.dark", "SensorOfCamera.flat",
}  # fmt: skip


def _parts(annotation: Any) -> Iterator[Any]:
    yield annotation
    for argument in get_args(annotation):
        yield from _parts(argument)


def _models(model: type[BaseModel], seen: set[type[BaseModel]]) -> set[type[BaseModel]]:
    """A model and all that its keys hold."""
    if model not in seen:
        seen.add(model)
        for field in model.model_fields.values():
            for part in _parts(field.annotation):
                if isinstance(part, type) and issubclass(part, BaseModel):
                    _models(part, seen)
    return seen


def _path_keys() -> dict[str, Any]:
    """Model.key -> what checks its value, of every key of every manifest that names files."""
    models: set[type[BaseModel]] = set()
    for manifest in MANIFESTS:
        _models(manifest, models)
    return {
        f"{model.__name__}.{key}": TypeAdapter(Annotated[field.annotation, *(field.metadata or [None])])
        for model in models
        for key, field in model.model_fields.items()
        if any(part is Path for part in _parts(field.annotation))
    }


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A folder with a recording's folder, a file outside, and links, pipes and circles inside."""
    inside = tmp_path / "campaign" / "recording"
    inside.mkdir(parents=True)
    (tmp_path / "secret.h5").write_bytes(b"x")
    (inside / "good.h5").write_bytes(b"x")
    (inside / "out.h5").symlink_to(tmp_path / "secret.h5")
    (inside / "away").symlink_to(tmp_path)
    (inside / "loop.h5").symlink_to("loop.h5")
    os.mkfifo(inside / "pipe.h5")
    return inside


def test_the_list_of_path_keys_is_whole():
    assert set(_path_keys()) == PATH_KEYS


@pytest.mark.parametrize("key", sorted(PATH_KEYS))
def test_every_path_passes_one_gate(key, tree):
    check = _path_keys()[key]
    context = Context(PathScope(tree, tree.parent))
    assert check.validate_python("good.h5", context=context)
    wrong = ("../../secret.h5", str(tree.parent.parent / "secret.h5"), "out.h5", "away/secret.h5", "away/*.h5",
             "loop.h5", "pipe.h5", "/dev/zero", "good.h5\0", "x" * 5000, "..", ".", "C:/x", "a\\b", "none")  # fmt: skip
    for text in wrong:
        with pytest.raises(ValidationError, match="expected"):
            check.validate_python(text, context=context)


def test_the_rig_passes_no_links_out(make_campaign, tmp_path):
    folder = make_campaign()
    for rig in ("/etc/hostname", "../../nowhere.toml", "../rig.toml\\u0000", "..", "pipe"):
        (folder / "pipe").exists() or os.mkfifo(folder / "pipe")
        text = (folder / "recording.toml").read_text(encoding="utf-8")
        other = re.sub(r'^rig = ".*"', lambda _, rig=rig: f'rig = "{rig}"', text, flags=re.MULTILINE)
        (folder / "recording.toml").write_text(other, encoding="utf-8")
        with pytest.raises(InputError, match="rig"):
            load_manifest(folder)
        (folder / "recording.toml").write_text(text, encoding="utf-8")


DEEP = 100_000
FLOODS = {
    # content, declaration, key, words of the values
    "deep lists": ("x = " + "[" * DEEP, INVALID_SYNTAX, "line 1", ["32"]),
    "deep lists, line by line": ("x = " + "[\n" * 5000, INVALID_SYNTAX, "", ["TOML"]),
    "deep tables": ("x = " + "{a = " * DEEP, INVALID_SYNTAX, "line 1", ["32"]),
    "a long name": (".".join("a" * DEEP) + " = 1", INVALID_SYNTAX, "line 1", ["32"]),
    "deep, but short": ("x = " + "[" * 40 + "]" * 40, INVALID_SYNTAX, "x[1][1]", ["32"]),
    "a long text": (f'x = "{"a" * 5000}"', INVALID_VALUE, "x", ["4096"]),
    "a long key": (f'"{"k" * 5000}" = 1', INVALID_VALUE, "", ["4096"]),
    "NUL": ('x = "a\\u0000b"', INVALID_VALUE, "x", [r'"a\u0000b"']),
    "an escape": ('x = ["a", "\\u001b[31m"]', INVALID_VALUE, "x[2]", [r'"\u001b[31m"']),
    "writing from the right": ('x = "a\\u202eb"', INVALID_VALUE, "x", [r'"a\u202eb"']),
    "a key with an escape": ('"\\u001b" = 1', INVALID_VALUE, "", [r"\u001b"]),
    "a number that overflows": ("x = 1e300", VALUE_OUT_OF_RANGE, "x", ["1e-100", "1e+30", "1e+300"]),
    "a number that vanishes": ("x = 1e-300", VALUE_OUT_OF_RANGE, "x", ["1e-100", "1e+30", "1e-300"]),
    "a whole number that overflows": ("x = " + "9" * 4000, VALUE_OUT_OF_RANGE, "x", ["1e-100", "1e+30"]),
    "no whole number": ("x = " + "9" * 5000, INVALID_SYNTAX, "", ["TOML"]),
    "too much": ("x = 1\n" * (LARGEST_TOML // 6 + 1), FILE_TOO_LARGE, "", [str(LARGEST_TOML)]),
}


@pytest.mark.parametrize(
    ("encoded", "pattern"),
    [
        (lambda text: text.replace("\n", "\r\n").encode(), None),
        (lambda text: text.encode("utf-8-sig"), None),
        (lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"), None),
        (lambda text: text.encode("utf-16"), "UTF-16"),
        (lambda text: text.encode("utf-16-be"), "TOML|encoding"),
        (lambda text: text.encode("cp1252"), "line 2.* 1252"),
        (lambda text: text.replace("\n", "\r").encode(), "TOML"),
    ],
)
def test_manifests_of_editors_of_other_systems(encoded, pattern, tmp_path):
    """Line ends and byte order marks of Windows are read; another encoding is one sentence."""
    text = 'format = 1\nname = "Prüfstand"\n\n[load]\nmass = 1.5\n'
    path = tmp_path / "rig.toml"
    path.write_bytes(encoded(text))
    if pattern is None:
        assert read_toml(path) == {"format": 1, "name": "Prüfstand", "load": {"mass": 1.5}}
        return
    with pytest.raises(InputError, match=rf"rig\.toml: .*({pattern})") as error:
        read_toml(path)
    assert str(error.value).isprintable()


@pytest.mark.parametrize("what", list(FLOODS))
def test_what_no_manifest_holds_is_refused_at_once(what, tmp_path):
    content, declared, key, words = FLOODS[what]
    path = tmp_path / "rig.toml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_toml(path)
    assert (error.value.code, error.value.file, error.value.key) == (declared.code, path, key)
    assert set(words) <= set(f"{error.value.values['expected']} {error.value.values['found']}".split())
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 600 + len(str(path))


def test_long_lines_that_are_meant_are_read(tmp_path):
    path = tmp_path / "rig.toml"
    rows = "[" + ", ".join(["[" + ", ".join(["0.0012345678901"] * 32) + "]"] * 60) + "]"
    path.write_text(f'x = {rows}\nabout = "{"." * 4000}"\nten = 1e-99\n', encoding="utf-8")
    assert len(read_toml(path)["x"]) == 60


@pytest.mark.parametrize(
    "command",
    [
        "elastomer",
        "align",
        "compensate --frequency 9",
        "load --moving-mass 1 --frequencies",
        "lines",
        "check",
        "run",
        "import-calibration -o x.json",
    ],
)
@pytest.mark.parametrize("place", ["pipe", "/dev/zero", "loop"])
def test_devices_pipes_and_circles_are_no_files(command, place, tmp_path, capsys, monkeypatch):
    from fusion.cli import main

    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("loop").symlink_to("loop")
    writer = threading.Timer(5.0, lambda: os.close(os.open("pipe", os.O_RDWR | os.O_NONBLOCK)))
    writer.start()  # so that a command that does read fails instead of hanging
    try:
        with pytest.raises(SystemExit) as ended:
            main([*command.split(), place])
    finally:
        writer.cancel()
    assert ended.value.code == 2
    assert re.search("device or pipe|circular", capsys.readouterr().err)


UNITS = [
    # file, old, new, pattern of the error
    ("rig.toml", "mass = 6.9605", "mass = 6960.5", "load.mass: "),
    ("rig.toml", "mass = 6.9605", "mass = 696050.0", r"load.mass: .*100000 kg"),
    ("rig.toml", "[0.0, 0.0, 0.0310]]", "[0.0, 0.0, 0.0310e6]]", r"load.inertia: "),
    (
        "rig.toml",
        "centre_of_mass = [0.0, 0.0, 0.010]",
        "centre_of_mass = [0.0, 0.0, 10.0]",
        r"centre_of_mass.*0.01 m",
    ),
    ("rig.toml", "translation = [0.0, 0.0, 0.30]", "translation = [0.0, 0.0, 300.0]", r"translation.*0.3 m"),
    ("rig.toml", "exposure = 40e-6", "exposure = 40", r"stereo.top.exposure: .*0.04 s"),
    ("rig.toml", "temperature = 23.0", "temperature = 296.15", "environment.temperature: "),
    ("rig.toml", "mass = 6.9605", "mass = 1e25", r"load.mass: .*100000 kg.*1e[+]25$"),
    ("rig.toml", "scale_uncertainty = 2e-4", "scale_uncertainty = 2.0", r"scale_uncertainty: .*0.02"),
    (
        "recording.toml",
        "direction_uncertainty = 5e-3",
        "direction_uncertainty = 5",
        r"direction_uncertainty: .*0.0872665 rad",
    ),
    ("recording.toml", "clock_uncertainty = 1e-6", "clock_uncertainty = 50", "clock_uncertainty: "),
    ("recording.toml", "point = [0.030, 0.0, 0.040]", "point = [30, 0, 40]", r"point.*0.03 m"),
    ("recording.toml", "delay = 0.0 ", "delay = 40.0 ", r"delay: .*10 s.*40"),
    ("recording.toml", "frequencies = [106.25]", "frequencies = [-106.25]", "frequencies.*-106.25"),
    ("recording.toml", "frequencies = [106.25]", f"frequencies = {list(range(1, 3000))}", "frequencies: .*2000"),
    ("recording.toml", 'harmonics = "auto"', "harmonics = [2, 1000000]", "harmonics.*1000"),
    ("recording.toml", "first_edge = 0 ", "first_edge = 9999999999 ", "first_edge"),
    ("recording.toml", "format = 1", "format = true", "format: .*1.*true"),
]


@pytest.mark.parametrize(("file", "old", "new", "pattern"), UNITS)
def test_a_value_of_another_unit_is_told(file, old, new, pattern, make_campaign):
    with pytest.raises(InputError, match=pattern):
        load_manifest(make_campaign(replace=((file, old, new),)))


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("CON", "Windows"),
        ("nul.x", "Windows"),
        ("a:b", "file name"),
        ("a/b", "file name"),
        ("../x", "file name"),
        ("end.", "file name"),
        ("end ", "file name"),
        ("x" * 200, "file name"),
        ("Top", 'differs from "top" by more than case'),
        ("\N{FULLWIDTH LATIN SMALL LETTER T}op", 'differs from "top"'),
    ],
)
def test_names_of_stereo_pairs_are_names_of_files(name, pattern, make_campaign):
    folder = make_campaign()
    text = (folder.parent / "rig.toml").read_text(encoding="utf-8")
    (folder.parent / "rig.toml").write_text(text.replace("[stereo.base]", f'[stereo."{name}"]'), encoding="utf-8")
    with pytest.raises(InputError, match=pattern):
        load_manifest(folder)


@pytest.fixture(scope="module")
def element(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("element") / "own"
    simulate(folder, "elastomer", 1)
    return folder


@pytest.mark.parametrize(
    ("old", "new", "pattern"),
    [
        ("span = 0.064", "span = 64.0", r"beams.span: .*2 m.*64 .*0.064 m"),
        ("width = 0.0038", "width = 0.38", "beams.width: .*0.0358 m"),
        ("length = 0.032", "length = 0.00032", "thickness: "),
        ("density = 2820.0", "density = 2.82", r"density: .*2820 kg/m"),
        ("youngs_modulus = 72000000000.0", "youngs_modulus = 72", "youngs_modulus: .*7.2e[+]10 Pa"),
        ('measured = "models.json"', 'measured = "../../secret.json"', "measured: "),
    ],
)
def test_a_drawing_in_another_unit_is_refused(old, new, pattern, element, tmp_path):
    text = (element / "elastomer.toml").read_text(encoding="utf-8")
    folder = tmp_path / "above" / "own"
    folder.mkdir(parents=True)
    (tmp_path / "secret.json").write_text("{}", encoding="utf-8")
    (folder / "models.json").write_bytes((element / "models.json").read_bytes())
    (folder / "elastomer.toml").write_text(text, encoding="utf-8")
    read_definition(folder / "elastomer.toml")
    edit(folder / "elastomer.toml", old, new)
    with pytest.raises(InputError, match=pattern):
        read_definition(folder / "elastomer.toml")


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        ("--frequency 100 --modes 9", "--modes (Fx): "),
        ("--frequency 1e6 --sample-rate 10", "--sample-rate (Fx): "),
    ],
)
def test_a_wish_that_cannot_be_met_names_its_option(arguments, pattern, element, tmp_path, refused: RefusedCommand):
    error_text = refused("compensate", element / "models.json", *arguments.split(), "-o", tmp_path / "out")
    assert pattern in error_text
    assert not (tmp_path / "out").exists()


def test_repeats_of_one_load_make_a_model_of_two_masses(tmp_path, capsys, monkeypatch):
    from support import rows, without_pages

    from fusion.cli import main

    without_pages(monkeypatch)
    table = tmp_path / "loads.csv"
    table.write_text("load_mass_kg,frequency_hz\n0.15,100\n0.15,101\n0.15,99\n", encoding="utf-8")
    assert main(["load", "--frequencies", str(table), "--moving-mass", "0.05", "-o", str(tmp_path / "out")]) == 0
    (stiffness,) = [row for row in rows(tmp_path / "out" / "parameters.csv") if row["name"] == "stiffness"]
    assert float(stiffness["value"]) == pytest.approx(0.2 * (2 * 3.141592653589793 * 100) ** 2, rel=0.02)


USUAL = 5
EXAMPLES = {
    **dict.fromkeys(("rig", "loads", "loads rig", "element", "measured", "models"), 3),
    **dict.fromkeys(("options of decouple", "options of elastomer", "options of lines"), 3),
}
"""Fewer where a valid example is seconds of work; `benchmarks/fuzz_manifests.py` tries hundreds of each."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where valid inputs are simulated, once per preset; what commands leave there is taken away again."""
    return tmp_path_factory.mktemp("inputs")


@pytest.mark.slow
@pytest.mark.parametrize("kind", fuzz_manifests.KINDS, ids=lambda kind: kind.name)
def test_wrong_manifests_end_with_one_sentence(kind, inputs):
    found = fuzz_manifests.fuzzed(kind, inputs, EXAMPLES.get(kind.name, USUAL))
    assert not found.broken
    assert not found.unnoticed


@pytest.mark.slow
@pytest.mark.parametrize("command", list(fuzz_manifests.OPTIONS))
def test_wrong_options_end_with_one_sentence(command, inputs):
    assert not fuzz_manifests.fuzzed_options(command, inputs, EXAMPLES.get(f"options of {command}", USUAL)).broken
