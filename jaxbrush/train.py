"""Training of generator and discriminator (paper sections 4.3 and 5): one function a step."""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxbrush import losses
from jaxbrush.models import (
    Discriminator,
    DiscriminatorConfig,
    Generator,
    GeneratorConfig,
    check_size,
)
from jaxbrush.structs import config, state

CLIP = 1.0
"""Root mean square, over all parameters of a network, at which Adam's step is cut [rates]; usual
steps have 0.6. Without a cut, one odd picture after many usual ones makes a step of up to 16, since
the mean square of slopes is slow: networks without normalisation were lost to it."""


@state
class Batch:
    """inputs: (n, h, w, c), target: (n, h, w, k), both in [-1, 1]. mask: (n, h, w, 1), 1 where the
    new stroke may have changed something; only masked normalisation reads it here."""

    inputs: jax.Array
    target: jax.Array
    mask: jax.Array


@config
class TrainConfig:
    """discriminator: None trains without, at half the cost of a weight of 0. average: keeps a
    running average of the generator's parameters. beta1, beta2: of Adam."""

    generator: GeneratorConfig = GeneratorConfig()  # noqa: RUF009
    discriminator: DiscriminatorConfig | None = DiscriminatorConfig()  # noqa: RUF009
    average: bool = False
    beta1: float = 0.5
    beta2: float = 0.999


@state
class TrainParams:
    """Scalars. l1, gan, l2, opacity, gradient: weights of the generator's losses; the last two are
    for those that paint heights. generator_rate, discriminator_rate: learning rates. decay: of the
    average of the parameters."""

    l1: jax.Array
    gan: jax.Array
    l2: jax.Array
    opacity: jax.Array
    gradient: jax.Array
    generator_rate: jax.Array
    discriminator_rate: jax.Array
    decay: jax.Array


def make_params(
    l1=10.0, gan=1.0, generator_rate=2e-4, discriminator_rate=2e-4, decay=0.999, l2=0.0,
    opacity=0.0, gradient=0.0,
) -> TrainParams:  # fmt: skip
    """The paper's weights and rates."""
    values = (l1, gan, l2, opacity, gradient, generator_rate, discriminator_rate, decay)
    return TrainParams(*(jnp.asarray(v, jnp.float32) for v in values))


@state
class TrainState:
    """step: () int32. params: may be replaced between updates without compiling anew, by arrays
    committed to a device where the others are, such as restored ones. generator,
    discriminator: parameters, float32. moments: running averages of batch normalisation.
    generator_adam, discriminator_adam: Optax states, of all
    parameters as one vector. average: of the generator's parameters, or
    None."""

    step: jax.Array
    params: TrainParams
    generator: dict
    moments: dict
    generator_adam: optax.OptState
    discriminator: dict | None
    discriminator_adam: optax.OptState | None
    average: dict | None


def _check(options: TrainConfig, batch: Batch):
    check_size(batch.inputs.shape)
    shape = batch.inputs.shape[:3]
    expected = {"target": (*shape, options.generator.outputs), "mask": (*shape, 1)}
    for name, size in expected.items():
        if getattr(batch, name).shape != size:
            raise ValueError(
                f"batch.{name} is {getattr(batch, name).shape}: expected {size} beside inputs "
                f"{batch.inputs.shape}"
            )
    for field in dataclasses.fields(Batch):
        dtype = getattr(batch, field.name).dtype
        if dtype != jnp.float32:
            raise ValueError(f"batch.{field.name} is {dtype}: expected float32")


def weights_of(norm: str, mask):
    """What a network of this norm takes as weights of the pixels."""
    return mask if norm == "masked" else None


def data_sharding(mesh: Mesh):
    """Shardings of (state, batch) on a mesh with one axis: copied, and split over the pictures."""
    (axis,) = mesh.axis_names
    return NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(axis))


def inference_variables(state: TrainState) -> dict:
    """Variables for `Generator.apply`: the averaged parameters where there are any."""
    params = state.generator if state.average is None else state.average
    return {"params": params, **state.moments}


def make_train(options: TrainConfig, mesh: Mesh | None = None):
    """Makes the two functions of a training.

    Both players step from the same state: the generator's picture is made once, and the
    discriminator that judges it is the one before the update.

    Args:
      options: networks and optimiser.
      mesh: of one axis, over which pictures are split (`data_sharding`); their number has to be a
        multiple of its size. None: one device.

    Returns:
      `init(key, batch, params=make_params()) -> TrainState`; of the batch only shapes count.

      `update(state, batch) -> (state, metrics)`, jitted; it consumes the state it is given. Metrics
      are scalars of the state before the step: `l1`, `l2`, `opacity` and `gradient` of a network
      that paints heights; with a discriminator `gan`, `discriminator` (losses without weights),
      `accuracy` (share of patches told right, 1 where it has won), `gradient_ratio` (of the
      weighted cGAN to the weighted others: norms of their slopes at the picture) and
      `logit_spread` (standard deviation over patches, 0 where it has collapsed); norms of the
      gradients `generator_slope`, `discriminator_slope`; `finite`, False once anything is not.

    Raises:
      ValueError: while tracing, a batch whose shapes or dtypes do not fit.
    """
    generator = Generator(options.generator)
    playing = options.discriminator is not None
    opponent = options.discriminator or DiscriminatorConfig()
    discriminator = Discriminator(opponent)
    adam = optax.scale_by_adam(b1=options.beta1, b2=options.beta2)

    def weights(norm, batch):
        return weights_of(norm, batch.mask)

    def judge(params, picture, batch):
        w = weights(opponent.norm, batch)
        return discriminator.apply({"params": params}, picture, batch.inputs, w)

    def paint(params, moments, batch):
        w = weights(options.generator.norm, batch)
        variables = {"params": params, **moments}
        return generator.apply(variables, batch.inputs, w, train=True, mutable=["moments"])

    def differ(fake, target, p):
        found = {"l1": losses.l1(fake, target), "l2": losses.l2(fake, target)}
        if options.generator.outputs != 3:
            for name in ("opacity", "gradient"):
                found[name] = getattr(losses, name)(fake[..., -1:], target[..., -1:])
        return sum(getattr(p, name) * loss for name, loss in found.items()), found

    def init(key, batch: Batch, params: TrainParams | None = None) -> TrainState:
        _check(options, batch)
        keys = jax.random.split(key)
        w = weights(options.generator.norm, batch)
        moments = dict(generator.init(keys[0], batch.inputs, w))
        painter = moments.pop("params")
        judge_params = None
        if playing:
            w = weights(opponent.norm, batch)
            judge_params = discriminator.init(keys[1], batch.target, batch.inputs, w)["params"]
        return TrainState(
            step=jnp.zeros((), jnp.int32),
            # Copied, since an update consumes them.
            params=jax.tree.map(jnp.copy, make_params() if params is None else params),
            generator=painter,
            moments=moments,
            generator_adam=adam.init(ravel_pytree(painter)[0]),
            discriminator=judge_params,
            discriminator_adam=adam.init(ravel_pytree(judge_params)[0]) if playing else None,
            average=jax.tree.map(jnp.copy, painter) if options.average else None,
        )

    def moved(params, slopes, adam_state, rate):
        # One long vector: a loop for each array would take longer to compile and to start.
        flat, tree = ravel_pytree(params)
        slopes, _ = ravel_pytree(slopes)
        with jax.numpy_dtype_promotion("standard"):  # Optax counts steps in int32
            steps, adam_state = adam.update(slopes, adam_state)
        steps = steps / jnp.maximum(1.0, jnp.sqrt(jnp.mean(steps**2)) / CLIP)
        return tree(flat - rate * steps), adam_state, jnp.linalg.norm(slopes)

    def update(state: TrainState, batch: Batch):
        _check(options, batch)
        p = state.params
        fake, pull, moments = jax.vjp(
            lambda g: paint(g, state.moments, batch), state.generator, has_aux=True
        )
        (_, metrics), slope = jax.value_and_grad(differ, has_aux=True)(fake, batch.target, p)
        change = {}
        if playing:
            logits, pull_fake = jax.vjp(
                lambda d, picture: judge(d, picture, batch), state.discriminator, fake
            )
            real, pull_real = jax.vjp(lambda d: judge(d, batch.target, batch), state.discriminator)
            gan, at_logits = jax.value_and_grad(losses.fool)(logits)
            gan_slope = p.gan * pull_fake(at_logits)[1]
            loss, (at_real, at_fake) = jax.value_and_grad(losses.tell_apart, (0, 1))(real, logits)
            slopes = jax.tree.map(jnp.add, pull_real(at_real)[0], pull_fake(at_fake)[0])
            metrics |= {
                "gan": gan,
                "discriminator": loss,
                "accuracy": 0.5 * (jnp.mean(real > 0.0) + jnp.mean(logits < 0.0)),
                "gradient_ratio": jnp.linalg.norm(gan_slope.ravel())
                / jnp.maximum(jnp.linalg.norm(slope.ravel()), 1e-12),
                "logit_spread": jnp.std(logits),
            }
            slope = slope + gan_slope
            judge_params, judge_adam, metrics["discriminator_slope"] = moved(
                state.discriminator, slopes, state.discriminator_adam, p.discriminator_rate
            )
            change = {"discriminator": judge_params, "discriminator_adam": judge_adam}
        (slopes,) = pull(slope)
        painter, painter_adam, metrics["generator_slope"] = moved(
            state.generator, slopes, state.generator_adam, p.generator_rate
        )
        if options.average:
            # A short memory first, so that the random start is forgotten.
            count = state.step.astype(jnp.float32)
            decay = jnp.minimum(p.decay, (1.0 + count) / (10.0 + count))
            change["average"] = jax.tree.map(
                lambda a, b: decay * a + (1.0 - decay) * b, state.average, painter
            )
        # Any parameter that is not finite shows in the next step's slopes, and so in its flag.
        metrics["finite"] = jnp.all(jnp.isfinite(jnp.stack(list(metrics.values()))))
        state = dataclasses.replace(
            state,
            step=state.step + 1,
            generator=painter,
            moments=dict(moments),
            generator_adam=painter_adam,
            **change,
        )
        return state, metrics

    if mesh is None:
        return jax.jit(init), jax.jit(update, donate_argnums=0)
    copied, split = data_sharding(mesh)
    return (
        jax.jit(init, out_shardings=copied),
        jax.jit(
            update, in_shardings=(copied, split), out_shardings=(copied, copied), donate_argnums=0
        ),
    )
