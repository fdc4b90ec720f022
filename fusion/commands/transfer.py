"""`shakercal transfer`: transfer functions of chirps, multisines, noise and blows."""

from __future__ import annotations

import argparse

from fusion.commands.values import EXIT_DONE, Commands, add_recording, add_results, positive


def add_transfer(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "transfer", parents=[common], help="transfer functions and resonances from a chirp, multisine, noise or blows"
    )
    add_recording(parser)
    parser.add_argument(
        "--estimator",
        choices=("auto", "periodic", "local", "H1", "H2", "Hv"),
        default="auto",
        help="default: auto, the ratio of means over periods where a period is stated, of noise local polynomials, of "
        "blows what the coherence advises",
    )
    parser.add_argument(
        "--resolution",
        type=positive,
        metavar="HZ",
        help="line spacing where no period is stated (default: 16 segments side by side; of blows: 1 Hz)",
    )
    parser.add_argument(
        "--quantity",
        choices=("displacement", "velocity", "acceleration"),
        help="turn every motion into this quantity (default: as it was measured)",
    )
    add_results(parser, "RECORDING/transfer")
    parser.set_defaults(action=_act_transfer)


def _act_transfer(options: argparse.Namespace) -> int:
    from fusion.transfer.result import TransferSettings
    from fusion.transfer.run import run_transfer

    settings = TransferSettings(options.estimator, options.resolution, options.quantity)
    run_transfer(options.recording, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE
