"""WAV files, their channels called by number."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from shaker.signals.files.common import chosen, numbers
from shaker.signals.recording import RawChannel


def read_wave(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by number, counted from 1, in the file's own numbers.

    16- and 32-bit integers come as they are, 24-bit ones as the upper bytes of 32 bits (times 256), 8-bit ones from 0
    to 255; floats as they are. The channel's scale has to turn these into SI units. RIFF, RIFX and RF64 files are
    read. The file states its own sampling rate, and `sample_rate_hz` is not used.
    """
    from scipy.io import wavfile

    with warnings.catch_warnings():
        # Chunks with remarks of the recorder are passed over; a record shorter than its header says is not.
        warnings.simplefilter("ignore", wavfile.WavFileWarning)
        warnings.filterwarnings("error", message="Reached EOF", category=wavfile.WavFileWarning)
        try:
            with path.open("rb") as file:
                rate, samples = wavfile.read(file)
        except wavfile.WavFileWarning as error:
            raise ValueError(f"{path}: expected a complete WAV file, found its end too early") from error
    columns = samples.reshape(len(samples), -1)
    wanted = chosen(path, names, [str(i + 1) for i in range(columns.shape[1])])
    return {name: RawChannel(numbers(path, name, columns[:, int(name) - 1]), float(rate), 0.0, "") for name in wanted}
