"""One body through a series of stereo images: `follow` its frames, and the motion of the `body` from them."""
