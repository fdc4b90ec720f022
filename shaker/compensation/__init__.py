"""Compensation filters and their effects."""
