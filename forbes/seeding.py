"""Stateless randomness: a stream is a pure function of (seed, purpose, counter), so resuming needs no RNG state."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["derive_seed", "forked", "generator"]


def derive_seed(seed: int, purpose: str, counter: int) -> int:
    """Hash (seed, purpose, counter) to 63 bits."""
    digest = hashlib.sha256(f"{seed}/{purpose}/{counter}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def generator(seed: int, purpose: str, counter: int) -> torch.Generator:
    """Return a CPU generator that depends only on (seed, purpose, counter)."""
    return torch.Generator().manual_seed(derive_seed(seed, purpose, counter))


@contextmanager
def forked(device: torch.device | str, seed: int) -> Iterator[None]:
    """Seed torch's global generators inside the `with` block; restore those of the CPU and of `device` after it."""
    device = torch.device(device)
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
