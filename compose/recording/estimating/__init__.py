"""Estimation from range recordings, with the estimator of the missions."""
