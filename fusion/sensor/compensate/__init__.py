"""Compensation filters: a sensor with other dynamics."""
