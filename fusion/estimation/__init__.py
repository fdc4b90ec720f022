"""From phasors to accelerations, with what they are uncertain by."""
