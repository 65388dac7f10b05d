"""DreamerV3 of sheeprl 0.8: `--model sheeprl_adapter:Model checkpoint=LOGS/version_0/checkpoint/ckpt_100000_0.ckpt`."""

from pathlib import Path

import gymnasium
import torch
from lightning import Fabric
from omegaconf import OmegaConf
from sheeprl.algos.dreamer_v3.agent import build_agent
from torch.distributions import Independent, OneHotCategorical

import forbes


class Model(forbes.ModelAdapter):
    """Observes the images `rgb`; its decoder is a Gaussian's mean, of bytes / 255 - 1/2 as in `forbes.Normal`."""

    likelihood = forbes.Normal()

    def __init__(self, checkpoint, actions, continuous=True, key="rgb", size=64, channels=3):
        super().__init__()
        config = OmegaConf.load(Path(checkpoint).parents[1] / "config.yaml")  # of the run
        saved = torch.load(checkpoint, map_location="cpu", weights_only=False)  # only your own: it unpickles objects
        space = gymnasium.spaces.Dict({key: gymnasium.spaces.Box(0, 255, (channels, size, size), "uint8")})
        world, *_ = build_agent(Fabric(accelerator="cpu"), [actions], continuous, config, space, saved["world_model"])
        self.encoder, self.decoder, self.rssm, self.key = world.encoder, world.observation_model, world.rssm, key

    def initial(self, batch):
        hidden, state = self.rssm.get_initial_states((1, batch))  # (1, B, H), (1, B, 32, 32)
        return forbes.State(hidden[0], state[0].flatten(1))

    def embed_target(self, target):
        return self.encoder({self.key: target})  # (B, T, E)

    def advance(self, before, action):
        inputs = torch.cat((before.state, action), -1)
        return self.rssm.recurrent_model(inputs[None], before.hidden[None])[0]

    def prior(self, hidden):
        return self.distribution(self.rssm._transition(hidden[None])[0])

    def posterior(self, hidden, embedding):
        return self.distribution(self.rssm._representation(hidden[None], embedding[None])[0])

    def distribution(self, logits):  # (1, N, 1024), with the uniform mix
        return Independent(OneHotCategorical(logits=logits[0].unflatten(-1, (-1, self.rssm.discrete))), 1)

    def decode_state(self, state):
        return self.decoder(torch.cat((state.state, state.hidden), -1))[self.key]  # (N, C, H, W)
