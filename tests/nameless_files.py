"""The files of the simulated laboratory as plainer recorders write them: without units, channels by number."""

from __future__ import annotations

from pathlib import Path

from nptdms import ChannelObject, TdmsFile, TdmsWriter

WAVE = ("wf_increment", "wf_start_offset", "wf_start_time", "wf_samples")


def forget_names(recording: Path) -> None:
    """Rewrite the recorders' files of a recording."""
    (table,) = recording.glob("*.csv")
    preamble, found, rows = table.read_text(encoding="latin-1").partition("Zeit [s];Laser [V];Kamera [V]")
    assert found
    table.write_text(f"{preamble}Zeit [s];Kanal 1;Kanal 2{rows}", encoding="latin-1", newline="\n")
    (path,) = recording.glob("*.tdms")
    (group,) = TdmsFile.read(path).groups()
    channels = [
        ChannelObject(group.name, f"AI{number}", channel[:], properties={key: channel.properties[key] for key in WAVE})
        for number, channel in enumerate(group.channels())
    ]
    with TdmsWriter(path) as writer:
        writer.write_segment(channels)
