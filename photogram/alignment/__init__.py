"""Where the cameras stand in the sensor frame."""
