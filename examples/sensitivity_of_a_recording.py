"""The path of a recording in Python: its sensitivity at the driven lines, and what the fused acceleration rests on."""

from __future__ import annotations

from fusion import evaluate_recording, find_recordings, load_manifest

(recording,) = find_recordings("sample_images/demo")
evaluation = evaluate_recording(load_manifest(recording))
element = evaluation.element
driven = element.channels.index("Fz"), element.components.index("Fz")
for frequency, value in zip(element.frequency_hz, element.value[:, *driven], strict=True):
    if abs(value) > 0.0:  # NaN where a line does not determine it
        print(f"{frequency:.4f} Hz: Fz per Fz {abs(value):.6g} {element.unit}/N")
for result in evaluation.accelerations:
    print(f"acceleration of the {result.body} from {result.source}: {', '.join(result.instruments)}")
