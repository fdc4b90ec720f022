"""A sensor that rings after a release, block by block through the filter that `shakercal compensate` makes for it.

With the name of a file, both are drawn into it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile

import numpy as np

from fusion import read_compensation_filters
from shaker import CompensationFilter

natural_hz, zeta = 300.0, 0.02
with tempfile.TemporaryDirectory() as out:
    words = f"compensate --sensor-frequency {natural_hz} --sensor-damping {zeta} --frequency 1000 --damping 0.7".split()
    subprocess.run([sys.executable, "-m", "fusion.cli", *words, "-o", out, "--force"], capture_output=True, check=True)
    (stored,) = read_compensation_filters(out)

rate_hz = stored.sections.sample_rate_hz
time_s = np.arange(round(0.2 * rate_hz)) / rate_hz
damped = 2 * np.pi * natural_hz * np.sqrt(1 - zeta**2)
decay = np.exp(-2 * np.pi * zeta * natural_hz * time_s)
ringing = 1 - decay * (np.cos(damped * time_s) + zeta / np.sqrt(1 - zeta**2) * np.sin(damped * time_s))

device = CompensationFilter(stored.sections)
quiet = np.concatenate([device(block[None])[0] for block in np.array_split(ringing, 50)])
print(f"sensor of {natural_hz:.0f} Hz, damping ratio {zeta}, sampled at {rate_hz:.0f} Hz")
for name, output in (("as it comes", ringing), ("compensated", quiet)):
    outside = np.flatnonzero(np.abs(output - 1) > 0.02)
    print(f"{name}: overshoot {100 * (output.max() - 1):.1f} %")
    print(f"{name}: within 2 % after {1e3 * time_s[outside[-1] + 1]:.2f} ms")

for file in sys.argv[1:]:
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7.0, 3.0), layout="constrained")
    axes = drawing.subplots()
    for name, output in (("as it comes", ringing), ("compensated", quiet)):
        axes.plot(1e3 * time_s, output, label=name, linewidth=1.0)
    axes.set(xlabel="time after the release / ms", ylabel="output / final value", xlim=(0.0, 50.0))
    axes.legend()
    drawing.savefig(file, dpi=130)
