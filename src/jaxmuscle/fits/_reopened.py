"""A fit taken up again: from its result back to the problem, for likelihoods, profiles and posteriors."""

from collections.abc import Iterable, Mapping

import numpy as np
from jax import Array

from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.objective._arguments import DT, planned
from jaxmuscle.objective._problem import Setup
from jaxmuscle.response._linearised import has_response

from ._result import FitResult


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
