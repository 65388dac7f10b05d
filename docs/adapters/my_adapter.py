"""Copy this file, and fill in the eight marked lines. Here it scores `their_dreamer.py`."""

import torch

# (1) the code of your model
from their_dreamer import Dreamer

import forbes


class Model(forbes.ModelAdapter):
    likelihood = forbes.OnePixel()  # (2) what the decoder's output means

    def __init__(self, checkpoint):
        super().__init__()
        saved = torch.load(checkpoint, weights_only=True)  # (3) your checkpoint
        self.net = Dreamer(**saved["sizes"])
        self.net.load_state_dict(saved["model"])

    def initial(self, batch):  # (4) the state before the first observation
        zeros = next(self.net.parameters()).new_zeros
        return forbes.State(hidden=zeros(batch, self.net.deter), state=zeros(batch, self.net.stoch * self.net.classes))

    def embed_target(self, target):  # (5) the encoder, (B, T, C, H, W) to (B, T, E)
        return self.net.encoder(target.flatten(2))

    def advance(self, before, action):  # (6) h_t
        return self.net.step(before.hidden, before.state, action)

    def prior(self, hidden):  # (7) p(s_t | h_t), and q(s_t | h_t, e_t) below
        return self.net.dist(self.net.prior_head(hidden))

    def posterior(self, hidden, embedding):
        return self.net.dist(self.net.posterior_head(torch.cat((hidden, embedding), -1)))

    def decode_state(self, state):  # (8) the decoder, to (N, C, H, W)
        pixels = self.net.decoder(torch.cat((state.state, state.hidden), -1))
        return pixels.unflatten(-1, (1, 28, 28))
