"""Stereo pairs calibrated and placed."""
