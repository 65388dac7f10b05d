"""A few updates of small models, in one process or in several that share every batch: `shared_updates.py OUT`."""

import sys
from functools import partial

import torch
from lightning import Trainer
from lightning.pytorch.callbacks import Callback

from forbes.beliefs import CategoricalBelief, FlowBelief, GaussianBelief
from forbes.data import SequenceBatch, SequenceDataModule, Simulated
from forbes.data.source import SequenceSource
from forbes.distributed import rank
from forbes.models import MLPDecoder, MLPEncoder, ParticleModel, VectorModel, VectorNormal
from forbes.pomdps import MirrorSensor
from forbes.training import ImaginationActorCritic, KnownBelief, PlanningAgent, WorldModel

__all__ = ["ACCUMULATED", "BATCH", "KINDS", "MICRO_BATCHES", "STEPS", "TRAJECTORIES", "train"]

BATCH, STEPS, TRAJECTORIES, UPDATES = 14, 5, 3, 3
ACCUMULATED, MICRO_BATCHES = "accumulated", 2
WORLD = {
    "belief": GaussianBelief,
    "encoder": partial(MLPEncoder, width=6, layers=1),
    "decoder": partial(MLPDecoder, width=6, layers=1),
    "observation_shape": (2,),
    "action_dim": 2,
    "state_dim": 3,
    "hidden_dim": 4,
    "mlp_dim": 6,
    "mlp_layers": 1,
    "center": True,
    "free_nats": 0.05,
}
FLOW = {"belief": partial(FlowBelief, layers=2, width=4)}
AGENT = {"control_dim": 5, "horizon": 3}
KINDS = {
    "RSSM": partial(WorldModel),
    "FORBES": partial(WorldModel, **FLOW, kl="monte_carlo"),
    "much below its free nats": partial(WorldModel, free_nats=50.0),
    "not finite in one row": partial(WorldModel),
    ACCUMULATED: partial(WorldModel, **FLOW, kl="monte_carlo", center=False, free_nats=0),
    "free nats of each step": partial(WorldModel, free_nats_per="element"),
    "categorical": partial(WorldModel, belief=partial(CategoricalBelief, classes=3)),
    "particles": partial(WorldModel, model=partial(ParticleModel, particles=TRAJECTORIES)),
    "vector": partial(WorldModel, model=partial(VectorModel, overshoot=2), state_dim=0),
    "agent": partial(
        ImaginationActorCritic, **FLOW, **AGENT, trajectories=TRAJECTORIES, continuation=True, actor_entropy=0.1
    ),
    "planning agent": partial(PlanningAgent, control_dim=5),
    "known process": partial(KnownBelief, MirrorSensor(), GaussianBelief, objective="elbo", hidden_dim=4, mlp_dim=4),
}


class Double(VectorNormal):
    """In float64, so that a difference is not rounding."""

    def target(self, observation):
        return observation.double()


class Unequal(SequenceSource):
    """Random sequences: those of the first half of a batch are larger, and much shorter unless `whole`, than others."""

    observation_shape, action_dim = (2,), 2

    def __init__(self, broken_row=None, whole=False):
        self.broken_row, self.whole = broken_row, whole

    def sha256(self):
        return ""

    def size(self, split):
        return 9 * BATCH

    def train_index(self, batch_size, length, seed, update):
        return update * batch_size + torch.arange(batch_size)

    def gather(self, split, index, length):
        rows = [torch.Generator().manual_seed(row) for row in index.tolist()]
        draws = [torch.randn(length, 6, generator=row, dtype=torch.float32) for row in rows]
        numbers = torch.stack(draws) if draws else torch.zeros(0, length, 6, dtype=torch.float32)
        if split == "train":
            numbers[index == self.broken_row] = torch.nan
        return numbers, index % BATCH

    def decode(self, compact):
        numbers, row = compact
        short = row < BATCH // 2
        steps = torch.where(short & (not self.whole), 1 + row % 2, numbers.shape[1])  # (B,)
        mask = torch.arange(numbers.shape[1]) < steps[:, None]  # (B, T)
        observation, action, reward, state = numbers.split((2, 2, 1, 1), -1)
        scale = 1 + 2 * short[:, None, None]  # (B, 1, 1)
        return SequenceBatch(scale * observation, action, reward.squeeze(-1), mask, state, mask & (reward[..., 0] > 2))


class DoubleBatches(SequenceDataModule):
    """Batches in float64."""

    def on_after_batch_transfer(self, batch, dataloader_idx):
        decoded = super().on_after_batch_transfer(batch, dataloader_idx)
        return SequenceBatch(*(values.double() if values.is_floating_point() else values for values in decoded))


class Recorder(Callback):
    """What every update logs, its loss, and its gradients before they are clipped."""

    def __init__(self):
        self.rows = []

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        self.gradients = {n: p.grad.clone() for n, p in pl_module.named_parameters() if p.grad is not None}

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        if (batch_idx + 1) % trainer.accumulate_grad_batches:
            return
        row = {name: value.double() for name, value in trainer.callback_metrics.items() if name.startswith("train")}
        self.rows.append({**row, "loss": outputs["loss"].detach(), **self.gradients})


def build(kind):
    torch.manual_seed(0)
    if kind == "known process":
        return KINDS[kind]()
    return KINDS[kind](**{**WORLD, "likelihood": Double(), **KINDS[kind].keywords}).double()


def train(kind, ranks, at_once=False):
    """Return what the updates gave, the validation's metrics, and the weights in the end.

    The micro-batches of an accumulated update are one batch if they come `at_once`.
    """
    micro = MICRO_BATCHES if kind == ACCUMULATED else 1
    known, broken = kind == "known process", 2 * BATCH - 1 if kind == "not finite in one row" else None
    torch.set_default_dtype(torch.float32 if known else torch.float64)  # that of what is logged, too
    try:
        source = (
            Simulated(MirrorSensor(), train=9 * BATCH, validation=9 * BATCH)
            if known
            else Unequal(broken, whole=micro > 1)
        )
        kind_of_data = SequenceDataModule if known else DoubleBatches
        batch_size, batches = (micro * BATCH, UPDATES) if at_once else (BATCH, micro * UPDATES)
        data = kind_of_data(source, batch_size, STEPS, batches, validation_sequences=9 * BATCH)
        module, recorder = build(kind), Recorder()
        trainer = Trainer(
            accelerator="cpu",
            devices=ranks,
            strategy="ddp" if ranks > 1 else "auto",
            max_epochs=1,
            accumulate_grad_batches=1 if at_once else micro,
            num_sanity_val_steps=0,
            log_every_n_steps=1,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            callbacks=[recorder],
        )
        trainer.fit(module, data)
        measured = {n: v.double() for n, v in trainer.callback_metrics.items() if n.startswith("val")}
        return [*recorder.rows, measured, module.state_dict()]
    finally:
        torch.set_default_dtype(torch.float32)


if __name__ == "__main__":
    out, ranks = sys.argv[1], int(sys.argv[2])
    found = {kind: train(kind, ranks) for kind in KINDS}
    torch.save(found, f"{out}.{rank()}")
