"""Evaluation of the acceptance test of a stereo rig: tests, verdict, most likely causes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

from fusion.base import CommandEvaluation, ProgressCallback, no_progress
from fusion.cameras.accept.acceptance_manifest import (
    FEWEST_MOVED,
    FEWEST_ROTATED,
    FEWEST_STATIONARY,
    AcceptanceFile,
)
from fusion.cameras.accept.acceptance_notices import (
    LATE_FRAMES,
    LIKELY_CAUSE,
    LIKELY_FAULT,
    SCALE_UNTESTED,
    SMALL_FAULT,
    SYNCHRONISATION_UNTESTED,
    UNEXPLAINED_FAULT,
)
from fusion.cameras.accept.acceptance_rows import AcceptanceRow, Verdict, overall
from fusion.cameras.accept.calibration_faults import Diagnosis, diagnose
from fusion.cameras.accept.moved_plate import MotionTest, measure_rotation, measure_translation
from fusion.cameras.accept.stationary_scene import StationaryTest, measure_stationary
from fusion.cameras.accept.tracked_test import open_pair, track_test
from shakercal._common.notices import Notice

GEOMETRIC = ("epipolar", "scale", "position", "scale_variation", "straightness", "rotation", "strain", "bending")
"""Rows that a fault of the calibration causes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AcceptanceEvaluation(CommandEvaluation):
    """Results of all tests of a rig.

    `diagnosis`: faults that explain the translations; None without them, or if a camera is late.
    """

    stationary: StationaryTest | None
    translations: tuple[MotionTest, ...]
    rotations: tuple[MotionTest, ...]
    diagnosis: Diagnosis | None

    @property
    def rows(self) -> tuple[AcceptanceRow, ...]:
        """The rows of all tests."""
        stationary = () if self.stationary is None else self.stationary.rows
        return (*stationary, *(row for test in (*self.translations, *self.rotations) for row in test.rows))

    @property
    def verdict(self) -> Verdict:
        """The verdict of all rows."""
        return overall(self.rows)


def evaluate_acceptance(
    file: AcceptanceFile, input_hashes: dict[str, str], progress: ProgressCallback = no_progress
) -> AcceptanceEvaluation:
    """Return the results of the tests that acceptance.toml describes.

    Parameters
    ----------
    file
        Tests, calibration and tolerances (`read_acceptance`).
    input_hashes
        SHA-256 of the input files by name.
    progress
        Called with test, done and total images; default none.

    Returns
    -------
    AcceptanceEvaluation
        Rows with value, U and verdict, and notices with the most likely causes.

    Raises
    ------
    InputError
        For images that do not fit the calibration, or that do not show the body.
    """
    started, tables, rig = time.monotonic(), file.tables, file.rig
    stationary, tracking = None, list[Notice]()
    if tables.stationary is not None:
        block = tables.stationary
        pair = open_pair(file, "stationary", block, FEWEST_STATIONARY)
        tracked = track_test(file, "stationary", pair, progress, at_rest=True)
        stationary = measure_stationary(rig, block, tracked, tables.tolerances)
        tracking += [*tracked.notices, *stationary.notices]
    translations, rotations = list[MotionTest](), list[MotionTest]()
    for moved in tables.translation:
        key = f"translation.{moved.name}"
        pair = open_pair(file, key, moved, FEWEST_MOVED, "positions")
        tracked = track_test(file, key, pair, progress)
        tracking += tracked.notices
        translations.append(measure_translation(rig, moved, tracked, tables.tolerances))
    for rotation in tables.rotation:
        key = f"rotation.{rotation.name}"
        pair = open_pair(file, key, rotation, FEWEST_ROTATED, "angles")
        tracked = track_test(file, key, pair, progress)
        tracking += tracked.notices
        rotations.append(measure_rotation(rig, rotation, tracked, tables.tolerances))
    plates = [test.plate for test in translations if test.plate is not None and not test.late]
    diagnosis = diagnose(rig, plates) if plates and len(plates) == len(translations) else None
    made = AcceptanceEvaluation(
        name=tables.name,
        notices=(),
        settings={"calibration": tables.calibration.name, **tables.tolerances.model_dump()},
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
        stationary=stationary,
        translations=tuple(translations),
        rotations=tuple(rotations),
        diagnosis=diagnosis,
    )
    return replace(made, notices=(*_causes(made, file), *tracking))


def _causes(evaluation: AcceptanceEvaluation, file: AcceptanceFile) -> Iterator[Notice]:
    """Yield the most likely causes of deviations, and what was not tested."""
    explained = list(_calibration_causes(evaluation))
    yield from explained
    for row in evaluation.rows:
        by_calibration = row.name in GEOMETRIC and any(notice.severity == "warning" for notice in explained)
        if row.verdict != "PASS" and row.cause and not by_calibration:
            shown = {"value": row.value_text, "tolerance": row.tolerance_text, "cause": row.cause}
            yield Notice(LIKELY_CAUSE, row.test, quantity=row.label, remedy=row.remedy, **shown)
    for test, block in zip(evaluation.translations, file.tables.translation, strict=True):
        if test.late is None:
            yield Notice(SYNCHRONISATION_UNTESTED, test.label)
        if block.positions is None:
            yield Notice(SCALE_UNTESTED, test.label)


def _calibration_causes(evaluation: AcceptanceEvaluation) -> Iterator[Notice]:
    """Yield the fault of synchronisation or calibration that explains the translations."""
    for test in evaluation.translations:
        if test.late:
            camera, frames = ("right", test.late) if test.late > 0 else ("left", -test.late)
            yield Notice(LATE_FRAMES, test.label, camera=camera, frames=frames)
            return
    found = evaluation.diagnosis
    if found is None or not found.is_significant:
        return
    best = found.best
    geometric = [row for row in evaluation.rows if row.name in GEOMETRIC]
    if overall(geometric) == "PASS":
        yield Notice(SMALL_FAULT, "calibration", fault=best.kind.label, size=best.size_text, remedy=best.kind.remedy)
        return
    percent = 100.0 * best.share
    if not found.explains:
        yield Notice(UNEXPLAINED_FAULT, "calibration", fault=best.kind.label, share_percent=percent)
        return
    others = "".join(f"; the data do not exclude {one.kind.label}: {one.size_text}" for one in found.similar)
    values = {"fault": best.kind.label, "size": best.size_text, "remedy": best.kind.remedy, "others": others}
    yield Notice(LIKELY_FAULT, "calibration", share_percent=percent, **values)
