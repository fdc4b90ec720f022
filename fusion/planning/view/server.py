"""Server of `shakercal view`: only for this machine, at an address with a secret token."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np

from fusion.errors import ComputeError, InputError
from fusion.planning.planning_notices import BOKEH_MISSING, PORT_IN_USE

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


def table(head: Mapping[str, Any], *arrays: np.typing.NDArray[Any]) -> bytes:
    """Return numbers in the page's binary format.

    The length of a head, JSON, and arrays of doubles, aligned to 8 bytes.
    """
    text = json.dumps({**head, "lengths": [array.size for array in arrays]}, allow_nan=False).encode()
    text += b" " * (-(len(text) + 8) % 8)
    body = b"".join(np.ascontiguousarray(array, dtype="<f8").tobytes() for array in arrays)
    return len(text).to_bytes(8, "little") + text + body


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
