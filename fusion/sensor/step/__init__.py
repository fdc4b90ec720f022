"""Step responses."""
