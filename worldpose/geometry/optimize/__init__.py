"""Nonlinear least squares: one Levenberg-Marquardt loop, linear solvers, robust losses."""
