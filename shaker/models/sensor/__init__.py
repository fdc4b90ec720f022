"""The sensor with its measuring chain: sensitivity over frequency, usable band, correction."""
