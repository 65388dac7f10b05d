"""Figures: one function per figure of the paper, and the style that all share."""
