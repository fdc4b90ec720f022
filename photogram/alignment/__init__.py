"""Pose of the cameras in the sensor frame."""
