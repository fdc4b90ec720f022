"""Images to rigid motion: subset tracking, triangulation, rigid fit. Knows nothing of shakers, clocks or sensors."""
