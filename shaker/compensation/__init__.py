"""Filters that give a sensor other dynamics, and what they do."""
