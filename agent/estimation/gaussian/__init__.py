"""Estimation with noisy sensors: least squares, hypotheses with probabilities, and consistency tests."""
