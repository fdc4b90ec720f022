"""Notices of implausible statements in manifests: sizes that suggest another unit."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

IMPLAUSIBLE_INERTIA = DeclaredNotice(
    "SC-160",
    "warning",
    "{key}: a ball of {mass_kg:g} kg with the largest moment of inertia, {inertia_kgm2:g} kg m^2, has only "
    "{density_kgm3:.2g} kg/m^3.",
    effect="Forces and moments of the load would be wrong.",
    remedy="Check that the mass is in kg and the inertia in kg m^2.",
    link="recording-format.md#load",
)
IMPLAUSIBLE_CENTRE_OF_MASS = DeclaredNotice(
    "SC-161",
    "warning",
    "{key}: the centre of mass is {distance_m:g} m from the sensor, {ratio:.3g} times the load's radius of gyration "
    "({gyration_m:.3g} m).",
    effect="Moments of the load would be wrong.",
    remedy="Check that it is in m, and `load.inertia` in kg m^2 about the centre of mass.",
    link="recording-format.md#load",
)
IMPLAUSIBLE_DENSITY = DeclaredNotice(
    "SC-162",
    "warning",
    "{key}: the density is {density_kgm3:g} kg/m^3; solids have {low_kgm3:g} to {high_kgm3:g} kg/m^3.",
    effect="The buoyancy correction of the mass, or the modes of the part, would be wrong.",
    remedy="Check that the density is in kg/m^3.",
    link="recording-format.md#load",
)
LOAD_EXCEEDS_CAPACITY = DeclaredNotice(
    "SC-163",
    "warning",
    "{key}: the load weighs {weight_n:.3g} N, more than every rated force (up to {rated_n:g} N).",
    effect="The sensor would be overloaded, or a unit is wrong.",
    remedy="Check that the rated loads are in N and `load.mass` in kg.",
    link="recording-format.md#sensor",
)
IMPLAUSIBLE_STATIC_SENSITIVITY = DeclaredNotice(
    "SC-164",
    "warning",
    "{key}: output {output} would be {rated_mv_per_v:.3g} mV/V at its rated load; bridges give {low_mv_per_v:g} to "
    "{high_mv_per_v:g} mV/V.",
    effect="Corrections by the static matrix would be wrong.",
    remedy="Check that the matrix is in {unit} per N and N m, and `sensor.capacity` in N and N m.",
    link="recording-format.md#sensor",
)
IMPLAUSIBLE_CAMERA_BASE = DeclaredNotice(
    "SC-165",
    "warning",
    "{key}: the cameras are {base_m:.3g} m apart and the left one is {distance_m:.3g} m from the sensor.",
    effect="The scale or the position of the pair would be wrong.",
    remedy="Check that the translations of {calibration} and of the pair are in m.",
    link="recording-format.md#stereoname",
)
IMPLAUSIBLE_CAMERA_CROSSING = DeclaredNotice(
    "SC-166",
    "warning",
    "{key}: the camera axes cross {crossing_m:.3g} m before the left camera, which is {distance_m:.3g} m from the "
    "sensor.",
    effect="Positions and motions of this pair would be wrong.",
    remedy="Check that rotation and translation (m) of {calibration} mean x_right = R · x_left + t.",
    link="recording-format.md#stereoname",
)
CAMERA_POINTS_PAST_SENSOR = DeclaredNotice(
    "SC-167",
    "warning",
    "{key}: the left camera points {angle_deg:.3g}° past the sensor, and {inverse_angle_deg:.3g}° with the inverse "
    "rotation.",
    effect="The motion would be assigned to wrong axes.",
    remedy="Check that x_sensor = rotation · x_left_camera + translation.",
    link="recording-format.md#stereoname",
)
LOAD_HANGS = DeclaredNotice(
    "SC-168",
    "note",
    "{key}: gravity points from the sensor to {target}, so the load hangs under the sensor.",
    effect="Gravity in tilted axes would have the wrong sign if the load stands on the sensor.",
    remedy="If the load stands on the sensor, reverse the sign. Gravity points down.",
    link="recording-format.md#environment",
)
LARGE_DIRECTION_UNCERTAINTY = DeclaredNotice(
    "SC-169",
    "warning",
    "{key}: the uncertainty of the direction is {u_rad:.3g} rad ({u_deg:.3g}°).",
    effect="U would be too large if degrees were stated.",
    remedy="State the angle in rad.",
    link="recording-format.md#daqchannel",
)
LARGE_SCALE_UNCERTAINTY = DeclaredNotice(
    "SC-170",
    "warning",
    "{key}: the relative uncertainty of the scale is {u:.3g} ({u:.1%}).",
    effect="U would be too large if per cent were stated.",
    remedy="State the share, such as 0.01 for 1 %.",
    link="recording-format.md#daqchannel",
)
LARGE_RESPONSE_UNCERTAINTY = DeclaredNotice(
    "SC-171",
    "warning",
    "{key}: the uncertainty of its magnitude is {u:.1%} at {frequency_hz:g} Hz.",
    effect="U would be too large if the table stated per cent.",
    remedy="State the uncertainty in the unit of the magnitude.",
    link="recording-format.md#response-files",
)
RESPONSE_PHASE_MAY_BE_DEGREES = DeclaredNotice(
    "SC-172",
    "warning",
    "{key}: its phase is {phase_rad:.3g} rad at {frequency_hz:g} Hz although its magnitude is constant.",
    effect="The phase of the channel would be wrong if the table stated degrees.",
    remedy="Check that the phases are in rad.",
    link="recording-format.md#response-files",
)
LONG_DELAY = DeclaredNotice(
    "SC-173",
    "warning",
    "{key}: the delay of {delay_s:g} s is {periods:.3g} periods of {frequency_hz:g} Hz.",
    effect="The phase of the channel would be wrong.",
    remedy="State the delay in s.",
    link="recording-format.md#daqchannel",
)
DISTANT_CHANNEL_POINT = DeclaredNotice(
    "SC-174",
    "warning",
    "{key}: the point is {distance_m:.3g} m from the load's centre of mass; the load reaches {reach_m:.3g} m.",
    effect="The motion of the sensor origin would be wrong.",
    remedy="State the point in m in sensor axes.",
    link="recording-format.md#daqchannel",
)
