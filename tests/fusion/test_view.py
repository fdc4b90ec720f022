"""`shakercal view`: what its server answers and refuses, and the page in a browser."""

from __future__ import annotations

import json
import re
import shutil
import struct
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.client import HTTPConnection
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import cv2
import h5py
import numpy as np
import pytest
from browsing import viewer_pages
from cluster_factory import environment, wait_until
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.errors import InputError
from fusion.planning.planning_notices import (
    MANIFEST_NEWER,
    PORT_IN_USE,
    RECORDING_CHANGED,
    RECORDING_MOVED,
    RESULTS_WITHOUT_RECORDING,
)
from fusion.planning.view.extremes import Extremes
from fusion.planning.view.manifest_edit import edited
from fusion.planning.view.server import LONGEST, Server, redirect_file
from fusion.planning.view.view_requests import api_actions, api_handlers
from fusion.planning.view.view_sources import find_sources
from fusion.planning.view.viewed_recording import ViewSession
from fusion.recording.load import load_manifest
from fusion.report.folder import hash_files
from fusion.report.recording_report import write_results
from photogram.images.sequence import ImageSequence
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.track import lay_stereo_grid
from shaker.io import read_channels

NASTY = "</script><b>\"'&\u2028 <!-- name"


class Client:
    """Asks a server."""

    def __init__(self, server: Server) -> None:
        self.server, self.path = server, urlsplit(server.address).path

    def raw(self, path: str, host: str | None = None) -> tuple[int, dict[str, str], bytes]:
        connection = HTTPConnection("127.0.0.1", self.server.server_port, timeout=30)
        connection.request("GET", path, headers={} if host is None else {"Host": host})
        answer = connection.getresponse()
        found = answer.status, dict(answer.getheaders()), answer.read()
        connection.close()
        return found

    def post(self, what: str, asked: Any, token: str = "", **heads: str | None) -> tuple[int, Any]:
        origin = f"http://127.0.0.1:{self.server.server_port}"
        sent = {"Origin": origin, "Content-Type": "application/json", **heads}
        connection = HTTPConnection("127.0.0.1", self.server.server_port, timeout=30)
        path = f"/{token}/" if token else self.path
        known = {name: value for name, value in sent.items() if value is not None}
        connection.request("POST", f"{path}api/{what}", json.dumps(asked).encode(), known)
        answer = connection.getresponse()
        status, body = answer.status, answer.read()
        connection.close()
        return status, json.loads(body) if answer.getheader("Content-Type") == "application/json" else body

    def ask(self, what: str, **asked: Any) -> Any:
        status, heads, body = self.raw(f"{self.path}api/{what}?{urlencode(asked)}")
        if heads["Content-Type"] == "application/json":
            return json.loads(body) | ({} if status == 200 else {"status": status})
        return body


def numbers(body: bytes) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Take an answer in numbers apart, by its description."""
    (length,) = struct.unpack("<Q", body[:8])
    head = json.loads(body[8 : 8 + length])
    values = np.frombuffer(body[8 + length :], "<f8")
    return head, np.split(values, np.cumsum(head["lengths"])[:-1])


def picture(body: bytes) -> tuple[dict[str, Any], np.ndarray]:
    """Take an image apart, by the description of its format."""
    (length,) = struct.unpack("<Q", body[:8])
    head = json.loads(body[8 : 8 + length])
    grey = np.frombuffer(body[8 + length :], {8: "u1", 16: "<u2"}[head["bits"]])
    return head, grey.reshape(head["height"], head["width"])


@contextmanager
def served(path: Path, recording: Path | None = None) -> Iterator[Client]:
    viewed = ViewSession(find_sources(path, recording))
    server = Server(api_handlers(viewed), 0, api_actions(viewed))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield Client(server)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(scope="module")
def client(demo_recording: Path) -> Iterator[Client]:
    with served(demo_recording) as found:
        yield found


def test_only_who_knows_the_token_is_answered(client, demo_recording):
    assert client.server.server_address[0] == "127.0.0.1"
    assert client.raw(client.path)[0] == 200
    for path in ("/", "/api/sources", "/wrong/", f"{client.path[:-2]}/", "//", "/%C3%A9/"):
        status, _, body = client.raw(path)
        assert status == 403
        assert client.server.token.encode() not in body
    assert client.raw(client.path + "x" * LONGEST)[0] == 403
    with served(demo_recording) as other:
        assert other.server.token != client.server.token


def test_only_this_machines_own_address_is_answered(client):
    port = client.server.server_port
    assert client.raw(client.path, f"localhost:{port}")[0] == 200
    for host in (
        "example.org",
        f"example.org:{port}",
        "127.0.0.1",
        f"127.0.0.1:{port + 1}",
        f"127.0.0.1.example.org:{port}",
    ):
        assert client.raw(client.path, host)[0] == 403


def test_the_page_may_run_its_own_programs_only(client):
    _, heads, _ = client.raw(client.path)
    policy = dict(part.strip().split(" ", 1) for part in heads["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["connect-src"] == "'self'"
    assert heads["X-Content-Type-Options"] == "nosniff"
    assert heads["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "Access-Control-Allow-Origin" not in heads
    for name in ("../server.py", "..%2fserver.py", "/etc/passwd", "%00"):
        assert client.raw(client.path + name)[0] == 404


@pytest.mark.parametrize(
    ("what", "asked"),
    [
        ("frame", {"pair": 0, "side": 0, "frame": 24}),
        ("frame", {"pair": 7, "side": 0, "frame": 0}),
        ("frame", {}),
        ("frame", {"pair": "<b>", "side": 0, "frame": 0}),
        ("signal", {"channels": "0", "from": "nan"}),
        ("signal", {"channels": "0", "to": "inf"}),
        ("epipolar", {"pair": 0, "side": 0, "x": "nan", "y": 0}),
        ("track", {"pair": 0, "point": 0}),
        ("recording", {"recording": 5}),
    ],
)
def test_what_cannot_be_answered_is_told_in_a_sentence(client, what, asked):
    found = client.ask(what, **asked)
    assert found["status"] == 400
    assert found["error"]
    assert "\n" not in found["error"]


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_columns_have_the_extremes_of_their_samples(data):
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    samples = rng.standard_normal(data.draw(st.sampled_from([2, 65, 1000, 33_333, 400_001])))
    extremes = Extremes(samples)
    first = data.draw(st.integers(-5, len(samples) + 5))
    last = data.draw(st.integers(-5, len(samples) + 5))
    most = data.draw(st.integers(1, 500))
    found = extremes.columns(first, last, most)
    assert 1 <= len(found.low) <= 2 * most
    for i, (begin, end) in enumerate(pairwise(found.edge)):
        assert (found.low[i], found.high[i]) == (samples[begin:end].min(), samples[begin:end].max())
    if 0 <= first < last <= len(samples):
        assert found.edge[0] <= first
        assert found.edge[-1] >= last
        width = (last - first) / most
        assert max(first - found.edge[0], found.edge[-1] - last) <= max(width, 1)


def test_a_zoom_shows_every_peak_of_the_file(client, demo_recording):
    told = client.ask("recording")
    names = [channel["name"] for channel in told["channels"]]
    chosen = [names.index("Fz"), names.index("velocity_1")]
    _, arrays = numbers(
        client.ask("signal", channels=",".join(map(str, chosen)), columns=100, **{"from": 0.2, "to": 0.5})
    )
    for place, (file, scale) in enumerate((("bridge.h5", 1e-3), ("vibrometer.h5", 0.1))):
        raw = read_channels(demo_recording / "Fz-0080" / file)[("Fz", "velocity_1")[place]]
        edge, low, high = arrays[3 * place : 3 * place + 3]
        whole = np.rint(edge * raw.sample_rate_hz).astype(int)
        parts = [scale * raw.samples[a:b] for a, b in pairwise(whole)]
        np.testing.assert_allclose(low, [part.min() for part in parts], rtol=1e-12)
        np.testing.assert_allclose(high, [part.max() for part in parts], rtol=1e-12)
        assert edge[0] <= 0.2
        assert edge[-1] >= 0.5


def test_pictures_are_those_of_the_files(client, demo_recording):
    head, shown = picture(client.ask("frame", pair=0, side=1, frame=3))
    stored = cv2.imread(str(demo_recording / "Fz-0080" / "top-right" / "0003.tif"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shown, stored)
    assert (head["full"], head["refused"]) == (1023, None)
    assert client.ask("recording")["pairs"][0]["cameras"][1]["size"] == [head["width"], head["height"]]


def test_the_beat_orders_frames_by_the_phase_of_the_line(client, demo_recording):
    pair = client.ask("recording")["pairs"][0]
    assert "run" in pair["missing"]
    (hz,) = pair["beats"]
    assert hz == 80.0
    step = np.diff(pair["times"])
    np.testing.assert_allclose(step, step[0], rtol=1e-9)
    turned = np.exp(2j * np.pi * np.diff(pair["phases"][0]))
    np.testing.assert_allclose(turned, np.exp(2j * np.pi * 80.0 * step[0]), atol=1e-6)


def test_the_line_in_the_other_picture_goes_through_the_same_point(client, demo_results, demo_recording):
    with served(demo_results, demo_recording) as viewed:
        seen = viewed.ask("subsets", pair=0, frame=0)
        for point in (0, 50, len(seen["left"]) - 1):
            x, y = seen["left"][point]
            line = np.array(viewed.ask("epipolar", pair=0, side=0, x=x, y=y)["right"])
            place = np.array(seen["right"][point])
            near = line[np.argsort(np.linalg.norm(line - place, axis=1))[:2]]
            along = (near[1] - near[0]) / np.linalg.norm(near[1] - near[0])
            away = place - near[0]
            assert abs(along[0] * away[1] - along[1] * away[0]) < 0.02


def test_subsets_stand_where_they_were_tracked(demo_results, demo_recording, demo_evaluation):
    with served(demo_results, demo_recording) as viewed:
        told = viewed.ask("recording")["pairs"][0]
        assert "--save-points" in told["missing"]
        (stereo,) = (one for one in demo_evaluation.stereo if one.name == "top")
        first = np.array(viewed.ask("subsets", pair=0, frame=0)["left"])
        assert np.abs(first - stereo.subsets_px).max() < 0.05
        _, arrays = numbers(viewed.ask("track", pair=0, point=40))
        z = arrays[3]
        pose = stereo.motion.pose[:, 2]
        assert np.corrcoef(z, pose)[0, 1] > 0.999
        found = viewed.ask("phasors", line=0)["panels"]
        assert {"load-fused", "load-vibrometer"} <= {one["name"] for panel in found for one in panel["values"]}


def test_region_and_mask_are_read_and_leave_subsets_inside(tmp_path, demo_recording):
    shutil.copytree(demo_recording, tmp_path / "demo")
    file = tmp_path / "demo" / "Fz-0080" / "recording.toml"
    text = file.read_text(encoding="utf-8")
    lines = "region = [60, 40, 180, 150]\nmask = [[120, 90, 50, 40]]\n"
    file.write_text(text.replace('stereo = "top"\n', f'stereo = "top"\n{lines}', 1), encoding="utf-8")
    entry = load_manifest(file).images[0]
    assert (entry.region, entry.mask) == ((60, 40, 180, 150), ((120, 90, 50, 40),))
    for wrong in ("[1, 2, 3]", "[0, 0, 0, 5]", "[-1, 0, 5, 5]", "[0.5, 0, 5, 5]", '"all"', "[true, 0, 5, 5]"):
        file.write_text(text.replace('stereo = "top"\n', f'stereo = "top"\nregion = {wrong}\n', 1), encoding="utf-8")
        with pytest.raises(InputError, match=r"images\.top\.region: .*\[x, y, width, height\]"):
            load_manifest(file)


def test_no_subset_lies_outside_the_region_or_in_a_mask():
    rng = np.random.default_rng(3)
    picture = cv2.normalize(
        cv2.GaussianBlur(rng.standard_normal((200, 240)), (0, 0), 1.8), None, 20, 230, cv2.NORM_MINMAX
    )
    picture = picture.astype(np.uint8)
    images = ImageSequence(("one", "two"), (240, 200), 255, lambda _: picture)
    settings = TrackSettings(7, region=(40, 30, 150, 120), mask=((90, 70, 30, 30),))
    grid = lay_stereo_grid(images, images, None, settings)
    x, y = grid.left_px.T
    reach = 7
    assert len(x) > 20
    assert (x - reach >= 40).all()
    assert (x + reach < 190).all()
    assert (y - reach >= 30).all()
    assert (y + reach < 150).all()
    assert not ((np.abs(x - 104.5) < 15 + reach) & (np.abs(y - 84.5) < 15 + reach)).any()
    assert not grid.areas[1][70:100, 90:120].any()


def test_wrong_input_is_one_sentence(tmp_path, refused, demo_recording):
    assert str(tmp_path / "none") in refused("view", tmp_path / "none", "--no-browser")
    with served(demo_recording) as other:
        port = str(other.server.server_port)
        assert f"{PORT_IN_USE.code} --port" in refused("view", demo_recording, "--no-browser", "--port", port)


@pytest.mark.usefixtures("no_pages")
def test_results_find_their_recording(tmp_path, demo_recording, demo_evaluation, refused):
    """By its place, from another folder by the absolute path, both moved together by the relative one."""
    home = tmp_path / "home"
    shutil.copytree(demo_recording, home / "campaign")
    manifest = load_manifest(home / "campaign" / "Fz-0080")
    write_results(replace(demo_evaluation, manifest=manifest), home / "out" / "any name")
    (source,) = find_sources(home / "out" / "any name")
    assert source.recording == manifest.path.resolve()
    shutil.copytree(home / "out" / "any name", tmp_path / "elsewhere" / "results")
    assert find_sources(tmp_path / "elsewhere" / "results")[0].recording == manifest.path.resolve()
    home.rename(tmp_path / "moved")
    (source,) = find_sources(tmp_path / "moved" / "out" / "any name")
    assert source.recording == tmp_path / "moved" / "campaign" / "Fz-0080" / "recording.toml"
    sentence = refused("view", tmp_path / "elsewhere" / "results", "--no-browser")
    assert RECORDING_MOVED.code in sentence
    assert str(manifest.path) in sentence
    assert "--recording" in (RECORDING_MOVED.remedy or "")
    found = find_sources(tmp_path / "elsewhere" / "results", tmp_path / "moved" / "campaign")
    assert found[0].results == tmp_path / "elsewhere" / "results"


@pytest.mark.usefixtures("no_pages")
def test_another_recording_at_the_same_place_is_not_taken(tmp_path, demo_recording, demo_evaluation):
    shutil.copytree(demo_recording, tmp_path / "campaign")
    manifest = load_manifest(tmp_path / "campaign" / "Fz-0080")
    write_results(replace(demo_evaluation, manifest=manifest), tmp_path / "out")
    text = manifest.path.read_text(encoding="utf-8")
    manifest.path.write_text(text.replace(f'name = "{manifest.name}"', 'name = "another"', 1), encoding="utf-8")
    with pytest.raises(InputError) as error:
        find_sources(tmp_path / "out")
    assert error.value.code == RECORDING_MOVED.code


@pytest.mark.usefixtures("no_pages")
def test_a_manifest_that_is_newer_than_the_results_is_named(tmp_path, demo_recording, demo_evaluation):
    shutil.copytree(demo_recording, tmp_path / "campaign")
    manifest = load_manifest(tmp_path / "campaign" / "Fz-0080")
    hashes = hash_files([manifest.path], manifest.root).hashes
    write_results(replace(demo_evaluation, manifest=manifest, input_hashes=hashes), tmp_path / "out")
    with served(tmp_path / "out") as viewed:
        assert viewed.ask("recording")["errors"] == []
        manifest.path.write_text(manifest.path.read_text(encoding="utf-8") + "\n# later\n", encoding="utf-8")
        assert [one["code"] for one in viewed.ask("recording")["errors"]] == [MANIFEST_NEWER.code]


# Changes of recording.toml.


def outlines(client: Client, **changes: Any) -> dict[str, Any]:
    told = client.ask("recording")
    asked = {"recording": 0, "pair": 0, "version": told["version"], "region": None, "mask": []}
    return {**asked, **changes}


def test_outlines_are_written_and_every_other_line_stays(tmp_path, demo_recording):
    shutil.copytree(demo_recording, tmp_path / "demo")
    file = tmp_path / "demo" / "Fz-0080" / "recording.toml"
    before = file.read_bytes()
    polygon = [[100, 80], [150, 80], [120, 130]]
    with served(tmp_path / "demo") as viewed:
        status, found = viewed.post(
            "outlines", outlines(viewed, pair=1, region=[5, 6, 200, 150], mask=[[9, 9, 3, 3], polygon])
        )
        assert status == 200, found
        after = file.read_bytes()
        lines = ["region = [5, 6, 200, 150]", "mask = [[9, 9, 3, 3], [[100, 80], [150, 80], [120, 130]]]"]
        assert [line for line in after.decode().splitlines() if line not in before.decode().splitlines()] == lines
        told = viewed.ask("recording")["pairs"]
        assert (told[1]["region"], told[1]["mask"]) == ([5, 6, 200, 150], [[9, 9, 3, 3], polygon])
        assert told[0]["region"] is None
        assert load_manifest(file).images[1].mask[1] == ((100, 80), (150, 80), (120, 130))
        assert viewed.post("outlines", outlines(viewed, pair=1))[0] == 200
    assert file.read_bytes() == before


def test_a_file_that_changed_meanwhile_is_not_written(tmp_path, demo_recording):
    shutil.copytree(demo_recording, tmp_path / "demo")
    file = tmp_path / "demo" / "Fz-0080" / "recording.toml"
    with served(tmp_path / "demo") as viewed:
        asked = outlines(viewed, region=[5, 6, 200, 150])
        file.write_text(file.read_text(encoding="utf-8") + "# by hand\n", encoding="utf-8")
        before = file.read_bytes()
        status, found = viewed.post("outlines", asked)
        assert (status, found["error"].split()[0]) == (400, RECORDING_CHANGED.code)
        assert file.read_bytes() == before
        assert viewed.post("outlines", outlines(viewed, region=[5, 6, 200, 150]))[0] == 200


@pytest.mark.parametrize(
    "wrong", [{"region": [1, 2, 3]}, {"mask": [[[1, 1], [2, 2]]]}, {"region": "all"}, {"pair": 7}, {"mask": None}]
)
def test_wrong_outlines_are_not_written(wrong, tmp_path, demo_recording):
    shutil.copytree(demo_recording, tmp_path / "demo")
    file = tmp_path / "demo" / "Fz-0080" / "recording.toml"
    before = file.read_bytes()
    with served(tmp_path / "demo") as viewed:
        status, found = viewed.post("outlines", outlines(viewed, **wrong))
    assert status == 400
    assert found["error"]
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    "heads",
    [
        {"Origin": "http://example.org"},
        {"Origin": "null"},
        {"Origin": None},
        {"Content-Type": "text/plain"},
        {"Content-Type": "application/x-www-form-urlencoded"},
        {"Host": "example.org"},
        {"Content-Length": "9999999999"},
    ],
)
def test_no_other_page_changes_a_file(heads, tmp_path, demo_recording):
    shutil.copytree(demo_recording, tmp_path / "demo")
    file = tmp_path / "demo" / "Fz-0080" / "recording.toml"
    before = file.read_bytes()
    with served(tmp_path / "demo") as viewed:
        asked = outlines(viewed, region=[5, 6, 200, 150])
        assert viewed.post("outlines", asked, **heads)[0] == 403
        assert viewed.post("outlines", asked, token="x" * 32)[0] == 403
        assert viewed.raw(f"{viewed.path}api/outlines?{urlencode({'region': '[5, 6, 20, 15]'})}")[0] == 404
    assert file.read_bytes() == before


NESTED = """# head
name = "a"   # a name
[[take]]
[[take.images]]
stereo = "one"
[[take]]
[[take.images]] # second
stereo = "two"
mask = [ # boxes
  [1, 2, 3, 4], # screw

  [5, 6, 7, 8],
]
# below
[take.images.more]
x = 1
"""


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_block_of_a_take_is_edited_with_its_comments(end):
    text = NESTED.replace("\n", end)
    changed = edited(text, (2, 0), {"region": (0, 0, 9, 9), "mask": ((1, 2, 3, 4),)})
    expected = tomllib.loads(NESTED)
    expected["take"][1]["images"][0] |= {"region": [0, 0, 9, 9], "mask": [[1, 2, 3, 4]]}
    assert tomllib.loads(changed) == expected
    assert changed.count("\n") == changed.count(end)
    for comment in ("# head", "# a name", "# second", "# boxes", "# screw", "# below"):
        assert comment in changed
    assert edited(text, (1, 0), {"region": None, "mask": None}) == text


@pytest.mark.parametrize("text", ['images = [{stereo = "a"}]', "[[images]]", 'a = """\n[[images]]\n"""\nimages = [{}]'])
def test_what_cannot_be_edited_line_by_line_is_refused(text):
    if text == "[[images]]":
        assert edited(text, (0, 0), {"region": (0, 0, 9, 9)}) == "[[images]]\nregion = [0, 0, 9, 9]"
        return
    with pytest.raises(ValueError, match=r"header|tables"):
        edited(text, (0, 0), {"region": (0, 0, 9, 9)})


def test_polygons_leave_subsets_inside_and_out():
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.standard_normal((200, 240)), (0, 0), 1.8)
    grey = cv2.normalize(noise, None, 20, 230, cv2.NORM_MINMAX).astype(np.uint8)
    images = ImageSequence(("one", "two"), (240, 200), 255, lambda _: grey)
    triangle, hole = ((20, 20), (220, 20), (120, 190)), ((110, 60), (140, 60), (125, 90))
    grid = lay_stereo_grid(images, images, None, TrackSettings(7, region=triangle, mask=(hole,)))
    corners = (grid.left_px[:, None] + np.array([[-7, -7], [-7, 7], [7, -7], [7, 7]])).reshape(-1, 2)
    assert len(grid.left_px) > 10
    outline = np.array(triangle, dtype=np.float32)
    assert all(cv2.pointPolygonTest(outline, corner, True) >= -1.0 for corner in corners.tolist())
    inside = [cv2.pointPolygonTest(np.array(hole, dtype=np.float32), p, False) > 0 for p in grid.left_px.tolist()]
    assert not any(inside)
    assert not grid.areas[1][75, 125]


def test_the_browsers_command_line_has_no_token(tmp_path, client):
    file = redirect_file(tmp_path, client.server.address)
    assert client.server.token not in file.as_uri()
    assert f'url={client.server.address}"' in file.read_text(encoding="utf-8")
    if sys.platform != "win32":
        assert file.stat().st_mode & 0o777 == 0o600


@pytest.mark.skipif(sys.platform == "win32", reason="signals of another process")
def test_the_redirect_file_goes_with_the_server(tmp_path, demo_recording):
    """The browser is a program that notes its arguments."""
    browser = tmp_path / "browser"
    script = f'#!/bin/sh\ncd {tmp_path}\ncp "${{1#file://}}" page\necho "$@" > args.part\nmv args.part args\n'
    browser.write_text(script)
    browser.chmod(0o755)
    folder = tmp_path / "tmp"
    folder.mkdir()
    around = {**environment(), "BROWSER": f"{browser} %s", "TMPDIR": str(folder)}
    command = [sys.executable, "-m", "fusion.cli", "view", str(demo_recording)]
    with subprocess.Popen(command, env=around, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        wait_until((tmp_path / "args").is_file)
        arguments = (tmp_path / "args").read_text()
        assert arguments.startswith("file:")
        assert urlsplit(address).path.strip("/") not in arguments
        assert address in (tmp_path / "page").read_text()
        process.terminate()  # a shell in the background has its programs ignore SIGINT
    assert list(folder.iterdir()) == []


# In a browser.


@pytest.fixture
def opened(browser: Any) -> Iterator[Callable[..., Any]]:
    with viewer_pages(browser) as open_page:
        yield open_page


def shade(page: Any, canvas: str) -> str:
    """Return what tells one picture from another."""
    return str(page.locator(canvas).evaluate("c => c.toDataURL()"))


def test_the_slider_and_the_keys_move_the_frame(client, opened):
    page = opened(client)
    before = shade(page, "#left")
    page.locator("#frame").fill("5")
    page.wait_for_selector("body[data-frame='5']")
    assert shade(page, "#left") != before
    assert "0005.tif" in page.inner_text("#left-told")
    page.locator("h1").click()
    page.keyboard.press("ArrowRight")
    page.wait_for_selector("body[data-frame='6']")
    page.keyboard.press("ArrowLeft")
    page.wait_for_selector("body[data-frame='5']")
    page.select_option("#order", "1")
    page.locator("#frame").fill("0")
    told = client.ask("recording")["pairs"][0]["phases"][0]
    page.wait_for_selector(f"body[data-frame='{int(np.argmin(told))}']")


def test_a_region_drawn_with_the_mouse_gives_lines_that_a_recording_takes(client, opened, tmp_path, demo_recording):
    page = opened(client)
    box = page.locator("#left").bounding_box()
    factor = box["width"] / 304

    def drag(kind: str, corners: tuple[int, int, int, int]) -> None:
        page.select_option("#mouse", kind)
        x0, y0, x1, y1 = (value * factor for value in corners)
        page.mouse.move(box["x"] + x0, box["y"] + y0)
        page.mouse.down()
        page.mouse.move(box["x"] + (x0 + x1) / 2, box["y"] + y1)
        page.mouse.move(box["x"] + x1, box["y"] + y1)
        page.mouse.up()

    drag("region", (40, 30, 240, 190))
    drag("mask", (180, 120, 150, 100))
    lines = page.input_value("#lines")
    found = tomllib.loads(lines)
    np.testing.assert_allclose(found["region"], [40, 30, 200, 160], atol=1)
    np.testing.assert_allclose(found["mask"], [[150, 100, 30, 20]], atol=1)
    shutil.copytree(demo_recording, tmp_path / "demo")
    file = tmp_path / "demo" / "Fz-0080" / "recording.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace('stereo = "top"\n', f'stereo = "top"\n{lines}\n', 1), encoding="utf-8")
    assert list(load_manifest(file).images[0].region) == found["region"]
    page.click("#undo")
    assert "mask" not in page.input_value("#lines")


def test_every_tab_draws_what_it_has(demo_results, demo_recording, opened):
    with served(demo_results, demo_recording) as viewed:
        page = opened(viewed, color_scheme="dark")
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 27)"
        seen = viewed.ask("subsets", pair=0, frame=0)["left"][40]
        box = page.locator("#left").bounding_box()
        factor = box["width"] / 304
        page.mouse.click(box["x"] + (seen[0] + 0.5) * factor, box["y"] + (seen[1] + 0.5) * factor)
        page.wait_for_selector("#track[data-drawn='4']")
        assert page.evaluate("document.body.dataset.picked") == "40"
        assert re.search(r"40\b.* -?0\.\d{4} px", page.inner_text("#images-told"))
        page.click("button[data-tab=signals]")
        page.wait_for_selector("#signals-drawn[data-drawn='1'] canvas")
        page.locator("#channels input").nth(1).check()
        page.locator("#channels input").nth(2).check()
        page.wait_for_selector("#signals-drawn[data-drawn='3'] canvas")
        page.wait_for_timeout(300)
        page.evaluate("view.signals.range.setv({ start: 0.2, end: 0.3 })")
        page.wait_for_selector("#signals[data-zoom='0.2 0.3']")
        page.click("button[data-tab=spectra]")
        page.click("#name-lines")
        page.wait_for_selector("#named tr")
        assert "harmonic 2" in page.inner_text("#named")
        page.click("button[data-tab=phasors]")
        page.wait_for_selector("#phasors-drawn[data-drawn]")
        assert int(page.get_attribute("#phasors-drawn", "data-drawn")) >= 6
        assert page.inner_text("#error") == ""


def test_names_are_shown_as_text_and_campaigns_open_their_recordings(tmp_path, demo_recording, opened):
    shutil.copytree(demo_recording, tmp_path / "campaign")
    shutil.copytree(tmp_path / "campaign" / "Fz-0080", tmp_path / "campaign" / "Fz-0090 <b>&amp;'")
    file = tmp_path / "campaign" / "Fz-0090 <b>&amp;'" / "recording.toml"
    name = json.dumps(NASTY.replace("\u2028", " "))
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace('name = "Fz 80.0 Hz, simulated"', f"name = {name}", 1), encoding="utf-8")
    with served(tmp_path / "campaign") as viewed:
        page = opened(viewed, wait="body[data-opened]")
        assert page.locator("#campaign tr").count() == 2
        page.get_by_role("button", name="Fz-0090 <b>&amp;'").click()
        page.wait_for_selector("body[data-opened='1']")
        assert page.text_content("#name") == NASTY.replace("\u2028", " ")
        assert page.locator("h1 b").count() == 0


def test_results_of_another_recording_are_refused(demo_recording, tmp_path, refused):
    folder = tmp_path / "results"
    folder.mkdir()
    with h5py.File(folder / "result.h5", "w") as file:
        file.attrs["format"], file.attrs["recording"] = 2, "Fz 160 Hz"
    told = refused("view", folder, "--recording", demo_recording / "Fz-0080", "--no-browser")
    assert told.startswith(f"shakercal: {RESULTS_WITHOUT_RECORDING.code} ")
    assert "“Fz 80.0 Hz, simulated”" in told
    assert "“Fz 160 Hz”" in told
