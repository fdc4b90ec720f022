"""Signals and mechanics of shaker measurements. Knows nothing of images."""
