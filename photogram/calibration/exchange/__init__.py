"""Calibrations of other programs: read as this program has them, and written for others."""
