"""Filtering: detected keypoints and boxes that contradict the fitted bodies.

Input: fitted bodies, cameras, detections and their matches to people. Output: keypoints to leave
out and corrections to subtract in the next iteration, and prediction errors in held-out cameras.
"""
