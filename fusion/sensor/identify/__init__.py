"""Mechanics of the sensor from frequency responses under several loads."""
