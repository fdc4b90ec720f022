"""Decoupling of outputs: dynamic cross-talk and its filter."""
