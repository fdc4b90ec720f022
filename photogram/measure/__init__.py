"""One body through a series of stereo images: tracking, and its motion."""
