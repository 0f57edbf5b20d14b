"""Types that many modules share."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

if TYPE_CHECKING:
    # a union of numbers and arrays supports no arithmetic in the eyes of a type checker
    Scalar = Any
    Key = PRNGKeyArray | Array | np.ndarray | np.integer | int
    Seed = Array | np.integer | int
    Seeds = int | np.integer | Sequence[int] | np.ndarray
else:
    Key = Seed = Seeds = Any  # checked by `keys.key_of` and `keys.seed_of`, with a sentence
    Scalar = Float[Array, "..."] | Float[np.ndarray, "..."] | np.floating | float | int
