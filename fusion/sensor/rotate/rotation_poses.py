"""Notices, figures and tables of recordings in any orientations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fusion.base import prefix
from fusion.report.figure import COLOURS, LIGHT, Figure, empty_figure
from fusion.report.table import Table, TableColumn, page_column, table
from fusion.sensor import bench_notices as declared
from fusion.sensor.rotate.rotation_readings import RotationEvaluation, RotationRecording
from shaker.labels import AXES, LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.orientations import OrientationFit
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text, quantity_text, typeset
from shakercal._common.notices import Notice

MOST_CONDITION = 5.0  # of offset and gravity, of poses in good order: chosen
TILT_NOTICE_RAD = np.radians(1.0)  # as of the axis of a head


def pose_notices(recordings: Sequence[RotationRecording], tilts: FloatArray) -> Iterator[Notice]:
    """Yield notices on what the orientations leave undetermined, and on estimated rotations (R, 3)."""
    for recording, tilt in zip(recordings, tilts, strict=True):
        fit, excitation = recording.fit, recording.manifest.excitation
        if not isinstance(fit, OrientationFit):
            continue
        pose = further_pose(fit)
        if fit.axes < len(AXES):
            normal = ", ".join(f"{x:.2f}" for x in np.cross(*fit.basis))
            yield Notice(declared.GRAVITY_IN_A_PLANE, recording.name, normal=normal, pose=pose.strip("+-"))
        elif fit.condition > MOST_CONDITION:
            yield Notice(declared.POSES_NEARLY_DEPENDENT, recording.name, condition=fit.condition, pose=pose)
        world, expanded = (float(np.degrees(np.linalg.norm(x))) for x in (fit.down_tilt, 2.0 * fit.u_down_tilt))
        if excitation.down_uncertainty is None and world > 0.0:
            yield Notice(declared.WORLD_TILTED, recording.name, tilt_deg=world, expanded_deg=expanded)
        size = float(np.linalg.norm(tilt))
        if size > TILT_NOTICE_RAD:
            yield Notice(declared.AXES_ROTATED, recording.name, rotation_deg=float(np.degrees(size)))
        if "orientation_uncertainty" not in excitation.model_fields_set:
            yield Notice(declared.POSES_TAKEN_AS_INDEPENDENT, "orientation")


def further_pose(fit: OrientationFit) -> str:
    """Return the axis that should point down in a further pose, such as -y."""
    down = fit.further_pose()
    axis = int(np.argmax(np.abs(down)))
    return f"{'-' if down[axis] < 0.0 else '+'}{AXES[axis]}"


# Figures and tables.


def over_unit(label: str, unit: str) -> str:
    """Return a label with its unit."""
    return f"{label} / ({unit})" if "·" in unit else f"{label} / {unit}"


def draw_poses(recording: RotationRecording, indices: Sequence[int], kind: str) -> Figure:
    """Draw readings of some load components over the poses, with fit and residuals."""
    fit, calibration, unit = recording.fit, recording.inverse[indices], typeset(LOAD_UNITS[indices[0]])
    residual, number = fit.residual @ calibration.T, np.arange(1.0, 1.0 + len(fit.reading))
    scale, letter = prefix(residual, coarse=False)
    drawn = empty_figure(f"rotation-{recording.name}-{kind}", 4.6, (2.0, 1.0))
    upper, lower = drawn.panels
    for c, index in enumerate(indices):
        name, colour = LOAD_COMPONENTS[index], COLOURS[c]
        upper.line(number, recording.load[:, index] - residual[:, c], name, colour=colour, width=0.9)
        upper.points(number, recording.load[:, index], name, colour=colour, size=4.0)
        lower.points(number, residual[:, c] / scale, name, colour=colour, size=4.0)
    lower.rule(0.0, colour=LIGHT)
    upper.y.label, lower.y.label = over_unit("load", unit), over_unit("residual", f"{letter}{unit}")
    upper.title, lower.title = f"{recording.name}: {kind}, readings and fit", "readings less fit"
    lower.x.label = "pose"
    caption = "Curves: offset, gravity and drift fitted to the readings."
    return drawn.with_title(f"{recording.name}, {kind} over the poses", caption, main=True)


def poses_table(evaluation: RotationEvaluation) -> Table | None:
    """Return what the orientations of each recording determine."""
    fits = [(r, r.fit) for r in evaluation.recordings if isinstance(r.fit, OrientationFit)]
    columns: list[TableColumn[tuple[RotationRecording, OrientationFit]]] = [
        page_column("recording", lambda row: row[0].name, "l"),
        page_column("readings", lambda row: f"{row[1].count.sum()}"),
        page_column("poses", lambda row: f"{len(row[1].count)}"),
        page_column("axes of gravity", lambda row: f"{row[1].axes}"),
        page_column("condition number", lambda row: number_text(row[1].condition, 2)),
        page_column("most useful further pose", lambda row: f"{further_pose(row[1])} down", "l"),
        page_column("random walk in", lambda row: ", ".join(walking(row[1])) or "none", "l"),
    ]
    return table("Orientations: offset and gravity along three axes need a condition number below 5", columns, fits)


def walking(fit: OrientationFit) -> list[str]:
    """Return the channels with a random walk."""
    return [name for name, walk in zip(fit.channels, fit.walk, strict=True) if walk > 0.0]


def matrix_table(evaluation: RotationEvaluation) -> Table | None:
    """Return the force part of the matrix beside the stated one."""
    found = {q.component: q for q in evaluation.quantities if q.name == "force_sensitivity"}
    if not found:
        return None
    channels, stated = evaluation.recordings[0].fit.channels, evaluation.outputs.sensitivity
    unit = typeset(next(iter(found.values())).unit)
    rows = []
    for c, channel in enumerate(channels):
        for j, force in enumerate(LOAD_COMPONENTS[:3]):
            q = found[f"{channel}/{force}"]
            rows.append((channel, force, quantity_text(q.value, q.expanded), number_text(stated[c, j], 2)))
    head = ("output", "force", over_unit("by the weighed load", unit), "stated")
    return Table("Force part of the static matrix with U", head, "llrr", tuple(rows))
