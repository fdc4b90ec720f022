"""Internal mass and load mass from the sensor turned about a horizontal axis: `shakercal rotate`."""
