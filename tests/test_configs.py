"""Configurations say what they are: those that claim the parameter count of another, or of a reference, have it."""

import re
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

import forbes.training  # noqa: F401  # a configuration finds its classes by their short names once they are imported
from forbes.runs.configuration import allow_modules, experiment_parser

CONFIGS = Path(__file__).parents[1] / "configs"
CLAIM = re.compile(r"\(([\d,]+)(?: parameters)? against ([\d,]+)\)")
MATCHED = [path for path in sorted(CONFIGS.rglob("*.yaml")) if CLAIM.search(path.read_text())]
REFERENCES = sorted(CONFIGS.rglob("*reference*.yaml"))


def instantiate(sections, *modules):
    allow_modules(modules)
    parser = experiment_parser()
    return parser.instantiate(parser.parse_object({name: sections[name] for name in ("model", "data")}))


def count(*modules):
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def parameters(config):
    return count(instantiate(yaml.safe_load(config.read_text())).model.model)


def dense(*widths):
    """The parameters of linear layers, one after the other."""
    return sum(before * after + after for before, after in pairwise(widths))


def danijar_dreamer(actions):
    """The parameters of danijar/dreamer at its own settings, part by part, for 64 x 64 pixels in three colours."""
    return {
        "encoder": 690_144,  # 32, 64, 128 and 256 channels, kernels of 4
        "decoder": 3_795_555,  # 1024 units, then 128, 64, 32 and 3 channels, kernels of 5, 5, 6 and 6
        "recurrence": dense(30 + actions, 200) + 3 * (2 * 200 * 200 + 2 * 200),  # Keras's GRU has two biases
        "prior": dense(200, 200, 60),
        "posterior": dense(200 + 1024, 200, 60),
        "reward": dense(230, 400, 400, 1),
        "critic": dense(230, 400, 400, 400, 1),
        "actor": dense(230, 400, 400, 400, 400, 2 * actions),
    }


@pytest.mark.parametrize("config", REFERENCES, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_a_reference_has_the_parameters_of_what_it_refers_to(config):
    sections = yaml.safe_load(config.read_text())
    sections["data"]["init_args"]["source"]["init_args"]["task"] = "Screen"
    experiment = instantiate(sections, "toy_environments")
    agent, actions = experiment.model, experiment.data.action_dim
    experiment.data.source.close()
    model = agent.model

    own = {
        "encoder": count(model.encoder),
        "decoder": count(model.decoder),
        "recurrence": count(model.transition, model.gru),
        "prior": count(model.prior_context, model.prior),
        "posterior": count(model.posterior_context, model.posterior),
        "reward": count(agent.reward),
        "critic": count(agent.critic),
        "actor": count(agent.actor),
    }

    assert own == danijar_dreamer(actions)
    assert count(agent) == sum(own.values())


@pytest.mark.parametrize("config", MATCHED, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_a_matched_configuration_has_the_parameters_it_claims(config):
    own, other = (int(number.replace(",", "")) for number in CLAIM.search(config.read_text()).groups())

    assert parameters(config) == own
    forbes = next(folder / "forbes.yaml" for folder in config.parents if (folder / "forbes.yaml").exists())
    assert parameters(forbes) == other
    assert abs(own / other - 1) < 0.05


@pytest.mark.parametrize(
    ("other", "forbes", "belief", "options"),
    [
        ("dreamer", "forbes_n1", "GaussianBelief", {}),
        ("positions/dreamer", "positions/forbes", "GaussianBelief", {}),
        # 32 variables of 32 classes for 30 dimensions of a flow, and free nats that need a KL in closed form
        ("dreamerv3", "forbes_v3", "CategoricalBelief", {"state_dim": 1024, "free_nats_per": "element"}),
    ],
)
def test_a_controlled_comparison_differs_in_the_belief_alone(other, forbes, belief, options):
    configs = [yaml.safe_load((CONFIGS / "dmc" / f"{name}.yaml").read_text()) for name in (other, forbes)]

    beliefs = [config["model"]["init_args"].pop("belief")["class_path"] for config in configs]
    assert beliefs == [belief, "FlowBelief"]
    for name, value in options.items():
        assert [config["model"]["init_args"].pop(name, None) for config in configs] == [value, None]
    assert configs[0] == configs[1]
