"""Training: unsupervised, resumable bit for bit, and stopped by a loss that is not finite."""

import dataclasses
import errno
import functools
import json
import os
import re
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import training
from jaxreg.config import Config, DataConfig, TrainConfig, check_options, from_dict
from jaxreg.data import training_label
from jaxreg.types import RigidTransform
from jaxreg.weights import checkpoint
from jaxreg.weights.released import load_pretrained

pytestmark = [pytest.mark.float32, pytest.mark.loose]


@pytest.fixture(scope="module")
def config() -> Config:
    return from_dict(
        {
            "model": {"channels": [4, 8], "width": 8, "n_inliers": 12, "iterations": 2, "k": 3},
            "pairs": {"points": 32, "kept": 24},
            "data": {
                "name": "shapes",
                "train_shapes": 8,
                "test_shapes": 4,
                "validation_share": 0.5,
            },
            "train": {
                "steps": 4,
                "batch": 2,
                "validate_every": 2,
                "validation_pairs": 2,
                "warmup": 1,
            },
        }
    )


@functools.cache
def loss_of(config: Config):
    return jax.jit(functools.partial(training.batch_loss, config=config))


draw_batch = jax.jit(training.draw_batch, static_argnums=2)


@functools.cache
def gradient_of(config: Config):
    return jax.jit(jax.grad(functools.partial(training.batch_loss, config=config), has_aux=True))


@pytest.mark.slow
def test_the_true_transform_changes_no_gradient(config, seed):
    shapes = jax.random.normal(jax.random.key(seed), (2, 32, 3))
    pairs = draw_batch(jnp.zeros((), jnp.int32), shapes, config)
    lie = RigidTransform(*jax.tree.map(lambda x: x * 0 + seed + 7.0, pairs.transform))
    state = training.create_train_state(config)
    arguments = state.variables["params"], state.variables["batch_stats"]
    honest, _ = gradient_of(config)(*arguments, pairs)
    lied, _ = gradient_of(config)(*arguments, pairs._replace(transform=lie))
    assert any(jnp.any(leaf != 0) for leaf in jax.tree.leaves(honest))
    jax.tree.map(np.testing.assert_array_equal, honest, lied)


def test_the_pose_loss_reads_the_true_transform_and_nothing_else_changes(config, seed):
    posed = dataclasses.replace(config, loss=dataclasses.replace(config.loss, pose=2.0))
    shapes = jax.random.normal(jax.random.key(seed), (2, 32, 3))
    pairs = draw_batch(jnp.zeros((), jnp.int32), shapes, config)
    state = training.create_train_state(config)
    arguments = state.variables["params"], state.variables["batch_stats"], pairs
    loss, (terms, _) = loss_of(config)(*arguments)
    total, (more, _) = loss_of(posed)(*arguments)
    error = more.pop("pose_error")
    assert set(terms) == set(more)
    np.testing.assert_allclose(total, loss + 2 * error, rtol=1e-5)
    # Where the true pose is a thousand away from any other, every point of every step is.
    far = pairs.transform._replace(translation=pairs.transform.translation + 1000.0)
    lied = (*arguments[:2], pairs._replace(transform=far))
    _, (away, _) = loss_of(posed)(*lied)
    steps, points = config.model.iterations, config.pairs.kept
    np.testing.assert_allclose(away["pose_error"], steps * points * 1000 * 3**0.5, rtol=0.01)
    assert error < away["pose_error"] / 100


def test_a_step_lowers_the_loss_on_its_own_pairs(config, seed):
    """A law of gradients: a short enough step along minus the gradient lowers the loss."""
    shapes = jax.random.normal(jax.random.key(seed), (2, 32, 3))
    state = training.create_train_state(config)
    pairs = draw_batch(state.step, shapes, config)
    params, statistics = state.variables["params"], state.variables["batch_stats"]
    loss = loss_of(config)
    gradient, _ = gradient_of(config)(params, statistics, pairs)
    square = sum(jnp.sum(g * g) for g in jax.tree.leaves(gradient))
    before, _ = loss(params, statistics, pairs)
    length = 1e-3 * before / square
    after, _ = loss(jax.tree.map(lambda p, g: p - length * g, params, gradient), statistics, pairs)
    assert after < before


@pytest.mark.slow
def test_a_resumed_run_equals_an_unbroken_one(config, tmp_path, monkeypatch):
    unbroken = training.train(config, tmp_path / "unbroken")

    class Killed(Exception):
        pass

    def log(run, entry, original=checkpoint.Run.log):
        original(run, entry)
        if entry["step"] == 3:
            raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint.Run, "log", log)
        with pytest.raises(Killed):
            training.train(config, tmp_path / "broken")
    resumed = training.train(config, tmp_path / "broken")
    jax.tree.map(np.testing.assert_array_equal, unbroken, resumed)
    lines = [
        [json.loads(line) for line in (tmp_path / run / "metrics.jsonl").read_text().splitlines()]
        for run in ("unbroken", "broken")
    ]
    assert [entry["step"] for entry in lines[1]] == [1, 2, 3, 4]
    assert lines[0] == lines[1]
    variables, saved = checkpoint.load_checkpoint(tmp_path / "broken")
    jax.tree.map(np.testing.assert_array_equal, variables, resumed)
    assert saved == config


def test_the_best_checkpoint_has_the_lowest_validation_error(config, tmp_path, monkeypatch):
    errors = iter([5.0, 9.0])
    seen = []

    def validate(variables, shapes, config):
        seen.append(jax.tree.map(np.asarray, variables))
        return {"mie_r_deg": next(errors)}

    monkeypatch.setattr(training, "validate", validate)
    best = training.train(config, tmp_path)
    assert len(seen) == 2
    jax.tree.map(np.testing.assert_array_equal, best, seen[0])
    assert checkpoint.best_config(tmp_path)[1] == 5.0


def test_another_configuration_does_not_resume(config, tmp_path):
    training.train(config, tmp_path)
    other = dataclasses.replace(config, loss=dataclasses.replace(config.loss, beta=0.5))
    with pytest.raises(ValueError, match=r"loss.beta: 0.01 there, 0.5 here"):
        training.train(other, tmp_path)


def test_a_loss_that_is_not_finite_stops_the_run_and_says_where(config, tmp_path, monkeypatch):
    clean = training.load_training

    def poisoned(*arguments, **options):
        clouds, held_out = clean(*arguments, **options)
        return clouds * np.float32(np.nan), held_out

    monkeypatch.setattr(training, "load_training", poisoned)
    with pytest.raises(FloatingPointError, match="step 1"):
        training.train(config, tmp_path)


def test_no_checkpoint_is_an_error_that_says_what_to_do(tmp_path):
    with pytest.raises(ValueError, match="--workdir"):
        checkpoint.load_checkpoint(tmp_path)


def test_a_checkpoint_with_other_arrays_is_an_error_that_says_so(config, tmp_path):
    with checkpoint.open_run(tmp_path, config) as run:
        run.save(1, {"weights": jnp.zeros(3)}, error=1.0)
    with pytest.raises(ValueError, match="other arrays than this version"):
        checkpoint.load_checkpoint(tmp_path)


def entries(workdir) -> list[dict]:
    lines = (workdir / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def other(config: Config) -> Config:
    return dataclasses.replace(config, loss=dataclasses.replace(config.loss, beta=0.5))


def test_a_run_stopped_before_its_first_checkpoint_starts_anew(config, tmp_path):
    start = {"weights": jnp.zeros(3)}
    with checkpoint.open_run(tmp_path, config) as run:
        run.log({"step": 1, "loss": 3.0})
        run.log({"step": 2, "loss": 2.0})
    with (tmp_path / "metrics.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"step": 3, "lo')  # Killed while it wrote.
    with checkpoint.open_run(tmp_path, other(config)) as run:
        assert run.restore(start) is start
        run.log({"step": 1, "loss": 4.0})
    assert entries(tmp_path) == [{"step": 1, "loss": 4.0}]


def test_a_log_that_an_earlier_version_left_in_pieces_is_mended(config, tmp_path):
    state = {"weights": jnp.zeros(3)}
    with checkpoint.open_run(tmp_path, config) as run:
        run.save(2, state, error=1.0)
    pieces = ['{"step": 1}', '{"step": 2, "lo{"step": 1}', "[2]", "\udcff", '{"step": 2}', '{"st']
    text = "\n".join(pieces)
    (tmp_path / "metrics.jsonl").write_text(text, encoding="utf-8", errors="surrogateescape")
    with checkpoint.open_run(tmp_path, config) as run:
        run.restore(state)
    assert entries(tmp_path) == [{"step": 1}, {"step": 2}]


def test_a_log_is_whole_even_where_the_run_is_killed_while_it_mends_it(
    config, tmp_path, monkeypatch
):
    state = {"weights": jnp.zeros(3)}
    with checkpoint.open_run(tmp_path, config) as run:
        run.save(1, state, error=1.0)
        run.log({"step": 1})
        run.log({"step": 2})

    def killed(path, target):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, checkpoint.open_run(tmp_path, config) as run:
        patched.setattr(type(tmp_path), "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            run.restore(state)
    assert entries(tmp_path) == [{"step": 1}, {"step": 2}]


def test_killed_in_its_first_save_a_run_keeps_its_configuration(config, tmp_path):
    state = {"weights": jnp.zeros(3)}
    with checkpoint.open_run(tmp_path, config) as run:
        run.save(1, state, error=1.0)
    shutil.rmtree(tmp_path / "latest")  # The best state is there, the newest was not finished.
    with (
        checkpoint.open_run(tmp_path, other(config)) as run,
        pytest.raises(ValueError, match=r"loss.beta: 0.01 there, 0.5 here"),
    ):
        run.restore(state)
    with checkpoint.open_run(tmp_path, config) as run:
        assert run.restore(state) is state


@pytest.mark.untyped
@pytest.mark.parametrize(
    ("name", "value", "bound"),
    [
        ("steps", 0, "at least 1"),
        ("batch", 0, "at least 1"),
        ("validate_every", 0, "at least 1"),
        ("validation_pairs", -1, "at least 1"),
        ("warmup", -1, "at least 0"),
        ("seed", -1, "at least 0"),
        ("learning_rate", 0.0, "positive"),
        ("learning_rate", float("nan"), "positive"),
        ("final_learning_rate", -1e-5, "at least 0"),
        ("weight_decay", float("inf"), "at least 0 and finite"),
        ("clip", 0.0, "positive"),
        ("ema", 1.5, "at least 0 and at most 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused_before_the_work(
    config, tmp_path, name, value, bound
):
    wrong = dataclasses.replace(config, train=dataclasses.replace(config.train, **{name: value}))
    option = f"--train.{name.replace('_', '-')}"
    with pytest.raises(ValueError, match=rf"train.{name} must be {bound}.*, got {value}.*{option}"):
        training.train(wrong, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_settings_at_the_end_of_their_range_are_taken():
    check_options(
        "train",
        TrainConfig(
            steps=1, batch=1, validate_every=1, validation_pairs=1, warmup=0, weight_decay=0.0,
            final_learning_rate=0.0, clip=float("inf"), ema=1.0, seed=0,
        )
    )  # fmt: skip


@pytest.mark.parametrize("inside", ["", "runs/own"])
def test_a_workdir_that_is_a_file_is_refused_before_the_work(config, tmp_path, inside, monkeypatch):
    monkeypatch.setattr(training, "load_training", None)  # Reading the data would fail.
    (tmp_path / "README.md").write_text("text")
    with pytest.raises(ValueError, match="README.md is a file: name a directory with --workdir"):
        training.train(config, tmp_path / "README.md" / inside)


def test_a_run_of_another_optimiser_is_evaluated_and_only_read(config, tmp_path):
    state = training.create_train_state(config)
    changed = state._replace(optimizer={"momentum": jnp.zeros(7)})
    with checkpoint.open_run(tmp_path, config) as run:
        run.save(3, changed, error=1.0)
    shutil.rmtree(tmp_path / "latest")
    files = sorted(tmp_path.rglob("*"))
    variables, saved = checkpoint.load_checkpoint(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, variables, state.average)
    assert saved == config
    assert sorted(tmp_path.rglob("*")) == files


def test_a_run_of_another_optimiser_is_not_resumed(config, tmp_path):
    state = training.create_train_state(config)
    with checkpoint.open_run(tmp_path, config) as run:
        run.save(3, state._replace(optimizer={"momentum": jnp.zeros(7)}), error=1.0)
    message = r"other arrays than this version .*\(optimizer/.* there, .* here\)"
    with (
        checkpoint.open_run(tmp_path, config) as run,
        pytest.raises(ValueError, match=message),
    ):
        run.restore(state)


def test_a_damaged_checkpoint_is_called_that(config, tmp_path):
    with checkpoint.open_run(tmp_path, config) as run:
        run.save(3, training.create_train_state(config), error=1.0)
    for path in (tmp_path / "best" / "3" / "state").rglob("*"):
        if path.is_file() and "METADATA" not in path.name:
            path.write_bytes(b"")
    # In a process of its own: reads that are still under way fail later, in threads, and pytest would
    # blame whatever test runs by then.
    code = f"from jaxreg.weights import checkpoint; checkpoint.load_checkpoint({str(tmp_path)!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert re.search(
        r"ValueError: .*best cannot be read \(.*\): replace it with an intact copy", done.stderr
    )


def test_a_card_tells_the_command_the_data_and_the_best_step(config, tmp_path):
    data = dataclasses.replace(config.data, label="what is tested on")
    config = dataclasses.replace(config, data=data)
    state = training.create_train_state(config)
    with checkpoint.open_run(tmp_path, config) as run:
        for step, error in ((2, 5.0), (4, 9.0)):
            run.save(step, state._replace(step=jnp.int32(step)), error)
            run.log({"step": step - 1, "loss": 0.5})
            run.log({"step": step, "loss": 0.5, "val_mie_r_deg": error, "val_mae_t": 1.0})
    path = training.release("mine", tmp_path, "jaxreg train 'a b'")
    assert path == tmp_path / "mine.json", "beside the run, and not in the package"
    variables, saved = load_pretrained(str(tmp_path / "mine"))
    jax.tree.map(np.testing.assert_array_equal, variables, state.average)
    assert saved == config
    card = json.loads(path.read_text("utf-8"))
    del card["config"]
    assert card == {
        "command": "jaxreg train 'a b'",
        "data": "shapes",
        "seed": 0,
        "step": 2,
        "validation": {"mie_r_deg": 5.0, "mae_t": 1.0},
    }


def test_a_log_without_the_best_step_is_an_error_that_says_so(config, tmp_path):
    state = training.create_train_state(config)._replace(step=jnp.int32(2))
    with checkpoint.open_run(tmp_path / "run", config) as run:
        run.save(2, state, error=1.0)
        run.log({"step": 1, "loss": 0.5})
    with pytest.raises(ValueError, match=r"metrics.jsonl lacks step 2.* finish"):
        training.release("mine", tmp_path / "run", "", directory=tmp_path / "weights")
    with pytest.raises(ValueError, match="weights 'modelnet40' already exist"):
        training.release("modelnet40", tmp_path / "run", "", directory=tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


def test_the_data_of_a_card_is_what_was_trained_on(tmp_path):
    (tmp_path / "ours" / "train").mkdir(parents=True)
    (tmp_path / "ours" / "train" / "icl_nuim.h5").touch()
    (tmp_path / "theirs" / "test").mkdir(parents=True)
    (tmp_path / "theirs" / "test" / "icl_nuim.h5").touch()
    called = {
        "ours": DataConfig(name="icl_nuim", label="test"),
        "modelnet40, training shapes: first20": DataConfig(train_categories="first20"),
        "folder my_scans": DataConfig(name="folder", folder="my_scans"),
    }
    for name, data in called.items():
        assert training_label(data, tmp_path) == name


def test_a_second_run_in_a_workdir_is_refused_while_the_first_goes_on(config, tmp_path):
    with (
        checkpoint.open_run(tmp_path, config),
        pytest.raises(ValueError, match="another process trains in .*--workdir"),
        checkpoint.open_run(tmp_path, config),
    ):
        pass
    with checkpoint.open_run(tmp_path, config):  # The lock has ended with the first run.
        pass


def test_a_full_disk_is_one_error_and_leaves_nothing(config, tmp_path, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with checkpoint.open_run(tmp_path, config) as run:
        with pytest.raises(OSError, match="No space left.*step 3.*same command") as caught:
            run.save(3, {"w": jnp.zeros(5)}, 0.1)
        assert not list(tmp_path.glob("*.part"))
        assert run._latest.latest_step() is None
    assert caught.value.filename == str(tmp_path)


def with_section(config, section, **values):
    part = dataclasses.replace(getattr(config, section), **values)
    return dataclasses.replace(config, **{section: part})


def test_training_starts_from_weights_of_the_same_network_only(config):
    state = jax.eval_shape(lambda: training.create_train_state(config))
    with pytest.raises(ValueError, match=r"'modelnet40' do not fit .*train with network = 'paper'"):
        training.started_from("modelnet40", state)
    with pytest.raises(ValueError, match="no released weights 'none-such'"):
        training.started_from("none-such", state)
    released, trained = load_pretrained("modelnet40")
    fits = jax.eval_shape(lambda: training.create_train_state(trained))
    started = training.started_from("modelnet40", fits)
    for given in (started.variables, started.average):
        jax.tree.map(np.testing.assert_array_equal, given, released)


@pytest.mark.parametrize("x64", [False, True])
def test_a_step_keeps_every_dtype_whatever_the_process_default(config, x64):
    """So that a run made with x64 loads without, and the other way round."""
    shapes = jax.ShapeDtypeStruct((4, 32, 3), np.float32)
    with jax.enable_x64(x64):
        state = jax.eval_shape(lambda: training.create_train_state(config))
        after, _ = jax.eval_shape(
            functools.partial(training.train_step, config=config), state, shapes
        )
    assert jax.tree.map(lambda x: x.dtype, after) == jax.tree.map(lambda x: x.dtype, state)
    assert not [x for x in jax.tree.leaves(state) if x.dtype == np.float64]


@pytest.mark.untyped
@pytest.mark.parametrize(
    ("section", "name", "value"),
    [
        ("model", "k", 0), ("model", "width", 0), ("model", "iterations", 0),
        ("model", "channels", ()), ("model", "channels", (8, 0)), ("model", "bn_momentum", 2.0),
        ("model", "alpha", float("nan")), ("model", "robust_rounds", -1),
        ("pairs", "jitter", -1.0), ("pairs", "translation_max", -1.0), ("pairs", "points", 0),
        ("pairs", "rotation_max_deg", 400.0), ("test_pairs", "outliers", -1),
        ("loss", "lambda_", -1.0), ("loss", "beta", 0.0), ("data", "train_shapes", 0),
    ],
)  # fmt: skip
def test_numbers_of_every_section_are_checked_before_the_work(
    config, tmp_path, section, name, value
):
    with pytest.raises(ValueError, match=rf"{section}\.{name} must be .*--"):
        training.train(with_section(config, section, **{name: value}), tmp_path / "run")
    assert not (tmp_path / "run").exists()
