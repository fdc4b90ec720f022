"""From accelerations to load and sensitivity: the path of one recording."""
