"""One colour and one spelling for each method, which every reader can tell apart."""

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from forbes.beliefs import GaussianBelief
from forbes.figures.prediction_grid import colour_of
from forbes.figures.style import METHODS, method_styles, method_title
from forbes.training.loading import load_run

AGENTS = ("Dreamer", "DreamerV3")  # on RSSMs of Gaussian and of categorical states, and never next to their like
TOGETHER = [name for name in METHODS if name not in AGENTS]

# Machado et al. (2009), severity 1, for linear RGB.
SEEN_BY = {
    "all cones": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
}


def lab(colour, seen_by="all cones"):
    """CIE L*a*b* of a colour (white point D65)."""
    encoded = np.array(to_rgb(colour))
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = to_xyz @ np.clip(SEEN_BY[seen_by] @ linear, 0, 1) / [0.9505, 1, 1.089]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("seen_by", SEEN_BY)
def test_colours_differ_for_colour_blind_readers(seen_by):
    """A difference of 2.3 is just noticeable; ten of them between areas, or also another line and marker."""
    for one, other in itertools.combinations(TOGETHER, 2):
        styles = METHODS[one], METHODS[other]
        difference = np.linalg.norm(lab(styles[0].colour, seen_by) - lab(styles[1].colour, seen_by))
        assert difference > 10
        assert difference > 23 or (styles[0].line, styles[0].marker) != (styles[1].line, styles[1].marker)


def test_fitted_methods_differ_in_grey_print():
    """In brightness by 10 of 100, or in the line and the marker."""
    for one, other in itertools.combinations(TOGETHER, 2):
        first, second = METHODS[one], METHODS[other]
        difference = abs(lab(first.colour)[0] - lab(second.colour)[0])
        assert difference > 10 or (first.line != second.line and first.marker != second.marker)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_every_colour_is_legible_on_white(method):
    """Contrast 2:1 at least, and 3:1 for the two that most figures compare (WCAG 2.2 for graphics)."""
    brightness = ((lab(method.colour)[0] + 16) / 116) ** 3
    assert 1.05 / (brightness + 0.05) > (3 if method in (METHODS["FORBES"], METHODS["RSSM"]) else 2)


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("forbes", "FORBES"),
        ("rssm_wide", "RSSM wide"),
        ("agent_dreamer", "Dreamer"),
        ("dreamerv3", "DreamerV3"),
        ("dreamer_n4", "Dreamer n4"),
        ("FORBES (deep/forbes-0)", "FORBES (deep/forbes-0)"),
        ("exact", "exact belief"),
        ("exact belief", "exact belief"),
        ("rssmx", "rssmx"),
        ("known_mixture", "known_mixture"),
        ("Mixture of experts", "Mixture of experts"),
    ],
)
def test_a_method_has_one_spelling(name, title):
    assert method_title(name) == title
    assert method_title(title) == title


def test_a_method_has_its_style_next_to_any_others():
    styles = method_styles(["mine", "forbes", "RSSM (a)", "RSSM (b)", "yours"])

    assert styles["forbes"] == METHODS["FORBES"]
    assert styles["RSSM (a)"] == METHODS["RSSM"]
    assert len({*styles.values()}) == 5


def test_more_methods_than_styles_repeat_the_unused_ones():
    names = [f"mine {number}" for number in range(20)]
    styles = method_styles(["FORBES", *names])

    assert METHODS["FORBES"] not in [styles[name] for name in names]


def test_a_model_has_the_colour_of_its_family_while_it_trains(tiny_run):
    module, _ = load_run(tiny_run)
    assert colour_of(module.model) == METHODS["FORBES"].colour
    module.model.posterior = module.model.prior = GaussianBelief(2, 4)
    assert colour_of(module.model) == METHODS["RSSM"].colour
