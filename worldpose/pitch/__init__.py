"""The pitch: its named points, its painted markings and the height of its surface.

Input: a `PitchSpec` with surveyed points, or none. Output: a template in world metres to calibrate,
draw and filter by.
"""

from worldpose.pitch.template import MarkingSamples, PitchTemplate

__all__ = ["MarkingSamples", "PitchTemplate"]
