"""Sine approximation at exact times, also far below the Nyquist rate."""
