"""The elastic element of a cross-beam sensor: statics, chains of oscillators, frame and solid model."""
