"""A user trains, scores and draws models of observations of several parts, from a YAML."""

import io
import json

import numpy as np
import pytest
import torch
from lightning import Trainer
from PIL import Image
from small_agents import forbes
from toy_environments import Robot

from forbes import evaluate, load_run
from forbes.data import Experience, Replay, SequenceDataModule
from forbes.data.episodes.collection import collect_episodes, random_policy
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.record import read_arrays, read_record
from forbes.evaluation.references import references
from forbes.models import Bernoulli, Normal, PartsLikelihood, VectorNormal
from forbes.runs.folder import read_metrics
from forbes.training import ImaginationActorCritic, WorldModel

NETWORKS = """\
    belief: {class_path: GaussianBelief}
    encoder:
      class_path: PartsEncoder
      init_args:
        parts:
          camera: {class_path: ConvEncoder, init_args: {channels: 4}}
          joint: {class_path: MLPEncoder, init_args: {width: 8, layers: 1}}
    decoder:
      class_path: PartsDecoder
      init_args:
        parts:
          camera: {class_path: ConvDecoder, init_args: {channels: 4}}
          joint: {class_path: MLPDecoder, init_args: {width: 8, layers: 1}}
    likelihood:
      class_path: PartsLikelihood
      init_args:
        parts:
          camera: {class_path: Normal, init_args: {std: 0.5}}
          joint: {class_path: VectorNormal, init_args: {std: 0.1}}
    state_dim: 2
    hidden_dim: 6
    mlp_dim: 8
    mlp_layers: 1
"""
WORLD = """\
model:
  class_path: WorldModel
  init_args:
{networks}
data:
  class_path: SequenceDataModule
  init_args:
    source: {{class_path: Replay, init_args: {{path: {store}, hold_out: 3, stride: 5}}}}
    batch_size: 3
    length: 6
    updates_per_epoch: 3
trainer:
  max_epochs: 2
  log_every_n_steps: 1
  callbacks:
    - {{class_path: OpenLoopPanel, init_args: {{context: 2, columns: 5}}}}
    - {{class_path: ImaginedFutures, init_args: {{context: 2, columns: 3, samples: 2}}}}
"""
AGENT = """\
model:
  class_path: ImaginationActorCritic
  init_args:
{networks}
    control_dim: 8
    horizon: 3
data:
  class_path: SequenceDataModule
  init_args:
    source: {{class_path: Experience, init_args: {{task: Robot, options: {{steps: 8, hide: {{joint: [1]}}}}}}}}
    batch_size: 3
    length: 5
    updates_per_epoch: 3
trainer:
  max_epochs: 2
  limit_val_batches: 0
  log_every_n_steps: 1
  callbacks:
    - {{class_path: Collect, init_args: {{seed_episodes: 2, evaluate_every: 2, evaluation_episodes: 2}}}}
    - {{class_path: EpisodeVideo}}
"""
BOUND = "elbo[camera=normal(0.5),joint=normal(0.1),S=1]"


def opened(path):
    return Image.open(io.BytesIO(path.read_bytes()))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "store"
    with EpisodeWriter(path) as writer:
        list(collect_episodes(Robot(), writer, random_policy, "random", until=9, seed=0))
    return path


@pytest.fixture(scope="module")
def world(store):
    """A run of a world model of two parts."""
    config, run = store.parent / "world.yaml", store.parent / "world"
    config.write_text(WORLD.format(networks=NETWORKS, store=store))
    assert forbes("fit", config, "--run_dir", run) == 0
    return run


@pytest.fixture(scope="module")
def agent(store):
    config, run = store.parent / "agent.yaml", store.parent / "agent"
    config.write_text(AGENT.format(networks=NETWORKS))
    assert forbes("fit", config, "--run_dir", run) == 0
    return run


def test_a_world_model_logs_its_bound_by_part(world):
    metrics = read_metrics(world)

    names = [f"{split}/{name}" for split in ("train", "val") for name in (BOUND, "reconstruction", "kl")]
    parts = [f"{split}/reconstruction/{part}" for split in ("train", "val") for part in PARTS]
    assert {*names, *parts} <= {*metrics}
    last = metrics.ffill().iloc[-1]
    for split in ("train", "val"):
        total = sum(last[f"{split}/reconstruction/{part}"] for part in PARTS)
        assert total == pytest.approx(last[f"{split}/reconstruction"], rel=1e-5)


PARTS = ("camera", "joint")


def test_its_scores_have_references_on_the_same_parts(world):
    assert forbes("evaluate", world, "--sequences", 4, "--samples", 2, "--particles", 4, "--context", 3) == 0

    scores = json.loads((world / "evaluation.json").read_text())
    elbo = next(entry for name, entry in scores.items() if "/elbo[camera=normal(0.5),joint=normal(0.1),S=2]" in name)
    assert {*elbo["references"]} == {"mean observation", "last observation"}
    assert not any("psnr" in name for name in scores)  # of images alone
    whole = next(entry["mean"] for name, entry in scores.items() if "/reconstruction[" in name)
    by_part = [entry["mean"] for name, entry in scores.items() if "/reconstruction/" in name]
    assert len(by_part) == 2
    assert sum(by_part) == pytest.approx(whole, rel=1e-5)


def test_errors_are_over_episodes_and_not_over_their_windows(world, store):
    assert forbes("evaluate", world, "--scores", "elbo", "--samples", 2) == 0

    name = f"test/{BOUND.replace('S=1', 'S=2')}"
    entry, values = read_record(str(world))[name], torch.from_numpy(read_arrays(str(world))[name])
    of_test = [number for number in EpisodeStore(store).records if number % 3 == 2]
    assert {*entry["episode_of"]} == {*of_test}
    assert len(entry["episode_of"]) == len(values) > len(of_test) > 1
    expected = Estimate.of(values, entry["episode_of"])
    assert entry["standard_error"] == pytest.approx(expected.standard_error)
    assert entry["standard_error"] != pytest.approx(Estimate.of(values).standard_error, rel=1e-3)
    data = SequenceDataModule(Replay(str(store), hold_out=3, stride=5), length=6)
    found = evaluate(load_run(world)[0].model, data, ["elbo"], sequences=len(values), samples=2)
    assert found["elbo"] == pytest.approx(expected)


def test_a_reference_is_the_sum_of_those_of_the_parts(store):
    data = SequenceDataModule(Replay(str(store), hold_out=3), length=6)
    parts = {"camera": Normal(0.5), "joint": VectorNormal(0.1)}
    likelihood = PartsLikelihood(parts).for_shape(data.observation_shape)
    batch = data.sequences("test", torch.arange(2))

    found = references(data, likelihood, "test", 2)["last observation"]

    mask = batch.mask[:, 1:]
    expected = 0
    for name, part in parts.items():
        target = part.target(batch.observation[name])
        expected = expected + part.log_prob(target[:, :-1], target[:, 1:])
    torch.testing.assert_close(found[:, 1:], (expected * mask).double())
    assert references(data, PartsLikelihood(parts | {"camera": Bernoulli()}), "test", 2) == {}


def test_a_loaded_model_is_the_one_that_was_trained(world, store):
    module = WorldModel.load_from_checkpoint(world / "checkpoints" / "last.ckpt")
    written = torch.load(world / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]

    assert {*module.state_dict()} == {*written}
    assert all(torch.equal(values, written[name]) for name, values in module.state_dict().items())
    _, data = load_run(world)
    terms = module.terms(data.sequences("test", torch.arange(2)))
    assert {*terms.parts} == {*PARTS}


@pytest.mark.filterwarnings("ignore:.*LeafSpec", "ignore:.*does not have many workers", "ignore:.*IterableDataset")
def test_a_model_built_for_the_data_can_be_saved_and_loaded(store, tmp_path):
    data = SequenceDataModule(Replay(str(store), hold_out=3), length=6, batch_size=3, updates_per_epoch=2)
    module = WorldModel.for_data(data, state_dim=2, hidden_dim=4, mlp_dim=4)
    trainer = Trainer(max_epochs=1, default_root_dir=tmp_path, logger=False, enable_progress_bar=False)
    trainer.fit(module, data)
    trainer.save_checkpoint(tmp_path / "plain.ckpt")

    loaded = WorldModel.load_from_checkpoint(tmp_path / "plain.ckpt")

    assert all(map(torch.equal, module.state_dict().values(), loaded.state_dict().values()))
    assert loaded.model.bound_name == "elbo[camera=normal(1),joint=normal(1),S=1]"


def test_pictures_show_the_images_among_the_parts(world):
    for name in ("open_loop.png", "futures.png"):
        assert np.asarray(opened(world / "figures" / name)).std() > 0


@pytest.mark.parametrize("callback", ["BeliefPlot", "PredictionGrid"])
def test_pictures_of_one_array_are_refused_in_one_sentence(world, callback, capsys):
    config = world.parent / "world.yaml"

    assert forbes("fit", config, "--trainer.callbacks", callback, "--run_dir", world.parent / callback) == 2

    assert f"{callback}: the observations have the parts camera, joint" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (("joint: {class_path: MLPEncoder", "sound: {class_path: MLPEncoder"), "PartsEncoder: lacks joint and has so"),
        (("{class_path: VectorNormal", "{class_path: Normal"), "that of joint is a Normal"),
        (("class_path: PartsDecoder", "class_path: Sequential"), "decoder"),
    ],
    ids=["name", "rank", "class"],
)
def test_a_configuration_that_does_not_fit_is_one_sentence(store, tmp_path, capsys, changed, sentence):
    config = tmp_path / "wrong.yaml"
    config.write_text(WORLD.format(networks=NETWORKS.replace(*changed), store=store))

    assert forbes("fit", config, "--run_dir", tmp_path / "run") == 2

    shown = capsys.readouterr().err
    assert sentence in shown
    assert "Traceback" not in shown


def test_an_agent_learns_from_its_own_episodes_of_parts(agent):
    episodes = EpisodeStore(agent / "episodes")

    assert len(episodes.records) >= 3
    shape = episodes.records[0].environment["observation_shape"]
    assert shape == {"camera": [1, 6, 6], "joint": [1]}  # the clock is hidden
    assert f"train/{BOUND}" in read_metrics(agent)
    assert (agent / "figures" / "episode.gif").stat().st_size > 0


def test_an_agent_is_evaluated_and_filmed(agent, tmp_path):
    assert forbes("evaluate", agent, "--episodes", 2) == 0
    assert forbes("rollout", agent, "--video", tmp_path / "plain.gif") == 0
    assert forbes("rollout", agent, "--video", tmp_path / "dream.gif", "--imagine", 3) == 0

    plain, dream = (opened(tmp_path / f"{name}.gif") for name in ("plain", "dream"))
    assert plain.size == (258, 258)  # 6 pixels, enlarged
    assert dream.size[0] > 2 * 258  # what happened, what was imagined, and the curves of the joint


def test_an_agent_resumes_bit_for_bit(agent, tmp_path):
    config, short = agent.parent / "agent.yaml", tmp_path / "short"
    assert forbes("fit", config, "--run_dir", short, "--trainer.max_epochs", 1) == 0
    assert forbes("fit", "--resume", short, "--trainer.max_epochs", 2) == 0

    one, other = (torch.load(run / "checkpoints/last.ckpt", weights_only=True)["state_dict"] for run in (short, agent))
    assert all(torch.equal(values, other[name]) for name, values in one.items())


def test_info_describes_the_parts_and_draws_the_images(store, capsys, tmp_path):
    assert forbes("data", "info", store, "-o", tmp_path / "frames.png") == 0

    assert "{'camera': [1, 6, 6], 'joint': [2]}" in capsys.readouterr().out
    assert opened(tmp_path / "frames.png").size[0] > 100


def test_python_builds_an_agent_for_the_parts():
    source = Experience("Robot")
    data = SequenceDataModule(source, length=5, batch_size=2)
    try:
        module = ImaginationActorCritic.for_data(data, hidden_dim=4, state_dim=2, mlp_dim=4, control_dim=4)
    finally:
        source.close()

    assert {*module.model.likelihood.parts} == {"camera", "joint"}
