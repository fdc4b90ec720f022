"""From files to phasors of every instrument."""
