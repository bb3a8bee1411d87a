"""The pressure of one stamp, solved by this package, scipy and pyamg on the identical matrix."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments.paint_cases import Setting
from jaxbrush.paint import presets
from jaxbrush.paint.hair import hair
from jaxbrush.paint.solvers import Matrix, residual, solve
from jaxbrush.paint.stencil import near, wide
from jaxbrush.paint.transfer import ride
from jaxbrush.paint.velocity import faces_of, pressure_system, splat, viscous

CHOICES = (
    ("chebyshev", 5), ("chebyshev", 10), ("chebyshev", 20), ("zline_pcg", 5), ("zline_pcg", 8),
    ("zline_pcg", 10), ("jacobi_pcg", 10), ("fixed_point", 10),
)  # fmt: skip


def system_of(setting: Setting, canvas, track, at: int):
    """(Matrix, right-hand side) of the pressure `at` a stamp of a stroke over a canvas."""
    config, params = setting.config, presets.params_of(setting.bristles)
    size = config.window
    node = jnp.swapaxes(track.position[:, -2:], 1, 2)
    middle = np.asarray(jnp.mean(track.position[at, -1, :2], axis=-1)) / config.pixel
    corner = np.round(middle - 0.5 * size)
    x = int(np.clip(corner[0], 0, canvas.shape[3] - size))
    y = int(np.clip(corner[1], 0, canvas.shape[2] - size))
    window = jax.lax.dynamic_slice(
        canvas, (0, 0, y, x), (config.layers, config.pigments, size, size)
    )

    def system(window, before, now, dt):
        offset = config.pixel * jnp.asarray([x, y, 0.0])
        local = lambda n: jnp.swapaxes(n - offset[:, None, None], 0, 1)  # noqa: E731
        points = hair(config, params, local(before), local(now), dt, jnp.ones(now.shape[-1]))
        z, _ = ride(config, params, window, points)
        phi, motion = splat(config, points, z)
        fill = jnp.sum(window, axis=1).reshape(config.layers, -1)
        u, _ = viscous(config, params, fill, phi, motion)
        face = [wide(f, size) for f in faces_of(config, u)]
        return pressure_system(config, params, fill, phi, face)[:2]

    dt = track.time[at] - track.time[at - 1]
    return jax.jit(system)(window, node[at - 1], node[at], dt)


def sparse(matrix: Matrix):
    """The matrix as scipy has it, in double precision, cells in the order (z, y, x)."""
    from scipy.sparse import coo_array

    width, shape = matrix.width, matrix.extra.shape
    link = np.asarray(near(matrix.link, width), np.float64)
    number = np.arange(link.size).reshape(shape)
    diagonal = np.asarray(matrix.extra, np.float64).copy()
    entries = []
    box = (shape[0], shape[1] // width, width)
    for axis, ratio in enumerate((matrix.ratio, 1.0, 1.0)):
        low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        boxed = link.reshape(box)
        c = (ratio * np.minimum(boxed[low], boxed[high])).ravel()
        i, j = number.reshape(box)[low].ravel(), number.reshape(box)[high].ravel()
        np.add.at(diagonal.reshape(-1), i, c)
        np.add.at(diagonal.reshape(-1), j, c)
        keep = c > 0.0
        entries.append((i[keep], j[keep], c[keep]))
    i, j, c = (np.concatenate(e) for e in zip(*entries, strict=True))
    row, column = np.concatenate([i, j, number.ravel()]), np.concatenate([j, i, number.ravel()])
    value = np.concatenate([-c, -c, diagonal.ravel()])
    return coo_array((value, (row, column)), shape=(link.size, link.size)).tocsr()


def best_of(call, rounds: int, now):
    """Least time of warm calls [s], and the result."""
    result, low = call(), np.inf
    for _ in range(rounds):
        start = now()
        result = call()
        low = min(low, now() - start)
    return low, result


def compare_solvers(matrix: Matrix, rhs, rounds: int, now=time.perf_counter) -> list[dict]:
    """Time, residual and error (both relative, 2-norm) of every solver, set-up included."""
    width = matrix.width
    b = np.asarray(rhs, np.float64).ravel()
    rows, exact = [], None

    def add(name, seconds, x):
        a_x = a @ x
        error = np.linalg.norm(x - exact) / np.linalg.norm(exact)
        rows.append({"solver": name, "seconds": seconds, "error": error,
                     "residual": np.linalg.norm(b - a_x) / np.linalg.norm(b)})  # fmt: skip

    from scipy.sparse import linalg

    a = sparse(matrix)
    seconds, exact = best_of(lambda: linalg.spsolve(a.tocsc(), b), 1, now)
    for solver, count in CHOICES:
        run = jax.jit(lambda m, r, s=solver, k=count: solve(s, m, r, k))
        call = lambda run=run: jax.block_until_ready(run(matrix, rhs))  # noqa: E731
        took, x = best_of(call, rounds, now)
        inside = x[..., width:-width]
        # The sparse matrix is the same one.
        ours = float(residual(matrix, inside, rhs)[0])
        add(f"{solver} {count}", took, np.asarray(inside, np.float64).ravel())
        assert abs(rows[-1]["residual"] - ours) < 1e-3 * max(ours, 1e-2)
    add("scipy spsolve", seconds, exact)

    # An incomplete LU is not symmetric, so that CG with it may never get there.
    limit = {"rtol": 0.05, "maxiter": 200}

    def ilu():
        factors = linalg.spilu(a.tocsc(), drop_tol=1e-3, fill_factor=5)
        inverse = linalg.LinearOperator(a.shape, factors.solve)
        return linalg.cg(a, b, M=inverse, **limit)[0]

    add("scipy cg + ILU, to 5 %", *best_of(ilu, rounds, now))
    point = 1.0 / a.diagonal()
    jacobi = linalg.LinearOperator(a.shape, lambda r: point * r)
    add("scipy cg + Jacobi, to 5 %",
        *best_of(lambda: linalg.cg(a, b, M=jacobi, **limit)[0], rounds, now))  # fmt: skip
    try:
        import pyamg
    except ImportError:
        return rows
    whole = lambda: pyamg.ruge_stuben_solver(a).solve(b, tol=0.05, accel="cg")  # noqa: E731
    add("pyamg Ruge-Stüben cg, to 5 %", *best_of(whole, rounds, now))
    made = pyamg.ruge_stuben_solver(a)
    add(
        "the same, set up before",
        *best_of(lambda: made.solve(b, tol=0.05, accel="cg"), rounds, now),
    )
    return rows
