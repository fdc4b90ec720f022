"""Commands for models of the sensor, from rotate to elastomer, and for its certificate.

Each command has a function for its options, and one for its action, which imports heavy modules. Its docstring is its
help.
"""

from __future__ import annotations

import argparse
import logging
from functools import partial

from fusion.base import check_new_file
from fusion.commands.options import (
    EXIT_DONE,
    EXIT_INPUT,
    Parser,
    between_0_and_1,
    command,
    database,
    hertz,
    not_negative,
    path,
    path_or_address,
    percent,
    positive,
    seed,
    whole,
)
from fusion.commands.plan import show_table, write_figure
from fusion.errors import FREQUENCIES_NOT_ASCENDING, InputError
from fusion.report.terminal import progress_bar

log = logging.getLogger("shakercal")


def _rotate_options(parser: Parser) -> None:
    parser.recordings()
    parser.results("folder rotate in the campaign or in the only recording, else next to rig.toml")
    parser.json()


@command(_rotate_options, "turned/bare turned/loaded")
def rotate(options: argparse.Namespace) -> None:
    """Determine internal mass and load mass by rotation about a horizontal axis."""
    from fusion.sensor.rotate.rotation_report import run_rotate

    run_rotate(options.recordings, options.output, force=options.force, allow_outside=options.allow_outside)


def _identify_options(parser: Parser) -> None:
    parser.value("campaign", path, "CAMPAIGN", "folder of a campaign or of one recording")
    parser.allow_outside()
    text = "default: auto, translation, and another one that the data call for"
    parser.choice("--model", ("auto", "translation", "pitching", "adapter"), text)
    text = "default: auto, one damper or loss factor of all recordings, and one of each that the data call for"
    parser.choice("--damping", ("auto", "common", "each"), text)
    text = "default: auto, fitted if two load masses or more separate it from the stiffness, else that of rig.toml"
    parser.choice("--internal-mass", ("auto", "free", "stated"), text)
    parser.value("--band", not_negative, ("LOW", "HIGH"), "lines to fit, in Hz (default: all)", nargs=2)
    text = "masses for corrections and usable bands (default: those of the recordings)"
    parser.value("--load-mass", positive, "KG", text, nargs="+", default=())
    text = "error of the magnitude up to which a band is usable (default: 0.05)"
    parser.value("--permitted", between_0_and_1, "SHARE", text, default=0.05)
    parser.results("CAMPAIGN/identify")
    parser.json()


@command(_identify_options, "campaign --load-mass 0.5 2 7")
def identify(options: argparse.Namespace) -> None:
    """Identify stiffness, damping and internal mass of the sensor from a campaign."""
    from fusion.sensor.identify.identification_inputs import IdentifySettings
    from fusion.sensor.identify.identification_report import run_identify

    band = None if options.band is None else (options.band[0], options.band[1])
    if band is not None and band[0] >= band[1]:
        found = f"{band[0]:g} and {band[1]:g}"
        expected = "two frequencies in Hz, the lower first"
        raise InputError(FREQUENCIES_NOT_ASCENDING, options.campaign, "--band", found=found, expected=expected)
    settings = IdentifySettings(
        model=options.model,
        damping=options.damping,
        internal_mass=options.internal_mass,
        band_hz=band,
        load_masses_kg=tuple(options.load_mass),
        permitted=options.permitted,
    )
    run_identify(options.campaign, options.output, settings, force=options.force, allow_outside=options.allow_outside)


def _step_options(parser: Parser) -> None:
    parser.recordings(", or data files of a release each, of which only poles are printed")
    text = "start of the fit: matrix pencil (default) or instrumental-variable ARX; all: compare every method"
    parser.choice("--method", ("pencil", "arx", "all"), text)
    parser.value("--modes", whole(1, 20), "N", "oscillating modes of a model (default: by rule)")
    parser.value("--real-poles", whole(0, 20), "N", "real poles of a model (default: by rule)")
    text = "change of the load (default: auto, the force channel if one is named, else by rule)"
    parser.choice("--release", ("auto", "step", "ramp", "smooth", "exponential", "measured"), text)
    parser.results("folder step in the campaign or in the only recording, else next to rig.toml")
    parser.json()


@command(_step_options, "releases --method pencil")
def step(options: argparse.Namespace) -> None:
    """Fit models of the sensor's outputs to releases of a load: modes, bands, settling."""
    from fusion.sensor.step.step_file import is_data_file, print_poles
    from fusion.sensor.step.step_records import StepSettings
    from fusion.sensor.step.step_report import run_step

    settings = StepSettings(options.method, options.modes, options.real_poles, options.release)
    if all(map(is_data_file, options.recordings)):
        print_poles(options.recordings, settings)
        return
    run_step(options.recordings, options.output, settings, force=options.force, allow_outside=options.allow_outside)


def _load_options(parser: Parser) -> None:
    parser.value("recordings", path, "RECORDING", "folder of a campaign, or of step recordings", nargs="*")
    parser.allow_outside()
    text = (
        "instead of recordings: CSV with load_mass_kg, frequency_hz and optionally u_frequency_hz, second_hz, "
        "u_load_mass_kg"
    )
    parser.value("--frequencies", path, "TABLE", text)
    parser.value("--moving-mass", positive, "KG", "of the sensor, with --frequencies")
    parser.value("--moving-mass-uncertainty", not_negative, "KG", "standard uncertainty (0)", default=0.0)
    text = "predict resonance and bands with these loads, such as a gripper or a hand (kg; kg m^2 for moments)"
    parser.value("--load-mass", positive, "KG", text, nargs="+", default=[])
    parser.value("--permitted", percent, "PERCENT", "permitted error of loads (5)", default=0.05)
    parser.value("--wanted", hertz, "HZ", "largest load for these resonances", nargs="+", default=[])
    parser.results("folder load in the campaign, in the only recording, or next to rig.toml or TABLE")
    parser.json()
    parser.set_defaults(refuse=parser.error)


@command(_load_options, "releases --wanted 500")
def load(options: argparse.Namespace) -> None:
    """Determine stiffness, resonance over load mass and load limits from releases."""
    from fusion.sensor.load.load_evaluation import LoadSettings
    from fusion.sensor.load.load_models_report import run_loads, run_table

    table = options.frequencies is not None
    if table == bool(options.recordings):
        options.refuse("expected either recordings or --frequencies TABLE")
    if table and options.moving_mass is None:
        options.refuse("--frequencies needs --moving-mass: resonances determine only stiffness over mass")
    if not table and options.moving_mass is not None:
        options.refuse("--moving-mass is for --frequencies: for recordings rig.toml states sensor.internal_mass")
    moving = (options.moving_mass, options.moving_mass_uncertainty) if table else None
    settings = LoadSettings(options.permitted, tuple(options.wanted), tuple(options.load_mass), moving)
    if table:
        run_table(options.frequencies, options.output, settings, force=options.force)
        return
    run_loads(options.recordings, options.output, settings, force=options.force, allow_outside=options.allow_outside)


def _compensate_options(parser: Parser) -> None:
    # subject of the compensation
    text = "models.json of shakercal step, load.json of shakercal load, or a folder with one"
    parser.value("models", path, "MODEL", text, nargs="*")
    parser.value("--sensor-frequency", hertz, "HZ", "natural frequency, without a model")
    parser.value("--sensor-damping", not_negative, "ZETA", "damping ratio, without a model")
    parser.value("--channel", str, "NAME", "output channels (default: all)", nargs="+", default=[])
    parser.value("--load-mass", not_negative, "KG", "loads of a model over the load, kg", nargs="+", default=[])
    parser.value("--modes", whole(1, 20), "N", "modes to compensate (default: 1)", default=1)
    # target
    parser.value("--frequency", hertz, "HZ", "natural frequency of the target")
    text = "damping ratio of the target (default: the one with the widest band for the permitted error)"
    parser.value("--damping", positive, "ZETA", text)
    parser.value("--bandwidth", hertz, "HZ", "instead of both: upper limit of the band with correct gain")
    parser.value("--permitted-error", positive, "PERCENT", "of the gain (default: 10)", default=10.0)
    parser.value("--real-pole", hertz, "HZ", "move the slowest real pole here")
    parser.value("--low-pass", hertz, "HZ", "corner of a Butterworth low-pass in the filter: less noise")
    parser.switch("--calibrated", "divide by the static gain too: the output of the filter is the load")
    # sampling and filtered recording
    parser.value("--sample-rate", hertz, "HZ", "of the filter (default: that of the model)")
    text = "matched poles and zeros, or Tustin prewarped at each mode (default: matched)"
    parser.choice("--discretisation", ("matched", "tustin"), text)
    parser.value("--apply", path, "RECORDING", "filter the outputs of this recording too")
    parser.value("--ball", positive, "N_PER_M", "check force feedback against a virtual ball of this stiffness")
    parser.allow_outside()
    parser.results("folder compensate next to the first model, or in the working folder")
    parser.json()


@command(_compensate_options, "releases/step --frequency 2000 --damping 0.7")
def compensate(options: argparse.Namespace) -> None:
    """Design filters for a specified resonance, damping or bandwidth of the sensor."""
    from fusion.sensor.compensate.compensation_report import run_compensate
    from fusion.sensor.compensate.compensation_subjects import CompensationSettings

    wish = CompensationSettings(
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


def _decouple_options(parser: Parser) -> None:
    parser.value("campaign", path, "CAMPAIGN", "folder with recordings of releases of all loads")
    parser.allow_outside()
    parser.value(
        "--frequency", hertz, "HZ", "target frequency after the filter (default: half that of the lowest mode)"
    )
    text = "target damping ratio, between 0 and 1 (default: 0.6)"
    parser.value("--damping", between_0_and_1, "Z", text, default=0.6)
    parser.value("--seed", seed, "N", "of the sampled models for U (default: 1)", default=1)
    parser.results("folder decouple in the campaign")
    parser.json()


@command(_decouple_options, "releases --frequency 800")
def decouple(options: argparse.Namespace) -> None:
    """Identify a model of all outputs over all loads from releases, and a decoupling filter."""
    from fusion.sensor.decouple.decoupling_evaluation import DecoupleSettings
    from fusion.sensor.decouple.decoupling_report import run_decouple

    settings = DecoupleSettings(options.frequency, options.damping, options.seed)
    run_decouple(options.campaign, options.output, settings, force=options.force, allow_outside=options.allow_outside)


def _elastomer_options(parser: Parser) -> None:
    parser.value("geometry", path, "GEOMETRY.toml", "description of the element, or a folder with elastomer.toml")
    text = 'also model it as an elastic solid on refined meshes (needs pip install "shakercal[solid]")'
    parser.switch("--solid", text)
    parser.switch("--allow-outside", "accept files outside the folder above that of GEOMETRY.toml")
    parser.results("folder elastomer next to the file")
    parser.json()


@command(_elastomer_options, "elastomer.toml --solid")
def elastomer(options: argparse.Namespace) -> None:
    """Compute stiffness and modes of a cross-beam element from its geometry."""
    from fusion.sensor.elastomer.element_report import run_elastomer

    with progress_bar(enabled=not options.quiet) as progress:
        run_elastomer(
            options.geometry,
            options.output,
            solid=options.solid,
            force=options.force,
            allow_outside=options.allow_outside,
            progress=progress,
        )


def _certificate_options(parser: Parser) -> None:
    parser.recording()
    parser.value(
        "--form", path, "FILE", "statements in addition to the results (default: certificate.toml next to them)"
    )
    parser.value(
        "--results",
        path,
        "RESULTS",
        "results of run, rotate, identify or step (default: results in the folder, else that of a command)",
    )
    parser.switch("--draft", "only write a certificate.toml to fill in")
    parser.switch("--verify", "only report who signed what of a certificate.xml, named instead of the recording")
    parser.switch("--specimen", "a specimen of simulated recordings, marked on every page and in the XML")
    parser.results("folder certificate in the recording or campaign")


@command(_certificate_options, "campaign --form certificate.toml")
def certificate(options: argparse.Namespace) -> None:
    """Write the calibration certificate of a recording or campaign, as XML (DCC) and page."""
    from fusion.sensor.certificate.certificate_report import run_certificate, write_form
    from fusion.sensor.certificate.certificate_verification import verify_certificate

    if options.verify:
        verify_certificate(options.recording)
        return
    if options.draft:
        write_form(options.form or options.recording, options.results)
        return
    run_certificate(
        options.recording,
        options.output,
        options.results,
        options.form,
        force=options.force,
        allow_outside=options.allow_outside,
        specimen=options.specimen,
    )


def _compare_options(parser: Parser) -> None:
    text = "results folder, CSV table or certificate, optionally with a name: [ROUND/]NAME[@DATE]=RESULT"
    parser.value("inputs", str, "[NAME=]RESULT", text, nargs="+")
    parser.value(
        "--date", str, "NAME=DATE", "day of a result, YYYY-MM-DD, for the drift; may be repeated", action="append"
    )
    text = "names and units of the columns of tables of others (docs/comparison.md)"
    parser.value("--columns", path, "COLUMNS.toml", text)
    parser.choice(
        "--reference", ("mean", "median"), "reference value: weighted mean (default), or median by Monte Carlo"
    )
    text = "laboratory that links rounds; may be repeated (default: all with results in several rounds)"
    parser.value("--link", str, "NAME", text, action="append")
    parser.value("--tolerance", percent, "PERCENT", "tolerance of equal frequencies (default: 0.1)", default=1e-3)
    parser.results("folder comparison in the working folder")
    parser.json()


@command(_compare_options, "2024=results-2024 2026=results-2026 --date 2024=2024-05-02 --date 2026=2026-03-09")
def compare(options: argparse.Namespace) -> None:
    """Compare results of laboratories, campaigns or dates: degrees of equivalence, E_n, consistency, drift."""
    from fusion.sensor.compare.comparison_evaluation import ComparisonMethod
    from fusion.sensor.compare.comparison_report import run_compare

    method = ComparisonMethod(options.reference, tuple(options.link or ()))
    dates = options.date or ()
    run_compare(options.inputs, options.output, dates, options.tolerance, options.columns, method, force=options.force)


def _collect_options(parser: Parser) -> None:
    text = "folder with results at any depth, or its address in an object store, such as s3://bucket/results"
    parser.value("archive", path_or_address, "ARCHIVE", text)
    text = "Parquet file to write, or to renew by the results that are new or changed"
    parser.value("-o", database, "DATABASE.parquet", text, dest="output", required=True)


@command(_collect_options, "archive -o results.parquet")
def collect(options: argparse.Namespace) -> int:
    """Collect the sensitivities of an archive in a database, for queries and compare."""
    from fusion.report.result_database import collect_results

    with progress_bar(enabled=not options.quiet) as progress:
        found = collect_results(options.archive, options.output, progress)
    for error in found.errors:
        log.error("%s", error)
    counts = f"{found.read} read, {found.unchanged} unchanged, {found.copies} copies, {len(found.errors)} unreadable"
    print(f"database: {options.output} ({found.rows} rows; results: {counts})")
    return EXIT_INPUT if found.errors else EXIT_DONE


def _chart_options(parser: Parser) -> None:
    text = "database of shakercal collect, and a condition on its columns"
    parser.value("database", path, "DATABASE.parquet[?CONDITION]", text)
    text = "number of the first days that determine mean and limits (default: all)"
    parser.value("--baseline", whole(3, 1000), "DAYS", text)
    parser.figure_and_table("draw the charts", "write every day as a table")


@command(_chart_options, "results.parquet --baseline 30 --figure chart.png")
def chart(options: argparse.Namespace) -> int:
    """Draw control charts of sensors over dates, with limits by moving ranges."""
    from fusion.sensor.compare.control_chart import charts_csv, charts_of, draw_charts, drawn_of, print_charts

    for file in filter(None, (options.figure, options.csv)):
        check_new_file(file, force=options.force)
    charts = charts_of(options.database, options.baseline)
    if options.figure:
        write_figure(options.figure, partial(draw_charts, charts))
        if left_out := drawn_of(charts):
            log.warning("%s: %s", options.figure, left_out)
    show_table(options, "chart", charts_csv(charts), partial(print_charts, charts))
    return EXIT_DONE


COMMANDS = (rotate, identify, step, load, compensate, decouple, elastomer, certificate, collect, compare, chart)
