"""A virtual brush and thick 3D paint in JAX.

A stylus stroke drives a brush of simulated bristles; the bristles drive a 3D paint simulator,
and networks trained on its strokes paint the same stroke in real time. Every stage is a pure
function that composes with `jit`, `vmap` and `grad`.
"""

from jaxbrush.platform import check_jax_version

__version__ = "0.1.0"

check_jax_version()
