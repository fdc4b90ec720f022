"""`shakercal step`: models of a sensor's outputs from releases of a load."""

from __future__ import annotations

import argparse

from fusion.commands.values import EXIT_DONE, Commands, add_recordings, add_results, count


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
    from fusion.step.run import run_step
    from fusion.step.settings import StepSettings

    settings = StepSettings(options.method, options.modes, options.real_poles, options.release)
    run_step(options.recordings, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE
