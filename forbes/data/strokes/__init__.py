"""Digit strokes: sequences of pen points, drawn frame by frame."""

from forbes.data.strokes.source import Strokes

__all__ = ["Strokes"]
