"""Requests of the page of `shakercal view`, and their answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import ComputeError, InputError
from fusion.estimation.uncertainty import polar_elements
from fusion.planning.lines import lines_of_recording
from fusion.planning.view.manifest_edit import write_outlines
from fusion.planning.view.readable import notice_of
from fusion.planning.view.subset_views import SubsetViews
from fusion.planning.view.view_sources import overview
from fusion.planning.view.viewed_recording import ViewedRecording, ViewSession
from fusion.planning.view.wire_format import table, with_head
from fusion.recording.transducer import TRANSDUCERS
from fusion.report.figure import BLACK, GREEN, GREY, ORANGE, PURPLE, RED, SKY, SOURCE_COLOUR, SOURCE_MARKER
from shaker.io.channel import RawChannel
from shakercal._common.arrays import FloatArray

ApiResponse = bytes | Mapping[str, Any]
ApiHandlers = Mapping[str, Callable[[Mapping[str, str]], ApiResponse]]
ApiActions = Mapping[str, Callable[[Mapping[str, Any]], ApiResponse]]
FAILURES = (InputError, ComputeError, OSError, ValueError, ArithmeticError, LookupError)
MOST_COLUMNS, MOST_BINS = 4000, 2000  # more than the pixels of a screen
PALETTE = {"ink": BLACK, "image": SOURCE_COLOUR["photogrammetry"], "line": RED, "region": GREEN, "mask": PURPLE}
PALETTE |= {"subset": SKY, "picked": ORANGE}
CHANNEL_COLOUR = {"output": PURPLE, "trigger": GREY}
Query = Mapping[str, str]


def api_handlers(viewed: ViewSession) -> ApiHandlers:
    """Return the function for each request of the page, by its name."""

    def number(query: Query, name: str) -> int:
        return int(query[name])

    def subsets(query: Query) -> SubsetViews:
        return viewed.recording(query).subset_views

    return {
        "sources": lambda _: {"recordings": [overview(one) for one in viewed.sources]},
        "recording": lambda query: description(viewed.renewed(query)),
        "refusals": lambda query: {"errors": viewed.recording(query).refusals},
        "frame": lambda query: image(
            viewed.recording(query), number(query, "pair"), number(query, "side"), number(query, "frame")
        ),
        "subsets": lambda query: subsets(query).frame(number(query, "pair"), number(query, "frame")),
        "epipolar": lambda query: subsets(query).epipolar(
            number(query, "pair"), number(query, "side"), (float(query["x"]), float(query["y"]))
        ),
        "track": lambda query: subsets(query).track(number(query, "pair"), number(query, "point")),
        "field": lambda query: viewed.recording(query).field_views.at_line(
            number(query, "pair"), number(query, "line")
        ),
        "signal": lambda query: signal(viewed.recording(query), query),
        "spectrum": lambda query: spectrum(viewed.recording(query), query),
        "lines": lambda query: lines(viewed.recording(query)),
        "phasors": lambda query: phasors(viewed.recording(query), number(query, "line")),
    }


def api_actions(viewed: ViewSession) -> ApiActions:
    """Return the function for each change that the page requests, by its name."""

    def outlines(asked: Mapping[str, Any]) -> ApiResponse:
        shown = viewed.recording({"recording": str(asked["recording"])})
        place = shown.pairs[int(asked["pair"])].stated.place
        write_outlines(shown.path, str(asked["version"]), place, asked["region"], asked["mask"])
        return {"written": str(shown.path)}

    return {"outlines": outlines}


def description(viewed: ViewedRecording) -> Mapping[str, Any]:
    """Return the data that the page needs first, with the lines of the results."""
    errors, pairs, lines = list(viewed.errors), [], list[float]()
    for number, pair in enumerate(viewed.pairs):
        stated = pair.stated
        shown = {**pair.description, "number": number, "region": stated.region, "mask": stated.mask}
        for views in ("subset_views", "field_views"):
            try:
                shown |= getattr(viewed, views).description(number)
            except FAILURES as error:
                errors.append(notice_of(error, viewed.path))
        pairs.append(shown)
    try:
        lines = next((one.frequency_hz.tolist() for one in viewed.accelerations.values()), [])
    except FAILURES as error:
        errors.append(notice_of(error, viewed.path))
    channels = [
        {
            "name": one.name,
            "daq": one.recorder,
            "quantity": one.quantity,
            "unit": one.unit,
            "colour": _colour(one.quantity),
        }
        for one in viewed.channels
    ]
    about = {"name": viewed.readable.name, "file": str(viewed.path), "version": viewed.version, "palette": PALETTE}
    return {**about, "errors": errors, "pairs": pairs, "channels": channels, "resultLines": lines}


def _colour(quantity: str) -> str:
    """Return the colour of a channel: that of its source in the report."""
    if quantity in TRANSDUCERS:
        return SOURCE_COLOUR[TRANSDUCERS[quantity].kind]
    return CHANNEL_COLOUR.get(quantity, ORANGE)


def image(viewed: ViewedRecording, number: int, side: int, frame: int) -> ApiResponse:
    """Return the grey values of an image as stored, row by row.

    `refused`: why a run refuses it; alone if the image cannot be read.
    """
    pair = viewed.pairs[number]
    name = list(pair.cameras)[side]
    if not 0 <= frame < len(pair.frames):
        raise ValueError(f"frame: expected 0 to {len(pair.frames) - 1}, found {frame}")
    try:
        shown = pair.read(name, frame)
    except FAILURES as error:
        return {"refused": pair.notice(error, name)}
    refused = None if shown.refusal is None else pair.notice(shown.refusal, name)
    grey = shown.grey if shown.grey.dtype == np.uint8 else shown.grey.astype("<u2", copy=False)
    height, width = grey.shape
    head = {"width": width, "height": height, "bits": 8 * grey.itemsize, "full": shown.full_scale, "refused": refused}
    return with_head(head, grey.tobytes())


def phasors(viewed: ViewedRecording, line: int) -> ApiResponse:
    """Return a panel for each component with all values at a line.

    Values have 95 % regions, and colour and marker of their source as in the report.
    """
    panels: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name, found in viewed.accelerations.items():
        source = name.rpartition("-")[2]
        row = polar_elements(found.value, found.uncertainty)[line]
        for e, element in enumerate(row):
            if element is None or not np.isfinite(element.region.half_axes).all():
                continue
            value = complex(found.value[line, e])
            panels.setdefault((f"{found.channel[e]} {found.component[e]}", found.unit[e]), []).append(
                {
                    "name": name,
                    "source": source if source in SOURCE_COLOUR else "fused",
                    "re": value.real,
                    "im": value.imag,
                    "axes": list(element.region.half_axes),
                    "angle": element.region.angle_rad,
                    "size": f"{element.magnitude:.6g} {found.unit[e]}, {np.degrees(element.phase_rad):.4g}°",
                    "colour": SOURCE_COLOUR.get(source, BLACK),
                    "marker": SOURCE_MARKER.get(source, "circle"),
                }
            )
    text = "ellipses: 95 % regions" if panels else "Phasors require results of shakercal run."
    shown = [{"name": name, "unit": unit, "values": values} for (name, unit), values in panels.items()]
    return {"panels": shown, "told": text}


def lines(viewed: ViewedRecording) -> ApiResponse:
    """Return the lines of a recording with their origins, as `shakercal lines`."""
    found = lines_of_recording(viewed.manifest)
    rows = [
        {"frequency": one.frequency_hz, "what": one.what, "use": one.use, "floor": float(np.nan_to_num(one.floor_db))}
        for one in found.entries
    ]
    return {"lines": rows}


def spectrum(viewed: ViewedRecording, query: Query) -> bytes:
    """Return the amplitude spectrum of a channel between two frequencies: the highest of neighbouring bins.

    `log`: neighbours are those on a logarithmic axis. The first bin, at 0 Hz, is always returned if it is in between.
    """
    number = int(query["channel"])
    raw, found = viewed.raw(number), viewed.spectrum(number)
    step = float(found.frequency_hz[1])
    begin, end = float(query.get("from", "0")), float(query.get("to", repr(float(found.frequency_hz[-1]))))
    first = min(max(int(begin / step), 0), len(found.amplitude) - 1)
    last = min(max(int(np.ceil(end / step)) + 1, first + 1), len(found.amplitude))
    if query.get("log") == "1" and last > max(first, 1) + 1:
        starts = np.unique(np.geomspace(max(first, 1), last, MOST_BINS + 1).astype(int)[:-1])
    else:
        starts = np.arange(max(first, 1), max(last, 2), -(-(last - first) // MOST_BINS))
    starts = np.concatenate([[0], starts]) if first == 0 else starts
    starts = starts[starts < last]
    ends = np.append(starts[1:], last)
    highest = np.array([a + int(np.argmax(found.amplitude[a:b])) for a, b in zip(starts, ends, strict=True)])
    text = (
        f"{len(raw.samples)} samples at {raw.sample_rate_hz:g} samples/s, Hann window; the highest of neighbouring bins"
    )
    head = {"told": text, "unit": viewed.unit(number), "step": step, "refused": viewed.remark(number)}
    return table(head, found.frequency_hz[highest], found.amplitude[highest])


def signal(viewed: ViewedRecording, query: Query) -> bytes:
    """Return channels of a recorder between two times: edges (s) and extremes of columns.

    Times count from the first sample of these channels. `refused`: channels that cannot be read; `remarks`: why a run
    refuses others.
    """
    asked = [int(text) for text in query["channels"].split(",")]
    most = min(max(int(query.get("columns", "1000")), 1), MOST_COLUMNS)
    limits = [float(query[name]) for name in ("from", "to") if name in query]
    if not np.isfinite(limits).all():
        raise ValueError("expected finite times")
    refused, raws = dict[int, Mapping[str, str]](), dict[int, RawChannel]()
    for number in asked:
        try:
            raws[number] = viewed.raw(number)
        except (InputError, ComputeError, OSError, ValueError) as error:
            refused[number] = notice_of(error, viewed.path)
    start_s = min((raw.start_s for raw in raws.values()), default=0.0)
    arrays: list[NDArray[Any]] = []
    for number, raw in raws.items():
        lag_s = raw.start_s - start_s
        arrays += _columns(viewed, number, query, (lag_s, most))
    remarks = {number: found for number in raws if (found := viewed.remark(number)) is not None}
    units = {number: viewed.unit(number) for number in raws}
    return table({"channels": list(raws), "refused": refused, "remarks": remarks, "units": units}, *arrays)


def _columns(viewed: ViewedRecording, number: int, query: Query, how: tuple[float, int]) -> list[NDArray[Any]]:
    """Return edges, smallest and largest samples of a channel in columns.

    `how`: its lag in s, and most columns.
    """
    raw, (lag_s, most) = viewed.raw(number), how
    count, rate = len(raw.samples), raw.sample_rate_hz
    begin, end = float(query.get("from", "0")) - lag_s, float(query.get("to", "inf")) - lag_s
    if raw.stamp_s is None:
        first, last = int(begin * rate), count if np.isinf(end) else int(np.ceil(end * rate))
    else:
        first, last = int(np.searchsorted(raw.stamp_s, begin)), int(np.searchsorted(raw.stamp_s, end)) + 1
    found = viewed.extremes(number).columns(first, last, most)
    edge: FloatArray = found.edge / rate
    if raw.stamp_s is not None:
        edge = np.append(raw.stamp_s, raw.stamp_s[-1] + 1.0 / rate)[found.edge]
    return [lag_s + edge, found.low, found.high]
