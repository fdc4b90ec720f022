"""Several recordings: run, joined, repeated, as a curve and as a matrix."""
