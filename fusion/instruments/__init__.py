"""Kinds of instruments: rows of the model, named errors and samples, units, observed components."""
