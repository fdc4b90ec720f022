"""Images to rigid motion: stereo cameras, subset tracking, triangulation. Knows nothing of shakers, clocks or sensors."""
