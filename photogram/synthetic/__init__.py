"""Rendered images with known truth."""
