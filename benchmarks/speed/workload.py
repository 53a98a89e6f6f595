"""What is timed: pairs from procedural shapes, the registration of a batch, the training step."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.paper import transcription
from jaxreg import training
from jaxreg.batching import map_pairs
from jaxreg.config import Config, PairConfig
from jaxreg.data.procedural import shapes
from jaxreg.network.model import register_pair
from jaxreg.types import Pair, PointCloud, RigidTransform
from jaxreg.weights.released import load_pretrained

jit_without_ynn = functools.partial(
    jax.jit, compiler_options={"xla_cpu_experimental_ynn_fusion_type": ""}
)
"""`jax.jit`, but XLA:CPU hands nothing to the library YNN: see `jaxreg._xla.unfused`."""
Implementation = Literal["jaxreg", "transcription"]


class Batch(NamedTuple):
    """Sources (b, n, 3), references (b, n, 3) and the true rotations (b, 3, 3), float32."""

    sources: np.ndarray
    references: np.ndarray
    rotations: np.ndarray


@functools.cache
def released() -> tuple[dict, Config]:
    """The released weights, on the device, and their configuration."""
    variables, config = load_pretrained("modelnet40")
    return jax.tree.map(jnp.asarray, variables), config


def draw(points: int, batch: int) -> Batch:
    """Pairs of the ModelNet40 protocol, three quarters of each procedural shape kept.

    In numpy, so that the memory of a process is that of what it is timed for.
    """
    rng = np.random.default_rng(0)
    return Batch(
        *(np.stack(x) for x in zip(*(_pair(rng, points) for _ in range(batch)), strict=True))
    )


def _pair(rng: np.random.Generator, points: int) -> tuple[np.ndarray, ...]:
    shape = shapes.sample_shape(0, int(rng.integers(1 << 30)), points=4 * points // 3)
    rotation = Rotation.from_euler("zyx", rng.uniform(0, 45, 3), degrees=True).as_matrix()
    viewpoint = 500.0 * rng.choice([-1, 1], 3)
    clouds = []
    for cloud in (shape, shape @ rotation.T + rng.uniform(-0.5, 0.5, 3)):
        near = np.argsort(np.linalg.norm(cloud - viewpoint, axis=1))[:points]
        clouds.append(np.float32(cloud[rng.permutation(near)]))
    return *clouds, np.float32(rotation)


def registration(implementation: Implementation, *, batched: bool) -> Callable:
    """The compiled function of variables and two clouds (n, 3), or two batches of them.

    `jaxreg` is the library, with batches as `evaluate.py` takes them; `transcription` is the equations
    as one would first write them.
    """
    _, config = released()
    if implementation == "jaxreg":
        batch, one = map_pairs, functools.partial(register_pair, config=config)
    else:
        batch, one = jax.vmap, functools.partial(transcription.register, config=config.model)
    if not batched:
        return jax.jit(one)
    return jax.jit(lambda variables, *clouds: batch(functools.partial(one, variables))(*clouds))


def training_config(points: int, batch: int) -> Config:
    """The released network, trained on pairs of so many points."""
    _, config = released()
    return dataclasses.replace(
        config,
        pairs=PairConfig(points=4 * points // 3, kept=points),
        train=dataclasses.replace(config.train, batch=batch),
    )


def gradient(implementation: Implementation, config: Config) -> Callable:
    """Compiled loss and gradient of a batch of pairs."""
    if implementation == "jaxreg":
        loss, aux = training.batch_loss, True
    else:
        loss, aux = transcription.batch_loss, False
    return jax.jit(jax.value_and_grad(functools.partial(loss, config=config), has_aux=aux))


def training_step(config: Config) -> Callable:
    """The compiled step of `train.py`: pairs, gradient, optimiser."""
    return jax.jit(functools.partial(training.train_step, config=config), donate_argnums=0)


def loss_inputs(implementation: Implementation, drawn: Batch) -> tuple:
    """What `gradient` takes after the parameters and the statistics."""
    sources, references = (jnp.asarray(x) for x in drawn[:2])
    if implementation == "transcription":
        return sources, references
    clouds = [PointCloud(x, jnp.ones(x.shape[:2], bool)) for x in (sources, references)]
    return (Pair(*clouds, RigidTransform(drawn.rotations, jnp.zeros_like(sources[:, 0]))),)
