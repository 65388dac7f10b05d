"""The help of every command says what its code does."""

import argparse
import importlib
import inspect

import pytest

from forbes.commands.cli import COMMANDS
from forbes.commands.parsers.fit import DESCRIPTION
from forbes.envs import DeepMindControl, Gymnasium
from forbes.envs.images import RENDERED_SIZE


def options_of(parser, name):
    """Give the options of a command and of those under it, each with the name of its command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for part, command in action.choices.items():
                yield from options_of(command, f"{name} {part}")
        else:
            yield pytest.param(action, id=f"{name} {(action.option_strings or [action.dest])[-1]}")


OPTIONS = [
    option
    for name in COMMANDS.keys() - DESCRIPTION.keys()
    for option in options_of(importlib.import_module(f"forbes.commands.parsers.{name}").parser(), name)
]


def written(default):
    """A default as one would type it."""
    return " ".join(map(str, default)) if isinstance(default, list | tuple) else str(default)


WITH_DEFAULT = [option for option in OPTIONS if option.values[0].default not in (None, argparse.SUPPRESS, False)]


@pytest.mark.parametrize("action", sorted(WITH_DEFAULT, key=lambda option: option.id))
def test_the_help_of_an_option_states_its_default(action):
    expected = "all" if action.default == action.choices else written(action.default)

    assert f"default: {expected}" in action.help


@pytest.mark.parametrize(
    ("option", "flag", "stated"),
    [
        ("action_repeat", "--action-repeat", "default: {suite} in DeepMind Control, {gymnasium} in Gymnasium"),
        ("size", "--size", f"default: {RENDERED_SIZE} if they are rendered"),
        ("pixels", "--no-pixels", "default: images in DeepMind Control only"),
    ],
)
def test_collect_help_states_the_environments_defaults(option, flag, stated):
    (action,) = [each.values[0] for each in OPTIONS if each.id == f"data collect {flag}"]
    suite, gymnasium = (inspect.signature(kind).parameters[option].default for kind in (DeepMindControl, Gymnasium))

    assert stated.format(suite=suite, gymnasium=gymnasium) in action.help
    assert option != "pixels" or (suite and not gymnasium)
