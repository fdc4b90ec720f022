"""The rules of the house: who may import whom, and in which order."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {"photogram": {"shaker", "fusion"}, "shaker": {"photogram", "fusion"}, "fusion": set[str]()}
WRITTEN_ORDER = {
    "photogram": """
        _checks _kernel notice _inverse _pinhole rigid camera calibration_file triangulate mraw images point_tables
        interpolate lanes sampling sums noise subset search reference quality icgn follow predict
        device icgn_torch track overlap motion deformation surface cells direct measure
        target calibrate calibration_import alignment epipolar synthetic
    """,
    "shaker.signals": """
        recording files edges numbering posterior rise trigger shift clock_line sync instants pulses
        resample phasor folding separation spectrum tones noise sine stationarity
        survey frequencies chain transfer plan
    """,
    "shaker.models": """
        resonance measured weights identification suspension mass_chain sensor
        partial_fractions conversion linear_system modal indices step step_fit load_series compensation decoupling
        feedback elastomer
    """,
    "shaker.models.resonance": "line_noise oscillator noisy_curve circle peak_shape peak",
    "shaker.models.weights": "gravity harmonics turning load_mass",
    "shaker.models.sensor": """
        spring_damper chain_shape sensitivity_fit sensor_response sensor_model usable_band correction
    """,
    "fusion": """
        notices errors output console settings crew uncertainty coverage polar propagated manifest response
        elastic_joint body chain observe system estimate consistency discrepancy doubt acceleration verdict fuse
        outputs load budget sensitivity point_spread parasitic_loads deflection evaluation drive repeats linearity
        matrix interpolation curve drift scans records timing channels stereo_motion stereo_pairs stereo_phasors
        readings take referral pool takes analyse monte_carlo provenance evaluate check highlights results_csv
        results_h5 read_results camera_facts plan lines plots report_numbers report_tables consistency_tables
        budget_tables point_tables monte_carlo_tables signal_tables take_tables page report results evaluated
        camera_tables camera_report joint execution campaign campaign_summary models_file simulate progress summary
        plan_tables line_tables cameras align import_calibration transfer rotate identify step load_series
        compensate decouple elastomer commands cli
    """,
}
ORDER = {package: text.split() for package, text in WRITTEN_ORDER.items()}


def _imports(path: Path) -> list[str]:
    """Return every module that a file imports, also inside functions."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
    return found


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_packages_keep_apart(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
        tops = {name.split(".")[0] for name in _imports(path)}
        assert not tops & FORBIDDEN[package], f"{path.relative_to(ROOT)} imports {tops & FORBIDDEN[package]}"


def _module(package: str, dotted: str) -> str | None:
    """Return the first name below `package` in a dotted module name, None for other packages."""
    prefix = package + "."
    return dotted[len(prefix) :].split(".", maxsplit=1)[0] if dotted.startswith(prefix) else None


@pytest.mark.parametrize("package", sorted(ORDER))
def test_modules_import_only_backwards(package: str) -> None:
    order = {name: place for place, name in enumerate(ORDER[package])}
    folder = ROOT / package.replace(".", "/")
    for path in folder.rglob("*.py"):
        name = path.relative_to(folder).parts[0].removesuffix(".py")
        if name == "__init__":
            continue
        assert name in order, f"{path.relative_to(ROOT)} has no place in the written order of {package}"
        for other in filter(None, (_module(package, dotted) for dotted in _imports(path))):
            assert other == name or order[other] < order[name], f"{package}.{name} imports {package}.{other}"
