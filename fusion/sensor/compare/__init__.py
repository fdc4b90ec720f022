"""Comparison of results of several campaigns, laboratories or dates."""
