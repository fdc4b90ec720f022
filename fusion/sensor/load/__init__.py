"""Load characteristics."""
