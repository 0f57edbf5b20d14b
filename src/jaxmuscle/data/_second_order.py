"""The classical description of a dynamic stiffness: a spring, a damper and a mass, with or without
a pure delay."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxmuscle._common.arguments import require
from jaxmuscle.spectra._cross_spectrum import Response

# a delay that is told of: in standard errors, and chi² without it over chi² with it
SURE, WORSE = 4.0, 2.0


Parameters = Float[np.ndarray, " parameters"]


class SecondOrder(NamedTuple):
    """`value` and `stderr` of K [N/m], B [N s/m], I [kg] and, if fitted, of the delay τ [s]; chi²
    over its expectation."""

    value: Parameters
    stderr: Parameters
    chi2: float


def second_order_shape(frequency: Float[np.ndarray, " bins"], parameters: Parameters) -> np.ndarray:
    """H = (K + iωB - ω²I) e^{-iωτ} [N/m], ω = 2πf; τ = 0 if there are three parameters."""
    k, b, i, *delay = parameters
    s = 2j * np.pi * frequency
    return (k + s * b + s**2 * i) * np.exp(-s * sum(delay))


def second_order_fit(response: Response, delayed: bool) -> SecondOrder:
    """K, B and I, and a delay, by least squares weighted with the response's errors.

    The errors take the correlation of neighbouring bins into account. Where chi² is more than it
    should be, since the muscle has another shape, they are multiplied by √(chi² / its expectation).
    """
    f, weight = response.centre, 1 / np.tile(response.stderr, 2)
    count = 3 + delayed
    remedy = "too few for a fit; excite a wider band, or take longer segments"
    require(2 * f.size > count, "bins", f.size, remedy)
    scale, shapes = _terms(response)
    scale = np.append(scale, 1 / (2 * np.pi * f.max()))[:count]

    def residuals(x: Parameters) -> Float[np.ndarray, " twice"]:
        return parts(second_order_shape(f, x * scale) - response.value) * weight

    start = np.linalg.lstsq(shapes, parts(response.value) * weight)[0]
    found = scipy.optimize.least_squares(
        residuals, np.append(start, 0.0)[:count], x_scale="jac", jac="3-point"
    )
    inverse = np.linalg.pinv(found.jac.T @ found.jac)
    c = response.correlation
    covariance = np.block([[np.real(c), -np.imag(c)], [np.imag(c), np.real(c)]])
    # neighbouring bins share errors, which the weights of the fit leave out
    inner = found.jac.T @ covariance @ found.jac
    spread = inverse @ inner @ inverse
    expected = 2 * f.size - np.trace(inverse @ inner)
    chi2 = float(2 * found.cost / expected)
    return SecondOrder(found.x * scale, np.sqrt(np.diag(spread) * max(chi2, 1.0)) * scale, chi2)


def lateness(response: Response) -> list[str]:
    """A notice if the force is surely later or earlier than a spring, a damper and a mass explain,
    else nothing."""
    if 2 * response.centre.size <= 4:
        return []
    without, found = (second_order_fit(response, delayed) for delayed in (False, True))
    delay, error = found.value[3], found.stderr[3]
    if abs(delay) < SURE * error or without.chi2 < WORSE * found.chi2:
        return []
    by, when = f"{1e3 * abs(delay):.2g} ± {1e3 * error:.1g} ms", "late" if delay > 0 else "early"
    return [
        f"the force comes {by} {when}, beyond what a spring, a damper and a mass explain. A filter"
        " in one of the channels does that; so can a muscle of two parts in series, by a little."
        " If your devices state a delay, correct for it (--delay, in s; Python: delay=). Left in,"
        " it makes damping and stiffness wrong"
    ]


def lengthens(response: Response) -> float:
    """By how much chi² is lower if the displacement counts lengthening as positive; below 0: if it
    counts shortening.

    A spring, a damper and a mass, none of them negative, are fitted to H and to -H. Over the chi²
    of the better one for each number, where that is more than 1.
    """
    values = parts(response.value) / np.tile(response.stderr, 2)
    signed = (scipy.optimize.nnls(_terms(response)[1], sign * values)[1] for sign in (1, -1))
    as_it_is, turned = (norm**2 for norm in signed)
    return float((turned - as_it_is) / max(1.0, min(turned, as_it_is) / values.size))


def _terms(response: Response) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "twice 3"]]:
    """Scales of K, B and I, and the response to one of each, in standard errors."""
    f = response.centre
    scale = np.abs(response.value).max() / (2 * np.pi * f.max()) ** np.arange(3)
    shapes = np.stack([parts(second_order_shape(f, unit * scale)) for unit in np.eye(3)], axis=1)
    return scale, shapes / np.tile(response.stderr, 2)[:, None]


def parts(values: Complex[np.ndarray, " bins"]) -> Float[np.ndarray, " twice"]:
    """Real parts, then imaginary parts."""
    return np.concatenate([np.real(values), np.imag(values)])
