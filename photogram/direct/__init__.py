"""Rigid motion fitted to the grey values of all pixels: cells of pixels, the fit, and the same batched for a GPU."""
