"""The name of a source or a process says with which numbers it was made, and nothing that changes from run to run."""

import copy
import inspect
import pickle

import pytest

from forbes import data, pomdps
from forbes.data import SequenceDataModule, SequenceSource, Simulated, Strokes
from forbes.evaluation.runs import data_name
from forbes.pomdps import LinearGaussian, MountainHike, Process, Tiger

KINDS = [
    kind
    for part in (data, pomdps)
    for kind in (getattr(part, name) for name in part.__all__)
    if inspect.isclass(kind) and issubclass(kind, Process | SequenceSource) and not inspect.isabstract(kind)
]
ARGUMENTS = {"Simulated": {"process": Tiger()}, "Experience": {"task": "mountain_hike"}}


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind is not data.Replay])
def test_every_source_and_process_is_named_with_all_its_numbers(kind):
    made = kind(**ARGUMENTS.get(kind.__name__, {}))

    assert str(made).startswith(f"{kind.__name__}(")
    assert "0x" not in str(made)
    for name, parameter in inspect.signature(kind).parameters.items():
        assert parameter.default is None or f"{name}=" in str(made)
    assert str(kind(**ARGUMENTS.get(kind.__name__, {}))) == str(made)


def test_all_are_tried():
    assert {"Strokes", "Simulated", "Experience", "Replay", "MountainHike", "TMaze"} <= {
        kind.__name__ for kind in KINDS
    }


def test_a_name_is_a_call():
    assert repr(Tiger(0.9)) == "Tiger(accuracy=0.9)"
    assert repr(MountainHike("multi", observation_std=1.5)) == "MountainHike(start=multi, observation_std=1.5)"
    assert repr(Strokes(frames="whole")).endswith("points_per_step=1, validation=5000, frames=whole, end=masked)")


def test_data_of_a_process_are_named_with_its_numbers():
    source = Simulated(LinearGaussian(0.9, initial_variance=2.0), train=20, validation=5, test=12)

    assert data_name(SequenceDataModule(source, batch_size=4, length=3)) == (
        "Simulated(process=LinearGaussian(transition=0.9, transition_variance=1.0, observation_variance=1.0, "
        "initial_variance=2.0), train=20, validation=5, test=12, seed=0), 3 steps"
    )


class Noisy(Tiger):
    """A subclass that sets an argument of its base by itself."""

    def __init__(self, noise=0.1):
        super().__init__(accuracy=1 - noise)


class Renamed(Tiger):
    """A subclass without a constructor of its own."""


def test_a_class_of_ones_own_is_named_by_what_it_was_made_with():
    assert repr(Noisy(0.2)) == "Noisy(noise=0.2)"
    assert repr(Renamed(0.7)) == "Renamed(accuracy=0.7)"


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda made: pickle.loads(pickle.dumps(made))])
def test_a_copy_has_the_same_name(copied):
    assert repr(copied(MountainHike("multi"))) == "MountainHike(start=multi, observation_std=0.1)"
