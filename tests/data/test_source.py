"""Batches of sequences: moved, cut and selected as one."""

import torch

from forbes.data import SequenceBatch


def make_batch(sequences, steps):
    mask = torch.arange(sequences * steps).view(sequences, steps)
    return SequenceBatch(mask[..., None], mask[..., None] + 1, mask + 2, mask + 3, mask[..., None] + 4, mask + 5)


def test_a_batch_is_cut_selected_and_moved_field_by_field():
    batch = make_batch(4, 6)

    for values, first, rows, moved in zip(
        batch, batch.first(2), batch.rows(slice(1, 3)), batch.to("meta"), strict=True
    ):
        assert torch.equal(first, values[:, :2])
        assert torch.equal(rows, values[1:3])
        assert moved.device.type == "meta"
