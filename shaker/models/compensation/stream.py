"""A compensation filter that runs along with the data, block by block."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.models.compensation.discrete import Sections


class CompensationFilter:
    """Filters blocks (C, N) of `channels` channels and keeps its state between them.

    The output of any split into blocks equals that of one block bit for bit. It starts settled at `level` (C,) or one
    number, in the unit of the input; None: at the first sample. `switch` changes the coefficients before the next
    sample: every section keeps its last two inputs and outputs, so that the output goes on from where it was. A
    constant signal does not notice a switch, and a smooth one moves by no more than its own change over one sample.
    """

    def __init__(self, sections: Sections, channels: int = 1, level: FloatArray | float | None = 0.0) -> None:
        if channels < 1:
            raise ValueError(f"channels: expected 1 or more, found {channels}")
        self._sections = sections
        self._channels = channels
        self._past = np.zeros((len(sections.sos) + 1, 2, channels))
        self._state = np.zeros((len(sections.sos), 2, channels))
        self._started = level is not None
        if level is not None:
            self._settle(np.broadcast_to(np.asarray(level, dtype=np.float64), (channels,)))

    @property
    def sections(self) -> Sections:
        """The coefficients in use."""
        return self._sections

    def __call__(self, block: FloatArray) -> FloatArray:
        """Return the compensated block (C, N); samples that are not finite are refused, they would never fade."""
        from scipy.signal import sosfilt

        signal = np.ascontiguousarray(block, dtype=np.float64)
        check_shape("block", signal, (self._channels, None))
        if not np.all(np.isfinite(signal)):
            raise ValueError("block: expected finite samples, found others")
        if not signal.shape[1]:
            return signal
        if not self._started:
            self._settle(signal[:, 0])
            self._started = True
        self._remember(0, signal)
        for place, row in enumerate(self._sections.sos):
            state = np.ascontiguousarray(self._state[place].T)[None]
            signal, after = sosfilt(row[None], signal, axis=1, zi=state)
            self._state[place] = after[0].T
            self._remember(place + 1, signal)
        return np.asarray(self._sections.gain * signal)

    def switch(self, sections: Sections) -> None:
        """Use other coefficients, as many sections at the same rate, from the next sample on."""
        if sections.sos.shape != self._sections.sos.shape:
            raise ValueError(f"sections: expected {len(self._sections.sos)}, found {len(sections.sos)}")
        if sections.sample_rate_hz != self._sections.sample_rate_hz:
            expected = self._sections.sample_rate_hz
            raise ValueError(f"sections: expected a rate of {expected} Hz, found {sections.sample_rate_hz} Hz")
        self._sections = sections
        for place, (_, b1, b2, _, a1, a2) in enumerate(sections.sos):
            x, y = self._past[place], self._past[place + 1]
            self._state[place, 1] = b2 * x[1] - a2 * y[1]
            self._state[place, 0] = b1 * x[1] - a1 * y[1] + b2 * x[0] - a2 * y[0]

    def _settle(self, level: FloatArray) -> None:
        """The state of having seen one level for ever."""
        self._past[0] = level
        for place, row in enumerate(self._sections.sos):
            self._past[place + 1] = self._past[place] * (np.sum(row[:3]) / np.sum(row[3:]))
        self.switch(self._sections)

    def _remember(self, place: int, signal: FloatArray) -> None:
        """Keep the last two samples at one place between the sections, the older first."""
        kept = np.concatenate([self._past[place], signal[:, -2:].T])
        self._past[place] = kept[-2:]
