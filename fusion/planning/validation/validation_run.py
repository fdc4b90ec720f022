"""`shakercal validate`: comparison of this installation with references, in three formats."""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from fusion.base import PROGRAM, __version__, versions
from fusion.errors import InputError
from fusion.planning.planning_notices import VALIDATION_OUTPUT
from fusion.planning.validation.cases import CASES
from fusion.report.atomic_files import write_files, write_together
from fusion.report.folder import render_page
from fusion.report.table import TableColumn, page_column, table
from fusion.report.terminal import print_text, stdout_console

PACKAGES = ("shakercal", "photogram", "shaker", "fusion")
REFERENCES = Path(__file__).with_name("references.json")
JSON_FILE, PAGE_FILE = "validation.json", "validation.html"
Verdict = Literal["as installed", "changed", "not installed from a package"]


@dataclass(frozen=True)
class QuantityComparison:
    """One quantity of one case: found and expected value with tolerance."""

    case: str
    quantity: str
    found: float
    expected: float
    tolerance: float
    unit: str

    @property
    def deviation(self) -> float:
        """Found minus expected value."""
        return self.found - self.expected

    @property
    def passed(self) -> bool:
        """Whether the deviation is within the tolerance; False without a value."""
        return abs(self.deviation) <= self.tolerance

    @property
    def share(self) -> float:
        """Deviation over the tolerance."""
        return abs(self.deviation) / self.tolerance if self.tolerance else 0.0 if self.deviation == 0.0 else math.inf


@dataclass(frozen=True)
class CaseResult:
    """One case: description, source of the reference, and quantities.

    `failure`: the reason if there are none.
    """

    name: str
    what: str
    source: str
    quantities: tuple[QuantityComparison, ...]
    failure: str
    duration_s: float

    @property
    def passed(self) -> bool:
        """Whether all quantities passed."""
        return not self.failure and all(quantity.passed for quantity in self.quantities)

    @property
    def worst(self) -> float:
        """Largest deviation over its tolerance."""
        return max((quantity.share for quantity in self.quantities), default=math.inf)


@dataclass(frozen=True)
class Installation:
    """SHA-256 over all files of the packages, and whether they are unchanged since installation."""

    sha256: str
    files: int
    verdict: Verdict
    changed: tuple[str, ...]
    versions: dict[str, str]
    references_sha256: str


@dataclass(frozen=True)
class Validation:
    """Validation of an installation."""

    cases: tuple[CaseResult, ...]
    installation: Installation
    date: str

    @property
    def passed(self) -> bool:
        """Whether all cases passed and no file was changed."""
        return all(case.passed for case in self.cases) and self.installation.verdict != "changed"


def validate(references: Mapping[str, Any] | None = None) -> Validation:
    """Compute every frozen case and compare it with its reference.

    References are by default those of the package.
    """
    stated = json.loads(REFERENCES.read_text(encoding="utf-8")) if references is None else references
    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    cases = tuple(_validated(name, stated[name]) for name in CASES)
    return Validation(cases, _installation(), date)


def _validated(name: str, reference: Mapping[str, Any]) -> CaseResult:
    """Return one case; an error in its computation is a failed case."""
    began, failure, found = time.perf_counter(), "", {}
    try:
        found = CASES[name](reference["inputs"])
    except Exception as error:
        failure = f"{type(error).__name__}: {error}"
    compared = [
        QuantityComparison(
            name,
            quantity,
            found.get(quantity, math.nan),
            reference_value["value"],
            reference_value["tolerance"],
            reference_value["unit"],
        )
        for quantity, reference_value in reference["expected"].items()
    ]
    took = time.perf_counter() - began
    return CaseResult(name, reference["what"], reference["source"], tuple(compared), failure, took)


# The validated installation.


def _installation() -> Installation:
    """Hash the files of the packages and compare them with the installer's record."""
    root, total = Path(__file__).resolve().parents[3], hashlib.sha256()
    names = sorted(name.relative_to(root).as_posix() for package in PACKAGES for name in _files(root / package))
    digests = {name: hashlib.sha256((root / name).read_bytes()) for name in names}
    for name, digest in digests.items():
        total.update(f"{digest.hexdigest()}  {name}\n".encode())
    recorded = dict(_recorded(root))
    encoded = {
        name: base64.urlsafe_b64encode(digest.digest()).rstrip(b"=").decode() for name, digest in digests.items()
    }
    changed = sorted(name for name in recorded.keys() | encoded.keys() if recorded.get(name) != encoded.get(name))
    verdict: Verdict = "not installed from a package" if not recorded else "changed" if changed else "as installed"
    references = hashlib.sha256(REFERENCES.read_bytes()).hexdigest()
    changed_files = tuple(changed) if recorded else ()
    return Installation(total.hexdigest(), len(names), verdict, changed_files, versions(), references)


def _files(folder: Path) -> Iterator[Path]:
    """Return the files of a package, without caches."""
    return (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)


def _recorded(root: Path) -> Iterator[tuple[str, str]]:
    """Yield name and SHA-256 of every installed file; none for a source folder."""
    try:
        distribution = importlib.metadata.distribution(PROGRAM)
    except importlib.metadata.PackageNotFoundError:
        return
    is_installed = Path(str(distribution.locate_file(""))).resolve() == root
    for file in (distribution.files or ()) if is_installed else ():
        if file.parts[0] in PACKAGES and file.hash is not None:
            yield file.as_posix(), file.hash.value


# Results: lines of the terminal, validation.json, a page.


COLUMNS: list[TableColumn[CaseResult]] = [
    page_column("case", lambda case: case.what, "l"),
    page_column("quantities", lambda case: str(len(case.quantities))),
    page_column("largest deviation / tolerance", lambda case: "–" if case.failure else f"{case.worst:.2g}"),
    page_column("reference by", lambda case: case.source, "l"),
    page_column("result", lambda case: "passed" if case.passed else case.failure or "FAILED", "l"),
]
QUANTITIES: list[TableColumn[QuantityComparison]] = [
    page_column("case", lambda found: found.case, "l"),
    page_column("quantity", lambda found: found.quantity, "l"),
    page_column("found", lambda found: f"{found.found:.12g}"),
    page_column("reference", lambda found: f"{found.expected:.12g}"),
    page_column("deviation", lambda found: f"{found.deviation:.2g}"),
    page_column("tolerance", lambda found: f"{found.tolerance:.2g}"),
    page_column("unit", lambda found: found.unit, "l"),
    page_column("result", lambda found: "passed" if found.passed else "FAILED", "l"),
]


def print_validation(found: Validation) -> None:
    """Print the table and the installation."""
    from rich.table import Table

    shown = Table(title=f"Validation of {PROGRAM} {__version__}: {'passed' if found.passed else 'FAILED'}")
    for column in COLUMNS:
        shown.add_column(str(column.head), justify="left" if column.align == "l" else "right", overflow="fold")
    for case in found.cases:
        shown.add_row(*(column.cell(case) for column in COLUMNS))
    installation = found.installation
    stdout_console().print(shown)
    for case in found.cases:
        for quantity in (quantity for quantity in case.quantities if not quantity.passed):
            off = f"found {quantity.found:.12g}, reference {quantity.expected:.12g} ± {quantity.tolerance:.2g}"
            print_text(f"{case.name}: {quantity.quantity}: {off} {quantity.unit}")
    print_text(f"{installation.files} files of the program, SHA-256 {installation.sha256}: {installation.verdict}")
    for name in installation.changed:
        print_text(f"not as installed: {name}")
    print_text(", ".join(f"{name} {version}" for name, version in installation.versions.items()))


def validation_json(found: Validation) -> str:
    """Return all results as JSON."""
    cases = [
        {
            **{name: getattr(case, name) for name in ("name", "what", "source", "passed", "failure", "duration_s")},
            "quantities": [{**asdict(quantity), "passed": quantity.passed} for quantity in case.quantities],
        }
        for case in found.cases
    ]
    installation = {"python": sys.version, **asdict(found.installation)}
    content = {"format": 1, "passed": found.passed, "date": found.date, "installation": installation, "cases": cases}
    return json.dumps(_plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(content: Any) -> Any:
    """Return content for JSON, with null for NaN."""
    if isinstance(content, dict):
        return {name: _plain(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def render_validation(found: Validation) -> str:
    """Return the page."""
    installation = found.installation
    facts = [
        ("Result", "passed" if found.passed else "FAILED"),
        ("Date (UTC)", found.date),
        ("Files of the program", f"{installation.files}, {installation.verdict}"),
        ("SHA-256 of these", installation.sha256),
        ("SHA-256 of the references", installation.references_sha256),
        *((name, version) for name, version in installation.versions.items()),
    ]
    quantities = [quantity for case in found.cases for quantity in case.quantities]
    context = {
        "name": f"{PROGRAM} {__version__}",
        "program": f"{PROGRAM} {__version__}",
        "subject": facts,
        "changed": installation.changed,
        "cases": table("Cases", COLUMNS, found.cases),
        "quantities": table("Every quantity", QUANTITIES, quantities),
    }
    return render_page("validation.html", context)


def check_output_folder(folder: Path, *, force: bool) -> None:
    """Refuse a folder that cannot contain the files, or contains an earlier validation.

    `force` permits the replacement.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(VALIDATION_OUTPUT, folder, found="a file of this name", expected="a folder")
    for path in (folder / JSON_FILE, folder / PAGE_FILE):
        if path.exists() and not force:
            raise InputError(
                VALIDATION_OUTPUT, path, found="one", expected="no file of this name (--force replaces it)"
            )


def write_validation(folder: Path, found: Validation) -> list[Path]:
    """Write validation.json and the page into a folder, together, and replace earlier ones."""
    files = {PAGE_FILE: render_validation(found), JSON_FILE: validation_json(found)}
    return write_together(folder, lambda temporary: write_files(temporary, files), lambda: (JSON_FILE, PAGE_FILE))
