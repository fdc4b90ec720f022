"""Calibration targets in images: chessboard, ChArUco, dot grids."""
