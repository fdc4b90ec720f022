"""Calibration certificates: as XML (Digital Calibration Certificate) and as a page."""
