"""From recorded files to the phasors of every instrument."""
