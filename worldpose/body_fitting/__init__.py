"""Body fitting: shape, position, orientation and joint angles of every person's body.

Input: triangulated joints with covariance, a body model, and the ground where known. Output: body
parameters, the bodies' keypoints with covariance, and the detector's systematic offsets.
"""
