"""`shakercal compensate`: filters that give a sensor the dynamics one wants."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, add_allow_outside, add_results, count, not_negative, positive


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
    from fusion.compensate.run import run_compensate
    from fusion.compensate.wish import Wish

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
