"""The command line: what it lists, what it leaves behind, and each bad input as one sentence and exit code 2."""

import importlib.metadata
import json
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from command_line import error_of
from environment_in_this_process import play_here
from jobs_in_this_process import configuration_here
from lightning_utilities.core.imports import RequirementCache
from small_agents import forbes, write_config

from forbes import __version__
from forbes.commands import compare, trainings
from forbes.commands.cli import COMMANDS, main
from forbes.commands.parsers.fit import help_page
from forbes.data.episodes.store import EpisodeStore
from forbes.runs.folder import RunFolder, read_metrics
from forbes.training import WorldModel

CONFIGS = Path(__file__).parents[2] / "configs"


HEAVY = {"torch", "lightning", "matplotlib.pyplot", "matplotlib", "pandas", "jsonargparse", "gymnasium", "dm_control"}


def imported_by(*arguments):
    """The exit status of a command, what it prints, and which of the heavy modules it imports; it must end itself."""
    program = f"""
import sys
from forbes.commands.cli import main
try:
    sys.exit(main({list(arguments)!r}))
finally:
    print(*{HEAVY!r} & sys.modules.keys(), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    *told, heavy = done.stderr.splitlines()
    return done.returncode, done.stdout + "\n".join(told), heavy


def test_help_lists_every_command_and_imports_nothing_heavy():
    status, text, heavy = imported_by("--help")

    assert (status, heavy) == (0, "")
    for name in COMMANDS:
        assert f"forbes {name}" in text


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_imports_nothing_heavy(name):
    status, text, heavy = imported_by(name, "--help")

    assert f"usage: forbes {name}" in text
    assert (status, heavy) == (0, "")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["evaluate"], "forbes evaluate: the following arguments are required: RUN"),
        (["compare", "a.yaml", "--seed", "x", "--", "--help"], "argument --seed: invalid int value: 'x'"),
        (["theorem", "--steps", "0"], "0 is not a number above 0"),
        (["data", "fetch", "digits"], "invalid choice: 'digits'"),
    ],
)
def test_a_mistake_is_told_before_anything_heavy_is_imported(arguments, sentence):
    status, text, heavy = imported_by(*arguments)

    assert sentence in text
    assert (status, heavy) == (2, "")


def test_what_follows_two_dashes_asks_for_no_help(capsys):
    assert "absent.yaml: no such configuration" in error_of(capsys, "compare", "absent.yaml", "--", "--help")


EXAMPLES = re.findall(r"^  forbes (fit strokes.*?)(?:  +#.*)?$", help_page("fit"), re.MULTILINE)
CHANGED = re.findall(r"(--(?:model|data|trainer|seed)[\w.]+) ([\w.-]+)", help_page("fit").split("\n\n")[3])


def test_the_help_of_fit_is_a_screenful():
    lines = help_page("fit").splitlines()

    assert len(lines) <= 40
    assert max(map(len, lines)) <= 120
    assert len(EXAMPLES) == 3
    assert len(CHANGED) >= 14


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_examples_of_its_help_can_be_run(example, monkeypatch, capsys):
    monkeypatch.chdir(CONFIGS.parent)
    with pytest.raises(SystemExit) as done:
        main([*example.split(), "--print_config"])

    assert done.value.code == 0
    assert "class_path: forbes.WorldModel" in capsys.readouterr().out


def test_flags_named_in_the_help_have_the_examples_values(monkeypatch, capsys):
    monkeypatch.chdir(CONFIGS.parent)
    flags = [f"{name}={value}" for name, value in CHANGED if value != "TASK"]
    printed = []
    for changed in ([], flags):
        with pytest.raises(SystemExit) as done:
            main([*EXAMPLES[0].split(), *changed, "--print_config"])
        assert done.value.code == 0
        printed.append(capsys.readouterr().out)

    assert "state_dim: 8" in printed[0]
    assert printed[1] == printed[0]


def test_all_flags_are_a_word_away(capsys):
    with pytest.raises(SystemExit) as done:
        main(["fit", "--help", "all"])

    assert done.value.code == 0
    text = capsys.readouterr().out
    assert "--trainer.gradient_clip_val" in text
    assert "--resume RUN" in text


def test_the_package_and_the_script_are_the_same_program():
    script = Path(sys.executable).with_name("forbes")
    outputs = {
        subprocess.run([*program, "--version"], capture_output=True, text=True, check=True).stdout
        for program in ([str(script)], [sys.executable, "-m", "forbes"])
    }

    assert outputs == {f"forbes {__version__}\n"}


def test_misspelt_arguments_of_a_class_are_named(tiny_config, tmp_path, capsys):
    """jsonargparse takes what stands beside class_path for an argument of the class that is the default."""
    config = tmp_path / "config.yaml"
    text = tiny_config.read_text()
    assert "MLPEncoder, init_args" in text
    config.write_text(text.replace("MLPEncoder, init_args", "MLPEncoder, int_args"))

    sentence = error_of(capsys, "fit", "--config", str(config))

    assert sentence == f"{config}: model.encoder: MLPEncoder: expected init_args next to class_path, found int_args"


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (
            ["--model.learning_rte", "1"],
            "model.learning_rte: WorldModel has no such option, did you mean learning_rate?",
        ),
        (["--model.belief.layer", "1"], "model.belief.layer: FlowBelief has no such option, did you mean layers?"),
        (["--data.source.point_per_step", "2"], "Strokes has no such option, did you mean points_per_step?"),
        (["--trainer.max_epoch", "3"], "trainer.max_epoch: Trainer has no such option, did you mean max_epochs?"),
        (["--modle.kl", "analytic"], "modle: the configuration has no such option, did you mean model?"),
        (
            ["--learning_rate", "1"],
            "learning_rate: the configuration has no such option, did you mean model.learning_rat",
        ),
        (["--max_epoch", "1"], "max_epoch: the configuration has no such option, did you mean trainer.max_epochs?"),
        (["--batch_size", "1"], "batch_size: the configuration has no such option, did you mean data.batch_size?"),
        (["--points_per_step", "2"], "did you mean data.source.points_per_step?"),
        (["--exploration", "0"], "did you mean model.exploration?"),
        (["mine.yaml"], "mine.yaml: is not a flag. Configurations come first: forbes fit CONFIG"),
        (
            ["--trainer.logger", "TensorBoardLogger", "--trainer.logger.savedir", "logs"],
            "trainer.logger.savedir: TensorBoardLogger has no such option, did you mean save_dir?",
        ),
        (["--trainer.callbacks", "ModelCheckpoint", "--trainer.callbacks.save_top_k", "-3"], "save_top_k=-3"),
        (["--model.belief", "FlowBelef"], "no class FlowBelef that fits here, did you mean FlowBelief?"),
        (["--data.source", "FlowBelief"], "no class FlowBelief that fits here"),
        (
            ["--trainer.callbacks", "PredictionGri"],
            "no class PredictionGri that fits here, did you mean PredictionGrid?",
        ),
        (["--model.learning_rate", "fast"], "model.learning_rate: is fast, expected float"),
        (["--model.kl", "exact"], "model.kl: is exact, expected one of ['analytic', 'monte_carlo', 'path']"),
        (["--trainer.max_epochs", "many"], "trainer.max_epochs: is many, expected int or null"),
        (["--data.length", "0"], "length is 0, expected at least 1"),
        (["--model.learning_rate", "null"], "learning_rate is None, expected at least 0"),
        (["--model.state_dim", "0"], "state_dim is 0, expected at least 1"),
        (["--data.batch_size", "-1"], "batch_size is -1, expected at least 1"),
        (["--data.batch_size", "21"], "batch_size is 21, but the training split has 20 sequences"),
        (["--trainer.devices", "0"], "devices"),
        (["surplus"], "surplus: is not a flag"),
        (["--config", "absent.yaml"], "absent.yaml: no such configuration"),
        (["--resume", "absent"], "absent: no such run folder"),
        (["--run_dir", "/proc/run"], "/proc/run: no such file or directory"),
        (["--resume", "pretrained:strokes-forbes", "--run_dir", "b"], "not allowed with argument"),
        (["--resume", ""], "--resume: is empty, expected a run folder. Name one, or leave it out"),
        (["--run_dir", ""], "--run_dir: is empty, expected a run folder. Name one, or leave it out"),
        (["--allow-module", "no_such_module"], "--allow-module no_such_module: No module named 'no_such_module'"),
        (["--allow-module"], "--allow-module: the name is missing"),
    ],
)
def test_a_wrong_flag_is_one_sentence(flags, expected, tiny_config, in_tmp_path, capsys):
    assert expected in error_of(capsys, "fit", "--config", str(tiny_config), *flags)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("modle: {class_path: WorldModel}", "modle: the configuration has no such option, did you mean model?"),
        ("model: {class_path: WorldModl}", "model: no class WorldModl that fits here, did you mean WorldModel?"),
        (
            "model: {class_path: WorldModel, init_args: {hiden_dim: 3}}",
            "model.hiden_dim: WorldModel has no such option, did you mean hidden_dim?",
        ),
        ("data: {class_path: SequenceDataModule, init_args: {length: 2.5}}", "data.length: is 2.5, expected int"),
        ("trainer: {max_epoch: 3}", "trainer.max_epoch: Trainer has no such option, did you mean max_epochs?"),
        ("trainer: {max_epochs: many}", "trainer.max_epochs: is many, expected int or null"),
    ],
)
def test_a_wrong_line_of_a_configuration_is_one_sentence(change, expected, tiny_config, in_tmp_path, capsys):
    Path("bad.yaml").write_text(change)

    for configs in (["--config", str(tiny_config), "--config", "bad.yaml"], ["--config", "bad.yaml"]):
        assert error_of(capsys, "fit", *configs) == f"bad.yaml: {expected}"
    assert not Path("runs").exists()


def test_a_logger_that_is_not_installed_is_one_sentence(tiny_config, in_tmp_path, monkeypatch, capsys):
    absent = RequirementCache("no_such_package>=1")
    monkeypatch.setattr("lightning.pytorch.loggers.wandb._WANDB_AVAILABLE", absent)

    sentence = error_of(capsys, "fit", "--config", str(tiny_config), "--trainer.logger", "WandbLogger")

    assert sentence.endswith("WandbLogger needs wandb, which is not installed. Install it: pip install wandb")


@pytest.mark.parametrize("text", ["model: {class_path: WorldModel", "- 1", "", "model: 3"])
def test_a_file_that_is_no_configuration_is_one_sentence(text, in_tmp_path, capsys):
    Path("bad.yaml").write_text(text)

    assert "bad.yaml" in error_of(capsys, "fit", "--config", "bad.yaml")


def test_an_unknown_command_suggests_the_nearest(capsys):
    assert error_of(capsys, "fti") == "fti: no such command. Did you mean fit?"


def test_debug_shows_the_traceback(in_tmp_path):
    with pytest.raises(Exception, match="no such run folder"):
        main(["--debug", "fit", "--resume", "absent"])


def test_a_configuration_runs_no_foreign_module_unless_allowed(tiny_config, in_tmp_path, monkeypatch, capsys):
    Path("stranger.py").write_text(
        "import pathlib\n"
        "from forbes.beliefs import GaussianBelief\n"
        "pathlib.Path('executed').touch()\n"
        "class MyBelief(GaussianBelief): ...\n"
    )
    monkeypatch.syspath_prepend(str(in_tmp_path))
    flags = ["fit", "--config", str(tiny_config), "--model.belief", "stranger.MyBelief"]

    sentence = error_of(capsys, *flags)

    assert "stranger.MyBelief is not a class of forbes or Lightning. If you trust it, add: --allow-module" in sentence
    assert not Path("executed").exists()
    assert main([*flags, "--allow-module", "stranger"]) == 0
    assert Path("executed").exists()


def test_a_family_of_ones_own_is_compared(tiny_config, in_tmp_path, monkeypatch, capfd):
    """Its training is a process of its own, which must know its module too; given again, it trains nothing."""
    for module in (compare, trainings):
        monkeypatch.setattr(module, "complete_configuration", configuration_here)
    Path("mine.py").write_text("from forbes.beliefs import GaussianBelief\nclass MyBelief(GaussianBelief): ...\n")
    flags = ["--model.belief", "mine.MyBelief", "--trainer.max_epochs", "1"]
    command = ["--allow-module", "mine", "compare", str(tiny_config), "--scores", "elbo", "-o", "runs", "--", *flags]

    for _ in range(2):
        assert main(command) == 0
        out = capfd.readouterr().out
        assert "MyBelief" in json.dumps(yaml.safe_load(Path("runs/forbes-0/config.yaml").read_text()))
        assert "comparison.csv" in out
    assert "epoch 1/1" not in out
    start, *_ = json.loads(Path("runs/forbes-0/provenance.json").read_text())
    assert start["command"].startswith("forbes --allow-module mine fit --config ")
    recorded = shlex.split(json.loads(Path("runs/comparison.json").read_text())["command"])
    assert recorded == ["forbes", *command]
    assert main(recorded[1:]) == 0  # what is recorded can be run


def test_a_run_folder_is_named_by_its_config_and_holds_all(tiny_config, in_tmp_path, capsys):
    assert main(["fit", "--config", str(tiny_config), "--seed_everything", "7"]) == 0

    (run,) = Path("runs/tiny/forbes").iterdir()
    assert run.name.endswith("-7")
    output = capsys.readouterr().out
    assert f"run folder: {run}" in output
    assert output.endswith(f"  forbes figures elbo --runs {run}\n")
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["seed_everything"] == 7
    assert config["model"]["class_path"] == "forbes.WorldModel"
    assert config["model"]["init_args"]["clip_norm"] == 100.0  # a default: the file holds all
    (start,) = json.loads((run / "provenance.json").read_text())
    assert start["seed"] == 7
    assert start["exit_status"] == 0
    assert start["command"].startswith("forbes fit --config ")
    assert start["versions"]["forbes"] == __version__
    assert start["versions"]["mujoco"] == importlib.metadata.version("mujoco")
    assert read_metrics(run).index.max() == 10
    assert (run / "checkpoints" / "last.ckpt").is_file()


def test_a_run_can_be_named(tiny_config, in_tmp_path):
    one_epoch = ["fit", "--config", str(tiny_config), "--trainer.max_epochs", "1"]

    assert main([*one_epoch, "--experiment", "mine"]) == 0
    assert main([*one_epoch, "--run_dir", "here"]) == 0

    assert len(list(Path("runs/mine").iterdir())) == 1
    assert Path("here/checkpoints/last.ckpt").is_file()


def test_a_trained_run_is_not_trained_over(tiny_config, tiny_run, capsys):
    before = (tiny_run / "metrics.jsonl").read_bytes()

    sentence = error_of(capsys, "fit", "--config", str(tiny_config), "--run_dir", str(tiny_run))

    assert sentence == f"{tiny_run}: holds a trained run. Name another, or resume it: forbes fit --resume {tiny_run}"
    assert (tiny_run / "metrics.jsonl").read_bytes() == before


def test_two_processes_never_train_in_one_folder(tiny_run, capsys):
    with RunFolder(tiny_run).locked():
        assert "trains here" in error_of(capsys, "fit", "--resume", str(tiny_run))


def test_each_start_of_a_run_is_recorded_with_its_end(tiny_config, in_tmp_path, monkeypatch):
    assert main(["fit", "--config", str(tiny_config), "--run_dir", "run"]) == 0
    resume = ["fit", "--resume", "run", "--trainer.max_epochs", "3"]
    with monkeypatch.context() as patch:
        patch.setattr(WorldModel, "training_step", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            main(resume)
    assert main(resume) == 0

    starts = json.loads(Path("run/provenance.json").read_text())

    assert [start["exit_status"] for start in starts] == [0, 1, 0]
    assert starts[1]["command"] == "forbes fit --resume run --trainer.max_epochs 3"
    assert read_metrics("run").index.max() == 15


def test_loggers_of_the_configuration_come_beside_ours(tiny_config, in_tmp_path):
    flags = ["--trainer.logger", "CSVLogger", "--trainer.logger.save_dir", "csv", "--run_dir", "run"]

    assert main(["fit", "--config", str(tiny_config), *flags]) == 0

    assert list(Path("csv").rglob("metrics.csv"))
    assert read_metrics("run").index.max() == 10


def test_without_logger_or_checkpoints_only_the_record_is_left(tiny_config, in_tmp_path):
    flags = ["--trainer.logger", "false", "--trainer.enable_checkpointing", "false", "--run_dir", "run"]

    assert main(["fit", "--config", str(tiny_config), *flags]) == 0

    assert {path.name for path in Path("run").iterdir()} == {".lock", "config.yaml", "provenance.json"}


CURVE = ["--trainer.callbacks+", "ElboCurve"]


def test_a_dry_run_leaves_nothing(tiny_config, in_tmp_path):
    assert main(["fit", "--config", str(tiny_config), "--trainer.fast_dev_run", "true", *CURVE]) == 0

    assert list(in_tmp_path.iterdir()) == []


def test_a_dry_run_of_an_agent_leaves_stored_episodes_alone(in_tmp_path):
    config = write_config(in_tmp_path)
    stored = in_tmp_path / "episodes" / "000000.npz"
    stored.parent.mkdir()
    stored.write_bytes(b"of the user")

    assert forbes("fit", "--config", config, "--trainer.fast_dev_run", "1", "--trainer.callbacks+", "ReturnCurve") == 0

    assert sorted(in_tmp_path.rglob("*")) == [stored.parent, stored, config]


@pytest.mark.parametrize("command", ["validate", "test", "predict"])
def test_an_agent_is_measured_by_its_returns(command, tmp_path, capsys):
    config = write_config(tmp_path)

    assert forbes(command, "--config", config, "--ckpt_path", tmp_path / "last.ckpt") == 2

    expected = f"forbes: forbes {command}: an agent is measured by its returns. Use: forbes evaluate RUN\n"
    assert capsys.readouterr().err == expected


def test_a_picture_of_the_metrics_needs_their_logger(tiny_config, in_tmp_path, capsys):
    flags = ["--config", str(tiny_config), "--trainer.logger", "false", "--run_dir", "run"]

    sentence = error_of(capsys, "fit", *flags, *CURVE)

    assert sentence.startswith(
        "ElboCurve: draws metrics.jsonl, which this training does not write. Remove this callback"
    )
    assert not RunFolder("run").checkpoint.exists()


@pytest.mark.parametrize("command", ["validate", "test", "predict"])
def test_a_trained_model_runs_through_the_other_loops(command, tiny_run, in_tmp_path):
    flags = ["--config", f"{tiny_run}/config.yaml", "--ckpt_path", f"{tiny_run}/checkpoints/last.ckpt"]

    assert main([command, *flags]) == 0

    assert list(in_tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["validate", "test", "predict"])
def test_the_other_loops_need_a_trained_model(command, tiny_config, capsys):
    assert "ckpt_path missing" in error_of(capsys, command, "--config", str(tiny_config))
    assert "absent: no such checkpoint" in error_of(
        capsys, command, "--config", str(tiny_config), "--ckpt_path", "absent"
    )


TOYS = ["--allow-module", "toy_environments"]
SMALL = {  # what a configuration spends on playing and on pictures
    "seed_episodes: 25": "seed_episodes: 1",
    "evaluation_episodes: 20": "evaluation_episodes: 1",
    "{evaluation_episodes: 10}": "{seed_episodes: 1, evaluation_episodes: 1}",
    "{evaluate_every: 20, evaluation_episodes: 3}": "{seed_episodes: 1, evaluation_episodes: 1}",
    "candidates: 200": "candidates: 20",
    "iterations: 5": "iterations: 1",
    "{class_path: Collect}": "{class_path: Collect, init_args: {seed_episodes: 1}}",
    "{class_path: ElboCurve}": "{class_path: ElboCurve, init_args: {sequences: 2}}",
    "{class_path: BeliefPlot}": "{class_path: BeliefPlot, init_args: {digits: 1, columns: 2, samples: 50}}",
    "{class_path: PredictionGrid}": "{class_path: PredictionGrid, init_args: {digits: 1, samples: 2}}",
    "{class_path: OpenLoopPanel}": "{class_path: OpenLoopPanel, init_args: {sequences: 1, columns: 6}}",
    "{class_path: ImaginedFutures}": "{class_path: ImaginedFutures, init_args: {samples: 2, columns: 2}}",
}
OVERLAYS = {
    "debug.yaml": "strokes/forbes.yaml",
    "dmc/cpu.yaml": "dmc/forbes_n1.yaml",
    "dmc/proprio.yaml": "dmc/forbes_n1.yaml",
    "dmc/proprio_v3.yaml": "dmc/dreamerv3.yaml",
    "dmc/world_model_cpu.yaml": "dmc/world_model_rssm.yaml",
}


@pytest.fixture(scope="session")
def screens(tmp_path_factory):
    """Ten episodes of a toy that looks like a task of DeepMind Control."""
    return collect(tmp_path_factory.mktemp("episodes") / "screens", "Screen")


@pytest.fixture(scope="session")
def vectors(tmp_path_factory):
    """Ten episodes of a toy that shows vectors."""
    return collect(tmp_path_factory.mktemp("episodes") / "vectors", "Parrot")


def with_little_work(text):
    for wanted, small in SMALL.items():
        text = text.replace(wanted, small)
    return text


def collect(folder, task):
    with pytest.MonkeyPatch.context() as patch:
        play_here(patch)
        assert main(["data", "collect", "--task", task, "--episodes", "10", "-o", str(folder), *TOYS]) == 0
    return folder


@pytest.mark.parametrize("config", sorted(CONFIGS.rglob("*.yaml")), ids=lambda path: str(path.relative_to(CONFIGS)))
def test_every_configuration_trains(config, in_tmp_path, screens, vectors, monkeypatch):
    play_here(monkeypatch)
    name = str(config.relative_to(CONFIGS))
    files = [CONFIGS / OVERLAYS[name], config] if name in OVERLAYS else [config]
    text = "\n".join(file.read_text() for file in files)
    for file in files:
        Path(file.name).write_text(with_little_work(file.read_text()))
    elsewhere = {"data.source.origin": "bundled"} if "origin: dejong" in text else {}  # it is not in the repository
    if name.startswith(("popgym/", "minigrid/", "memory_maze/")):
        pytest.importorskip(config.parent.name)
    if name.startswith("dmc/"):
        elsewhere = {"data.length": 6}
        task = "Screen" if "pixels: false" not in text else "cartpole_balance"
        task = "ScreenWithJoints" if "proprio: true" in text else task
        stored = vectors if "positions/" in name else screens
        elsewhere |= {"data.source.path": stored} if "world_model" in name else {"data.source.task": task}
        elsewhere |= {"model.candidates": 20, "model.best": 5} if "PlanningAgent" in text else {}
    elsewhere |= {"data.source.time_limit": 12} if "Experience" in text else {}
    small = {
        "data.batch_size": 4,
        "data.updates_per_epoch": 1,
        "data.validation_sequences": 4,
        "trainer.max_epochs": 2 if "Experience" in text else 1,  # agents play in the second
        "trainer.log_every_n_steps": 1,
        "trainer.accelerator": "cpu",
    }
    flags = [f"--{name}={value}" for name, value in (small | elsewhere).items()]
    configs = [part for file in files for part in ("--config", file.name)]

    assert main(["fit", *configs, *flags, "--run_dir", "run", *TOYS]) == 0

    assert Path("run/checkpoints/last.ckpt").is_file()
    logged = [json.loads(line) for line in Path("run/metrics.jsonl").read_text().splitlines()]
    assert all(math.isfinite(value) for line in logged for value in line.values())
    if Path("run/episodes").is_dir():
        policies = [record.policy for record in EpisodeStore("run/episodes").records.values()]
        assert policies[0] == "random"
        assert policies[-1] != "random"
