"""Rotation tests."""
