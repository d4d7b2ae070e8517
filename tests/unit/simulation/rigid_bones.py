from typing import Final

RIGID_BONES: Final = (
    *((5, 7), (7, 9), (6, 8), (8, 10), (5, 6), (11, 12), (11, 13), (13, 15), (12, 14), (14, 16)),
    *((0, 1), (0, 2), (1, 3), (2, 4)),
)
"""Pairs of joints at constant distance in a person; the spine twists and the head turns."""
