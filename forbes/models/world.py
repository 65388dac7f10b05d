"""The arguments of a world model and of its training, and the belief model that they describe."""

from typing import Literal, TypeAlias, get_args

import torch
from torch import nn

from forbes.beliefs import BeliefFamily, FlowBelief
from forbes.errors import require_at_least, require_one_of
from forbes.models.base import ModelFamily, ModelParts
from forbes.models.elbo import KL, FreeNats
from forbes.models.likelihoods import Likelihood, Normal
from forbes.models.networks import Activation, ConvDecoder, ConvEncoder, DecoderFamily, EncoderFamily, activate
from forbes.models.requirements import likelihood_for, require_mean, require_path, require_same_states
from forbes.models.state_space import StateSpaceModel
from forbes.shapes import Shape, size_of

__all__ = ["Schedule", "World"]

Schedule: TypeAlias = Literal["constant", "cosine"]


class World(nn.Module):
    """A belief model and how it is trained: all of a `WorldModel` that works without a Trainer.

    An evaluation loads this class. It does not import Lightning, which takes longer than loading a run.

    Args:
        belief: the family of prior and posterior, a class of `forbes.beliefs` with its own arguments.
        prior: the family of the prior, where it is another one: a flow in only one of the two.
        model: how it filters, a class of `forbes.models` with its own arguments: `StateSpaceModel`, `ParticleModel`
            (the belief is a set of particles) or `VectorModel` (no stochastic state).
        encoder: o_t to e_t, a class of `forbes.models.networks`.
        decoder: features to the likelihood's parameters, likewise.
        likelihood: what the decoder's output means; `Normal()` by default.
        observation_shape: shape of one observation, or of its parts by name; the command line takes it from the data.
        action_dim: dimensions of an action, A; the command line takes it from the data.
        state_dim: dimensions of s, D; 0 for a `VectorModel`.
        hidden_dim: dimensions of h, the GRU's state, H.
        mlp_dim: width of every MLP.
        mlp_layers: layers of every MLP.
        activation: activation of every MLP; convolutions and flows keep their ReLU.
        kl: how the KL is differentiated. "analytic": by its closed form where the family has one, else as "path".
            "path": at the posterior's sample, through the sample alone. "monte_carlo": through the posterior's
            parameters too; this noise costs a flow thousands of updates. Of a `ParticleModel`, "analytic" is this.
        free_nats: the KL below this, in nats per step, costs nothing in training.
        free_nats_per: "batch" applies them to the mean over batch and time, "element" to each step, for a KL in closed
            form.
        kl_warmup: updates over which the weight of the KL rises from 0 to 1.
        learning_rate: learning rate of Adam (eps 1e-7).
        schedule: "constant", or "cosine" to 0 at the end of the training.
        warmup: updates over which the learning rate rises from 0; a high rate needs it.
        clip_norm: gradients are scaled down to this norm.
        center: measure the mean observation on the first batch. Encoder and decoder then work on the difference to it.
            This learns several times faster where most of a frame never changes. For Gaussian likelihoods.
        seed: random seed of the noise of training and validation.

    Raises:
        ForbesError: when a size is below 1, another number below 0, a choice does not exist, or `likelihood`, `prior`,
            `kl` or `center` does not fit the other arguments.
    """

    def __init__(
        self,
        belief: BeliefFamily = FlowBelief,
        prior: BeliefFamily | None = None,
        model: ModelFamily = StateSpaceModel,
        encoder: EncoderFamily = ConvEncoder,
        decoder: DecoderFamily = ConvDecoder,
        likelihood: Likelihood | None = None,
        observation_shape: Shape = (3, 64, 64),
        action_dim: int = 0,
        state_dim: int = 30,
        hidden_dim: int = 200,
        mlp_dim: int = 200,
        mlp_layers: int = 2,
        activation: Activation = "relu",
        kl: KL = "analytic",
        free_nats: float = 3.0,
        free_nats_per: FreeNats = "batch",
        kl_warmup: int = 0,
        learning_rate: float = 5e-4,
        schedule: Schedule = "constant",
        warmup: int = 0,
        clip_norm: float = 100.0,
        center: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.learning_rate, self.seed, self.schedule, self.warmup = learning_rate, seed, schedule, warmup
        require_at_least(1, "WorldModel", hidden_dim=hidden_dim, mlp_dim=mlp_dim, mlp_layers=mlp_layers)
        require_at_least(0, "WorldModel", state_dim=state_dim, learning_rate=learning_rate, clip_norm=clip_norm)
        require_at_least(0, "WorldModel", free_nats=free_nats, kl_warmup=kl_warmup, warmup=warmup)
        require_one_of(get_args(KL), "WorldModel", kl=kl)
        require_one_of(get_args(FreeNats), "WorldModel", free_nats_per=free_nats_per)
        require_one_of(get_args(Schedule), "WorldModel", schedule=schedule)
        require_one_of(get_args(Activation), "WorldModel", activation=activation)
        likelihood = likelihood_for(observation_shape, likelihood or Normal())
        self.model = model(
            ModelParts(
                belief=belief,
                prior=prior,
                encoder=encoder(observation_shape),
                decoder=decoder(hidden_dim + state_dim, observation_shape),
                likelihood=likelihood,
                action_dim=action_dim,
                state_dim=state_dim,
                hidden_dim=hidden_dim,
                mlp_dim=mlp_dim,
                mlp_layers=mlp_layers,
            )
        )
        require_same_states(self.model)
        require_path(kl, self.model)
        self.activation: Activation = activation
        activate(self.model, activation)
        if center:
            require_mean(likelihood)
            shape = (size_of(observation_shape),) if isinstance(observation_shape, dict) else observation_shape
            self.model.center = torch.zeros(shape)
        self.kl, self.free_nats, self.free_nats_per, self.kl_warmup = kl, free_nats, free_nats_per, kl_warmup
        self.clip_norm = clip_norm
