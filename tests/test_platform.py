"""Releases of JAX are refused by name, and the memory of a process is kept where the C library can
be told to."""

import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jaxbrush
from jaxbrush.platform import EXCLUDED, check_jax_version

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


@pytest.mark.parametrize("version", ["0.10.2", "0.11.0", "0.11.1"])
def test_excluded_release_is_refused_with_reason_and_remedy(version, monkeypatch):
    monkeypatch.setattr(jax, "__version__", version)
    with pytest.raises(ImportError) as caught:
        check_jax_version()
    message = str(caught.value)
    assert f"jax {version}:" in message
    assert "https://github.com/jax-ml/jax/issues/" in message
    assert "0.10.1" in message and "0.11.2" in message


@pytest.mark.parametrize("version", ["0.4.38", "0.9.2", "0.10.0"])
def test_release_that_is_too_old_is_refused(version, monkeypatch):
    monkeypatch.setattr(jax, "__version__", version)
    with pytest.raises(ImportError, match=f"{version}: it needs at least 0.10.1"):
        check_jax_version()


@pytest.mark.parametrize("version", ["0.10.1", "0.11.2", "0.12.0.1", "0.12.1", "0.13.0.dev1"])
def test_sound_release_is_accepted(version, monkeypatch):
    monkeypatch.setattr(jax, "__version__", version)
    check_jax_version()


def test_suffix_does_not_hide_an_excluded_release():
    with pytest.raises(ImportError, match="0.10.2"):
        check_jax_version("0.10.2+cuda12")


def test_unreadable_version_is_refused():
    with pytest.raises(ImportError, match="nightly"):
        check_jax_version("nightly")


def test_pyproject_excludes_the_same_releases():
    """The installer and the import check must not drift apart."""
    project = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    line = next(t for t in project.splitlines() if '"jax>=' in t)
    found = {tuple(map(int, part[2:].split("."))) for part in line.strip(' ",').split(",")[1:]}
    assert found == set(EXCLUDED)


def test_package_has_a_version():
    assert jaxbrush.__version__.count(".") == 2
