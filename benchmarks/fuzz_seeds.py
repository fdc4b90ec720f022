"""Small valid files of every kind that a reader takes, and the calls that read them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import cine_factory
import h5py
import numpy as np
import scipy.io
import tdms_factory as tdms
import universal_factory as uff

from fusion import Settings, read_results, run_path, simulate_preset
from fusion.campaign.joint_report import write_campaign
from photogram.images.image_files import open_sequence, read_image
from photogram.images.sequence import wrap_read_errors
from photogram.point_tables import read_matrix, read_point_tables
from shaker.io import read_channels
from shaker.io.table import read_table_columns, table_units
from shaker.io.text import read_scan_asc
from shaker.io.universal import read_universal_functions, read_universal_shapes

RNG = np.random.default_rng(0)
X, Y = np.arange(120) / 100.0, RNG.normal(size=120)
GREY = RNG.integers(0, 4096, (3, 16, 24), dtype=np.uint16)
BLOB = RNG.normal(size=(24, 3))
LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tNo\n***End_of_Header***\t\n\t\n"
    "Channels\t1\t\nSamples\t120\t\nDelta_X\t0.01\t\nY_Unit_Label\tN\t\n***End_of_Header***\t\nX_Value\tU\tComment\n"
)


@dataclass(frozen=True)
class Seed:
    """How sound files of a kind come into a folder, and the calls that read one of them."""

    make: Callable[[Path, Path], None]
    reads: tuple[Callable[[Path], Any], ...]
    suffixes: tuple[str, ...]

    def write(self, folder: Path, data: Path) -> bool:
        """Write the files, and tell whether there are any; those of `data` are taken where they are there."""
        self.make(folder, data)
        return bool(self.paths(folder))

    def paths(self, folder: Path) -> list[Path]:
        """Return the files that are read."""
        return sorted(path for path in folder.iterdir() if path.suffix.lower() in self.suffixes)


# Channels.


def _channels(path: Path) -> None:
    rate = None
    try:
        names = list(read_channels(path))
    except ValueError as error:
        if "give sample_rate" not in str(error):
            raise
        rate = 100.0  # of files that state none
        names = list(read_channels(path, None, rate))
    if names:
        read_channels(path, names[-1:], rate)


def _columns(path: Path) -> None:
    read_table_columns(path, list(table_units(path)))


def _tdms(folder: Path, data: Path) -> None:
    for name, flag in (("blocks", 0), ("interleaved", tdms.INTERLEAVED)):
        parts = [
            tdms.entry(f"/'g'/'{own}'", tdms.plain("f8", 60), {"wf_increment": 0.01, **tdms.linear(2.0, 1.0)})
            for own in "ab"
        ]
        raw = [tdms.interleaved(part, part) if flag else part.tobytes() * 2 for part in (Y[:60], Y[60:])]
        more = tdms.segment([], raw[1], tdms.RAW | flag)
        (folder / f"{name}.tdms").write_bytes(tdms.segment(parts, raw[0], 14 | flag) + more)
    _taken(folder, data, "tdms/raw1.tdms", "tdms/Digital_Input.tdms", "formats/tdms/raw_timestamps.tdms")


def _taken(folder: Path, data: Path, *names: str) -> None:
    """Copy real files, those that are there, and what stands beside them."""
    for name in names:
        own = data / name
        for path in own.parent.glob(f"{own.stem}.*") if own.is_file() else ():
            shutil.copyfile(path, folder / path.name)


def _hdf5(folder: Path, _: Path) -> None:
    with h5py.File(folder / "a.h5", "w") as file:
        file.attrs["sample_rate"] = 100.0
        file.create_dataset("daq/Fz", data=Y, chunks=(30,), compression="gzip")
        file["daq/Fz"].attrs["unit"] = "N"
        file.create_dataset("table", data=np.stack([Y, Y], axis=1))
        file["link"] = h5py.SoftLink("/table")
        records = np.zeros(120, [("time", "f8"), ("a", "i2")])
        records["time"] = np.arange(120) / 100.0
        file.create_dataset("records", data=records)
    with h5py.File(folder / "b.h5", "w", libver="latest") as file:
        file.create_dataset("Fz", data=Y, chunks=(64,), maxshape=(None,), compression="lzf", shuffle=True)
        file["Fz"].attrs["fs"] = 10.0


def _matlab(folder: Path, _: Path) -> None:
    content = {
        "Fz": Y,
        "rec": {"x": Y, "fs": 100.0, "deep": {"unit": "N"}},
        "name": "text",
        "c": np.array(["a"], object),
    }
    for name, options in (("v5", {}), ("v7", {"do_compression": True})):
        scipy.io.savemat(folder / f"{name}.mat", content, **options)
    scipy.io.savemat(folder / "v4.mat", {"Fz": Y, "fs": 100.0}, format="4")
    with h5py.File(folder / "v73.mat", "w", userblock_size=512) as file:
        for name, own in (("Fz", Y[None]), ("rec/x", Y[:, None]), ("rec/fs", np.array([[100.0]]))):
            file.create_dataset(name, data=own).attrs["MATLAB_class"] = np.bytes_("double")
        text = np.frombuffer("N".encode("utf-16-le"), "<u2")[:, None]
        file.create_dataset("rec/unit", data=text).attrs["MATLAB_class"] = np.bytes_("char")


def _wave(folder: Path, _: Path) -> None:
    for name, kind in (("i16", np.int16), ("f32", np.float32), ("u8", np.uint8)):
        scipy.io.wavfile.write(folder / f"{name}.wav", 1000, np.stack([Y * 100, Y * 50], axis=1).astype(kind))


def _universal_files(folder: Path, data: Path) -> None:
    shape = uff.shape(5, [53.7], [1, 2, 3], np.ones((3, 3), dtype=complex))
    for even in (True, False):
        (folder / f"text{even}.uff").write_bytes(uff.text_function(1, 4, X, Y, even) * 2)
        (folder / f"binary{even}.uff").write_bytes(uff.binary_function(4, X, Y, even, "<") + shape)
    (folder / "complex.unv").write_bytes(uff.text_function(4, 6, X, Y + 1j * Y, True) + shape)
    _taken(folder, data, "uff/binary8byte.uff", "uff/time-history-not-all-columns-filled.uff")


def _texts(folder: Path, _: Path) -> None:
    (folder / "a.lvm").write_text(LVM + "".join(f"\t{y:.6f}\n" for y in Y))
    points, block = "1 2 3\n" * 3, "".join(f"{y:.5f} {y:.5f} {y:.5f}\n" for y in Y)
    (folder / "a.asc").write_text("title\n" * 18 + points + "120 0.01\n" + block + "\n" + block)
    rows = "".join(f"{x:.2f};{y:.6f};{y:.3f}\n".replace(".", ",") for x, y in zip(X, Y, strict=True))
    (folder / "a.csv").write_text("sep=;\ntime;Fz;Fx [N]\ns;N;\n" + rows)
    (folder / "b.csv").write_text('# remark\n"a b",c\n' + "".join(f"{y},{y}\n" for y in Y))


def _mdf(folder: Path, data: Path) -> None:
    try:
        from asammdf import MDF, Signal
    except ImportError:
        return
    kinds: dict[str, Literal[0, 2]] = {"plain": 0, "deflated": 2}
    for name, compression in kinds.items():
        with MDF(version="4.10") as file:
            for unit, scale in (("N", 1), ("V", 2)):
                file.append([Signal(np.asarray(Y * scale), X, name=f"c{scale}", unit=unit)], acq_name=unit)
            file.save(folder / f"{name}.mf4", overwrite=True, compression=compression)
    _taken(folder, data, "formats/mdf4/test_batch.mf4", "formats/mdf4/test_meas_4.10.mf4")


def _dewesoft(folder: Path, data: Path) -> None:
    _taken(folder, data, "formats/dewesoft/test_acc_001.dxd", "formats/dewesoft/Example_Drive01.d7d")


def _parquet(folder: Path, _: Path) -> None:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        return
    table = pa.table({"time": X, "Fz": Y, "count": np.arange(120, dtype=np.int16)})
    parquet.write_table(table, folder / "a.parquet")
    parquet.write_table(table, folder / "b.parquet", compression="none", use_dictionary=False)


# Pictures and films.


def _frames(path: Path) -> None:
    sequence = open_sequence([path])
    for frame in range(min(len(sequence), 3)):
        sequence.read(frame)


def _grey_files(folder: Path, _: Path) -> None:
    import cv2
    import tifffile

    cv2.imwrite(str(folder / "a.png"), GREY[0])
    cv2.imwrite(str(folder / "b.bmp"), (GREY[0] >> 4).astype(np.uint8))
    cv2.imwrite(str(folder / "lzw.tif"), GREY[0])
    cv2.imwrite(str(folder / "c.jpg"), (GREY[0] >> 4).astype(np.uint8))
    tifffile.imwrite(folder / "plain.tif", GREY[0])
    tifffile.imwrite(folder / "pages.tiff", GREY, photometric="minisblack")
    tifffile.imwrite(folder / "zlib.tiff", GREY[0], compression="zlib", predictor=True)
    tifffile.imwrite(folder / "tiles.tif", np.tile(GREY[0], (2, 2)), tile=(16, 16))


def _cine(folder: Path, data: Path) -> None:
    codes = GREY >> 2
    cine_factory.write_cine(folder / "a.cine", GREY)
    cine_factory.write_cine(folder / "b.cine", GREY, packing=256, codes=codes)
    cine_factory.write_cine(folder / "c.cine", GREY, packing=1024)


def _photron(folder: Path, data: Path) -> None:
    entries = {
        **{"Total Frame": 3, "Image Width": 24, "Image Height": 16, "Color Type": "Mono", "Color Bit": 16},
        **{"File Format": "MRaw", "EffectiveBit Depth": 12, "EffectiveBit Side": "Lower", "Save Step": 1},
        **{"Record Rate(fps)": 1000, "Shutter Speed(s)": "1/5000"},
    }
    (folder / "a.cih").write_text("#Header\n" + "\n".join(f"{key} : {value}" for key, value in entries.items()))
    (folder / "a.mraw").write_bytes(GREY.astype("<u2").tobytes())
    _taken(folder, data, "formats/cihx/beam.cihx")


def _films(folder: Path, _: Path) -> None:
    import cv2

    for name, codec in (("a.avi", "MJPG"), ("b.avi", "FFV1"), ("c.mp4", "mp4v"), ("d.mkv", "FFV1")):
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*codec), 50.0, (96, 64), False)
        for frame in GREY if writer.isOpened() else ():
            writer.write(np.tile((frame >> 4).astype(np.uint8), (4, 4)))
        writer.release()


# Tables of points.


def _points(folder: Path, data: Path) -> None:
    moved = BLOB + 0.01
    heads = {
        "vic": [*(f"{c} [mm]" for c in "XYZUVW"), "x [pixel]", "y [pixel]", "sigma [pixel]"],
        "dice": ["COORDINATE_X", "COORDINATE_Y", "SIGMA"],
        "aramis": ["ID", *(f"{c}_undef [mm]" for c in "xyz"), *(f"{c} [mm]" for c in "uvw")],
    }
    heads["dice"] += [f"MODEL_{kind}_{axis}" for kind in ("COORDINATES", "DISPLACEMENT") for axis in "XYZ"]
    values = np.column_stack([np.arange(24), BLOB, moved, BLOB, moved])
    for name, head in heads.items():
        rows = [",".join(f"{value:.8g}" for value in row[: len(head)]) for row in values]
        (folder / f"{name}.csv").write_text("\n".join([",".join(f'"{own}"' for own in head), *rows]) + "\n")
    for quantity in "XYZUVW":
        rows = [";".join(f"{value:.5f}" for value in row) + ";" for row in BLOB.reshape(6, 12)]
        (folder / f"m_{quantity}[mm].txt").write_text("\n".join(rows))
    table = {name: part.reshape(4, 6) for name, part in zip("XYZUVW", (*BLOB.T, *moved.T), strict=True)}
    scipy.io.savemat(folder / "vic.mat", {**table, "note": "x"}, do_compression=True)
    scipy.io.savemat(folder / "plain.mat", table)


def _named_points(path: Path) -> None:
    read_point_tables([path], ["id", "x", "y", "z", *["_"] * 5])


def _known_points(path: Path) -> None:
    read_point_tables([path], scale=1e-3)


def _matrix(path: Path) -> None:
    with wrap_read_errors(path):
        read_matrix(path)


# Results of a run.


def _results(folder: Path, data: Path) -> None:
    with TemporaryDirectory() as place:
        simulate_preset(f"{place}/matrix", "matrix", 1)
        run_path(f"{place}/matrix/1-z", f"{place}/results/1-z", Settings())
        write_campaign(Path(place, "results"), "matrix", [Path(place, "results/1-z")], {})
        for name in ("1-z/result.h5", "campaign.h5"):
            shutil.copyfile(Path(place, "results", name), folder / Path(name).name)


def _labelled(path: Path) -> None:
    found = read_results(path)
    for part in (found.sensitivity, found.element, found.load, *found.acceleration.values(), *found.curve):
        if part is not None:
            part.to_dataframe()


SEEDS: dict[str, Seed] = {
    "tdms": Seed(_tdms, (_channels,), (".tdms",)),
    "hdf5": Seed(_hdf5, (_channels,), (".h5",)),
    "matlab": Seed(_matlab, (_channels,), (".mat",)),
    "wave": Seed(_wave, (_channels,), (".wav",)),
    "universal": Seed(_universal_files, (_channels, read_universal_functions, read_universal_shapes), (".uff", ".unv")),
    "labview": Seed(_texts, (_channels,), (".lvm",)),
    "scan": Seed(_texts, (_channels, read_scan_asc), (".asc",)),
    "csv": Seed(_texts, (_channels, _columns), (".csv",)),
    "mdf": Seed(_mdf, (_channels,), (".mf4",)),
    "dewesoft": Seed(_dewesoft, (_channels,), (".dxd", ".d7d")),
    "parquet": Seed(_parquet, (_channels,), (".parquet",)),
    "png": Seed(_grey_files, (_frames, read_image), (".png",)),
    "jpeg": Seed(_grey_files, (read_image,), (".jpg",)),
    "bmp": Seed(_grey_files, (_frames, read_image), (".bmp",)),
    "tiff": Seed(_grey_files, (_frames, read_image), (".tif", ".tiff")),
    "cine": Seed(_cine, (_frames,), (".cine",)),
    "photron": Seed(_photron, (_frames,), (".cih", ".cihx")),
    "film": Seed(_films, (_frames,), (".avi", ".mp4", ".mkv")),
    "points": Seed(_points, (_named_points, _known_points), (".csv", ".mat")),
    "matrix": Seed(_points, (_matrix,), (".txt",)),
    "results": Seed(_results, (_labelled,), (".h5",)),
}
