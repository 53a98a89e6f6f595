"""Clouds as other libraries hold them: Open3D, PyVista, trimesh, pandas, masked arrays."""

import numpy as np
from jaxtyping import Bool, Float

_FEWEST = 1000
"""Vertices; the corners of a mesh of fewer say nothing of the surface between them."""


def points_of(cloud: object, name: str) -> object:
    """The points of an object that has some, as an array or what numpy understands; else itself.

    `points` of Open3D and PyVista, `point.positions` of Open3D's tensors, `vertices` of trimesh and of
    meshes, the columns x, y, z of tables and of structured arrays.

    Raises:
      ValueError: it is a mesh of fewer than 1000 vertices.
    """
    if isinstance(cloud, np.ndarray):
        names = cloud.dtype.names or ()
        if not set("xyz") <= set(names):
            return cloud
        stack = np.ma.stack if isinstance(cloud, np.ma.MaskedArray) else np.stack
        return stack([cloud[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    if hasattr(cloud, "columns") and hasattr(cloud, "to_numpy"):
        return _of_table(cloud)
    for attribute in ("points", "vertices"):
        found = getattr(cloud, attribute, None)
        if found is not None and not callable(found):
            _check_mesh(cloud, len(found), name)
            return found if isinstance(found, np.ma.MaskedArray) else np.asarray(found)
    positions = getattr(getattr(cloud, "point", None), "positions", None)
    return cloud if positions is None else positions.cpu().numpy()


def unmasked(
    given: object, array: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """The array with NaN in the rows that a masked array masks, and which rows these are."""
    if not isinstance(given, np.ma.MaskedArray):
        return array, np.zeros(len(array), bool)
    masked = np.asarray(np.ma.getmaskarray(given).any(axis=1), bool)
    return np.where(masked[:, None], np.nan, array), masked


def _of_table(table) -> object:
    lower = {str(column).lower(): column for column in table.columns}
    if set("xyz") <= set(lower):
        return table[[lower[axis] for axis in "xyz"]].to_numpy()
    return table


def _check_mesh(cloud: object, vertices: int, name: str) -> None:
    for attribute, sampled in (
        ("triangles", "sample_points_uniformly(20_000).points"),
        ("faces", "sample(20_000)"),
    ):
        faces = getattr(cloud, attribute, None)
        if faces is None or callable(faces) or len(faces) == 0 or vertices >= _FEWEST:
            continue
        if hasattr(cloud, sampled.split("(")[0]):
            raise ValueError(
                f"{name} is a mesh of {vertices} vertices, too few to stand for its surface: give "
                f"points of that, as in {name}.{sampled}."
            )
