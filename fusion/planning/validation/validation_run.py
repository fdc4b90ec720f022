"""`shakercal validate`: frozen inputs computed anew and compared with references, in three formats."""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import json
import math
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from fusion.base import PROGRAM, __version__, versions
from fusion.errors import InputError
from fusion.planning.planning_notices import VALIDATION_OUTPUT
from fusion.report.atomic_files import write_files, write_together
from fusion.report.folder import render_page
from fusion.report.table import TableColumn, page_column, table
from fusion.report.terminal import print_table, print_text
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.digits import number_text, round_to_uncertainty

if TYPE_CHECKING:
    from lxml import etree

    from fusion.estimation.coverage import Polar

Inputs = Mapping[str, Any]


def sines(inputs: Inputs) -> dict[str, float]:
    """Compute the sine approximation of irregular samples below the Nyquist rate, differentiated."""
    from shaker.sine.sine_fit import fit_sines

    samples = np.array(inputs["samples_m"])[:, None]
    fit = fit_sines(np.array(inputs["time_s"]), samples, np.array(inputs["frequency_hz"]), ["z"], ["m"])
    moved = fit.phasors.differentiated(2, ["m/s^2"])
    found = {"offset": float(fit.offset[0]), "u_re 80 Hz": float(fit.phasors.u_re[0, 0])}
    for k, frequency in enumerate(inputs["frequency_hz"]):
        value = complex(fit.phasors.value[k, 0])
        found |= {f"re {frequency:g} Hz": value.real, f"im {frequency:g} Hz": value.imag}
        found[f"acceleration {frequency:g} Hz"] = float(abs(moved.value[k, 0]))
    return found


def trigger(inputs: Inputs) -> dict[str, float]:
    """Compute the edges of a camera's trigger and their periodic model."""
    from shaker.timebase.edges import find_edges
    from shaker.timebase.trigger import fit_trigger

    samples = np.frombuffer(zlib.decompress(base64.b64decode(inputs["samples"])), dtype=np.uint8).astype(float)
    fit = fit_trigger(find_edges(samples, inputs["sample_rate_hz"]))
    return {"edges": float(fit.edges), "start": fit.start_s, "period": fit.period_s}


def frames(inputs: Inputs) -> dict[str, float]:
    """Compute the displacements of subsets between two frames."""
    from photogram.bspline import spline_of_image
    from photogram.subsets.find import identity_registration
    from photogram.subsets.icgn import TrackSettings, register
    from photogram.subsets.reference import prepare_reference

    settings = TrackSettings(radius_px=inputs["radius_px"])
    first, second = (spline_of_image(_image(inputs, name), settings.degree) for name in ("first", "second"))
    reference = prepare_reference(first, np.array(inputs["centre_px"]), settings.radius_px, settings.shape_order)
    warp = register(reference, second, identity_registration(reference).warp, settings).warp
    columns = {"u": 0, "v": 3}
    return {f"{n} of subset {i + 1}": float(row[c]) for i, row in enumerate(warp) for n, c in columns.items()}


def _image(inputs: Inputs, name: str) -> FloatArray:
    grey = np.frombuffer(zlib.decompress(base64.b64decode(inputs[name])), dtype="<u2")
    return grey.reshape(inputs["side"], inputs["side"]).astype(np.float64)


def cameras(inputs: Inputs) -> dict[str, float]:
    """Compute points projected into a camera with distortion, and triangulated from two."""
    from photogram.camera import Camera, StereoRig, triangulate
    from photogram.geometry import RigidTransform

    size = np.array([1280, 1024])
    left, right = (Camera.from_parameters(np.array(inputs[name]), size) for name in ("left", "right"))
    pose = RigidTransform(np.array(inputs["rotation"]), np.array(inputs["translation_m"]))
    pixels = [np.array(inputs[name])[None] for name in ("left_px", "right_px")]
    points = triangulate(StereoRig(left, right, pose), *pixels).position_m[0]
    seen = left.project(np.array(inputs["point_m"]))
    found = {f"{a} of point {i + 1}": float(v) for i, row in enumerate(points) for a, v in zip("xyz", row, strict=True)}
    at = {f"left {a} of point {i + 1}": float(v) for i, row in enumerate(seen) for a, v in zip("xy", row, strict=True)}
    return found | at


def step(inputs: Inputs) -> dict[str, float]:
    """Compute the fit of a release, and the figures of a system by its poles."""
    from shaker.lti.indices import indices
    from shaker.lti.system import LinearSystem
    from shaker.release.record import StepRecord
    from shaker.release.step_fit import fit_step

    samples, rate, size = np.array(inputs["samples"])[None], inputs["sample_rate_hz"], inputs["amplitude_n"]
    model = fit_step(StepRecord("line 1", ("Fz",), "V", samples, rate, "Fz", size), "Fz").model
    omega = 2.0 * np.pi * inputs["frequency_hz"]
    system = LinearSystem.from_coefficients(
        np.array([omega**2]), np.array([1.0, 2.0 * inputs["damping"] * omega, omega**2])
    )
    figures = indices(system)
    found = {
        "overshoot": figures.overshoot,
        "peak gain": figures.peak_gain,
        "frequency of the peak": figures.peak_hz,
        "5 % band": figures.band_5_hz,
        "natural frequency": figures.natural_hz,
    }
    if model is None:
        raise ValueError("no model fits the record")
    return {
        "frequency of the record": float(model.frequency_hz[0]),
        "damping ratio of the record": float(model.damping_ratio[0]),
        **{name: np.nan if value is None else float(value) for name, value in found.items()},
    }


def rotation(inputs: Inputs) -> dict[str, float]:
    """Compute weight and first moment of a body rotated in gravity."""
    from shaker.static_rotation.masses import fit_weights
    from shaker.static_rotation.weight_model import SensorOutputs, head_record

    amplitude = _complex(inputs, "amplitude")
    axis, down = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    record = head_record("weight", amplitude, inputs["variance"] * np.eye(12), 20.0, axis, down)
    value = fit_weights([record], SensorOutputs(np.array(inputs["sensitivity"]), np.zeros((6, 6)))).value
    names = ("weight", *(f"first moment {axis}" for axis in "xyz"))
    return dict(zip(names, value[:4].tolist(), strict=True))


def _complex(inputs: Inputs, name: str) -> ComplexArray:
    return np.asarray(np.array(inputs[f"{name}_re"]) + 1j * np.array(inputs[f"{name}_im"]))


def matrix(inputs: Inputs) -> dict[str, float]:
    """Compute the 6 × 6 matrix from eight recordings of known loads."""
    from fusion.campaign.excited_line import ExcitedLine
    from fusion.campaign.matrix import fit_matrix
    from fusion.estimation.uncertainty import Contribution, Uncertainty
    from shaker.labels import LOAD_COMPONENTS

    loads, outputs = _complex(inputs, "load"), _complex(inputs, "output")
    load_uncertainty = Uncertainty((Contribution("noise", "A", 1e-24 * np.eye(12)[None]),), ())
    noise = Uncertainty((Contribution("noise", "A", inputs["u_output"] ** 2 * np.eye(12)[None]),), ())
    facts = 100.0, 100.0, (0.0, 0.0, 1.0)
    drives = [
        ExcitedLine(f"run {n}", str(n), *facts, load, load_uncertainty, output, noise, LOAD_COMPONENTS)
        for n, (load, output) in enumerate(zip(loads, outputs, strict=True))
    ]
    value = fit_matrix(drives).value
    found: dict[str, float] = {}
    for i, channel in enumerate(LOAD_COMPONENTS):
        for j in (i, (i + 1) % 6):
            name = f"{channel}/{LOAD_COMPONENTS[j]}"
            found |= {f"re {name}": float(value[i, j].real), f"im {name}": float(value[i, j].imag)}
    return found


def certificate(inputs: Inputs) -> dict[str, float]:
    """Compute coverage factors, magnitude and phase, rounding, and the numbers in the XML."""
    from fusion.estimation.coverage import coverage_factor, polar, region_factor

    found = {"k of infinite degrees of freedom": coverage_factor(np.inf)}
    for dof in inputs["dof"]:
        found |= {
            f"k of {dof:g} degrees of freedom": coverage_factor(dof),
            f"region factor of {dof:g}": float(region_factor(dof)),
        }
    stated = polar(complex(*inputs["value"]), np.array(inputs["covariance"]))
    texts = sum(
        f"({round_to_uncertainty(value, expanded).scaled})" == text for value, expanded, text in inputs["rounding"]
    )
    return found | {
        "magnitude": stated.magnitude,
        "phase": stated.phase_rad,
        "u of the magnitude": stated.u_magnitude,
        "u of the phase": stated.u_phase_rad,
        "texts rounded as JCGM 100, 7.2.6 asks": float(texts),
        **_in_xml(stated, inputs),
    }


def _in_xml(stated: Polar, inputs: Inputs) -> dict[str, float]:
    """Return the numbers in a certificate's XML, of one sensitivity and one mass."""
    from lxml import etree

    from fusion.campaign.recording_results import SensorFacts
    from fusion.sensor.certificate.certificate_content import Certificate, CertifiedElement, CertifiedValue
    from fusion.sensor.certificate.certificate_form import Form
    from fusion.sensor.certificate.certificate_inputs import CertifiedNumber, NumberList
    from fusion.sensor.certificate.certificate_xml import DCC, SI, certificate_xml

    k, mass = stated.k, inputs["mass"]
    value = CertifiedValue(
        80.0, stated, k * stated.u_magnitude, stated.k_phase * stated.u_phase_rad, k, stated.k_phase, True
    )
    named = ("", "", ("Fz",), "V/V", "on_load", None, None, 0.0)
    found = Certificate(
        form=Form(format=1), title="", rig_path=Path("rig.toml"), sensor=SensorFacts(*named), recordings=(),
        begin=date(2026, 1, 1), end=date(2026, 1, 1), procedure="", conditions=(), sources=(),
        elements=(CertifiedElement("Fz", "Fz", "V/V", "element", True, (value,)),),
        numbers=(NumberList("masses", (CertifiedNumber("mass", "mass", mass[0], k * mass[1], k, "kg"),)),),
        warnings=(), not_assessed=(), versions={},
    )  # fmt: skip
    result = etree.fromstring(certificate_xml(found, b"")).iterfind(f".//{{{DCC}}}data/{{{DCC}}}list/{{{DCC}}}quantity")
    frequency, size, turn, complex_value, single = (list(quantity.iter(f"{{{SI}}}*")) for quantity in result)

    def numbers(quantity: list[etree._Element], *ends: str) -> list[float]:
        """Texts of elements whose names begin so, in the order of the document."""
        leaves = [e for e in quantity if any(etree.QName(e).localname.startswith(end) for end in ends) and not len(e)]
        return [float(str(e.text)) for e in leaves]

    names = ["frequency", "magnitude", "U of the magnitude", "k", "phase", "U of the phase", "real part"]
    names += ["imaginary part", "variance, re", "covariance", "covariance again", "variance, im", "factor"]
    names += ["mass", "U of the mass"]
    values_found = [
        *numbers(frequency, "value"), *numbers(size, "value", "coverageFactor"), *numbers(turn, "value"),
        *numbers(complex_value, "value", "coverageFactor"), *numbers(single, "value"),
    ]  # fmt: skip
    return {f"XML: {name}": number for name, number in zip(names, values_found, strict=True)}


CASES: dict[str, Callable[[Inputs], dict[str, float]]] = {
    case.__name__: case for case in (sines, trigger, frames, cameras, step, rotation, matrix, certificate)
}


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
    page_column("largest deviation / tolerance", lambda case: "–" if case.failure else number_text(case.worst, 2)),
    page_column("reference by", lambda case: case.source, "l"),
    page_column("result", lambda case: "passed" if case.passed else case.failure or "FAILED", "l"),
]
QUANTITIES: list[TableColumn[QuantityComparison]] = [
    page_column("case", lambda found: found.case, "l"),
    page_column("quantity", lambda found: found.quantity, "l"),
    page_column("found", lambda found: f"{found.found:.12g}"),
    page_column("reference", lambda found: f"{found.expected:.12g}"),
    page_column("deviation", lambda found: number_text(found.deviation, 2)),
    page_column("tolerance", lambda found: number_text(found.tolerance, 2)),
    page_column("unit", lambda found: found.unit, "l"),
    page_column("result", lambda found: "passed" if found.passed else "FAILED", "l"),
]


def print_validation(found: Validation) -> None:
    """Print the table and the installation."""
    title = f"Validation of {PROGRAM} {__version__}: {'passed' if found.passed else 'FAILED'}"
    rows = [[column.cell(case) for column in COLUMNS] for case in found.cases]
    print_table(title, [str(column.head) for column in COLUMNS], "".join(column.align for column in COLUMNS), [rows])
    installation = found.installation
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
