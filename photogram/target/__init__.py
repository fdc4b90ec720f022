"""Calibration targets: what they look like, and their points in a picture with sub-pixel positions and covariance."""
