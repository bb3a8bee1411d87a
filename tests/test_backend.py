"""Known wrong results of XLA, each as a test that compares jit with NumPy and with op-by-op.

A failure here means that no number of this environment can be trusted, so it is worth more
than any other test: run this file first on a new JAX release or a new device. Where a defect
is still open in the releases we support, the naive spelling is an expected failure that
documents it, and the spelling that the house rules ask for must pass.
"""

import ast
import functools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

ROOT = Path(__file__).parents[1]
SOURCES = sorted([*ROOT.glob("jaxbrush/**/*.py"), *ROOT.glob("experiments/**/*.py")])


def assert_right(function: Callable, expected: np.ndarray, *args: jax.Array) -> None:
    """Asserts that op-by-op and compiled results both equal `expected` bit for bit."""
    np.testing.assert_array_equal(np.asarray(function(*args)), expected, err_msg="op-by-op")
    np.testing.assert_array_equal(np.asarray(jax.jit(function)(*args)), expected, err_msg="jit")


# --- mat-vec and reduction (jax#39103, wrong in 0.10.2) ------------------------------------


def sums_of_squares(matrix: jax.Array, rows: jax.Array) -> jax.Array:
    def one(row):
        return jnp.sum(jnp.square(jnp.matmul(matrix, row, precision=lax.Precision.HIGHEST)))

    return jax.vmap(one)(rows)


def rows_along_x(count: int, dtype: type) -> np.ndarray:
    rows = np.zeros((count, 3), dtype)
    rows[:, 0] = np.arange(count)
    return rows


def test_small_matvec_with_reduction_f32():
    rows = rows_along_x(32_769, np.float32)
    expected = np.square(rows[:, 0])
    assert expected[-1] == 1_073_741_824
    assert_right(sums_of_squares, expected, jnp.eye(3, dtype=jnp.float32), jnp.asarray(rows))


def test_small_matvec_with_reduction_f64(x64):
    rows = rows_along_x(16_385, np.float64)
    expected = np.square(rows[:, 0])
    assert expected[-1] == 268_435_456
    assert_right(sums_of_squares, expected, jnp.eye(3, dtype=jnp.float64), jnp.asarray(rows))


# --- shifting an array (openxla/xla#49176, open) -------------------------------------------


def shift_by_set(x: jax.Array) -> jax.Array:
    return x.at[1:].set(x[:-1])


def shift_by_concatenate(x: jax.Array) -> jax.Array:
    return jnp.concatenate([x[:1], x[:-1]])


def shift_by_pad(x: jax.Array) -> jax.Array:
    return jnp.pad(x[:-1], ((1, 0),) + ((0, 0),) * (x.ndim - 1), mode="edge")


def shift_by_lax_pad(x: jax.Array) -> jax.Array:
    """Zero enters from the left; the first row is put back."""
    zero = jnp.zeros((), x.dtype)
    shifted = lax.pad(x, zero, [(1, -1, 0)] + [(0, 0, 0)] * (x.ndim - 1))
    first = lax.broadcasted_iota(jnp.int32, x.shape, 0) == 0
    return jnp.where(first, x, shifted)


def shift_by_roll(x: jax.Array) -> jax.Array:
    first = lax.broadcasted_iota(jnp.int32, x.shape, 0) == 0
    return jnp.where(first, x, jnp.roll(x, 1, axis=0))


SAFE_SHIFTS = [shift_by_concatenate, shift_by_pad, shift_by_lax_pad, shift_by_roll]


def shift_and_reshape(shift: Callable, x: jax.Array) -> jax.Array:
    y = shift(x + jnp.ones((), x.dtype))
    return y.reshape((1, *y.shape))


def shift_case(dtype: str) -> tuple[jax.Array, np.ndarray]:
    x = np.arange(128, dtype=dtype).reshape(8, 16)
    y = x + np.ones((), dtype)
    return jnp.asarray(x), np.concatenate([y[:1], y[:-1]])[None]


@pytest.mark.xfail(
    strict=False, reason="open: https://github.com/openxla/xla/issues/49176, wrong on the CPU"
)
@pytest.mark.parametrize("dtype", ["int32", "float32"])
def test_naive_shift_then_reshape(dtype):
    x, expected = shift_case(dtype)
    assert_right(functools.partial(shift_and_reshape, shift_by_set), expected, x)


@pytest.mark.parametrize("dtype", ["int32", "float32"])
@pytest.mark.parametrize("shift", SAFE_SHIFTS)
def test_safe_shift_then_reshape(shift, dtype):
    x, expected = shift_case(dtype)
    assert_right(functools.partial(shift_and_reshape, shift), expected, x)


@pytest.mark.parametrize("shift", SAFE_SHIFTS)
def test_safe_shift_inside_scan(shift):
    """The way a simulator shifts: repeatedly, on a carry that XLA may update in place."""

    def run(x):
        def body(carry, _):
            carry = shift(carry + jnp.ones((), carry.dtype))
            return carry, carry.reshape(-1)

        return lax.scan(body, x, length=3)[1]

    x = np.arange(24, dtype=np.int32).reshape(6, 4)
    expected, y = [], x
    for _ in range(3):
        y = np.concatenate([y[:1], y[:-1]]) + 1
        expected.append(y.reshape(-1))
    assert_right(run, np.stack(expected), jnp.asarray(x))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_safe_shift_of_packed_nodes(axis):
    """Differences along each axis of a (component, node, bristle) array, then a reshape."""

    def run(x):
        x = x * jnp.float32(2)
        ahead = lax.slice_in_dim(x, 1, None, axis=axis)
        behind = lax.slice_in_dim(x, 0, -1, axis=axis)
        padding = [(1, 0) if i == axis else (0, 0) for i in range(3)]
        return jnp.pad(ahead - behind, padding).reshape(-1)

    x = np.arange(3 * 12 * 32, dtype=np.float32).reshape(3, 12, 32) ** 2 % 97
    padding = [(1, 0) if i == axis else (0, 0) for i in range(3)]
    expected = np.pad(np.diff(2 * x, axis=axis), padding).reshape(-1)
    assert_right(run, expected, jnp.asarray(x))


def updates(tree: ast.AST) -> Iterator[tuple[int, ast.expr, str, list[ast.expr]]]:
    """Yields (line, array, where it is written, what is written) of each slice update."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        target, method = node.func.value, node.func.attr
        if (
            isinstance(target, ast.Subscript)
            and isinstance(target.value, ast.Attribute)
            and target.value.attr == "at"
            and method in {"set", "add", "subtract", "multiply", "mul", "divide", "min", "max"}
        ):
            if any(isinstance(part, ast.Slice) for part in ast.walk(target.slice)):
                written = [*node.args, *(k.value for k in node.keywords)]
                yield node.lineno, target.value.value, ast.unparse(target.slice), written
        elif method.startswith("dynamic_update") and len(node.args) >= 2:
            yield node.lineno, node.args[0], "", [node.args[1]]


def self_shifts(source: str) -> list[int]:
    """Returns the lines where a slice of an array is set from another slice of that array.

    Names are looked through: `y = x[:-1]; x.at[1:].set(y)` is found as well.
    """
    tree = ast.parse(source)
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.Lambda)]
    lines = set()
    for scope in [tree, *functions]:
        assigned: dict[str, list[ast.expr]] = {}
        for node in ast.walk(scope):
            if isinstance(node, ast.Assign):
                for name in node.targets:
                    if isinstance(name, ast.Name):
                        assigned.setdefault(name.id, []).append(node.value)
        for line, array, where, written in updates(scope):
            base, seen, queue = ast.unparse(array), set(), list(written)
            while queue:
                for node in ast.walk(queue.pop()):
                    if isinstance(node, ast.Subscript) and ast.unparse(node.value) == base:
                        if ast.unparse(node.slice) != where:
                            lines.add(line)
                    elif isinstance(node, ast.Name) and node.id not in seen:
                        seen.add(node.id)
                        if node.id != base:
                            queue += assigned.get(node.id, [])
    return sorted(lines)


@pytest.mark.parametrize(
    "snippet",
    [
        "x = x.at[1:].set(x[:-1])",
        "x.at[:, 1:].add(2.0 * x[:, :-1])",
        "s.position.at[1:].set(s.position[:-1] + d)",
        "def f(x):\n    y = x[:-1]\n    return x.at[1:].set(y)",
        "lax.dynamic_update_slice(x, x[:3], (1, 0))",
        "lax.dynamic_update_slice_in_dim(x, x[1:], 0, axis=0)",
    ],
)
def test_self_shift_is_found(snippet):
    assert self_shifts(snippet)


@pytest.mark.parametrize(
    "snippet",
    [
        "x = x.at[1:].set(y[:-1])",
        "x = x.at[1:3].set(2.0 * x[1:3])",
        "x = x.at[ids].add(x[0])",
        "x = jnp.concatenate([x[:1], x[:-1]])",
        "a[1:].set(a[:-1])",
    ],
)
def test_other_updates_are_not_mistaken_for_self_shifts(snippet):
    assert not self_shifts(snippet)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_source_shifts_no_array_by_setting_it_from_itself(path):
    lines = self_shifts(path.read_text())
    assert not lines, f"{path}:{lines}: use pad, roll or concatenate (openxla/xla#49176)"


# --- windows that reach past the end (openxla/xla#49121, jax#40849) ------------------------


def slice_of_slice(x: jax.Array, outer: jax.Array, inner: jax.Array) -> jax.Array:
    return lax.dynamic_slice(lax.dynamic_slice(x, (outer,), (4,)), (inner,), (1,))


def clipped_slice_of_slice(x: jax.Array, outer: jax.Array, inner: jax.Array) -> jax.Array:
    outer = jnp.clip(outer, 0, x.shape[0] - 4)
    inner = jnp.clip(inner, 0, 4 - 1)
    return slice_of_slice(x, outer, inner)


def slice_of_roll(x: jax.Array, shift: jax.Array, start: jax.Array) -> jax.Array:
    return lax.dynamic_slice(jnp.roll(x, shift), (start,), (4,))


def clipped_slice_of_roll(x: jax.Array, shift: jax.Array, start: jax.Array) -> jax.Array:
    return slice_of_roll(x, shift, jnp.clip(start, 0, x.shape[0] - 4))


SLICE_STARTS = [(9, 0), (9, 3), (9, 9), (-3, 0), (0, 7), (6, 2)]
ROLL_STARTS = [(4, 12), (4, 5), (4, 6), (0, 12), (-2, 100), (4, 0), (7, -1)]


def check_window(window, expected, x, first, second, traced=True):
    if traced:
        assert_right(window, expected, jnp.asarray(x), jnp.int32(first), jnp.int32(second))
    else:
        assert_right(lambda x: window(x, first, second), expected, jnp.asarray(x))


@pytest.mark.parametrize("traced", [True, False], ids=["traced", "constant"])
@pytest.mark.parametrize(("outer", "inner"), SLICE_STARTS)
def test_slice_of_slice_with_explicit_clip(outer, inner, traced):
    x = np.arange(10, dtype=np.int32)
    first = np.clip(outer, 0, 6) + np.clip(inner, 0, 3)
    check_window(clipped_slice_of_slice, x[first : first + 1], x, outer, inner, traced)


@pytest.mark.parametrize("traced", [True, False], ids=["traced", "constant"])
@pytest.mark.parametrize(("shift", "start"), ROLL_STARTS)
def test_slice_of_roll_with_explicit_clip(shift, start, traced):
    x = 10 * np.arange(9, dtype=np.int32)
    first = np.clip(start, 0, 5)
    check_window(
        clipped_slice_of_roll, np.roll(x, shift)[first : first + 4], x, shift, start, traced
    )


IMPLICIT = pytest.mark.xfail(
    strict=False,
    reason="https://github.com/openxla/xla/issues/49121: wrong in 0.10.x and 0.11.x",
)


@IMPLICIT
def test_slice_of_slice_with_implicit_clamp():
    check_window(slice_of_slice, np.asarray([6], np.int32), np.arange(10, dtype=np.int32), 9, 0)


@IMPLICIT
def test_slice_of_roll_with_implicit_clamp():
    expected = np.asarray([10, 20, 30, 40], np.int32)
    check_window(slice_of_roll, expected, 10 * np.arange(9, dtype=np.int32), 4, 12)


@pytest.mark.parametrize("start", [0, 3, 12, 13, 99])
def test_window_is_read_changed_and_written_back(start):
    """How the paint simulator works: a window that follows the brush, over several steps."""

    def run(x, start):
        def body(x, step):
            origin = jnp.clip(start + step, 0, x.shape[0] - 4)
            window = lax.dynamic_slice(x, (origin,), (4,))
            window = window + jnp.pad(window[:-1], (1, 0))
            return lax.dynamic_update_slice(x, window, (origin,)), None

        return lax.scan(body, x, jnp.arange(5, dtype=jnp.int32))[0]

    x = np.arange(16, dtype=np.int32)
    expected = x.copy()
    for step in range(5):
        origin = np.clip(start + step, 0, 12)
        window = expected[origin : origin + 4].copy()
        expected[origin : origin + 4] = window + np.pad(window[:-1], (1, 0))
    assert_right(run, expected, jnp.asarray(x), jnp.int32(start))


# --- speed and rank ------------------------------------------------------------------------


def test_stacked_scan_takes_linear_time():
    """0.11.1 rewrites the whole stack at each step, on the CPU (jax#40101)."""
    steps = 100_000

    @jax.jit
    def run(x):
        def body(carry, _):
            carry = carry * jnp.float32(0.999)
            return carry, carry

        return lax.scan(body, x, length=steps)[1]

    def seconds(x):
        start = time.perf_counter()
        run(x).block_until_ready()
        return time.perf_counter() - start

    x = jax.device_put(jnp.float32(1), jax.local_devices(backend="cpu")[0])
    first_call = run(x)
    assert first_call.shape == (steps,)
    fastest = min(seconds(x) for _ in range(3))
    assert fastest < 0.25, f"{steps} steps took {fastest:.2f} s; about 0.001 s is normal"


@pytest.mark.parametrize("rank", [1, 2, 3, 4, 5, 6])
def test_multiply_and_reduce_up_to_rank_six(rank):
    """Rank 7 and more crashes or hangs in 0.10.2 and 0.11.0 (jax#39257): we stop at six."""
    shape = (2, 3, 2, 3, 2, 3)[:rank]
    x = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)

    def run(x, y):
        return jnp.sum(x * y, axis=tuple(range(1, rank)))

    expected = np.sum(x * (x + 1), axis=tuple(range(1, rank)))
    assert_right(run, expected, jnp.asarray(x), jnp.asarray(x + 1))


KEPT = """
import experiments, jax, zlib
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
from jaxbrush import BrushConfig, make_brush, random_stroke, resample, rollout
config = BrushConfig(nodes=4)
brush = make_brush(jax.random.key(0), config, "flat", 8)
stroke = resample(random_stroke(jax.random.key(1)), 32, 0.25, 0.01)
track = jax.jit(rollout)(config, brush, stroke)
print(zlib.crc32(track.position.tobytes()), zlib.crc32(track.force.tobytes()))
"""


def test_kept_functions_compute_the_same_bits(tmp_path):
    """Experiments keep what they have compiled (experiments/__init__.py)."""
    root = str(Path(__file__).parents[1])
    ours = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "TF_CPP"))}
    runs = [
        subprocess.run(
            [sys.executable, "-c", KEPT],
            cwd=tmp_path,
            env=ours | {"PYTHONPATH": root},
            capture_output=True,
            text=True,
            timeout=300,
        )  # fmt: skip
        for _ in range(2)
    ]
    for run in runs:
        assert run.returncode == 0 and run.stderr == "", run.stderr
    assert runs[0].stdout == runs[1].stdout
    (kept,) = (tmp_path / "results" / ".compiled").iterdir()
    assert sum(path.name.endswith("-cache") for path in kept.iterdir()) > 5
