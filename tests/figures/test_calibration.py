"""The calibration figure shows the ranks it is given, and a band that exact beliefs keep to."""

import pytest
import torch
from command_line import error_of

from forbes.errors import ForbesError
from forbes.figures.calibration import RankedBelief, calibration, draw_calibration
from forbes.figures.style import BLUE, METHODS, ORANGE, Method, save_figure

SAMPLES, COUNT = 39, 500


def belief(name, colour, width, seed=0, count=COUNT):
    """Of two dimensions, as wide as it should be times `width`."""
    generator = torch.Generator().manual_seed(seed)
    truth, samples = (torch.randn(*shape, count, 2, generator=generator) for shape in ((), (SAMPLES,)))
    samples = width * samples
    density = (samples.square().sum(-1) < truth.square().sum(-1)).sum(0)  # (N,), how many are less dense is L - this
    return RankedBelief(name, Method(colour), (samples < truth).sum(0), SAMPLES - density)


@pytest.fixture(scope="module")
def beliefs():
    return [belief("exact", BLUE, 1.0), belief("narrow", ORANGE, 0.5, seed=1)]


@pytest.fixture(scope="module")
def figure(beliefs):
    return calibration(beliefs, SAMPLES)


def lines_of(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour]


def band_of(axes):
    """Lowest and highest point of the band at each x."""
    (band,) = axes.collections
    points = {}
    for x, y in band.get_paths()[0].vertices:
        points.setdefault(round(float(x), 9), []).append(float(y))
    return {x: (min(ys), max(ys)) for x, ys in points.items()}


def test_the_histogram_is_the_density_of_the_ranks(beliefs, figure):
    steps = [patch for patch in figure.axes[0].patches if not patch.get_fill()]

    drawn = [patch.get_data().values for patch in steps]

    assert len(drawn) == 4  # two beliefs of two dimensions
    counts = beliefs[0].value_ranks[:, 0].bincount(minlength=SAMPLES + 1).view(20, 2).sum(1)  # 40 ranks in 20 bins
    assert drawn[0] == pytest.approx((20 * counts / COUNT).tolist(), rel=1e-6)


def test_second_panel_is_the_cdf_minus_the_uniform_one(beliefs, figure):
    line, _ = lines_of(figure.axes[1], ORANGE)

    for k in (0, 7, SAMPLES):
        expected = (beliefs[1].value_ranks[:, 0] <= k).double().mean() - (k + 1) / (SAMPLES + 1)
        assert line.get_ydata()[k + 1] == pytest.approx(expected.item(), abs=1e-9)
        assert line.get_xdata()[k + 1] == pytest.approx((k + 1) / (SAMPLES + 1))


def test_coverage_is_drawn_against_the_level(beliefs, figure):
    (line,) = lines_of(figure.axes[2], ORANGE)

    # At level 20 / 40: the true values of which fewer than 20 samples are denser.
    expected = (SAMPLES - beliefs[1].density_ranks < 20).double().mean()
    assert line.get_ydata()[50] == pytest.approx(expected.item())


@pytest.mark.parametrize("panel", [1, 2])
def test_exact_beliefs_stay_in_the_band_and_narrow_ones_do_not(figure, panel):
    axes = figure.axes[panel]
    band = band_of(axes)

    for colour, inside in ((BLUE, True), (ORANGE, False)):
        for line in lines_of(axes, colour):
            points = zip(line.get_xdata(), line.get_ydata(), strict=True)
            kept = [low - 1e-9 <= y <= high + 1e-9 for x, y in points for low, high in [band[round(float(x), 9)]]]
            assert (sum(kept) > 0.9 * len(kept)) == inside
    # The second panel's band holds a calibrated belief as a whole, the third's at 95 of 100 levels.


def test_it_says_what_is_drawn(figure, tmp_path):
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes]
    (legend,) = figure.legends

    assert labels == [
        ("rank of the true value / L", "density of ranks"),
        ("rank of the true value / L", "ECDF − uniform"),
        ("nominal level of the region", "true values inside"),
    ]
    assert [text.get_text() for text in legend.get_texts()] == ["exact", "narrow", "calibrated, 95 %"]
    save_figure(figure, tmp_path / "calibration.pdf")
    assert (tmp_path / "calibration.pdf").read_bytes().startswith(b"%PDF")


def test_beliefs_about_other_states_are_not_compared():
    beliefs = [belief("exact", BLUE, 1.0), belief("short", ORANGE, 1.0, count=100)]

    with pytest.raises(ForbesError, match=r"^short: 100 and 100 ranks, expected 500 as for exact\. Rank the same"):
        calibration(beliefs, SAMPLES)


def test_runs_of_a_family_share_a_style_and_one_entry(tiny_run, tiny_forbes1):
    figure = draw_calibration([str(tiny_run), str(tiny_forbes1)])["calibration"]

    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["FORBES, 2 runs", "calibrated, 95 %"]
    assert len(lines_of(figure.axes[2], METHODS["FORBES"].colour)) == 2


def test_a_model_without_a_state_is_not_calibrated(tiny_vector, tmp_path, capsys):
    sentence = error_of(capsys, "figures", "calibration", "--runs", tiny_vector, "-o", tmp_path / "figures")

    assert sentence == f"{tiny_vector}: a Vector model has no state that could be ranked. Name other runs"
