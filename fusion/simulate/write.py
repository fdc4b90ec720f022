"""Writing of simulated recordings: manifests as TOML text, DAQ files, points, truth."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.recording.toml import to_toml
from fusion.report.atomic_files import write_file, write_files
from fusion.simulate.preset import Preset, StereoSetup, camera_pose, patches_of, region_of
from shakercal._common.arrays import FloatArray

MANIFEST_FILE, RIG_FILE, TRUTH_FILE = "recording.toml", "rig.toml", "truth.json"
COLUMNS = ("frame", "id", "x", "y", "z")
POINTS_SCALE = 1e-3  # millimetres in a table of points
_START = datetime(2018, 1, 1)


@dataclass(frozen=True, eq=False)
class Record:
    """A DAQ file: nominal rate, samples and unit of every channel, compression level."""

    sample_rate_hz: float
    samples: Mapping[str, NDArray[np.float32]]
    units: Mapping[str, str]
    gzip: int = 4


def write_recording(
    folder: Path,
    manifest: Mapping[str, Any],
    truth: Mapping[str, Any],
    records: Mapping[str, Record] | None = None,
    texts: Mapping[str, str] | None = None,
) -> Path:
    """Write the folder of a recording, which states that it is simulated, and return it."""
    folder.mkdir(parents=True)
    manifest = {"format": manifest["format"], "name": manifest["name"], "simulated": True, **manifest}
    for name, recorded in (records or {}).items():
        write_record(folder / name, recorded)
    write_files(folder, {**(texts or {}), MANIFEST_FILE: to_toml(manifest), TRUTH_FILE: json.dumps(truth)})
    return folder


def write_record(path: Path, recorded: Record) -> None:
    """Write one DAQ file by its suffix: HDF5, TDMS, or a German recorder's CSV."""
    if path.suffix == ".tdms":
        from nptdms import ChannelObject, TdmsWriter

        wave = {"wf_increment": 1 / recorded.sample_rate_hz, "wf_start_offset": 0.0, "wf_start_time": _START}
        channels = []
        for name, samples in recorded.samples.items():
            properties = {**wave, "wf_samples": len(samples), "unit_string": recorded.units[name]}
            channels.append(ChannelObject(path.stem, name, samples, properties=properties))
        stream = io.BytesIO()
        with TdmsWriter(stream) as writer:
            writer.write_segment(channels)
        write_file(path, stream.getvalue())
        return
    if path.suffix == ".csv":
        write_file(path, _german_table(recorded).encode("latin-1"))
        return
    import h5py

    from fusion.report.h5 import h5_content

    def fill(file: h5py.File) -> None:
        for name, samples in recorded.samples.items():
            data = file.create_dataset(
                name, data=samples, compression="gzip", compression_opts=recorded.gzip, shuffle=True
            )
            data.attrs["sample_rate"] = recorded.sample_rate_hz
            data.attrs["unit"] = recorded.units[name]

    write_file(path, h5_content(fill, in_order=False))


def _german_table(recorded: Record) -> str:
    """Return a preamble and a table with decimal commas; times have nine decimals."""
    rate, count = recorded.sample_rate_hz, len(next(iter(recorded.samples.values())))
    head = f"Messverstärker;Vibrometer-Rekorder\nAbtastrate;{rate:.0f} Hz\nWerte;{count}\n\n"
    names = ";".join(["Zeit [s]", *(f"{name} [{recorded.units[name]}]" for name in recorded.samples)])
    columns = [[f"{index / rate:.9f}" for index in range(count)]]
    columns += [[f"{value:.6f}" for value in samples.tolist()] for samples in recorded.samples.values()]
    table = "\n".join(map(";".join, zip(*columns, strict=True))).replace(".", ",")
    return f"{head}{names}\n{table}\n"


def points_text(position_m: FloatArray) -> str:
    """Return points (F, N, 3) as a table in mm."""
    frames, count = position_m.shape[:2]
    number = np.stack(np.meshgrid(np.arange(frames), np.arange(count), indexing="ij"), axis=-1)
    rows = np.concatenate([number, position_m / POINTS_SCALE], axis=2).reshape(-1, len(COLUMNS))
    text = "\n".join(f"{frame:.0f},{point:.0f},{x:.6f},{y:.6f},{z:.6f}" for frame, point, x, y, z in rows.tolist())
    return f"{','.join(COLUMNS)}\n{text}\n"


def complex_table(value: NDArray[np.complex128]) -> dict[str, Any]:
    """Return real and imaginary part as nested lists."""
    return {"re": value.real.tolist(), "im": value.imag.tolist()}


# Stereo pairs in manifests.

SUPPORT = "frame"  # of all cameras of a set-up


def pairs(setup: StereoSetup, preset: Preset) -> list[tuple[str, dict[str, Any]]]:
    """Return the blocks of a stereo pair and of its patch at rest."""
    keys = _stereo_keys(setup, preset)
    names = dict.fromkeys(patch.name for patch in patches_of(setup))
    support = {"support": SUPPORT} if names else {}
    return [(setup.name, keys | support), *((name, {**keys, "body": "room", **support}) for name in names)]


def _stereo_keys(setup: StereoSetup, preset: Preset) -> dict[str, Any]:
    """Return the block of a stereo pair, or of points of another program."""
    placed, images = camera_pose(setup), not preset.as_points
    lengths: dict[str, Any] = {"scale_uncertainty": setup.scale_uncertainty}
    if setup.surface_uncertainty:
        distance, tilt = setup.surface_uncertainty
        plane = {"point": list(setup.face_centre), "normal": list(setup.face_normal)}
        lengths = {"surface": {**plane, "distance_uncertainty": distance, "tilt_uncertainty": tilt}}
    return {
        "body": setup.body,
        **({"calibration": calibration_file(setup)} if images else {}),
        "rotation": placed.rotation.tolist(),
        "translation": placed.translation_m.tolist(),
        "pose_uncertainty": list(setup.pose_uncertainty),
        **lengths,
        **({"bit_depth": setup.bit_depth} if images else {}),
        "exposure": preset.exposure_s,
        "delay": 0.0,
        "delay_uncertainty": setup.delay_uncertainty,
        **({name: getattr(setup, name) for name in ("row_time", "row_time_uncertainty")} if setup.row_time else {}),
    }


def calibration_file(setup: StereoSetup) -> str:
    """Return the path of a pair's calibration in its campaign."""
    return f"calibration/{setup.name}.json"


def points_file(setup: StereoSetup) -> str:
    """Return the file name of a stereo pair's points."""
    return f"points-{setup.name}.csv"


def images(setup: StereoSetup) -> list[dict[str, Any]]:
    """Return the image blocks of a pair, and those of the patch at rest."""
    files, patches = {side: f"{setup.name}-{side}/*.tif" for side in setup.sides}, patches_of(setup)
    if not patches:
        return [{"stereo": setup.name, **files}]
    body, at_rest = region_of(setup, setup), region_of(setup, *patches)
    return [
        {"stereo": setup.name, **files, "region": body},
        {"stereo": patches[0].name, **files, "region": at_rest, "mask": [body]},
    ]
