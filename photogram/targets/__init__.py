"""Calibration targets in pictures: chessboard, ChArUco, dot grids."""
