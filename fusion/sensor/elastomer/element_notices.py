"""Notices and errors of models of elastic elements (`shakercal elastomer`)."""

from shakercal._common.notices import DeclaredNotice

BLOCK_THICKNESS_MISSING = DeclaredNotice(
    "SC-740",
    "error",
    "expected the thickness of the block that --solid models, found none",
    remedy="State `thickness`, or run without `--solid`.",
    link="elastomer.md",
)
SOLID_PACKAGE_MISSING = DeclaredNotice(
    "SC-741",
    "error",
    'expected the package that pip install "shakercal[solid]" installs, found none ({reason})',
    remedy='Run `pip install "shakercal[solid]"`, or run without `--solid`.',
    link="elastomer.md",
)
SOLID_REFUSED = DeclaredNotice(
    "SC-742",
    "error",
    "{reason}",
    effect="The solid model cannot be meshed or solved.",
    remedy="Correct the dimension.",
    link="elastomer.md",
)
NO_MEASURED_MODE = DeclaredNotice(
    "SC-743",
    "note",
    "The model of {component} in {file} has no oscillating mode.",
    effect="The column of measured frequencies has no value for it.",
    link="elastomer.md",
)
MIXED_MODE = DeclaredNotice(
    "SC-744",
    "note",
    "The mode contains {share_percent:.0f} % of the motion that names it, and another mode contains more of it.",
    effect="The name of the mode is approximate.",
    link="elastomer.md",
)
FURTHER_MODES = DeclaredNotice(
    "SC-745",
    "note",
    "There are further modes at {frequencies_hz} Hz, in which the beams themselves oscillate.",
    link="elastomer.md",
)
PLATFORM_AS_STATED = DeclaredNotice(
    "SC-746",
    "note",
    "Mass, centre of mass and inertia of the platform are used as stated.",
    effect="Every frequency depends on them.",
    link="elastomer.md",
)
MESH_NOT_CONVERGED = DeclaredNotice(
    "SC-747",
    "warning",
    "{mode} changed by {change_percent:.1f} % with the last refinement of the mesh.",
    effect="The frequencies of the solid model have not converged.",
    remedy="Add a finer mesh to `refinements` of `[solid]`.",
    link="elastomer.md",
)
FRAME_DEVIATES = DeclaredNotice(
    "SC-748",
    "note",
    "The frame deviates by {deviation_percent:+.0f} % from the solid, and by {stiff_percent:+.0f} % from a solid "
    "with a rigid platform.",
    effect="The difference of the two numbers is the effect of the elastic platform.",
    link="elastomer.md",
)
