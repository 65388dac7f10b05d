"""Stateless randomness: a stream is a pure function of (seed, purpose, counter), so resuming needs no RNG state."""

import hashlib

import torch

__all__ = ["derive_seed", "generator"]


def derive_seed(seed: int, purpose: str, counter: int) -> int:
    """Hash (seed, purpose, counter) to 63 bits."""
    digest = hashlib.sha256(f"{seed}/{purpose}/{counter}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def generator(seed: int, purpose: str, counter: int) -> torch.Generator:
    """Return a CPU generator that depends only on (seed, purpose, counter)."""
    return torch.Generator().manual_seed(derive_seed(seed, purpose, counter))
