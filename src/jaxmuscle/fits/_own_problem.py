"""A fit as functions of numbers, for optimisers and samplers of one's own: `jm.fits.problem`. No
other file calls it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import all_concrete, require
from jaxmuscle._common.cards import Card, Shown
from jaxmuscle._common.text import choices
from jaxmuscle._common.types import Scalar
from jaxmuscle.data._as_target import as_target
from jaxmuscle.model._noises import with_noise
from jaxmuscle.model._parameters import proper_values
from jaxmuscle.model._task import require_task
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import at_mean, planned
from jaxmuscle.objective._consequences import expand
from jaxmuscle.objective._coordinates import task_at
from jaxmuscle.objective._likelihood import Likelihood, require_spread
from jaxmuscle.objective._moment_models import Linear
from jaxmuscle.objective._options import DataOptions, FitOptions
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.response._expected import Moments

Theta = Float[Array | np.ndarray, " free"]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Problem(Shown):
    """A fit as functions of numbers without bounds: give them to any optimiser or sampler. Made by
    `problem`.

    `names` are the free parameters, `start` is θ at the task's own values, an array with a number
    for each name. A parameter with bounds is `v = low + (high - low) sigmoid(θ)`; of a positive one
    these are logarithms, and a low of 0 counts as none. If it has only one bound, the other is set
    20 prior standard deviations from the task's value. A parameter without bounds is `ln v = ln
    v0 + sd θ`, or `v = v0 + sd θ` where it may be negative: v0 the task's value, sd the prior's (1
    if flat).

    All methods are functions of θ that JAX compiles and differentiates, also twice:
    `jax.hessian(problem.log_density)`. Turn on double precision first
    (`jax.config.update("jax_enable_x64", True)`): in single precision a search ends early.

    `fit_problem`, `objective` and `likelihood` are what the functions are made of, for the package
    itself.
    """

    names: tuple[str, ...]
    start: Float[np.ndarray, " free"]
    fit_problem: FitProblem
    objective: Residuals
    likelihood: Likelihood | None

    @classmethod
    def of(cls, given: FitProblem, shares: "list[np.ndarray] | None" = None) -> "Problem":
        """For the package itself (you use `jaxmuscle.fits.problem`): of the problem of a fit.
        `shares`: for each target the share of each bin that the harmonic holds, if known."""
        c = given.coordinates
        targets = [part.target for part in given.parts]
        known = all(
            t.segments is not None or t.sigma is not None or not len(t.bins) for t in targets
        )
        likelihood = Likelihood.of(given) if known else None
        return cls(
            c.names, c.from_theta(np.zeros(len(c.names))), given, given.linear(shares), likelihood
        )

    def parameters(self, theta: Theta) -> dict[str, Scalar]:
        """The parameters by name, in their units."""
        return self.objective.coordinates.values(self._scaled(theta))

    def theta(self, parameters: Mapping[str, Scalar]) -> Theta:
        """θ of parameters by name, in their units; those not named are at their start. The inverse
        of `parameters`.

        JAX may trace the values; a traced value outside the bounds of the fit is NaN.

        Raises `ValueError` for a name that is not free and for a value outside the bounds of the
        fit.
        """
        c, given = self.fit_problem.coordinates, proper_values(parameters)
        if unknown := [name for name in given if name not in self.names]:
            raise ValueError(
                f"{unknown[0]!r} is not free in this problem: {choices(unknown[0], self.names)}"
            )
        return c.unbounded(
            [given.get(name, start) for name, start in zip(self.names, c.centre, strict=True)]
        )

    def task(self, theta: Theta) -> AbstractTask:
        """The task with these parameters."""
        part = self.objective.parts[0]
        return task_at(part.task, part.coordinates, self._scaled(theta))

    def residuals(self, theta: Theta) -> Float[Array, " residuals"]:
        """What a fit makes small, `½ Σ r²`: those of the data in standard deviations, then those of
        the prior."""
        scaled = self._scaled(theta)
        return self.objective.residuals(scaled, self._moments(scaled), self.objective.data)

    def log_likelihood(self, theta: Theta) -> Scalar:
        """Log likelihood of the target, up to a constant.

        `jaxmuscle.objective.log_likelihood` is the same, but for a coefficient of variation:
        there it scatters as in the task that is given, here as in the task at `start`, or at the θ
        of `scattering_as`. So the density that a sampler draws from has one scatter.

        Raises `ValueError` for a target that states neither segments nor sigma.
        """
        if self.likelihood is None:
            require_spread(self.fit_problem.parts[0].target)
        assert self.likelihood is not None
        return self.likelihood.marginal(self._moments(self._scaled(theta)))

    def log_prior(self, theta: Theta) -> Scalar:
        """Log density of the prior as one of θ, up to a constant. Where a prior is None it is flat
        in the parameter (of a positive one in its logarithm), and improper unless that has bounds.
        """
        scaled, stretch = self._scaled(theta), self.objective.coordinates.log_stretch(theta)
        return stretch - 0.5 * jnp.sum((self.objective.prior_root @ scaled) ** 2)

    def log_density(self, theta: Theta) -> Scalar:
        """Log density of the posterior as one of θ, `log_likelihood + log_prior`: what a sampler
        asks for.

        It is -inf where the model cannot be computed, which is more than about ten prior standard
        deviations away.

        Raises `ValueError` as `log_likelihood` does.
        """
        found = self.log_likelihood(theta) + self.log_prior(theta)
        return jnp.where(jnp.isnan(found), -jnp.inf, found)

    def scattering_as(self, theta: Theta) -> "Problem":
        """The problem whose data scatter as the model at θ says.

        A bin in which the harmonic holds a share ρ of the power scatters less: it has 1 / (1 - ρ²)
        times as many degrees of freedom. The coefficient of variation scatters less, too
        (docs/fitting.md, *What is minimised*). A fit goes on with this when it has come near its
        minimum: do the same for the same minimum.
        """
        with jax.enable_x64(True):
            scaled = np.asarray(self.fit_problem.coordinates.theta(np.asarray(theta, dtype=float)))
            seen = expand(self.fit_problem.linear(), scaled[None]).row(0)
            shares = [np.clip(np.nan_to_num(m.line / m.power), 0.0, 1.0) for m in seen.moments]
            return Problem.of(
                self.fit_problem.scattering_as(self.fit_problem.tasks_at(scaled)), shares
            )

    def _scaled(self, theta: Any) -> Any:
        """What the objective is a function of. Raises `ValueError` for anything but one number for
        each name."""
        if isinstance(theta, Mapping):
            raise ValueError(
                "theta is a dictionary: give problem.theta(values), which makes an array of it"
            )
        if np.shape(theta) != (len(self.names),):
            raise ValueError(
                f"theta has the shape {np.shape(theta)}, this problem takes ({len(self.names)},), a"
                f" number for each of {', '.join(self.names)}: use jax.vmap for several"
            )
        return self.objective.theta(jnp.asarray(theta))

    def _moments(self, scaled: Any) -> tuple[Moments, ...]:
        found = []
        for part in self.objective.parts:
            assert isinstance(part.model, Linear)
            found.append(part.model.moments(task_at(part.task, part.coordinates, scaled)))
        return tuple(found)

    def _card(self) -> Card:
        heading = f"problem of {self.fit_problem.title} with {len(self.names)} free parameters"
        return self.fit_problem.coordinates.card(heading)


def problem(
    task: AbstractTask,
    target: Any,
    *,
    mean_force: tuple[float, float] | Literal[False] | None = None,
    **options: Unpack[DataOptions],
) -> Problem:
    """What `fit` minimises, for an optimiser or a sampler of your own: residuals, log density,
    names, start.

        problem = jm.fits.problem(task, target)
        found = scipy.optimize.least_squares(jax.jit(problem.residuals), problem.start)
        problem.parameters(found.x)

    The model is that of the linear response; `task` is fitted as it is, without the richer models
    that `fit` may try.

    **Arguments:**

    - `task`: the model; its values are the prior's centre. Not traced by JAX
    - `target`: in any form that `fit` takes but a perturbed recording
    - `free`, `fix`, `noise`, `bounds`, `priors`, `coefficient_of_variation`, `mean_force`: as in
      `fit`

    **Returns:** a `Problem`. **Raises:** `ValueError` as `fit` does.
    """
    require_task(task, "problem(task, target)")
    require(
        all_concrete((task, options.get("noise"))),
        "task: JAX is tracing it (inside jit, grad or vmap), but a problem is made from numbers."
        " Make it outside, and give its functions what changes:"
        " problem.log_density(problem.theta({'k_w': ...}))",
    )
    target = as_target(target)
    with jax.enable_x64(True):
        given = FitOptions.of(problem, DataOptions, options, mean_force=mean_force)
        task, given = at_mean(with_noise(task, given.noise, given.fix), target, given)
        return Problem.of(planned(task, target, given).problem)
