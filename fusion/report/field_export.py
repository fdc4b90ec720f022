"""Fields of stereo pairs as files: PNG, animated WebP, MP4 and VTK."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.base import __version__
from fusion.errors import InputError
from fusion.report.atomic_files import write_file, write_together
from fusion.report.field_data import COVERAGE_FACTOR, FieldQuantity, PairField, field_quantities, read_pair_fields
from fusion.report.field_images import FieldScale, overlay, value_scale
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.report_notices import FIELD_FOLDER_EXISTS, NO_FIELDS, NO_RESULTS
from fusion.report.vtk import collection, poly_data
from shakercal._common.arrays import FloatArray

READ = ("stereo", "accelerations", "excitation")
"""Groups of results that are read."""
FRAMES, FRAME_MS = 24, 80
"""Frames of an animation over one period, and the duration of each."""
WIDTH_IN, DPI, ANIMATION_DPI = 7.0, 160, 100
MARKER = "fields.txt"
"""File that is written last and marks a complete folder."""


def export_fields(results: Path, folder: Path, *, force: bool = False) -> list[Path]:
    """Write the fields of all stereo pairs and return the paths.

    `results`: folder of a recording or campaign, or a result file.
    """
    named = _result_files(results)
    if folder.exists() and not force and any(folder.iterdir() if folder.is_dir() else [folder]):
        name = next(iter(folder.iterdir()), folder).name if folder.is_dir() else "a file of this name"
        raise InputError(FIELD_FOLDER_EXISTS, folder, name=name)
    found = list[tuple[str, PairField]]()
    for name, file in named:
        with open_results(file, *READ) as content:
            found += [(name, pair) for pair in read_pair_fields(content)]
    if not found:
        raise InputError(NO_FIELDS, results)

    def make(temporary: Path) -> list[str]:
        names = [made for name, pair in found for made in _write_pair(temporary, name, pair)]
        write_file(temporary / MARKER, _contents(found))
        return [*names, MARKER]

    return write_together(folder, make, lambda: _earlier(folder))


def _result_files(results: Path) -> list[tuple[str, Path]]:
    """Return the result files of a path with the prefix of their names."""
    file = results if results.is_file() else results / RESULT_FILE
    if file.is_file() and file.name == RESULT_FILE:
        return [("", file)]
    each = sorted(results.glob(f"*/{RESULT_FILE}"))
    if not each:
        raise InputError(NO_RESULTS, results, expected=RESULT_FILE)
    return [(f"{one.parent.name}-" if len(each) > 1 else "", one) for one in each]


def _earlier(folder: Path) -> list[str]:
    """Return the files of an earlier export in a folder."""
    marker = folder / MARKER
    if not marker.is_file():
        return []
    lines = marker.read_text(encoding="utf-8", errors="replace").splitlines()
    starts = [re.escape(line.removeprefix("pair ").partition(":")[0]) for line in lines if line.startswith("pair ")]
    ours = re.compile(rf"({'|'.join(starts)})-(lines\.pvd|[\d.]+Hz(-[a-z-]+)?\.(png|webp|mp4|vtp))")
    return sorted(path.name for path in folder.iterdir() if starts and ours.fullmatch(path.name))


def _contents(found: Sequence[tuple[str, PairField]]) -> str:
    """Return the text that describes the files."""
    lines = [f"Fields over the images of stereo pairs, shakercal {__version__}."]
    lines += [
        "PNG: colours over the first left image; WebP, MP4: over one period; VTK: points in the sensor frame, SI."
    ]
    lines += [f"U = {COVERAGE_FACTOR:g} u. Phasors: x(t) = Re{{X exp(+j omega t)}}, peak values."]
    for name, pair in found:
        hertz = ", ".join(f"{one:.4f}" for one in pair.frequency_hz)
        lines.append(f"pair {name}{safe_name(pair.name)}: {pair.body}, {len(pair.points_px)} subsets, lines {hertz} Hz")
    return "\n".join(lines) + "\n"


def safe_name(text: str) -> str:
    """Return a text as part of a file name."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in text)


def _write_pair(folder: Path, prefix: str, pair: PairField) -> Iterator[str]:
    """Write the files of one pair and yield their names."""
    start, steps = f"{prefix}{safe_name(pair.name)}", list[tuple[float, str]]()
    for line, hertz in enumerate(pair.frequency_hz.tolist()):
        name = f"{start}-{hertz:.4f}Hz"
        quantities = field_quantities(pair, line)
        yield _written(folder, f"{name}.vtp", pair_vtp(pair, line))
        steps.append((hertz, f"{name}.vtp"))
        if pair.image is None:
            continue
        shown = quantities if line == pair.main_line else [q for q in quantities if q.key == quantities[0].key]
        for quantity in shown:
            yield _written(folder, f"{name}-{quantity.key}.png", field_png(pair, line, quantity))
        if line == pair.main_line:
            moving = [q for q in quantities if q.across is not None and q.above_noise.any()]
            for quantity in (q for q in moving if q is moving[0] or (q.noise is not None and _significant(q))):
                yield from _animation(folder, f"{name}-{quantity.key}", pair, line, quantity)
    yield _written(folder, f"{start}-lines.pvd", collection(steps))


def _significant(quantity: FieldQuantity) -> bool:
    """Return whether many more points are above their noise than by chance."""
    return float(quantity.above_noise.mean()) > 0.25


def _written(folder: Path, name: str, content: str | bytes) -> str:
    write_file(folder / name, content)
    return name


# VTK.


def pair_vtp(pair: PairField, line: int) -> str:
    """Return the points of a pair at a line as VTK PolyData.

    In the sensor frame, in SI. Standard uncertainties are root mean squares of those of real and imaginary part.
    """
    moved = pair.displacement(line)
    axes = {key[2:]: one for one in field_quantities(pair, line) if (key := one.key).startswith("d-")}
    u = [axes[axis].u_part for axis in "xyz"]
    values = {
        "displacement_re_m": moved.real,
        "displacement_im_m": moved.imag,
        "u_displacement_m": np.stack(u, axis=-1),
        "amplitude_m": axes["size"].amplitude,
    }
    if pair.deviation is not None and pair.u_deviation is not None:
        deviation = pair.deviation[line]
        values |= {"deviation_re_m": deviation.real, "deviation_im_m": deviation.imag}
        values |= {"u_deviation_m": pair.u_deviation[line]}
    if pair.zncc is not None:
        values["zncc"] = pair.zncc
    values["image_px"] = np.column_stack([pair.points_px, np.zeros(len(pair.points_px))])
    triangles = pair.triangles if len(pair.triangles) else None
    return poly_data(pair.reference_m, values, triangles, "displacement_re_m")


# Images with a colour bar.


class _Drawing:
    """A field over the image of a pair, with title and colour bar, drawn repeatedly."""

    def __init__(self, pair: PairField, quantity: FieldQuantity, scale: FieldScale, title: str, dpi: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize
        from matplotlib.figure import Figure

        assert pair.image is not None
        self.image, self.scale = pair.image, scale
        self.points = pair.pixels_per_px * (pair.points_px + 0.5) - 0.5
        self.triangles = pair.triangles
        single = not quantity.above_noise.all()  # points without neighbours to interpolate with
        self.side = 0.94 * pair.pixels_per_px * pair.subset_px if single else 0.0
        height, width = pair.image.shape
        figure = Figure(figsize=(WIDTH_IN, 0.84 * WIDTH_IN * height / width + 0.7), dpi=dpi, layout="constrained")
        self.canvas = FigureCanvasAgg(figure)
        axes = figure.subplots()
        axes.set_axis_off()
        self.title = axes.set_title(title, fontsize=9, loc="left")
        self.artist = axes.imshow(np.zeros((height, width, 3), np.uint8), interpolation="nearest")
        colours = LinearSegmentedColormap.from_list("field", list(scale.colours))
        limits = Normalize(scale.low / scale.factor, scale.high / scale.factor)
        figure.colorbar(ScalarMappable(limits, colours), ax=axes, shrink=0.9, label=scale.unit)

    def drawn(self, values: FloatArray, title: str = "") -> NDArray[np.uint8]:
        """Return red, green, blue (h, w, 3) of the figure with values (N,)."""
        arguments = self.image, self.points, self.triangles, values, self.scale, self.side
        self.artist.set_data(overlay(*arguments))
        if title:
            self.title.set_text(title)
        canvas: Any = self.canvas  # without types
        canvas.draw()
        canvas.figure.set_layout_engine("none")  # solved once: the next frames differ in pixels and one number
        return np.array(canvas.buffer_rgba(), dtype=np.uint8)[..., :3]


def _title(pair: PairField, line: int, quantity: FieldQuantity, what: str) -> str:
    """Return the title of an image: pair, quantity, line, kind and U."""
    unit, text = quantity.unit, f"{pair.name}, {quantity.label}"
    kind = "shapes fitted to all pixels" if quantity.kind == "shapes" else quantity.kind
    of_line = f"{what}{pair.frequency_hz[line]:.4f} Hz, {kind}"
    text += "\nmean over the frames" if quantity.kind == "score" else f"\n{of_line}"
    if np.isfinite(quantity.expanded).any():
        from fusion.base import prefix

        expanded = float(np.nanmedian(quantity.expanded))
        factor, letter = prefix(expanded)
        text += f", U {float(f'{expanded / factor:.2g}'):g} {letter}{unit} (median)"
    if quantity.noise is not None:
        text += f", {int(quantity.above_noise.sum())} of {len(quantity.noise)} subsets above noise"
    return text


def field_png(pair: PairField, line: int, quantity: FieldQuantity) -> bytes:
    """Return the amplitudes of a quantity over the image as PNG.

    Values below their noise are left out.
    """
    amplitude = quantity.amplitude
    scale = value_scale(amplitude, quantity.expanded, quantity.unit)
    if quantity.noise is not None:
        scale = scale._replace(low=0.0)
    title = _title(pair, line, quantity, "amplitude at " if quantity.across is not None else "at ")
    drawing = _Drawing(pair, quantity, scale, title, DPI)
    rgb = drawing.drawn(np.where(quantity.above_noise, amplitude, np.nan))
    return cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()


def _animation(folder: Path, name: str, pair: PairField, line: int, quantity: FieldQuantity) -> Iterator[str]:
    """Write one period of a quantity as animated WebP and MP4, and yield their names.

    MP4 only if the system can write it.
    """
    from PIL import Image

    scale = value_scale(quantity.amplitude, quantity.expanded, quantity.unit, signed=True)
    drawing = _Drawing(pair, quantity, scale, _title(pair, line, quantity, "0° of "), ANIMATION_DPI)
    shown, frames = np.where(quantity.above_noise, quantity.value, np.nan), list[NDArray[np.uint8]]()
    for step in range(FRAMES):
        values = (shown * np.exp(2j * np.pi * step / FRAMES)).real
        frames.append(drawing.drawn(values, _title(pair, line, quantity, f"{360 * step // FRAMES}° of ")))
    images, stream = [Image.fromarray(frame) for frame in frames], io.BytesIO()
    images[0].save(
        stream, "WEBP", save_all=True, append_images=images[1:], duration=FRAME_MS, loop=0, quality=80, method=2
    )
    yield _written(folder, f"{name}.webp", stream.getvalue())
    height, width = (2 * (length // 2) for length in frames[0].shape[:2])
    path = folder / f"{name}.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 1000.0 / FRAME_MS, (width, height))
    if writer.isOpened():
        for frame in frames * 3:
            writer.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
        writer.release()
        yield path.name
