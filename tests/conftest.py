"""Define the settings that all tests share.

By default property tests are deterministic, so that a failure here is a failure everywhere. The slow tier draws other
examples each time, and prints how to repeat one that fails.
"""

import ctypes
import gc
import os
import resource
from collections import defaultdict
from pathlib import Path

import hypothesis
import jax
import pytest
import threadpoolctl

FAST_COMPILE_FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
"""Flags that make XLA compile faster and optimise less. Most programs of the default tier run once and take longer to
compile than to run: the flags save a third of the time. They are not used in the slow tier, nor where the user sets
``XLA_FLAGS``; there XLA optimises as it does for users."""

hypothesis.settings.register_profile(
    "liethermo", derandomize=True, deadline=None, database=None, print_blob=True, max_examples=6
)
hypothesis.settings.register_profile(
    "liethermo-slow", derandomize=False, deadline=None, database=None, print_blob=True, max_examples=10
)


os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of processes that a test starts
threadpoolctl.threadpool_limits(limits=1, user_api="blas")
# The workers of a run share the cores, and threads of BLAS wait in busy loops.

gc.set_threshold(200_000, 20, 100)
"""Tracing makes many small objects that live: looking through them ever again costs a tenth of the time."""


def pytest_addoption(parser):
    parser.addoption("--part", metavar="K/N", help="run the K-th of N parts of the selected tests")


class SuitePart:
    """Plugin that keeps one of N parts of the selected tests: every N-th test, so that each part has cases of every
    test."""

    def __init__(self, text: str):
        try:
            number, count = map(int, text.split("/"))
        except ValueError:
            raise pytest.UsageError(f"--part must be K/N, such as 3/4, got {text!r}") from None
        if not 1 <= number <= count:
            raise pytest.UsageError(f"--part must be from 1/{count} to {count}/{count}, got {text!r}")
        self.number, self.count = number, count

    @pytest.hookimpl(trylast=True)  # after tests are deselected by their marks
    def pytest_collection_modifyitems(self, config, items):
        parts = [items[k :: self.count] for k in range(self.count)]
        items[:] = parts.pop(self.number - 1)
        config.hook.pytest_deselected(items=[item for part in parts for item in part])


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    if config.option.part:
        config.pluginmanager.register(SuitePart(config.option.part))
    is_slow_tier = "slow" in (config.option.markexpr or "") and "not slow" not in config.option.markexpr
    hypothesis.settings.load_profile("liethermo-slow" if is_slow_tier else "liethermo")
    if not is_slow_tier:
        os.environ.setdefault("XLA_FLAGS", FAST_COMPILE_FLAGS)
    if hasattr(config, "cache"):
        _keep_compiled_programs(config.cache.mkdir("compiled"))


def _keep_compiled_programs(folder: Path) -> None:
    """Let XLA and the library store compiled programs in a folder, for later runs and for every process of this one.

    ``--cache-clear`` empties the folder.
    """
    os.environ["LIETHERMO_CACHE"] = str(folder / "liethermo")
    for name, value in {
        "jax_compilation_cache_dir": str(folder / "xla"),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }.items():
        os.environ[name.upper()] = str(value)  # for processes that a test starts
        jax.config.update(name, value)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark the cases of a test marked ``sampled`` as slow, except for a sample of them.

    ``sampled(n)`` keeps n cases, spread over all of them; ``sampled("a", "b")`` keeps the cases with these ids.
    """
    cases = defaultdict(list)
    for item in items:
        mark = item.get_closest_marker("sampled")
        if mark and not item.get_closest_marker("slow"):
            cases[item.parent.nodeid, item.originalname, mark.args].append(item)
    runs_whole_files = not any("::" in argument for argument in config.args)
    for (file, test, sample), test_cases in cases.items():
        if isinstance(sample[0], str):
            unknown = set(sample) - {item.callspec.id for item in test_cases}
            if unknown and runs_whole_files:
                raise pytest.UsageError(
                    f"{file}::{test} is to be sampled at {sorted(unknown)}, which are no cases of it"
                )
            chosen_indices = {i for i, item in enumerate(test_cases) if item.callspec.id in sample}
        else:
            chosen_indices = {(2 * i + 1) * len(test_cases) // (2 * sample[0]) for i in range(sample[0])}
        for i, item in enumerate(test_cases):
            if i not in chosen_indices:
                item.add_marker("slow")


def pytest_collection_finish():
    """Let garbage collections pass over the modules and the tests, some 700,000 objects that stay: each took 1.7 s."""
    gc.collect()
    gc.freeze()


MAX_COMPILED_BY_MODULE = 10
"""Most programs that reading one module of tests may compile: constants and one small system. The most seen is 8."""

_compile_events: list[str] = []


@jax.monitoring.register_event_duration_secs_listener
def _record_compilation(event, *_, **__):
    if event == "/jax/core/compile/backend_compile_duration":
        _compile_events.append(event)


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report(collector):
    """Fail a module of tests that compiles too many programs when it is read.

    Every worker reads every module: a system that a module builds at import costs all workers, for any selection.
    """
    start_count = len(_compile_events)
    outcome = yield
    count = len(_compile_events) - start_count
    if isinstance(collector, pytest.Module) and count > MAX_COMPILED_BY_MODULE:
        report = outcome.get_result()
        report.outcome = "failed"
        report.longrepr = (
            f"{collector.nodeid} compiles {count} programs when it is read, more than {MAX_COMPILED_BY_MODULE}: "
            "build systems where they are used (tests.cases.BuiltOnUse, functools.cache)"
        )


@pytest.fixture(autouse=True)
def _bounded_compilation_cache(request):
    """Drop JAX's compiled programs between tests when they hold too many memory maps or too much memory.

    A process may have 65,530 maps, and every compiled program holds some. Memory that is free again is returned to the
    system: else the size stays, and programs are dropped ever again.
    """
    yield
    request.session.liethermo_count = count = getattr(request.session, "liethermo_count", 0) + 1
    if count % 10 == 0 and (_memory_maps() > 30_000 or _megabytes() > 3_000):
        jax.clear_caches()
        gc.collect()
        if return_memory := getattr(ctypes.CDLL(None), "malloc_trim", None):
            return_memory(0)


def _megabytes() -> int:
    """Return the resident memory of this process, in MiB, or 0 where the system does not report it."""
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[1]) * resource.getpagesize() // 2**20 if pages.exists() else 0


def _memory_maps() -> int:
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 30_001
