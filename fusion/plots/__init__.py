"""Figures of the report: vector graphics in memory, in one style; uncertainties are expanded ones, k = 2."""
