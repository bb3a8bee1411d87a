import dataclasses
from enum import Enum

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.structs import config, state


class Scheme(Enum):
    VERLET = "verlet"
    IMPLICIT = "implicit"


@state
class Tip:
    position: jax.Array
    velocity: jax.Array


@state
class Pair:
    left: Tip
    right: Tip


@config
class Options:
    count: int = 4
    scheme: Scheme = Scheme.VERLET
    sizes: tuple[int, ...] = (1, 2)


@config
class Nested:
    options: Options = Options()  # noqa: RUF009
    name: str = "brush"


def make_tip() -> Tip:
    return Tip(position=jnp.arange(3.0), velocity=jnp.ones(3))


def test_state_is_a_pytree_in_field_order():
    tip = make_tip()
    leaves, structure = jax.tree.flatten(tip)
    assert len(leaves) == 2
    assert leaves[0] is tip.position and leaves[1] is tip.velocity
    assert isinstance(jax.tree.unflatten(structure, leaves), Tip)


def test_state_names_its_fields_in_paths():
    paths = [
        jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(make_tip())
    ]
    assert paths == [".position", ".velocity"]


def test_states_nest():
    pair = Pair(left=make_tip(), right=make_tip())
    doubled = jax.tree.map(lambda x: 2 * x, pair)
    assert isinstance(doubled.right, Tip)
    np.testing.assert_array_equal(doubled.right.position, [0, 2, 4])


def test_state_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        make_tip().position = jnp.zeros(3)  # type: ignore[misc]


def test_replace_changes_one_field_of_a_copy():
    tip = make_tip()
    moved = dataclasses.replace(tip, position=tip.position + 1)
    np.testing.assert_array_equal(moved.position, [1, 2, 3])
    np.testing.assert_array_equal(tip.position, [0, 1, 2])
    assert moved.velocity is tip.velocity


def test_state_passes_through_the_transformations():
    def energy(tip):
        return jnp.sum(tip.velocity**2) + jnp.sum(tip.position**2)

    tip = make_tip()
    gradient = jax.jit(jax.grad(energy))(tip)
    assert isinstance(gradient, Tip)
    np.testing.assert_allclose(gradient.position, [0, 2, 4])

    batch = jax.tree.map(lambda *x: jnp.stack(x), tip, tip)
    np.testing.assert_allclose(jax.vmap(energy)(batch), [8, 8])

    def body(tip, _):
        return dataclasses.replace(tip, position=tip.position + tip.velocity), tip.position[0]

    last, track = jax.lax.scan(body, tip, length=3)
    np.testing.assert_allclose(last.position, [3, 4, 5])
    np.testing.assert_allclose(track, [0, 1, 2])


def test_config_is_frozen_and_hashable_by_value():
    assert Options() == Options(count=4)
    assert hash(Options()) == hash(Options(count=4))
    assert Options() != Options(count=5)
    assert len({Nested(), Nested(), Nested(name="other")}) == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        Options().count = 5  # type: ignore[misc]


def test_config_holds_no_traced_leaf():
    assert jax.tree.leaves(Nested()) == []


def test_configs_of_two_classes_differ():
    @config
    class Other:
        count: int = 4
        scheme: Scheme = Scheme.VERLET
        sizes: tuple[int, ...] = (1, 2)

    assert Other() != Options()


def test_config_is_static_under_jit():
    traces = []

    @jax.jit
    def run(options, x):
        traces.append(options)
        # Python control flow and shapes: impossible with a traced value.
        if options.scheme is Scheme.IMPLICIT:
            x = -x
        return jnp.broadcast_to(x, (options.count,))

    assert run(Options(), jnp.float32(1)).shape == (4,)
    assert run(Options(count=4), jnp.float32(2)).shape == (4,)
    assert len(traces) == 1, "an equal config must not trace again"

    assert run(Options(count=5), jnp.float32(1)).shape == (5,)
    assert len(traces) == 2, "another config must trace again"

    np.testing.assert_array_equal(run(Options(scheme=Scheme.IMPLICIT), jnp.float32(1)), -np.ones(4))
    assert len(traces) == 3

    run(Options(), jnp.float32(3))
    assert len(traces) == 3, "the first compilation is kept"


def test_nested_config_is_static_under_jit():
    traces = []

    @jax.jit
    def run(nested, x):
        traces.append(nested)
        return x * nested.options.count

    run(Nested(), jnp.float32(1))
    run(Nested(options=Options(count=4)), jnp.float32(1))
    assert len(traces) == 1
    run(Nested(options=Options(count=2)), jnp.float32(1))
    assert len(traces) == 2


def test_state_of_the_same_shape_does_not_trace_again():
    traces = []

    @jax.jit
    def run(tip):
        traces.append(tip)
        return tip.position + tip.velocity

    run(make_tip())
    run(dataclasses.replace(make_tip(), velocity=jnp.zeros(3)))
    assert len(traces) == 1
