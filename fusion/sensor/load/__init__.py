"""Load characteristics of a sensor: resonance over the load mass."""
