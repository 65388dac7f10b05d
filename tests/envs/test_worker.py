"""The process that owns an environment: whatever happens in it, the parent gets a sentence and the next episode."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
from processes import ends
from toy_environments import Echo, Severed, Troubled, Unready

from forbes.envs import BrokenEnvironmentError, EnvironmentProcess, find_environment, worker
from forbes.envs.known_process import KnownProcess
from forbes.errors import ForbesError
from forbes.pomdps import TMaze

ACTIONS = [np.array([value], np.float32) for value in (0.5, -0.25, 0.125, 1.0, 0.0, -1.0)]


def episode(environment, seed=3):
    return [environment.reset(seed), *map(environment.step, ACTIONS)]


def assert_same(one, other):
    for ours, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(ours.observation, theirs.observation)
        assert ours[1:] == theirs[1:]


@pytest.fixture(scope="module")
def echo():
    with EnvironmentProcess(Echo) as environment:
        yield environment


def test_it_is_the_environment_it_owns(echo):
    assert (echo.observation_shape, echo.action_dim, echo.discrete, echo.action_repeat) == ((2,), 1, False, 1)
    assert_same(episode(echo), episode(Echo()))


def test_it_lives_elsewhere_and_without_torch(echo):
    assert echo.describe()["process"] != os.getpid()
    assert not echo.describe()["torch"]


@pytest.mark.parametrize(("ends", "limit"), [(None, 4), (4, 4), (6, 4), (4, 6)])
def test_an_episode_is_truncated_at_the_limit_unless_it_ended(ends, limit):
    """`ends` is the step at which the process itself terminates: an end at the limit stays an end."""
    with EnvironmentProcess(partial(Echo, ends, True), time_limit=limit) as environment:
        for _ in range(2):  # the count begins again with each reset
            steps = [environment.reset(3), *(environment.step(ACTIONS[0]) for _ in range(4))]

            assert [step.truncated for step in steps] == [False] * 4 + [ends != 4 and limit == 4]
            assert [step.terminated for step in steps] == [False] * 4 + [ends == 4]


def test_no_episode_is_without_a_limit_of_steps(echo):
    assert echo.describe()["time_limit"] == 100_000


@pytest.mark.parametrize(("limit", "expected"), [(100, 30), (10, 10)])
def test_the_shorter_of_two_time_limits_is_told(limit, expected):
    with EnvironmentProcess(partial(KnownProcess, TMaze(3), time_limit=30), time_limit=limit) as environment:
        assert environment.describe()["time_limit"] == expected


SENTENCES = {
    "raises": "step raises ArithmeticError: the physics has exploded",
    "hangs": "it hangs, no answer to step within 0.5 s",
    "dies": "its process died in step, exit code -9",
    "leaves": "its process died in step, exit code 7",
    "rewards_nan": "step raises ValueError: the reward is nan, expected a finite number",
    "sees_nan": "step raises ValueError: the observation is not finite",
    "sees_another_shape": "the observation is float32 (3,), expected float32 (2,)",
    "sees_doubles": "the observation is float64 (2,), expected float32 (2,)",
}


@pytest.mark.parametrize("trouble", SENTENCES)
def test_after_trouble_the_next_reset_starts_anew(trouble, tmp_path):
    make = partial(Troubled, trouble, tmp_path / "ledger")
    with EnvironmentProcess(make, timeout=0.5 if trouble == "hangs" else 60.0) as environment:
        first = environment.describe()["process"]
        with pytest.raises(BrokenEnvironmentError) as error:
            episode(environment)
        assert str(error.value).startswith("Echo: ")
        assert str(error.value).endswith(SENTENCES[trouble])
        with pytest.raises(BrokenEnvironmentError, match="expected a reset before the next step"):
            environment.step(ACTIONS[0])

        assert_same(episode(environment), episode(Echo()))
        assert environment.describe()["process"] != first


@pytest.mark.parametrize("where", ["start", "reset"])
@pytest.mark.parametrize("trouble", ["raises", "hangs", "leaves"])
def test_early_trouble_is_one_sentence_and_leaves_no_process(where, trouble, monkeypatch):
    monkeypatch.setattr(worker, "START_LIMIT", 3.0 if (where, trouble) == ("start", "hangs") else 60.0)
    limit = 3 if where == "start" else 0.5
    begun = set(multiprocessing.active_children())

    with pytest.raises(BrokenEnvironmentError) as error:
        EnvironmentProcess(partial(Unready, where, trouble), timeout=0.5).reset(0)

    sentences = {
        "raises": f"{where} raises ArithmeticError: the physics has exploded",
        "hangs": f"it hangs, no answer to {where} within {limit} s",
        "leaves": f"its process died in {where}, exit code 7",
    }
    assert str(error.value).startswith(f"{'Unready' if where == 'start' else 'Echo'}: {sentences[trouble]}")
    assert set(multiprocessing.active_children()) <= begun


def test_an_interrupt_leaves_no_answer_for_the_next_request(echo, monkeypatch):
    echo.reset(1)
    with monkeypatch.context() as patch:
        patch.setattr(type(echo._connection), "poll", lambda *_: exec("raise KeyboardInterrupt"))
        with pytest.raises(KeyboardInterrupt):
            echo.step(ACTIONS[0])

    assert_same(episode(echo), episode(Echo()))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_a_process_that_starts_is_left_to_its_parent(number, monkeypatch):
    answer = EnvironmentProcess._answer

    def send(self, method, timeout):
        os.kill(self._process.pid, number)
        return answer(self, method, timeout)

    monkeypatch.setattr(EnvironmentProcess, "_answer", send)
    with EnvironmentProcess(Echo) as environment:
        assert_same(episode(environment), episode(Echo()))


@pytest.mark.parametrize("sent", [0, 100])
def test_a_death_before_or_during_an_answer_is_reported(sent, tmp_path):
    """A connection tells the two apart: by an EOFError and an OSError."""
    with EnvironmentProcess(partial(Severed, sent)) as environment:
        with pytest.raises(BrokenEnvironmentError, match="Echo: its process died in reset, exit code 7"):
            environment.reset(0)


def test_an_error_that_a_user_can_mend_is_not_tried_again():
    with pytest.raises(ForbesError, match="action_repeat is 0, expected at least 1") as error:
        EnvironmentProcess(partial(find_environment("cartpole_balance"), pixels=False, action_repeat=0))
    assert not isinstance(error.value, BrokenEnvironmentError)
    assert "Traceback" in "".join(error.value.__notes__)  # for --debug


def run_script(folder, text):
    (folder / "script.py").write_text("from forbes.envs import EnvironmentProcess, find_environment\n" + text)
    command = [sys.executable, str(folder / "script.py")]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def test_a_script_that_forgets_to_close_it_ends_all_the_same(tmp_path):
    """At its exit it would wait for a process that leaves every request to end to its parent."""
    guarded = """
if __name__ == "__main__":
    environment = EnvironmentProcess(find_environment("tiger"))
    raise SystemExit("refused")
"""
    done = run_script(tmp_path, guarded)

    assert (done.returncode, done.stderr.strip()) == (1, "refused")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_it_ends_with_its_parent_even_in_an_endless_step(tmp_path):
    program = """
import sys
from functools import partial
from toy_environments import Troubled
from forbes.envs import EnvironmentProcess
if __name__ == "__main__":
    environment = EnvironmentProcess(partial(Troubled, "hangs", sys.argv[1]))
    print(environment.describe()["process"], flush=True)
    environment.reset(0)
    import numpy
    for _ in range(3):
        environment.step(numpy.zeros(1, numpy.float32))
"""
    (tmp_path / "parent.py").write_text(program)
    ledger = tmp_path / "ledger"
    paths = os.pathsep.join(path for path in sys.path if path)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py"), str(ledger)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    )
    with parent:
        child = int(parent.stdout.readline())
        while not ledger.exists():  # it has begun to hang
            time.sleep(0.05)
        parent.send_signal(signal.SIGKILL)

    if not (ended := ends(child)):
        os.kill(child, signal.SIGKILL)
    assert ended


def test_a_script_without_a_guard_is_told_what_it_lacks(tmp_path):
    """A spawned process imports the script that started it, which would start another one, and so on."""
    done = run_script(tmp_path, "EnvironmentProcess(find_environment('tiger'))\n")

    assert done.returncode != 0
    assert 'guard its code with `if __name__ == "__main__":`' in done.stderr.splitlines()[-1]


NOTEBOOK = """
import functools
from forbes.envs import EnvironmentProcess
from forbes.errors import ForbesError
from forbes.pomdps import TMaze
from toy_environments import Echo
class Room(Echo):
    pass
def furnish(steps, kind):
    return kind(steps)
for make in (Room, functools.partial(Room, 3), functools.partial(furnish, 3, Echo)):
    try:
        EnvironmentProcess(make)
    except ForbesError as error:
        print(error)
with EnvironmentProcess(Echo) as environment:
    print(environment.action_dim)
"""
NAMES = ("Room", "Room", "furnish")


def assert_told_to_move(name, sentence):
    assert sentence.startswith(f"{name}: it is defined in a notebook or on standard input, which")
    assert sentence.endswith("Define it at the top level of a module file, and import it from there")


def run_notebook(*flags, stdin=None):
    """Run the commands where `__main__` is no file; their output, and that nothing is on standard error."""
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.run([sys.executable, *flags], input=stdin, capture_output=True, text=True, env=environ)


def test_a_class_of_a_notebook_is_told_to_move_to_a_module_file():
    done = run_notebook("-c", NOTEBOOK)  # as in a notebook, `__main__` has no file, and an imported class can be used

    *refused, action_dim = done.stdout.splitlines()
    for name, sentence in zip(NAMES, refused, strict=True):
        assert_told_to_move(name, sentence)
    assert action_dim == "1"
    assert done.stderr == ""


def test_a_script_on_standard_input_is_told_to_move_to_a_file():
    done = run_notebook(stdin=NOTEBOOK)

    for name, sentence in zip(NAMES, done.stdout.splitlines(), strict=True):
        assert_told_to_move(name, sentence)
    assert done.stderr.splitlines()[-1].endswith(
        "Echo: code on standard input cannot start the worker process of an environment, which re-imports it. "
        "Write it to a file"
    )


@pytest.mark.parametrize("task", ["tiger", "cartpole_balance"])
def test_an_environment_that_does_not_start_is_named_by_its_task(task, monkeypatch):
    monkeypatch.setattr(worker, "START_LIMIT", 0.01)

    with pytest.raises(BrokenEnvironmentError, match=rf"^{task}: it hangs, no answer to start"):
        EnvironmentProcess(find_environment(task, noise=0.1))


def test_what_cannot_be_sent_to_another_process_is_one_sentence():
    class Local(Echo):
        pass

    for make in (Local, lambda: Echo()):
        with pytest.raises(
            ForbesError, match=r"it cannot be sent to another process .* Define it at the top level of a module"
        ):
            EnvironmentProcess(make)
