"""Settings and fixtures that every test shares."""

import gc
import os
from pathlib import Path

WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if WORKERS > 1:
    # Each worker's XLA would otherwise start as many compute threads as there are cores.
    os.environ.setdefault("PJRT_NPROC", str(max(1, (os.cpu_count() or 1) // WORKERS)))

# What is tested is what is compiled now.
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "0"

import jax  # noqa: E402  (the variables above are read when it is imported)
import pytest  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


MAPS = Path("/proc/self/maps")
MANY = 30_000
"""Mapped regions from which on compiled functions are let go. Each keeps several, Linux allows a
process 65,530, and past that compiling aborts it: all tests in one process come that far."""


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    moves_on = nextitem is not None and nextitem.path != item.path
    if moves_on and MAPS.exists() and MAPS.read_bytes().count(b"\n") > MANY:
        jax.clear_caches()
        gc.collect()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") and jax.default_backend() != "gpu":
        pytest.skip("needs a GPU")


@pytest.fixture
def key() -> jax.Array:
    """A typed random key, the same in every test."""
    return jax.random.key(0)


@pytest.fixture
def x64():
    """Runs the test in double precision: arrays default to float64."""
    with jax.enable_x64(True):
        yield
