"""Commands from the plan of a measurement to its results, and `explain` for notices.

Each command has a function for its options, and one for its action, which imports heavy modules. Its docstring is its
help.
"""

from __future__ import annotations

import argparse
import logging
import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING

from fusion.base import DEFAULT_SEED, FEWEST_DRAWS, MOST_DRAWS, Settings, check_new_file
from fusion.commands.options import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INPUT,
    Parser,
    band,
    command,
    count,
    draws,
    hertz,
    page,
    path,
    path_or_address,
    percent,
    radius,
    seed,
    whole,
)
from fusion.commands.plan import plan, show_table, write_figure
from fusion.errors import (
    CONFLICTING_OPTIONS,
    INVALID_OPTION,
    OPTION_OF_ANOTHER_INPUT,
    OUTPUT_EXISTS,
    UNKNOWN_CODE,
    InputError,
    declared_by_stage,
    declared_notices,
)
from fusion.report.terminal import print_text, progress_bar

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager

    from fusion.campaign.stored_campaign import StoredCampaign
    from fusion.recording.load import Manifest
    from shakercal._common.notices import DeclaredNotice

log = logging.getLogger("shakercal")


def _simulate_options(parser: Parser) -> None:
    from fusion.simulate import PRESETS

    parser.value("out", path, "OUT", "campaign folder to create")
    text = (
        "which rig (default: demo); single: one camera; room: on a floor that may shake, with patches at rest; "
        "sweep, matrix: campaigns for a curve over frequency and for the 6x6; multisine: 40 lines at once; files: a "
        "laboratory's files without manifests, for shakercal init; targets: a camera calibration; acceptance: for "
        "shakercal accept; chirp: a recording for shakercal transfer; masses, pitching: campaigns of two loads for "
        "shakercal identify; rotation: a campaign for shakercal rotate; steps: one for shakercal step; loads: one for "
        "shakercal load; elastomer: a geometry for shakercal elastomer"
    )
    parser.choice("--preset", PRESETS, text)
    parser.add_argument("--seed", type=seed, default=1, help="seed of every random draw (default: 1)")
    text = (
        "violate one assumption of the program in a preset of sines, or add a fault to the rig of preset acceptance; "
        "may be repeated; docs/assumptions.md and docs/acceptance.md list the names, units and default sizes"
    )
    parser.add_argument("--violate", action="append", metavar="NAME[=SIZE]", default=[], help=text)
    parser.switch("--force", "overwrite an earlier simulation")


@command(_simulate_options, "rope --preset steps")
def simulate(options: argparse.Namespace) -> None:
    """Simulate a recording with its truth."""
    from fusion.simulate import simulate

    if options.out.exists() and not options.force:
        expected = "a new folder (--force replaces an earlier simulation)"
        raise InputError(OUTPUT_EXISTS, options.out, found="a file or folder of this name", expected=expected)
    violated = {"violate": tuple(options.violate)} if options.violate else {}
    try:
        with progress_bar(enabled=not options.quiet) as progress:
            written = simulate(options.out, options.preset, options.seed, progress, **violated)
    except ValueError as error:
        if not str(error).startswith("violate: "):
            raise
        reason = str(error).partition(": ")[2]
        raise InputError(INVALID_OPTION, "shakercal simulate", "--violate", reason=reason) from error
    number = len(list(options.out.glob("*/recording.toml")))
    others = {"files": "files of a laboratory", "targets": "images", "acceptance": "rig", "elastomer": "element"}
    kind = "recording" if number == 1 else "campaign" if number else others.get(options.preset, "files")
    print(f"simulated {kind}: {written}" + (f", {number} recordings" if kind == "campaign" else ""))


def _init_options(parser: Parser) -> None:
    parser.value("folder", path, "FOLDER", "folder of a recording's files, or of several such folders")
    how = parser.add_mutually_exclusive_group()
    text = "copy rig and channels from this recording with similar files"
    how.add_argument("--from", dest="like", type=path, metavar="RECORDING", help=text)
    how.add_argument("--example", action="store_true", help="write a commented example instead, with every block")
    parser.value("--answers", path, "FILE.toml", "values for the drafts, by the ends of their key paths")
    parser.switch("--no-questions", "ask nothing on a terminal")


@command(_init_options, "recordings/Fz-0080 --from recordings/Fz-0106")
def init(options: argparse.Namespace) -> None:
    """Draft recording.toml and rig.toml from the files of a folder."""
    from fusion.planning.draft.init import run_init

    def reply(question: str) -> str:
        print_text(question)
        return input("> ")

    asking = sys.stdin.isatty() and sys.stdout.isatty() and not options.no_questions and options.answers is None
    made = run_init(
        options.folder,
        options.like,
        with_example=options.example,
        answers=options.answers,
        reply=reply if asking else None,
    )
    for line in made.found:
        print_text(line)
    for file in made.files:
        print(f"written: {file}")
    if made.unfilled:
        print(f'{made.unfilled} values are left to fill in, "?"; shakercal check {options.folder} lists them')


def _check_options(parser: Parser) -> None:
    parser.recording()
    text = "draw cameras, beams, sensors, bodies, axes and gravity as stated: an interactive page"
    parser.value("--rig", page, "FILE.html", text)
    parser.switch("--force", "overwrite an existing page")
    parser.json()


@command(_check_options, "recordings/Fz-0080 --rig rig.html")
def check(options: argparse.Namespace) -> int:
    """Report the content of a recording and all errors, without tracking images."""
    from fusion.planning.check import check, check_together
    from fusion.recording.load import Manifest, find_recordings, load_manifest

    if options.rig:
        check_new_file(options.rig, force=options.force)
    manifests, reports, wrong, shown = list[Manifest](), [], list[str](), set[str]()
    for recording in find_recordings(options.recording):
        try:
            manifests.append(load_manifest(recording, allow_outside=options.allow_outside))
            reports.append(check(manifests[-1]))
        except InputError as error:
            wrong += [str(mistake) for mistake in error.each if str(mistake) not in wrong]
        else:
            if not options.json:
                print_text(str(reports[-1].without_repeats(shown)))
    wrong += [str(contradiction) for contradiction in check_together(manifests)]
    for sentence in wrong:
        log.error("%s", sentence)
    if options.rig and manifests:
        from fusion.report.atomic_files import write_atomically
        from fusion.report.report_scene import rig_page

        write_atomically(options.rig, rig_page(manifests))
        if not options.json:
            print(f"rig drawn: {options.rig}")
    if options.json:
        from fusion.report.folder import command_json

        print(command_json("check", recordings=[report.parts() for report in reports], wrong=wrong))
    return EXIT_INPUT if wrong or any(report.problems for report in reports) else EXIT_DONE


def _look_options(parser: Parser) -> None:
    parser.recording()
    text = "required expanded uncertainty (k = 2) of the result, in %%"
    parser.value("--aim", percent, "PERCENT", text)
    parser.value("--page", path, "FILE.html", "write a page, too, whose colour is visible from two metres")
    how = parser.add_mutually_exclusive_group()
    text = "repeat whenever files change, until Ctrl-C; the page reloads itself"
    how.add_argument("--watch", action="store_true", help=text)
    text = "evaluate the images while they arrive, by the cameras alone, until the recorder's files are complete"
    how.add_argument("--live", action="store_true", help=text)
    parser.value("--rate", hertz, "HZ", "frames per second of the cameras, for --live")
    text = "relative U (95 %%) of the driven acceleration, in %%, at which --live stops"
    parser.value("--until", percent, "PERCENT", text)
    parser.switch("--json", "print events of --live as JSON, one a line")
    parser.set_defaults(usage_error=parser.error)


@command(_look_options, "recordings/Fz-0080 --aim 0.1")
def look(options: argparse.Namespace) -> int:
    """Assess a recording within seconds: defects and achievable uncertainty."""
    if options.page is not None:
        check_new_file(options.page, force=True)
    if options.live:
        if options.rate is None:
            options.usage_error("the following arguments are required with --live: --rate")
        from fusion.planning.look.live_command import LiveOptions, run_live

        given = (options.rate, options.until, options.page, options.json, options.quiet, options.allow_outside)
        return EXIT_DONE if run_live(options.recording, LiveOptions(*given)) else EXIT_FAILED
    if options.rate is not None or options.until is not None or options.json:
        options.usage_error("--rate, --until and --json need --live")
    from fusion.planning.look.look import run_look

    level = run_look(
        options.recording, options.aim, options.page, watch=options.watch, allow_outside=options.allow_outside
    )
    return EXIT_FAILED if level == "wrong" else EXIT_DONE


def _view_options(parser: Parser) -> None:
    parser.value("source", path, "SOURCE", "folder of results, of a recording or of a campaign")
    parser.value("--recording", path, "RECORDING", "recording or campaign of the results, if stored elsewhere")
    parser.value("--port", whole(0, 65535), "PORT", "of this machine (default: 0, any free one)", default=0)
    parser.switch("--no-browser", "print the address only")
    parser.allow_outside()


@command(_view_options, "recordings/Fz-0080/results")
def view(options: argparse.Namespace) -> None:
    """View images, channels, spectra and phasors on a page of this machine, until Ctrl-C."""
    from fusion.planning.view.server import run_view

    run_view(
        options.source,
        options.recording,
        options.port,
        browser=not options.no_browser,
        allow_outside=options.allow_outside,
    )


def _lines_options(parser: Parser) -> None:
    text = "DAQ file, a recording (its folder or recording.toml), or a campaign of several"
    parser.value("source", path, "SOURCE", text)
    text = "channel of the file, may be repeated (default: all)"
    parser.add_argument("--channel", action="append", metavar="NAME", help=text)
    parser.value("--sample-rate", hertz, "HZ", "of a file without sample rate")
    parser.value("--band", band, "LOW:HIGH", "list lines of the file between these, in Hz")
    parser.figure_and_table("draw spectrum and floor", "write the list as a table")
    parser.allow_outside()


@command(_lines_options, "recordings/Fz-0080/bridge.tdms --channel Fz --band 50:2000 --figure lines.png")
def lines(options: argparse.Namespace) -> None:
    """List every line of a file or recording, with its origin."""
    from fusion.planning.lines import lines_csv, lines_of_file, lines_of_recording, print_lines

    for file in filter(None, (options.figure, options.csv)):
        check_new_file(file, force=options.force)
    drawn = options.figure is not None
    if options.source.is_dir() or options.source.suffix.lower() == ".toml":
        lists = [lines_of_recording(manifest, drawn=drawn) for manifest in _manifests(options)]
    else:
        lists = lines_of_file(options.source, options.channel, options.sample_rate, options.band, drawn=drawn)
    if options.figure:
        from fusion.planning.plan_figures import draw_lines

        write_figure(options.figure, partial(draw_lines, lists))
    show_table(options, "lines", lines_csv(lists), partial(print_lines, lists))


def _manifests(options: argparse.Namespace) -> list[Manifest]:
    """Load the recordings of a folder; refuse options of files, and several for one table."""
    from fusion.recording.load import find_recordings, load_manifest
    from fusion.recording.recording_notices import ONE_RECORDING_EXPECTED

    for name in ("channel", "sample_rate", "band"):
        if getattr(options, name) is not None:
            option = f"--{name.replace('_', '-')}"
            expected = "no such option, recording.toml states it"
            raise InputError(OPTION_OF_ANOTHER_INPUT, options.source, found=option, expected=expected)
    recordings = find_recordings(options.source)
    if len(recordings) > 1 and (options.csv or options.figure):
        found, expected = f"{len(recordings)} recordings", "one recording for --csv and --figure"
        raise InputError(ONE_RECORDING_EXPECTED, options.source, found=found, expected=expected)
    return [load_manifest(recording, allow_outside=options.allow_outside) for recording in recordings]


def _run_options(parser: Parser) -> None:
    text = "folder of a recording or of a campaign, or its address in an object store, such as s3://bucket/campaign"
    parser.value("recording", path_or_address, "RECORDING", text)
    parser.allow_outside()
    text = "folder of the results, of a stored campaign also an address (default: RECORDING/results)"
    parser.add_argument("-o", "--output", type=path_or_address, metavar="RESULTS", help=text)
    parser.switch("--force", "compute again and overwrite existing results")
    text = "half-width of the subsets (default: from the speckle size in the images, 10 px for speckle of 4 to 5 px)"
    parser.value("--subset-radius", radius, "PX", text)
    parser.device("device for tracking (default: auto, a GPU if torch finds one)")
    text = (
        "check the uncertainties with N draws of all uncertain inputs "
        f"({FEWEST_DRAWS} to {MOST_DRAWS}; 100000 are good for two digits of U; default: none)"
    )
    parser.value("--monte-carlo", draws, "N", text, default=0)
    parser.value("--seed", seed, "S", f"of these draws (default: {DEFAULT_SEED})", default=DEFAULT_SEED)
    parser.json()
    parser.pdf()
    parser.switch("--save-points", "write every point of every frame too, as a table and for ParaView (.pvd)")
    where = parser.add_mutually_exclusive_group()
    text = "processes that share the work on this machine (default: 1); results are the same to the last digit"
    where.add_argument("--workers", type=count, default=1, metavar="N", help=text)
    text = (
        "compute on the Dask cluster with the scheduler at ADDRESS, such as tcp://10.0.0.1:8786: its "
        'workers see the same files by the same paths (needs pip install "shakercal[cluster]")'
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help=text)


@command(_run_options, "sample_images/demo -o results")
def run(options: argparse.Namespace) -> int:
    """Evaluate one recording or a campaign of several."""
    from fusion.campaign.run import exit_status, is_campaign, run_path
    from fusion.campaign.run_summary import as_json, print_outcomes
    from fusion.report.recording_report import REPORT_FILE
    from fusion.report.summary_pdf import write_requested_pdf
    from photogram.device import resolve_device

    settings = Settings(
        subset_radius_px=options.subset_radius,
        device=resolve_device(options.device),
        monte_carlo=options.monte_carlo,
        seed=options.seed,
        save_points=options.save_points,
    )
    with _campaign(options) as source:
        with progress_bar(enabled=not options.quiet) as progress:
            outcomes = run_path(
                source,
                options.output,
                settings,
                force=options.force,
                allow_outside=options.allow_outside,
                workers=options.workers if options.scheduler is None else options.scheduler,
                progress=progress,
            )
        campaign = is_campaign(source if isinstance(source, Path) else source.path)
        if options.json:
            print(as_json(outcomes, campaign=campaign))
        else:
            print_outcomes(outcomes, campaign=campaign)
        if done := [outcome.folder for outcome in outcomes if outcome.error is None]:
            write_requested_pdf((done[0].parent if campaign else done[0]) / REPORT_FILE)
    return exit_status(outcomes)


def _campaign(options: argparse.Namespace) -> AbstractContextManager[Path | StoredCampaign]:
    """Return the recordings of a run: a path, or what an address stands for."""
    if isinstance(options.recording, str):
        from fusion.campaign.stored_campaign import fetched_campaign

        return fetched_campaign(options.recording, options.output)
    if isinstance(options.output, str):
        expected = "a local folder for recordings of this machine"
        raise InputError(OPTION_OF_ANOTHER_INPUT, options.recording, found=f"-o {options.output}", expected=expected)
    return nullcontext(options.recording)


def _transfer_options(parser: Parser) -> None:
    parser.recording()
    text = (
        "default: auto: from rest to rest over repeats, with a period the ratio of means over periods, for noise local "
        "polynomials, for blows by coherence"
    )
    parser.choice("--estimator", ("auto", "rest", "periodic", "local", "H1", "H2", "Hv"), text)
    text = "line spacing without a stated period (default: 16 over the record; from rest to rest 1; for blows 1 Hz)"
    parser.value("--resolution", hertz, "HZ", text)
    text = "convert every motion into this quantity (default: as measured)"
    parser.add_argument("--quantity", choices=("displacement", "velocity", "acceleration"), help=text)
    parser.results("RECORDING/transfer")
    parser.json()


@command(_transfer_options, "recordings/chirp")
def transfer(options: argparse.Namespace) -> None:
    """Estimate transfer functions and resonances from a chirp, multisine, noise or blows."""
    from fusion.sensor.transfer.transfer_records import TransferSettings
    from fusion.sensor.transfer.transfer_report import run_transfer

    settings = TransferSettings(options.estimator, options.resolution, options.quantity)
    run_transfer(options.recording, options.output, settings, force=options.force, allow_outside=options.allow_outside)


def _export_options(parser: Parser) -> None:
    text = "folder of results (run, transfer, elastomer) or of a recording"
    parser.value("results", path, "RESULTS", text)
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("-o", "--output", type=path, metavar="FILE", help="file to write: .uff, .unv or .zarr")
    text = "write the fields of the stereo pairs there: PNG, animated WebP, MP4 and VTK"
    target.add_argument("--fields", type=path, metavar="FOLDER", help=text)
    parser.switch("--inputs", "all uncertain inputs of the main elements with their effects, as CSV, instead")
    parser.switch("--text", "functions as data set 58 in text, with 13 digits (default: 58b, all digits)")
    parser.switch("--force", "overwrite files that are there")


@command(_export_options, "results/Fz-0080 -o Fz-0080.uff")
def export(options: argparse.Namespace) -> None:
    """Export results as universal file or Zarr store, inputs as CSV, fields as images.

    Universal files (UFF) have the data sets 58, 58b, 55 and 2411.
    """
    if options.fields is not None:
        if options.inputs:
            raise InputError(CONFLICTING_OPTIONS, "--inputs", found="--fields", expected="--output with it")
        from fusion.report.field_export import export_fields

        written = export_fields(options.results, options.fields, force=options.force)
        print(f"fields written: {options.fields} ({len(written)} files)")
        return
    suffix, suffixes = options.output.suffix.lower(), (".csv",) if options.inputs else (".uff", ".unv", ".zarr")
    if suffix not in suffixes:
        reason = f"expected a name that ends in {', '.join(suffixes)}, found {options.output.name}"
        raise InputError(INVALID_OPTION, options.output, "--output", reason=reason)
    if options.inputs:
        from fusion.report.traceability import export_inputs

        count = export_inputs(options.results, options.output, force=options.force)
        print(f"table written: {options.output} ({count} rows)")
        return
    if suffix == ".zarr":
        from fusion.report.zarr_export import export_zarr

        groups = export_zarr(options.results, options.output, force=options.force)
        print(f"Zarr store written: {options.output} ({', '.join(groups)})")
        return
    from fusion.report.universal_export import export_universal

    made = export_universal(options.results, options.output, text=options.text, force=options.force)
    counts = f"{len(made.functions)} functions, {len(made.shapes)} shapes, {len(made.nodes)} nodes"
    print(f"universal file written: {options.output} ({counts})")


def _validate_options(parser: Parser) -> None:
    text = "write validation.json and a page there (default: print only)"
    parser.add_argument("-o", "--output", type=path, metavar="FOLDER", help=text)
    parser.switch("--force", "replace those of an earlier validation")


@command(_validate_options, "-o validation")
def validate(options: argparse.Namespace) -> int:
    """Compare results of this installation with independent ones (software validation)."""
    from fusion.planning.validation import validation_run as validation

    if options.output is not None:
        validation.check_output_folder(options.output, force=options.force)
    found = validation.validate()
    if options.output is not None:
        validation.write_validation(options.output, found)
    validation.print_validation(found)
    return EXIT_DONE if found.passed else EXIT_FAILED


NOTICES_HEAD = """# Notices and errors

Every notice and every error of the program has a code. The terminal shows code, place and one sentence;
`shakercal explain CODE` adds effect and remedy. This page lists all of them and is made by
`shakercal explain --markdown`. Names in angle brackets are values of a case, and fields of `--json` and `result.h5`.

- **error**: the input is refused, or a result could not be computed. Nothing is written.
- **warning**: a result may be wrong, or its U incomplete.
- **note**: good to know. A note with a possible size is an influence that a recording cannot assess; pages list these
  in the table "Not assessed".

A laboratory acknowledges a warning or note in `recording.toml` with `[[acknowledged]]` (see
[the manifest](recording-format.md)), unless it says *cannot be acknowledged*.
"""


REFUSED = "The input is refused, and no result is written."
"""Effect of an error that declares none."""


def _explain_options(parser: Parser) -> None:
    parser.add_argument("codes", nargs="*", metavar="CODE", help="codes to explain, such as SC-203 (default: list all)")
    parser.switch("--markdown", "all of them as a page of documentation")


@command(_explain_options, "SC-953")
def explain(options: argparse.Namespace) -> int:
    """Explain notices and errors by their codes: cause, effect, remedy."""
    if options.markdown:
        print(notices_page(), end="")
        return EXIT_DONE
    declared = declared_notices()
    codes = [code.upper() for code in options.codes]
    for code in codes:
        if code not in declared:
            raise InputError(UNKNOWN_CODE, "explain", code, first=next(iter(declared)), last=next(reversed(declared)))
    if not codes:
        for code, (title, notice) in declared.items():
            print_text(f"{code} {notice.severity:7} {title}")
    for code in codes:
        for line in explanation(*declared[code]):
            print_text(line)
    return EXIT_DONE


def explanation(title: str, notice: DeclaredNotice) -> Iterator[str]:
    """Yield the parts of a notice, one line each."""
    yield f"{notice.code} ({notice.severity}): {title}"
    effect = notice.effect or (REFUSED if notice.severity == "error" else "")
    parts = {"sentence": notice.template, "effect": effect, "possible size": notice.possible_size}
    parts |= {"remedy": notice.remedy, "more": notice.link and f"docs/{notice.link}"}
    yield from (f"  {name}: {with_field_names(text)}" for name, text in parts.items() if text)
    if not notice.can_be_acknowledged and notice.severity != "error":
        yield "  cannot be acknowledged in a manifest"


def with_field_names(template: str) -> str:
    """Return a declared text with its fields as names in angle brackets."""
    parts = Formatter().parse(template)
    return "".join(text + ("" if name is None else f"<{name}>") for text, name, _, _ in parts)


def notices_page() -> str:
    """Return the page `docs/notices.md`: every stage with its notices, cause, effect and remedy."""
    lines = [NOTICES_HEAD]
    for title, notices in declared_by_stage():
        lines += [f"## {title}", "", "| code | severity | notice | effect | remedy |", "|---|---|---|---|---|"]
        for heading, one in notices.items():
            fixed = "" if one.can_be_acknowledged or one.severity == "error" else ", cannot be acknowledged"
            size = f" Possible size: {one.possible_size}" if one.possible_size else ""
            more = f" [More]({one.link})." if one.link else ""
            cells = (
                one.code,
                f"{one.severity}{fixed}",
                f"**{heading}.** {one.template}",
                f"{one.effect}{size}".strip(),
                f"{one.remedy}{more}".strip(),
            )
            named = (with_field_names(cell).replace("|", "\\|").replace("<", "&lt;") for cell in cells)
            lines.append(f"| {' | '.join(named)} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


COMMANDS = (run, init, check, look, view, simulate, plan, lines, transfer, export, validate)
