"""Types that many modules share."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

if TYPE_CHECKING:
    Scalar = Any  # a union of numbers and arrays supports no arithmetic in the eyes of a type checker
    Key = PRNGKeyArray | Array | np.ndarray | np.integer | int
    Seed = Array | np.integer | int
else:
    Key = Seed = Any  # checked by `keys.key_of` and `keys.seed_of`, with a sentence
    Scalar = Float[Array, "..."] | Float[np.ndarray, "..."] | float | int
