"""Means over the batches of a validation."""

import torch

from forbes.distributed import WeightedMeans


def test_the_means_are_those_of_python_floats_bit_for_bit():
    torch.manual_seed(0)
    batches = [(100 * torch.randn(()), weight) for weight in (250, 250, 250, 7)]
    means = WeightedMeans()

    for value, weight in batches:
        means.add({"elbo": value, "kl": value.bfloat16()}, weight)

    total = sum(weight for _, weight in batches)
    expected = {
        "elbo": sum(weight * value.item() for value, weight in batches) / total,
        "kl": sum(weight * value.bfloat16().item() for value, weight in batches) / total,
    }
    assert means.compute() == expected
    assert WeightedMeans().compute() == {}


def test_adding_a_batch_reads_no_number_from_the_device():
    """A tensor on the device meta has no number: whatever waits for one raises."""
    means = WeightedMeans()

    for _ in range(2):
        means.add({"elbo": torch.ones((), device="meta")}, 250)
