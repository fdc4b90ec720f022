"""Frequency response functions: stated measuring chains, and measured transfer functions."""
