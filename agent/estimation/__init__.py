"""Estimation of poses from ranges: closed forms and exact tests, and Gaussian estimation in `gaussian`."""
