"""Broadcast calibration: a clip's moving camera from a few key frames, clicked or proposed.

Input: clicks in key frames, the clip's frames, people of the static cameras. Output: a camera per
frame with one center, its covariance, and a report.
"""
