"""Calibration of stereo pairs from images of a target."""
