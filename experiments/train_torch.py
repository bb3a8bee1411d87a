"""The same networks and training step in PyTorch (CPU), where it is installed: a yardstick."""

import os

import numpy as np

from jaxbrush.train import Batch

try:
    import torch
    from torch import nn
    from torch.nn import functional
except ImportError:  # a yardstick only: the project does not install it
    torch = None


def available() -> bool:
    return torch is not None


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _tensor(array):
    return torch.from_numpy(np.array(array))


def _module(layers: dict):
    """Parameters of a network as PyTorch has them: kernels (o, i, y, x)."""
    module = nn.Module()
    for name, layer in layers.items():
        part = nn.Module()
        part.kernel = nn.Parameter(
            _tensor(np.transpose(layer["kernel"], (3, 2, 0, 1))).contiguous(
                memory_format=torch.channels_last
            )
        )
        for key in ("scale", "offset"):
            if "norm" in layer:
                setattr(part, key, nn.Parameter(_tensor(layer["norm"][key])))
        if "bias" in layer:
            part.bias = nn.Parameter(_tensor(layer["bias"]))
        setattr(module, name, part)
    return module


def _layer(part, x, stride: int = 1, up: bool = False):
    if up:
        x = functional.interpolate(x, scale_factor=2, mode="nearest")
    margin = (1, 2, 1, 2) if stride == 1 else (1, 1, 1, 1)
    x = functional.conv2d(
        functional.pad(x, margin), part.kernel, getattr(part, "bias", None), stride
    )
    if hasattr(part, "scale"):
        x = functional.instance_norm(x, weight=part.scale, bias=part.offset, eps=1e-5)
    return x


def _generate(m, inputs):
    first = functional.relu(_layer(m.encode1, inputs))
    second = functional.relu(_layer(m.encode2, first, 2))
    third = functional.relu(_layer(m.encode3, second))
    x = functional.relu(_layer(m.encode4, third, 2))
    x = functional.relu(_layer(m.decode1, x, up=True))
    x = functional.relu(_layer(m.decode2, torch.cat([x, third], 1)))
    x = functional.relu(_layer(m.decode3, torch.cat([x, second], 1), up=True))
    return torch.tanh(_layer(m.decode4, torch.cat([x, first], 1)))


def _judge(m, picture, inputs):
    x = torch.cat([picture, inputs], 1)
    for name, stride in (("layer1", 1), ("layer2", 2), ("layer3", 2), ("layer4", 1)):
        x = functional.leaky_relu(_layer(getattr(m, name), x, stride), 0.2)
    return _layer(m.layer5, x)


def make_step(parameters, batch: Batch):
    """A function that makes one training step and returns the losses before it.

    Both players step from the same state, and the generator's picture is made once, as in
    `jaxbrush.train`.

    Args:
      parameters: (generator, discriminator) as `TrainState` has them, instance normalisation.
    """
    torch.set_num_threads(cores())
    painter, judge = (_module(p) for p in parameters)
    fused = [
        torch.optim.Adam(m.parameters(), lr=2e-4, betas=(0.5, 0.999), fused=True)
        for m in (painter, judge)
    ]
    inputs, target = (
        _tensor(np.moveaxis(x, -1, 1)).contiguous(memory_format=torch.channels_last)
        for x in (batch.inputs, batch.target)
    )
    softplus = functional.softplus

    def step():
        fake = _generate(painter, inputs)
        # Cut in two, so that the generator's slopes come after the discriminator's.
        seen = fake.detach().requires_grad_()
        logits, real = _judge(judge, seen, inputs), _judge(judge, target, inputs)
        gan = softplus(-logits).mean()
        (slope,) = torch.autograd.grad(gan, seen, retain_graph=True)
        loss = softplus(-real).mean() + softplus(logits).mean()
        slopes = torch.autograd.grad(loss, list(judge.parameters()))
        for p, g in zip(judge.parameters(), slopes, strict=True):
            p.grad = g
        l1 = (fake - target).abs().mean()
        fused[0].zero_grad()
        torch.autograd.backward([10.0 * l1, fake], [None, slope])
        for optimiser in fused:
            optimiser.step()
        return {"l1": l1.item(), "gan": gan.item(), "discriminator": loss.item()}

    return step
