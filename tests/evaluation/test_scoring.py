"""Scoring a split where the memory does not suffice."""

import subprocess
import sys

import pytest
import torch
from torch import nn

from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.evaluation.record import describe
from forbes.evaluation.scoring import PartialScores, Scorer, Scores, score_split

STEPS = 3


def batches():
    """Two batches of five sequences; the observation is the sequence's number."""
    for first in (0, 5):
        number = torch.arange(first, first + 5).view(5, 1, 1).expand(5, STEPS, 1)
        none, mask = torch.zeros(5, STEPS, 0), torch.ones(5, STEPS) > 0
        yield first, SequenceBatch(number, none, torch.zeros(5, STEPS), mask, none, ~mask)


def hungry(limit, error):
    """A pass that scores a sequence by its number, and has memory for so many at once."""

    def function(model, batch):
        if len(batch.mask) > limit:
            raise error
        return {"number": batch.observation[..., 0].double()}

    return Scorer(("number",), "K=9", function, 5)


OUT_OF_MEMORY = [
    torch.OutOfMemoryError("CUDA out of memory"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory: you tried"),
]


@pytest.mark.parametrize("error", OUT_OF_MEMORY, ids=["cuda", "cpu"])
@pytest.mark.parametrize("limit", [1, 2, 3, 4])
def test_a_batch_too_large_for_memory_is_halved_loudly(limit, error, capsys):
    scores = score_split(nn.Linear(1, 1), batches(), hungry(limit, error), where="runs/a, test split")

    torch.testing.assert_close(scores.values["number"].sum(1), STEPS * torch.arange(10, dtype=torch.float64))
    assert "runs/a, test split: no memory for 5 sequences at once, trying 2" in capsys.readouterr().err


def test_a_single_sequence_beyond_memory_gives_a_remedy():
    with pytest.raises(ForbesError, match=r"runs/a: no memory for one sequence with K=9. Choose fewer particles"):
        score_split(nn.Linear(1, 1), batches(), hungry(0, OUT_OF_MEMORY[0]), where="runs/a")


LIMITED = """
import resource
import forbes

data = forbes.SequenceDataModule(forbes.Strokes(), length=30)
world = forbes.WorldModel.for_data(data)

def score(batch_size):
    return forbes.evaluate(world.model, data, ["elbo"], sequences=512, samples=1, batch_size=batch_size)["elbo"]

alone = score(8)  # also loads what torch loads when it is first used
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 60 * 2**20,) * 2)  # all 512 take 200 MiB
halved = score(512)
assert abs(halved.mean - alone.mean) < 4 * alone.standard_error  # other batches have other noise
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
def test_an_evaluation_with_too_little_memory_is_halved_and_ends():
    done = subprocess.run([sys.executable, "-c", LIMITED], capture_output=True, text=True, timeout=300)

    assert done.returncode == 0, done.stderr
    assert "no memory for 512 sequences at once, trying 256" in done.stderr


def noise_of(seed, parts=None):
    """What a pass of noise alone gives in two batches, (10, T)."""
    noise = Scorer(("noise",), "", lambda model, batch: {"noise": torch.randn(batch.mask.shape).double()}, 5)
    return score_split(nn.Linear(1, 1), batches(), noise, seed, parts=parts).values["noise"]


def test_every_batch_and_every_seed_has_noise_of_its_own():
    first = noise_of(seed=0)

    assert first.flatten().unique().numel() == 10 * STEPS
    assert torch.equal(noise_of(seed=0), first)
    assert not torch.isin(noise_of(seed=1), first).any()


def test_a_batch_has_the_same_noise_whatever_was_scored_before(tmp_path):
    whole, parts = noise_of(seed=0), PartialScores(tmp_path / "parts", "noise")
    parts.write(0, {"noise": whole[:5]})  # what an interrupted evaluation has left

    assert torch.equal(noise_of(seed=0, parts=parts), whole)


def test_another_error_is_not_taken_for_a_lack_of_memory():
    with pytest.raises(RuntimeError, match="shapes"):
        score_split(nn.Linear(1, 1), batches(), hungry(0, RuntimeError("shapes do not fit")))


def test_a_curve_ends_with_the_last_sequence():
    """Steps that no sequence reaches have no mean; they counted as 0 nats."""
    values = {"elbo": torch.tensor([[1.0, 2.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]], dtype=torch.float64)}
    mask = torch.tensor([[True, True, False, False], [True, False, False, False]])

    assert describe(Scores(values, mask), "elbo")["curve"] == [2.0, 2.0]
