"""Calibration of camera pairs, import and export, and their pose in the sensor frame."""
