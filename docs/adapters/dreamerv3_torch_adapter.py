"""NM512/dreamerv3-torch: `--model dreamerv3_torch_adapter:Model folder=REPO checkpoint=LOGDIR/latest.pt actions=1`."""

import sys
from argparse import Namespace
from pathlib import Path

import gymnasium
import torch
import yaml

import forbes


class Model(forbes.ModelAdapter):
    """Observes `image`; `names` are the `--configs` of its training. The decoder is a Gaussian's mean in [0, 1]."""

    likelihood = forbes.Normal()

    def __init__(self, folder, checkpoint, actions, names="dmc_vision", size=64):
        super().__init__()
        sys.path.append(folder)  # its modules are called models, networks and tools
        import models

        files, config = yaml.safe_load(Path(folder, "configs.yaml").read_text()), {}
        for key, value in (
            (key, value) for name in ("defaults", *names.split(",")) for key, value in files[name].items()
        ):
            config[key] = config.get(key, {}) | value if isinstance(value, dict) else value
        config = Namespace(**config | {"device": "cpu", "num_actions": actions})
        image = gymnasium.spaces.Box(0, 255, (size, size, 3), "uint8")
        self.net = models.WorldModel(gymnasium.spaces.Dict({"image": image}), None, 0, config)
        saved = torch.load(checkpoint, map_location="cpu", weights_only=True)
        saved = saved.get("agent_state_dict", saved)  # older ones are the weights alone
        saved = {key.replace("_orig_mod.", ""): value for key, value in saved.items()}  # of torch.compile
        self.net.load_state_dict({key[4:]: value for key, value in saved.items() if key.startswith("_wm.")})
        self.rssm = self.net.dynamics

    def initial(self, batch):
        state = self.rssm.initial(batch)
        return forbes.State(state["deter"], state["stoch"].flatten(1))

    def embed_target(self, target):  # (B, T, C, H, W) in [-1/2, 1/2] to channels last in [0, 1]
        return self.net.encoder({"image": (target + 0.5).movedim(-3, -1)})

    def advance(self, before, action):
        stoch = before.state.unflatten(-1, (self.rssm._stoch, self.rssm._discrete))
        return self.rssm.img_step({"deter": before.hidden, "stoch": stoch}, action.clone())["deter"]

    def prior(self, hidden):
        return self.rssm.get_dist(self.rssm._suff_stats_layer("ims", self.rssm._img_out_layers(hidden)))

    def posterior(self, hidden, embedding):
        inputs = torch.cat((hidden, embedding), -1)
        return self.rssm.get_dist(self.rssm._suff_stats_layer("obs", self.rssm._obs_out_layers(inputs)))

    def decode_state(self, state):
        image = self.net.heads["decoder"](torch.cat((state.state, state.hidden), -1))["image"]
        return image.mode().movedim(-1, -3) - 0.5  # (N, C, H, W)
