"""A recording and its rig as their files describe them."""
