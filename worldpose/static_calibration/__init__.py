"""Static calibration: a camera from the pitch markings in its image.

Input: a pitch template, clicked points and drawn markings, or an image alone. Output: a camera and
its covariance.
"""
