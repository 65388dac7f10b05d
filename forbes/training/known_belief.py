"""A learned belief of a known process as a LightningModule: it optimises and logs, the mathematics is in the model."""

from typing import Literal

import torch
from torch import Tensor
from torch.optim import Optimizer

from forbes.beliefs import BeliefFamily, CategoricalBelief
from forbes.data import SequenceBatch, SequenceDataModule, Simulated
from forbes.distributed import mean_over_ranks, shared_batch
from forbes.errors import ForbesError, require_positive
from forbes.models.elbo import elbo_loss
from forbes.models.known_model import KnownModel, Standardizer
from forbes.performance.precision import full_precision
from forbes.pomdps import FiniteBelief, Process
from forbes.pomdps.distributions import PointMass
from forbes.seeding import generator
from forbes.training.seeded import SeededModule

__all__ = ["KnownBelief", "Objective", "has_transition_density"]

Objective = Literal["state_nll", "elbo"]

_EXAMPLES, _STEPS = 1000, 30
"""Number and length of the sequences that standardise states and observations."""


class KnownBelief(SeededModule):
    r"""Learns q(s_t | o_1:t, a_1:t-1) of a process whose densities are known, so that its error can be measured.

    The objectives, in nats per step:

    .. math:: L_{nll} = -\frac1T \sum_t \log q(s_t \mid o_{1:t}), \quad (s, o) \sim p, \qquad
              L_{elbo} = -\frac1T\, E_q\left[\log p(s, o) - \log q(s \mid o)\right]

    The first is a proper score: it is minimal for the exact belief, and exceeds this minimum by KL(exact ‖ q). The
    second trains world models, and prefers a belief that is too narrow (`forbes theorem`).

    Args:
        process: the known process, e.g. `MirrorSensor`; the same as that of the data.
        belief: the family of q, a class of `forbes.beliefs` with its own arguments.
        objective: "state_nll", which uses the true states, or "elbo".
        observation_shape: shape of one observation; the command line takes it from the data.
        action_dim: dimensions of an action, A; the command line takes it from the data.
        hidden_dim: dimensions of the GRU's state, H.
        mlp_dim: width of the MLP between the GRU and the belief.
        mlp_layers: layers of this MLP.
        learning_rate: learning rate of Adam at the start. It falls to 0 along a cosine.
        seed: random seed of the noise of training and validation.

    Raises:
        ForbesError: when the data are of another process, the process lacks a density that the objective needs, the
            family has none, or a size or the rate is not above 0.

    Example:
        >>> process = forbes.MirrorSensor()
        >>> data = forbes.SequenceDataModule(forbes.Simulated(process, train=100), length=20)
        >>> known = forbes.KnownBelief(process, forbes.MixtureBelief)
        >>> known.state_nll(data.sequences("train", torch.arange(5))).shape
        torch.Size([5, 20])
    """

    def __init__(
        self,
        process: Process,
        belief: BeliefFamily,
        objective: Objective = "state_nll",
        observation_shape: tuple[int, ...] = (1,),
        action_dim: int = 0,
        hidden_dim: int = 64,
        mlp_dim: int = 64,
        mlp_layers: int = 1,
        learning_rate: float = 3e-3,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.learning_rate, self.seed, self.schedule = learning_rate, seed, "cosine"
        sizes = {"hidden_dim": hidden_dim, "mlp_dim": mlp_dim, "mlp_layers": mlp_layers}
        require_positive("KnownBelief", **sizes, learning_rate=learning_rate)
        _require_density(process, objective)
        if (*observation_shape, action_dim) != (process.observation_dim, process.action_dim):
            raise _not_its_data(process, f"observations of shape {(*observation_shape,)} and {action_dim} actions")
        self.process, self.objective = process, objective
        state, observation, action = process.sample(_EXAMPLES, _STEPS, generator(0, "units", 0))
        inputs = torch.cat((observation, action), -1)  # (N, T, O + A)
        units = Standardizer(state.flatten(0, 1)), Standardizer(inputs.flatten(0, 1))
        self.model = KnownModel(process, belief, *units, hidden_dim, mlp_dim, mlp_layers)
        if isinstance(self.model.head, CategoricalBelief):
            raise ForbesError("KnownBelief: a CategoricalBelief has no density. Use another family")

    @property
    def objective_name(self) -> str:
        """See `SeededModule.objective_name`."""
        return "loss"

    def setup(self, stage: str) -> None:
        """Refuse data of another process."""
        self.require_data(self.trainer.datamodule)  # type: ignore[attr-defined]

    def require_data(self, data: SequenceDataModule) -> None:
        """Refuse data of another process. Equal processes sample equal sequences from the same noise."""
        source = data.source
        if not isinstance(source, Simulated):
            raise _not_its_data(self.process, f"those of {type(source).__name__}")
        ours, theirs = (process.sample(2, 10, generator(0, "same", 0)) for process in (self.process, source.process))
        if not all(map(torch.equal, ours, theirs)):
            raise _not_its_data(self.process, f"those of {source.process}")

    def state_nll(self, batch: SequenceBatch) -> Tensor:
        """Return -log q(s_t | o_1:t) of the true states in nats, `(B, T)`."""
        with full_precision(batch.state):
            return -self.model.belief(batch.observation, batch.action).log_prob(batch.state)

    def loss(self, batch: SequenceBatch) -> Tensor:
        """Return the objective in nats per step, a scalar."""
        if self.objective == "state_nll":
            return mean_over_ranks(self.state_nll(batch).mean())
        with full_precision(batch.state):
            return elbo_loss(self.model.elbo(batch.observation, batch.action, batch.mask))

    def training_step(self, batch: SequenceBatch, batch_idx: int) -> Tensor:
        """Return and log the loss of one update."""
        with shared_batch():
            loss = self.loss(batch)
        self.log_split("train", {"loss": loss.detach()}, batch)
        return loss

    def measure(self, batch: SequenceBatch) -> dict[str, Tensor]:
        """See `SeededModule.measure`: the loss, and the proper score."""
        return {"loss": self.loss(batch), "state_nll": self.state_nll(batch).mean()}

    def predict_step(self, batch: SequenceBatch, batch_idx: int) -> Tensor:
        """Return -log q(s_t | o_1:t) of the true states in nats, `(B, T)`."""
        return self.state_nll(batch)

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Make no step where the gradient is not finite."""
        gradients = [parameter.grad for parameter in self.parameters() if parameter.grad is not None]
        self.hold_unless_finite(optimizer, torch.nn.utils.get_total_norm(gradients))


def has_transition_density(process: Process) -> bool:
    """Return whether p(s_t | s_{t-1}, a) is a density. It is none where the transition is deterministic."""
    zeros = torch.zeros(1, process.state_dim + process.action_dim)
    state, action = zeros.split((process.state_dim, process.action_dim), -1)  # (1, D), (1, A)
    return not isinstance(process.transition(state, action), PointMass)


def _require_density(process: Process, objective: Objective) -> None:
    """Refuse finite states, and the ELBO where p(s_t | s_{t-1}, a) is no density."""
    name = type(process).__name__
    if isinstance(process.initial(torch.zeros(1)), FiniteBelief):
        raise ForbesError(f"KnownBelief: the states of {name} are finite, expected a density. Train a WorldModel on it")
    if objective == "elbo" and not has_transition_density(process):
        raise ForbesError(
            f"KnownBelief: the steps of {name} are certain, so log p(s_t | s_t-1) is no number, expected a density "
            "for the objective elbo. Choose objective: state_nll"
        )


def _not_its_data(process: Process, found: str) -> ForbesError:
    return ForbesError(
        f"KnownBelief: the data are {found}, expected those of its {process}. Give model and data the "
        "same process, as pomdp/NAME/known_gaussian does"
    )
