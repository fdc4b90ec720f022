"""NI TDMS: channels `group/channel`, `wf_increment`, `wf_start_offset`, `unit_string`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shaker.signals.files.common import checked_rate, chosen, numbers
from shaker.signals.recording import RawChannel


def read_tdms(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by `group/channel`, or by the channel's name alone where only one group has it."""
    from nptdms import TdmsFile
    from nptdms.log import log_manager

    for logger in log_manager.loggers.values():  # else the library writes to stderr past all settings of logging
        logger.removeHandler(log_manager.console_handler)
    with path.open("rb") as stream, TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            raise ValueError(f"{path}: expected a complete TDMS file, found its last segment cut off")
        channels = {
            f"{group.name}/{channel.name}": channel
            for group in file.groups()
            for channel in group.channels()
            if len(channel) and channel.dtype.kind in "biuf"
        }
        bare = [name.rsplit("/", 1)[1] for name in channels]
        alone = {tail: name for tail, name in zip(bare, channels, strict=True) if bare.count(tail) == 1}
        if names is not None:
            chosen(path, names, [*channels, *alone])
        result = {}
        for name in channels if names is None else names:
            channel = channels[name if name in channels else alone[name]]
            step = channel.properties.get("wf_increment")
            rate = 1.0 / float(step) if step else sample_rate_hz
            result[name] = RawChannel(
                numbers(path, name, channel[:]),
                checked_rate(path, rate, f'channel "{name}"'),
                float(channel.properties.get("wf_start_offset", 0.0)),
                str(channel.properties.get("unit_string", "")),
            )
        return result
