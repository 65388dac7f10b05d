"""Callbacks draw what they say, and a training never notices them."""

import math
import shutil
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image
from small_agents import fit, write_image_config

from forbes.callbacks import BeliefPlot, ElboCurve, PredictionGrid
from forbes.callbacks.belief_plot import _kernel_density, _principal_plane
from forbes.callbacks.parameter_count import count_parameters
from forbes.commands.cli import main
from forbes.figures.style import BLACK, BLUE, GREY
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.training.loading import load_run

PICTURES = ("predictions.png", "elbo.png", "beliefs.png")


@pytest.fixture(scope="module")
def callbacks(tmp_path_factory):
    """A configuration that adds all of them, small."""
    path = tmp_path_factory.mktemp("callbacks") / "callbacks.yaml"
    path.write_text("""\
trainer:
  callbacks:
  - {class_path: PredictionGrid, init_args: {digits: 3, samples: 2, context: 3, every: 1}}
  - {class_path: ElboCurve, init_args: {sequences: 6, every: 2}}
  - {class_path: BeliefPlot, init_args: {digits: 1, columns: 2, samples: 50, every: 1}}
  - {class_path: ParameterCount}
""")
    return path


@pytest.fixture(scope="module")
def watched(tiny_config, callbacks, tmp_path_factory):
    """The tiny run, with callbacks."""
    run = tmp_path_factory.mktemp("watched") / "run"
    assert main(["fit", "--config", str(tiny_config), "--config", str(callbacks), "--run_dir", str(run)]) == 0
    return run


def is_picture(path):
    """Not blank: it holds light, dark and something between."""
    pixels = np.asarray(Image.open(path).convert("L"))
    return pixels.min() < 100 and pixels.max() > 250 and len(np.unique(pixels)) > 10


def draw(callback, run):
    """Draw a finished run."""
    module, data = load_run(run)
    torch.manual_seed(0)
    callback.folder = run
    with torch.no_grad():
        return callback.draw(SimpleNamespace(), module, data)


def test_a_training_with_callbacks_is_bitwise_the_one_without(watched, tiny_run):
    metrics = read_metrics(watched).drop(columns="parameters").dropna(how="all")
    pd.testing.assert_frame_equal(metrics, read_metrics(tiny_run), check_exact=True, check_dtype=False)
    state, expected = (read_checkpoint(RunFolder(run).checkpoint)["state_dict"] for run in (watched, tiny_run))
    torch.testing.assert_close(state, expected, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("arguments", "objective", "density"),
    [
        (["--model.belief", "GaussianBelief", "--model.state_dim", "3"], "elbo[bernoulli,S=1]", "KDE"),
        (["--model.likelihood", "Normal"], "elbo[normal(1),S=1]", "exact density"),
        (
            ["--model.model", "ParticleModel", "--model.model.init_args.particles", "2"],
            "fivo[bernoulli,K=2]",
            "exact density",
        ),
    ],
    ids=["gaussian, 3-d", "normal likelihood", "particles"],
)
def test_every_family_and_likelihood_is_drawn(arguments, objective, density, tiny_config, tmp_path):
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path), *arguments]) == 0

    grid, curves, beliefs = (draw(each, tmp_path) for each in (PredictionGrid(3, 2, 3), ElboCurve(6), BeliefPlot(1, 2)))

    assert [axes.get_title() for axes in grid.axes][:2] == ["truth", "seen"]
    assert all(axes.images[0].get_array().std() > 0 for axes in grid.axes)
    assert [axes.get_title() for axes in curves.axes][:3] == [objective, "reconstruction", "KL"]
    metrics = read_metrics(tmp_path)
    for axes, name in zip(curves.axes, [objective, "reconstruction", "kl"], strict=False):
        for line, split in zip(axes.lines, ["train", "val"], strict=False):
            assert line.get_ydata() == pytest.approx(metrics[f"{split}/{name}"].dropna())
    assert [axes.get_ylabel() for axes in beliefs.axes[2::2]] == [f"prior, {density}", f"posterior, {density}"]


def test_a_training_without_a_metric_is_drawn_too(tiny_config, tmp_path):
    without = ["--trainer.limit_val_batches", "0", "--trainer.log_every_n_steps", "1000"]
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path), *without]) == 0
    assert not [name for name in read_metrics(tmp_path) if name.startswith(("train/", "val/"))]

    bound, reconstruction, kl, steps = draw(ElboCurve(6), tmp_path).axes

    assert {line.get_label() for line in bound.lines}.isdisjoint({"train", "validation"})
    assert not [*reconstruction.lines, *kl.lines]
    assert len(steps.lines[0].get_ydata()) == 6


def test_a_model_without_a_state_has_all_but_the_belief_plot(tiny_config, callbacks, tmp_path, capsys):
    flags = ["--config", str(tiny_config), "--model.model", "VectorModel", "--model.state_dim", "0"]
    assert main(["fit", *flags, "--config", str(callbacks), "--run_dir", str(tmp_path / "refused")]) == 2
    assert "BeliefPlot: VectorModel has no state to plot. Remove this callback" in capsys.readouterr().err
    assert not RunFolder(tmp_path / "refused").checkpoint.exists()
    run = tmp_path / "run"
    assert main(["fit", *flags, "--run_dir", str(run)]) == 0

    curves, grid = draw(ElboCurve(6), run), draw(PredictionGrid(3, 2, 3), run)

    assert [axes.get_title() for axes in curves.axes] == ["log_p[bernoulli]", "rollout loss"]
    metrics = read_metrics(run)
    for axes, name in zip(curves.axes, ["log_p[bernoulli]", "overshoot"], strict=True):
        assert axes.lines[1].get_ydata() == pytest.approx(metrics[f"val/{name}"].dropna())
    titles = [axes.get_title().replace("\n", " ") for axes in grid.axes]  # broken where panels are narrow
    assert titles[2:] == ["sampled completions, t = 6", "sampled completions, t = 9"]
    parts = count_parameters(load_run(run)[0].model)
    assert set(parts) == {"encoder", "decoder", "recurrence", "total"}


def test_pictures_are_complete_files_with_nothing_beside_them(watched):
    assert sorted(path.name for path in (watched / "figures").iterdir()) == sorted(PICTURES)
    assert all(is_picture(watched / "figures" / name) for name in PICTURES)


@pytest.mark.parametrize("callback", [PredictionGrid(3, 2, 3), ElboCurve(6), BeliefPlot(1, 2, 50)])
def test_drawing_leaves_random_state_and_module_as_they_were(callback, tiny_run, tmp_path):
    module, data = load_run(tiny_run)
    module.train()
    shutil.copy(tiny_run / "metrics.jsonl", tmp_path)
    before = torch.get_rng_state()

    callback.on_fit_end(
        SimpleNamespace(
            log_dir=str(tmp_path),
            fast_dev_run=False,
            is_global_zero=True,
            global_step=10,
            datamodule=data,
            loggers=[],
        ),
        module,
    )

    assert torch.equal(torch.get_rng_state(), before)
    assert module.training
    assert is_picture(tmp_path / "figures" / callback.filename)


def test_draws_after_every_kth_epoch_and_at_the_end(tiny_config, callbacks, tmp_path, monkeypatch):
    drawn = []
    for callback in (PredictionGrid, ElboCurve, BeliefPlot):

        def note(self, trainer, module, data):
            drawn.append((type(self), trainer.current_epoch))
            return Figure((1, 1))

        monkeypatch.setattr(callback, "draw", note)
    configs = ["--config", str(tiny_config), "--config", str(callbacks)]
    main(["fit", *configs, "--run_dir", str(tmp_path), "--trainer.max_epochs", "3"])
    assert [epoch for callback, epoch in drawn if callback is PredictionGrid] == [1, 2, 3]  # epochs done
    assert [epoch for callback, epoch in drawn if callback is ElboCurve] == [2, 3]  # every 2, and the end


def test_the_curve_of_a_resumed_run_starts_at_the_first_life(watched, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(watched, run)
    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "4"]) == 0

    figure = draw(ElboCurve(sequences=6), run)

    for axes, name in zip(figure.axes, ["elbo[bernoulli,S=1]", "reconstruction", "kl"], strict=False):
        train, validation = axes.lines
        assert list(train.get_xdata()) == list(range(1, 21))
        assert list(validation.get_xdata()) == [5, 10, 15, 20]
        assert validation.get_ydata() == pytest.approx(read_metrics(run)[f"val/{name}"].dropna())


def test_the_kl_of_each_step_leaves_padding_out_and_adds_up(tiny_run):
    module, data = load_run(tiny_run)
    terms = {}

    def remember(batch, real=module.terms):
        terms[len(terms)] = real(batch)
        return terms[len(terms) - 1]

    module.terms = remember
    mean, error = ElboCurve(sequences=8)._kl_per_step(module, data)

    kl, mask = (torch.cat([getattr(term, name) for term in terms.values()]) for name in ("kl", "mask"))
    assert not mask.all()
    torch.testing.assert_close((mean * mask.sum(0)).sum(), (kl * mask).sum())
    t = 5
    torch.testing.assert_close(error[t], kl[mask[:, t], t].std() / math.sqrt(mask[:, t].sum()))


def test_a_prediction_grid_shows_truth_seen_frames_and_samples(tiny_run):
    figure = draw(PredictionGrid(digits=4, samples=2, context=3), tiny_run)
    titles = [axes.get_title().replace("\n", " ") for axes in figure.axes]  # broken where panels are narrow
    assert titles == ["truth", "seen", "sampled completions, t = 6", "sampled completions, t = 9"]
    assert [label.get_text() for label in figure.axes[1].get_xticklabels()] == ["t=1", "t=2", "t=3"]
    rows = {axes.images[0].get_array().shape[0] for axes in figure.axes}
    assert rows == {4 * 30 + 2}


def test_a_context_that_leaves_nothing_to_predict_is_refused(tiny_config, tmp_path, capsys):
    config = tmp_path / "callbacks.yaml"
    config.write_text("trainer: {callbacks: [{class_path: PredictionGrid, init_args: {context: 6}}]}")
    run = str(tmp_path / "run")
    assert main(["fit", "--config", str(tiny_config), "--config", str(config), "--run_dir", run]) == 2
    assert "context is 6, expected less than the length 6" in capsys.readouterr().err
    assert not RunFolder(run).checkpoint.exists()


def test_a_state_of_one_dimension_has_no_plane(tiny_config, callbacks, tmp_path, capsys):
    flags = ["--model.belief", "GaussianBelief", "--model.state_dim", "1", "--run_dir", str(tmp_path / "run")]
    assert main(["fit", "--config", str(tiny_config), "--config", str(callbacks), *flags]) == 2
    assert "BeliefPlot: state_dim is 1, expected at least 2. Remove this callback" in capsys.readouterr().err


@pytest.mark.parametrize("callback", ["ElboCurve", "PredictionGrid", "BeliefPlot"])
def test_an_agent_has_no_validation_split_to_draw(callback, tmp_path, capsys):
    config = write_image_config(tmp_path, f"{{class_path: {callback}}}")
    assert fit("--config", config, "--run_dir", tmp_path / "run") == 2
    assert f"{callback}: the data have no validation split, from which it draws" in capsys.readouterr().err


def test_a_belief_in_the_plane_is_drawn_with_its_exact_density(tiny_run):
    figure = draw(BeliefPlot(digits=1, columns=3, samples=100), tiny_run)
    module, _ = load_run(tiny_run)
    frame, prior, posterior = (figure.axes[3 * row] for row in range(3))
    assert frame.get_title() == "t = 1"
    assert prior.get_ylabel() == "prior, exact density"
    assert posterior.get_xlabel() == "$s_1$, $s_2$"

    left, right, bottom, top = prior.images[0].get_extent()
    density = prior.images[0].get_array()
    with torch.no_grad():
        hidden = module.model.gru(module.model.transition(torch.zeros(1, 2)), torch.zeros(1, 4))  # h_1, from (0, 0)
        context = module.model.prior_context(hidden)[0]
        expected = module.model.prior.log_prob(torch.tensor([right, top]), context).exp().item()
    assert density[-1, -1] == pytest.approx(expected, rel=1e-4)
    area = (right - left) * (top - bottom)
    assert 0.9 < density.mean() * area < 1.05  # the frame holds nearly all of the belief


def test_the_legend_of_beliefs_names_each_colour_that_is_drawn(tiny_run):
    figure = draw(BeliefPlot(digits=2, columns=2, samples=60), tiny_run)

    (legend,) = figure.subfigs[0].legends
    names = {
        to_hex(handle.get_facecolor() if isinstance(handle, Patch) else handle.get_color()): text.get_text()
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True)
    }
    drawn = {to_hex(line.get_color()) for axes in figure.axes for line in axes.lines}
    assert drawn == {BLACK, BLUE}
    assert names.keys() == {GREY, BLUE, BLACK}
    figure.canvas.draw()
    box = legend.get_window_extent()
    assert not [axes for axes in figure.axes if axes.get_tightbbox().overlaps(box)]
    boxes = [axes.yaxis.label.get_window_extent() for axes in figure.axes if axes.get_ylabel()]
    assert min(each.x0 for each in (box, *boxes)) >= 0
    assert box.x1 <= figure.bbox.width
    assert not [one for one, other in pairwise(boxes) if one.overlaps(other)]


def test_a_belief_is_projected_on_the_priors_principal_plane():
    torch.manual_seed(0)
    spread = torch.tensor([0.1, 3.0, 1.0], dtype=torch.float64)
    prior = torch.randn(4000, 3, dtype=torch.float64) * spread
    posterior = prior + torch.tensor([0.0, 1.0, 0.0])

    first, second, name = _principal_plane(prior, posterior)

    # Variances 9, 1 and 0.01 along the axes: shares 90 % and 10 %.
    assert name == "PC 1 (90%), PC 2 (10%)"
    torch.testing.assert_close(first.samples.var(0), torch.tensor([9.0, 1.0]).double(), rtol=0.1, atol=0)
    shift = (second.samples - first.samples).mean(0).abs()
    torch.testing.assert_close(shift, torch.tensor([1.0, 0.0]).double(), rtol=0, atol=0.05)


def test_a_kernel_density_is_a_mean_and_integrates_to_one():
    torch.manual_seed(0)
    samples = torch.randn(64, 2, dtype=torch.float64) * torch.tensor([1.0, 0.2])
    x, y = torch.linspace(-8, 8, 400).double(), torch.linspace(-3, 3, 400).double()

    density = _kernel_density(samples)(x, y)

    widths = samples.std(0) / 2  # 64^(1/6)
    kernels = torch.distributions.Normal(samples, widths).log_prob(torch.stack((x[200], y[150]))).sum(1).exp()
    torch.testing.assert_close(density[150, 200], kernels.mean())
    assert torch.trapezoid(torch.trapezoid(density, x), y).item() == pytest.approx(1, abs=1e-6)


def test_parameter_counts_add_up_and_are_printed_and_logged(tiny_config, callbacks, tmp_path, capsys):
    configs = ["--config", str(tiny_config), "--config", str(callbacks)]
    main(["fit", *configs, "--run_dir", str(tmp_path), "--trainer.max_epochs", "1"])
    module, _ = load_run(tmp_path)

    parts = count_parameters(module.model)

    total = parts.pop("total")
    assert sum(parts.values()) == total == read_metrics(tmp_path)["parameters"].dropna().item()
    printed = capsys.readouterr().out
    for number in (total, *parts.values()):
        assert f"{number:,} parameters" in printed
