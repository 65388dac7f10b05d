"""Choices of arguments, for the command line and for Python. Does not import torch."""

from typing import Literal, TypeAlias

__all__ = ["EXPORTS", "FORMATS", "LONGEST", "PASSES", "SUBSET", "Dataset", "Fetched", "Origin", "Split"]

LONGEST = 1_000_000  # maximal timeout in seconds; the system counts milliseconds in 32 bits

Split: TypeAlias = Literal["train", "validation", "test"]
Dataset: TypeAlias = Literal["strokes"]
Fetched: TypeAlias = Literal["strokes", "curves"]
Origin: TypeAlias = Literal["bundled", "dejong"]
"""Set of digit strokes."""

FORMATS = {
    "dreamer": "dreamer:Dreamer",
    "robomimic": "robomimic:Robomimic",
    "stable-worldmodel": "stable_worldmodel:StableWorldModel",
    "arrays": "arrays:Arrays",
    "minari": "minari:Minari",
    "lerobot": "lerobot:LeRobot",
    "lance": "lance:Lance",
    "frames": "frames:Frames",
}
"""Formats of recorded episodes in the order of recognition: module in `forbes.data.imports`, class of its reader."""
EXPORTS = ("hdf5", "minari", "npz")
"""Formats to which a store can be exported."""

PASSES = {
    "elbo": "samples",
    "pll": "particles",
    "fivo": "particles",
    "open-loop": "futures",
}
"""Scores of sequences, and the option for the number of samples of each."""
SUBSET = 1000
"""Default number of sequences for the expensive scores, which use particles or futures."""
