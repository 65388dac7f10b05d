"""Configurations say what they are: those that claim the parameter count of another have it."""

import re
from pathlib import Path

import pytest
import yaml

from forbes.training.configuration import allow_modules, experiment_parser

CONFIGS = Path(__file__).parents[1] / "configs"
CLAIM = re.compile(r"\(([\d,]+)(?: parameters)? against ([\d,]+)\)")
MATCHED = [path for path in sorted(CONFIGS.rglob("*.yaml")) if CLAIM.search(path.read_text())]


def parameters(config):
    allow_modules()
    sections = yaml.safe_load(config.read_text())
    parser = experiment_parser()
    model = parser.instantiate(parser.parse_object({name: sections[name] for name in ("model", "data")})).model
    return sum(parameter.numel() for parameter in model.model.parameters())


@pytest.mark.parametrize("config", MATCHED, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_a_matched_configuration_has_the_parameters_it_claims(config):
    own, other = (int(number.replace(",", "")) for number in CLAIM.search(config.read_text()).groups())

    assert parameters(config) == own
    forbes = next(folder / "forbes.yaml" for folder in config.parents if (folder / "forbes.yaml").exists())
    assert parameters(forbes) == other
    assert abs(own / other - 1) < 0.05


def test_the_controlled_comparison_differs_in_the_belief_alone():
    dreamer, forbes = (
        yaml.safe_load((CONFIGS / "dmc" / f"{name}.yaml").read_text()) for name in ("dreamer", "forbes_n1")
    )

    beliefs = [config["model"]["init_args"].pop("belief")["class_path"] for config in (dreamer, forbes)]
    assert beliefs == ["GaussianBelief", "FlowBelief"]
    assert dreamer == forbes
