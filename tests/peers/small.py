"""The peers with small networks, a short training, and random weights for them in float64."""

import jax
import numpy as np

from jaxreg.config import (
    CEMNetConfig,
    Config,
    DataConfig,
    DCPConfig,
    FMRConfig,
    IDAMConfig,
    PairConfig,
    RPMNetConfig,
    TrainConfig,
)
from jaxreg.peers import cemnet, dcp, fmr, idam, rpmnet

K = 3
SMALL = {
    "dcp": DCPConfig(k=K, channels=(3, 4), width=4),
    "cemnet": CEMNetConfig(
        k=K, channels=(3, 4), width=4, hidden=(4,), iterations=2, candidates=6, look_ahead=1,
        epsilon=1.0, stride=2, reach=4,
    ),
    "idam": IDAMConfig(
        k=K, channels=(3, 4), significance=(4, 2), hidden=4, kept_one_in=1, iterations=2
    ),
    "rpmnet": RPMNetConfig(
        radius=2.0, neighbors=4, width=4, hidden=(4, 8, 4, 4), k_normals=K, sinkhorn=2,
        iterations=2, train_iterations=2,
    ),
    "fmr": FMRConfig(channels=(8, 24), hidden=(6,), decoded=5, iterations=2),
}  # fmt: skip
MODULES = {"dcp": dcp, "cemnet": cemnet, "idam": idam, "rpmnet": rpmnet, "fmr": fmr}


def short_training(name: str) -> Config:
    """Two steps on two pairs of procedural shapes."""
    return Config(
        network=name,
        data=DataConfig(name="shapes", train_shapes=4, test_shapes=2),
        pairs=PairConfig(points=32, kept=24),
        test_pairs=PairConfig(points=32, kept=24),
        train=TrainConfig(steps=2, batch=2, validate_every=1, validation_pairs=2),
        **{name: SMALL[name]},
    )


def draw_variables(module, config, rng):
    """Biases above zero, so that few features are cut off; variances that are positive."""
    shapes = jax.eval_shape(lambda: module.init_variables(jax.random.key(0), config))

    def draw(path, leaf):
        place = jax.tree_util.keystr(path)
        value = rng.normal(1.0 if "bias" in place else 0.0, 0.5, leaf.shape)
        return 0.5 + np.abs(value) if "'var'" in place else value

    return jax.tree_util.tree_map_with_path(draw, shapes)
