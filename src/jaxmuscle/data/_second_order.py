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
# of K, B and I, by the unit of the response
UNITS = {"N/m": ("N/m", "N s/m", "kg"), "N m/rad": ("N m/rad", "N m s/rad", "kg m²")}


class SecondOrder(NamedTuple):
    """`value` and `stderr` of K [N/m], B [N s/m], I [kg] and, if fitted, of the delay τ [s]; chi²
    over its expectation, and how probable one so large is if the response has that shape."""

    value: Parameters
    stderr: Parameters
    chi2: float
    p: float


def second_order_shape(frequency: Float[np.ndarray, " bins"], parameters: Parameters) -> np.ndarray:
    """H = (K + iωB - ω²I) e^{-iωτ} [N/m], ω = 2πf; τ = 0 if there are three parameters."""
    k, b, i, *delay = parameters
    s = 2j * np.pi * frequency
    return (k + s * b + s**2 * i) * np.exp(-s * sum(delay))


def second_order_fit(response: Response, delayed: bool) -> SecondOrder:
    """K, B and I, and a delay, by least squares weighted with the response's errors.

    What a bin sees of the shape is its mean over the frequencies in that bin. The errors take the
    correlation of neighbouring bins into account. Where chi² is more than it should be, since the
    muscle has another shape, they are multiplied by √(chi² / its expectation).

    `p`: the square of every residual, made shorter as in `FrequencyResponse.p_none`, has the chi²
    distribution; their sum is compared with that of the same mean and variance.
    """
    f, weight = response.centre, 1 / np.tile(response.stderr, 2)
    count = 3 + delayed
    remedy = "too few for a fit; excite a wider band, or take longer segments"
    require(2 * f.size > count, "bins", f.size, remedy)
    scale, shapes = _terms(response)
    scale = np.append(scale, 1 / (2 * np.pi * f.max()))[:count]

    def residuals(x: Parameters) -> Float[np.ndarray, " twice"]:
        return parts(_seen(response, x * scale) - response.value) * weight

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
    squares = np.sum(found.fun.reshape(2, -1) ** 2, axis=0)
    averages = averages_of(response.value, response.stderr, response.coherence)
    total = np.sum(shortened(squares, averages))
    left = covariance - found.jac @ inverse @ (found.jac.T @ covariance)
    unit = np.sum(left * left.T) / expected  # half of the variance over the mean
    p = float(scipy.stats.chi2.sf(total / unit, expected / unit))
    return SecondOrder(found.x * scale, np.sqrt(np.diag(spread) * max(chi2, 1.0)) * scale, chi2, p)


def averages_of(value: np.ndarray, stderr: np.ndarray, coherence: np.ndarray) -> np.ndarray:
    """How many independent averages errors and coherence imply: (1 - γ²) |H|² / (2 γ² stderr²)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return (1 - coherence) / (2 * coherence) * (np.abs(value) / stderr) ** 2


def shortened(squares: np.ndarray, averages: np.ndarray) -> np.ndarray:
    """`|e|² / stderr²` of errors that are estimated from so many averages n, so that it has the
    chi² distribution: 2 (n - 1) ln(1 + |e|² / (2 (n - 1) stderr²))."""
    # fewer than one average and a bit would be divided by nothing
    spare = np.maximum(2 * (averages - 1), 1e-3)
    return spare * np.log1p(squares / spare)


def _seen(response: Response, parameters: Parameters) -> np.ndarray:
    """What the bins of a response see of `second_order_shape`."""
    k, b, i, *delay = parameters
    turn = 2j * np.pi
    return (k + turn * response.centre * b + turn**2 * response.square * i) * np.exp(
        -turn * response.centre * sum(delay)
    )


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
    shapes = np.stack([parts(_seen(response, unit * scale)) for unit in np.eye(3)], axis=1)
    return scale, shapes / np.tile(response.stderr, 2)[:, None]


def parts(values: Complex[np.ndarray, " bins"]) -> Float[np.ndarray, " twice"]:
    """Real parts, then imaginary parts."""
    return np.concatenate([np.real(values), np.imag(values)])
