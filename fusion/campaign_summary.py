"""What the command prints when a campaign is done: what became of its recordings, and where the report lies."""

from __future__ import annotations

from collections.abc import Sequence

from fusion.console import stdout_console
from fusion.execution.job import Outcome
from fusion.report import REPORT_FILE


def print_campaign(outcomes: Sequence[Outcome]) -> None:
    """Print one line per recording, each failure with its reason, how many there are of each, and the joint report."""
    console = stdout_console()
    for outcome in outcomes:
        console.print(f"{outcome.name}: {_told(outcome)}", soft_wrap=True)
    console.print(tally(outcomes))
    done = [outcome for outcome in outcomes if outcome.error is None]
    if done:
        console.print(f"report of all: {done[0].folder.parent / REPORT_FILE}", soft_wrap=True)


def tally(outcomes: Sequence[Outcome]) -> str:
    """Return how many recordings were finished, were done before, and failed."""
    failed = sum(outcome.error is not None for outcome in outcomes)
    resumed = sum(outcome.resumed for outcome in outcomes)
    parts = [(len(outcomes) - failed - resumed, "evaluated"), (resumed, "unchanged since the last run")]
    told = ", ".join(f"{count} {what}" for count, what in (*parts, (failed, "failed")) if count)
    return f"{len(outcomes)} recording{'' if len(outcomes) == 1 else 's'}: {told}"


def _told(outcome: Outcome) -> str:
    """Return what became of one recording."""
    if outcome.error is not None:
        return f"failed, {outcome.error}"
    return (
        f"report ({'unchanged since the last run' if outcome.resumed else 'written'}): {outcome.folder / REPORT_FILE}"
    )
