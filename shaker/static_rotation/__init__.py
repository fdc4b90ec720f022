"""Readings over the angle of an indexing head."""
