"""The commands that model the sensor: rotate, identify, step, load, compensate, decouple, elastomer."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.options import (
    EXIT_DONE,
    Commands,
    add_allow_outside,
    add_recordings,
    add_results,
    count,
    not_negative,
    positive,
)

# `shakercal rotate`: internal mass and load mass from the sensor turned on an indexing head.


def add_rotate(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "rotate", parents=[common], help="internal mass and load mass from the sensor turned about a horizontal axis"
    )
    add_recordings(parser)
    add_results(parser, "folder rotate in the campaign or in the only recording, else beside rig.toml")
    parser.set_defaults(action=_act_rotate)


def _act_rotate(options: argparse.Namespace) -> int:
    from fusion.sensor.rotate.report import run_rotate

    run_rotate(options.recordings, options.output, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE


# `shakercal identify`: stiffness, damping and internal mass of the sensor from all recordings of a campaign.


def add_identify(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "identify", parents=[common], help="stiffness, damping and internal mass of the sensor from a whole campaign"
    )
    parser.add_argument("campaign", type=Path, metavar="CAMPAIGN", help="folder of a campaign or of one recording")
    add_allow_outside(parser)
    parser.add_argument(
        "--model",
        choices=("auto", "translation", "pitching", "adapter"),
        default="auto",
        help="default: auto, translation, and pitching where a second peak calls for it",
    )
    parser.add_argument(
        "--damping", choices=("common", "each"), default="common", help="one for all recordings, or one for each"
    )
    parser.add_argument(
        "--internal-mass",
        choices=("auto", "free", "stated"),
        default="auto",
        help="default: auto, fitted where two load masses or more tell it from the stiffness, else that of rig.toml",
    )
    parser.add_argument(
        "--band", nargs=2, type=not_negative, metavar=("LOW", "HIGH"), help="lines to fit, in Hz (default: all)"
    )
    parser.add_argument(
        "--load-mass",
        nargs="+",
        type=positive,
        default=(),
        metavar="KG",
        help="masses for which corrections and usable bands are given (default: those of the recordings)",
    )
    parser.add_argument(
        "--permitted",
        type=_share,
        default=0.05,
        metavar="SHARE",
        help="error of the magnitude up to which a band is usable (default: 0.05)",
    )
    add_results(parser, "CAMPAIGN/identify")
    parser.set_defaults(action=_act_identify)


def _share(text: str) -> float:
    """Return a number between 0 and 1."""
    value = positive(text)
    if value >= 1.0:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text}")
    return value


def _act_identify(options: argparse.Namespace) -> int:
    from fusion.base import InputError
    from fusion.sensor.identify.measured import IdentifySettings
    from fusion.sensor.identify.run import run_identify

    band = None if options.band is None else (options.band[0], options.band[1])
    if band is not None and band[0] >= band[1]:
        found = f"{band[0]:g} and {band[1]:g}"
        raise InputError(options.campaign, "--band", found=found, expected="two frequencies in Hz, the lower first")
    settings = IdentifySettings(
        model=options.model,
        damping=options.damping,
        internal_mass=options.internal_mass,
        band_hz=band,
        load_masses_kg=tuple(options.load_mass),
        permitted=options.permitted,
    )
    run_identify(options.campaign, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE


# `shakercal step`: models of a sensor's outputs from releases of a load.


def add_step(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "step", parents=[common], help="models of the sensor's outputs from releases of a load: modes, bands, settling"
    )
    add_recordings(parser)
    parser.add_argument(
        "--method",
        choices=("pencil", "arx", "all"),
        default="pencil",
        help="start of the fit: matrix pencil (default) or instrumental-variable ARX; all: compare every method",
    )
    parser.add_argument("--modes", type=count, metavar="N", help="oscillating modes of a model (default: by rule)")
    parser.add_argument("--real-poles", type=_poles, metavar="N", help="real poles of a model (default: by rule)")
    parser.add_argument(
        "--release",
        choices=("auto", "step", "ramp", "smooth", "measured"),
        default="auto",
        help="how the load changes (default: auto, the force channel where one is named, else by rule)",
    )
    add_results(parser, "folder step in the campaign or in the only recording, else beside rig.toml")
    parser.set_defaults(action=_act_step)


def _poles(text: str) -> int:
    """Return a number of real poles."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, found {text}")
    return value


def _act_step(options: argparse.Namespace) -> int:
    from fusion.sensor.step.records import StepSettings
    from fusion.sensor.step.run import run_step

    settings = StepSettings(options.method, options.modes, options.real_poles, options.release)
    run_step(options.recordings, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE


# `shakercal load`: resonance over load mass, load limits, from releases with several loads or a table.


def add_load(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "load", parents=[common], help="stiffness, resonance over load mass and load limits from releases with loads"
    )
    parser.add_argument(
        "recordings", type=Path, nargs="*", metavar="RECORDING", help="folder of a campaign, or of step recordings"
    )
    add_allow_outside(parser)
    parser.add_argument(
        "--frequencies",
        type=Path,
        metavar="TABLE",
        help="in place of recordings: CSV with load_mass_kg, frequency_hz and, if known, u_frequency_hz, second_hz, "
        "u_load_mass_kg",
    )
    parser.add_argument("--moving-mass", type=positive, metavar="KG", help="of the sensor, with --frequencies")
    parser.add_argument(
        "--moving-mass-uncertainty", type=not_negative, default=0.0, metavar="KG", help="standard uncertainty (0)"
    )
    parser.add_argument(
        "--load-mass",
        type=positive,
        nargs="+",
        default=[],
        metavar="KG",
        help="foretell resonance and bands with these loads, such as a gripper or a hand (kg; of moments kg m^2)",
    )
    parser.add_argument(
        "--permitted", type=_percent, default=0.05, metavar="PERCENT", help="error up to which loads are permitted (5)"
    )
    parser.add_argument(
        "--wanted", type=positive, nargs="+", default=[], metavar="HZ", help="largest load for these resonances"
    )
    add_results(parser, "folder load in the campaign, in the only recording, or beside rig.toml or TABLE")
    parser.set_defaults(action=_act_load, refuse=parser.error)


def _act_load(options: argparse.Namespace) -> int:
    from fusion.sensor.load.evaluate import LoadSettings
    from fusion.sensor.load.run import run_loads, run_table

    _check(options)
    table = options.frequencies is not None
    moving = (options.moving_mass, options.moving_mass_uncertainty) if table else None
    settings = LoadSettings(options.permitted, tuple(options.wanted), tuple(options.load_mass), moving)
    if table:
        run_table(options.frequencies, options.output, settings, force=options.force)
    else:
        run_loads(
            options.recordings, options.output, settings, force=options.force, allow_outside=options.allow_outside
        )
    return EXIT_DONE


def _check(options: argparse.Namespace) -> None:
    """Refuse recordings and a table at once, neither, and a table without the mass that its resonances belong to."""
    table = options.frequencies is not None
    if table == bool(options.recordings):
        options.refuse("expected either recordings or --frequencies TABLE")
    if table and options.moving_mass is None:
        options.refuse("--frequencies needs --moving-mass: resonances tell stiffness only over mass")
    if not table and options.moving_mass is not None:
        options.refuse("--moving-mass is for --frequencies: of recordings rig.toml states sensor.internal_mass")


def _percent(text: str) -> float:
    """Return a percentage above 0 and below 100 as a share."""
    value = positive(text)
    if value >= 100.0:
        raise argparse.ArgumentTypeError(f"expected less than 100 %, found {text}")
    return value / 100.0


# `shakercal compensate`: filters that give a sensor the dynamics one wants.


def add_compensate(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "compensate", parents=[common], help="filters that give a sensor the resonance, damping or bandwidth one wants"
    )
    _add_sensor(parser)
    _add_target(parser)
    _add_samples(parser)
    add_results(parser, "folder compensate beside the first model, or in the working folder")
    parser.set_defaults(action=_act_compensate)


def _add_sensor(parser: argparse.ArgumentParser) -> None:
    """What is compensated."""
    parser.add_argument(
        "models",
        type=Path,
        nargs="*",
        metavar="MODEL",
        help="models.json of shakercal step, load.json of shakercal load, or a folder with one",
    )
    parser.add_argument("--sensor-frequency", type=positive, metavar="HZ", help="natural frequency, without a model")
    parser.add_argument("--sensor-damping", type=not_negative, metavar="ZETA", help="damping ratio, without a model")
    parser.add_argument("--channel", nargs="+", default=[], metavar="NAME", help="output channels (default: all)")
    parser.add_argument(
        "--load-mass", type=not_negative, nargs="+", default=[], metavar="KG", help="loads of a model over the load, kg"
    )
    parser.add_argument("--modes", type=count, default=1, metavar="N", help="modes to compensate (default: 1)")


def _add_target(parser: argparse.ArgumentParser) -> None:
    """What is wanted."""
    parser.add_argument("--frequency", type=positive, metavar="HZ", help="natural frequency of the target")
    parser.add_argument(
        "--damping",
        type=positive,
        metavar="ZETA",
        help="damping ratio of the target (default: the one with the widest band for the permitted error)",
    )
    parser.add_argument(
        "--bandwidth", type=positive, metavar="HZ", help="instead of both: up to where the gain shall be right"
    )
    parser.add_argument(
        "--permitted-error", type=positive, default=10.0, metavar="PERCENT", help="of the gain (default: 10)"
    )
    parser.add_argument("--real-pole", type=positive, metavar="HZ", help="move the slowest real pole here")
    parser.add_argument(
        "--low-pass", type=positive, metavar="HZ", help="corner of a Butterworth low-pass in the filter: less noise"
    )
    parser.add_argument(
        "--calibrated", action="store_true", help="divide by the static gain too: the filter puts out the load"
    )


def _add_samples(parser: argparse.ArgumentParser) -> None:
    """How it is sampled, and what is filtered."""
    parser.add_argument("--sample-rate", type=positive, metavar="HZ", help="of the filter (default: that of the model)")
    parser.add_argument(
        "--discretisation",
        choices=("matched", "tustin"),
        default="matched",
        help="matched poles and zeros, or Tustin prewarped at each mode (default: matched)",
    )
    parser.add_argument("--apply", type=Path, metavar="RECORDING", help="filter the outputs of this recording too")
    parser.add_argument(
        "--ball", type=positive, metavar="N_PER_M", help="check force feedback against a virtual ball of this stiffness"
    )
    add_allow_outside(parser)


def _act_compensate(options: argparse.Namespace) -> int:
    from fusion.sensor.compensate.run import run_compensate
    from fusion.sensor.compensate.source import Wish

    wish = Wish(
        frequency_hz=options.frequency,
        damping_ratio=options.damping,
        bandwidth_hz=options.bandwidth,
        permitted_error=options.permitted_error / 100.0,
        real_hz=options.real_pole,
        low_pass_hz=options.low_pass,
        modes=options.modes,
        sample_rate_hz=options.sample_rate,
        discretisation=options.discretisation,
        calibrated=options.calibrated,
        load_masses=tuple(dict.fromkeys(options.load_mass)),
        channels=tuple(options.channel),
        ball_stiffness=options.ball,
    )
    run_compensate(
        options.models,
        (options.sensor_frequency, options.sensor_damping),
        wish,
        options.output,
        recording=options.apply,
        force=options.force,
        allow_outside=options.allow_outside,
    )
    return EXIT_DONE


# `shakercal decouple`: one model of all outputs over all loads, and a filter against cross-talk.


def add_decouple(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "decouple",
        parents=[common],
        help="model of all outputs over all loads from releases; filter against cross-talk",
    )
    parser.add_argument(
        "campaign", type=Path, metavar="CAMPAIGN", help="folder with recordings of releases of all loads"
    )
    add_allow_outside(parser)
    parser.add_argument(
        "--frequency",
        type=positive,
        metavar="HZ",
        help="wanted frequency behind the filter (default: half the lowest mode's)",
    )
    parser.add_argument(
        "--damping",
        type=_damping,
        default=0.6,
        metavar="Z",
        help="wanted damping ratio, between 0 and 1 (default: 0.6)",
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the models drawn for U (default: 1)")
    add_results(parser, "folder decouple in the campaign")
    parser.set_defaults(action=_act_decouple)


def _damping(text: str) -> float:
    """Return a damping ratio of an oscillator."""
    value = float(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text}")
    return value


def _act_decouple(options: argparse.Namespace) -> int:
    from fusion.sensor.decouple.evaluate import DecoupleSettings
    from fusion.sensor.decouple.report import run_decouple

    settings = DecoupleSettings(options.frequency, options.damping, options.seed)
    run_decouple(options.campaign, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE


# `shakercal elastomer`: stiffness and modes of a cross-beam element from its geometry.


def add_elastomer(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "elastomer", parents=[common], help="stiffness and modes of a cross-beam element from its geometry"
    )
    parser.add_argument(
        "geometry", type=Path, metavar="GEOMETRY.toml", help="what the element is, or a folder with elastomer.toml"
    )
    parser.add_argument(
        "--solid",
        action="store_true",
        help='also model it as an elastic solid on meshes that get finer (needs pip install "shakercal[solid]")',
    )
    add_results(parser, "folder elastomer beside the file")
    parser.set_defaults(action=_act_elastomer)


def _act_elastomer(options: argparse.Namespace) -> int:
    from fusion.base import progress_bar
    from fusion.sensor.elastomer.report import run_elastomer

    with progress_bar(enabled=not options.quiet) as progress:
        run_elastomer(options.geometry, options.output, solid=options.solid, force=options.force, progress=progress)
    return EXIT_DONE
