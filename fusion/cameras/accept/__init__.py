"""Acceptance test of a stereo rig: stationary scene, known translation, known rotation."""
