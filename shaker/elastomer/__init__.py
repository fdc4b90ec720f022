"""The cross-beam element of a sensor."""
