"""Somebody else's code: a small DreamerV3 of pen strokes, as its author would write it."""

import sys

import torch
from torch import nn
from torch.distributions import Independent, OneHotCategorical, OneHotCategoricalStraightThrough, kl_divergence
from torch.nn.functional import cross_entropy, pad

import forbes


def mlp(inputs, outputs, hidden=64):
    """A layer with LayerNorm and SiLU, and a linear one."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.LayerNorm(hidden), nn.SiLU(), nn.Linear(hidden, outputs))


class Dreamer(nn.Module):
    """A discrete RSSM: `stoch` categoricals of `classes` classes with 1 % uniform mix, and a GRU of width `deter`."""

    def __init__(self, pixels=784, actions=0, deter=64, stoch=8, classes=8):
        super().__init__()
        self.sizes = {"pixels": pixels, "actions": actions, "deter": deter, "stoch": stoch, "classes": classes}
        self.stoch, self.classes, self.deter = stoch, classes, deter
        self.encoder = mlp(pixels, 64)
        self.pre = mlp(stoch * classes + actions, 64)
        self.gru = nn.GRUCell(64, deter)
        self.prior_head = mlp(deter, stoch * classes)
        self.posterior_head = mlp(deter + 64, stoch * classes)
        self.decoder = mlp(stoch * classes + deter, pixels)

    def dist(self, logits, kind=OneHotCategorical):
        probs = logits.unflatten(-1, (self.stoch, self.classes)).softmax(-1)
        return Independent(kind(probs=0.99 * probs + 0.01 / self.classes), 1)

    def step(self, deter, stoch, action):
        return self.gru(self.pre(torch.cat((stoch, action), -1)), deter)

    def loss(self, image, action, mask):
        """The loss of DreamerV3: KL balance 1 and 0.1, one free nat, and the cross-entropy of the written pixel."""
        embed = self.encoder(image.flatten(2).float())
        deter = image.new_zeros(len(image), self.deter, dtype=torch.float32)
        stoch = deter.new_zeros(len(image), self.stoch * self.classes)
        total = 0.0
        for t in range(image.shape[1]):
            deter = self.step(deter, stoch, action[:, t])
            prior, post = self.prior_head(deter), self.posterior_head(torch.cat((deter, embed[:, t]), -1))
            stoch = self.dist(post, OneHotCategoricalStraightThrough).rsample().flatten(1)
            logits = pad(self.decoder(torch.cat((stoch, deter), -1)), (0, 1))  # the last class is "no pixel"
            frame = pad(image[:, t].flatten(1).float(), (0, 1), value=0.5)
            pixel = cross_entropy(logits, frame.argmax(-1), reduction="none")
            dyn = kl_divergence(self.dist(post.detach()), self.dist(prior)).clamp(min=1)
            rep = kl_divergence(self.dist(post), self.dist(prior.detach())).clamp(min=1)
            total = total + ((pixel + dyn + 0.1 * rep) * mask[:, t]).mean()
        return total


def train(data, updates, path):
    """Train on the batches of a data module, and save sizes and weights."""
    torch.manual_seed(0)
    model = Dreamer(pixels=torch.Size(data.observation_shape).numel(), actions=data.action_dim)
    optimizer = torch.optim.Adam(model.parameters(), 6e-3)
    for update in range(updates):
        batch = data.sequences("train", data.train_index(update))
        optimizer.zero_grad()
        loss = model.loss(batch.observation, batch.action, batch.mask)
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 100)
        optimizer.step()
    print(f"loss {loss.item():.1f} nats per sequence after {updates} updates")
    torch.save({"sizes": model.sizes, "model": model.state_dict()}, path)


if __name__ == "__main__":
    strokes = forbes.SequenceDataModule(forbes.Strokes(), batch_size=16, length=30)
    train(strokes, updates=int(sys.argv[1]), path="their_dreamer.pt")
