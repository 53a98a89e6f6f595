"""What a file holds besides its points: one record for every format."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

TWO_COLUMNS = "two columns: z is 0"
"""The note of a file of x and y alone."""


class Scan(NamedTuple):
    """The points of a file, and what a reader of them should know ("a mesh of 12 faces ...").

    `viewpoint` is where the scanner stood, in the coordinates of the points, if the file says so.
    """

    points: Float[np.ndarray, "n 3"]
    notes: tuple[str, ...] = ()
    viewpoint: Float[np.ndarray, "3"] | None = None
