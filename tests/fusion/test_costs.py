"""Counted costs of the evaluation of the demo, independent of the machine."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fusion import Settings, run_path
from fusion.phasors.frame_order import MOST_ROW_FRAMES
from fusion.report import static_figure
from fusion.report.folder import read_provenance
from photogram import bspline
from photogram.direct import direct_fit
from photogram.images import image_files, tiff
from photogram.subsets import find
from photogram.subsets.reference import TrackStatus

DEMO = Path(__file__).resolve().parents[2] / "sample_images" / "demo" / "Fz-0080"
PICTURES, CAMERAS = 96, 4
DRAWING = ("matplotlib", "jinja2", "PIL")
FOLLOWING = ("numba", "llvmlite", "torch", "photogram.bspline", "photogram.measure")
SELDOM = ("scipy.interpolate", "scipy.stats", "scipy.signal", "lxml")
OF_CAMPAIGNS = (
    "fusion.campaign.joint_evaluation",
    "fusion.campaign.curve",
    "fusion.campaign.matrix",
    "scipy.sparse.csgraph",
)
SOLVING = ("scipy.optimize", "scipy.fft", "scipy.ndimage", "scipy.spatial", "scipy.sparse")


@pytest.fixture(scope="module")
def costs(tmp_path_factory):
    """Calls of what takes the time of a run, iterations of every subset, opened files, and the results."""
    calls, iterations, opened, out = Counter[str](), list[int](), set[str](), tmp_path_factory.mktemp("results")
    listening = True

    def listen(event, arguments):
        if listening and event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            opened.add(os.path.realpath(os.fsdecode(arguments[0])))

    def counted(patch, module, name):
        inner = getattr(module, name)

        def outer(*arguments, **named):
            calls[name] += 1
            return inner(*arguments, **named)

        patch.setattr(module, name, outer)

    compare, pixels = direct_fit.compare_cells, list[int]()

    def compared(own, *arguments):
        pixels.append(own.pixels.shape[1])
        return compare(own, *arguments)

    register = find.register

    def registered(*arguments):
        found = register(*arguments)
        iterations.extend(found.iterations[found.status == TrackStatus.OK])
        return found

    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (image_files, "tiff_header"), (image_files, "read_tiff"), (tiff, "_inflated"), (bspline, "_prefilter"),
            (static_figure, "frames"),
        ):  # fmt: skip
            counted(patch, module, name)
        patch.setattr(find, "register", registered)
        patch.setattr(direct_fit, "compare_cells", compared)
        sys.addaudithook(listen)
        run_path(DEMO, out, Settings(), force=True)
    listening = False
    calls["pixels of a body"], calls["pixels compared"] = max(pixels), sum(pixels)
    return calls, iterations, opened, out


def test_a_picture_is_read_and_prepared_once_but_for_the_first_of_a_camera_and_some_whose_rows_are_compared(costs):
    calls, *_ = costs
    assert calls["tiff_header"] == PICTURES
    assert PICTURES <= calls["read_tiff"] <= PICTURES + (2 + MOST_ROW_FRAMES + 1) * CAMERAS
    assert calls["_inflated"] == calls["read_tiff"]
    assert PICTURES <= calls["_prefilter"] <= PICTURES + 2  # and the two splines whose noise is known


def test_a_subset_needs_fewer_than_two_steps(costs):
    _, iterations, *_ = costs
    assert len(iterations) > 50 * PICTURES
    assert np.mean(iterations) < 2.0


def test_most_frames_are_compared_with_the_body_once(costs):
    calls, *_ = costs
    assert calls["pixels compared"] <= 1.3 * PICTURES * calls["pixels of a body"]


def test_figures_of_paper_are_drawn_once(costs):
    """The summary and the main figures have images for paper, 4 ms each; all others are drawn by the browser."""
    calls, *_ = costs
    assert 0 < calls["frames"] <= 24


def test_every_file_that_a_run_opens_is_among_the_hashed(costs):
    """Of the files that Python opens, those of the campaign are inputs of the results."""
    *_, opened, out = costs
    campaign = DEMO.parent.resolve()
    hashed = {os.path.realpath(campaign / name) for name in read_provenance(out).input_hashes}
    read = {name for name in opened if name.startswith(f"{campaign}{os.sep}")}
    assert len(read) > PICTURES
    assert read <= hashed


def imported(program: str, *arguments: str) -> set[str]:
    """Modules that a process has imported after a program, which prints nothing else in its last line."""
    program += "\nimport sys; print(); print(*sys.modules)"
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, cwd=DEMO.parents[2], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


COMMAND = "import sys\nfrom fusion.cli import main\nassert main(sys.argv[1:]) == 0"


def test_check_imports_no_module_for_tracking_or_drawing():
    found = imported(COMMAND, "check", str(DEMO), "-q")
    assert not found & {*DRAWING, *FOLLOWING, *OF_CAMPAIGNS, "scipy", "lxml", "rich", "multiprocessing"}


def test_lines_need_no_images():
    found = imported(COMMAND, "lines", str(DEMO), "-q")
    assert not found & {*DRAWING, *FOLLOWING, *SELDOM, *OF_CAMPAIGNS, *SOLVING, "cv2"}


def test_a_single_recording_imports_no_campaign_module_and_no_matplotlib():
    """Everything that a run imports before it computes, its page, and a table that is printed afterwards."""
    modules = "campaign.run", "campaign.run_summary", "report.recording_report", "sensitivity.recording_evaluation"
    found = imported("\n".join(f"import fusion.{name}" for name in modules) + "\nimport photogram.measure.body")
    assert not found & {*SELDOM, *OF_CAMPAIGNS, "torch", "scipy.optimize", "matplotlib"}
