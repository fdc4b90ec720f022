"""Subsets of images: grid, reference, registration, tracks."""
