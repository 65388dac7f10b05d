"""Completions of digits: whether they are digits, and whether they are as diverse as they should be."""
