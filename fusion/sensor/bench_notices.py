"""Notices and errors of rotation tests and elastic elements (`shakercal rotate`, `elastomer`)."""

from shakercal._common.notices import DeclaredNotice

# `shakercal rotate`.


GRAVITY_NOT_DETERMINED = DeclaredNotice(
    "SC-620",
    "error",
    "expected local gravity, or latitude and height, found none",
    effect="Weights cannot be converted into masses.",
    remedy="State `gravity`, or `latitude` and `height`, in `[environment]` of rig.toml.",
    link="rotation.md",
)
DIFFERENT_ROTATION_CHANNELS = DeclaredNotice(
    "SC-621",
    "error",
    "expected {expected}, the channels of {recording}, found {found}",
    effect="Recordings are evaluated together only if they have the same channels in the same units.",
    remedy="Export the same columns for every recording.",
    link="rotation.md",
)
MISSING_ROTATION_ENTRY = DeclaredNotice(
    "SC-622",
    "error",
    "expected {expected}, found none",
    remedy="Add it to the file.",
    link="rotation.md",
)
WRONG_ROTATION_TABLE = DeclaredNotice(
    "SC-623",
    "error",
    "expected {expected}, found {found}",
    effect="The readings cannot be assigned to angles and channels.",
    remedy="Correct the table, or the key that describes it.",
    link="rotation.md",
)
CONSTANT_CHANNELS = DeclaredNotice(
    "SC-624",
    "warning",
    "All readings of {channels} are equal.",
    effect="These channels are left out.",
    remedy="Check the connection and the range of these channels.",
    link="rotation.md",
)
MISSING_CHANNEL_COLUMNS = DeclaredNotice(
    "SC-625",
    "note",
    "{file} has no column of {channels}.",
    effect="These channels are not used.",
    link="rotation.md",
)
GRAVITY_FROM_LOCATION = DeclaredNotice(
    "SC-626",
    "note",
    "Local gravity is not stated; {gravity_mps2:.6g} m/s² is used with U = {expanded_mps2:.2g} m/s² (k = 2), {source}.",
    remedy="State `gravity` in `[environment]` of rig.toml if it was measured.",
    link="rotation.md",
)
GRAVITY_EXACT = DeclaredNotice(
    "SC-627",
    "note",
    "Gravity is treated as exact because gravity_uncertainty is not stated.",
    remedy="State `gravity_uncertainty` in `[environment]` of rig.toml.",
    link="rotation.md",
)
MATRIX_UNCERTAINTY_NOT_STATED = DeclaredNotice(
    "SC-628",
    "warning",
    "No uncertainty of the calibration matrix is stated.",
    effect="U includes the scatter of the readings, but not the scale of the sensor.",
    remedy="State `static_sensitivity_uncertainty` of the sensor in rig.toml.",
    link="rotation.md",
)
BODY_DENSITY_NOT_STATED = DeclaredNotice(
    "SC-629",
    "note",
    "The density of {body} is not stated.",
    effect="Its buoyancy is that of a material between aluminium and steel, and U includes this range.",
    remedy="State `density`.",
    link="rotation.md",
)
NO_LOADED_RECORDING = DeclaredNotice(
    "SC-630",
    "note",
    "There is no recording with load.",
    effect="Only the internal mass is determined.",
    link="rotation.md",
)
NO_UNLOADED_RECORDING = DeclaredNotice(
    "SC-631",
    "note",
    "There is no recording without load.",
    effect="The internal mass is the measured mass less the weighed mass of the load.",
    remedy="Record one rotation without load to determine both masses independently.",
    link="rotation.md",
)
TOTAL_WEIGHT_ONLY = DeclaredNotice(
    "SC-632",
    "warning",
    "There is neither a recording without load nor a weighed load.",
    effect="Only weights are reported, each of load and internal mass together.",
    remedy="Record one rotation without load, or state `[load]` in rig.toml.",
    link="rotation.md",
)
LOAD_NOT_WEIGHED = DeclaredNotice(
    "SC-633",
    "note",
    "rig.toml has no [load], so the load mass is not compared with a weighed mass.",
    remedy="State `[load]` in rig.toml.",
    link="rotation.md",
)
SINGLE_MOUNTING = DeclaredNotice(
    "SC-634",
    "note",
    "All {count} recordings {state} are of one mounting.",
    effect="U does not include the scatter between mountings.",
    remedy="Record after mounting again.",
    link="rotation.md",
    possible_size="not known",
)
GRAVITY_REVERSED = DeclaredNotice(
    "SC-635",
    "warning",
    "Gravity at angle 0 deviates by {offset_deg:.1f}° from its stated direction.",
    effect="Masses and centres of mass do not depend on it.",
    remedy="Check `sense` of the sensor and `zero_gravity`: one of them may have the wrong sign.",
    link="rotation.md",
)
GRAVITY_OFFSET = DeclaredNotice(
    "SC-636",
    "note",
    "Gravity at angle 0 deviates by {offset_deg:.1f}° from its stated direction.",
    effect="The deviation is estimated and corrected.",
    link="rotation.md",
)
AXIS_TILT = DeclaredNotice(
    "SC-637",
    "note",
    "The force along the axis varies with the angle as if the axis were tilted by {tilt_deg:.2f}°.",
    effect="The tilt is estimated and corrected; cross-talk of the sensor has the same effect.",
    remedy="Check the stated axis.",
    link="rotation.md",
)
WEIGHT_NOT_EXPLAINED = DeclaredNotice(
    "SC-638",
    "warning",
    "A weight does not explain all channels within noise and stated calibration.",
    effect="Forces have an additional uncertainty of {departure_percent:.2g} % of the weight, moments one of "
    "{moment_percent:.2g} % of the weight at 0.1 m, which cover the disagreement.",
    remedy="Check the calibration matrix and the mounting.",
    link="rotation.md",
)
LOAD_MASS_DEVIATES = DeclaredNotice(
    "SC-639",
    "warning",
    "The load mass by {component} and the weighed mass differ by {ratio:.2f} times the U of their difference.",
    effect="One of the two masses, or its uncertainty, is wrong.",
    remedy="Weigh the load again, and check the calibration matrix.",
    link="rotation.md",
    acknowledgeable=False,
)


AXIS_INCLINATION_NOT_STATED = DeclaredNotice(
    "SC-911",
    "note",
    "The inclination of the axis from the horizontal is not stated.",
    effect="An inclined axis lowers every mass by half its square, which the readings do not show.",
    remedy="Measure the inclination and state it as `axis_uncertainty`.",
    link="rotation.md",
    possible_size="0.015 % of every mass for 1°",
)
ONE_SENSE_OF_ROTATION = DeclaredNotice(
    "SC-912",
    "note",
    "The readings were taken in one sense of rotation.",
    effect="Hysteresis is not determined and not included in U.",
    remedy="Read the same angles on the way back.",
    link="rotation.md",
    possible_size="the hysteresis of the sensor, relative to every mass",
)
HYSTERESIS_FOUND = DeclaredNotice(
    "SC-913",
    "warning",
    "Readings after a rise and after a fall of the load differ by {loop_percent:.2g} % of it ({outputs}).",
    effect="Their mean is taken to deviate by up to this difference. A calibration over a much larger range may "
    "deviate by more.",
    remedy="Calibrate the sensor over the range of this test, or compare the load mass with the weighed mass.",
    link="rotation.md",
)
GRAVITY_IN_A_PLANE = DeclaredNotice(
    "SC-914",
    "warning",
    "Gravity does not vary along the direction ({normal}) of the sensor.",
    effect="Outputs along it are undetermined. The offsets along it follow from the calibration matrix.",
    remedy="Add poses with {pose} of the sensor down and up.",
    link="rotation.md",
)
POSES_NEARLY_DEPENDENT = DeclaredNotice(
    "SC-915",
    "note",
    "The poses separate offset and gravity with a condition number of {condition:.1f} (1.7: best).",
    effect="U of the offsets and of the matrix is larger than necessary.",
    remedy="Add a pose with {pose} of the sensor down.",
    link="rotation.md",
)
WORLD_TILTED = DeclaredNotice(
    "SC-916",
    "note",
    "Down in the world deviates by ({tilt_deg:.2f} ± {expanded_deg:.2f})° from its stated direction (k = 2).",
    effect="The deviation is estimated and corrected.",
    remedy="Level the base, or correct `down`.",
    link="rotation.md",
)
AXES_ROTATED = DeclaredNotice(
    "SC-917",
    "note",
    "The forces are rotated by {rotation_deg:.2f}° against the stated axes of the sensor.",
    effect="The rotation is estimated and corrected for masses and centres. The force part of the matrix includes it "
    "as uncertainty; cross-talk of the sensor has the same effect.",
    remedy="Check `sensor_in_flange`.",
    link="rotation.md",
)
POSES_TAKEN_AS_INDEPENDENT = DeclaredNotice(
    "SC-918",
    "note",
    "The uncertainty of the orientations is not stated.",
    effect="Errors of single poses are part of the scatter; an error that neighbouring poses share is not in U.",
    remedy="State `orientation_uncertainty`.",
    link="rotation.md",
    possible_size="1 mrad moves the centre of mass by about 0.1 % of its distance",
)


# `shakercal elastomer`.


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
