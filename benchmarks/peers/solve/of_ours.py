"""Ours: `pegasus-train`, as a user types it, in a folder of its own and with nothing compiled before.

Every policy is judged when its checkpoint is there; the run stands still meanwhile, so that no clock counts it. Wall
time begins with the command.
"""

import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.peers.solve.attempt import Attempt, judge
from pegasus_jax import controller
from pegasus_jax.cli.sweep import PROGRAM
from pegasus_jax.runs import checkpoint, store


def cpu_seconds(pid: int) -> float:
    """What a process has used, all its threads together."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def learn(attempt: Attempt, program: str) -> None:
    """Learn until a policy solves the plant or the time is over."""
    del program
    trial, aside = 1, 0.0
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        words = [*attempt.plant.task, f"seed={attempt.seed}", "eval_episodes=0", "trials=100", f"out={run}"]
        env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache")}
        began = time.monotonic()
        process = subprocess.Popen([*PROGRAM, *words], env=env, stdout=subprocess.DEVNULL)
        while process.poll() is None and cpu_seconds(process.pid) < attempt.limit:
            time.sleep(0.1)
            if not run.exists() or trial not in checkpoint.available(run):
                continue
            process.send_signal(signal.SIGSTOP)
            now, used = time.monotonic(), cpu_seconds(process.pid)
            value = judge(controller(run, trial=trial), attempt.other, attempt.plant)
            attempt.note(store.trials(run)[trial - 1]["plant_seconds"], now - began - aside, used, value)
            if value >= attempt.plant.bar:
                break
            aside, trial = aside + time.monotonic() - now, trial + 1
            process.send_signal(signal.SIGCONT)
        failed = process.poll()
        process.kill()
        process.wait()
    if failed:
        raise SystemExit(failed)
