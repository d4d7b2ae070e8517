"""Bundle adjustment: all cameras and some joints together (B1-B3).

Input: calibrated cameras, tracked and placed people, clicked markings. Output: cameras that agree
with both, accepted only where people who had no part in it agree better.
"""

from worldpose.bundle_adjustment.solving import Adjusted, Problem, SolverSettings, solve

__all__ = ["Adjusted", "Problem", "SolverSettings", "solve"]
