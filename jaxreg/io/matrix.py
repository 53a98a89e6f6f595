"""A rigid transform as a file: the 4x4 matrix, as text, NPY or JSON."""

import json
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxreg.io.decoding import decoded, with_points
from jaxreg.io.places import reading


def read_matrix(path: Path) -> Float[np.ndarray, "4 4"]:
    """A 4x4 matrix from text, NPY, or the JSON that `jaxreg register` writes.

    The text may be in any encoding and have decimal commas.

    Raises:
      ValueError: there is no such file, it is a directory, it may not be read, or it does not
        contain a 4x4 matrix.
    """
    remedy = "write four lines of four numbers"
    with reading(path):
        try:
            matrix = np.asarray(_content(path), float)
        except (ValueError, KeyError, TypeError, EOFError) as error:
            raise ValueError(f"{path} does not contain a 4x4 matrix ({error}): {remedy}.") from None
    if matrix.shape != (4, 4):
        raise ValueError(f"{path} contains an array {matrix.shape}, not a 4x4 matrix: {remedy}.")
    return matrix


def _content(path: Path) -> object:
    if path.suffix.lower() == ".json":
        content = json.loads(decoded(path, path.read_bytes()))
        return content["transformation"] if isinstance(content, dict) else content
    if path.suffix.lower() == ".npy":
        return np.load(path, allow_pickle=False)
    text = decoded(path, path.read_bytes())
    numbers = words(text)
    if len(numbers) != 16:  # The commas may be decimal marks, and tear numbers apart.
        numbers = words(with_points(text.encode()).decode())
    return np.array(numbers, float).reshape(4, 4)


def words(text: str) -> list[str]:
    """The numbers in a text; comments, brackets and commas may be there, as Python prints them."""
    return re.sub(r"#.*|[\[\],;]", " ", text).split()


def turn_of(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation R of a matrix ``s R``: what turns normals, which keep their length."""
    volume = float(np.linalg.det(matrix))
    return matrix if abs(volume - 1) < 1e-9 else matrix / np.cbrt(volume)
