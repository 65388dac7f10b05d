"""A training that was interrupted and resumed gives the same numbers, bit for bit on the CPU."""

import os
import shutil
import signal

import pytest
from continued_runs import assert_same_run

from forbes.commands.cli import main
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.runs.provenance import read_provenance
from forbes.runs.saving import ResumeWholeEpochs
from forbes.training import WorldModel

FOUR_EPOCHS = ["--trainer.max_epochs", "4"]  # of five updates


@pytest.fixture(scope="module")
def straight(tiny_config, tmp_path_factory):
    run = tmp_path_factory.mktemp("runs") / "straight"
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run), *FOUR_EPOCHS]) == 0
    return run


def test_two_epochs_and_two_more_are_four_epochs(straight, tiny_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)

    assert main(["fit", "--resume", str(run), *FOUR_EPOCHS]) == 0

    assert_same_run(run, straight)


def test_a_run_resumes_from_the_last_undamaged_checkpoint(straight, tiny_run, tmp_path, capsys):
    run = RunFolder(shutil.copytree(tiny_run, tmp_path / "run"))
    run.checkpoint.write_bytes(run.checkpoint.read_bytes()[:-100])

    assert main(["fit", "--resume", str(run), *FOUR_EPOCHS]) == 0

    assert f"reading {run.checkpoint.with_name('previous.ckpt')}" in capsys.readouterr().err
    assert_same_run(run.path, straight)


@pytest.mark.parametrize(
    "limits",
    [
        [("--trainer.max_steps", "8"), ("--trainer.max_steps", "-1")],
        [("--trainer.max_steps", "8"), ("--trainer.max_steps", "20")],
        [("--trainer.max_steps", "5"), ("--trainer.max_steps", "20")],  # the end of an epoch
        [("--trainer.max_steps", "8"), ("--trainer.max_steps", "10"), ("--trainer.max_steps", "20")],
        [("--trainer.max_steps", "5"), ("--trainer.max_steps", "6"), ("--trainer.max_steps", "-1")],
    ],
    ids=lambda limits: " then ".join(value for _, value in limits),
)
def test_a_limit_that_is_raised_is_no_limit(straight, tiny_config, tmp_path, limits):
    run = str(tmp_path / "run")
    first, *rest = limits
    assert main(["fit", "--config", str(tiny_config), *FOUR_EPOCHS, "--run_dir", run, *first]) == 0
    assert read_checkpoint(RunFolder(run).checkpoint)["global_step"] == int(first[1])

    for limit in rest:
        assert main(["fit", "--resume", run, *limit]) == 0

    assert_same_run(run, straight)


def test_a_limit_within_the_last_epoch_leaves_its_rest_to_train(tiny_run, tiny_config, tmp_path):
    run = str(tmp_path / "run")

    assert main(["fit", "--config", str(tiny_config), "--run_dir", run, "--trainer.max_steps", "7"]) == 0
    assert main(["fit", "--resume", run, "--trainer.max_steps", "10"]) == 0

    assert_same_run(run, tiny_run)


def test_a_finished_run_says_so(tiny_run, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)

    assert main(["fit", "--resume", str(run)]) == 0

    assert "nothing was trained: max_epochs 2 ends at update 10. Set a higher limit" in capsys.readouterr().out
    assert_same_run(run, tiny_run)


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_updates_after_the_last_checkpoint_are_made_again(tiny_config, tmp_path, monkeypatch, schedule):
    """What SIGKILL leaves: metrics that are ahead of the checkpoint."""
    fit = ["fit", "--config", str(tiny_config), *FOUR_EPOCHS, "--model.schedule", schedule, "--run_dir"]
    straight, run = str(tmp_path / "straight"), str(tmp_path / "run")
    assert main([*fit, straight]) == 0

    class Killed(BaseException):
        pass

    def kill(self, loss):
        if self.global_step == 13:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(WorldModel, "on_before_backward", kill)
        with pytest.raises(Killed):
            main([*fit, run])
    assert read_metrics(run).index.max() == 13
    assert read_checkpoint(RunFolder(run).checkpoint)["global_step"] == 10

    assert main(["fit", "--resume", run]) == 0

    assert_same_run(run, straight)


MIDDLE, BEFORE_LAST, LAST_OF_EPOCH, LAST = 6, 8, 9, 19


@pytest.mark.parametrize(
    ("number", "update", "stops_at"),
    [
        (signal.SIGINT, MIDDLE, 8),
        (signal.SIGTERM, 0, 2),
        (signal.SIGTERM, MIDDLE, 8),
        (signal.SIGTERM, BEFORE_LAST, 10),  # not between the epoch's last update and its validation
        (signal.SIGTERM, LAST_OF_EPOCH, 10),
        (signal.SIGTERM, LAST, 20),
        (signal.SIGUSR1, MIDDLE, 8),  # SLURM: before the end of the time, or a preemption
        (signal.SIGUSR2, MIDDLE, 8),
    ],
)
def test_a_signal_stops_a_training_where_it_can_go_on(
    straight, tiny_config, tmp_path, monkeypatch, capsys, number, update, stops_at
):
    def interrupt(self, loss):
        if self.global_step == update:
            os.kill(os.getpid(), number)

    run = str(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(WorldModel, "on_before_backward", interrupt)
        status = main(["fit", "--config", str(tiny_config), "--run_dir", run, *FOUR_EPOCHS])

    assert status == 128 + number
    assert read_checkpoint(RunFolder(run).checkpoint)["global_step"] == stops_at
    assert f"stopped at update {stops_at}, resume with: forbes fit --resume {run}" in capsys.readouterr().out
    if number == signal.SIGTERM:  # what the others leave is the same
        assert main(["fit", "--resume", run]) == 0
        assert_same_run(run, straight)


def terminate(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(("hook", "stops_at"), [("on_sanity_check_start", 0), ("on_sanity_check_end", 1)])
def test_a_signal_before_the_training_begins_stops_it_too(straight, tiny_config, tmp_path, monkeypatch, hook, stops_at):
    """There Lightning's own handler receives it; the status was 128."""
    run = RunFolder(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(ResumeWholeEpochs, hook, terminate)
        status = main(["fit", "--config", str(tiny_config), "--run_dir", str(run), *FOUR_EPOCHS])

    assert status == 128 + signal.SIGTERM
    assert read_provenance(run.provenance)[-1]["exit_status"] == status
    assert read_checkpoint(run.checkpoint)["global_step"] == stops_at
    assert main(["fit", "--resume", str(run)]) == 0
    assert_same_run(run.path, straight)


def test_a_signal_does_not_part_the_batches_of_an_update(tiny_config, tmp_path, monkeypatch):
    fit = ["fit", "--config", str(tiny_config), "--trainer.accumulate_grad_batches", "2", "--run_dir"]
    straight, run = str(tmp_path / "straight"), str(tmp_path / "run")
    assert main([*fit, straight]) == 0

    def interrupt(self, loss):
        if self.trainer.fit_loop.total_batch_idx == 6:  # the last of an update; the next is the first of one
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(WorldModel, "on_before_backward", interrupt)
        assert main([*fit, run]) == 128 + signal.SIGTERM
    assert read_checkpoint(RunFolder(run).checkpoint)["global_step"] == 5  # each epoch has three: of 2, 2 and 1 batches
    assert main(["fit", "--resume", run]) == 0

    assert_same_run(run, straight)


def test_a_signal_does_not_lose_a_validation_within_an_epoch(tiny_config, tmp_path, monkeypatch):
    fit = ["fit", "--config", str(tiny_config), "--trainer.val_check_interval", "2", "--data.batch_size", "2"]
    straight, run = str(tmp_path / "straight"), str(tmp_path / "run")
    assert main([*fit, "--run_dir", straight]) == 0

    def interrupt(self, loss):
        if self.global_step == 2:  # a validation follows update 4
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(WorldModel, "on_before_backward", interrupt)
        assert main([*fit, "--run_dir", run]) == 128 + signal.SIGTERM
    assert main(["fit", "--resume", run]) == 0

    assert_same_run(run, straight)


def test_signals_of_a_cluster_around_one_sigterm_lose_no_update(tiny_config, tmp_path, monkeypatch):
    """As SLURM sends them at a preemption, and a launcher passes them on."""

    def preempt(self, loss):
        if self.global_step == MIDDLE:
            for number in (signal.SIGTERM, signal.SIGUSR2, signal.SIGUSR1, signal.SIGUSR1):
                os.kill(os.getpid(), number)

    run = RunFolder(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(WorldModel, "on_before_backward", preempt)
        assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run)]) == 128 + signal.SIGTERM

    assert read_checkpoint(run.checkpoint)["global_step"] == 8


def test_a_second_signal_stops_at_once(tiny_config, tmp_path, monkeypatch):
    def interrupt(self, loss):
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(WorldModel, "on_before_backward", interrupt)
    with pytest.raises(SystemExit, match=str(128 + signal.SIGTERM)):
        main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run")])
