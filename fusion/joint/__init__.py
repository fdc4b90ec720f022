"""What the recordings of a campaign say together: curves, matrices, repeats; their files and their page."""
