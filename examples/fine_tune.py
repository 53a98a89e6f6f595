"""Fine-tune released weights with an optimiser of your own: any optax chain, any loop.

`batch_loss` is the unsupervised loss of a batch of pairs (Eq. 18) with the statistics that BatchNorm
updates; the rest is plain JAX and optax. `jaxreg train CONFIG --weights NAME` does the same with the
optimiser of the paper. Prints the loss of every step.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax

import jaxreg

STEPS, BATCH = 5, 2
variables, config = jaxreg.load_pretrained("modelnet40")
model = dataclasses.replace(config.model, n_inliers=32)
pairs = jaxreg.PairConfig(points=64, kept=48)
config = dataclasses.replace(config, model=model, pairs=pairs)
shapes = jnp.stack([jnp.asarray(jaxreg.sample_shape(0, i, points=64)) for i in range(BATCH)])
optimizer = optax.chain(optax.clip(1.0), optax.lion(1e-5))


@jax.jit
def step(variables, state, key):
    """One step on fresh pairs of the shapes: the variables, the optimiser's state, the loss."""
    keys = jax.random.split(key, BATCH)
    batch = jax.vmap(lambda k, shape: jaxreg.make_pair(k, shape, config.pairs))(keys, shapes)
    loss = jax.value_and_grad(jaxreg.batch_loss, has_aux=True)
    params, statistics = variables["params"], variables["batch_stats"]
    (value, (_, statistics)), gradient = loss(params, statistics, batch, config=config)
    updates, state = optimizer.update(gradient, state, params)
    params = optax.apply_updates(params, updates)
    return {"params": params, "batch_stats": statistics}, state, value


def fine_tune(variables):
    """The variables after `STEPS` steps."""
    state = optimizer.init(variables["params"])
    for number in range(STEPS):
        variables, state, value = step(variables, state, jax.random.key(number))
        print(f"step {number + 1}: loss {float(value):.3f}")
    return variables


if __name__ == "__main__":
    fine_tune(variables)
