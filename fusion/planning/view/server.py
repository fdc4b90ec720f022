"""Server of `shakercal view`: only for this machine, at an address with a secret token."""

from __future__ import annotations

import json
import secrets
import webbrowser
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np

from fusion.errors import ComputeError, InputError
from fusion.estimation.uncertainty import polar_elements
from fusion.planning.lines import lines_of_recording
from fusion.planning.planning_notices import BOKEH_MISSING, PORT_IN_USE
from fusion.planning.view.viewed_recording import (
    SubsetViews,
    ViewedRecording,
    ViewSession,
    ViewSource,
    find_sources,
    table,
)
from fusion.recording.toml import read_toml
from shaker.lines.spectrum import amplitude_spectrum

LOOPBACK = "127.0.0.1"
PAGE = Path(__file__).with_name("page")
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
LIBRARY = ("bokeh.min.js", "bokeh-api.min.js")
# BokehJS inserts its styles as text; scripts are only loaded from files.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
LONGEST = 8192  # characters of an address; requests have some hundred
ApiResponse = bytes | Mapping[str, Any]
ApiHandlers = Mapping[str, Callable[[Mapping[str, str]], ApiResponse]]


def page_files() -> dict[str, Path]:
    """Return every file of the page by its name, including the installed drawing library."""
    files = {path.name: path for path in PAGE.iterdir() if path.suffix in KINDS}
    spec = find_spec("bokeh")
    if spec is None or not spec.submodule_search_locations:
        raise ComputeError(BOKEH_MISSING)
    scripts = Path(spec.submodule_search_locations[0]) / "server/static/js"
    return files | {name: scripts / name for name in LIBRARY}


class Server(ThreadingHTTPServer):
    """A server on the loopback address.

    `address` is that of its page, with a token that every request repeats.
    """

    daemon_threads = True

    def __init__(self, handlers: ApiHandlers, port: int = 0) -> None:
        self.handlers, self.token, self.files = handlers, secrets.token_urlsafe(24), page_files()
        try:
            super().__init__((LOOPBACK, port), Handler)
        except OSError as error:
            found = error.strerror or str(error)
            raise InputError(PORT_IN_USE, "--port", found=f"{port} ({found})", expected="a free port") from error
        self.hosts = {f"{name}:{self.server_port}" for name in (LOOPBACK, "localhost")}

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self.server_port}/{self.token}/"


class Handler(BaseHTTPRequestHandler):
    """Handler of GET requests: files of the page, and `api/NAME` with a query."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "shakercal", ""
    timeout = 60

    def do_GET(self) -> None:
        """Answer one request."""
        if self.headers.get("Host") not in self.server.hosts:
            return self._send(403, "text/plain", b"expected the address of this machine")
        where = urlsplit(self.path)
        _, _, token_and_name = where.path.partition("/")
        token, _, name = token_and_name.partition("/")
        if len(self.path) > LONGEST or not secrets.compare_digest(token.encode(), self.server.token.encode()):
            return self._send(403, "text/plain", b"expected the address printed by shakercal view")
        kind, _, what = name.partition("/")
        if kind == "api" and what in self.server.handlers:
            return self._answer(what, {key: values[-1] for key, values in parse_qs(where.query).items()})
        file = self.server.files.get(unquote(name) or "index.html")
        if file is None:
            return self._send(404, "text/plain", b"no such page")
        return self._send(200, f"{KINDS[file.suffix]}; charset=utf-8", file.read_bytes())

    def _answer(self, what: str, query: Mapping[str, str]) -> None:
        """Answer with numbers or JSON; an error is reported in a sentence."""
        status, kind = 200, "application/json"
        try:
            found = self.server.handlers[what](query)
            if isinstance(found, bytes):
                kind, text = "application/octet-stream", found
            else:
                text = json.dumps(found, allow_nan=False, separators=(",", ":")).encode()
        except (InputError, ComputeError, OSError, ValueError, ArithmeticError, LookupError) as error:
            text_of_error = (
                f"expected {error} in the address" if isinstance(error, KeyError) else " ".join(str(error).split())
            )
            status, text = 400, json.dumps({"error": text_of_error}).encode()
        return self._send(status, kind, text)

    def _send(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        heads = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY,
            "Cache-Control": "no-store",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        for name, value in heads.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Suppress the log: an address contains the token."""


MOST_COLUMNS, MOST_BINS = 4000, 4000  # more than the pixels of a screen
Query = Mapping[str, str]


def api_handlers(viewed: ViewSession) -> ApiHandlers:
    """Return the function for each request of the page, by its name."""

    def number(query: Query, name: str) -> int:
        return int(query[name])

    def subsets(query: Query) -> SubsetViews:
        return viewed.recording(query).subset_views

    return {
        "sources": lambda _: {"recordings": [overview(one) for one in viewed.sources]},
        "recording": lambda query: description(viewed.recording(query)),
        "frame": lambda query: (
            viewed.recording(query)
            .pairs[number(query, "pair")]
            .image_bytes(number(query, "side"), number(query, "frame"))
        ),
        "subsets": lambda query: subsets(query).frame(number(query, "pair"), number(query, "frame")),
        "epipolar": lambda query: subsets(query).epipolar(
            number(query, "pair"), number(query, "side"), (float(query["x"]), float(query["y"]))
        ),
        "track": lambda query: subsets(query).track(number(query, "pair"), number(query, "point")),
        "signal": lambda query: signal(viewed.recording(query), query),
        "spectrum": lambda query: spectrum(viewed.recording(query), number(query, "channel")),
        "lines": lambda query: lines(viewed.recording(query)),
        "phasors": lambda query: phasors(viewed.recording(query), number(query, "line")),
    }


def description(viewed: ViewedRecording) -> Mapping[str, Any]:
    """Return the data that the page needs first, with the lines of the results."""
    found = viewed.description()
    pairs = [{**pair, **viewed.subset_views.description(number)} for number, pair in enumerate(found["pairs"])]
    lines: list[float] = next((one.frequency_hz.tolist() for one in viewed.accelerations.values()), [])
    return {**found, "pairs": pairs, "resultLines": lines}


def overview(source: ViewSource) -> Mapping[str, str]:
    """Return a row of the campaign's table, from the text of the recording's manifest alone."""
    name = source.recording.parent.name
    try:
        text = read_toml(source.recording)
    except InputError as error:
        return {"name": name, "excitation": str(error), "images": "", "channels": "", "results": ""}
    excitation = text.get("excitation")
    stated = excitation if isinstance(excitation, dict) else {}
    listed = stated.get("frequencies")
    hz = (
        ", ".join(f"{value:g}" for value in listed if isinstance(value, int | float))
        if isinstance(listed, list)
        else ""
    )
    blocks = text.get("daq") if isinstance(text.get("daq"), list) else []
    channels = sum(len(block.get("channel", ())) for block in blocks or () if isinstance(block, dict))
    pairs = text.get("images")
    return {
        "name": name,
        "excitation": f"{stated.get('kind', '')} {hz}{' Hz' * bool(hz)}".strip(),
        "images": str(len(pairs) if isinstance(pairs, list) else 0),
        "channels": str(channels),
        "results": "" if source.results is None else source.results.name,
    }


def phasors(viewed: ViewedRecording, line: int) -> ApiResponse:
    """Return a panel for each component with all values at a line.

    Values have 95 % regions.
    """
    panels: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name, found in viewed.accelerations.items():
        row = polar_elements(found.value, found.uncertainty)[line]
        for e, element in enumerate(row):
            if element is None or not np.isfinite(element.region.half_axes).all():
                continue
            value = complex(found.value[line, e])
            panels.setdefault((f"{found.channel[e]} {found.component[e]}", found.unit[e]), []).append(
                {
                    "name": name,
                    "re": value.real,
                    "im": value.imag,
                    "axes": list(element.region.half_axes),
                    "angle": element.region.angle_rad,
                    "size": f"{element.magnitude:.6g} {found.unit[e]}, {np.degrees(element.phase_rad):.4g}°",
                }
            )
    text = "ellipses: 95 % regions" if panels else "Phasors require results of shakercal run."
    shown = [{"name": name, "unit": unit, "values": values} for (name, unit), values in panels.items()]
    return {"panels": shown, "told": text}


def lines(viewed: ViewedRecording) -> ApiResponse:
    """Return the lines of a recording with their origins, as `shakercal lines`."""
    found = lines_of_recording(viewed.manifest)
    rows = [
        {"frequency": one.frequency_hz, "what": one.what, "use": one.use, "floor": float(np.nan_to_num(one.floor_db))}
        for one in found.entries
    ]
    return {"lines": rows}


def spectrum(viewed: ViewedRecording, number: int) -> bytes:
    """Return the amplitude spectrum of a channel in its unit.

    Peaks of neighbouring bins are retained.
    """
    raw = viewed.raw(number)
    found = amplitude_spectrum(raw.samples, raw.sample_rate_hz, MOST_BINS)
    text = (
        f"{len(raw.samples)} samples at {raw.sample_rate_hz:g} samples/s, Hann window; the highest of neighbouring bins"
    )
    scale = abs(viewed.channels[number].entry.scale)
    return table({"told": text}, found.frequency_hz, scale * found.amplitude)


def signal(viewed: ViewedRecording, query: Query) -> bytes:
    """Return channels between two times in columns: edges in s, and extremes in the unit."""
    numbers = [int(text) for text in query["channels"].split(",")]
    most = min(max(int(query.get("columns", "1000")), 1), MOST_COLUMNS)
    arrays: list[np.typing.NDArray[Any]] = []
    for number in numbers:
        raw, scale = viewed.raw(number), viewed.channels[number].entry.scale
        rate = raw.sample_rate_hz
        begin, end = float(query.get("from", "0")), float(query.get("to", repr(len(raw.samples) / rate)))
        found = viewed.extremes(number).columns(int(begin * rate), int(np.ceil(end * rate)), most)
        low, high = (found.low, found.high) if scale >= 0 else (found.high, found.low)
        arrays += [found.edge / rate, low * scale, high * scale]
    return table({"channels": numbers}, *arrays)


def run_view(path: Path, recording: Path | None, port: int, *, browser: bool, allow_outside: bool) -> None:
    """Serve the page until Ctrl-C."""
    viewed = ViewSession(find_sources(path, recording), allow_outside=allow_outside)
    viewed.recording({})
    with Server(api_handlers(viewed), port) as server:
        print(f"{server.address}\nCtrl-C ends it", flush=True)
        if browser:
            webbrowser.open(server.address)
        server.serve_forever()
