"""One command a question: `python -m experiments.NAME`; see the README for all of them.

Compiled functions are kept in results/.compiled: the first stroke of a painting takes 2.4 s in the
second run in place of 12.5 s. JAX_COMPILATION_CACHE_DIR keeps them elsewhere,
JAX_ENABLE_COMPILATION_CACHE=0 nowhere.
"""

import hashlib
import os
import platform
from pathlib import Path


def _machine() -> str:
    """What code is compiled for: it must not be run on a processor that knows less."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    what = f"{platform.machine()} {platform.processor()} {flags}"
    return hashlib.sha256(what.encode()).hexdigest()[:16]


# Read by JAX when it is imported.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path("results/.compiled") / _machine()))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
# XLA takes its own hints to itself ("prefer-no-gather") for features that the processor lacks, and
# says so at every function it reads back.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
