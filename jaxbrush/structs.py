"""The two kinds of dataclass the project is made of.

`state`: arrays that are traced (a pytree). `config`: static, hashable values that
fix shapes and choose algorithms; changing one recompiles.
"""

import dataclasses
from typing import TypeVar, dataclass_transform

import jax

T = TypeVar("T", bound=type)


@dataclass_transform(frozen_default=True)
def state(cls: T) -> T:
    """Makes `cls` a frozen dataclass whose fields are pytree children, except those declared with
    `metadata={"static": True}`."""
    cls = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(cls)
    static = [f.name for f in fields if f.metadata.get("static")]
    data = [f.name for f in fields if not f.metadata.get("static")]
    return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=static)


@dataclass_transform(frozen_default=True)
def config(cls: T) -> T:
    """Makes `cls` a frozen, hashable dataclass that jit treats as static."""
    cls = dataclasses.dataclass(frozen=True)(cls)
    return jax.tree_util.register_static(cls)
