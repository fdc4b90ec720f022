"""Compensation filters."""
