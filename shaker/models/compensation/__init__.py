"""Filters that compensate the dynamics of a sensor."""
