"""Mechanics of the sensor from several loads."""
