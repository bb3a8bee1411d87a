"""The memory of a process is kept where the C library can be told to."""

import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import jax, jax.numpy as jnp
from jaxbrush.platform import keep_memory

if sys.argv[1] == "keep" and not keep_memory():
    sys.exit(3)

@jax.jit
def work(x):  # needs 128 MiB between
    return jnp.cumsum(x @ x.T, axis=0)[-1]

x = jnp.ones((4096, 16))
count = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
each = []
for _ in range(25):  # the first ones find their place
    before = count()
    work(x).block_until_ready()
    each.append(count() - before)
print(sorted(each[10:])[7])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="another C library")
def test_memory_that_is_kept_is_not_faulted_in_anew():
    def faults(how):
        done = subprocess.run(
            [sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=False
        )
        if done.returncode == 3:
            pytest.skip("another C library than glibc")
        assert done.returncode == 0, done.stderr
        return float(done.stdout)

    given_back, kept = faults("give back"), faults("keep")
    print(f"page faults a call: {given_back:.0f}, kept {kept:.0f}")
    assert given_back > 4000.0  # the naive way: at least 16 MiB anew at every call
    assert kept < 0.1 * given_back
