"""`forbes reproduce`: trains what is missing, and its page says what held and where each number is from."""

import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from command_line import error_of
from environment_in_this_process import play_here
from jobs_in_this_process import configuration_here, run_here

from forbes.commands import budgets, reproduce, score_tables, trainings
from forbes.commands.budgets import Family, Size
from forbes.commands.cli import main
from forbes.commands.parsers.reproduce import BUDGETS, PARTS
from forbes.commands.report import late_gain, write_report
from forbes.evaluation.claims import CLAIMS
from forbes.evaluation.record import read_record
from forbes.runs.configs import find_config
from forbes.runs.folder import read_metrics


def in_this_process(patch):
    """Run the jobs here."""
    patch.setattr(reproduce, "run_jobs", run_here)
    patch.setattr(trainings, "complete_configuration", configuration_here)


@pytest.fixture(scope="module")
def rssm(tiny_config, tmp_path_factory):
    """The tiny configuration of an RSSM."""
    path = tmp_path_factory.mktemp("configs") / "rssm.yaml"
    flow = "{class_path: FlowBelief, init_args: {layers: 2, width: 4}}"
    path.write_text(tiny_config.read_text().replace(flow, "GaussianBelief"))
    return path


def plan_tiny(patch, rssm, tiny_config):
    """Plan FORBES and an RSSM of the tiny configuration, one seed each, in place of the paper's."""
    configs = {"strokes/rssm": str(rssm), "strokes/forbes": str(tiny_config)}
    sizes = {budget: Size(1, 1) for budget in BUDGETS}
    plan = [Family(name, config, "strokes", 5, 2.0, sizes) for name, config in configs.items()]
    nothing = dict.fromkeys(PARTS, list)
    patch.setattr(budgets, "_PARTS", nothing | {"strokes": lambda: plan})
    patch.setitem(budgets._SMOKE_FLAGS, "strokes", ())
    patch.setattr(budgets, "_FIGURES", ())
    in_this_process(patch)
    return plan


@pytest.fixture
def tiny_plan(rssm, tiny_config, monkeypatch):
    return plan_tiny(monkeypatch, rssm, tiny_config)


@pytest.fixture(scope="module")
def reproduced(rssm, tiny_config, tmp_path_factory):
    """The folder of the tiny plan, trained and measured."""
    folder = tmp_path_factory.mktemp("reproduced")
    with pytest.MonkeyPatch.context() as patch:
        plan_tiny(patch, rssm, tiny_config)
        assert main(smoke(folder)) == 0
    return folder


def smoke(folder, *options):
    return ["reproduce", "--budget", "smoke", "--only", "strokes", "-o", str(folder), *options]


def page_of(folder):
    return (folder / "report" / "index.html").read_text()


class Resources(HTMLParser):
    """All addresses of a page that a browser would load, and the names of its anchors."""

    def __init__(self, page):
        super().__init__()
        self.loaded, self.links, self.anchors = [], [], set()
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.loaded += [found[key] for key in ("src", "data") if key in found]
        self.loaded += [found["href"]] if tag == "link" else []
        self.links += [found["href"]] if tag == "a" else []
        self.anchors |= {found.get("id")}


def test_the_smoke_budget_trains_measures_and_reports_everything(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    play_here(monkeypatch)
    monkeypatch.setattr("forbes.figures.beliefs._SAMPLES", 200)
    monkeypatch.setattr("forbes.figures.calibration._SEQUENCES", 40)

    assert main(["reproduce", "--budget", "smoke", "-o", str(tmp_path)]) == 0

    page = page_of(tmp_path)
    found = Resources(page)
    planned = [one for part in PARTS for one in budgets.trainings(part, "smoke", tmp_path)]
    assert all(address.startswith("data:image/png;base64,") for address in found.loaded)
    assert len(found.loaded) >= 3
    assert "This is a smoke run. Its numbers are no evidence." in page
    assert page.count("smoke run, no evidence") > len(found.loaded)
    assert {link[1:] for link in found.links if link.startswith("#")} <= found.anchors
    for one in planned:
        metrics = read_metrics(one.training.folder)
        assert metrics.index.max() == one.updates == 10
        assert f"--run_dir {one.training.folder}" in page
    verdicts = re.findall(r'class="badge ([\w-]+)">[^<]*</span><br>', page)
    assert verdicts == ["not-tested"] * len(CLAIMS) + ["does-not-hold"]  # Theorem 1 needs no training


def test_a_failed_job_is_named_and_stops_no_other(tiny_plan, tmp_path, capsys):
    tiny_plan[0] = tiny_plan[0]._replace(flags=("--model.no_such_key", "1"))

    assert main(smoke(tmp_path)) == 2

    error = capsys.readouterr().err.splitlines()[-1]
    assert f"jobs that failed: {tmp_path}/strokes/rssm-0. See {tmp_path}/report/index.html" in error
    page = page_of(tmp_path)
    assert "Jobs that failed" in page
    assert f"<code>{tmp_path}/strokes/rssm-0</code> ended with status 2: its last &lt;line&gt;" in page
    assert any("/elbo[" in name for name in read_record(tmp_path / "strokes" / "forbes-0"))


def test_a_failed_measurement_is_named_with_its_last_line(tiny_plan, tmp_path, monkeypatch):
    broken = budgets._Measured(("evaluate", "--sequences", "1"), (), 0.1)
    monkeypatch.setitem(budgets._MEASURES, "strokes", broken)

    assert main(smoke(tmp_path)) == 2

    assert "<code>evaluate-strokes-strokes-0</code> ended with status 2: its last &lt;line&gt;" in page_of(tmp_path)


def test_interrupted_it_resumes_where_it_stopped(tiny_plan, tmp_path, monkeypatch):
    begun = []

    def killed_in_the_second(jobs, launcher, later=0.0, on_end=None):
        begun.append([job.name for job in jobs])
        run_here(jobs[:1], launcher)
        raise KeyboardInterrupt

    def counted(jobs, launcher, *others):
        begun.append([job.name for job in jobs])
        return run_here(jobs, launcher, *others)

    monkeypatch.setattr(reproduce, "_run_steps", lambda steps, *others: {})
    monkeypatch.setattr(reproduce, "run_jobs", killed_in_the_second)
    assert main(smoke(tmp_path)) == 130
    monkeypatch.setattr(reproduce, "run_jobs", counted)

    assert main(smoke(tmp_path)) == 0

    assert begun == [[f"{tmp_path}/strokes/rssm-0", f"{tmp_path}/strokes/forbes-0"], [f"{tmp_path}/strokes/forbes-0"]]


def test_a_step_is_repeated_only_if_a_run_was_trained_further(tiny_plan, reproduced, monkeypatch):
    ran = []

    def counted(jobs, launcher, *others):
        ran.extend(job.name for job in jobs)
        return run_here(jobs, launcher, *others)

    monkeypatch.setattr(reproduce, "run_jobs", counted)
    assert main(smoke(reproduced)) == 0
    assert ran == []
    path = reproduced / "steps" / "evaluate-strokes-strokes-0.json"
    record = json.loads(path.read_text())
    record["checkpoints"][f"{reproduced}/strokes/rssm-0"] = "of another training"
    path.write_text(json.dumps(record))

    assert main(smoke(reproduced)) == 0

    assert ran == ["evaluate-strokes-strokes-0"]


def test_what_is_wrong_is_said_in_one_sentence(tiny_plan, reproduced, capsys):
    other = error_of(capsys, "reproduce", "--budget", "small", "-o", reproduced)
    assert other.startswith(f"{reproduced}: has the runs of --budget smoke, expected small. Choose another folder")
    assert "invalid choice: 'theory'" in error_of(capsys, "reproduce", "--only", "theory")


def test_a_changed_configuration_is_named_and_its_run_not_used(tiny_plan, tmp_path, capsys):
    tiny_plan[1] = tiny_plan[1]._replace(flags=("--model.free_nats", "1"))
    assert main(smoke(tmp_path)) == 0
    tiny_plan[:] = [family._replace(flags=("--model.free_nats", "1")) for family in tiny_plan]

    assert main(smoke(tmp_path)) == 2

    out, error = capsys.readouterr()
    assert f"jobs that failed: {tmp_path}/strokes/rssm-0. See" in error
    reason = "was trained with model.init_args.free_nats = "
    assert f"not finished: {tmp_path}/strokes/rssm-0 {reason}" in out
    assert page_of(tmp_path).count(reason) == 2  # above, and where the run is listed


def test_a_dry_run_lists_hours_and_trains_nothing(tiny_plan, tmp_path, capsys):
    assert main(smoke(tmp_path, "--dry-run")) == 0

    lines = capsys.readouterr().out
    assert all(name in lines for name in ("strokes/rssm-0", "strokes/forbes-0"))
    assert "2 of 2 trainings are missing and take about 0.0 hours" in lines
    assert [*tmp_path.iterdir()] == []


def test_measured_updates_per_second_replace_the_recorded(tiny_plan, tmp_path):
    one = budgets.trainings("strokes", "small", tmp_path)[0]
    assert one.hours(None, gpu=False) == pytest.approx((10 + 5 / 2.0) / 3600)

    run = Path(one.training.folder)
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "last.ckpt").touch()
    (run / "provenance.json").write_text(json.dumps([{"hours": 0.5, "exit_status": 0}]))
    (run / "metrics.jsonl").write_text('{"update": 3600, "epoch": 0}\n')

    assert reproduce._measured_rate(one, [one]) == pytest.approx(2.0)


def test_the_paper_is_started_only_after_a_yes(tiny_plan, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda question: "n")

    error = error_of(capsys, "reproduce", "--budget", "paper", "--only", "strokes", "-o", tmp_path / "paper")

    assert error.startswith("not started.")
    assert not (tmp_path / "paper").exists()


@pytest.mark.parametrize("budget", BUDGETS)
def test_the_plan_states_the_updates_of_its_configurations(budget, tmp_path):
    for part in PARTS:
        for family in budgets.families(part, budget):
            config = yaml.safe_load(find_config(family.config).read_text())
            assert config["data"]["init_args"]["updates_per_epoch"] == family.per_epoch, family.name
            assert family.name.partition("/")[2] in score_tables._TITLES
        folders = [one.training.folder for one in budgets.trainings(part, budget, tmp_path)]
        assert len({*folders}) == len(folders) > 0


def test_the_small_budget_is_estimated_at_three_hours_on_two_cores(tmp_path):
    planned = [one for part in PARTS for one in budgets.trainings(part, "small", tmp_path)]
    steps = [*budgets.measures(planned, "small", tmp_path), *budgets.figures(planned, tmp_path)]

    assert sum(one.hours(None, gpu=False) for one in planned) + sum(step.hours for step in steps) <= 2 * 3


def test_the_paper_budget_tests_each_claim(tmp_path):
    trained = {family.name for part in PARTS for family in budgets.families(part, "paper")}
    updates = {one.family.name: one.updates for part in PARTS for one in budgets.trainings(part, "paper", tmp_path)}

    for claim in CLAIMS:
        assert {*claim.families} <= trained
        assert min(updates[family] for family in claim.families) >= claim.updates


@pytest.fixture
def record_run():
    """A function that writes the folder of a finished and measured run."""

    def record(folder, scores, updates=3000, sha256="a", curve=()):
        folder = Path(folder)
        (folder / "checkpoints").mkdir(parents=True)
        (folder / "checkpoints" / "last.ckpt").touch()
        entry = {"command": "forbes fit <it>", "commit": "1234567890", "hours": 0.25, "exit_status": 0}
        (folder / "provenance.json").write_text(json.dumps([entry]))
        lines = [{"update": update, "epoch": 0, "val/elbo[S=1]": value} for update, value in curve]
        lines.append({"update": updates, "epoch": 0})
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        name, data = "test/elbo[categorical,S=16]", {"name": "digits", "sha256": sha256}
        about = {"mean": float(scores.mean()), "standard_error": 0.1, "data": data, "seed": 0}
        (folder / "evaluation.json").write_text(json.dumps({name: about}))
        np.savez(folder / "evaluation.npz", **{name: scores})

    return record


@pytest.mark.parametrize(
    ("lead", "updates", "verdict"),
    [(6.0, 3000, "holds"), (-6.0, 3000, "does-not-hold"), (6.0, 2999, "not-tested")],
)
def test_the_page_decides_a_claim_by_the_recorded_scores(lead, updates, verdict, record_run, tmp_path):
    planned = budgets.trainings("strokes", "small", tmp_path)
    random = np.random.default_rng(0)
    digits = random.normal(-40.0, 10.0, 100)
    for one in planned:
        ahead = lead if one.family.name == "strokes/forbes" else 0.0
        record_run(one.training.folder, digits + ahead + random.normal(0.0, 0.5, 100), updates)

    write_report(planned, "small", tmp_path, {}, "forbes reproduce")

    page = page_of(tmp_path)

    rows = re.findall(r"<tr>\s*<td>(.*?)</tr>", page, re.DOTALL)
    (row,) = [row for row in rows if row.startswith("FORBES has the higher test ELBO on digit strokes")]
    assert f'badge {verdict}"' in row
    number = re.search(r'class="number">([+−])([\d.]+) ± ([\d.]+) nats per digit<', row)
    assert number[1] == ("+" if lead > 0 else "−")
    assert float(number[2]) == pytest.approx(abs(lead), abs=4 * float(number[3]))
    assert "1.50 h, commit 1234567" in row  # six runs of a quarter
    assert "smoke" not in page.replace("forbes reproduce --budget", "")
    assert "forbes fit &lt;it&gt;" in page


def test_the_page_says_which_runs_still_learn_and_what_chance_gives(record_run, tmp_path):
    """FORBES has gained 2 of 40 nats in the last tenth of its updates, the others none."""
    planned = budgets.trainings("strokes", "small", tmp_path)
    random = np.random.default_rng(0)
    for one in planned:
        late = 2 if one.family.name == "strokes/forbes" else 0
        curve = [(300, -80.0), (2700, -40.0 - late), (2800, -40.0 - late / 2), (3000, -40.0)]
        record_run(one.training.folder, random.normal(-40.0, 1.0, 20), curve=curve)

    rows = write_report(planned, "small", tmp_path, {}, "forbes reproduce")

    (numbers,) = {row.rising for row in rows if row.rising}
    late = [number for number, one in enumerate(planned, start=1) if one.family.name == "strokes/forbes"]
    names = ", ".join(f"r{number}" for number in late)
    assert numbers == f"not flat: up to 5% of the gain of {names} came in the last tenth of updates"
    page = " ".join(page_of(tmp_path).split())
    tested = sum(row.verdict.held != "not tested" for row in rows if row.runs)
    assert f"{tested} claims were tested with trained models, without a correction" in page
    assert f"at most {0.05 * tested:.2f} would be expected to hold by chance" in page


@pytest.mark.parametrize(
    ("curve", "share"),
    [
        ({10: -5.0, 90: -2.0, 100: -1.0}, 0.25),
        ({10: 5.0, 90: 2.0, 100: 1.0}, 0.25),  # a loss
        ({10: -5.0, 90: -1.0, 100: -1.5}, -1 / 7),
        ({100: -5.0}, 0.0),
        ({10: -5.0, 100: -5.0}, 0.0),
        ({95: -5.0, 100: -4.0}, 1.0),
    ],
)
def test_a_late_gain_is_a_share_of_the_whole(curve, share):
    metrics = pd.DataFrame({"val/elbo[S=1]": curve, "train/loss": dict.fromkeys(range(101), 1.0)})

    assert late_gain(metrics.sort_index()) == pytest.approx(share)


def test_a_run_measured_on_other_digits_leaves_its_claims_untested(record_run, tmp_path):
    planned = budgets.trainings("strokes", "small", tmp_path)
    for one in planned:
        record_run(one.training.folder, np.zeros(9), sha256=one.family.name)

    rows = write_report(planned, "small", tmp_path, {}, "forbes reproduce")

    assert rows[0].verdict.held == "not tested"
    assert "strokes/rssm-0: its elbo was measured otherwise than that of" in rows[0].verdict.reason
    assert rows[0].number == ""
