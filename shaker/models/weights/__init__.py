"""Masses from the weight of what turns."""
