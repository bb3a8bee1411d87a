"""Every error measure, once.

All take pictures of one pair, arrays (h, w) or (h, w, c), and a mask (h, w) or (h, w, 1), weights
at least 0; no mask means all pixels. An empty mask gives 0, never NaN. Networks see [-1, 1]
("network scale"); the same error on [0, 1] ("image scale") is half of it.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush import render

HULL_TOLERANCE = 1.0 / 255.0
_WHITE = np.array([0.95047, 1.0, 1.08883])  # D65
_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375],
     [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip


def weighted_mean(values, mask=None):
    """Mean of (h, w) or (h, w, c) where the mask is, over channels too; 0 where it is empty."""
    if mask is None:
        return jnp.mean(values)
    mask = mask.reshape(values.shape[:2] + (1,) * (values.ndim - 2)).astype(values.dtype)
    count = jnp.sum(mask) * (values.size // (values.shape[0] * values.shape[1]))
    return jnp.sum(mask * values) / jnp.where(count > 0.0, count, 1.0)


def image_scale(x):
    """Network scale [-1, 1] to image scale [0, 1]."""
    return 0.5 * (x + 1.0)


def rmse(found, true, mask=None):
    """Root of the mean square difference, in the scale of the arguments."""
    square = weighted_mean(jnp.square(found - true), mask)
    # The slope at 0 is 0 rather than NaN.
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def mae(found, true, mask=None):
    """Mean absolute difference."""
    return weighted_mean(jnp.abs(found - true), mask)


def volume_bias(found, true, mask=None):
    """Signed error of the paint's volume, as a share of the true one.

    Args:
      found, true: heights over the bare canvas [mm], at least 0 where true.

    Returns:
      Scalar, 0.1 where there is a tenth too much; 0 where there is no paint.
    """
    volume = weighted_mean(true, mask)
    return weighted_mean(found - true, mask) / jnp.where(volume > 0.0, volume, jnp.inf)


def normal_angles(found, true, pixel):
    """Angle between the surfaces' normals at each pixel, (h, w) [degrees].

    Args:
      found, true: (h, w) heights [mm]. pixel: side of a pixel [mm].
    """
    a, b = render.normals(found, pixel), render.normals(true, pixel)
    # By the chord, which keeps small angles in float32 where the cosine loses them.
    square = jnp.sum(jnp.square(a - b), axis=-1)
    chord = jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
    return jnp.degrees(2.0 * jnp.arcsin(jnp.minimum(0.5 * chord, 1.0)))


def octave_power(picture):
    """Power spectrum of a picture summed over rings an octave wide.

    The mean is removed and a Hann window is applied, so that borders do not count as detail.

    Args:
      picture: (h, w) or (h, w, c); channels are added up.

    Returns:
      (k,), finest first: entry i holds wavelengths of 2^(i+1) to 2^(i+2) pixels, entry 0 also the
      shorter ones along diagonals; k = floor(log2(min(h, w))) - 1.
    """
    picture = picture.reshape(*picture.shape[:2], -1)
    h, w, _ = picture.shape
    window = jnp.asarray(np.hanning(h + 1)[:-1, None] * np.hanning(w + 1)[:-1], picture.dtype)
    window = window[..., None]
    mean = jnp.sum(window * picture, (0, 1), keepdims=True) / jnp.sum(window)
    spectrum = jnp.fft.fft2(window * (picture - mean), axes=(0, 1))
    power = jnp.sum(jnp.square(jnp.abs(spectrum)), axis=-1) / (h * w)
    frequency = np.hypot(np.fft.fftfreq(h)[:, None], np.fft.fftfreq(w))
    octaves = int(np.log2(min(h, w))) - 1
    with np.errstate(divide="ignore"):
        ring = np.maximum(np.ceil(-np.log2(frequency)) - 2, 0)
    rings = np.stack([ring == i for i in range(octaves)])
    return jnp.sum(jnp.asarray(rings, power.dtype) * power[None], axis=(1, 2))


def spectrum_ratio(found_power, true_power):
    """Power found over true power, (k,) by octave; 1 is right, below 1 is blurred, above is noise.

    Args:
      found_power, true_power: (k,) of `octave_power`, each summed over the pictures compared.
    """
    # Rounding leaves some power in octaves where there is none.
    floor = 1e-10 * jnp.sum(true_power) + jnp.finfo(true_power.dtype).tiny
    return (found_power + floor) / (true_power + floor)


def lab(linear):
    """CIE L*a*b* (D65, 2 degrees) of linear sRGB, (..., 3)."""
    weights = jnp.asarray(_XYZ / _WHITE[:, None], linear.dtype)
    xyz = jnp.einsum("ij,...j->...i", weights, linear, precision=jax.lax.Precision.HIGHEST)
    low = xyz <= (6 / 29) ** 3
    f = jnp.where(low, xyz / (3 * (6 / 29) ** 2) + 4 / 29, jnp.where(low, 1.0, xyz) ** (1 / 3))
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return jnp.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def ciede2000(a, b):
    """Color difference CIEDE2000 of two Lab colors (..., 3), (...).

    Chosen over the Euclidean distance (CIE76), which overrates differences of saturated colors
    several times over, and paint from the tube is saturated. About 1 is just noticeable. Sharma,
    Wu, Dalal 2005, whose test data it reproduces.
    """

    def root(x):
        return jnp.where(x > 0.0, jnp.sqrt(jnp.where(x > 0.0, x, 1.0)), 0.0)

    def hue(a, b):
        gray = (a == 0.0) & (b == 0.0)
        return jnp.where(gray, 0.0, jnp.arctan2(b, jnp.where(gray, 1.0, a))) % (2 * jnp.pi)

    def fade(c):  # C^7 / (C^7 + 25^7), without overflow
        ratio = (jnp.minimum(c, 1e4) / 25.0) ** 7
        return root(ratio / (ratio + 1.0))

    chroma = 0.5 * (root(a[..., 1] ** 2 + a[..., 2] ** 2) + root(b[..., 1] ** 2 + b[..., 2] ** 2))
    stretch = 1.5 - 0.5 * fade(chroma)
    (l1, a1, b1), (l2, a2, b2) = (
        (x[..., 0], x[..., 1] * stretch, x[..., 2]) for x in (a, b)
    )  # fmt: skip
    c1, c2 = root(a1**2 + b1**2), root(a2**2 + b2**2)
    h1, h2 = hue(a1, b1), hue(a2, b2)
    colored = (c1 > 0.0) & (c2 > 0.0)
    turn = h2 - h1
    turn = turn - 2 * jnp.pi * jnp.where(turn > jnp.pi, 1.0, jnp.where(turn < -jnp.pi, -1.0, 0.0))
    turn = jnp.where(colored, turn, 0.0)
    far = jnp.abs(h1 - h2) > jnp.pi
    middle = 0.5 * (h1 + h2) + jnp.where(far, jnp.where(h1 + h2 < 2 * jnp.pi, jnp.pi, -jnp.pi), 0.0)
    middle = jnp.where(colored, middle, h1 + h2)
    light, c = 0.5 * (l1 + l2), 0.5 * (c1 + c2)
    dl, dc, dh = l2 - l1, c2 - c1, 2.0 * root(c1 * c2) * jnp.sin(0.5 * turn)
    degree = jnp.pi / 180.0
    t = (
        1.0
        - 0.17 * jnp.cos(middle - 30 * degree)
        + 0.24 * jnp.cos(2 * middle)
        + 0.32 * jnp.cos(3 * middle + 6 * degree)
        - 0.20 * jnp.cos(4 * middle - 63 * degree)
    )
    away = (light - 50.0) ** 2
    dl = dl / (1.0 + 0.015 * away / jnp.sqrt(20.0 + away))
    dc = dc / (1.0 + 0.045 * c)
    dh = dh / (1.0 + 0.015 * c * t)
    blue = 30 * degree * jnp.exp(-(((middle / degree - 275.0) / 25.0) ** 2))
    rotation = -2.0 * fade(c) * jnp.sin(2 * blue)
    return root(dl**2 + dc**2 + dh**2 + rotation * dc * dh)


def delta_e(found, true):
    """CIEDE2000 between two pictures, (h, w).

    Args:
      found, true: (h, w, 3) linear RGB in [0, 1].
    """
    return ciede2000(lab(found), lab(true))


def extremes(colors, directions: int = 64):
    """The colors that span a set: for each of `directions` directions the outermost one.

    Args:
      colors: (n, 3).

    Returns:
      (directions, 3), rows of `colors`. Their convex hull lies within the set's.
    """
    i = np.arange(directions) + 0.5
    up, turn = 1.0 - 2.0 * i / directions, np.pi * (1.0 + 5.0**0.5) * i
    side = np.sqrt(1.0 - up**2)
    ways = np.stack([side * np.cos(turn), side * np.sin(turn), up])
    along = jnp.matmul(colors, jnp.asarray(ways, colors.dtype), precision=jax.lax.Precision.HIGHEST)
    return colors[jnp.argmax(along, axis=0)]


def hull_distance(colors, vertices, steps: int = 256):
    """Distance of colors from the convex hull of others.

    Each color's nearest point is a mean of the vertices; weight is moved from the worst vertex that
    has some to the best one, as far as it helps (Mitchell, Demyanov, Malozemov 1974).

    Args:
      colors: (n, 3). vertices: (k, 3), in any number, repeated or in a plane.

    Returns:
      (n,), at least the true distance and, after `steps`, within about 2e-3 of it for a dozen
      vertices on [0, 1].
    """
    matmul = lambda a, b: jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)  # noqa: E731

    def body(_, weights):
        away = matmul(weights, vertices) - colors
        along = matmul(away, vertices.T)
        best = jnp.argmin(along, axis=1)
        worst = jnp.argmax(jnp.where(weights > 0.0, along, -jnp.inf), axis=1)
        move = vertices[best] - vertices[worst]
        length = jnp.sum(move * move, axis=1)
        step = -jnp.sum(away * move, axis=1) / jnp.where(length > 0.0, length, 1.0)
        held = jnp.take_along_axis(weights, worst[:, None], axis=1)[:, 0]
        step = jnp.clip(step, 0.0, held)[:, None]
        count = vertices.shape[0]
        one = lambda index: jax.nn.one_hot(index, count, dtype=weights.dtype)  # noqa: E731
        return jnp.maximum(weights + step * (one(best) - one(worst)), 0.0)

    near = jnp.argmin(jnp.sum((colors[:, None] - vertices[None]) ** 2, axis=-1), axis=1)
    weights = jax.nn.one_hot(near, vertices.shape[0], dtype=colors.dtype)
    weights = jax.lax.fori_loop(0, steps, body, weights)
    weights = weights / jnp.sum(weights, axis=1, keepdims=True)
    return jnp.sqrt(jnp.sum((matmul(weights, vertices) - colors) ** 2, axis=1))


def out_of_hull(color, vertices, mask=None, tolerance: float = HULL_TOLERANCE):
    """Share of pixels whose color no mixture of others gives.

    Args:
      color: (h, w, 3), in a space where mixtures are means. vertices: (k, 3), what went in.
      tolerance: distance from the hull that is let pass.
    """
    distance = hull_distance(color.reshape(-1, 3), vertices).reshape(color.shape[:2])
    return weighted_mean((distance > tolerance).astype(color.dtype), mask)
