"""Rotation tests: masses and centres of mass by gravity."""
