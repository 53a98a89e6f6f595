"""From a configuration and the name of a method to the figures of RESULTS.md.

Networks, classical methods and transforms that another program made meet the same pairs and the same
metrics.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxreg import classical, evaluation, metrics, report
from jaxreg.config import Config, RefineConfig
from jaxreg.data import dataset_label, icl_nuim, load_shapes, pair_sizes
from jaxreg.predecessor import load_predecessor
from jaxreg.pretrained import available_weights, load_pretrained
from jaxreg.training import load_checkpoint, shape_points
from jaxreg.types import Pair, RigidTransform

_REFINEMENTS = ("icp", "point_to_plane", "gicp")
_AFTER_TRAINING = ("iterations", "n_inliers", "robust_rounds")


def choose_method(name: str) -> evaluation.Method:
    """A method that needs no weights: `identity`, `icp` (ours), or a classical baseline.

    Raises:
      ValueError: the name is unknown (the message lists them), or its library is not installed.
    """
    match name:
        case "identity":
            return evaluation.identity_method
        case "icp":
            return evaluation.icp_method
    return evaluation.host_method(classical.choose(name))


def _network(config: Config, checkpoint: str, predecessor: str) -> tuple[str, evaluation.Method]:
    """A trained network with the architecture it was trained with.

    What costs nothing to change after training follows `config`: the iterations, N_c and the
    robust rounds of the Procrustes.
    """
    if predecessor:
        label, (variables, trained) = "predecessor", load_predecessor(predecessor)
    elif checkpoint:
        label, (variables, trained) = f"checkpoint {checkpoint}", load_checkpoint(checkpoint)
    else:
        label, (variables, trained) = f"jaxreg ({config.weights})", load_pretrained(config.weights)
    chosen = {name: getattr(config.model, name) for name in _AFTER_TRAINING}
    model = dataclasses.replace(trained.model, **chosen)
    return label, evaluation.network_method(variables, model)


def pair_stream(
    config: Config, *, root: str | Path | None, pairs: int = 0, batch: int = 8
) -> tuple[int, Iterator[tuple[Pair, int]]]:
    """The number of test pairs, and the pairs in batches; `pairs` takes the first so many.

    Raises:
      ValueError: the data is missing or malformed, it comes without pairs although `config` wants
        those, or the sizes of the pairs do not fit it.
    """
    key = evaluation.test_key(config.data.test_seed)
    if config.data.test_pairs_from == "file":
        source, target, transforms = _file_pairs(config, root, pairs)
        batches = evaluation.given_pair_batches(
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
    return len(shapes), evaluation.pair_batches(shapes, key, config=config.test_pairs, batch=batch)


def _file_pairs(config: Config, root: str | Path | None, pairs: int) -> tuple[np.ndarray, ...]:
    if config.data.name != "icl_nuim" or root is None:
        raise ValueError(
            f"data.test_pairs_from = 'file' needs data.name = 'icl_nuim' (got '{config.data.name}') "
            "and its folder: give --data-root or set $JAXREG_DATA."
        )
    return tuple(array[: pairs or None] for array in icl_nuim.load_pairs(root))


def score(
    config: Config,
    *,
    root: str | Path | None = None,
    checkpoint: str = "",
    predecessor: str = "",
    method: str = "",
    transforms: str = "",
    refine: str = "",
    pairs: int = 0,
    batch: int = 8,
    save_transforms: str = "",
) -> dict[str, Any]:
    """Evaluate one method on the test pairs of `config`; returns the figures, in degrees.

    One of `checkpoint`, `predecessor` (its weights file), `method` and `transforms` chooses it; with
    none of them it is the released weights that `config` names. `refine` (icp, point_to_plane or
    gicp, with the defaults of `RefineConfig` but no annealing) improves its poses on the clouds
    afterwards.

    Raises:
      ValueError: more than one method is chosen, or none; an unknown refinement; missing data,
        weights or files.
    """
    chosen = [x for x in (checkpoint, predecessor, method, transforms) if x]
    if len(chosen) > 1 or not (chosen or config.weights):
        raise ValueError(
            "choose one of --checkpoint, --predecessor, --method and --transforms; without any, "
            "--weights or the configuration must name released weights "
            f"({', '.join(available_weights())})."
        )
    improve = _refinement(refine)
    count, batches = pair_stream(config, root=root, pairs=pairs, batch=batch)
    given = _read_transforms(transforms, count) if transforms else None
    if given is not None and not refine:
        predicted, seconds = given, None
        truth = evaluation.true_transforms(batches)
        label = f"transforms of {Path(transforms).name}"
    else:
        if given is not None:
            label, function = f"transforms of {Path(transforms).name}", improve
        elif method:
            label, function = method, choose_method(method)
        else:
            label, function = _network(config, checkpoint, predecessor)
        if refine and given is None:
            function = evaluation.refined_method(function, improve)
        label = f"{label} + {refine}" if refine else label
        with report.counting_progress(count, label) as progress:
            predicted, truth, seconds = evaluation.evaluate_method(
                function, batches, progress, initial=given
            )
    if save_transforms:
        np.savez(save_transforms, **predicted._asdict())
    figures = metrics.evaluate_transforms(predicted, truth)
    dataset = dataset_label(config.data, root)
    return {"method": label, "dataset": dataset} | figures | {"seconds_per_pair": seconds}


def _refinement(name: str) -> evaluation.Refinement | None:
    if not name:
        return None
    if name not in _REFINEMENTS:
        raise ValueError(f"no refinement '{name}': choose one of {', '.join(_REFINEMENTS)}.")
    # From nearby: a kernel that starts ten times as wide, as for a pose that may be far off, has drawn
    # the exact pose of a flight of stairs to the next step.
    return evaluation.refinement(RefineConfig(method=name, anneal=1.0))


def _read_transforms(path: str, count: int) -> RigidTransform:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            transform = RigidTransform(arrays["rotation"], arrays["translation"])
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path} must be an NPZ file with `rotation` (n, 3, 3) and `translation` (n, 3): {error}."
        ) from None
    if transform.rotation.shape != (count, 3, 3) or transform.translation.shape != (count, 3):
        raise ValueError(
            f"{path}: {count} pairs need rotation ({count}, 3, 3) and translation ({count}, 3), got "
            f"{transform.rotation.shape} and {transform.translation.shape}."
        )
    return transform


def save_pairs(path: str, batches: Iterator[tuple[Pair, int]]) -> None:
    """Write pairs to an NPZ file: `source`, `reference` (n, p, 3) and their masks (n, p)."""
    parts = [jax.tree.map(lambda x, c=count: np.asarray(x)[:c], pair) for pair, count in batches]
    pair = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    np.savez(
        path,
        source=pair.source.points,
        source_mask=pair.source.mask,
        reference=pair.reference.points,
        reference_mask=pair.reference.mask,
    )


def draw_first_pair(
    path: str,
    config: Config,
    *,
    root: str | Path | None = None,
    checkpoint: str = "",
    predecessor: str = "",
    method: str = "",
) -> None:
    """Draw the first test pair before and after registration as PNG."""
    _, batches = pair_stream(config, root=root, pairs=1, batch=1)
    pair, _ = next(batches)
    if method:
        function = choose_method(method)
    else:
        _, function = _network(config, checkpoint, predecessor)
    predicted = function(pair)
    first = jax.tree.map(lambda x: np.asarray(x)[0], (pair, predicted))
    (source, reference, truth), transform = first
    report.plot_pair(
        source.points[source.mask], reference.points[reference.mask], transform, path, truth=truth
    )
