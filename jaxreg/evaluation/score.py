"""From a configuration and the name of a method to the numbers of RESULTS.md.

Networks, classical methods and transforms from another program get the same pairs and the same
metrics.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxreg import __version__
from jaxreg.config import PEERS, Config, check_options, option_name
from jaxreg.data import dataset_label, icl_nuim, load_shapes, pair_sizes
from jaxreg.data.batches import given_pair_batches, key_of_tests, pair_batches, true_transforms
from jaxreg.data.pairs import shape_points
from jaxreg.evaluation import methods, metrics
from jaxreg.evaluation.parts import Parts, digest
from jaxreg.evaluation.run import evaluate_method, registered_batches, together
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.io.arrays import read_arrays
from jaxreg.io.places import whole
from jaxreg.progress import counting_progress
from jaxreg.refine.config import RefineConfig
from jaxreg.types import Pair, RigidTransform

_REFINEMENTS = ("icp", "point_to_plane", "gicp")
_ALIKE_DEG = 1.0
"""Rotations that differ by less than this in the median fit."""
_TRAINING_DATA = ("train_categories", "validation_share", "train_shapes", "train_draws")


class Scored(NamedTuple):
    """What `evaluate` returns (numpy): stacked transforms, the first pair, and how they were made."""

    method: str
    dataset: str
    predicted: RigidTransform
    truth: RigidTransform
    first: Pair
    seconds: float | None


class Stream(NamedTuple):
    """The test pairs of a configuration: how many, in batches of how many, and the batches.

    `batches(only=None)` takes the numbers of those to make, and yields what `pair_batches` does.
    `read` are the arrays that came from files; procedural shapes follow from the configuration.
    """

    count: int
    batch: int
    batches: Callable[..., Iterator[tuple[Pair, int]]]
    read: tuple[np.ndarray, ...]


def pair_stream(
    config: Config, *, root: str | Path | None, pairs: int = 0, batch: int = 8
) -> Stream:
    """The test pairs in batches; `pairs` limits them to the first so many.

    Raises:
      ValueError: the data is missing or malformed, it has no pairs although `config` asks for them,
        or it does not suit the sizes of the pairs.
    """
    key = key_of_tests(config.data.test_seed)
    if config.data.test_pairs_from == "file":
        source, target, transforms = _file_pairs(config, root, pairs)
        batch = min(batch, len(source))
        return Stream(
            len(source),
            batch,
            lambda only=None: given_pair_batches(
                (source, target), transforms, key, config=config.test_pairs, batch=batch, only=only
            ),
            (source, target, transforms),
        )
    points = shape_points(config.test_pairs)
    shapes, _ = load_shapes(config.data, "test", root=root, points=points)
    pair_sizes(config.test_pairs, shapes.shape[1])
    shapes = shapes[: pairs or None]
    batch = min(batch, len(shapes))
    return Stream(
        len(shapes),
        batch,
        lambda only=None: pair_batches(
            shapes, key, config=config.test_pairs, batch=batch, only=only
        ),
        () if config.data.name == "shapes" else (shapes,),
    )


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
    method: str = "",
    transforms: str = "",
    refine: str = "",
    pairs: int = 0,
    batch: int = 8,
    parts: Parts | None = None,
) -> Scored | None:
    """Evaluate one method on the test pairs of `config`.

    `method` is a name for `methods.choose` (by default the released weights that `config` names);
    networks take their `methods.AFTER_TRAINING` from `config.model`. Or `transforms` is a file of
    poses. `refine` (icp, point_to_plane or gicp; ten iterations without annealing, else the
    defaults of `RefineConfig`) improves the poses on the clouds afterwards.

    With `parts`, only this process' batches are registered, and kept in the folder; the result is
    None if those of other processes are not there yet. The seconds then are those of all processes.

    Raises:
      ValueError: both or neither of the two are given; an unknown method or refinement; missing
        data, weights or files.
    """
    for section in ("model", "test_pairs", "data"):
        check_options(section, getattr(config, section))
    name = _evaluated(config, method, transforms)
    improve = _refinement(refine)
    stream = pair_stream(config, root=root, pairs=pairs, batch=batch)
    label = (name or f"transforms of {Path(transforms).name}") + (f" + {refine}" if refine else "")
    given = None if name else _read_transforms(transforms, stream.count)
    function = methods.choose(name, model=config.model).batch if name else None
    if improve is not None:
        function = improve if function is None else methods.refined_method(function, improve)
    if function is None:
        assert given is not None  # one of the two was asked for
        found = given, true_transforms(stream.batches()), None
    elif parts is None:
        with counting_progress(stream.count, label) as progress:
            found = evaluate_method(function, stream.batches(), progress, initial=given)
    else:
        parts.opened(_identity(config, name, refine, given, stream))
        found = _in_parts(function, stream, parts, label, given)
    if found is None:
        return None
    first = jax.tree.map(lambda x: np.asarray(x)[0], next(stream.batches([0]))[0])
    return Scored(label, dataset_label(config.data, root), found[0], found[1], first, found[2])


def _identity(
    config: Config, name: str, refine: str, given: RigidTransform | None, stream: Stream
) -> dict[str, Any]:
    """All that the results follow from: what is in the files, wherever they lie on a host."""
    kind, settings, weights = name or "transforms", None, None
    if methods.is_network(name):
        variables, trained = methods.load_network_of(name)
        section = "model" if trained.network == "paper" else trained.network
        kind = name.partition(":")[0]
        settings = {trained.network: dataclasses.asdict(getattr(trained, section))}
        weights = digest(variables)
    asked = {
        "model": dataclasses.asdict(config.model),
        "test_pairs": dataclasses.asdict(config.test_pairs),
        "data": dataclasses.asdict(config.data) | {"folder": ""},
    }
    return {
        "version": __version__,
        "method": kind,
        "refine": refine,
        "network": settings,
        "weights": weights,
        "transforms": None if given is None else digest(given),
        "data": digest(stream.read) if stream.read else None,
        "pairs": stream.count,
        "batch": stream.batch,
        "config": asked,
    }


def _in_parts(
    function: Callable[..., RigidTransform],
    stream: Stream,
    parts: Parts,
    label: str,
    initial: RigidTransform | None,
) -> tuple[RigidTransform, RigidTransform, float] | None:
    """What `evaluate_method` gives, once the batches of all processes are there."""
    batches = -(-stream.count // stream.batch)
    own = parts.own(batches)
    numbered = ((k, *batch) for k, batch in zip(own, stream.batches(own), strict=True))
    # The last batch is filled up with pairs that are not counted.
    total = sum(min(stream.batch, stream.count - number * stream.batch) for number in own)
    with counting_progress(total, label) as progress:
        for number, found in registered_batches(function, numbered, initial=initial):
            parts.keep(number, found)
            progress(len(found.truth.rotation))
    if parts.missing(batches):
        return None
    return together(parts.kept(number) for number in range(batches))


def _evaluated(config: Config, method: str, transforms: str) -> str:
    """The name of what to evaluate; empty if transforms are given."""
    if method and transforms:
        raise ValueError(
            f"both a method ({method}) and transforms ({transforms}) are given: choose one of the two."
        )
    if not (method or transforms or config.weights):
        raise ValueError(
            "nothing to evaluate: choose a method or transforms, or released weights in the "
            f"configuration. Methods: {', '.join(methods.names())}."
        )
    return method or ("" if transforms else f"weights:{config.weights}")


def check_given(
    config: Config, given: Collection[str], *, method: str = "", transforms: str = ""
) -> None:
    """Refuse settings without effect, so nobody takes the results for what they are not.

    `given` names the fields of `config` that somebody set, as in `model.k`; the rest is as in
    `evaluate`.

    Raises:
      ValueError: one of them has no effect; the message says why, and what to give instead.
    """
    for name in given:
        if reason := _without_effect(config, name, method, transforms):
            raise ValueError(f"{option(config, name)} has no effect here: {reason}.")


def option(config: Config, name: str) -> str:
    """How a command line sets a field to its value, as in `--test-pairs.outliers 200`."""
    section, _, field = name.rpartition(".")
    value = getattr(getattr(config, section) if section else config, field)
    if isinstance(value, bool):
        section, dot, field = option_name(name).rpartition(".")
        return f"--{section}{dot}{'' if value else 'no-'}{field}"
    values = value if isinstance(value, tuple) else (value,)
    return " ".join([f"--{option_name(name)}", *map(str, values)])


def _without_effect(config: Config, name: str, method: str, transforms: str) -> str:
    """Why setting a field has no effect on an evaluation, and what to do; empty if it has one."""
    section, _, field = name.rpartition(".")
    if section == "pairs":
        instead = option(config, name).replace("--", "--test-", 1)
        return f"[pairs] are for training; to test on such pairs give {instead}"
    if section in ("loss", "train") or (section == "data" and field in _TRAINING_DATA):
        return "it belongs to the training; leave it out, or train with it"
    if name == "weights" and (method or transforms):
        return f"{method or transforms} is evaluated; leave out one of the two"
    sets_up = section in ("model", *PEERS) or name == "network"
    if not sets_up or not (method or transforms or config.weights):
        return ""
    trained = methods.trained_config(_evaluated(config, method, transforms))
    if trained is None:
        return f"{method or transforms} is not a network; leave it out"
    if section not in ("", "model" if trained.network == "paper" else trained.network):
        return f"the weights are those of network = '{trained.network}'; leave it out"
    there, here = (getattr(x, section) if section else x for x in (trained, config))
    value = getattr(there, field)
    if (section == "model" and field in methods.AFTER_TRAINING) or value == getattr(here, field):
        return ""
    return (
        f"the weights were trained with {field} = {value}; leave it out, or train with it and evaluate "
        "that run"
    )


def figures(scored: Scored) -> dict[str, Any]:
    """The metrics of an evaluation (`metrics.summarize`, degrees), and what was evaluated.

    Raises:
      ValueError: a predicted transform is not finite or not a rotation.
    """
    found = metrics.evaluate_transforms(scored.predicted, scored.truth)
    named = {"method": scored.method, "dataset": scored.dataset}
    return named | found | {"seconds_per_pair": scored.seconds}


def other_convention(scored: Scored) -> str:
    """A hint if the transforms are right in another convention than ``y = R x + t``; else empty."""
    predicted, truth = (
        RigidTransform(*(np.asarray(part, np.float64) for part in transform))
        for transform in (scored.predicted, scored.truth)
    )

    def median(rotation: np.ndarray) -> float:
        return float(np.median(rotation_angle_deg(rotation, truth.rotation)))

    transposed = np.swapaxes(predicted.rotation, 1, 2)
    here, there = median(predicted.rotation), median(transposed)
    if there > _ALIKE_DEG or here < 10 * max(there, _ALIKE_DEG):
        return ""
    back = -np.einsum("nij,nj->ni", transposed, predicted.translation)
    errors = (np.linalg.norm(t - truth.translation, axis=1) for t in (predicted.translation, back))
    same, inverse = map(np.median, errors)
    kind, remedy = (
        ("go from reference to source", "their inverses (R^T, -R^T t)")
        if inverse < same
        else ("are for row vectors, y = x R + t", "rotation.transpose(0, 2, 1)")
    )
    return (
        f"the transposed rotations fit: {there:.2g} degrees in the median, in place of {here:.3g}. It "
        f"seems that these transforms {kind}; in the convention here, y = R x + t from source to "
        f"reference, they are {remedy}."
    )


def _refinement(name: str) -> methods.BatchRefinement | None:
    if not name:
        return None
    if name not in _REFINEMENTS:
        raise ValueError(f"no refinement '{name}': choose one of {', '.join(_REFINEMENTS)}.")
    # From nearby: a kernel that starts ten times as wide, as for a pose that may be far off, has
    # pulled the exact pose of a flight of stairs to the next step. Ten iterations end where thirty do.
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
    # Opened here: numpy would add .npz to a name without it.
    with whole(Path(path)) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


def draw_first_pair(path: str | Path, scored: Scored) -> None:
    """Draw the first pair of an evaluation before and after, in the pose that was evaluated."""
    from jaxreg.view.pictures import plot_pair  # matplotlib, which an evaluation does not need

    source, reference, truth = scored.first
    transform = jax.tree.map(lambda x: np.asarray(x)[0], scored.predicted)
    moving, fixed = (
        np.asarray(cloud.points)[np.asarray(cloud.mask)] for cloud in (source, reference)
    )
    with whole(Path(path)) as part:
        plot_pair(moving, fixed, transform, part, truth=truth)
