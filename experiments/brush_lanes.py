"""The brush loops of `brush_numba` blocked by hand, so that the compiler fills vector registers.

A block of `LANES` bristles runs through the whole stroke with its state in the first cache level.
The innermost loop is over lanes, and all rows of lanes live in one buffer at constant places, so
that the compiler sees that they do not overlap.
"""

import numpy as np

from experiments import brush_numba
from experiments.brush_numba import ONE, Z, compiled, coulomb, numba

LANES = 16


def inputs(config, params, pose):
    """Those of `brush_numba.inputs`, the brush in g blocks of rows of lanes (g, 6 + 3 n, l).

    Raises:
      ValueError: when the bristles are not a multiple of `LANES`.
    """
    brush, *rest = brush_numba.inputs(config, params, pose)
    b, rows = brush.shape
    if b % LANES:
        raise ValueError(f"{b} bristles: expected a multiple of {LANES}")
    blocks = brush.reshape(b // LANES, LANES, rows).swapaxes(1, 2)
    return np.ascontiguousarray(blocks), *rest


def arranged(position, force):
    """What a rollout returns in the order of a BristleTrack: (t, k, 3, b) and (t, m, b)."""
    whole = lambda x: np.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)  # noqa: E731
    return whole(position), whole(force)


# Counts of segments, contact nodes, tracked nodes and rows; `make_rollout` compiles with those of
# a config.
N, M, K, ROWS = 11, 1, 3, 0


def _stroke(brush, mu, pivot, sub, origin, rotation, iterations, position, force):
    """One block of `LANES` bristles through all stamps.

    Args:
      brush to iterations: see `inputs`, for one block.
      position: (t, k, 3, l) [mm] and force: (t, m, l) [µN], written.
    """
    memory = np.zeros((ROWS, LANES), np.float32)
    e = memory[0 : 3 * N]
    r = memory[3 * N : 6 * N]
    d = memory[6 * N : 9 * N]
    f = memory[9 * N : 12 * N]
    w = memory[12 * N : 14 * N]
    fold = memory[14 * N : 15 * N]
    inside = memory[15 * N : 16 * N]
    at = 16 * N
    place = memory[at : at + 3 * K]
    point = memory[at + 3 * K : at + 6 * K]
    load = memory[at + 6 * K : at + 9 * K]
    share = memory[at + 9 * K : at + 10 * K]
    to = at + 10 * K
    row = memory[to : to + 9]
    total = memory[to + 9 : to + 18]
    held = memory[to + 18 : to + 21]
    kick = memory[to + 21 : to + 24]
    off = memory[to + 24 : to + 27]
    base = memory[to + 27 : to + 30]
    worst = memory[to + 30 : to + 31]
    own = memory[to + 31 : to + 37 + 3 * N]
    for k in range(6 + 3 * N):
        for q in range(LANES):
            own[k, q] = brush[k, q]

    for t in range(origin.shape[0]):
        for k in range(3):
            a, b, c, o = rotation[t, k, 0], rotation[t, k, 1], rotation[t, k, 2], origin[t, k]
            for q in range(LANES):
                base[k, q] = a * own[0, q] + b * own[1, q] + c * own[2, q] + o
            for i in range(N):
                s = 6 + 3 * i
                for q in range(LANES):
                    x = a * own[s, q] + b * own[s + 1, q] + c * own[s + 2, q]
                    r[3 * i + k, q] = own[3, q] * x
        if t == 0:
            e[:] = r
            _walk(e, base, place)
            point[:] = place
        for _ in range(iterations):
            _walk(e, base, place)
            _residual(e, r, d, f, load, own)
            _choose(place, point, load, share, worst, held, off, inside)
            _compliance(d, f, inside, pivot, sub, fold, row, total)
            _coulomb(total, off, held, own, mu, kick)
            for k in range(3):
                for q in range(LANES):
                    kick[k, q] -= held[k, q]
                for c in range(M):
                    for q in range(LANES):
                        load[3 * c + k, q] += share[c, q] * kick[k, q]
            _turn(e, d, f, w, inside, kick, pivot, sub, fold, row, own)
        _walk(e, base, place)
        # Friction holds the node at the end of the bristle's give.
        point[:] = place
        for c in range(M):
            node = 3 * (K - M + c)
            for k in range(2):
                for q in range(LANES):
                    point[node + k, q] += own[5, q] * load[3 * c + k, q]
        for c in range(K):
            for k in range(3):
                for q in range(LANES):
                    position[t, c, k, q] = place[3 * c + k, q]
        for c in range(M):
            for q in range(LANES):
                force[t, c, q] = load[3 * c + 2, q]


def _walk(e, base, place):
    """Tracked nodes, down the segments from the clamp points."""
    for k in range(3):
        last = 3 * (K - 1) + k
        for q in range(LANES):
            x = Z
            for i in range(N):
                x += e[3 * i + k, q]
            place[last, q] = base[k, q] + x
        for c in range(1, K):
            here = last - 3 * c
            for q in range(LANES):
                place[here, q] = place[here + 3, q] - e[3 * (N - c) + k, q]


def _residual(e, r, d, f, load, own):
    """Contact and bending force over stiffness on the segments, f [mm]; their directions, d."""
    for k in range(3):
        for q in range(LANES):
            bent = e[k, q] - r[k, q]
            f[k, q] = bent + bent
        for i in range(1, N):
            here = 3 * i + k
            for q in range(LANES):
                bent = e[here, q] - r[here, q] - e[here - 3, q] + r[here - 3, q]
                f[here, q] = bent
                f[here - 3, q] -= bent
    for i in range(N):
        for k in range(3):
            here = 3 * i + k
            for q in range(LANES):
                x = Z
                for c in range(max(M - N + i, 0), M):
                    x += load[3 * c + k, q]
                f[here, q] = x / own[4, q] - f[here, q]
                d[here, q] = e[here, q] / own[3, q]


def _choose(place, point, load, share, worst, held, off, inside):
    """The contact that breaks its condition most: its force, place, and the segments above it."""
    worst[:] = Z
    held[:] = Z
    off[:] = Z
    for c in range(M):
        node = 3 * (K - M + c)
        for q in range(LANES):
            gap = place[node + 2, q]
            bad = abs(gap) if load[3 * c + 2, q] > Z else max(-gap, Z)
            share[c, q] = bad + np.float32(1e-9) * np.float32(c)
            worst[0, q] = max(worst[0, q], share[c, q])
    for c in range(M):
        node = 3 * (K - M + c)
        for q in range(LANES):
            g = ONE if share[c, q] >= worst[0, q] else Z
            share[c, q] = g
            held[0, q] += g * load[3 * c, q]
            held[1, q] += g * load[3 * c + 1, q]
            held[2, q] += g * load[3 * c + 2, q]
            off[0, q] += g * (place[node, q] - point[node, q])
            off[1, q] += g * (place[node + 1, q] - point[node + 1, q])
            off[2, q] += g * place[node + 2, q]
    for i in range(N):
        for q in range(LANES):
            g = Z
            for c in range(max(M - N + i, 0), M):
                g += share[c, q]
            inside[i, q] = g


def _compliance(d, f, inside, pivot, sub, fold, row, total):
    """Whitened tangent components of the force, and of the contact's three directions.

    A segment's tangents t_k, k in (x, y), have components delta_ka - fold d_k d_a along a in
    (x, y) and d_k along z; fold: (n, l). row: (7, l), the segment before: five distinct columns
    and the force, by forward substitution. total: (9, l), products summed over the segments: force
    against the directions (3), directions among each other (6). f becomes its components (2).
    """
    total[:] = Z
    row[:] = Z
    for i in range(N):
        p, s = pivot[i], sub[i]
        for q in range(LANES):
            x, y, z, g = d[3 * i, q], d[3 * i + 1, q], d[3 * i + 2, q], inside[i, q]
            turn = ONE / max(ONE - z, np.float32(1e-3))
            fold[i, q] = turn
            mixed = f[3 * i + 2, q] - turn * (x * f[3 * i, q] + y * f[3 * i + 1, q])
            u = f[3 * i, q] + x * mixed
            v = f[3 * i + 1, q] + y * mixed
            f[3 * i, q], f[3 * i + 1, q] = u, v
            u = (u - s * row[5, q]) * p
            v = (v - s * row[6, q]) * p
            xx = ((ONE - turn * x * x) * g - s * row[0, q]) * p
            xy = (-turn * x * y * g - s * row[1, q]) * p
            yy = ((ONE - turn * y * y) * g - s * row[2, q]) * p
            xz = (x * g - s * row[3, q]) * p
            yz = (y * g - s * row[4, q]) * p
            row[0, q], row[1, q], row[2, q] = xx, xy, yy
            row[3, q], row[4, q], row[5, q], row[6, q] = xz, yz, u, v
            total[0, q] += xx * u + xy * v
            total[1, q] += xy * u + yy * v
            total[2, q] += xz * u + yz * v
            total[3, q] += xx * xx + xy * xy
            total[4, q] += xx * xy + xy * yy
            total[5, q] += xx * xz + xy * yz
            total[6, q] += xy * xy + yy * yy
            total[7, q] += xy * xz + yy * yz
            total[8, q] += xz * xz + yz * yz


def _coulomb(total, off, held, own, mu, out):
    """Contact with friction as `jaxbrush.brush.contact.coulomb`; out: (3, l) force [µN]."""
    for q in range(LANES):
        k = ONE / own[4, q]
        out[0, q], out[1, q], out[2, q] = coulomb(
            total[3, q] * k, total[4, q] * k, total[5, q] * k,
            total[6, q] * k, total[7, q] * k, total[8, q] * k,
            off[0, q] + total[0, q], off[1, q] + total[1, q], off[2, q] + total[2, q],
            held[0, q], held[1, q], held[2, q], own[5, q], mu,
        )  # fmt: skip


def _turn(e, d, f, w, inside, kick, pivot, sub, fold, row, own):
    """Segments turned by the inverse bending matrix times the tangent force, length kept."""
    row[:] = Z
    for i in range(N):
        p, s = pivot[i], sub[i]
        for q in range(LANES):
            x, y, g = d[3 * i, q], d[3 * i + 1, q], inside[i, q] / own[4, q]
            mixed = kick[2, q] - fold[i, q] * (x * kick[0, q] + y * kick[1, q])
            u = (f[3 * i, q] + g * (kick[0, q] + x * mixed) - s * row[0, q]) * p
            v = (f[3 * i + 1, q] + g * (kick[1, q] + y * mixed) - s * row[1, q]) * p
            row[0, q], row[1, q] = u, v
            w[2 * i, q], w[2 * i + 1, q] = u, v
    row[:] = Z
    s = Z
    for j in range(N):
        i = N - 1 - j
        p = pivot[i]
        for q in range(LANES):
            x, y = d[3 * i, q], d[3 * i + 1, q]
            u = (w[2 * i, q] - s * row[0, q]) * p
            v = (w[2 * i + 1, q] - s * row[1, q]) * p
            row[0, q], row[1, q] = u, v
            lift = x * u + y * v
            ex = e[3 * i, q] + u - x * fold[i, q] * lift
            ey = e[3 * i + 1, q] + v - y * fold[i, q] * lift
            ez = e[3 * i + 2, q] + lift
            scale = own[3, q] / np.sqrt(ex * ex + ey * ey + ez * ez + np.float32(1e-20))
            e[3 * i, q], e[3 * i + 1, q], e[3 * i + 2, q] = ex * scale, ey * scale, ez * scale
        s = sub[i]


def make_rollout(config, parallel: bool = False):
    """Compiles the loops for the counts of a BrushConfig.

    Args:
      config: counts of nodes. parallel: spreads the blocks of bristles over cores.

    Returns:
      f(*inputs) -> position (g, t, k, 3, l) [mm] of the tracked nodes, force (g, t, m, l) [µN] of
      the contact nodes, of g blocks of l lanes; None without numba.
    """
    if numba is None:
        return None
    n, m = config.segments, config.contact_nodes
    tracked = config.tracked_nodes
    scope = {
        "np": np, "LANES": LANES, "N": n, "M": m, "K": tracked, "Z": Z, "ONE": ONE,
        "coulomb": coulomb, "ROWS": 19 * n + 10 * tracked + 37,
    }  # fmt: skip
    # Inlined, so that the compiler knows where each row lies.
    for part in (_walk, _residual, _choose, _compliance, _coulomb, _turn):
        name = part.__name__
        scope[name] = compiled(inline="always")(type(part)(part.__code__, scope, name))
    stroke = compiled()(type(_stroke)(_stroke.__code__, scope, "stroke"))
    span = numba.prange if parallel else range

    def rollout(brush, mu, pivot, sub, origin, rotation, iterations):
        blocks, t = brush.shape[0], origin.shape[0]
        position = np.empty((blocks, t, tracked, 3, LANES), np.float32)
        force = np.empty((blocks, t, m, LANES), np.float32)
        for g in span(blocks):
            stroke(brush[g], mu, pivot, sub, origin, rotation, iterations, position[g], force[g])
        return position, force

    return compiled(parallel=parallel)(rollout)
