"""Image sequences of cameras at full bit depth, and the noise of their pixels."""
