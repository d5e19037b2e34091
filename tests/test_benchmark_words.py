"""What the benchmarks answer to words that they cannot use: one line, before any work and before a file is touched."""

import os
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import benchmarks
from benchmarks import RESULTS
from pegasus_jax.checks import ConfigError, RunError


@pytest.mark.parametrize(
    ("module", "words", "said"),
    [
        ("speed.suite", "repeats=x", "repeats=x is not a whole number from 1 on; for example repeats=7"),
        ("speed.suite", "repeats=0", "repeats=0 is not a whole number from 1 on"),
        ("speed.suite", f"out={RESULTS}", "cannot be written; expected the name of a file"),
        ("speed.combinations", "repeats=x", "repeats=x is not a whole number"),
        ("speed.growth", "rows=50,a", "rows=a is not a whole number"),
        ("speed.growth", "foo=1", "foo is not a setting"),
        ("speed.scaling", "seeds counts=x", "counts=x is not a whole number"),
        ("speed.scaling", "devices seeds=1,2", "seeds=1,2 is not a whole number"),
        ("speed.scaling", "devices devices=1,99", "devices=99 is out of range"),
        ("speed.first_step", "repeats=x", "repeats=x is not a whole number"),
        ("speed.first_step", "repeats=1 task=cartpol", "task=cartpol is unknown; did you mean 'cartpole'?"),
        ("speed.compare", "", "name a run of the suite"),
        ("speed.compare", "README.md", "README.md is not what python -m benchmarks.speed.suite writes"),
        ("speed.against", ". /", "/ is not a checkout: it has no src/pegasus_jax"),
        ("speed.against", ". . round=1", "round= is unknown; did you mean 'rounds'?"),
        ("speed.against", ". . sizes=cart", "sizes=cart is not a choice; did you mean 'cart-pole'?"),
        ("plants.__main__", "foo", "foo is one word too many"),
        ("plants.gains", "generation=1", "generation= is unknown; did you mean 'generations'?"),
        ("plants.gains", "legs=3", "legs=3 is not a choice; choices: 2, 6"),
        ("plants.gains", "task=belly", "task=belly is not a choice; did you mean 'belly_up'?"),
        ("plants.solvability", "start=1", "start= is unknown; did you mean 'starts'?"),
        ("results_page", "foo", "foo is one word too many"),
        ("pictures", "cartpol=runs/a", "cartpol= is unknown; did you mean 'cartpole'?"),
        ("pictures", "cartpole=/nowhere", "cartpole=/nowhere is not a run; pegasus-train task=cartpole trials=5"),
        ("robot.known_model", "searches=x", "searches=x is not a whole number"),
    ],
)
def test_a_word_that_cannot_be_used_is_one_line_before_any_work(module, words, said):
    stored = {path: path.stat().st_mtime_ns for path in RESULTS.iterdir()}
    with pytest.raises((ConfigError, RunError)) as error:
        import_module(f"benchmarks.{module}").main(shlex.split(words))
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert {path: path.stat().st_mtime_ns for path in RESULTS.iterdir()} == stored


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "soon"])
def test_minutes_are_a_number_above_0(text):
    with pytest.raises(ConfigError, match=f"minutes={text} is not a number above 0; for example minutes=9"):
        benchmarks.minutes({"minutes": text}, 9)
    assert benchmarks.minutes({"minutes": "0.5"}, 9) == 0.5
    assert benchmarks.minutes({}, 9) == 9


def test_a_result_has_its_folder_before_it_is_measured(tmp_path):
    assert benchmarks.writable(tmp_path / "new" / "a.json") == tmp_path / "new" / "a.json"
    assert (tmp_path / "new").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        benchmarks.writable(tmp_path / "file" / "a.json")


@pytest.mark.parametrize(
    ("raised", "status", "said"),
    [
        ("OSError(28, 'No space left on device', 'a.json')", 1, "main: a.json: No space left on device\n"),
        ("FileNotFoundError('x is not a checkout')", 1, "main: x is not a checkout\n"),
        ("KeyboardInterrupt()", 130, "main: stopped\n"),
    ],
)
def test_a_file_and_ctrl_c_are_one_line(raised, status, said, tmp_path):
    file = tmp_path / "main.py"
    file.write_text(f"import benchmarks\ndef main(words):\n    raise {raised}\nbenchmarks.command(main, '')\n")
    done = ended([str(file)])
    assert (done.returncode, done.stderr) == (status, said)


def test_ctrl_c_waits_for_no_thread(tmp_path):
    """One that compiles would end the process by SIGABRT, after `stopped`."""
    file = tmp_path / "main.py"
    file.write_text(
        "import benchmarks, threading, time\n"
        "def main(words):\n"
        "    threading.Thread(target=time.sleep, args=(600,)).start()\n"
        "    raise KeyboardInterrupt\n"
        "benchmarks.command(main, '')\n"
    )
    assert ended([str(file)]).returncode == 130


def test_a_reader_that_goes_away_is_no_traceback(tmp_path):
    file = tmp_path / "main.py"
    file.write_text("import benchmarks\nbenchmarks.command(lambda words: print('x' * 1_000_000), '')\n")
    command = f"{shlex.quote(sys.executable)} {file} | head -c 1"
    assert ended(["-c", f"import os; os.system({command!r})"]).stderr == ""


def ended(words: list[str]) -> subprocess.CompletedProcess:
    """A Python program that imports the benchmarks."""
    env = {**os.environ, "PYTHONPATH": str(Path(benchmarks.__file__).parents[1])}
    return subprocess.run([sys.executable, *words], env=env, capture_output=True, text=True, timeout=120)
