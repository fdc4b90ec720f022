"""Evaluation of single recordings and joint evaluation of campaigns."""
