"""The built wheel: it holds the three packages and nothing else, and works outside the clone."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {"photogram", "shaker", "fusion"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(out), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    (built,) = out.glob("shakercal-*.whl")
    return built


@pytest.mark.slow
def test_wheel_holds_the_three_packages_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == PACKAGES
    for package in PACKAGES:
        assert f"{package}/py.typed" in names
    sources = {str(path.relative_to(ROOT)) for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    assert sources <= set(names)
    assert any(name.startswith("fusion/templates/") for name in names)


@pytest.mark.slow
def test_wheel_runs_outside_the_clone(wheel: Path, demo_recording: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel)]
    subprocess.run(install, check=True, capture_output=True, text=True)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    run = [sys.executable, "-c", "import fusion; print(fusion.__file__)"]
    where = subprocess.run(run, check=True, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert where.stdout.startswith(str(site))
    command = [sys.executable, "-m", "fusion.cli"]
    said = subprocess.run(
        [*command, "--version"], check=True, capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    assert said.stdout.strip() == f"shakercal {version('shakercal')}"
    results = tmp_path / "results"
    arguments = ["run", str(demo_recording), "-o", str(results)]
    done = subprocess.run(
        [*command, *arguments], check=False, capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert (results / "sensitivity.csv").stat().st_size > 0
