"""Figures: one function per figure, and their common style."""
