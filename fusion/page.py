"""A template and its context become one self-contained HTML page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from fusion.evaluation import Evaluation
from fusion.notices import AnyNotice, warnings_first
from fusion.provenance import PROGRAM, Provenance
from fusion.report_tables import inputs_table, provenance_tables


def render_page(template: str, context: Mapping[str, Any]) -> str:
    """HTML text of a template of this package; style and figures are inside, nothing is fetched from elsewhere."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["data_uri"] = data_uri
    return environment.get_template(template).render(context) + "\n"


def origin_frame(origin: Evaluation | Provenance, notices: Iterable[AnyNotice]) -> dict[str, Any]:
    """What every page shows beside its subject: notices, settings and versions, input files, the program."""
    return {
        "notices": warnings_first(notices),
        "origin": provenance_tables(origin),
        "inputs": inputs_table(origin),
        "program": f"{PROGRAM} {origin.versions.get(PROGRAM, '')}".strip(),
    }


def data_uri(svg: str) -> Markup:
    """SVG text as the source of an image element; percent encoding is shorter than base64 for text."""
    flat = re.sub(r"\s*\n\s*", " ", svg[svg.index("<svg") :]).replace('"', "'")
    return Markup("data:image/svg+xml,{}").format(Markup(quote(flat, safe=" ='/:;,.()+-_!*@?&$[]{}|~")))
