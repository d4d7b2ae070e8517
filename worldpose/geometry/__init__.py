"""Camera models: projection of world points to pixels, and unprojection of pixels to rays.

Inputs: calibrations, world points [m] or pixels. Outputs: pixels with Jacobians, rays, distances.
"""
