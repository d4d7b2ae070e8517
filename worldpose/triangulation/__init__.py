"""Triangulation: 3D joints of all tracked persons, with covariance.

Inputs: cameras, detected keypoints, and the detection of each person in each view. Outputs: joints
[m] per frame and of whole tracks, with covariance and inlier views; clock offsets of the cameras.
"""
