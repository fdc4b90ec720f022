"""The numbers that Nitsche, Kumme and Tutsch (2018) print and that the tables of docs/papers.md start from."""

from __future__ import annotations

from math import pi

VIBROMETER_HZ = (106.2503, 425.0)
VIBROMETER_MPS2 = (189.3217, 0.9596)
VIBROMETER_RAD = (0.369, 5.573 - 2 * pi)
CAMERA_HZ = (106.2495, 424.9472)
CAMERA_M = (0.4277e-3, 0.0040e-3)
CAMERA_RAD = (0.208, 0.820)
CAMERA_MEAN_M = -0.0425e-3
RESIDUAL_M = (0.0036e-3, 0.0023e-3)
CAMERA_RATE_HZ = 52.874
FRAMES = 211
GRAVITY = 9.8125  # Braunschweig; not stated in the publication, the only value that gives its load masses
WEIGHED_KG, INTERNAL_KG = 6.9605, 0.769
LOADS_KG = (4.236, 8.798)
RESONANCE_HZ = (1477.35, 1092.97)
SPRING_N_PER_M = (4.313e8, 4.512e8)
DAMPING_KG_PER_S = (699.18, 1566.01)
TABLE_2 = (
    (LOADS_KG[0], (1864.8, 1865.6, 315.6, 316.4), (6.872e8, 6.878e8, 0.197e8, 0.198e8), (144.5, 75.5, 58.58, 57.61)),
    (
        LOADS_KG[1],
        (1359.4, 1357.8, 210.9, 210.9),
        (6.980e8, 6.963e8, 0.168e8, 0.168e8),
        (390.16, 521.88, 1003.04, 1026.59),
    ),
)
"""Load, resonances f1x f1y f2x f2y in Hz, spring constants in N/m, damping coefficients in kg/s."""
LINE_HZ = 51200.0 / 65536
"""Not printed: every resonance is a multiple of it."""
LAG_S = 50e-6
