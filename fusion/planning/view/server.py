"""Server of `shakercal view`: only for this machine, at an address with a secret token."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import suppress
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from fusion import report
from fusion.base import cleanup_on_signal
from fusion.errors import ComputeError, InputError
from fusion.planning.planning_notices import BOKEH_MISSING, PORT_IN_USE
from fusion.planning.view.view_requests import FAILURES, ApiActions, ApiHandlers, ApiResponse, api_actions, api_handlers
from fusion.planning.view.view_sources import find_sources
from fusion.planning.view.viewed_recording import ViewSession
from fusion.report.atomic_files import write_file

LOOPBACK = "127.0.0.1"
PAGE = Path(__file__).with_name("page")
FIELDS = Path(report.__file__).parent / "templates/fields.js"  # of the report as well
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
LIBRARY = ("bokeh.min.js", "bokeh-api.min.js")
# BokehJS inserts its styles as text; scripts are only loaded from files.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
LONGEST = 8192  # characters of an address; requests have some hundred
LARGEST = 1 << 20  # bytes of a request's body
JSON = "application/json"


def page_files() -> dict[str, Path]:
    """Return every file of the page by its name, including the installed drawing library."""
    files = {path.name: path for path in PAGE.iterdir() if path.suffix in KINDS}
    spec = find_spec("bokeh")
    if spec is None or not spec.submodule_search_locations:
        raise ComputeError(BOKEH_MISSING)
    scripts = Path(spec.submodule_search_locations[0]) / "server/static/js"
    return files | {FIELDS.name: FIELDS} | {name: scripts / name for name in LIBRARY}


class Server(ThreadingHTTPServer):
    """A server on the loopback address.

    `address` is that of its page, with a token that every request repeats. `actions` change files.
    """

    daemon_threads = True

    def __init__(self, handlers: ApiHandlers, port: int = 0, actions: ApiActions | None = None) -> None:
        self.handlers, self.actions = handlers, actions or {}
        self.token, self.files = secrets.token_urlsafe(24), page_files()
        try:
            super().__init__((LOOPBACK, port), Handler)
        except OSError as error:
            found = error.strerror or str(error)
            raise InputError(PORT_IN_USE, "--port", found=f"{port} ({found})", expected="a free port") from error
        self.hosts = {f"{name}:{self.server_port}" for name in (LOOPBACK, "localhost")}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error; a page that was closed meanwhile is none."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self.server_port}/{self.token}/"


class Handler(BaseHTTPRequestHandler):
    """Handler of requests: GET of files and of `api/NAME`, POST of actions."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "shakercal", ""
    timeout = 60
    disable_nagle_algorithm = True  # heads and body are two packets; the second would wait 40 ms for a receipt

    def do_GET(self) -> None:
        """Answer one request."""
        name = self._permitted_name()
        if name is None:
            return None
        kind, _, what = name.partition("/")
        if kind == "api" and what in self.server.handlers:
            query = {key: values[-1] for key, values in parse_qs(urlsplit(self.path).query).items()}
            return self._answer(lambda: self.server.handlers[what](query))
        file = self.server.files.get(unquote(name) or "index.html")
        if file is None:
            return self._send(404, "text/plain", b"no such page")
        return self._send(200, f"{KINDS[file.suffix]}; charset=utf-8", file.read_bytes())

    def do_POST(self) -> None:
        """Answer one action, which the page itself requests.

        No form or script of another page can.
        """
        name = self._permitted_name()
        if name is None:
            return None
        origin, kind = self.headers.get("Origin"), self.headers.get("Content-Type")
        length = self.headers.get("Content-Length", "")
        if origin not in {f"http://{host}" for host in self.server.hosts} or kind != JSON:
            return self._refuse("expected a request of the page itself")
        if not length.isdecimal() or int(length) > LARGEST:
            return self._refuse("expected a short request")
        body = self.rfile.read(int(length))
        kind, _, what = name.partition("/")
        if kind != "api" or what not in self.server.actions:
            return self._send(404, "text/plain", b"no such action")
        return self._answer(lambda: self.server.actions[what](_table_of(body)))

    def _permitted_name(self) -> str | None:
        """Return the name after the token; answer others with a refusal."""
        if self.headers.get("Host") not in self.server.hosts:
            self._refuse("expected the address of this machine")
            return None
        _, _, token_and_name = urlsplit(self.path).path.partition("/")
        token, _, name = token_and_name.partition("/")
        if len(self.path) > LONGEST or not secrets.compare_digest(token.encode(), self.server.token.encode()):
            self._refuse("expected the address printed by shakercal view")
            return None
        return name

    def _refuse(self, expected: str) -> None:
        self.close_connection = True  # an unread body is no further request
        self._send(403, "text/plain", expected.encode())

    def _answer(self, respond: Callable[[], ApiResponse]) -> None:
        """Answer with numbers or JSON; an error is reported in a sentence."""
        status, kind = 200, JSON
        try:
            found = respond()
            if isinstance(found, bytes):
                kind, text = "application/octet-stream", found
            else:
                text = json.dumps(found, allow_nan=False, separators=(",", ":")).encode()
        except FAILURES as error:
            text_of_error = (
                f"expected {error} in the address" if isinstance(error, KeyError) else " ".join(str(error).split())
            )
            status, text = 400, json.dumps({"error": text_of_error}).encode()
        return self._send(status, kind, text)

    def _send(self, status: int, kind: str, body: bytes) -> None:
        heads = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY,
            "Cache-Control": "no-store",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        with suppress(ConnectionError):  # the page asks for the next image meanwhile
            self.send_response(status)
            for name, value in heads.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Suppress the log: an address contains the token."""


def _table_of(body: bytes) -> Mapping[str, Any]:
    """Return the JSON object of a request."""
    found = json.loads(body)
    if not isinstance(found, dict):
        raise ValueError("expected a table of values")
    return found


def redirect_file(folder: Path, address: str) -> Path:
    """Write a page that only this user can read and that opens an address.

    The browser's command line, which every user of the machine sees, then names the file instead of the token.
    """
    path, link = folder / "open.html", escape(address)
    parts = (
        '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>shakercal view',
        f'</title><meta http-equiv="refresh" content="0; url={link}"><p><a href="{link}">shakercal view</a></p>\n',
    )
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    write_file(path, "".join(parts))
    return path


def run_view(path: Path, recording: Path | None, port: int, *, browser: bool, allow_outside: bool) -> None:
    """Serve the page until Ctrl-C."""
    viewed = ViewSession(find_sources(path, recording), allow_outside=allow_outside)
    viewed.recording({})
    with Server(api_handlers(viewed), port, api_actions(viewed)) as server:
        print(f"{server.address}\nCtrl-C ends it", flush=True)
        folder = Path(tempfile.mkdtemp(prefix="shakercal-view-"))  # of this user alone
        with cleanup_on_signal(lambda: shutil.rmtree(folder, ignore_errors=True)):
            if browser:
                webbrowser.open(redirect_file(folder, server.address).as_uri())
            server.serve_forever()
