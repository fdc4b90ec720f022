"""Site of the documents, as `make docs` builds it: theme, commands and Python names from the program."""

from __future__ import annotations

import json
import logging
import os
import sys
from argparse import _SubParsersAction
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

ROOT = Path(__file__).resolve().parent.parent
GALLERY = ROOT / "build" / "gallery"
sys.path.insert(0, str(ROOT))

from fusion.base import __version__  # noqa: E402
from fusion.cli import _parser  # noqa: E402

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx

project, author, release = "shakercal", "the authors of shakercal", __version__
copyright = author
NOTEBOOKS = find_spec("myst_nb") is not None  # without it, notebooks are shown without output
extensions = ["myst_nb" if NOTEBOOKS else "myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
nb_execution_mode, nb_execution_timeout, nb_execution_raise_on_error = "force", 300, True
nb_merge_streams = True
source_suffix = {".md": "myst-nb" if NOTEBOOKS else "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
default_role = "code"
napoleon_google_docstring, napoleon_use_ivar = False, True
suppress_warnings = ["ref.python"]  # words of a description that are also attributes of several classes
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {
    "members": True,
    "imported-members": True,
    "undoc-members": False,
    "ignore-module-all": False,
}
autodoc_preserve_defaults = True
myst_heading_anchors = 4
myst_enable_extensions = ["attrs_inline"]
html_theme, html_title = "furo", f"shakercal {release}"  # in the header of every page
html_show_copyright, html_show_sphinx, html_copy_source = False, False, False
html_show_search_summary = False  # would fetch the pages found, which browsers refuse for files
html_extra_path = [str(GALLERY)] if GALLERY.is_dir() else []
highlight_language = "none"
nitpicky = True
nitpick_ignore_regex = [("py:(class|exc)", ".*")]  # types of NumPy and of Python


def commands() -> str:
    """Return the page of all commands with their help."""
    purpose = (
        "Help of every command, as `shakercal COMMAND --help` prints it. [Overview](../overview.md) sorts them by task."
    )
    lines = ["# Commands", "", purpose, ""]
    (all_of_them,) = (a for a in _parser()._actions if isinstance(a, _SubParsersAction))
    for name, parser in all_of_them.choices.items():
        parser.prog = f"shakercal {name}"
        text = parser.format_help()
        lines += [f"## {name}", "", "```text", text.rstrip(), "```", ""]
    return "\n".join(lines)


def links_outside(app: Sphinx, tree: nodes.document, name: str) -> None:
    """Show links to files outside of this folder as names of files of the repository."""
    from docutils import nodes
    from sphinx import addnodes

    for reference in list(tree.findall(addnodes.pending_xref)) + list(tree.findall(addnodes.download_reference)):
        target = str(reference.get("reftarget", ""))
        if target.startswith("../"):
            reference.replace_self(nodes.literal(text=target.removeprefix("../")))


def pages_of_thumbnails(app: Sphinx, tree: nodes.document) -> None:
    """Link the images of the gallery to the pages of `make gallery`."""
    from docutils import nodes

    for image in list(tree.findall(nodes.image)):
        path = Path(image["uri"])
        page = f"pages/{path.stem}.html"
        if path.parent.name == "gallery" and (GALLERY / page).exists():
            link = nodes.reference(refuri=page)
            image.replace_self(link)
            link += image


def plain_bars(app: Sphinx, kind: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Escape bars of docstrings, as in |H|, which would be names of substitutions."""
    lines[:] = [line if "`" in line else line.replace("|", "\\|") for line in lines]


def prepare_notebooks(app: Sphinx) -> None:
    """Have a kernel of this Python that reports errors only; without myst-nb, show cells as code."""
    if NOTEBOOKS:
        folder = ROOT / "build" / "jupyter"
        kernel = folder / "kernels" / "python3" / "kernel.json"
        kernel.parent.mkdir(parents=True, exist_ok=True)
        argv = [sys.executable, "-m", "ipykernel_launcher", "--log-level=ERROR", "-f", "{connection_file}"]
        kernel.write_text(json.dumps({"argv": argv, "display_name": "Python 3", "language": "python"}))
        os.environ["JUPYTER_PATH"] = str(folder)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        logging.getLogger("traitlets").setLevel(logging.WARNING)
    else:
        from sphinx.directives.code import CodeBlock
        from sphinx.roles import code_role

        app.add_directive("code-cell", CodeBlock)
        app.add_role("nb-download", code_role)


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the generated page and connect the changes of pages."""
    path = Path(__file__).with_name("reference") / "commands.md"
    text = commands()
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
    prepare_notebooks(app)
    app.connect("autodoc-process-docstring", plain_bars)
    app.connect("doctree-read", lambda app, tree: links_outside(app, tree, ""))
    app.connect("doctree-read", pages_of_thumbnails)
    return {"parallel_read_safe": True}
