"""What several tests need: one thread, and a few digits that nobody has to read from the disk."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from forbes.cli import main
from forbes.data.stroke_file import StrokeArrays, save_strokes
from forbes.training import configuration, loading
from forbes.training.checkpoint import AtomicCheckpointIO, read_checkpoint

torch.set_num_threads(1)  # a second thread gains nothing on matrices of this size


@pytest.fixture(autouse=True, scope="module")
def no_module_is_allowed_yet() -> Iterator[None]:
    """Let a file's tests begin like a process: a record names the modules that were allowed in it, no others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(configuration, "_allowed", {})
        yield


@pytest.fixture(autouse=True)
def no_module_is_allowed_by_another_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each of them begin so."""
    monkeypatch.setattr(configuration, "_allowed", {})


@pytest.fixture(scope="session")
def strokes_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stroke file of 40 training and 12 test digits of 5 to 9 random points."""
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
    path = tmp_path_factory.mktemp("strokes") / "strokes.npz"
    save_strokes(path, splits)
    return path


@pytest.fixture(scope="session")
def tiny_config(strokes_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration that trains FORBES for two epochs of five updates in a second."""
    path = tmp_path_factory.mktemp("project") / "configs" / "tiny" / "forbes.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(f"""\
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
    source: {{class_path: Strokes, init_args: {{path: {strokes_file}, validation: 20}}}}
    batch_size: 4
    length: 6
    updates_per_epoch: 5
    validation_sequences: 20
trainer:
  accelerator: cpu
  max_epochs: 2
  log_every_n_steps: 1
""")
    return path


@pytest.fixture(scope="session")
def tiny_run(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder that the tiny configuration leaves; not to be changed."""
    run = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 0
    return run


@pytest.fixture
def overwritten(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Let a training go on while its run is measured; gives the hash of each checkpoint that was read, by its path."""
    read: dict[str, str] = {}

    def check_weights(model: object, state: object, name: str) -> None:
        read[name] = hashlib.sha256(Path(name).read_bytes()).hexdigest()
        content = read_checkpoint(Path(name))
        AtomicCheckpointIO().save_checkpoint(content | {"global_step": content["global_step"] + 1}, name)

    monkeypatch.setattr(loading, "check_weights", check_weights)
    return read


@pytest.fixture
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in an empty folder, so that runs/ is made there."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
