"""Import and export of calibrations of other programs."""
