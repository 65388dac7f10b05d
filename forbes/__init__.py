"""FORBES: learn, measure and use belief states of partially observable processes."""

__version__ = "0.1.0"
