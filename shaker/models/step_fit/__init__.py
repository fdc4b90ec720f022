"""Models identified from step responses."""
