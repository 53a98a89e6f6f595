"""Unsupervised training: the jitted step, validation, and the loop that can be stopped at any time.

A step depends only on the state and the seed: its pairs derive from ``fold_in(seed, step)``. A run
that was interrupted and resumed is therefore bit-equal to one that was not.
"""

import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int

from jaxreg import devices
from jaxreg._extras import extra
from jaxreg.config import Config, TrainConfig, check_options
from jaxreg.data import load_training, training_label
from jaxreg.data.batches import key_of, pair_batches, same_streams, validation_key
from jaxreg.data.pairs import make_pair, shape_points
from jaxreg.evaluation.methods import network_method
from jaxreg.evaluation.metrics import evaluate_transforms
from jaxreg.evaluation.run import evaluate_method
from jaxreg.geometry import rigid
from jaxreg.io.log import read_metrics
from jaxreg.network.features import BATCH_AXIS, DEVICE_AXIS
from jaxreg.network.losses import pose_error, step_losses, total_loss
from jaxreg.network.model import Variables, iterate
from jaxreg.peers import by_name
from jaxreg.progress import training_progress
from jaxreg.types import Pair, PointCloud
from jaxreg.weights import checkpoint
from jaxreg.weights.released import check_new_name, load_network, save_weights

with extra("train", "training"):
    import optax

_TRAIN, _INIT = 0, 1  # Streams of random keys below the seed.


class TrainState(NamedTuple):
    """All that a step reads and writes. `average` is the running average of `variables`."""

    step: Int[Array, ""]
    variables: Variables
    average: Variables
    optimizer: Any


def create_optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """Adam with L2 inside, clipped, with linear warm-up and cosine decay."""
    schedule = optax.warmup_cosine_decay_schedule(
        0.0,
        config.learning_rate,
        min(config.warmup, config.steps // 2),
        config.steps,
        config.final_learning_rate,
    )
    # Forty small arrays as one vector: saves a fifth of the step's compile time on one core, none
    # on two.
    return optax.flatten(
        optax.chain(
            optax.clip_by_global_norm(config.clip),
            optax.add_decayed_weights(config.weight_decay),
            optax.adam(schedule),
        )
    )


@functools.partial(jax.jit, static_argnames="config")
def create_train_state(config: Config) -> TrainState:
    """The state before the first step; one program, because operation by operation it takes 300 MB."""
    key = jax.random.fold_in(key_of(config.train.seed), _INIT)
    variables = by_name.init_variables(key, config)
    optimizer = create_optimizer(config.train).init(variables["params"])
    average = jax.tree.map(jnp.copy, variables)  # A donated buffer must not appear twice.
    return TrainState(jnp.zeros((), jnp.int32), variables, average, optimizer)


def started_from(name: str, state: TrainState) -> TrainState:
    """`state` with released weights, by their name, or the best ones of a run, by its folder.

    Parts that only the training uses are not released (FMR's decoder): they start anew.

    Raises:
      ValueError: there are none, or the network of `state` has other arrays.
    """
    variables, trained = load_network(name)
    variables = by_name.for_training(variables, state.variables, trained)
    there, here = (
        {jax.tree_util.keystr(path, simple=True, separator="/"): x.shape for path, x in leaves}
        for leaves, _ in map(jax.tree_util.tree_flatten_with_path, (variables, state.variables))
    )
    if there != here:
        odd = min(part for part, _ in there.items() ^ here.items())
        raise ValueError(
            f"the weights '{name}' do not fit the network of the configuration ({odd}: "
            f"{there.get(odd, 'none')} there, {here.get(odd, 'none')} here): train with network = "
            f"'{trained.network}' and the settings of these weights, "
            f"{trained.model if trained.network == 'paper' else getattr(trained, trained.network)}."
        )
    variables, average = (
        jax.tree.map(lambda x, like: jnp.array(x, like.dtype), variables, state.variables)
        for _ in range(2)  # A donated buffer must not appear twice.
    )
    return state._replace(variables=variables, average=average)


def batch_loss(
    params: Any, statistics: Any, pairs: Pair, *, config: Config
) -> tuple[Float[Array, ""], tuple[dict[str, Float[Array, ""]], Any]]:
    """Mean loss of a batch of pairs, its terms by name, and the updated BatchNorm statistics.

    Only the two clouds of each pair are read, and never its transform, unless `config.loss.pose`
    asks for it, or `config.network` is a peer that learns from the pose.
    """

    def peer_loss(source, reference, truth):
        variables = {"params": params, "batch_stats": statistics}
        loss, terms, variables = by_name.loss(variables, source, reference, truth, config=config)
        return loss, terms, variables["batch_stats"]

    def pair_loss(source, reference, truth):
        variables = {"params": params, "batch_stats": statistics}
        target = rigid.apply(truth, source.points) if config.loss.pose else None

        def observe(step, graph):
            terms = step_losses(
                step, graph, source.mask, reference, config=config.loss, model=config.model
            )
            if target is None:
                return terms, {}
            return terms, {"pose_error": pose_error(PointCloud(step.moved, source.mask), target)}

        _, seen, variables = iterate(
            variables, source, reference, config=config.model, train=True, observe=observe
        )
        terms, posed = jax.tree.map(jnp.sum, seen)
        loss = total_loss(terms, config.loss)
        loss = loss + sum(config.loss.pose * error for error in posed.values())
        return loss, terms._asdict() | posed, variables["batch_stats"]

    one = pair_loss if config.network == "paper" else peer_loss
    loss, terms, statistics = jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, 0, None))(
        pairs.source, pairs.reference, pairs.transform
    )
    return jnp.mean(loss), (jax.tree.map(jnp.mean, terms), statistics)


def draw_batch(
    step: Int[Array, ""], shapes: Float[Array, "s p 3"], config: Config, devices: int = 1
) -> Pair:
    """The pairs of a training step: random shapes, random poses and crops.

    Of many `devices`, under `shard_map`, each gets its share of the same pairs, and draws no others.
    """
    stream = jax.random.fold_in(key_of(config.train.seed), _TRAIN)
    shape_key, pair_key = jax.random.split(jax.random.fold_in(stream, step))
    chosen = jax.random.randint(shape_key, (config.train.batch,), 0, shapes.shape[0])
    keys = jax.random.split(pair_key, config.train.batch)
    if devices > 1:
        share = config.train.batch // devices
        first = jax.lax.axis_index(DEVICE_AXIS) * share
        chosen, keys = (jax.lax.dynamic_slice_in_dim(x, first, share) for x in (chosen, keys))
    return jax.vmap(lambda key, shape: make_pair(key, shape, config.pairs))(keys, shapes[chosen])


def train_step(
    state: TrainState, shapes: Float[Array, "s p 3"], *, config: Config, devices: int = 1
) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
    """One optimiser step on fresh pairs, and what to log about it.

    Under `shard_map` over `DEVICE_AXIS` each of the `devices` takes its share of the pairs.
    """
    pairs = draw_batch(state.step, shapes, config, devices)
    params, statistics = state.variables["params"], state.variables["batch_stats"]
    (loss, (terms, statistics)), gradient = jax.value_and_grad(batch_loss, has_aux=True)(
        params, statistics, pairs, config=config
    )
    if devices > 1:
        loss, terms, gradient = jax.lax.pmean((loss, terms, gradient), DEVICE_AXIS)
    updates, optimizer = create_optimizer(config.train).update(gradient, state.optimizer, params)
    variables = {"params": optax.apply_updates(params, updates), "batch_stats": statistics}
    # A young average follows faster, so it soon forgets the initial weights.
    step = state.step.astype(jnp.float32)
    decay = jnp.minimum(jnp.float32(config.train.ema), (1 + step) / (10 + step))
    average = optax.incremental_update(variables, state.average, 1 - decay)
    logged = {"loss": loss, "gradient_norm": optax.tree.norm(gradient), **terms}
    return state._replace(
        step=state.step + 1, variables=variables, average=average, optimizer=optimizer
    ), logged


@functools.partial(jax.jit, static_argnames=("config", "mesh"), donate_argnums=0)
def _train_step_jit(state, shapes, *, config: Config, mesh: Mesh | None = None):
    if mesh is None:
        return train_step(state, shapes, config=config)
    step = functools.partial(train_step, config=config, devices=mesh.size)
    everywhere = PartitionSpec()
    # Without its check, under which the derivatives of our own rules would have to say what they
    # differ over; so the mean over devices is taken by hand, above.
    return jax.shard_map(
        step, mesh=mesh, in_specs=everywhere, out_specs=everywhere, check_vma=False
    )(state, shapes)


def validate(variables: Variables, shapes: np.ndarray, config: Config) -> dict[str, float]:
    """Errors on the first `validation_pairs` pairs of the held-out shapes; the same every time.

    The pairs are made as `[test_pairs]` says, from shapes that are not trained on.
    """
    batches = pair_batches(
        shapes[: config.train.validation_pairs],
        validation_key(config.data.test_seed),
        config=config.test_pairs,
        batch=config.train.batch,
    )
    method = network_method(variables, config)
    predicted, truth, _ = evaluate_method(method, batches)
    metrics = evaluate_transforms(predicted, truth)
    return {
        name: float(metrics[name])
        for name in (
            "mae_r_deg",
            "mie_r_deg",
            "mae_t",
            "median_rre_deg",
            "recall_1deg",
            "recall_5deg",
        )
    }


def _check_validation(shapes: np.ndarray, config: Config) -> None:
    """Raise ValueError where `validate` would: hours later, at the first validation.

    A pair of one shape is traced as far as its pose, which computes nothing.
    """

    def pose(key, shape):
        pair = make_pair(key, shape, config.test_pairs)
        variables = by_name.init_variables(key, config)
        return by_name.pose(variables, pair.source, pair.reference, config=config)

    shape = jax.ShapeDtypeStruct(shapes.shape[1:], shapes.dtype)
    try:
        jax.eval_shape(pose, jax.eval_shape(lambda: jax.random.key(0)), shape)
    except ValueError as error:
        raise ValueError(f"the pairs to validate on ([test_pairs]) do not fit: {error}") from None


def train(config: Config, workdir: str | Path, *, root: str | Path | None = None) -> Variables:
    """Train in `workdir`, resuming any run there; returns the variables of lowest validation error.

    Writes `metrics.jsonl` (one object per line), the latest and the best checkpoint. The best has
    the lowest mean geodesic rotation error on the validation pairs, which are made from shapes that
    are not trained on. With `config.train.start` it fine-tunes the weights of that name or run. A run
    that was stopped goes on from its last validation, or, after SIGTERM, from where it was; one stopped
    before its first validation starts over, with any configuration. On many devices, of this process
    and of others (`jaxreg.devices.join_processes`), each takes a share of every batch.

    Raises:
      ValueError: `config` has a number out of range, `[test_pairs]` asks for more points than there
        are or the network needs more than they leave, the devices do not divide the batch,
        `workdir` cannot be written to, the data is missing, the weights to start from do not
        exist or do not fit, another process trains in `workdir`, or it contains a run with
        another configuration.
      FloatingPointError: the loss is not finite; the message says at which step. Saved checkpoints
        stay.
    """
    if config.network not in by_name.TRAINED:
        raise ValueError(
            f"network = '{config.network}' is not trained here: evaluate the weights of its authors, "
            f"or train one of {', '.join(by_name.TRAINED)}."
        )
    own = "model" if config.network == "paper" else config.network
    for section in (own, "loss", "pairs", "test_pairs", "data", "train"):
        check_options(section, getattr(config, section))
    checkpoint.check_place(workdir)
    shapes, held_out = load_training(
        config.data,
        root=root,
        points=shape_points(config.pairs),
        validation_points=shape_points(config.test_pairs),
        seed=config.train.seed,
    )
    _check_validation(held_out, config)
    mesh = devices.mesh_of_all()
    devices.check_shares(config.train.batch, mesh)
    on_device = devices.on_all(jnp.asarray(shapes), mesh)
    with (
        checkpoint.open_run(workdir, config) as run,
        training_progress(config.train.steps) as progress,
        devices.watched() as watch,
    ):
        with same_streams():
            state = create_train_state(config)
        state = run.restore(devices.on_all(state, mesh))
        if config.train.start and int(state.step) == 0:
            state = devices.on_all(started_from(config.train.start, state), mesh)
        while int(state.step) < config.train.steps:
            with same_streams():
                state, logged = _train_step_jit(state, on_device, config=config, mesh=mesh)
            number = int(state.step)
            entry = {"step": number} | {name: float(value) for name, value in logged.items()}
            if not np.isfinite([entry["loss"], entry["gradient_norm"]]).all():
                raise FloatingPointError(
                    f"the loss or its gradient is not finite at step {number}: {entry}. The last "
                    f"checkpoint in {workdir} is from before; lower train.learning_rate or check "
                    "the shapes."
                )
            last = number == config.train.steps
            if number % config.train.validate_every == 0 or last:
                found = validate(devices.on_one(state.average, mesh), held_out, config)
                entry |= {f"val_{k}": v for k, v in devices.as_first_says(found).items()}
                run.save(number, state, entry["val_mie_r_deg"])
            run.log(entry)
            progress(entry)
            if not last and watch.asked_to_end(number):
                run.save(number, state, np.inf)
                run.close()
                watch.end(number)
    return checkpoint.load_checkpoint(workdir)[0]


def release(
    name: str,
    workdir: str | Path,
    command: str,
    *,
    directory: str | Path = "",
    root: str | Path | None = None,
) -> Path:
    """Write the best weights of a run into `directory` (the workdir), with a card of their origin.

    What only the training uses is left out (FMR's decoder); the checkpoint has it.
    The data is named after what is found in `root`, so a stand-in does not pass for the original.
    Returns the path of the card.

    Raises:
      ValueError: `name` is not plain or is taken, `workdir` has no checkpoint, or its log lacks the
        step of the best one.
    """
    directory = directory or workdir
    check_new_name(name, directory)
    variables, config, step = checkpoint.load_best(workdir)
    log = Path(workdir) / "metrics.jsonl"
    metrics = read_metrics(log)
    rows = np.flatnonzero(metrics["step"] == step)
    if len(rows) == 0:
        # A run killed between the two has saved the step but not logged it.
        raise ValueError(
            f"{log} lacks step {step}, that of the best checkpoint: run `jaxreg train` with this "
            "--workdir again to finish it."
        )
    card = {
        "command": command,
        "data": training_label(config.data, root),
        "seed": config.train.seed,
        "step": step,
        "validation": {
            key.removeprefix("val_"): float(values[rows[-1]])
            for key, values in metrics.items()
            if key.startswith("val_")
        },
    }
    return save_weights(directory, name, by_name.for_registration(variables, config), config, card)
