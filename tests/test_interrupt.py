"""Signals: a robot is let go within a second, whatever else goes on, and the exit status says which signal it was."""

import signal
import subprocess
import sys
import time

import pytest

# A command that opens something to be closed, and then waits for another thread, as for a compiler.
COMMAND = """
import signal, sys, threading, time
from pegasus_jax import interrupt
{before}
def close():
    print("closing", flush=True)
    {closing}
    print("closed", flush=True)
interrupt.before_end(close)
done = threading.Event()
threading.Thread(target=lambda: time.sleep(60), daemon=True).start()
try:
    interrupt.listen()
    print("ready", flush=True)
    {body}
except KeyboardInterrupt:
    interrupt.clean_up()
    interrupt.end(interrupt.status())
interrupt.clean_up()
interrupt.end(0 if len(sys.argv) < 2 else int(sys.argv[1]))
"""


def begun(body: str = "done.wait()", closing: str = "pass", before: str = "") -> subprocess.Popen[str]:
    program = COMMAND.format(body=body, closing=closing, before=before)
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # which `nohup` lets us and ours ignore
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def ended(process: subprocess.Popen[str], seconds: float = 20) -> tuple[int, list[str]]:
    process.wait(seconds)
    assert process.stdout is not None
    return process.returncode, process.stdout.read().split()


@pytest.mark.parametrize(("number", "status"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_closes_and_ends(number: str, status: int) -> None:
    """The other thread would go on for a minute."""
    process = begun()
    began = time.monotonic()
    process.send_signal(getattr(signal, number))
    assert ended(process) == (status, ["closing", "closed"])
    assert time.monotonic() - began < 10


def test_a_signal_while_it_closes_waits_and_a_third_one_does_not() -> None:
    process = begun(closing="time.sleep(1.5)")
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    assert ended(process) == (130, ["closing", "closed"])
    process = begun(closing="time.sleep(60)")
    for _ in range(3):
        process.send_signal(signal.SIGINT)
        time.sleep(0.5)
    assert ended(process) == (130, ["closing"])


def test_a_second_signal_closes_and_ends_at_once() -> None:
    """The first one is swallowed."""
    body = (
        'exec(\'try:\\n    print("inside", flush=True)\\n    done.wait()\\nexcept KeyboardInterrupt:\\n'
        '    print("swallowed", flush=True)\\n    done.wait()\')'
    )
    process = begun(body=body)
    assert process.stdout is not None
    assert process.stdout.readline() == "inside\n"
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "swallowed\n"
    process.send_signal(signal.SIGTERM)
    assert ended(process) == (130, ["closing", "closed"])


def test_a_swallowed_signal_is_remembered() -> None:
    body = "exec('try:\\n    signal.raise_signal(2)\\nexcept KeyboardInterrupt:\\n    pass\\ninterrupt.check()')"
    assert ended(begun(body=body)) == (130, ["closing", "closed"])


def test_a_signal_that_a_finalizer_loses_is_raised_again() -> None:
    lost = (
        "exec('class Loses:\\n    def __del__(self):\\n        signal.raise_signal(2)\\n"
        'Loses()\\nprint("lost", flush=True)\\ndone.wait(30)\')'
    )
    began = time.monotonic()
    assert ended(begun(body=lost)) == (130, ["lost", "closing", "closed"])
    assert time.monotonic() - began < 10


def test_a_signal_while_an_extension_module_begins_is_raised_after_that() -> None:
    """C++ that is called back by Python's initialization of it ends the process, where an exception passes it."""
    begins = (
        "exec('from importlib.machinery import ExtensionFileLoader\\nclass Begins(ExtensionFileLoader):\\n"
        '    def exec_module(self, module):\\n        signal.raise_signal(2)\\n        print("begun", flush=True)\\n'
        'Begins("module", "path").exec_module(None)\\ndone.wait(30)\')'
    )
    assert ended(begun(body=begins.replace("exec('", "exec('", 1))) == (130, ["begun", "closing", "closed"])


def test_the_handlers_of_an_environment_are_called_and_do_not_hide_the_signal() -> None:
    body = (
        'exec(\'signal.signal(2, lambda *_: print("theirs", flush=True))\\n'
        'interrupt.reclaim()\\nsignal.raise_signal(2)\\nprint("lost")\')'
    )
    assert ended(begun(body=body)) == (130, ["theirs", "closing", "closed"])


def test_what_close_raises_is_said_and_does_not_keep_the_command(capfd: pytest.CaptureFixture[str]) -> None:
    process = begun(closing="raise OSError('no answer')")
    process.send_signal(signal.SIGINT)
    assert ended(process) == (130, ["closing"])
    assert "pegasus: closing the environment failed, OSError: no answer" in capfd.readouterr().err


def test_a_robot_that_was_not_closed_is_no_success(capfd: pytest.CaptureFixture[str]) -> None:
    assert ended(begun(body="pass", closing="raise OSError('no answer')")) == (2, ["closing"])
    assert capfd.readouterr().err.splitlines() == ["pegasus: closing the environment failed, OSError: no answer"]


@pytest.mark.parametrize("code", [0, 2])
def test_an_end_does_not_wait_for_the_threads_of_others(code: int) -> None:
    """A robot's driver, or a tracker, may have one that never ends."""
    program = COMMAND.format(body="pass", closing="pass", before="")
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", program, str(code)], capture_output=True, text=True, check=False, timeout=30
    )
    assert (done.returncode, done.stdout.split()) == (code, ["ready", "closing", "closed"])
    assert time.monotonic() - began < 20


def test_a_hangup_that_is_ignored_stays_ignored() -> None:
    """As nohup has it."""
    process = begun(body="done.wait(1)", before="signal.signal(signal.SIGHUP, signal.SIG_IGN)")
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGTERM)
    assert ended(process) == (143, ["closing", "closed"])


def test_a_defect_is_told_whole_and_no_thread_is_torn_down() -> None:
    """Which would end the compiler's threads at any place, by SIGSEGV or SIGABRT."""
    code = (
        "import atexit, sys; from pegasus_jax.cli.main import main; sys.argv = ['x', 'y']\n"
        "atexit.register(print, 'torn down')\n"
        "main(lambda words: [][0], '')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("Traceback")
    assert done.stderr.endswith("IndexError: list index out of range\n")
