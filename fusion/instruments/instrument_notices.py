"""Notices of instruments: undetermined geometry of channels."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

PARALLEL_BEAMS = DeclaredNotice(
    "SC-190",
    "note",
    "Laser beams are stated as exactly parallel: {beams}.",
    effect="Beams of a scanning head are not parallel: 50 mm off axis at 0.5 m reads 0.5 % less.",
    remedy="State `mirror` or `standoff` of the laser head in `[head.NAME]`.",
    link="recording-format.md#headname",
)
PARALLEL_BEAMS_WITHOUT_HEAD = DeclaredNotice(
    "SC-191",
    "note",
    "Laser beams without a head are stated as exactly parallel: {beams}.",
    effect="Their direction uncertainty is counted both as a common tilt and per beam, to be safe. Beams of a scanning "
    "head are not parallel: 50 mm off axis at 0.5 m reads 0.5 % less.",
    remedy="Describe the laser head in `[head.NAME]`, with its `mirror` or `standoff`.",
    link="recording-format.md#headname",
)
