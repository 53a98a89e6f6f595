"""Registration as a program in one file, for where there is no Python to trace it.

`export_program` writes StableHLO by `jax.export`; `load_exported` runs such a file. It needs neither
the network's code nor its weights, and traces nothing; XLA compiles it for the device at hand.
"""

import dataclasses
import functools
import json
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Bool, Float

from jaxreg import types  # registers the records that programs return

VERSION = 1
"""Of the file: a zip of `card.json` and `program.bin`, the serialised `jax.export.Exported`."""
GLOBAL = "register_global"
"""The program that needs no weights; every other one is `register_pair` with weights of that name."""
LEAST, MOST = 256, 2048
"""Points of a cloud that a program with symbolic sizes takes; larger ones are matched in blocks."""
_CARD, _PROGRAM = "card.json", "program.bin"
_NO_PROGRAM = "{} is no program of jaxreg: write one by jaxreg export."


@dataclasses.dataclass(frozen=True)
class ExportedProgram:
    """A program from a file: call it with two clouds (n, 3) and (m, 3), as the function it was made of.

    `name` is "register_global", or that of the weights. `points` are the numbers of rows (n, m) that
    it takes: fewer are padded and masked, or, where `points` is None, any number from 256 to 2048.
    `platforms` are those it was made for.

    Under `jax.vmap` the pairs are computed one after the other; it has no derivative; and it may be
    pickled.
    """

    name: str
    points: tuple[int, int] | None
    platforms: tuple[str, ...]
    _exported: export.Exported = dataclasses.field(repr=False)

    def __call__(
        self,
        source: Float[Array | np.ndarray, "n 3"],
        reference: Float[Array | np.ndarray, "m 3"],
        *,
        source_mask: Bool[Array | np.ndarray, "n"] | None = None,
        reference_mask: Bool[Array | np.ndarray, "m"] | None = None,
    ) -> types.Registration | types.GlobalRegistration:
        """The result of the function that was exported; float32, a row for every row of the source.

        Raises:
          ValueError: a cloud is not (n, 3), has more rows than the program takes, or its mask is not
            (n,) of bools; or a derivative is asked for.
        """
        count = len(source)
        sides = (("source", source, source_mask), ("reference", reference, reference_mask))
        arrays = [
            self._padded(name, points, mask, side)
            for side, (name, points, mask) in enumerate(sides)
        ]
        (source, here), (reference, there) = arrays
        found = self._call(source, reference, here, there)
        return found._replace(
            confidence=found.confidence[:count], correspondences=found.correspondences[:count]
        )

    def __reduce__(self) -> tuple[Any, ...]:
        written = bytes(self._exported.serialize())
        return _restored, (self.name, self.points, self.platforms, written)

    @functools.cached_property
    def _call(self) -> Callable[..., Any]:
        # JAX has no rule to batch such a program, which was made for one pair.
        call = jax.custom_jvp(jax.custom_batching.sequential_vmap(self._exported.call))

        @call.defjvp
        def derivative(_, __):
            raise ValueError(
                f"the program of {self.name} was exported without derivatives: differentiate the "
                "function that it was made of (jaxreg.register_global, jaxreg.register_pair), or take "
                "jax.lax.stop_gradient of the clouds."
            )

        return jax.jit(call)

    def _padded(self, name: str, points: Any, mask: Any, side: int) -> tuple[Array, Array]:
        points = jnp.asarray(points, jnp.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"{name} has shape {points.shape}: give one point per row, (n, 3).")
        count = points.shape[0]
        mask = jnp.ones(count, bool) if mask is None else jnp.asarray(mask)
        if mask.shape != (count,) or mask.dtype != bool:
            raise ValueError(
                f"{name}_mask has shape {mask.shape} and dtype {mask.dtype}: give ({count},) of bools."
            )
        least, most = (LEAST, MOST) if self.points is None else (1, self.points[side])
        if not least <= count <= most:
            raise ValueError(
                f"{name} has {count} points and this program takes {least} to {most}: thin the cloud, "
                "or export a program for more (jaxreg export --points N M)."
            )
        fill = 0 if self.points is None else most - count
        return jnp.pad(points, ((0, fill), (0, 0))), jnp.pad(mask, (0, fill))


def export_program(
    path: str | Path,
    name: str = GLOBAL,
    *,
    points: tuple[int, int] = (1024, 1024),
    symbolic: bool = False,
    platforms: Sequence[str] = ("cpu",),
) -> Path:
    """Write a registration of two clouds as a program; `load_exported` runs it.

    `name` is "register_global", or released weights or the folder of a run, with which
    `register_pair` is written, or `register` of another network. `points` are the largest numbers
    of points (n, m); with `symbolic`, which the search cannot do, any from 256 to 2048. `platforms`
    are those of JAX: cpu, cuda, rocm, tpu. The file holds the weights. Returns its path.

    Raises:
      ValueError: there are no such weights or platforms, the search is asked for symbolic sizes, or
        a size is below 16.
    """
    platforms = tuple(platforms)
    if not platforms:
        raise ValueError("no platform is given: choose from cpu, cuda, rocm and tpu.")
    if unknown := set(platforms) - {"cpu", "cuda", "rocm", "tpu"}:
        raise ValueError(f"platforms {unknown}: choose from cpu, cuda, rocm and tpu.")
    if symbolic and name == GLOBAL:
        raise ValueError(
            f"{GLOBAL} has no program for any size: its search compares the sizes. Give --points N M; "
            "smaller clouds are padded."
        )
    if not symbolic and min(points) < 16:
        raise ValueError(f"points = {points}: a cloud needs 16 points or more.")
    sizes = _symbols() if symbolic else points
    least = LEAST if symbolic else min(points)
    clouds = [jax.ShapeDtypeStruct((size, 3), jnp.float32) for size in sizes]
    masks = [jax.ShapeDtypeStruct((size,), jnp.bool_) for size in sizes]
    program = export.export(jax.jit(_function(name, least)), platforms=platforms)(*clouds, *masks)
    card = {
        "version": VERSION,
        "name": name,
        "points": None if symbolic else list(points),
        "platforms": list(platforms),
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(_CARD, json.dumps(card, indent=1))
        file.writestr(_PROGRAM, bytes(program.serialize()))
    return Path(path)


def load_exported(path: str | Path) -> ExportedProgram:
    """A program that `export_program` wrote; compiled at its first call.

    Raises:
      ValueError: there is no such file, it cannot be read, it is no program, was written by a newer
        jaxreg, or is too old or too new for the JAX at hand.
    """
    card, program = _unpacked(path)
    if card["version"] > VERSION:
        raise ValueError(
            f"{path} has version {card['version']} and this jaxreg reads up to {VERSION}: install a "
            "newer one, or export the program again."
        )
    try:
        exported = export.deserialize(bytearray(program))
    except Exception as error:  # noqa: BLE001 - JAX raises what its parsers choose
        raise ValueError(
            f"{path} cannot be read by JAX {jax.__version__} ({error}): export it again."
        ) from None
    try:
        points = None
        if card["points"] is not None:
            source, reference = card["points"]
            points = int(source), int(reference)
        return ExportedProgram(card["name"], points, tuple(card["platforms"]), exported)
    except (KeyError, TypeError, ValueError):
        raise ValueError(_NO_PROGRAM.format(path)) from None


def _restored(
    name: str, points: tuple[int, int] | None, platforms: tuple[str, ...], program: bytes
) -> ExportedProgram:
    """What was pickled."""
    return ExportedProgram(name, points, platforms, export.deserialize(bytearray(program)))


def _unpacked(path: str | Path) -> tuple[dict[str, Any], bytes]:
    """The card, which has a version, and the program of a file; raises as `load_exported`."""
    try:
        with zipfile.ZipFile(path) as file:
            card, program = json.loads(file.read(_CARD)), file.read(_PROGRAM)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path.") from None
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read ({error.strerror or error}): name a file of jaxreg export."
        ) from None
    # A damaged zip raises what it is made of: zlib's errors, encryption, unknown compressions.
    except (zipfile.BadZipFile, zlib.error, KeyError, ValueError, RuntimeError, EOFError):
        raise ValueError(_NO_PROGRAM.format(path)) from None
    if not isinstance(card, dict) or not isinstance(card.get("version"), int):
        raise ValueError(_NO_PROGRAM.format(path))
    return card, program


def _symbols() -> tuple[Any, ...]:
    bounds = [f"{size} {bound}" for size in "nm" for bound in (f">= {LEAST}", f"<= {MOST}")]
    return tuple(export.symbolic_shape("n, m", constraints=bounds))


def _function(name: str, least: int) -> Callable[..., Any]:
    """The function of a name, for clouds of at least so many rows."""
    if name == GLOBAL:
        from jaxreg.search.pipeline import register_global

        return lambda source, reference, source_mask, reference_mask: register_global(
            source, reference, source_mask=source_mask, reference_mask=reference_mask
        )
    from jaxreg.peers import by_name  # Flax, which a loaded program does without
    from jaxreg.weights.released import load_network

    variables, config = load_network(name)
    if config.network == "paper" and least < config.model.n_inliers:
        raise ValueError(
            f"{name} keeps {config.model.n_inliers} correspondences: give points of that many or more."
        )
    return lambda source, reference, source_mask, reference_mask: by_name.register(
        variables, source, reference, config=config,
        source_mask=source_mask, reference_mask=reference_mask,
    )  # fmt: skip
