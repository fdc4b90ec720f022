"""Resonances, structures and sensors identified from transfer functions."""
