"""Evaluate completions of digits: are they digits, and are they as diverse as they should be?"""
