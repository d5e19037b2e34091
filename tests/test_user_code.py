"""What is wrong with a user's own code is one line with their file and line; code in a run's folder is not run."""

import os
import re
import sys
from pathlib import Path

import pytest

from pegasus_jax.checks import ConfigError
from pegasus_jax.tasks import user_code


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working folder; what is imported from it is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def refusal(name):
    with pytest.raises(ConfigError) as caught:
        user_code.load("cost", name)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"cost={name}")
    return message


def test_a_function_of_the_working_folder_is_found(here):
    (here / "own_costs.py").write_text("def cost(x):\n    return x[0]\n")
    assert user_code.load("cost", "own_costs:cost")([3]) == 3
    assert user_code.origin("own_costs") == here / "own_costs.py"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("def cost(x) return 1\n", "SyntaxError: expected ':' (broken.py:1)"),
        ("x = 1\ny = x / 0\n", "ZeroDivisionError: division by zero (broken.py:2)"),
        ("\n\nimport sys\nsys.exit(7)\n", "it ends the program, sys.exit(7) (broken.py:4)"),
        ("import nowhere_at_all\n", "No module named 'nowhere_at_all' (broken.py:1)"),
        ("import json\n\njson.loads('{')\n", "(broken.py:3)"),
        (
            "def helper():\n    raise OSError('no robot\\nat this address')\n\nhelper()\n",
            "no robot at this address (broken.py:2)",
        ),
        ("class Stop(BaseException):\n    pass\nraise Stop\n", "Stop (broken.py:3)"),
        ("raise ValueError('x' * 10000)\n", "..."),
    ],
)
def test_what_a_module_raises_is_one_line_with_its_own_line(here, text, says):
    (here / "broken.py").write_text(text)
    message = refusal("broken:cost")
    assert says in message
    assert len(message) < 500


def test_ctrl_c_goes_through(here):
    (here / "broken.py").write_text("raise KeyboardInterrupt\n")
    with pytest.raises(KeyboardInterrupt):
        user_code.load("cost", "broken:cost")


def test_what_is_not_there_is_said_with_what_is(here):
    (here / "own_costs.py").write_text("def cost(x):\n    return x[0]\n\nlimit = 3\n")
    assert "did you mean 'cost'?" in refusal("own_costs:coast")
    assert "not a function, but of type int" in refusal("own_costs:limit")
    assert f"no module named 'own_cost' in {here} or among" in refusal("own_cost:cost")
    for name in ("cost", "own_costs:", ":cost", ""):
        assert "expected cost=module:function" in refusal(name)


def test_a_name_that_python_has_itself_says_which_file_was_taken(here):
    import select as standard

    assert str(user_code.origin("select") or "select") in refusal("select:cost")
    assert standard
    (here / "random.py").write_text("def cost(x):\n    return x[0]\n")
    assert f"random is {user_code.origin('random')}, not your random.py; rename that file" in refusal("random:cost")


def test_what_a_function_raises_has_its_line_or_that_of_its_definition(here):
    (here / "called.py").write_text("\ndef two(x, u):\n    return x\n\ndef fails(x):\n    return len(3)\n")
    two, fails = (user_code.load("cost", f"called:{name}") for name in ("two", "fails"))
    with pytest.raises(ConfigError, match=r"^it: TypeError: .* no len\(\) \(called.py:6\)$"), user_code.blamed("it"):
        fails(1)
    assert user_code.told(TypeError("no u"), two) == "TypeError: no u (called.py:2)"
    assert user_code.told(TypeError("no u"), len) == "TypeError: no u"


def test_no_folder_is_added_twice(here):
    (here / "own_costs.py").write_text("def cost(x):\n    return x[0]\n")
    for _ in range(2):
        user_code.load("cost", "own_costs:cost")
    assert sys.path.count(os.getcwd()) == 1
    assert Path(os.getcwd()) == here


@pytest.mark.parametrize(
    ("setting", "word"), [("cost", "cost=function"), ("explore.policy", 'settings={"explore.policy": function}')]
)
def test_a_function_of_a_program_is_given_again_as_it_can_be(setting, word):
    with pytest.raises(ConfigError, match=re.escape(f"go on in Python: train(resume=RUN, {word})")):
        user_code.load(setting, "__main__:<lambda>")


def test_a_module_has_a_name() -> None:
    with pytest.raises(ConfigError, match=r"cost=\.robot:cost cannot be imported: expected cost=module:function"):
        user_code.load("cost", ".robot:cost")
