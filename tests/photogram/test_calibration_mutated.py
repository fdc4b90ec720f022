"""Calibration files that are damaged or hostile: read, or refused in one sentence that names the file; never a crash.

Every format that can be written here, and samples of other programs where they are at hand, with bytes flipped, cut
off, repeated, with numbers replaced and with lists within lists. The files are read in a process of its own, since what
is looked for is also that this dies, which no test could catch.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from photogram.calibration.calibration_file import read_calibration, read_camera, write_calibration
from photogram.calibration.exchange.exchange_files import export_calibration, import_calibration
from photogram.calibration.exchange.lens import LengthUnit
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform

SECONDS = 10  # for one file
NUMBERS = (
    "1e300",
    "-1e300",
    "NaN",
    "nan",
    "inf",
    "-1",
    "0",
    "9" * 400,
    "1e-300",
    "",
    "true",
    '"x"',
    "[]",
    "{}",
    "null",
)
NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
K = np.array([[3200.5, 0, 640.25], [0, 3198.75, 511.5], [0, 0, 1.0]])
R = Rotation.from_euler("xyz", [0.4, 18.0, -0.7], degrees=True).as_matrix()
T_MM = np.array([-151.5, 1.25, 24.5])
D = [-0.08, 0.05, 1e-3, -5e-4, 0.02]
SAMPLES = ("matchid/calib.caldat", "kalibr/open_vins_euroc_kalibr_imucam_chain.yaml", "ros_camera_info/left.yaml")
SAMPLES += ("matlab_stereo/stereoParams.mat", "vic3d/cal_a.xml", "vic3d/project_xml_from_z3d.xml", "dice/cal_a.txt")
SAMPLES += ("dice/sim_dot_cal_gold.xml", "dice/cal_a_with_R.txt")


def _matlab_variables() -> dict[str, object]:
    sides = {f"{name}_{side}": value for side in ("left", "right") for name, value in _bouguet_side().items()}
    return {**sides, "om": [0.01, 0.3, 0.0], "T": T_MM, "nx": 1280, "ny": 1024}


def _bouguet_side() -> dict[str, object]:
    return {"fc": [3200.5, 3198.75], "cc": [640.25, 511.5], "kc": D, "alpha_c": 0.0}


def _kalibr() -> str:
    pose = np.vstack([np.column_stack([R, 1e-3 * T_MM]), [0, 0, 0, 1]]).tolist()
    camera = f"  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: {D[:4]}\n"
    camera += "  intrinsics: [3200.5, 3198.75, 640.25, 511.5]\n  resolution: [1280, 1024]\n"
    return f"cam0:\n{camera}cam1:\n{camera}  T_cn_cnm1: {pose}\n"


def _ros(shift: float) -> str:
    text = "image_width: 1280\nimage_height: 1024\ndistortion_model: plumb_bob\n"
    p = np.column_stack([K, [shift, 0, 0]])
    named = {"camera_matrix": K, "distortion_coefficients": np.array([D]), "rectification_matrix": np.eye(3)}
    for name, value in {**named, "projection_matrix": p}.items():
        rows, columns = value.shape
        text += f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {value.ravel().tolist()}\n"
    return text


def _written(folder: Path) -> dict[str, bytes]:
    """Return a whole file of every format that can be written here, by name."""
    camera = Camera.from_parameters(np.array([3200.5, 3198.75, 640.25, 511.5, *D]), np.array([1280, 1024]))
    plain = Camera.from_parameters(np.array([3200.5, 3198.75, 640.25, 511.5, -0.08, 0.05, 0, 0, 0]), camera.size_px)
    between = RigidTransform(R, 1e-3 * T_MM)
    rig = StereoRig(camera, camera, between, np.diag(np.full(24, 1e-6)))
    write_calibration(folder / "own.json", rig, 0.1)
    own = json.loads((folder / "own.json").read_text())
    covariance = {"parameters": ["fx", "fy"], "matrix": [[1.0, 0.5], [0.5, 1.0]]}
    mono = {key: own[key] for key in ("format", "image_size", "reprojection_rms")}
    (folder / "camera.json").write_text(json.dumps({**mono, "camera": own["left"], "covariance": covariance}))
    for name, exported in (("opencv.yml", rig), ("vic3d.xml", StereoRig(plain, plain, between)), ("matlab.json", rig)):
        export_calibration(folder / name, exported)
    for suffix in ("xml", "json"):
        storage = cv2.FileStorage(str(folder / f"storage.{suffix}"), cv2.FILE_STORAGE_WRITE)
        for name, value in {"M1": K, "D1": np.array([D]), "M2": K, "D2": np.array([D]), "R": R, "T": T_MM}.items():
            storage.write(name, value)
        storage.release()
    names = ["cx", "cy", "fx", "fy", "fs", "k1", "k2", "k3"]
    dice = "".join(
        f"{x} # {n}\n" for x, n in zip([640, 511, 3200, 3198, 0.0, -0.08, 0.05, 0.02] * 2, 2 * names, strict=True)
    )
    (folder / "dice.txt").write_text(dice + "0.4\n18\n-0.7\n-151.5\n1.25\n24.5\n1024\n1280\n")
    matchid = "".join(
        f"Cam{n}_{k};{v}\n" for n in (0, 1) for k, v in (("Fx [px]", 3200.5), ("Fy [px]", 3198.75), ("Fs", 0))
    )
    matchid += "".join(f"Cam{n}_{k};{v}\n" for n in (0, 1) for k, v in (("Cx", 640), ("Cy", 511), ("Kappa 1", -0.08)))
    (folder / "a.caldat").write_text(
        matchid + "Tx [mm];-151.5\nTy [mm];1.25\nTz [mm];24.5\nTheta [deg];0.4\nPhi [deg];18\nPsi [deg];-0.7\n"
    )
    variables = _matlab_variables()
    (folder / "bouguet.m").write_text(
        "".join(f"{n} = [ {' '.join(map(str, np.ravel(v)))} ];\n" for n, v in variables.items())
    )
    savemat(folder / "bouguet.mat", variables)
    wide = {"K1": K, "D1": np.array(D[:4]), "K2": K, "D2": np.array(D[:4]), "distortion_model": "fisheye"}
    np.savez(folder / "fisheye.npz", **wide, R=R, T=T_MM)
    (folder / "kalibr.yaml").write_text(_kalibr())
    (folder / "ros.yaml").write_text(_ros(0.0))
    with zipfile.ZipFile(folder / "vic3d.z3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(folder / "vic3d.xml", "project.xml")
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def _mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a damaged copy: one of the ways in which files break, or are made to break a reader."""
    kind = rng.integers(7)
    data = bytearray(content)
    if kind == 0:
        return bytes(data[: rng.integers(len(data))])
    if kind == 1:
        for place in rng.integers(len(data), size=rng.integers(1, 6)):
            data[place] ^= 1 << rng.integers(8)
        return bytes(data)
    if kind == 2:  # a part left out or repeated
        start, stop = sorted(rng.integers(len(data) + 1, size=2))
        return content[:start] + content[start:stop] * int(rng.choice([0, 2, 50])) + content[stop:]
    numbers = list(NUMBER.finditer(content))
    if kind in (3, 4) and numbers:
        for match in reversed([numbers[i] for i in sorted({int(rng.integers(len(numbers))) for _ in range(kind - 2)})]):
            data[match.start() : match.end()] = str(rng.choice(NUMBERS)).encode()
        return bytes(data)
    place, depth = int(rng.integers(len(data) + 1)), int(rng.choice([100, 5000, 200_000]))
    if kind == 5:  # what is nested: in lists, objects, names, dashes, elements, quotes that close nothing
        nest = rng.choice(
            np.array(["[", '{"a":', "a: ", "- ", "<a>", '["]",', "[ ']', ", "fc_left=[", "<calibration "])
        )
        return content[:place] + str(nest).encode() * depth + content[place:]
    filler = rng.choice(np.array(["\n", " ", "\t", "a", "\\", '"', "0", "\0", " %", "\u2003"]))
    return content[:place] + str(filler).encode() * depth + content[place:]


READER = """
import signal, sys
from test_calibration_mutated import read
for line in sys.stdin:
    signal.alarm(SECONDS)
    print(read(line.rstrip()), flush=True)
""".replace("SECONDS", str(SECONDS))


def _unit(name: str) -> LengthUnit | None:
    """The unit that a file's user states; this program's export for OpenCV has one."""
    return None if "opencv" in name else "mm"


def read(path: str) -> str:
    """Return what comes of a file: read, refused in one sentence of the file's name, or what must not be."""
    first, reads = Path(path), []
    ros = "ros" in first.name
    if first.name.endswith("own.json"):
        reads = [lambda: read_calibration(first)]
    elif first.name.endswith("camera.json"):
        reads = [lambda: read_camera(first)]
    else:
        unit = _unit(first.name)
        reads = [lambda: import_calibration(first, (1280, 1024), unit, first.with_name("right") if ros else None)]
        reads += [lambda: import_calibration(first.with_name("first"), (1280, 1024), None, first)] * (not ros)
    for way in reads:
        try:
            way()
        except ValueError as error:
            told = str(error)
            named = told.startswith((f"{first}: ", f"{first.with_name('first')}: ", f"{first.with_name('right')}: "))
            if not named or "\n" in told or len(told) > 700:
                return f"sentence: {told!r:.300}"
        except BaseException as error:  # what must not be
            return f"{type(error).__name__}: {error!s:.200}"
    return "good"


class Process:
    """A process that reads files; one that dies is told and replaced."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        path = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[1]), *sys.path])
        self.process = subprocess.Popen(
            [sys.executable, "-W", "error", "-c", READER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )

    def read(self, path: Path) -> str:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{path}\n")
        self.process.stdin.flush()
        told = self.process.stdout.readline().strip()
        if told:
            return told
        code = self.process.wait()
        self.start()
        return f"no end within {SECONDS} s" if code == -signal.SIGALRM else f"died with {code}"


@pytest.fixture
def process() -> Iterator[Process]:
    reader = Process()
    yield reader
    reader.process.kill()
    reader.process.communicate()


def _damage(folder: Path, whole: dict[str, bytes], process: Process, count: int, seed: int) -> list[str]:
    """Return what must not be of `count` damaged copies of each file."""
    rng, wrong = np.random.default_rng(seed), []
    damaged = folder / "damaged"
    damaged.mkdir()
    (damaged / "first").write_bytes(whole["opencv.yml"])
    (damaged / "right").write_text(_ros(-480.0))
    for name, content in whole.items():
        path = damaged / name.replace("/", "_")
        for trial in range(count):
            path.write_bytes(_mutated(content, rng))
            told = process.read(path)
            if told != "good":
                wrong.append(f"{name} {trial}: {told}")
                if "WRONG" in os.environ:
                    Path(os.environ["WRONG"], f"{trial}-{path.name}").write_bytes(path.read_bytes())
    return wrong


@pytest.mark.skipif(not hasattr(signal, "alarm"), reason="needs signals")
def test_damaged_calibrations_are_read_or_refused_in_one_sentence(tmp_path, process):
    (tmp_path / "whole").mkdir()
    whole = _written(tmp_path / "whole")
    (tmp_path / "right").write_text(_ros(-480.0))
    for name in whole:  # whole ones are read, so that damage is all that is tried
        first = tmp_path / "whole" / name
        if name == "camera.json":
            read_camera(first)
        elif name == "own.json":
            read_calibration(first)
        elif name != "ros.yaml" or _has_yaml():
            import_calibration(first, (1280, 1024), _unit(name), tmp_path / "right" if name == "ros.yaml" else None)
    assert not _damage(tmp_path, whole, process, count=12, seed=1)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "alarm"), reason="needs signals")
def test_many_damaged_calibrations_and_samples(tmp_path, process, data_dir):
    (tmp_path / "whole").mkdir()
    whole = _written(tmp_path / "whole")
    whole |= {name: (data_dir / "formats" / name).read_bytes() for name in SAMPLES if (data_dir / "formats").is_dir()}
    assert not _damage(tmp_path, whole, process, count=int(os.environ.get("DAMAGED", "30")), seed=2)


def _has_yaml() -> bool:
    return find_spec("yaml") is not None
