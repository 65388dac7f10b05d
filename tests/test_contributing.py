"""The recipes of CONTRIBUTING.md are followed: what they copy is copied, renamed and used from outside the package."""

import importlib
import re
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
from small_models import ACTION, HIDDEN, SHAPE, Bernoulli64, random_model, sequences

from forbes.cli import main
from forbes.data import SequenceBatch, SequenceDataModule, Simulated
from forbes.data.episode_store import EpisodeStore
from forbes.figures.strokes import Family
from forbes.figures.style import BLUE, save_figure
from forbes.models import MLPDecoder, MLPEncoder
from forbes.training.run_folder import RunFolder

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()


def recipe(heading):
    """The text under a heading."""
    return TEXT.split(f"## {heading}\n")[1].split("\n## ")[0]


def named_in(heading, start):
    """The file that a recipe names after a word."""
    return ROOT / re.search(rf"{start} `([\w/]+\.(?:py|md))`", " ".join(recipe(heading).split()))[1]


@pytest.fixture
def copy_of(in_tmp_path, monkeypatch):
    """Copies a module to the working directory under another name, its class renamed, and imports it."""
    monkeypatch.syspath_prepend(str(in_tmp_path))

    def copy(path, old, new, module):
        Path(f"{module}.py").write_text(re.sub(rf"\b{old}\b", new, path.read_text()))
        importlib.invalidate_caches()
        return getattr(importlib.import_module(module), new)

    yield copy
    for name in [name for name in sys.modules if name.startswith("your_")]:
        del sys.modules[name]


def test_every_file_that_a_recipe_names_exists():
    names = set(re.findall(r"`((?:forbes|tests|configs|docs)/[\w/]+(?:\.py|\.md)?)`", TEXT))

    assert len(names) > 15
    assert not [name for name in names if not (ROOT / name).exists() and "your" not in name]


def test_a_belief_family_outside_this_repository_is_trained(copy_of, tiny_config):
    copy_of(named_in("A belief family", "Copy"), "GaussianBelief", "YourBelief", "your_module")
    command = re.search(r"    forbes (fit --allow-module your_module .*)", TEXT)[1]
    command = command.replace("configs/strokes/forbes.yaml", str(tiny_config))

    assert main([*command.split(), "--run_dir", "run"]) == 0

    assert "your_module.YourBelief" in RunFolder("run").config.read_text()


def test_a_model_copied_from_its_recipe_has_a_bound(copy_of):
    kind = copy_of(named_in("A model whose filter differs", "Copy"), "VectorModel", "YourModel", "your_model")
    decoder = MLPDecoder(HIDDEN, SHAPE, 9, layers=1)
    parts = {"encoder": MLPEncoder(SHAPE, 9, layers=1), "decoder": decoder, "likelihood": Bernoulli64()}
    model = kind(None, **parts, action_dim=ACTION, state_dim=0, hidden_dim=HIDDEN, mlp_dim=9, mlp_layers=1).double()

    assert model.elbo(*sequences()).elbo.shape == (5,)


def test_a_data_source_copied_from_its_recipe_gives_batches(copy_of, strokes_file):
    kind = copy_of(named_in("A data source", "Copy"), "Strokes", "YourSource", "your_source")

    data = SequenceDataModule(kind(path=str(strokes_file), validation=20), batch_size=4, length=6)

    assert data.sequences("train", torch.arange(4)).observation.shape == (4, 6, 1, 28, 28)


def test_the_environment_of_the_documentation_is_collected(in_tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(in_tmp_path))  # a process begins in the folder of the tests
    path = re.search(r"Copy the 20 lines of \[(docs/environments.md)\]", recipe("An environment"))[1]
    text = (ROOT / path).read_text()
    Path("my_room.py").write_text(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1])
    command = re.search(r"    forbes (data collect --allow-module my_room .*)", text)[1]

    assert main(command.replace("--episodes 10", "--episodes 1").split()) == 0

    assert len(EpisodeStore("episodes/room").records) == 1
    del sys.modules["my_room"]


def test_a_process_copied_from_its_recipe_has_a_filter(copy_of):
    names = re.search(
        r"`forbes/pomdps/`.*?`(linear_gaussian.py)`", recipe("A process whose belief is known"), re.DOTALL
    )
    kind = copy_of(ROOT / "forbes/pomdps" / names[1], "LinearGaussian", "YourProcess", "your_process")

    source = Simulated(kind(), 4, 2, 2)
    drawn = source.trajectories("train", 5)

    assert source.process.exact_filter(drawn.observation, drawn.action).log_likelihood.shape == (4,)
    assert SequenceDataModule(source, 2, 5).sequences("test", torch.arange(2)).observation.shape[:2] == (2, 5)


def test_a_score_copied_from_its_recipe_adds_nats_to_each_step(copy_of):
    score = copy_of(named_in("A score", "as in"), "score_particles", "your_score", "your_scores")
    observation, action, mask = sequences()
    zeros = torch.zeros(mask.shape)
    batch = SequenceBatch(observation, action, zeros, mask, zeros[..., None], ~mask)

    scores = score(random_model("gaussian"), batch, 3)

    assert {name: (values.shape, values.dtype) for name, values in scores.items()} == dict.fromkeys(
        ("fivo", "ess"), (mask.shape, torch.float64)
    )


def test_a_figure_copied_from_its_recipe_is_saved_in_both_formats(copy_of):
    path = named_in("A figure", "`paper_style\\(\\)`;")
    draw = copy_of(path, "elbo_against_updates", "your_figure", "your_figures")
    family = Family("FORBES", BLUE, random_model("gaussian"), [pd.Series({1: -9.0, 2: -8.0})], [])

    for kind in ("png", "pdf"):
        save_figure(draw([family], {}), Path(f"figure.{kind}"))
        assert Path(f"figure.{kind}").stat().st_size > 0
