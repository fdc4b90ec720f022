"""Fusion of instruments by least squares, with uncertainties, consistency tests and coverage factors."""
