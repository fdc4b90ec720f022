"""Motion of a speckled body from the images of two cameras: six components of every frame with their uncertainty.

With the name of a file, x, y and z are drawn into it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from photogram import RigidTransform, TrackSettings, measure_body, open_sequence, read_calibration

demo = Path("sample_images/demo")
left, right = (open_sequence(sorted(demo.glob(f"Fz-0080/top-{side}/*.tif"))) for side in ("left", "right"))
pair = read_calibration(demo / "calibration/top.json")
body = measure_body((left, right), pair, RigidTransform.identity(), TrackSettings())
u = body.motion.covariance.diagonal(axis1=1, axis2=2) ** 0.5
for frame, (pose, own) in enumerate(zip(body.motion.pose, u, strict=True)):
    shift = ", ".join(f"{1e6 * value:8.2f} ± {2e6 * half:.2f}" for value, half in zip(pose[:3], own[:3], strict=True))
    print(f"frame {frame:2d}: x, y, z = {shift} µm (k = 2, noise of the images)")

for file in sys.argv[1:]:
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7.0, 3.0), layout="constrained")
    axes = drawing.subplots()
    for component, name in enumerate("xyz"):
        axes.errorbar(
            range(len(u)), 1e6 * body.motion.pose[:, component], 2e6 * u[:, component], fmt="o-", label=name, ms=3
        )
    axes.set(xlabel="frame", ylabel="translation / µm")
    axes.legend(ncols=3)
    drawing.savefig(file, dpi=130)
