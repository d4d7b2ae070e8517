"""Baseline methods: readers for the results of other methods on a clip.

Inputs: the files that a method's own code wrote, and the body model for its poses. Outputs:
    `MethodResult`: joints, their world frame, boxes in the image.
"""

from worldpose.baselines.known import METHODS, Method, find_method
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.resampling import resampled
from worldpose.baselines.result import MethodResult

__all__ = ["METHODS", "Method", "MethodResult", "find_method", "read_pickled", "resampled"]
