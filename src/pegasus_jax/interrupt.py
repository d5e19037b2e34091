"""Signals that ask a command to stop: a robot is closed first, and the process ends with 128 + the signal's number."""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.machinery import ExtensionFileLoader
from types import FrameType
from typing import Any

# Windows has no SIGHUP; its SIGBREAK is Ctrl-Break, and a closed console.
NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
SIGNALS = tuple(signal.Signals[name] for name in NAMES if name in signal.Signals.__members__)

WAITED = "compiling"  # the name of threads that the end of a success waits for: the compiler cannot be stopped
PAUSE = 0.02  # seconds until a signal whose exception was lost, or could not be raised, is raised again
LOADING = ("create_module", "exec_module")  # of a loader


class Interrupted(KeyboardInterrupt):
    """A signal asked to stop; its argument is the signal's number."""


class _State:
    """Signals are the process's own, and so is what is known of them."""

    listening = False
    closing = False
    unclosed = False
    held = False
    repeated = False
    asked: list[int] = []  # noqa: RUF012
    cleanups: list[Callable[[], None]] = []  # noqa: RUF012
    others: dict[int, Any] = {}  # noqa: RUF012


def listen() -> None:
    """From now on a signal raises `Interrupted` in the main thread; a second one cleans up and ends the process."""
    if not _State.listening:
        sys.unraisablehook = partial(_unraisable, sys.unraisablehook)
    _State.listening, _State.closing, _State.held, _State.repeated = True, False, False, False
    _State.asked.clear()
    _State.others.clear()
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup leaves it
            signal.signal(number, _handle)


def reclaim() -> None:
    """Answer the signals again after a user's code took them; its handlers are called first."""
    for number in SIGNALS if _State.listening else ():
        handler = signal.getsignal(number)
        if handler not in (_handle, signal.SIG_IGN):
            _State.others[number] = handler
            signal.signal(number, _handle)


def check() -> None:
    """Raise `Interrupted` if a signal asked to stop, also where somebody's `except` swallowed it."""
    if _State.asked:
        raise Interrupted(_State.asked[0])


@contextmanager
def held() -> Iterator[None]:
    """Signals wait until the block ends, except in `heard` blocks, so that what was measured is stored first."""
    before, _State.held = _State.held, True
    try:
        yield
    finally:
        _State.held = before
    if not before:
        check()


@contextmanager
def heard() -> Iterator[None]:
    """Signals are raised in this block, also within `held`."""
    before, _State.held = _State.held, False
    try:
        check()
        yield
    finally:
        _State.held = before


def before_end(cleanup: Callable[[], None]) -> None:
    """Call `cleanup` when the command ends, whatever ends it."""
    _State.cleanups.append(cleanup)


def clean_up() -> None:
    """Do now, once, what was to be done before the end."""
    while _State.cleanups:
        let_go(_State.cleanups.pop())


def let_go(close: Callable[[], None]) -> None:
    """Call a robot's `close` and wait for its end, also after one or two signals. An error in it is printed."""
    _State.closing = True
    try:
        close()
    except Exception as error:
        _State.unclosed = True
        print(f"pegasus: closing the environment failed, {type(error).__name__}: {error}", file=sys.stderr)
    finally:
        _State.closing = False


def asked() -> bool:
    """Whether a signal asked to stop: what is raised after that may be its consequence."""
    return bool(_State.asked)


def status() -> int:
    """The exit status of a command that was asked to stop: 130 after Ctrl-C."""
    return 128 + (_State.asked[0] if _State.asked else int(signal.SIGINT))


def end(code: int) -> None:
    """End the process with this status; 2 in place of 0 where a robot was not closed, as its motors may be on.

    Only a success waits for threads that still compile, and nothing waits for threads of others.
    """
    code = code or 2 * _State.unclosed
    for thread in threading.enumerate() if code == 0 else ():
        if thread.name == WAITED:
            thread.join()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # nobody reads it any more
            stream.flush()
    if code:
        os._exit(code)  # the compiler's threads cannot be stopped, and those of others would complain of the end
    sys.exit(code)


def forget_input() -> None:
    """Throw away what was typed before a question is asked: it would answer "Is the robot at rest?"."""
    try:
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    except Exception:  # no terminal, or a system without them
        return


def _unraisable(otherwise: Callable[[Any], object], told: Any) -> None:
    """What Python loses, as in a finalizer or in a callback of its garbage collector: a signal is raised again."""
    if isinstance(told.exc_value, Interrupted):
        threading.Thread(target=_repeat, args=(told.exc_value.args[0],), daemon=True).start()
    else:
        otherwise(told)


def _repeat(number: int) -> None:
    time.sleep(PAUSE)
    _State.repeated = True
    to_main_thread(number)


def to_main_thread(number: int) -> None:
    """Raise a signal in the main thread, whatever thread this is: what it waits for in the system is interrupted."""
    try:
        signal.pthread_kill(threading.main_thread().ident, number)  # type: ignore[arg-type]
    except AttributeError:  # Windows has none; Python calls the handler in the main thread all the same
        signal.raise_signal(number)


def _handle(number: int, frame: FrameType | None) -> None:
    if _State.repeated:
        _State.repeated = False
        if not (_State.closing or _State.held):
            _raise(number, frame)
        return
    _State.asked.append(number)
    other = _State.others.get(number)
    if callable(other) and other != signal.default_int_handler:
        try:
            other(number, frame)
        except Exception as error:
            print(f"pegasus: a signal handler of the environment failed: {error}", file=sys.stderr)
    if (_State.closing and len(_State.asked) < 3) or (_State.held and len(_State.asked) == 1):
        return
    if len(_State.asked) == 1:
        _raise(number, frame)
        return
    clean_up()
    os._exit(status())


def _raise(number: int, frame: FrameType | None) -> None:
    """Raise `Interrupted`; a moment later where an extension module begins, which that could end by SIGSEGV."""
    if not _begins_extension(frame):
        raise Interrupted(number)
    threading.Thread(target=_repeat, args=(number,), daemon=True).start()


def _begins_extension(frame: FrameType | None) -> bool:
    """Whether the initialization of an extension module is among a frame and its callers."""
    while frame is not None:
        if frame.f_code.co_name in LOADING and isinstance(frame.f_locals.get("self"), ExtensionFileLoader):
            return True
        frame = frame.f_back
    return False
