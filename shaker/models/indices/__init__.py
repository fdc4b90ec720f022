"""Indices of a model: resonance, bands, overshoot, rise and settling."""
