"""The pitch: its named points, its painted markings and the height of its surface.

Input: a `PitchSpec` with surveyed points, or none; a surveyor's file. Output: a template in world
metres to calibrate, draw and filter by; a survey in the world frame (`worldpose.pitch.survey`).
"""

from worldpose.pitch.template import MarkingSamples, PitchTemplate

__all__ = ["MarkingSamples", "PitchTemplate"]
