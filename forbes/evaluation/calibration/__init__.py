"""Calibration: is a belief as certain as it should be?"""
