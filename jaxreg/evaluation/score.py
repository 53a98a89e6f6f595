"""From a configuration and the name of a method to the figures of RESULTS.md.

Networks, classical methods and transforms that another program made meet the same pairs and the same
metrics.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxreg.config import Config
from jaxreg.data import dataset_label, icl_nuim, load_shapes, pair_sizes
from jaxreg.data.batches import given_pair_batches, pair_batches, test_key
from jaxreg.data.pairs import shape_points
from jaxreg.evaluation import methods, metrics
from jaxreg.evaluation.methods import choose_method
from jaxreg.evaluation.run import evaluate_method
from jaxreg.io.arrays import read_arrays
from jaxreg.peers.rienet import load_rienet
from jaxreg.progress import counting_progress
from jaxreg.refine.config import RefineConfig
from jaxreg.types import Pair, RigidTransform
from jaxreg.weights import checkpoint as checkpoints
from jaxreg.weights.checkpoint import load_checkpoint
from jaxreg.weights.released import available_weights, load_pretrained

_REFINEMENTS = ("icp", "point_to_plane", "gicp")
AFTER_TRAINING = ("iterations", "n_inliers", "robust_rounds")
"""Fields of the model that cost nothing to change after training."""


class Scored(NamedTuple):
    """What `evaluate` finds (numpy): stacked transforms, the first pair, and how they were made."""

    method: str
    dataset: str
    predicted: RigidTransform
    truth: RigidTransform
    first: Pair
    seconds: float | None


def trained_config(config: Config, *, checkpoint: str = "", rienet: str = "") -> Config:
    """The configuration that a network was trained with, chosen as by `evaluate`.

    Raises:
      ValueError: there is no such checkpoint, file, or name of released weights.
    """
    if rienet:
        return load_rienet(rienet)[1]
    if checkpoint:
        return checkpoints.best_config(checkpoint)[0]
    return load_pretrained(config.weights)[1]


def _network(config: Config, checkpoint: str, rienet: str) -> tuple[str, methods.Method]:
    """A trained network with the architecture it was trained with; `AFTER_TRAINING` as in `config`."""
    if rienet:
        label, (variables, trained) = "rienet", load_rienet(rienet)
    elif checkpoint:
        label, (variables, trained) = f"checkpoint {checkpoint}", load_checkpoint(checkpoint)
    else:
        label, (variables, trained) = f"jaxreg ({config.weights})", load_pretrained(config.weights)
    chosen = {name: getattr(config.model, name) for name in AFTER_TRAINING}
    model = dataclasses.replace(trained.model, **chosen)
    return label, methods.network_method(variables, model)


def pair_stream(
    config: Config, *, root: str | Path | None, pairs: int = 0, batch: int = 8
) -> tuple[int, Iterator[tuple[Pair, int]]]:
    """The number of test pairs, and the pairs in batches; `pairs` takes the first so many.

    Raises:
      ValueError: the data is missing or malformed, it comes without pairs although `config` wants
        those, or the sizes of the pairs do not fit it.
    """
    key = test_key(config.data.test_seed)
    if config.data.test_pairs_from == "file":
        source, target, transforms = _file_pairs(config, root, pairs)
        batches = given_pair_batches(
            (source, target),
            transforms,
            key,
            config=config.test_pairs,
            batch=min(batch, len(source)),
        )
        return len(source), batches
    points = shape_points(config.test_pairs)
    shapes, _ = load_shapes(config.data, "test", root=root, points=points)
    pair_sizes(config.test_pairs, shapes.shape[1])
    shapes = shapes[: pairs or None]
    batch = min(batch, len(shapes))
    return len(shapes), pair_batches(shapes, key, config=config.test_pairs, batch=batch)


def _file_pairs(config: Config, root: str | Path | None, pairs: int) -> tuple[np.ndarray, ...]:
    if config.data.name != "icl_nuim" or root is None:
        raise ValueError(
            f"data.test_pairs_from = 'file' needs data.name = 'icl_nuim' (got '{config.data.name}') "
            "and its folder: give --data-root or set $JAXREG_DATA."
        )
    return tuple(array[: pairs or None] for array in icl_nuim.load_pairs(root))


def evaluate(
    config: Config,
    *,
    root: str | Path | None = None,
    checkpoint: str = "",
    rienet: str = "",
    method: str = "",
    transforms: str = "",
    refine: str = "",
    pairs: int = 0,
    batch: int = 8,
) -> Scored:
    """Evaluate one method on the test pairs of `config`.

    One of `checkpoint`, `rienet` (the file of its weights), `method` and `transforms` chooses it; with
    none of them it is the released weights that `config` names. `refine` (icp, point_to_plane or
    gicp; ten iterations without annealing, else the defaults of `RefineConfig`) improves its poses on
    the clouds afterwards.

    Raises:
      ValueError: more than one method is chosen, or none; an unknown refinement; missing data,
        weights or files.
    """
    chosen = [x for x in (checkpoint, rienet, method, transforms) if x]
    if len(chosen) > 1 or not (chosen or config.weights):
        raise ValueError(
            "choose one of --checkpoint, --rienet, --method and --transforms; without any, "
            "--weights or the configuration must name released weights "
            f"({', '.join(available_weights())})."
        )
    improve = _refinement(refine)
    count, batches = pair_stream(config, root=root, pairs=pairs, batch=batch)
    first: list[Pair] = []
    batches = _keep_first(batches, first)
    given = _read_transforms(transforms, count) if transforms else None
    if given is not None and not refine:
        predicted, seconds = given, None
        truth = batches.true_transforms(batches)
        label = f"transforms of {Path(transforms).name}"
    else:
        if given is not None:
            label, function = f"transforms of {Path(transforms).name}", improve
        elif method:
            label, function = method, choose_method(method)
        else:
            label, function = _network(config, checkpoint, rienet)
        if refine and given is None:
            function = methods.refined_method(function, improve)
        label = f"{label} + {refine}" if refine else label
        with counting_progress(count, label) as progress:
            predicted, truth, seconds = evaluate_method(function, batches, progress, initial=given)
    return Scored(label, dataset_label(config.data, root), predicted, truth, first[0], seconds)


def figures(scored: Scored) -> dict[str, Any]:
    """The metrics of an evaluation (`metrics.summarize`, degrees), and what it was of.

    Raises:
      ValueError: a predicted transform is not finite or no rotation.
    """
    found = metrics.evaluate_transforms(scored.predicted, scored.truth)
    named = {"method": scored.method, "dataset": scored.dataset}
    return named | found | {"seconds_per_pair": scored.seconds}


def score(config: Config, *, save_transforms: str = "", **chosen: Any) -> dict[str, Any]:
    """The figures of `evaluate`, whose arguments these are; errors as those of both.

    `save_transforms` names an NPZ file for the predicted transforms.
    """
    scored = evaluate(config, **chosen)
    if save_transforms:
        _save(save_transforms, scored.predicted._asdict())
    return figures(scored)


def _keep_first(
    batches: Iterator[tuple[Pair, int]], first: list[Pair]
) -> Iterator[tuple[Pair, int]]:
    """The same batches; the first pair of all is put into `first`, to be drawn as it was evaluated."""
    for pair, count in batches:
        if not first:
            first.append(jax.tree.map(lambda x: np.asarray(x)[0].copy(), pair))
        yield pair, count


def _refinement(name: str) -> methods.Refinement | None:
    if not name:
        return None
    if name not in _REFINEMENTS:
        raise ValueError(f"no refinement '{name}': choose one of {', '.join(_REFINEMENTS)}.")
    # From nearby: a kernel that starts ten times as wide, as for a pose that may be far off, has drawn
    # the exact pose of a flight of stairs to the next step. Ten iterations end where thirty do.
    return methods.refinement(RefineConfig(method=name, kernel_annealing=1.0, iterations=10))


def _read_transforms(path: str, count: int) -> RigidTransform:
    remedy = "give an NPZ file with numbers `rotation` (n, 3, 3) and `translation` (n, 3)"
    arrays = read_arrays(path, ("rotation", "translation"), remedy=remedy)
    transform = RigidTransform(arrays["rotation"], arrays["translation"])
    for name, array in transform._asdict().items():
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{path}: `{name}` is of type {array.dtype}: {remedy}.")
    if transform.rotation.shape != (count, 3, 3) or transform.translation.shape != (count, 3):
        raise ValueError(
            f"{path}: {count} pairs need rotation ({count}, 3, 3) and translation ({count}, 3), got "
            f"{transform.rotation.shape} and {transform.translation.shape}."
        )
    return transform


def save_pairs(path: str | Path, batches: Iterator[tuple[Pair, int]]) -> None:
    """Write pairs to an NPZ file: `source`, `reference` (n, p, 3) and their masks (n, p)."""
    parts = [jax.tree.map(lambda x, c=count: np.asarray(x)[:c], pair) for pair, count in batches]
    pair = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    arrays = {
        "source": pair.source.points,
        "source_mask": pair.source.mask,
        "reference": pair.reference.points,
        "reference_mask": pair.reference.mask,
    }
    _save(path, arrays)


def save_transforms(path: str | Path, transforms: RigidTransform) -> None:
    """Write stacked transforms to an NPZ file: `rotation` (n, 3, 3) and `translation` (n, 3)."""
    _save(path, transforms._asdict())


def _save(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    # Opened here: to a name without .npz numpy would add it.
    with Path(path).open("wb") as file:
        np.savez(file, **arrays)


def draw_first_pair(path: str | Path, scored: Scored) -> None:
    """Draw the first pair of an evaluation before and after, in the pose that was evaluated."""
    from jaxreg.view.pictures import plot_pair  # matplotlib, which an evaluation does not need

    source, reference, truth = scored.first
    transform = jax.tree.map(lambda x: np.asarray(x)[0], scored.predicted)
    plot_pair(
        source.points[source.mask], reference.points[reference.mask], transform, path, truth=truth
    )
