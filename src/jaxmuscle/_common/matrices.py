"""Products and exponentials of small matrices in compiled code."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

HALVINGS = 20


def product(
    a: Inexact[Array, "*#many n m"], b: Inexact[Array, "*#many m k"]
) -> Inexact[Array, "*#many n k"]:
    """`a @ b` as a sum of outer products, which XLA joins with its surroundings: a call costs more
    for small matrices."""
    terms = [a[..., :, i, None] * b[..., None, i, :] for i in range(a.shape[-1])]
    return sum(terms[1:], terms[0])


def exponential(x: Inexact[Array, "*many n n"]) -> Inexact[Array, "*many n n"]:
    """exp(x), for norms up to about 10⁵.

    `E = exp(x / 2²⁰) - 1` by Taylor's series to the sixth power, then doubled twenty times, `E ← 2
    E + E²`. As 1 is added last, halving too often loses no digits. The operations are the same
    whatever the norm. `jax.scipy.linalg.expm` computes five Padé approximants where it is mapped,
    and takes more than ten times as long for a few states.
    """
    x = x / 2.0**HALVINGS
    square = product(x, x)
    cube = product(square, x)
    small = x + square / 2 + cube / 6 + product(cube, x / 24 + square / 120 + cube / 720)
    whole, _ = jax.lax.scan(lambda e, _: (2 * e + product(e, e), None), small, length=HALVINGS)
    return whole + jnp.eye(x.shape[-1], dtype=x.dtype)
