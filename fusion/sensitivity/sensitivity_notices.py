"""Notices and errors of the stage from acceleration to load and sensitivity."""

from shakercal._common.notices import DeclaredNotice

# Influences that are not assessed: notes with their possible size.

TEMPERATURE_NOT_ASSESSED = DeclaredNotice(
    "SC-468",
    "note",
    "The temperature of the sensor: {missing} not stated.",
    remedy="State both in rig.toml.",
    possible_size="{share:.2%} of the sensitivity, for {deviation_k:g} K and {coefficient_per_k:g}/K",
    link="assumptions.md",
)
CABLES_NOT_ASSESSED = DeclaredNotice(
    "SC-469",
    "note",
    "Cables and hoses on the load: `load.cable_stiffness` is not stated.",
    remedy="State it in rig.toml; zero if no cable pulls on the load.",
    possible_size="{share:.2%} of the force at {frequency_hz:.6g} Hz, for {stiffness_npm:g} N/m",
    link="assumptions.md",
)
BASE_STRAIN_NOT_ASSESSED = DeclaredNotice(
    "SC-470",
    "note",
    "Strain of the sensor's foot by bending of its support: {missing} not stated.",
    remedy="State both in rig.toml.",
    possible_size="not known",
    link="assumptions.md",
)
SUPPORT_MOTION_NOT_ASSESSED = DeclaredNotice(
    "SC-471",
    "note",
    "Motion of the supports of lasers and cameras: `environment.support_motion` is not stated.",
    remedy="Measure it with a reference at rest, or state its limit.",
    possible_size="0.1 % of the sensitivity for 0.1 % of the measured motion; {detectable}",
    link="room.md",
)
REPEATABILITY_NOT_ASSESSED = DeclaredNotice(
    "SC-472",
    "note",
    "Repeatability and the effect of a new mounting: this is a single recording.",
    remedy="Evaluate it in a campaign with repeated recordings and mountings.",
    possible_size="not known",
    link="campaigns.md",
)
OTHER_LOADS_NOT_ASSESSED = DeclaredNotice(
    "SC-473",
    "note",
    "The part of other loads in the ratio of output and {component}: the recording does not show the 6 x 6 matrix.",
    remedy="State `sensor.static_sensitivity` with cross-talk, or `sensor.cross_talk`.",
    possible_size="the cross-talk of the sensor times {loads}",
    link="uncertainty.md",
)
CROSS_TALK_BOUND = DeclaredNotice(
    "SC-474",
    "note",
    "The {element} is not corrected for other loads.",
    effect="U includes a cross-talk within ± {cross_talk:.2%} of the rated output at every rated load.",
    remedy="State `sensor.static_sensitivity` with its cross-talk to correct it.",
    link="uncertainty.md",
)
EXACT_INPUTS = DeclaredNotice(
    "SC-923",
    "note",
    "These inputs count as exact, because no uncertainty of them is stated ({inputs}).",
    remedy="State their uncertainties, such as `scale_uncertainty` in `[daq.defaults]`.",
    possible_size="the relative error of a scale or a mass changes the sensitivity by up to the same share; of the "
    "others not known",
    link="uncertainty.md",
)

# The result.

NO_RESULT_AT_LINES = DeclaredNotice(
    "SC-475",
    "warning",
    "No {quantity} at {frequencies} Hz ({lost} of {driven} driven lines): {reason}.",
    effect="The command ends with exit status 1.",
    remedy="Correct the manifest, or add an instrument.",
    acknowledgeable=False,
    link="uncertainty.md",
)
DIRECTION_DOUBTED = DeclaredNotice(
    "SC-476",
    "warning",
    "{component} of the {body} moves by {across:.3g} {unit} at {frequency_hz:.6g} Hz, but only by {along:.3g} m/s² "
    "along `excitation.direction`.",
    effect="The result may refer to the wrong component.",
    remedy="Check which axis is driven.",
    link="uncertainty.md",
)
ELEMENT_CHANGED = DeclaredNotice(
    "SC-477",
    "warning",
    "The {element} is {factor:.3g} times its static value at {frequency_hz:.6g} Hz, turned by {angle_rad:.3g} rad.",
    effect="Other elements may have changed equally, which U includes.",
    remedy="Check units and signs of the static matrix.",
    link="uncertainty.md",
)
OUTPUT_CONTRADICTS = DeclaredNotice(
    "SC-478",
    "warning",
    "Outputs contradict the static sensitivity at {frequency_hz:.6g} Hz: {outputs}.",
    effect="The sensitivity is probably wrong by these factors.",
    remedy="Check {checks}.",
    link="uncertainty.md",
)
MASS_DOUBTED = DeclaredNotice(
    "SC-479",
    "warning",
    "The {element} is {factor:.3g} times its static value at {frequency_hz:.6g} Hz, {resonance}.",
    effect="A mass may be wrong or missing.",
    remedy="Check `load.mass`, all parts that move with the load, `sensor.internal_mass`, and the chain of the output.",
    link="uncertainty.md",
)
OUTPUT_OPPOSES_LOAD = DeclaredNotice(
    "SC-480",
    "warning",
    "Output {output} opposes the load (phase {phase_rad:.3g} rad), and `sensor.static_sensitivity` states no sign.",
    effect="The sign of the sensitivity may be wrong.",
    remedy="Check directions, `sensor.sense` and the wiring.",
    link="uncertainty.md",
)
OUTPUT_LAGS = DeclaredNotice(
    "SC-481",
    "note",
    "Output {output} lags the load by {lag_mrad:.3g} mrad at {frequency_hz:.6g} Hz ({lag_us:.3g} µs).",
    effect="No delay or response of its measuring chain is stated, so the phase of the sensitivity includes it.",
    remedy="State `delay` or `response` if the amplifier has one.",
    link="uncertainty.md",
)
OUTPUT_LEADS_LOAD = DeclaredNotice(
    "SC-482",
    "warning",
    "Output {output} {direction} the load by {lag_mrad:.3g} mrad at {frequency_hz:.6g} Hz ({lag_us:.3g} µs).",
    effect="No delay or response of its measuring chain is stated, and a chain hardly causes such a phase.",
    remedy="Check the clocks, the mass of the load and the measuring chain.",
    link="uncertainty.md",
)

# The load.

LOAD_UNSTATED = DeclaredNotice(
    "SC-483",
    "error",
    "expected {expected}, found {found}",
    effect="Without a mass the acceleration gives no load.",
    remedy="State [load] in rig.toml.",
    link="recording-format.md",
)
POSITION_UNSTATED = DeclaredNotice(
    "SC-484",
    "error",
    "The load is elastic, but the position of {instrument} on it is not stated ({key}).",
    effect="Its motion relative to the foot of the load is not known.",
    remedy="State the position.",
    link="modes.md",
)
UNOBSERVED_MOTION_LARGE = DeclaredNotice(
    "SC-485",
    "warning",
    "No instrument measures {components} at some lines; this contributes {u_percent:.2g} % to u of {load} at "
    "{frequency_hz:.6g} Hz, {share:.0%} of its variance.",
    effect="Amplitudes up to {limits} are assumed{driven}.",
    remedy="Measure these components, or state the limits in [shaker].",
    link="uncertainty.md",
)
UNOBSERVED_MOTION_ASSUMED = DeclaredNotice(
    "SC-486",
    "note",
    "No instrument measures {components} at some lines; this contributes {u_percent:.2g} % to u of {load} at "
    "{frequency_hz:.6g} Hz, {share:.0%} of its variance.",
    effect="Amplitudes up to {limits} are assumed{driven}.",
    remedy="Measure these components, or state the limits in [shaker].",
    link="uncertainty.md",
)
LOAD_UNDETERMINED = DeclaredNotice(
    "SC-487",
    "note",
    "{components} have no value.",
    effect="Components of the motion that no instrument measures may dominate them.",
    remedy="Add measuring points or directions.",
    link="uncertainty.md",
)
ELASTIC_CORRECTED = DeclaredNotice(
    "SC-488",
    "note",
    "{load} at {frequency_hz:.6g} Hz differs by {change_percent:+.2g} % from that of a rigid body, because of {parts}.",
    effect="The result is corrected for it; accelerations of the load are those of {moving}.",
    link="modes.md",
)
ELASTIC_ONLY_NAMED = DeclaredNotice(
    "SC-489",
    "note",
    "The {part} ({frequency_hz:.6g} Hz) is stated without any uncertainty.",
    effect="The result is not corrected for it; U includes the whole effect.",
    remedy="State an uncertainty to correct the result.",
    link="modes.md",
)
DRAWING_TOO_HEAVY = DeclaredNotice(
    "SC-490",
    "warning",
    "The elastic {part} weighs {mass_kg:.4g} kg by its drawing, all moving parts {total_kg:.4g} kg.",
    effect="The modes of this part are probably wrong.",
    remedy="Check its dimensions and density, and `load.mass`.",
    link="modes.md",
)
NEAR_RESONANCE = DeclaredNotice(
    "SC-491",
    "warning",
    "{frequency_hz:.6g} Hz is near the natural frequency {natural_hz:.6g} Hz of the elastic {part}.",
    effect="The damping determines the result there, and U by first order may be too small.",
    remedy="Use the Monte Carlo method, or another frequency.",
    link="modes.md",
)
LOAD_MAY_DEFORM = DeclaredNotice(
    "SC-492",
    "warning",
    "The load may not be rigid at {frequency_hz:.6g} Hz: a solid of its size resonates near {natural_hz:g} Hz.",
    effect="This changes {load} by about {change:.1%}, which is neither corrected nor included in U.",
    remedy="State [[load.elastic]], or `load.first_frequency` to bound the effect.",
    link="modes.md",
)
MODES_CONTRADICT = DeclaredNotice(
    "SC-493",
    "warning",
    "The elastic {part} of the load does not move at {frequency_hz:.6g} Hz as its stated frequencies and damping "
    "predict.",
    effect="The motion measured by stereo pair {pair} is used instead.",
    remedy="Check [[load.elastic]] and the mounting of the load.",
    link="modes.md",
)

# Motion of supports.

SUPPORT_EXCEEDS_LIMIT = DeclaredNotice(
    "SC-494",
    "warning",
    "It moves at {frequency_hz:.6g} Hz by more than `environment.support_motion`, {limit:g} of the measured motion.",
    effect="Its motion is determined by its reference alone.",
    remedy="Correct `environment.support_motion`, or improve the support.",
    link="room.md",
)
SUPPORT_CORRECTED = DeclaredNotice(
    "SC-495",
    "note",
    "It moves with the excitation along {axis} by ({share} ± {expanded}) % of the measured motion at "
    "{frequency_hz:.6g} Hz (k = 2, by {references}).",
    effect="The readings are corrected for it.",
    link="room.md",
)
SUPPORT_UNCERTAIN = DeclaredNotice(
    "SC-496",
    "note",
    "The uncertainty of its motion is {u_relative:.2g} of the measured motion at {frequency_hz:.6g} Hz (by "
    "{references}).",
    effect="U includes it.",
    remedy="Use a larger or nearer reference, or more frames.",
    link="room.md",
)

# Monte Carlo.

FIRST_ORDER_TOO_SMALL = DeclaredNotice(
    "SC-497",
    "warning",
    "First-order U is smaller than that of {draws} Monte Carlo draws: {quantities}.",
    effect="The intervals and regions of the Monte Carlo method are valid there.",
    remedy="Use the Monte Carlo results.",
    link="uncertainty.md",
)
FIRST_ORDER_TOO_LARGE = DeclaredNotice(
    "SC-498",
    "note",
    "First-order U is larger than that of {draws} Monte Carlo draws: {quantities}.",
    effect="The first-order results remain valid and are conservative.",
    link="uncertainty.md",
)
DRAWS_NOT_CONVERGED = DeclaredNotice(
    "SC-499",
    "error",
    "The Monte Carlo estimate did not converge: positions or directions are too uncertain.",
    remedy="Reduce their stated uncertainties.",
    link="uncertainty.md",
)
