"""Least-squares fit of a target's image: pixels, solver, covariance, tests."""
