"""Rigid motion of a body fitted to the grey values of all its pixels."""
