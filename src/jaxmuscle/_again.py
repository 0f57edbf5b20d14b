"""A fit taken up again: from its result back to the problem, for likelihoods, profiles and posteriors."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jax import Array

from ._climb import Peak, climb
from ._fit import DT, planned
from ._likelihood import Likelihood
from ._linear import has_response
from ._parameter import PARAMETERS
from ._problem import Setup
from ._result import FitResult
from ._starts import candidate_frequencies
from ._target import Target

FREQUENCIES = 32


def taken_up(
    result: FitResult,
    target: Target | None = None,
    *,
    free: Iterable[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, float | tuple[float, float | None] | None] | None = None,
    key: Array | int = 0,
) -> Setup:
    """The setup of the fit that gave the result, in linear response; needs double precision.

    `priors` {name: sd, or (centre, sd)} and `bounds` go before those of the fit. Raises `ValueError` for a fit that failed
    and for a task without linear response.
    """
    if not np.all(np.isfinite(result.fitted)):
        raise ValueError(f"the fit of {result.target.name} failed ({result.message}): fit again first")
    has_response(result.task, required=True)
    settings = result.settings
    names = tuple(settings["free"] if free is None else free)
    centres = {n: settings.get("prior_centre", {}).get(n, _default(result, n)) for n in names}
    sds = {n: settings["prior_sd"].get(n, PARAMETERS[n].prior_sd if n in PARAMETERS else 1.0) for n in names}
    for name, given in (priors or {}).items():
        if name not in names:
            raise ValueError(f"priors: {name} is not free; free are {', '.join(names)}")
        centres[name], sds[name] = given if isinstance(given, tuple) else (centres[name], given)
    limits = {n: tuple(b) for n, b in settings.get("bounds", {}).items() if n in names} | dict(bounds or {})
    for name, (low, high) in limits.items():
        if name in centres and not low < centres[name] < high:
            raise ValueError(f"the prior of {name} is centred at {centres[name]:g}, outside its bounds ({low:g}, {high:g}): "
                             "give priors={name: (centre, sd)} inside them, or wider bounds")  # fmt: skip
    plan = planned(
        result.task.replace(**centres),
        result.target if target is None else target,
        free=names,
        residual=settings["residual"],
        key=key,
        bounds=limits,
        priors=sds,
        coefficient_of_variation=settings["coefficient_of_variation"],
        mean_force=None if settings["mean_force"] is None else tuple(settings["mean_force"]),
        dt=settings.get("dt", DT),
    )
    return plan.setup.scattering_as(result.task.with_parts(settings=plan.setup.target.settings))


def _default(result: FitResult, name: str) -> float:
    return PARAMETERS[name].default if name in PARAMETERS else float(result.task[name])


def theta_of(setup: Setup, task: Any) -> np.ndarray:
    """Coordinates of a task's values."""
    c = setup.coordinates
    values = np.array([float(task[name]) for name in c.names])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(c.positive, np.log(values / c.centre), values - c.centre) / c.sd


def points_about(setup: Setup, theta: np.ndarray) -> np.ndarray:
    """A point with the harmonic's frequency as it is and at the target's local maxima and over the band, amplitude free."""
    names = setup.coordinates.names
    if "harmonic_frequency" not in names:
        return theta[None]
    points = np.tile(theta, (FREQUENCIES, 1))
    frequencies = candidate_frequencies(setup.target, FREQUENCIES - 1)
    points[1:, names.index("harmonic_frequency")] = setup.coordinates.theta_of("harmonic_frequency", frequencies)
    if "harmonic_amplitude" in names:
        points[1::2, names.index("harmonic_amplitude")] = 0.0
    return points


def highest(setup: Setup, likelihood: Likelihood, theta: np.ndarray, precision: np.ndarray) -> tuple[Peak, int]:
    """Maxima climbed to from `points_about`, and which of them is the highest."""
    peak = climb(likelihood, points_about(setup, theta), precision)
    if not np.isfinite(peak.cost[peak.best]):
        raise ValueError(f"{setup.target.name}: the likelihood is not finite anywhere near the fit")
    return peak, peak.best
