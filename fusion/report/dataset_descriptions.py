"""Unit, description and named axes of every data set in result files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from fusion.report.h5_tree import Data, Group
from shaker.labels import AXES, LOAD_COMPONENTS, LOAD_UNITS, MOTION_COMPONENTS, component_units, sensitivity_unit


class DatasetDescription(NamedTuple):
    """Description of a data set; an empty field is filled by rules.

    `axes`: names of its axes. A name refers to the data set of one axis in the group or above it. `unit`: ASCII;
    `value` for the unit of the group's values, `squared` for products of these, `.` for one unit per row as in the data
    set `unit`. `text`: name in words.
    """

    axes: str = ""
    unit: str = ""
    text: str = ""


def _described(rows: Mapping[str, tuple[str, ...]]) -> dict[str, DatasetDescription]:
    """Return descriptions from their axes, units and texts."""
    return {name: DatasetDescription(*row) for name, row in rows.items()}


K, KC, KQ, EACH = "frequency_hz", "frequency_hz channels", "frequency_hz elements", "[unit of the channel]"
SPREAD = {
    "mean": "mean of the draws",
    "u": "standard deviation of the draws",
    "low": "lower end of the 95 % interval",
    "high": "upper end of the 95 % interval",
    "u_end": "standard uncertainty of the ends by the number of draws",
    "first_u": "standard uncertainty by first order",
    "first_low": "lower end of the 95 % interval by first order",
    "first_high": "upper end of the 95 % interval by first order",
}
"""Descriptions of the statistics of Monte Carlo draws of a real quantity."""
DATASETS = _described(
    {
        "frequency_hz": (K, "Hz", "frequency"),
        "u_frequency_hz": (K,),
        "nominal_hz": (K, "", "nominal fundamental of the line"),
        "multiple": (K, "1", "harmonic number of the line"),
        "dof": (K, "1", "degrees of freedom"),
        "kind": (K,),
        "why": (K,),
        "channels": ("channels",),
        "components": ("components",),
        "unit": ("channels",),
        "value": (KC, "value", "peak phasors"),
        "covariance": ("frequency_hz row column", "squared", "covariance of [all Re, all Im]"),
        "observed": (KC, "1", "whether the component is a result"),
        "disputed": (KC, "1", "whether instruments contradict each other in the component"),
        "assumed": (KC, "value", "largest amplitude of an unobserved component, infinite without a limit"),
        "driven": (K, "m/s^2", "largest amplitude of the driven motion, infinite without a limit"),
        "drive": ("motion", "1", "driven motion, rotations times 0.1 m, a unit vector"),
        "leaked": ("frequency_hz row column", "value", "contribution of one u of unobserved motion to [Re, Im]"),
        "instruments": ("instruments",),
        "capacity": ("components", "load", "rated loads"),
        "static": ("channels components", "static", "static sensitivity"),
        "static_sensitivity": ("channels components", "static", "static sensitivity"),
        "direction": ("axis", "1", "direction in the sensor frame"),
        "frequencies": ("excitation", "Hz", "stated frequencies"),
        "origin_m": ("axis", "", "point that the motion is referred to"),
        "elements": ("element of", "1", "number of channel and of component (0 to 5: Fx to Mz) of each element"),
        "half_axis": ("channels components", "1", "larger half axis of the 95 % region"),
        "holds_zero": ("channels components", "1", "whether the 95 % region includes zero"),
        "main": ("channels", "1", "number of the main component (0 to 5: Fx to Mz)"),
        "load_size": ("components", "load", "largest loads of the recordings"),
        "effect": ("name frequency_hz row", "value", "change of [all Re, all Im] for one u of each unknown"),
        "uncertainty/dof": ("name", "1", "degrees of freedom of u"),
        "uncertainty/u": ("name", ".", "standard uncertainty of the unknown"),
        **{f"uncertainty/{text}": ("name",) for text in ("name", "label", "unit", "scope", "type")},
        "unknowns/*": ("name",),
        "unknowns/u": ("name", ".", "standard uncertainty of the unknown"),
        "unknowns/estimate": ("name", "1", "estimate of the unknown over its u"),
        "unknowns/remaining": ("name", "1", "u after the estimate over u before"),
        "unknowns/recordings": ("name", "1", "number of recordings that determine the unknown"),
        "posterior": ("unknown unknown_of", "1", "covariance of the unknowns after the estimate, in their u"),
        "products": ("unknown", "1", "second-order effect of each unknown, in its u"),
        "both": ("both", "", "unknowns that act on the load through the motion and directly"),
        "consistency/*": ("instrument",),
        "consistency/channels": ("instrument", "1", "number of channels"),
        "consistency/normalised_deviation": ("instrument", "1", "normalised deviation from all others"),
        "consistency/ratio": ("instrument", "1", "measured over predicted"),
        **{f"consistency/{word}": ("instrument", "1", f"whether it is {word}") for word in ("used", "suspect")},
        "consistency/left_out": ("instrument", "1", "whether it is left out as a gross error"),
        "unnoticed/*": ("case",),
        "unnoticed/shift": ("case", "1", "shift of the component over its U"),
        "notices/*": ("notice",),
        "evidence/*": ("input",),
        "evidence/value": ("input", ".", "stated value of the input"),
        "evidence/u": ("input", ".", "standard uncertainty of the unknown"),
        "scatter/*/amplitude": (K, "1", "scatter in phase with the reading, relative to the motion"),
        "scatter/*/phase": (K, "rad", "scatter at right angles to the reading, relative to the motion"),
        "budget/*/coefficient": (
            "quantity frequency_hz element",
            "per",
            "change of relative magnitude and phase per unit",
        ),
        "u_relative": ("frequency_hz element", "1", "contribution to the u of the relative magnitude"),
        "u_phase_rad": ("frequency_hz element", "", "contribution to the u of the phase"),
        "excerpt_s": ("excerpt_s", "", "time of the excerpt"),
        "excerpt": ("excerpt_s", "value", "excerpt of the record"),
        "excerpt_fit": ("excerpt_s", "value", "fit to the excerpt"),
        "spectrum_hz": ("spectrum_hz", "", "frequency of the spectrum"),
        "spectrum": ("spectrum_hz", "value", "amplitude spectrum"),
        "time_s": ("time_s", "", "time on the clock of the first recorder"),
        "stationarity/value": ("time_s frequency_hz channels", "value", "peak phasors of the blocks"),
        "stationarity/u": ("time_s frequency_hz channels", "value", "standard uncertainty of either part"),
        "amplitude_per_s": (KC, "value/s", "rate of change of the amplitude"),
        "u_amplitude_per_s": (KC, "value/s", "standard uncertainty of the rate of change of the amplitude"),
        "phase_rad_per_s": (KC, "rad/s", "rate of change of the phase"),
        "u_phase_rad_per_s": (KC, "rad/s", "standard uncertainty of the rate of change of the phase"),
        "p_value": (KC, "1", "chance that noise alone moves the blocks that far"),
        "pose": ("time_s channels", "value", "pose: translation and rotation vector"),
        "motion/covariance": ("time_s channels component", "squared", "covariance of the pose"),
        "motion_from_mean/covariance": ("time_s channels component", "squared", "covariance of the pose"),
        "residual_m": ("time_s", "", "rms residual of the points per coordinate"),
        "motion/points": ("time_s", "1", "number of points used"),
        "motion_from_mean/points": ("time_s", "1", "number of points used"),
        "stereo/*/residual": ("time_s channels", "value", "residual of the sine approximation of the pose"),
        "usable": ("line", "1", "whether the camera rate resolves the line"),
        "subsets_px": ("subset coordinate", "", "position of the subsets in the first left image"),
        "first_image": ("y x", "1", "first left image, contrast stretched to 8 bits"),
        "subset_zncc": ("subset", "1", "correlation of the subsets in the left camera, mean over the frames"),
        "sigma_px": ("of", "", "median standard deviation of a subset's coordinate: predicted, found"),
        "prnu": ("camera value", "1", "relative rms of the pixels' gains by the fixed pattern, and its u"),
        "read_variance_grey2": ("camera", "1", "variance of the dark sensor in grey values squared"),
        "variance_per_grey": ("camera", "1", "variance per grey value"),
        "deflection/value": (
            "frequency_hz point axis",
            "m",
            "deflection in addition to the rigid motion, peak phasors",
        ),
        "deflection/u": ("frequency_hz point axis", "m", "standard uncertainty of either part"),
        "shapes/effects": ("unknown frequency_hz channels", "m", "change of the amplitudes by 1 u of an unknown"),
        "shapes/share": ("component channels", "1, rad/m", "rigid motion per amplitude in that of the pair"),
        "shapes/form": ("channels point axis", "1", "displacement of the points for an amplitude of 1 m"),
        "shapes/f": (K, "1", "F of the amplitudes of all shapes against a rigid body"),
        "shapes/chance": (K, "1", "chance of an F as large on a rigid body"),
        "shapes/modes": ("", "1", "number of significant independent shapes"),
        "reference_m": ("point axis", "", "position of the points at rest"),
        "course_px": ("time_s share", "", "epipolar residual: mean, change along x, change along y"),
        "u_course_px": ("time_s share", "", "standard uncertainty of the epipolar residual"),
        "pattern_px": ("share", "", "epipolar residual of the recording: mean, change along x, change along y"),
        "pattern_covariance": ("share share_of", "px^2", "covariance of the pattern by calibration and matching"),
        "position_px": ("point coordinate", "", "mean position of the points in the left image"),
        "residual_px": ("point", "", "mean epipolar residual of the points"),
        "offset": ("channels", "value", "offset"),
        "offset_covariance": ("channels component", "squared", "covariance of the offset"),
        "drift_per_s": ("channels", "value/s", "drift"),
        "residual_rms": ("channels", "value", "rms residual of the sine approximation"),
        "decay_per_s": (K, "1/s", "decay of the line"),
        "u_decay_per_s": (K, "1/s"),
        "slopes": ("set row column", "1", "share of the lines' parts times time that the fit follows"),
        "spikes": ("spike", "1", "number of each frame left out"),
        "others/amplitude": ("frequency_hz channel", EACH, "peak amplitude in the channel"),
        "others/u_amplitude": ("frequency_hz channel", EACH, "standard uncertainty of the peak amplitude"),
        "snr": (K, "1", "power of the line over that of the noise"),
        "origin": (K,),
        "floor": ("floor_hz channel", EACH, "noise floor as amplitude per bin"),
        "floor_hz": ("floor_hz", "", "frequency of the noise floor"),
        "nuisance_hz": ("nuisance_hz", "", "lines fitted in addition to those of the recording"),
        "trigger/number": ("number", "1", "number of the edge"),
        **{f"trigger/{name}": ("number",) for name in ("edge_s", "lower_s", "upper_s", "correction_s")},
        "trigger/missing": ("missed", "1", "numbers without an edge"),
        "trigger/covariance": ("parameter other", "s^2", "covariance of start_s and period_s"),
        "trigger/known_period_s": ("parts", "", "period known from other sources than its edges, and its u"),
        "tie/follows": ("parameter other", "[s, 1]/s", "effect of errors of the first start_s and period_s"),
        "tie/beside": ("parameter other", "[s, 1]^2", "covariance of the rest"),
        "tie/covariance": ("parameter other", "[s, 1]^2", "covariance of offset_s and rate"),
        "tie/noise": ("parameter other", "[s, 1]^2", "its part by the noise of the edges"),
        "axes": ("across axis", "1", "directions across that of the points"),
        "place_m": ("channels across", "", "lever arms of the points"),
        "plane": ("frequency_hz plane_of", "[m/s^2, rad/s^2, rad/s^2]", "mean and angular accelerations of the points"),
        "points/*/residual": (KC, "m/s^2", "residual of the plane"),
        "fused": (K, "value", "output over the load of the fused motion"),
        "set_ups/*/value": (K, EACH, "phasors of the reference channel"),
        "supports/*/observed": (KC, "1", "whether the references alone determine the component"),
        "supports/*/measured_mps2": (K, "m/s^2", "largest translation that the instruments on it measure"),
        "references": ("reference",),
        "carried": ("row",),
        "factor": (K, "1", "factor that ties the set-up to the first"),
        "drift": (K, "1", "change of the reference's magnitude"),
        "u_drift": (K, "1"),
        "results/*/elements": ("elements",),
        "results/*/unit": ("elements",),
        "results/*/value": (KQ, "value", "values of the evaluation"),
        "results/*/mean": (KQ, "value", "mean of the draws"),
        "results/*/covariance": (f"{KQ} part part_of", "[unit]^2", "covariance of (Re, Im) of the draws"),
        "results/*/first_covariance": (f"{KQ} part part_of", "[unit]^2", "covariance of (Re, Im) by first order"),
        "results/*/factor": (KQ, "1", "factor of the 95 % ellipse of the draws"),
        "results/*/first_region": (f"{KQ} part part_of", "[unit]^2", "matrix of the 95 % region by first order"),
        "results/*/first_holds": (KQ, "1", "share of the draws in the ellipse by first order"),
        "results/*/k_polar": (f"polar {KQ}", "1", "coverage factors of magnitude and of phase"),
        **{
            f"results/*/{of}/{name}": (KQ, unit, f"{of}: {text}")
            for of, unit in (("magnitude", "value"), ("phase", "rad"))
            for name, text in SPREAD.items()
        },
        "sensitivity/value": ("frequency_hz channels components", "value", "complex sensitivity"),
        "element/value": ("frequency_hz channels components", "value", "complex sensitivity, elements of the sensor"),
        "load/value": ("frequency_hz components", "value", "peak phasors of the load"),
        "load/observed": ("frequency_hz components", "1", "whether the component is a result"),
        "curves/*/value": ("frequency_hz element", "value", "complex sensitivity"),
        "repeats/*/value": ("channels", "value", "mean complex sensitivity"),
        "weight": ("recordings", "1", "weight in the mean"),
        "within": ("channels", "1", "relative standard deviation of a recording"),
        "between": ("channels", "1", "relative standard deviation of a mounting"),
        "mountings": ("recordings",),
        "linearity/*/amplitude": ("recordings", "driven", "amplitude of the load"),
        "slope": ("channels", "1/driven", "relative change per unit of load"),
        "change": ("channels", "1", "relative change from the smallest to the largest amplitude"),
        "linearity/*/covariance": ("channels part part_of", "1", "covariance of (Re, Im) of the change"),
        "linear": ("channels", "1", "whether the 95 % region of the change includes zero"),
        "matrices/*/value": ("channels components", "value", "complex 6x6 matrix"),
        "singular": ("independent", "1", "independent loads in their standard uncertainties"),
        "excitation/share": ("independent", "1", "singular values relative to the largest"),
        "agreement/*": ("drive",),
        "agreement/normalised_deviation": ("drive", "1", "normalised deviation from all others"),
        "agreement/readings": ("drive", "1", "number of readings"),
        "agreement/frequency_hz": ("drive", "Hz", "frequency"),
        "cross_talks/*/value": (
            "channels components",
            "1",
            "output under a rated load over that under its main rated load",
        ),
    }
)
"""Descriptions by the end of the path: the longest match counts, `*` matches any name."""
_TAILS: dict[str, list[list[str]]] = {}
for _name in DATASETS:
    _TAILS.setdefault(_name.rpartition("/")[2], []).append(_name.split("/"))
_LONGEST = max(name.count("/") + 1 for name in DATASETS)
SUFFIXES = {
    "_rad_per_s": "rad/s", "_per_s": "1/s", "_hz": "Hz", "_rad": "rad", "_s": "s", "_m": "m", "_m2": "m^2",
    "_px": "px", "_kg": "kg", "_n": "N", "_relative": "1", "_db": "dB",
}  # fmt: skip
"""Units by the ending of a field's name."""
PHASORS = {"frequency_hz", "value", "covariance", "channels", "unit"}
"""Members of a group of phasors, in any file."""


OTHERS = _described(
    {
        **dict.fromkeys(("value", "u", "stated", "u_stated", "reading"), ("", ".")),
        **dict.fromkeys(("damping_ratio", "u_damping_ratio", "share", "u_share"), ("", "1")),
        "load": ("", "load"),
        "dof": ("", "1", "degrees of freedom"),
        "averages": ("", "1", "number of averages"),
        "coherence": ("", "1", "coherence with the reference"),
        "line_correlation": ("", "1", "correlation of the noise of lines by their distance in bins"),
        "relative": ("", "1", "relative change for one u of the error"),
        "correlation": ("", "1", "correlation of the estimates"),
        "direction": ("", "1", "direction in the sensor frame"),
        "shares": ("", "1", "share of each release in the mean"),
        "estimate": ("", "1", "estimate of the unknown over its u"),
        "remaining": ("", "1", "u after the estimate over u before"),
    }
)
"""Descriptions of data sets of other commands by name; `.` if `unit` in the same group has as many rows."""
OVER = ("frequency_hz", "time_s")
"""Axes of data sets of the same length in the same group."""


def describe(top: Group) -> None:
    """Set `units`, `long_name` and dimension scales of every data set.

    `units` is ASCII: one unit; `[a, b]` if they differ along the last axis (for Re and again for Im if that is twice as
    long); `[a, b]^2` for products of the units of row and column; `[unit]` if the data set `unit` has them. In files of
    other commands only phasors and names with a known ending or meaning are described.
    """
    whole = "mounting" in top.attrs or "curves" in top
    for path, group, data in sorted(top.datasets(), key=lambda one: (one[0].count("/"), len(one[2].shape), one[0])):
        field, shape = path.rpartition("/")[2], data.shape
        described = whole or set(group.inside) >= PHASORS
        description = _description(path) if described else OTHERS.get(field, DatasetDescription())
        if data.numbers:
            unit = _unit(group, field, shape, description)
            if unit:
                data.attrs["units"] = unit
        data.attrs["long_name"] = description.text or _words(path)
        axes = (
            description.axes.split()
            if described
            else [name for name in OVER if _has_coordinates(group, field, shape, name)]
        )
        if not described and not axes:
            continue
        if len(axes) != len(shape):
            free_axes = [field] if len(shape) == 1 else [f"{field}_{axis + 1}" for axis in range(len(shape))]
            axes = free_axes if described else [*axes[:1], *free_axes[1:]]
        for axis, name in enumerate(axes):
            scale = _scale(group, name, shape[axis])
            if scale is not data:
                data.scales[axis] = scale


def _has_coordinates(group: Group, field: str, shape: tuple[int, ...], name: str) -> bool:
    """Return whether the data set of this name has the coordinates of the first axis."""
    return field != name and len(shape) > 0 and getattr(group.get(name), "shape", None) == shape[:1]


def _description(path: str) -> DatasetDescription:
    """Return the description for the longest match of a path, one without `*` first."""
    return _longest_match(tuple(path.strip("/").split("/")[-_LONGEST:]))


@cache
def _longest_match(names: tuple[str, ...]) -> DatasetDescription:
    """Return the description for the last names of a path."""
    parts = [re.sub(r"^\w+_uncertainty$", "uncertainty", part) for part in names]
    fitting = [
        tail
        for tail in _TAILS.get(parts[-1], []) + _TAILS["*"]
        if len(tail) <= len(parts) and all(a in ("*", b) for a, b in zip(tail[::-1], parts[::-1], strict=False))
    ]
    best = max(fitting, key=lambda tail: (len(tail), -tail.count("*")), default=None)
    return DATASETS["/".join(best)] if best else DatasetDescription()


def _words(path: str) -> str:
    """Return the name of a field in words: without its unit, `u_` as standard uncertainty."""
    name = path.rpartition("/")[2]
    ending = max((suffix for suffix in SUFFIXES if name.endswith(suffix)), key=len, default="")
    text = name.removesuffix(ending).replace("_", " ")
    return re.sub("^u(?: |$)", "standard uncertainty of the ", text).removesuffix(" of the ")


# Units of the values of a group, from its members.


def _unit(group: Group, name: str, shape: tuple[int, ...], description: DatasetDescription) -> str:
    """Return the unit of a data set, empty if unknown."""
    rules: dict[str, Callable[[], str]] = {
        "": lambda: next((unit for suffix, unit in SUFFIXES.items() if name.endswith(suffix)), ""),
        ".": lambda: _listed(group["unit"].values, "[unit]") if group["unit"].shape[0] == shape[-1] else "",
        "load": lambda: _listed(LOAD_UNITS) if shape[-1:] == (6,) else "",
        "per": lambda: f"[1, rad]/({group.attrs['unit'] or '1'})",
        "static": lambda: _listed(_sensitivity_units(group)),
        "driven": lambda: LOAD_UNITS[int(group.attrs["component"])],
        "1/driven": lambda: f"1/({LOAD_UNITS[int(group.attrs['component'])]})",
        "value": lambda: _listed(_sensitivity_units(group) if len(shape) > 1 and _is_matrix(group) else units()),
        "value/s": lambda: _listed(f"({unit})/s" if "/" in unit else f"{unit}/s" for unit in units()),
        "squared": lambda: _squared(_listed(units())),
    }

    def units() -> list[str]:
        return _units_of_values(group)

    try:
        return rules[description.unit]() if description.unit in rules else description.unit
    except KeyError:  # the group has no unit
        return ""


def _squared(listed: str) -> str:
    """Return the unit of products."""
    return listed if listed in ("", "1") else f"{listed}^2" if listed[0] == "[" else f"({listed})^2"


def _is_matrix(group: Group) -> bool:
    """Return whether the values of a group are over channels and load components."""
    top = group.name.split("/")
    return "uncertainty" not in top and (top[1:2] == ["matrices"] or top[1:] in (["sensitivity"], ["element"]))


def _sensitivity_units(group: Group) -> list[str]:
    """Return the units of sensitivities to the six load components."""
    return [sensitivity_unit(_output_unit(group), component) for component in LOAD_COMPONENTS]


def _listed(units: Iterable[str], several: str = "") -> str:
    """Return the common unit, else `several`, by default all units in brackets."""
    units = [str(unit) for unit in units]
    return units[0] if len(set(units)) == 1 else (several or f"[{', '.join(units)}]") if units else ""


def _output_unit(group: Group) -> str:
    """Return the unit of the outputs of a group's sensitivities."""
    return str(group.attrs.get("unit", group.top["sensor"].attrs["unit"] if "sensor" in group.top else ""))


def _owner(group: Group) -> tuple[Group, str]:
    """Return the group whose uncertainty this is, and which of its values (`plane`, `residual`)."""
    found = re.match(r"(.*)/(?:(\w+)_)?uncertainty(/.*)?$", group.name)
    return (group.top[found[1].strip("/")], found[2] or "") if found else (group, "")


def _units_of_values(group: Group) -> list[str]:
    """Return the units of the values of a group or of its parent."""
    owner, which = _owner(group)
    top = owner.name.split("/")[1:]
    stated = next((inner for inner in ("unit", "phasors/unit") if inner in owner), None)
    fixed = {
        "load": list(LOAD_UNITS),
        "cross_talks": ["1"],
        "stereo": list(component_units(0)),
        "points": ["m/s^2", "rad/s^2", "rad/s^2"] if which == "plane" else ["m/s^2"],
    }
    if stated is not None:
        units = list(owner[stated].values)
    elif top[0] in fixed and top[-1] != "ratios":
        units = fixed[top[0]]
    elif "components" not in owner and "component" in owner.attrs:
        component = owner.attrs["component"]
        units = [
            sensitivity_unit(_output_unit(owner), LOAD_COMPONENTS[component] if component in range(6) else component)
        ]
    elif "elements" in owner:
        units = [_sensitivity_units(owner)[j] for j in owner["elements"].values[:, 1]]
    elif top[0] == "matrices":
        units = _sensitivity_units(owner) * owner["channels"].shape[0]
    elif "unit" in owner.attrs:
        units = [str(owner.attrs["unit"])]
    else:
        units = _units_of_values(owner.parent) if len(top) > 1 else []
    return units


# Axes: coordinates of the group or of those above it, labels, or a length alone.


def _scale(start: Group, name: str, length: int) -> Data:
    """Return the dimension scale of an axis from this group or one above it.

    Create it if missing.
    """
    group = start
    while True:
        if getattr(group.get(name), "shape", None) == (length,):
            near: Data = group[name]
            near.scale = near.scale or name
            return near
        if group is group.top:
            break
        group = group.parent
    free = next(text for text in (name, *(f"{name}_{number}" for number in range(2, 99))) if text not in start)
    values = _coordinate(start, name, length)
    start[free] = np.zeros(length, ">f4") if values is None else values
    scale: Data = start[free]
    if values is None:
        scale.scale = f"This is a netCDF dimension but not a netCDF variable. {length:9d}"
    else:
        scale.scale = free
        scale.attrs["long_name"] = (
            "real parts, then imaginary parts" if name in ("row", "column") else _words(f"/{name}")
        )
        if scale.numbers:
            scale.attrs["units"] = "Hz"
    return scale


def _coordinate(group: Group, name: str, length: int) -> Any:
    """Return the coordinates of an axis, None if only its length is known."""
    owner, which = _owner(group)
    labels = _labels(owner, which) if name in ("row", "column", "element") else []
    groups = [owner, *(owner[inner] for inner in ("phasors", "fit/phasors") if inner in owner)]
    found: Any = next(
        (inner_group[name] for inner_group in groups if name in inner_group and inner_group[name].shape == (length,)),
        None,
    )
    if name in ("row", "column"):
        values: Any = [f"{part} {label}" for part in ("Re", "Im") for label in labels]
    elif name == "element":
        values = labels
    elif name == "components":
        values = LOAD_COMPONENTS
    elif name in ("channels", "component") and group.name.startswith("/stereo"):
        values = MOTION_COMPONENTS
    elif name == "axis":
        values = AXES
    elif found is not None:
        values = found.values
    else:
        values = np.array([owner.attrs["frequency_hz"]]) if name == K and K in owner.attrs else ()
    return values if len(values) == length > 0 else None


def _labels(owner: Group, which: str) -> list[str]:
    """Return the label of each value of a group."""
    if which == "plane":
        return ["mean", "rotation 1", "rotation 2"]
    if "elements" in owner:
        channels = owner["channels"].values
        return [f"{channels[c]}/{LOAD_COMPONENTS[j]}" for c, j in owner["elements"].values]
    top = owner.name.split("/")[1]
    if top == "load":
        return list(LOAD_COMPONENTS)
    inner = next((inner for inner in ("channels", "phasors/channels") if inner in owner), None)
    if inner is None:
        return _labels(owner.parent, which) if owner.name != "/" else []
    channels = list(owner[inner].values)
    if top in ("matrices", "cross_talks"):
        return [f"{channel}/{component}" for channel in channels for component in LOAD_COMPONENTS]
    return channels
