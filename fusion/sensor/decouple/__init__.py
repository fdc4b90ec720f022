"""Decoupling of outputs."""
