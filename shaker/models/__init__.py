"""Mechanical models of the sensor and its load."""
