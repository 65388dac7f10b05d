"""Figure 1: beliefs next to the exact one, of a sequence that no model has chosen."""

import numpy as np
import pytest
import torch
import yaml
from command_line import error_of

from forbes.beliefs import GaussianBelief
from forbes.commands.cli import main
from forbes.data import SequenceDataModule, Simulated
from forbes.figures.belief_samples import KnownSamples, WorldSamples, exact_belief, world_models
from forbes.figures.beliefs import DrawnBelief, beliefs_over_time, draw_beliefs, least_gaussian
from forbes.figures.style import METHODS
from forbes.pomdps import LinearGaussian, MirrorSensor, MountainHike
from forbes.training import KnownBelief

MULTI = {"class_path": "MountainHike", "init_args": {"start": "multi", "observation_std": 1.5}}
MIRROR = {"class_path": "MirrorSensor"}


def data_of(process, length=6, test=30):
    source = Simulated(process, train=50, validation=10, test=test)
    return SequenceDataModule(source, batch_size=10, length=length)


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """Train two updates of a world model, or of a known belief."""

    def run(name, process, model):
        folder = tmp_path_factory.mktemp("runs")
        sizes = {"train": 50, "validation": 10, "test": 30}
        source = {"class_path": "Simulated", "init_args": {"process": process, **sizes}}
        data = {"source": source, "batch_size": 10, "length": 6, "updates_per_epoch": 2, "validation_sequences": 10}
        config = {
            "model": model,
            "data": {"class_path": "SequenceDataModule", "init_args": data},
            "trainer": {"max_epochs": 1, "callbacks": [], "enable_progress_bar": False},
        }
        (folder / "config.yaml").write_text(yaml.safe_dump(config))
        assert main(["fit", "--config", str(folder / "config.yaml"), "--run_dir", str(folder / name)]) == 0
        return str(folder / name)

    return run


def known(process):
    return {"class_path": "KnownBelief", "init_args": {"process": process, "belief": {"class_path": "GaussianBelief"}}}


def world(std, **others):
    parts = {name: {"class_path": f"MLP{name.title()}", "init_args": {"width": 8}} for name in ("encoder", "decoder")}
    likelihood = {"class_path": "VectorNormal", "init_args": {"std": std}}
    sizes = {"state_dim": 2, "hidden_dim": 8, "mlp_dim": 8, "mlp_layers": 1}
    arguments = {"belief": {"class_path": "GaussianBelief"}, "likelihood": likelihood, **parts, **sizes, **others}
    return {"class_path": "WorldModel", "init_args": arguments}


@pytest.fixture(scope="module")
def runs(fit):
    return {
        "known": fit("gaussian-0", MIRROR, known(MIRROR)),
        "world": fit("rssm-0", MULTI, world(15.0)),
        "noise": fit("rssm_noise-0", MULTI, world(1.0)),
        "vector": fit("vector-0", MULTI, world(15.0, model={"class_path": "VectorModel"}, state_dim=0)),
    }


def test_the_sequence_drawn_has_the_least_gaussian_beliefs():
    """Two equal modes of the mirror sensor are far from a Gaussian if they are far apart compared with their width."""
    process = MirrorSensor(cells=401)
    data = data_of(process)

    chosen = least_gaussian(data, process)

    distance = data.sequences("test", torch.arange(30)).state.abs().sum((1, 2))  # (B,)
    assert distance[chosen] > distance.quantile(0.9)


def test_a_gaussian_process_has_no_least_gaussian_sequence():
    """All distances are 0, so the first is drawn."""
    process = LinearGaussian()
    assert least_gaussian(data_of(process), process) == 0


def test_a_drawn_density_is_that_of_the_samples():
    """The shade is the square root of the density, relative to the maximum of the first belief at this step."""
    points = torch.randn(20_000, 2, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    exact = DrawnBelief("exact belief", METHODS["exact belief"], points)
    wide = DrawnBelief("RSSM", METHODS["RSSM"], 2 * points)

    figure = beliefs_over_time([exact, wide], torch.zeros(2, 1, dtype=torch.float64), [1, 2], "state")

    first, second = (np.asarray(axes.images[0].get_array()) for axes in figure.axes)
    assert first.max() == 1
    # A density twice as wide is half as high, up to the noise of 100 bins of 20,000 samples.
    np.testing.assert_allclose(second[45:55].mean() / first[45:55].mean(), 0.5**0.5, rtol=0.05)


def test_a_world_model_is_drawn_over_what_its_sensor_sees():
    process = MirrorSensor(cells=401)
    module = KnownBelief(process, GaussianBelief)
    data = data_of(process)
    state = torch.tensor([[-2.0]], dtype=torch.float64)
    assert KnownSamples("RSSM", data, module).values(state).item() == -2
    assert WorldSamples("RSSM", data, process, None).values(state).item() == 2  # the sensor does not see the sign
    hike = MountainHike("multi", observation_std=1.5)
    position = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    torch.testing.assert_close(WorldSamples("RSSM", data, hike, None).values(position), 10 * position)


def test_one_dimension_is_drawn_against_time(runs):
    figure = draw_beliefs([runs["known"]])["beliefs"]

    assert [axes.get_title() for axes in figure.axes] == ["exact belief", "RSSM"]
    assert figure.axes[0].images[0].get_array().shape[1] == 6
    data = data_of(MirrorSensor())
    batch = data.sequences("test", torch.tensor([least_gaussian(data, MirrorSensor())]))
    np.testing.assert_allclose(figure.axes[0].lines[1].get_ydata(), batch.state[0, :, 0])


def test_two_dimensions_are_drawn_at_some_steps(runs):
    figure = draw_beliefs([runs["world"]], index=[3])["beliefs"]

    rows = [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()]
    columns = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert rows == ["exact belief", "RSSM"]
    assert columns == ["t = 1", "t = 2", "t = 4", "t = 6"]
    state = data_of(MountainHike("multi", 1.5)).sequences("test", torch.tensor([3])).state[0]
    np.testing.assert_allclose(np.ravel(figure.axes[0].lines[0].get_xydata()), 10 * state[0], rtol=1e-5)


def test_samples_of_a_world_model_are_those_of_its_filter(runs):
    """They depend on the observations up to each step only, so a longer sequence has the same."""
    (learned,) = world_models([runs["world"]])
    batch = learned.data.sequences("test", torch.tensor([0]))
    both, last = learned.sample(batch, [2, 4], 5), learned.sample(batch, [4], 5)
    torch.testing.assert_close(both[:, 1:], last)
    torch.testing.assert_close(learned.sample(batch.first(2), [2], 5), both[:, :1])


def test_the_exact_belief_of_the_figure_is_that_of_the_process():
    process = MirrorSensor(cells=401)
    batch = data_of(process).sequences("test", torch.arange(2))
    torch.testing.assert_close(exact_belief(process, batch).mean, torch.zeros(2, 6, 1, dtype=torch.float64))


def test_beliefs_that_cannot_be_compared_are_one_sentence(runs, tiny_run, capsys, tmp_path):
    for names, sentence in [
        ([runs["known"], runs["world"]], "expected one kind, since only the second is over the true state"),
        ([runs["noise"]], "its likelihood is normal(1), expected the noise of the sensor, 15 at every state"),
        ([runs["vector"]], "a Vector model has no belief over a state"),
        ([str(tiny_run)], "whose exact beliefs are unknown, expected Simulated"),
        ([runs["known"], "--index", "30"], "--index 30: expected one test sequence, 0 to 29"),
        ([runs["known"], "--index", "1", "2"], "--index 1 2: expected one test sequence"),
    ]:
        assert sentence in error_of(capsys, "figures", "beliefs", "-o", tmp_path / "figures", "--runs", *names)
    assert not (tmp_path / "figures").exists()
