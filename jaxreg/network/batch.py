"""Many pairs of clouds through the network: any sizes, any number, in a stream."""

import functools
import itertools
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import dtypes

from jaxreg.config import Config, ModelConfig, model_config
from jaxreg.geometry.clouds import sizes_of_pair
from jaxreg.network.model import Variables, register_pair
from jaxreg.types import Registration

_TOGETHER = 64
"""Pairs in one call where there is an accelerator; on a CPU one pair alone is the fastest."""
_WINDOW = 8
"""So many calls' worth of pairs are sorted by size before they are run."""


class _Numbered(NamedTuple):
    """A pair as it was given, padded to its bucket; `count` is the number of source rows given."""

    number: int
    count: int
    clouds: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def register_batch(
    variables: Variables,
    sources: Iterable[Any],
    references: Iterable[Any],
    *,
    config: Config | ModelConfig,
    source_masks: Iterable[Any] | None = None,
    reference_masks: Iterable[Any] | None = None,
    together: int | None = None,
) -> Iterator[Registration]:
    """`register_pair` of many pairs, in their order; one numpy `Registration` after the other.

    `sources` and `references` are lists or streams of clouds (n, 3) of any sizes, or padded arrays
    (b, n, 3) with masks (b, n). Pairs are read as they are needed, so that a stream of any length
    takes constant memory. Clouds are padded to few sizes (both of a pair to one, 4, 5, 6 or 7 times a
    power of two; to coarser steps if one is over twice as large as the other), each of which compiles
    one program; the rows of a result are those of the given source. `together`
    pairs are computed at once: None means one on a CPU, where that is the fastest, else 64.

    Raises:
      ValueError: there are more sources than references, or fewer; a cloud is not (n, 3) of floats
        (the message names it by its number); or what `register_pair` raises.
    """
    model = model_config(config)
    together = together or (1 if jax.default_backend() == "cpu" else _TOGETHER)
    pairs = _padded_pairs(sources, references, source_masks, reference_masks)
    while window := list(
        itertools.islice(pairs, together if together == 1 else _WINDOW * together)
    ):
        found = {}
        for part in _parts(window, together):
            found |= _run(variables, part, together, model)
        yield from (found[pair.number] for pair in window)


@functools.partial(jax.jit, static_argnames="config")
def _registered(variables, source, reference, source_mask, reference_mask, *, config):
    def one(source, reference, source_mask, reference_mask):
        return register_pair(
            variables,
            source,
            reference,
            config=config,
            source_mask=source_mask,
            reference_mask=reference_mask,
        )

    return jax.vmap(one)(source, reference, source_mask, reference_mask)


def _run(
    variables: Variables, part: list[_Numbered], together: int, config: ModelConfig
) -> dict[int, Registration]:
    """The results of pairs of one bucket, by their numbers."""
    # Filled up with the last pair, because another number of pairs would be another program.
    filled = part + [part[-1]] * (together - len(part))
    batch = [np.stack(arrays) for arrays in zip(*(pair.clouds for pair in filled), strict=True)]
    found = jax.tree.map(np.asarray, _registered(variables, *batch, config=config))
    results = {}
    for row, pair in enumerate(part):
        one = jax.tree.map(lambda leaf, row=row: leaf[row], found)
        results[pair.number] = one._replace(
            confidence=one.confidence[: pair.count],
            correspondences=one.correspondences[: pair.count],
        )
    return results


def _parts(window: list[_Numbered], together: int) -> Iterator[list[_Numbered]]:
    """Pairs of one bucket, at most `together` of them."""
    size = lambda pair: tuple(len(array) for array in pair.clouds)  # noqa: E731
    for _, group in itertools.groupby(sorted(window, key=size), key=size):
        group = list(group)
        for start in range(0, len(group), together):
            yield group[start : start + together]


_MISSING = object()


def _padded_pairs(sources, references, source_masks, reference_masks) -> Iterator[_Numbered]:
    streams = {
        "sources": sources,
        "references": references,
        "source_masks": source_masks,
        "reference_masks": reference_masks,
    }
    streams = {name: stream for name, stream in streams.items() if stream is not None}
    for number, row in enumerate(itertools.zip_longest(*streams.values(), fillvalue=_MISSING)):
        given = dict(zip(streams, row, strict=True))
        if short := [name for name, part in given.items() if part is _MISSING]:
            raise ValueError(
                f"there is no {short[0]}[{number}]: give as many of it as of the other arguments."
            )
        yield _padded(number, given)


def _padded(number: int, given: dict[str, Any]) -> _Numbered:
    clouds = [_cloud(f"{name}[{number}]", given[name]) for name in ("sources", "references")]
    masks = [
        _mask(f"{name}[{number}]", given.get(name), len(cloud))
        for name, cloud in zip(("source_masks", "reference_masks"), clouds, strict=True)
    ]
    sizes = _sizes(*map(len, clouds))
    source, reference = (
        np.pad(cloud, ((0, size - len(cloud)), (0, 0)))
        for cloud, size in zip(clouds, sizes, strict=True)
    )
    here, there = (np.pad(m, (0, size - len(m))) for m, size in zip(masks, sizes, strict=True))
    return _Numbered(number, len(clouds[0]), (source, reference, here, there))


def _cloud(name: str, points: Any) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f" or len(points) == 0:
        raise ValueError(
            f"{name} has shape {points.shape} and dtype {points.dtype}: give one point per row, "
            "(n, 3) of float32 or float64."
        )
    return points.astype(dtypes.canonicalize_dtype(points.dtype))


def _mask(name: str, mask: Any, count: int) -> np.ndarray:
    if mask is None:
        return np.ones(count, bool)
    mask = np.asarray(mask)
    if mask.dtype != bool or mask.shape != (count,):
        raise ValueError(
            f"{name} has shape {mask.shape} and dtype {mask.dtype}: give {(count,)} of bools, True "
            "for every row that is a point."
        )
    return mask


def _sizes(source: int, reference: int) -> list[int]:
    """The padded sizes of a pair of clouds.

    Of two clouds that are far apart in size every step of the one meets every step of the other, so the
    steps are coarser: 4 and 6 times a power of two for the larger, powers of two for the smaller. That
    makes 25 programs of 68 for clouds of 300 to 3000 points, with a twentieth more work.
    """
    counts = source, reference
    fine = sizes_of_pair([_bucket(count) for count in counts])
    if fine[0] == fine[1]:
        return fine
    return [
        _bucket(n, steps=2 if size == max(fine) else 1)
        for n, size in zip(counts, fine, strict=True)
    ]


def _bucket(count: int, *, steps: int = 4) -> int:
    """The smallest size, of so many between one power of two, from 64 on, and the next, for `count`."""
    power = max(64, 2 ** max(0, (count - 1).bit_length() - 1))
    step = power // steps
    return power + step * max(0, -(-(count - power) // step))
