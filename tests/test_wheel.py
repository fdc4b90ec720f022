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
PACKAGES = {"shakercal", "photogram", "shaker", "fusion"}


def _pip(what: str, *arguments: object) -> None:
    command = [sys.executable, "-m", "pip", what, "--quiet", "--no-deps", *map(str, arguments)]
    subprocess.run(command, check=True, capture_output=True, text=True)


@pytest.mark.slow
def test_wheel_has_only_its_packages_and_runs_outside_the_clone(demo_recording, tmp_path):
    _pip("wheel", "--wheel-dir", tmp_path, ROOT)
    (wheel,) = tmp_path.glob("shakercal-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == PACKAGES
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file())
    wanted = {path.relative_to(ROOT).as_posix() for path in files if "__pycache__" not in path.parts}
    assert any(name.endswith("py.typed") for name in wanted)
    assert wanted <= set(names)  # templates and presets, too
    site = tmp_path / "site"
    _pip("install", "--target", site, wheel)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    outside = {"capture_output": True, "text": True, "cwd": tmp_path, "env": environment}
    run = [sys.executable, "-c", "import fusion; print(fusion.__file__)"]
    where = subprocess.run(run, check=True, **outside)
    assert where.stdout.startswith(str(site))
    command = [sys.executable, "-m", "fusion.cli"]
    said = subprocess.run([*command, "--version"], check=True, **outside)
    assert said.stdout.strip() == f"shakercal {version('shakercal')}"
    results = tmp_path / "results"
    done = subprocess.run([*command, "run", str(demo_recording), "-o", str(results)], check=False, **outside)
    assert done.returncode == 0, done.stderr
    assert (results / "sensitivity.csv").stat().st_size > 0
    judged = subprocess.run([*command, "validate"], check=True, **outside)
    assert "as installed" in judged.stdout
    (site / "shaker" / "labels.py").write_text((site / "shaker" / "labels.py").read_text() + "# changed\n")
    judged = subprocess.run([*command, "validate"], check=False, **outside)
    assert judged.returncode == 1
    assert "not as installed: shaker/labels.py" in judged.stdout
