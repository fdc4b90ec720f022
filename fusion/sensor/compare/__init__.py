"""Comparison of results of several campaigns, laboratories or dates, with a reference value and its consistency."""
