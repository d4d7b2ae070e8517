"""Bundle adjustment: joint refinement of all cameras and some 3D joints.

Input: calibrated cameras, tracked and triangulated people, clicked markings. Output: cameras that
fit both, accepted only where they reduce the residuals of held-out people.
"""
