"""The same brush as plain loops: the quasi-static projective step of `jaxbrush`, in numba.

A peer to measure against, written the way one first writes it: for each bristle, for each stamp,
for each segment. Bristles are independent given the handle's path. The inverse factor of the
bending matrix is applied by substitution, 4 operations a segment instead of a row of a matrix.
`brush_lanes` is the same blocked by hand; both share the friction here.
"""

import numpy as np

try:
    import numba
except ImportError:
    numba = None

# float32 like jaxbrush: a bare 0.0 would make the loops double.
Z, ONE, TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-12)


def compiled(**options):
    """numba.njit with sums reordered at will and no checks of division; nothing without numba."""
    if numba is None:
        return lambda function: function
    return numba.njit(fastmath=True, error_model="numpy", **options)


def inputs(config, params, pose):
    """Arrays for the loops, from a brush and its handle poses (leading axis t), as float32.

    Args:
      config: BrushConfig. params: BrushParams of b bristles.
      pose: Pose with t steps, approach included.

    Returns:
      The arguments of the functions made by `make_rollout`: the brush (b, 6 + 3 n), a row the
      clamp point (3), segment length, EI / l0^3, compliance along the bristle, rest directions
      (n, 3); friction; pivots and subdiagonal of the factor (n,); origin (t, 3);
      rotation (t, 3, 3); iterations.
    """
    n, b = config.segments, params.length.shape[0]
    column = lambda x: np.asarray(x, np.float32)[:, None]  # noqa: E731
    brush = np.concatenate(
        [
            np.asarray(params.root, np.float32).T,
            column(params.segment_length(n)),
            column(params.bending_stiffness(n)),
            column(n / params.stretch_stiffness(n)),
            np.asarray(params.rest, np.float32).reshape(3 * n, b).T,
        ],
        axis=1,
    )
    difference = np.eye(n) - np.eye(n, k=-1)
    weight = np.append(2.0, np.ones(n - 1))
    factor = np.linalg.cholesky(difference.T @ (weight[:, None] * difference))
    single = lambda x: np.ascontiguousarray(np.asarray(x), np.float32)  # noqa: E731
    return (
        single(brush),
        np.float32(params.friction),
        single(1.0 / np.diag(factor)),
        single(np.append(0.0, np.diag(factor, -1))),
        single(pose.origin),
        single(pose.rotation),
        config.iterations,
    )


@compiled(inline="always")
def newton(axx, axy, ayy, bx, by, shift, low, radius):
    """The multiplier |u| / |F| of the slip after one step, see `jaxbrush.brush.contact`."""
    ax, ay = axx + shift, ayy + shift
    inv = ONE / (ax * ay + low)
    gx, gy = -(ay * bx - axy * by) * inv, -(ax * by - axy * bx) * inv
    square = gx * gx + gy * gy + TINY
    slope = (gx * (ay * gx - axy * gy) + gy * (ax * gy - axy * gx)) * inv
    slope = max(slope, square / (axx + ayy + shift))
    step = square / slope * (np.sqrt(square) / radius - ONE)
    return max(shift + step, Z)


@compiled(inline="always")
def coulomb(xx, xy, xz, yy, yz, zz, sx, sy, sz, fx, fy, fz, soft, mu):
    """Contact with friction as `jaxbrush.brush.contact.coulomb`, without branches.

    Args:
      xx to zz: compliance without the axial one, `soft` [mm/µN]. sx, sy, sz: where the tip goes
        if its force stays fx, fy, fz [mm]. mu: friction.

    Returns:
      (x, y, z) force [µN].
    """
    sx -= xx * fx + xy * fy + xz * fz
    sy -= xy * fx + yy * fy + yz * fz
    sz -= xz * fx + yz * fy + zz * fz
    xx, yy, zz = xx + soft, yy + soft, zz + soft
    jam = np.float32(0.1) * zz
    inverse = ONE / zz
    axx, axy, ayy = xx - xz * xz * inverse, xy - xz * yz * inverse, yy - yz * yz * inverse
    bx, by = sx - xz * sz * inverse, sy - yz * sz * inverse
    low = TINY * xx * yy
    det = ONE / max(axx * ayy - axy * axy, low)
    hx, hy = -(ayy * bx - axy * by) * det, -(axx * by - axy * bx) * det
    hz = -(sz + xz * hx + yz * hy) * inverse
    limit = mu * hz
    stick = (hx * hx + hy * hy <= limit * limit) & (hz > Z)
    drift = np.sqrt(bx * bx + by * by + TINY)
    last = np.sqrt(fx * fx + fy * fy + TINY)
    was = last > np.float32(1e-5)
    tx = fx / last if was else -bx / drift
    ty = fy / last if was else -by / drift
    deep = max(-sz, Z)
    radius = max(mu * deep / max(zz + mu * (xz * tx + yz * ty), jam), np.float32(1e-6))
    shift = max(drift / radius - (axx + ayy), Z)
    low = low - axy * axy
    shift = newton(axx, axy, ayy, bx, by, shift, low, radius)
    shift = newton(axx, axy, ayy, bx, by, shift, low, radius)
    shift = newton(axx, axy, ayy, bx, by, shift, low, radius)
    ax, ay = axx + shift, ayy + shift
    inv = ONE / (ax * ay + low)
    gx, gy = -(ay * bx - axy * by) * inv, -(ax * by - axy * bx) * inv
    norm = np.sqrt(gx * gx + gy * gy + TINY)
    tx, ty = gx / norm, gy / norm
    z = deep / max(zz + mu * (xz * tx + yz * ty), jam)
    x = (hx if stick else mu * z * tx) if sz < Z else Z
    y = (hy if stick else mu * z * ty) if sz < Z else Z
    z = (hz if stick else z) if sz < Z else Z
    return x, y, z


@compiled()
def _walk(e, base, place):
    """Tracked nodes (k, 3), the last of them the tip, down the segments from the clamp point."""
    n, tracked = e.shape[0], place.shape[0]
    for k in range(3):
        x = base[k]
        for i in range(n):
            x += e[i, k]
            if i >= n - tracked:
                place[i - n + tracked, k] = x


@compiled()
def _worst(place, load):
    """The contact node that breaks its condition most, the tip on a draw; counts from 0."""
    above = place.shape[0] - load.shape[0]
    worst, most = 0, -ONE
    for c in range(load.shape[0]):
        gap = place[above + c, 2]
        bad = abs(gap) if load[c, 2] > Z else max(-gap, Z)
        if bad >= most:
            worst, most = c, bad
    return worst


@compiled()
def _residual(e, r, load, stiffness, f):
    """Contact and bending force over stiffness on the segments, f (n, 3) [mm]."""
    n, m = e.shape[0], load.shape[0]
    for k in range(3):
        pull = Z
        for i in range(n - 1, -1, -1):
            if i > n - 1 - m:
                pull += load[i - n + m, k]
            f[i, k] = pull / stiffness
        before = -(e[0, k] - r[0, k])
        for i in range(n):
            bent = e[i, k] - r[i, k]
            f[i, k] -= bent - before
            if i > 0:
                f[i - 1, k] += bent - before
            before = bent


@compiled()
def _solve(e, f, reach, length, stiffness, soft, pivot, sub, mu, away, force, w, fold):
    """The force on the contact below the first `reach` segments, and the segments turned by it.

    A segment's tangents t_k, k in (x, y), have components delta_ka - fold d_k d_a along a in
    (x, y) and d_k along z. Forward substitution whitens the force on them and the contact's
    directions; products of both are the compliance.
    """
    n = e.shape[0]
    xx = xy = xz = yy = yz = zz = mx = my = mz = Z
    ax = ay = by = cx = cy = u = v = Z
    for i in range(n):
        x, y, z = e[i, 0] / length, e[i, 1] / length, e[i, 2] / length
        turn = ONE / max(ONE - z, np.float32(1e-3))
        fold[i] = turn
        mixed = f[i, 2] - turn * (x * f[i, 0] + y * f[i, 1])
        f[i, 0] += x * mixed
        f[i, 1] += y * mixed
        p, s = pivot[i], sub[i]
        g = ONE if i < reach else Z
        u, v = (f[i, 0] - s * u) * p, (f[i, 1] - s * v) * p
        ax, ay = ((ONE - turn * x * x) * g - s * ax) * p, (-turn * x * y * g - s * ay) * p
        by = ((ONE - turn * y * y) * g - s * by) * p  # and bx is ay
        cx, cy = (x * g - s * cx) * p, (y * g - s * cy) * p
        mx, my, mz = mx + ax * u + ay * v, my + ay * u + by * v, mz + cx * u + cy * v
        xx, xy, xz = xx + ax * ax + ay * ay, xy + ax * ay + ay * by, xz + ax * cx + ay * cy
        yy, yz, zz = yy + ay * ay + by * by, yz + ay * cx + by * cy, zz + cx * cx + cy * cy

    k = ONE / stiffness
    fx, fy, fz = force
    new = coulomb(
        xx * k, xy * k, xz * k, yy * k, yz * k, zz * k,
        away[0] + mx, away[1] + my, away[2] + mz, fx, fy, fz, soft, mu,
    )  # fmt: skip
    kx, ky, kz = (new[0] - fx) * k, (new[1] - fy) * k, (new[2] - fz) * k
    u = v = Z
    for i in range(n):
        x, y = e[i, 0] / length, e[i, 1] / length
        g = ONE if i < reach else Z
        mixed = kz - fold[i] * (x * kx + y * ky)
        u = (f[i, 0] + g * (kx + x * mixed) - sub[i] * u) * pivot[i]
        v = (f[i, 1] + g * (ky + y * mixed) - sub[i] * v) * pivot[i]
        w[i, 0], w[i, 1] = u, v
    u = v = s = Z
    for i in range(n - 1, -1, -1):
        x, y = e[i, 0] / length, e[i, 1] / length
        u, v = (w[i, 0] - s * u) * pivot[i], (w[i, 1] - s * v) * pivot[i]
        s = sub[i]
        lift = x * u + y * v
        ex, ey = e[i, 0] + u - x * fold[i] * lift, e[i, 1] + v - y * fold[i] * lift
        ez = e[i, 2] + lift
        scale = length / np.sqrt(ex * ex + ey * ey + ez * ez + np.float32(1e-20))
        e[i, 0], e[i, 1], e[i, 2] = ex * scale, ey * scale, ez * scale
    return new


@compiled()
def _stroke(own, mu, pivot, sub, origin, rotation, iterations, position, force):
    """One bristle through all stamps; fills position (t, k, 3) [mm] and force (t, m) [µN]."""
    n, tracked, m = pivot.shape[0], position.shape[1], force.shape[1]
    above = tracked - m
    length, stiffness, soft = own[3], own[4], own[5]
    rest = own[6:].reshape(n, 3)
    e, r = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    f, w = np.zeros((n, 3), np.float32), np.zeros((n, 2), np.float32)
    fold, base, away = np.zeros(n, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32)
    load, point = np.zeros((m, 3), np.float32), np.zeros((m, 3), np.float32)
    for t in range(origin.shape[0]):
        place = position[t]
        for k in range(3):
            a, b, c = rotation[t, k, 0], rotation[t, k, 1], rotation[t, k, 2]
            base[k] = a * own[0] + b * own[1] + c * own[2] + origin[t, k]
            for i in range(n):
                r[i, k] = length * (a * rest[i, 0] + b * rest[i, 1] + c * rest[i, 2])
        if t == 0:
            e[:] = r
            _walk(e, base, place)
            point[:] = place[above:]
        for _ in range(iterations):
            _walk(e, base, place)
            c = _worst(place, load)
            for k in range(3):
                away[k] = place[above + c, k] - point[c, k]
            away[2] = place[above + c, 2]
            _residual(e, r, load, stiffness, f)
            held = (load[c, 0], load[c, 1], load[c, 2])
            reach = n - m + c + 1
            load[c] = _solve(
                e, f, reach, length, stiffness, soft, pivot, sub, mu, away, held, w, fold
            )
        _walk(e, base, place)
        for c in range(m):
            # Friction holds the node at the end of the bristle's give.
            point[c, 0] = place[above + c, 0] + soft * load[c, 0]
            point[c, 1] = place[above + c, 1] + soft * load[c, 1]
            force[t, c] = load[c, 2]


def make_rollout(config, parallel: bool = False):
    """Compiles the loops; `parallel` spreads the bristles over cores.

    Returns:
      f(*inputs) -> position (b, t, k, 3) [mm] of the tracked nodes, force (b, t, m) [µN] of the
      contact nodes; None without numba.
    """
    if numba is None:
        return None
    tracked, m = config.tracked_nodes, config.contact_nodes
    span = numba.prange if parallel else range

    def rollout(brush, mu, pivot, sub, origin, rotation, iterations):
        bristles, t = brush.shape[0], origin.shape[0]
        position = np.empty((bristles, t, tracked, 3), np.float32)
        force = np.empty((bristles, t, m), np.float32)
        for b in span(bristles):
            _stroke(brush[b], mu, pivot, sub, origin, rotation, iterations, position[b], force[b])
        return position, force

    return compiled(parallel=parallel)(rollout)


def arranged(position, force):
    """What a rollout returns in the order of a BristleTrack: (t, k, 3, b) and (t, m, b)."""
    return np.moveaxis(position, 0, -1), np.moveaxis(force, 0, -1)
