"""Methods: what the results of other people's methods say about a clip.

Inputs: the files that a method's own code wrote, and the body that its poses are put on.
Outputs: `MethodResult`: joints, the world they are in, boxes in the picture.
"""

from worldpose.baselines.known import METHODS, Method, find_method
from worldpose.baselines.pickled import read_pickled
from worldpose.baselines.resampling import resampled
from worldpose.baselines.result import MethodResult

__all__ = ["METHODS", "Method", "MethodResult", "find_method", "read_pickled", "resampled"]
