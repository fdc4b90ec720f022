"""A small valid campaign on disk: the example of `shakercal init`, empty files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluation_factory import Choice, make_evaluation
from recordings import make_once
from support import DOCS, RefusedCommand, draft_example, examples, refusals, without_pages

from fusion import simulate_preset
from fusion.base import Settings, versions
from fusion.campaign.executor import one_blas_thread
from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.report.recording_report import write_results
from fusion.report.summary_pdf import find_browser
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording

FILES = (
    *(f"{folder}/{frame:04d}.tif" for folder in ("top-left", "top-right") for frame in range(3)),
    *(f"DIC_results/result_B{frame}.txt" for frame in (1, 2, 10)),
    "vibrometer.h5",
    "bridge.tdms",
    "bridge-response.csv",
)
BASE_PAIR = """
[stereo.base]
body = "base"
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation = [0.0, 0.0, -0.1]
scale_uncertainty = 3e-4
exposure = 40e-6
"""


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Headless Chromium of the system."""
    api = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    try:
        program = find_browser()
    except InputError:
        pytest.skip("no Chromium on this system")
    with api.sync_playwright() as started:
        try:
            arguments = ["--no-sandbox", "--disable-dev-shm-usage"]
            chromium = started.chromium.launch(executable_path=program, args=arguments, timeout=60_000)
        except api.Error as error:
            pytest.skip(f"Chromium does not start: {str(error).splitlines()[0]}")
        yield chromium
        chromium.close()


@pytest.fixture(scope="session")
def format_examples() -> dict[str, str]:
    """The example of rig.toml and recording.toml, and calibration/NAME.json of the document on files."""
    calibration = examples((DOCS / "files.md").read_text(encoding="utf-8"), "json")[0]
    return {
        "rig": draft_example("rig.toml"),
        "recording": draft_example("recording.toml"),
        "calibration": calibration,
    }


@pytest.fixture
def make_campaign(tmp_path: Path, format_examples: dict[str, str]) -> Callable[..., Path]:
    """Return a function that writes a campaign and returns the folder of its recording.

    `rig`, `recording`: texts in place of the examples; `replace`: (file, old, new) changes to either of them.
    """

    def make(
        rig: str | None = None, recording: str | None = None, replace: tuple[tuple[str, str, str], ...] = ()
    ) -> Path:
        texts = {
            "rig.toml": format_examples["rig"] + BASE_PAIR if rig is None else rig,
            "recording.toml": format_examples["recording"] if recording is None else recording,
        }
        for file, old, new in replace:
            assert old in texts[file], f"{old!r} is not in {file}"
            texts[file] = texts[file].replace(old, new, 1)
        folder = tmp_path / "campaign" / "Fz-0106.25"
        for name in FILES:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(b"")
        (folder.parent / "calibration").mkdir(exist_ok=True)
        (folder.parent / "calibration" / "top.json").write_text(format_examples["calibration"], encoding="utf-8")
        (folder.parent / "rig.toml").write_text(texts["rig.toml"], encoding="utf-8")
        (folder / "recording.toml").write_text(texts["recording.toml"], encoding="utf-8")
        return folder

    return make


@pytest.fixture(scope="session")
def ready_evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    """A complete synthetic evaluation, made once."""
    return make_evaluation(tmp_path_factory.mktemp("ready"), Choice(frames=24, images=False))


@pytest.fixture(scope="session")
def demo_evaluation(demo_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    """The demo recording evaluated as a run does, once per test run."""

    def evaluate(_: Path) -> Evaluation:
        with one_blas_thread():
            return evaluate_recording(load_manifest(find_recordings(demo_recording)[0]), Settings(), {})

    return make_once(tmp_path_factory, "demo", evaluate)


@pytest.fixture(scope="session")
def demo_results(demo_evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the demo with an empty page, written once per test run. Tests that change them must copy them."""

    def write(folder: Path) -> Path:
        with pytest.MonkeyPatch.context() as patch:
            without_pages(patch)
            write_results(demo_evaluation, folder / "Fz-0080")
        return folder / "Fz-0080"

    return make_once(tmp_path_factory, "demo-results", write)


COMMANDS = {
    "steps": "step",
    "rotation": "rotate",
    "loads": "load",
    "chirp": "transfer",
    "masses": "identify",
    "elastomer": "elastomer",
    "matrix": "run",
}


@pytest.fixture(scope="session")
def commanded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that returns a simulated campaign with the results of its command, once per test run.

    Tests that change it must copy it.
    """

    def made(preset: str) -> Path:
        def write(folder: Path) -> Path:
            simulate_preset(folder, preset, seed=1)
            source = folder / "elastomer.toml" if preset == "elastomer" else folder
            assert main([COMMANDS[preset], str(source), "-q"]) == 0
            return folder

        return make_once(tmp_path_factory, f"preset-{preset}", write)

    return made


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch, ready_evaluation: Evaluation) -> list[str]:
    """Replace tracking and fusion by the ready evaluation; no figures in reports, no texts in HDF5 files.

    The returned list has the folders of evaluated recordings.
    """
    done: list[str] = []

    def evaluate(manifest: Manifest, settings: Settings, hashes: dict[str, str], *_: Any) -> Evaluation:
        done.append(manifest.folder.name)
        return replace(
            ready_evaluation, manifest=manifest, settings=settings.as_dict(), versions=versions(), input_hashes=hashes
        )

    monkeypatch.setattr("fusion.campaign.run.evaluate_recording", evaluate)
    monkeypatch.setattr("fusion.report.h5.describe", lambda _: None)
    without_pages(monkeypatch)
    return done


@pytest.fixture
def no_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    without_pages(monkeypatch)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> RefusedCommand:
    """Run a command that refuses its input, and return its sentence."""
    return refusals(capsys)
