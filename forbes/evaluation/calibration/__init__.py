"""Calibration: whether a belief is as certain as it should be."""
