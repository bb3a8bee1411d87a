"""Refuses the JAX releases that compute wrong numbers, or compute them far too slowly; and keeps
the memory of a process, which speeds up training on a CPU.

`pyproject.toml` excludes the same releases; this check also catches an environment that
was put together by other means. `tests/test_backend.py` holds the reproducers.
"""

import ctypes
import re

import jax

OLDEST = (0, 10, 1)
EXCLUDED: dict[tuple[int, ...], str] = {
    (0, 10, 2): (
        "it computes wrong numbers on the CPU under jit "
        "(https://github.com/jax-ml/jax/issues/39103)"
    ),
    (0, 11, 0): (
        "it crashes or hangs on reductions of rank 7 and more, and GPU scatters are up to 2000x "
        "slower (https://github.com/jax-ml/jax/issues/39257, "
        "https://github.com/jax-ml/jax/issues/38806)"
    ),
    (0, 11, 1): (
        "scans that stack their outputs take quadratic time on the CPU "
        "(https://github.com/jax-ml/jax/issues/40101)"
    ),
}
REMEDY = (
    "Install jax 0.10.1 with flax 0.12.8 (Python 3.11), or jax >= 0.11.2 with flax >= 0.12.12 "
    "(Python >= 3.12): pip install -e . picks them."
)


def check_jax_version(version: str | None = None) -> None:
    """Checks that a JAX release is one whose numbers can be trusted.

    Args:
      version: the release, such as "0.10.1"; by default the one that is imported. Development
        and pre-release suffixes are ignored.

    Raises:
      ImportError: the release is older than the oldest supported one, or known to be wrong or
        unusably slow. The message names the release, the reason and what to install.
    """
    if version is None:
        version = jax.__version__
    match = re.match(r"(\d+)\.(\d+)(?:\.(\d+))?", version)
    if match is None:
        raise ImportError(f"cannot read the JAX version {version!r}; expected such as '0.10.1'")
    release = tuple(int(part or 0) for part in match.groups())
    if release < OLDEST:
        reason = f"it needs at least {'.'.join(map(str, OLDEST))}"
    elif release in EXCLUDED:
        reason = EXCLUDED[release]
    else:
        return
    raise ImportError(f"jaxbrush does not run on jax {version}: {reason}. {REMEDY}")


_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of glibc's malloc.h


def keep_memory() -> bool:
    """Has the process keep the memory that it frees, from then on.

    glibc hands blocks above 32 MiB back to the system and is given them again page by page: one
    page fault per 4 KiB of XLA's working memory at every call. Without, a training step takes
    0.65 to 0.9 of the time (2 cores). The process stays as large as it once was.

    Returns:
      Whether the C library could be told; only glibc can.
    """
    try:
        tell = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    # Arenas of other threads hold 64 MiB, and ask the system for larger blocks: one arena for all.
    settings = {_MMAP_THRESHOLD: 2**30, _TRIM_THRESHOLD: 2**31 - 1, _ARENA_MAX: 1}
    return all([tell(name, value) == 1 for name, value in settings.items()])
