"""What several tests need: one thread, and a few digits that nobody has to read from the disk."""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import small_agents
import torch
from small_strokes import write_config, write_strokes

from forbes.commands.cli import main
from forbes.data.strokes.file import StrokeArrays
from forbes.runs import configuration, modules, worlds
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.saving import AtomicCheckpointIO

SLOW = ("commands", "callbacks", "runs", "faults", "test_contributing.py", "test_full_disk.py", "test_damaged_files.py")
"""Folders and files of tests that go through the command line: `pytest -m "not slow"` leaves them out."""

torch.set_num_threads(1)  # a second thread gains nothing on matrices of this size


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the slow tests."""
    for item in items:
        if item.path.relative_to(Path(__file__).parent).parts[0] in SLOW:
            item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[object]) -> Iterator[None]:
    """Let what several tests share begin like a process: a record names the modules that were allowed in it alone."""
    if fixturedef.scope == "function":
        return (yield)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(configuration, "_allowed", {})
        return (yield)


@pytest.fixture(autouse=True)
def no_module_is_allowed_by_another_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each test begin so."""
    monkeypatch.setattr(configuration, "_allowed", {})


@pytest.fixture(scope="session")
def strokes_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stroke file of 40 training and 12 test digits of 5 to 9 random points."""
    return write_strokes(tmp_path_factory.mktemp("strokes") / "strokes.npz")


@pytest.fixture(scope="session")
def tiny_config(strokes_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration that trains FORBES for two epochs of five updates in a second."""
    path = tmp_path_factory.mktemp("project") / "configs" / "tiny" / "forbes.yaml"
    path.parent.mkdir(parents=True)
    return write_config(path, strokes_file)


@pytest.fixture(scope="session")
def tiny_run(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder that the tiny configuration leaves; not to be changed."""
    run = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 0
    return run


VARIANTS = {
    "rssm": ("--model.belief", "GaussianBelief"),
    "vector": ("--model.model", "VectorModel", "--model.state_dim", "0"),
    "particle": ("--model.belief", "GaussianBelief", "--model.model", "ParticleModel", "--model.model.particles", "2"),
    "forbes1": ("--seed_everything", "1"),
}


def fit_variant(name: str, config: Path, folder: Path) -> Path:
    assert main(["fit", "--config", str(config), "--run_dir", str(folder / name), *VARIANTS[name]]) == 0
    return folder / name


@pytest.fixture(scope="session")
def tiny_rssm(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of an RSSM on the same digits; not to be changed."""
    return fit_variant("rssm", tiny_config, tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def tiny_vector(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a model without a state on the same digits; not to be changed."""
    return fit_variant("vector", tiny_config, tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def tiny_particle(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a particle filter on the same digits; not to be changed."""
    return fit_variant("particle", tiny_config, tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def tiny_forbes1(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second seed of the tiny run; not to be changed."""
    return fit_variant("forbes1", tiny_config, tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def small_agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of an agent that sees vectors, of one epoch; not to be changed."""
    folder = tmp_path_factory.mktemp("agent")
    config = small_agents.write_config(folder)
    assert small_agents.fit("--config", config, "--trainer.max_epochs", 1, "--run_dir", folder / "forbes-0") == 0
    return folder / "forbes-0"


@pytest.fixture(scope="session")
def small_image_agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of an agent that sees images, of one epoch; not to be changed."""
    folder = tmp_path_factory.mktemp("agent")
    config = small_agents.write_image_config(folder)
    assert small_agents.fit("--config", config, "--trainer.max_epochs", 1, "--run_dir", folder / "forbes-0") == 0
    return folder / "forbes-0"


@pytest.fixture
def overwritten(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Let a training go on while its run is measured; gives the hash of each checkpoint that was read, by its path."""
    read: dict[str, str] = {}

    def check_weights(model: object, state: object, name: str) -> None:
        read[name] = hashlib.sha256(Path(name).read_bytes()).hexdigest()
        content = read_checkpoint(Path(name))
        AtomicCheckpointIO().save_checkpoint(content | {"global_step": content["global_step"] + 1}, name)

    for loading in (modules, worlds):
        monkeypatch.setattr(loading, "check_weights", check_weights)
    return read


@pytest.fixture
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in an empty folder, so that runs/ is made there."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def make_arrays() -> Callable[..., StrokeArrays]:
    """Make `StrokeArrays` of digits, each a list of strokes, each a list of pixels."""

    def make(*digits: list[list[tuple[int, int]]]) -> StrokeArrays:
        strokes = [stroke for digit in digits for stroke in digit]
        points = np.array([pixel for stroke in strokes for pixel in stroke], np.uint8)
        pen_up = np.zeros(len(points), bool)
        pen_up[np.cumsum([len(stroke) for stroke in strokes]) - 1] = True
        offsets = np.cumsum([0, *(sum(map(len, digit)) for digit in digits)]).astype(np.int32)
        return StrokeArrays(points, pen_up, offsets, np.arange(len(digits), dtype=np.uint8) % 10)

    return make


@pytest.fixture(scope="session")
def mnist_digits() -> tuple[np.ndarray, np.ndarray]:
    """The first ten MNIST test images, uint8 (10, 28, 28), and their labels, uint8 (10,)."""
    with np.load(Path(__file__).parent / "data" / "mnist_test_0_to_9.npz") as file:
        return file["images"], file["labels"]
