"""Before the measurement: camera rates, lines."""
