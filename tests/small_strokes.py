"""A few digits that nobody has to read from the disk, and a configuration that trains on them in a second."""

import numpy as np

from forbes.data.strokes.file import StrokeArrays, save_strokes

__all__ = ["write_config", "write_strokes"]

CONFIG = """\
model:
  class_path: WorldModel
  init_args:
    belief: {{class_path: FlowBelief, init_args: {{layers: 2, width: 4}}}}
    encoder: {{class_path: MLPEncoder, init_args: {{width: 8, layers: 1}}}}
    decoder: {{class_path: MLPDecoder, init_args: {{width: 8, layers: 1}}}}
    likelihood: {{class_path: Bernoulli}}
    state_dim: 2
    hidden_dim: 4
    mlp_dim: 8
    mlp_layers: 1
data:
  class_path: SequenceDataModule
  init_args:
    source: {{class_path: Strokes, init_args: {{path: {strokes}, validation: 20}}}}
    batch_size: 4
    length: 6
    updates_per_epoch: 5
    validation_sequences: 20
trainer:
  accelerator: cpu
  max_epochs: 2
  log_every_n_steps: 1
"""


def write_strokes(path):
    """Write 40 training and 12 test digits of 5 to 9 random points."""
    random = np.random.default_rng(0)
    splits = {}
    for split, digits in (("train", 40), ("test", 12)):
        lengths = random.integers(5, 10, digits)
        offsets = np.concatenate([[0], lengths.cumsum()]).astype(np.int32)
        pen_up = np.zeros(offsets[-1], bool)
        pen_up[offsets[1:] - 1] = True
        points = random.integers(0, 28, (offsets[-1], 2), dtype=np.uint8)
        labels = (np.arange(digits) % 10).astype(np.uint8)
        splits[split] = StrokeArrays(points, pen_up, offsets, labels)
    save_strokes(path, splits)
    return path


def write_config(path, strokes):
    """Write a configuration that trains FORBES for two epochs of five updates in a second."""
    path.write_text(CONFIG.format(strokes=strokes))
    return path
