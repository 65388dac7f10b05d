"""Several processes that share every batch make the update of one process that has the whole batch."""

import pytest
import shared_updates
import torch
from ranks import finish, start_ranks
from shared_updates import ACCUMULATED, BATCH, KINDS, STEPS, TRAJECTORIES, train
from torch.overrides import TorchFunctionMode

from forbes.seeding import derive_seed
from forbes.training.seeded import SeededModule

RANKS = 2
pytestmark = [
    pytest.mark.filterwarnings(f"ignore:.*{text}")
    for text in ("LeafSpec", "does not have many workers", "`IterableDataset` has", "dataloader is not resumable")
]
FLATTENED = [(1, 1), (1, STEPS), (TRAJECTORIES, 1), (TRAJECTORIES, STEPS)]
"""What is flattened with the axis that has a row for each sequence: before and after it."""
DRAWS = {  # functions without a generator of their own, and what they fill a tensor with
    **dict.fromkeys(("randn", "randn_like"), torch.Tensor.normal_),
    **dict.fromkeys(("rand", "rand_like"), torch.Tensor.uniform_),
    "exponential_": torch.Tensor.exponential_,
}


class NoiseOfRanks(TorchFunctionMode):
    """Draws what the ranks would draw, each for its own rows, by a generator for every `BATCH / RANKS` sequences."""

    def __init__(self):
        super().__init__()
        self.generators = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs, name = kwargs or {}, getattr(func, "__name__", "")
        if name not in DRAWS or not self.generators or "generator" in kwargs:
            return func(*args, **kwargs)
        like = func(*args, **kwargs)  # its values are replaced
        number, rows = len(self.generators), BATCH // RANKS  # shares, and sequences of each
        sizes = {before * number * rows * after: (before, after) for before, after in FLATTENED}
        axis = next(axis for axis, size in enumerate(like.shape) if size in sizes)
        before, after = sizes[like.shape[axis]]
        shares = like.new_empty(number, *like.shape[:axis], like.shape[axis] // number, *like.shape[axis + 1 :])
        for share, generator in zip(shares, self.generators, strict=True):
            DRAWS[name](share, generator=generator)
        parts = [share.unflatten(axis, (before, rows, after)) for share in shares]
        return like.copy_(torch.cat(parts, axis + 1).flatten(axis, axis + 2))


@pytest.fixture(scope="module")
def on_two_ranks(tmp_path_factory):
    """What two processes found, each of which ran all trainings."""
    out = tmp_path_factory.mktemp("ranks") / "found"
    for status, _, errors in finish(start_ranks(shared_updates.__file__, out, RANKS)):
        assert status == 0, errors
    return [torch.load(f"{out}.{rank}") for rank in range(RANKS)]


@pytest.fixture
def noise_of_ranks(monkeypatch):
    """Let one process draw the noise of two in its updates, also that of all micro-batches in one batch."""
    noise = NoiseOfRanks()

    def seed_update(module, _):
        at_once = module.trainer.datamodule.batch_size // BATCH
        numbers = range(at_once * module.batches_before, at_once * (module.batches_before + 1))
        seeds = [derive_seed(module.seed, purpose, n) for n in numbers for purpose in ("update", "update/1")]
        assert len({*seeds}) == RANKS * at_once
        noise.generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def begin(module):
        noise.generators = []
        started(module)

    started = SeededModule.on_validation_epoch_start
    monkeypatch.setattr(SeededModule, "seed_update", seed_update)
    monkeypatch.setattr(SeededModule, "on_validation_epoch_start", begin)
    with noise:
        yield


@pytest.mark.parametrize("kind", KINDS)
def test_two_ranks_make_the_update_of_one_process(kind, on_two_ranks, noise_of_ranks):
    alone = train(kind, ranks=1)
    rtol, atol = (1e-5, 1e-6) if kind == "known process" else (1e-9, 1e-12)  # float32 or float64

    for of_rank in on_two_ranks:
        for ours, theirs in zip(of_rank[kind], alone, strict=True):
            assert ours.keys() == theirs.keys()
            torch.testing.assert_close(ours, theirs, rtol=rtol, atol=atol, equal_nan=True)
        assert all(values.isfinite().all() for values in of_rank[kind][-1].values())  # weights


def test_accumulated_shares_of_ranks_make_the_update_of_the_whole_batch(on_two_ranks, noise_of_ranks):
    """Two micro-batches on each of two ranks, with noise of their own, where the loss is a mean over sequences."""
    *expected, _, weights = train(ACCUMULATED, ranks=1, at_once=True)

    for of_rank in on_two_ranks:
        *updates, _, found = of_rank[ACCUMULATED]
        for ours, theirs in zip(updates, expected, strict=True):
            gradients = [name for name in theirs if name in weights]
            assert gradients
            for name in gradients:
                torch.testing.assert_close(ours[name], theirs[name], rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(found, weights, rtol=1e-9, atol=1e-12)
