"""What every test shares: key reuse is an error, property tests are repeatable, and float64 is one fixture away."""

import gc
import os
import signal
from importlib.metadata import version
from pathlib import Path

# Before jax loads LAPACK: two test processes on two cores, each with a thread a core that spins while it waits, made a
# Cholesky factor of 375 rows take a second instead of a millisecond.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Compile faster to slower code, here and in the processes that tests start: their programs are many and tiny. The flags
# take the place of a run's own options (programs.FAST_RUN) and save a third of its time; later compilers have some of
# them no more, and end a process that is given those.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ["XLA_FLAGS"] = " ".join(
    [
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_backend_optimization_level=0",
        "--xla_cpu_prefer_vector_width=256",
        "--xla_cpu_parallel_codegen_split_count=1",  # a small program in many parts takes longer
    ]
    * (version("jaxlib") < "0.11")
    + os.environ.get("XLA_FLAGS", "").split()
)

# A program is compiled once for all tests and the processes that they start, in this run of them and in the next ones:
# many compile the same, small ones above all. `make clean` removes the folder.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(Path(__file__).resolve().parents[1] / "build" / "programs")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

# A shell that starts a command in the background lets it ignore Ctrl-C, and so would every process that tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import jax
import pytest
from hypothesis import settings

import forked

# A random key used twice raises, in jit and scan too: PEGASUS rests on knowing which draw is which. One false alarm is
# known, in jax 0.10 and 0.12: vmap of a scan over split keys. probes.unchecked switches the check off for that.
jax.config.update("jax_debug_key_reuse", True)

# JAX makes many objects when it traces, and few of them are garbage: a tenth of a test's time went to look for it.
gc.set_threshold(100_000)

# Derandomized: a failure in CI is the same failure here. No deadline: the first example compiles.
settings.register_profile("repository", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("repository")


# The files that take minutes: begun first, so that at the end no core waits for another's last file.
LONG = ("test_docs", "test_train", "test_family", "test_campaigns", "test_examples", "test_robot", "test_seeds")
LONG += ("test_api", "test_export", "test_build_search")
QUICK = 120  # CPU seconds that a test of `make test` may take, on any machine; those there are take up to 20 here


def pytest_collection_modifyitems(items):
    """Long files first, otherwise as they came."""
    items.sort(key=lambda item: LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG))


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu") and jax.default_backend() != "gpu":
        pytest.skip("needs a GPU")


def cpu_seconds():
    """Of this process and of those that it started, until now."""
    return sum(os.times()[:4]) + sum(forked.spent)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """A test that takes long has to say so. CPU time, its processes' too: it hardly depends on what else is running."""
    began = cpu_seconds()
    result = yield
    spent = cpu_seconds() - began
    if spent > QUICK and not item.get_closest_marker("slow") and not item.get_closest_marker("campaign"):
        pytest.fail(f"took {spent:.0f} s of CPU time; above {QUICK} s: mark it slow, or make it quicker", pytrace=False)
    return result


@pytest.fixture
def x64():
    """Float64 inside one test, for closed forms and finite differences."""
    with jax.enable_x64(True):
        yield
