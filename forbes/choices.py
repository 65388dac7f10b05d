"""What a user may choose from, for the command line and for Python; nothing here needs torch."""

from typing import Literal, TypeAlias

__all__ = ["LONGEST", "PASSES", "SUBSET", "Dataset", "Fetched", "Origin", "Split"]

LONGEST = 1_000_000  # seconds; the system counts milliseconds in 32 bits

Split: TypeAlias = Literal["train", "validation", "test"]
Dataset: TypeAlias = Literal["strokes"]
Fetched: TypeAlias = Literal["strokes", "curves"]
Origin: TypeAlias = Literal["bundled", "dejong"]
"""A set of strokes."""

PASSES = {
    "elbo": "samples",
    "pll": "particles",
    "fivo": "particles",
    "open-loop": "futures",
}
"""Scores of sequences, with the option that has the number of samples of each."""
SUBSET = 1000
"""Sequences that particles are spent on, unless the user says otherwise."""
