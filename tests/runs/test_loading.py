"""A loaded run is the trained one, or one sentence says why not."""

import re
import shutil

import pytest
import torch
import yaml

from forbes.commands.cli import main
from forbes.errors import ForbesError
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder
from forbes.runs.saving import AtomicCheckpointIO
from forbes.training.loading import load_run


@pytest.fixture
def run(tiny_run, tmp_path):
    """A copy to break."""
    shutil.copytree(tiny_run, tmp_path / "run")
    return RunFolder(tmp_path / "run")


def configure(run, change):
    config = yaml.safe_load(run.config.read_text())
    change(config)
    run.config.write_text(yaml.safe_dump(config))


def test_a_loaded_model_has_the_trained_weights_and_outputs(tiny_run):
    model, data = load_run(tiny_run)
    again, _ = load_run(str(tiny_run))

    saved = read_checkpoint(RunFolder(tiny_run).checkpoint)["state_dict"]
    torch.testing.assert_close(dict(model.state_dict()), dict(saved), rtol=0, atol=0)
    assert not model.training
    assert data.batch_size == 4
    batch = data.sequences("test", torch.arange(5))
    outputs = []
    for one in (model, again):
        torch.manual_seed(0)
        outputs.append(one.terms(batch).elbo)
    torch.testing.assert_close(*outputs, rtol=0, atol=0)


def test_a_run_without_a_checkpoint_is_one_sentence(run):
    run.checkpoint.unlink()

    with pytest.raises(ForbesError, match=r"run: has no checkpoint yet\. Train it: forbes fit .*config\.yaml"):
        load_run(run.path)


def test_a_checkpoint_of_another_family_is_one_sentence(run):
    configure(run, lambda config: config["model"]["init_args"].update(belief={"class_path": "GaussianBelief"}))

    with pytest.raises(ForbesError, match=r"last\.ckpt: it has no model\.prior\.\S+, which .*: another belief family"):
        load_run(run.path)


def test_a_checkpoint_that_lacks_a_tensor_is_one_sentence(run):
    checkpoint = read_checkpoint(run.checkpoint)
    name = next(iter(checkpoint["state_dict"]))
    del checkpoint["state_dict"][name]
    AtomicCheckpointIO().save_checkpoint(checkpoint, run.checkpoint)

    with pytest.raises(ForbesError, match=rf"last\.ckpt: it has no {re.escape(name)}, which the configured model has"):
        load_run(run.path)


@pytest.mark.parametrize("content", [{}, {"state_dict": 3}, {"state_dict": {}}, [1], {"state_dict": {"a": "b"}}])
def test_a_checkpoint_that_is_no_trainings_is_one_sentence(run, content):
    torch.save(content, run.checkpoint)

    with pytest.raises(ForbesError, match=r"last\.ckpt: (has no state_dict of tensors|has no global_step)"):
        load_run(run.path)


def test_a_checkpoint_of_another_size_is_refused_with_shapes(run):
    configure(run, lambda config: config["model"]["init_args"].update(hidden_dim=5))

    with pytest.raises(
        ForbesError, match=r"last\.ckpt: its model\.\S+ is \([\d, ]+\), that of the configured model \("
    ):
        load_run(run.path)


def test_a_configuration_of_another_version_is_one_sentence(run):
    configure(run, lambda config: config["model"]["init_args"].update(learnin_rate=1))

    with pytest.raises(ForbesError, match=r"config\.yaml: model\.learnin_rate: .*did you mean learning_rate\?"):
        load_run(run.path)


def test_a_run_finds_its_data_from_any_folder(tiny_config, strokes_file, in_tmp_path, monkeypatch):
    shutil.copy(strokes_file, "mine.npz")
    fit = ["fit", "--config", str(tiny_config), "--data.source.path", "mine.npz", "--run_dir", "run"]
    assert main([*fit, "--trainer.max_epochs", "1"]) == 0
    (in_tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(in_tmp_path / "elsewhere")

    _, data = load_run("../run")

    assert data.source.path == str(in_tmp_path / "mine.npz")
    assert main(["fit", "--resume", "../run", "--trainer.max_epochs", "2"]) == 0


def test_a_moved_run_is_loaded(run, tmp_path):
    run.path.rename(tmp_path / "moved")

    load_run(tmp_path / "moved")


def test_data_that_are_not_there_are_one_sentence(run):
    configure(run, lambda config: config["data"]["init_args"]["source"]["init_args"].update(path="gone.npz"))

    with pytest.raises(
        ForbesError, match=r"config\.yaml: data\.source\.path is gone\.npz, which does not exist\. Set it to the path"
    ):
        load_run(run.path)


def test_another_checkpoint_of_a_run_is_loaded_by_its_path(run):
    checkpoint = read_checkpoint(run.checkpoint)
    name = next(iter(checkpoint["state_dict"]))
    checkpoint["state_dict"][name] += 1
    best = run.checkpoint.with_name("best.ckpt")
    AtomicCheckpointIO().save_checkpoint(checkpoint, best)

    last_model, _ = load_run(run.path)
    best_model, _ = load_run(best)

    torch.testing.assert_close(best_model.state_dict()[name], last_model.state_dict()[name] + 1, rtol=0, atol=0)
    with pytest.raises(ForbesError, match=r"worst\.ckpt: no such checkpoint\. There are best\.ckpt, last\.ckpt"):
        load_run(best.with_name("worst.ckpt"))


def test_resuming_from_a_checkpoint_file_is_refused(run, capsys):
    assert main(["fit", "--resume", str(run.checkpoint)]) == 2

    assert "last.ckpt: is a checkpoint, expected a run folder" in capsys.readouterr().err


def test_a_run_does_not_go_on_with_another_family(run, capsys):
    before = run.config.read_text()

    status = main(["fit", "--resume", str(run), "--model.belief", "GaussianBelief"])

    assert status == 2
    assert "last.ckpt: it has no model.prior." in capsys.readouterr().err
    assert run.config.read_text() == before


def test_a_run_from_before_written_frames_has_whole_ones(tiny_run, tmp_path):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["data"]["init_args"]["source"]["init_args"].pop("frames") == "written"
    (run / "config.yaml").write_text(yaml.safe_dump(config))

    assert load_run(run)[1].source.frames == "whole"

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3"]) == 0
    resumed = yaml.safe_load((run / "config.yaml").read_text())
    assert resumed["data"]["init_args"]["source"]["init_args"]["frames"] == "whole"
    assert load_run(run)[1].source.frames == "whole"
