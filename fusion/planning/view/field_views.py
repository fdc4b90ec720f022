"""Fields of stored results over the images of a stereo pair."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from fusion.planning.view.subset_views import SubsetViews
from fusion.report.field_data import PairField, field_quantities, read_pair_fields
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.page_images import WIDEST_PX

READ = ("stereo", "accelerations", "excitation")
"""Groups of results that are read."""
NO_FIELDS = "Fields require results of shakercal run with images of this pair."


class FieldViews:
    """The fields of a recording's stereo pairs."""

    def __init__(self, views: SubsetViews, results: Path | None) -> None:
        self._views, self._results = views, results

    @cached_property
    def _fields(self) -> Mapping[str, PairField]:
        """Fields by the names of their pairs."""
        if self._results is None:
            return {}
        with open_results(self._results / RESULT_FILE, *READ) as file:
            return {one.name: one for one in read_pair_fields(file)}

    def _field(self, number: int) -> PairField | None:
        return self._fields.get(self._views.pairs[number].stated.stereo)

    def description(self, number: int) -> Mapping[str, Any]:
        """Return lines and quantities of a pair's field as in the report, empty without results."""
        field = self._field(number)
        if field is None:
            return {}
        named = [[one.key, one.label] for one in field_quantities(field, field.main_line)]
        return {"fields": {"lines": field.frequency_hz.tolist(), "main": field.main_line, "quantities": named}}

    def at_line(self, number: int, line: int) -> Mapping[str, Any]:
        """Return all quantities of a pair at a line, and the points in each camera."""
        from fusion.report.field_images import encode_field, encode_points

        field = self._field(number)
        if field is None:
            raise ValueError(NO_FIELDS)
        if not 0 <= line < len(field.frequency_hz):
            raise ValueError(f"line: expected 0 to {len(field.frequency_hz) - 1}, found {line}")
        seen = [field.points_px, *self._views.seen(number, field.reference_m)[1:]]
        cameras = []
        for points, camera in zip(seen, self._views.pairs[number].description["cameras"], strict=False):
            width, height = camera["size"]
            scale = min(1.0, WIDEST_PX / width)
            shape = round(height * scale), round(width * scale)
            cameras.append(encode_points(points, field.subset_px, scale, shape))
        return {**encode_field(field, [field_quantities(field, line)]), "cameras": cameras}
