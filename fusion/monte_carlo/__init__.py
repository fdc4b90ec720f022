"""Propagation of distributions: everything uncertain is drawn, and the evaluation repeated from the phasors on."""

from fusion.monte_carlo.propagate import Known, propagate

__all__ = ["Known", "propagate"]
