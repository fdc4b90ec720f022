"""How soon `shakercal view` answers: a step of the slider, and a zoom into long channels.

Usage: python benchmarks/view.py [--seconds 60] [--channels 16] [--draws 200] [--browser CHROMIUM] [--docs docs]

Makes a recording of noise in a temporary folder: pictures of 1280 x 1024 px at 10 bit of a stereo pair, and channels
at 51.2 kHz in HDF5. Its server is asked over HTTP as the page asks it: both pictures and subsets of a frame at once;
all channels between two random times, in 1200 columns. Printed: median and 95 % quantile of the answers in ms and the
first one (which reads the files and makes the extremes), with --docs into performance.md there; and the memory of the
extremes over that of the samples as float64. With --browser (Playwright drives it): from the moved slider until both
images are drawn: the next frame, as while dragging, and any other one; with and without a field over both. The field is
the demo's, whose points are moved to the same share of the larger pictures.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import h5py
import numpy as np
import tifffile
from marked import existing_folder, markdown_table, write_marked

from fusion.planning.view.server import Server
from fusion.planning.view.view_requests import api_handlers
from fusion.planning.view.view_sources import find_sources
from fusion.planning.view.viewed_recording import ViewSession
from fusion.report.recording_report import write_results
from fusion.sensitivity.recording_evaluation import evaluate_recording

DEMO = Path(__file__).resolve().parents[1] / "sample_images/demo"
RATE_HZ, SIZE_PX, FRAMES = 51_200.0, (1280, 1024), 100
DEMO_PX = 304  # width of the demo's pictures


def make_recording(folder: Path, seconds: float, channels: int) -> None:
    """Write a campaign of one recording: the demo's rig with larger pictures, and channels of noise."""
    rng = np.random.default_rng(1)
    shutil.copy(DEMO / "rig.toml", folder)
    shutil.copytree(DEMO / "calibration", folder / "calibration")
    for file in (folder / "calibration").iterdir():
        content = json.loads(file.read_text(encoding="utf-8"))
        cameras = {side: _enlarged(content[side]) for side in ("left", "right")}
        file.write_text(json.dumps(content | {"image_size": list(SIZE_PX)} | cameras), encoding="utf-8")
    own = folder / "Fz-0080"
    for side in ("left", "right"):
        (own / side).mkdir(parents=True)
        for frame in range(FRAMES):
            picture = rng.integers(0, 1024, SIZE_PX[::-1], dtype=np.uint16)
            tifffile.imwrite(own / side / f"{frame:04d}.tif", picture)
    text = ['format = 1\nname = "long"\nrig = "../rig.toml"\n[excitation]\nkind = "sine"\ndirection = [0.0, 0.0, 1.0]']
    text.append('frequencies = [80.0]\n[[daq]]\nname = "long"\nfile = "long.h5"')
    with h5py.File(own / "long.h5", "w") as file:
        for channel in range(channels):
            samples = rng.standard_normal(int(seconds * RATE_HZ)).astype(np.float32)
            data = file.create_dataset(f"c{channel}", data=samples)
            data.attrs["sample_rate"] = RATE_HZ
            text.append(f'[[daq.channel]]\nname = "c{channel}"\nquantity = "voltage"')
        trigger = (np.arange(int(seconds * RATE_HZ)) % 1280 < 64) * np.float32(5)
        file.create_dataset("camera_trigger", data=trigger).attrs["sample_rate"] = RATE_HZ
    text.append('[[daq.channel]]\nname = "camera_trigger"\nquantity = "trigger"')
    text.append('[[images]]\nstereo = "top"\nleft = "left/*.tif"\nright = "right/*.tif"\ntrigger = "camera_trigger"')
    (own / "recording.toml").write_text("\n".join(text), encoding="utf-8")


def _enlarged(camera: dict[str, Any]) -> dict[str, Any]:
    """Return a camera of the demo with the larger pictures."""
    scale = np.diag([SIZE_PX[0] / DEMO_PX] * 2 + [1.0])
    return camera | {"matrix": (scale @ np.array(camera["matrix"])).tolist()}


def add_results(folder: Path) -> None:
    """Write the results of the demo as those of the recording, with its points in the larger pictures."""
    results = folder / "results/Fz-0080"
    write_results(evaluate_recording(DEMO / "Fz-0080/recording.toml"), results)
    with h5py.File(results / "result.h5", "a") as file:
        file.attrs["recording"] = "long"
        pair = file["stereo/top"]
        changed = {
            "subsets_px": pair["subsets_px"][()] * SIZE_PX[0] / DEMO_PX,
            "time_s": np.arange(FRAMES) * 1280 / RATE_HZ,
        }
        changed["motion/pose"] = np.resize(pair["motion/pose"][()], (FRAMES, 6))
        for name, values in changed.items():
            del pair[name]
            pair[name] = values


def timed(ask: Callable[[], object]) -> float:
    """Return how long an answer takes in ms."""
    begin = time.perf_counter()
    ask()
    return 1e3 * (time.perf_counter() - begin)


def told(what: str, times_ms: list[float], first_ms: float) -> str:
    """Return a row of the table."""
    middle, high = np.percentile(times_ms, (50, 95))
    return f"| {what} | {middle:.0f} | {high:.0f} | {first_ms:.0f} |"


STEP = """async (frame) => {
  const slider = view.get("frame"), began = performance.now();
  slider.value = frame;
  slider.dispatchEvent(new Event("input"));
  while (document.body.dataset.frame !== String(frame)) await new Promise((drawn) => requestAnimationFrame(drawn));
  return performance.now() - began;
}"""


def in_browser(chromium: str, address: str, draws: int) -> list[str]:
    """Return rows of steps of the slider in a browser."""
    from playwright.sync_api import sync_playwright

    rows = []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        page.goto(address)
        page.wait_for_selector("body[data-frame]", timeout=120_000)
        for what, field in (("images", ""), ("images with a field", "d-z")):
            page.select_option("#field", field)
            for way, step in (("next frame", 1), ("any frame", 7)):
                page.wait_for_timeout(1000)
                first, *steps = [float(page.evaluate(STEP, (step * n + 5) % FRAMES)) for n in range(draws)]
                rows.append(told(f"{way} in the browser, {what}", steps, first))
        browser.close()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--channels", type=int, default=16)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--browser", help="path of a Chromium")
    parser.add_argument("--docs", type=existing_folder, help="folder of performance.md, whose table is replaced")
    options = parser.parse_args()
    rng = np.random.default_rng(2)
    with tempfile.TemporaryDirectory() as folder:
        make_recording(Path(folder), options.seconds, options.channels)
        add_results(Path(folder))
        viewed = ViewSession(find_sources(Path(folder)))
        with Server(api_handlers(viewed)) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            connection = HTTPConnection("127.0.0.1", server.server_port)

            def ask(what: str, **asked: object) -> None:
                connection.request("GET", f"{urlsplit(server.address).path}api/{what}?{urlencode(asked)}")
                answer = connection.getresponse()
                body = answer.read()
                assert answer.status == 200, body

            def step(frame: int) -> None:
                ask("frame", pair=0, side=0, frame=frame)
                ask("frame", pair=0, side=1, frame=frame)
                ask("subsets", pair=0, frame=frame)

            def zoom(begin: float, end: float) -> None:
                numbers = ",".join(map(str, range(options.channels)))
                ask("signal", channels=numbers, columns=1200, **{"from": begin, "to": end})

            print(f"opening: {timed(lambda: ask('recording')):.0f} ms")
            first = timed(lambda: step(0))
            steps = [timed(partial(step, frame)) for frame in rng.integers(1, FRAMES, options.draws).tolist()]
            rows = [told(f"server: both images of a frame, {SIZE_PX[0]} × {SIZE_PX[1]} px", steps, first)]
            first = timed(lambda: zoom(0.0, options.seconds))
            spans = np.exp(rng.uniform(np.log(1e-3), np.log(options.seconds), options.draws))
            begins = rng.uniform(0.0, np.maximum(options.seconds - spans, 0.0))
            zooms = [timed(partial(zoom, b, b + s)) for b, s in zip(begins, spans, strict=True)]
            name = f"server: zoom into {options.channels} channels of {options.seconds:g} s at 51.2 kHz"
            rows += [told(name, zooms, first)]
            made = viewed.recording({}).extremes(0)
            share = sum(low.nbytes + high.nbytes for _, low, high in made.levels) / made.samples.nbytes
            print(f"memory of the extremes over that of the samples: {share:.4f}")
            rows += in_browser(options.browser, server.address, options.draws) if options.browser else []
            server.shutdown()
    table = markdown_table("| request | median / ms | 95 % quantile / ms | first / ms |", rows)
    print(table)
    if options.docs:
        write_marked(options.docs / "performance.md", {"view": table})


if __name__ == "__main__":
    main()
