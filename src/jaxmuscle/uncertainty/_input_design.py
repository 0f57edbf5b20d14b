"""The motion of the insertion from which a quantity becomes best known."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Unpack

import jax
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle._common.arguments import check_options
from jaxmuscle._common.arrays import as_numbers, require
from jaxmuscle._common.keys import check_key, key_of
from jaxmuscle._common.text import choices
from jaxmuscle._common.types import Key
from jaxmuscle.data._target import Target
from jaxmuscle.fits._result import FitResult
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedLength
from jaxmuscle.objective._arguments import MASSES, planned
from jaxmuscle.objective._derived import TANGENTS, derived_names, has_tangents
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.response._expected_spectrum import expected_spectrum

from ._design_information import (
    Square,
    Theta,
    coordinates_of,
    design_information,
    expansion_at,
    with_open_masses,
)
from ._designed_input import DesignedInput
from ._designs import moved_insertion, without_noise
from ._identifiability import LEAST_PRIOR, Here, fitted_problem, misfit_notices
from ._identifiability_report import BASE, NO_NOISE
from ._lengthening import Largest, Lengthening, Lines
from ._multisine import Motion, MotionOptions

WIDTH, FEWEST = 0.15, 5  # of a step of the density: relative to its frequency; lines in it at least
TRIES = 4  # how often the density follows the crest factors of its motion
CREST = (1.6, 2.0, 2.5)  # of position, velocity and acceleration, to begin with
LONGEST = 1e4  # times the record
NOTHING = 1e-4  # of the relative variance, by which a motion must lower it


def design_input(
    result: FitResult | AbstractTask,
    quantity: str | Iterable[str] = "K_w0",
    *,
    target: str | None = None,
    key: Key = 0,
    error: float | None = None,
    **options: Unpack[MotionOptions],
) -> DesignedInput:
    """The motion of the insertion, within limits, whose record makes a quantity best known.

        made = jm.uncertainty.design_input(result, "K_w0", rms=1e-3, band=(0.5, 5.0))

    The density S_x(f) of the displacement that minimises the sum of the relative variances of the
    quantities q,

        Σ_q g_qᵀ (I_0 + I[S_x])⁻¹ g_q / q²
        I[S_x] = 2T ∫ Re(∂H* ∂Hᵀ) S_x(f) / S(f) df,    ∫ S_x df <= rms²

    I_0 is the information that is there without the motion: the fit's data and prior, and the
    fluctuations of the new record. The masses are fitted with the record: their errors are in those
    of q. H is the `dynamic_stiffness`, S the `noise_density`, T the length of the record. The
    problem is convex. S_x is constant in steps 0.15 f wide, or of five lines. It is then realised
    as a multisine, periodic in T, with phases that keep the peaks low. Everything reported is of
    this motion.

    **Arguments:**

    - `result` of a fit, or a task, whose usual free parameters are then free with their prior
    - `quantity`: a free parameter or a derived quantity such as K_w0, K_z0, C_w0, C_z0,
      K_w_tangent, or several. In a fit of several targets write "K_w_tangent@NAME" for that of one.
      Without "@NAME" it is that of `target`, if you give one; otherwise that of the first target
      that has a dynamic stiffness, or of the first of all if none has
    - `rms` [m], `peak` [m], `speed` [m/s], `acceleration` [m/s²]: at most; where the motion would
      pass `peak`, `speed` or `acceleration` it gets smaller or slower
    - `band` [Hz]: from 0.5 Hz on, as drift and slow movements of the person are not in the model
    - `seconds`: length of the record and period
    - `rate` [Hz] of the motion
    - `key` of its phases
    - `spread`: the share of the mean square that is even over the band (a motion of few lines could
      be foreseen, and would not test the model)
    - `target`: of a fit with several targets, the one whose task and spectrum settings the new
      record takes over (by default the first)
    - `error`: relative, 0.1 say: how long a record takes until every quantity is known to that

    **Raises:** `ValueError` for an unknown quantity or one that is fixed, or of which no motion
    tells; for limits that are not positive, a band that holds no line or reaches beyond half the
    rate, seconds that are no whole number of samples; `OperatingPointError` for a task without
    linear response.
    """
    check_options(design_input, MotionOptions, options)
    asked = Motion(**options)
    require(
        error is None or 0 < error < 1,
        f"error = {error} must be a share between 0 and 1, 0.1 for 10 %",
    )
    check_key(key)
    quantities = (quantity,) if isinstance(quantity, str) else tuple(quantity)
    crest, rms = np.array(CREST), [asked.rms, np.inf, np.inf]
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key_of(key))).tolist())
    with jax.enable_x64(True):
        even = Lengthening.flat(asked.rms, asked.band, asked.seconds)
        experiment = Experiment.of(result, quantities, even, target)
        displacement, _ = asked.realise(even.power, rng)
        even = even.of_motion(displacement)
        # What limits a motion are its peaks, which follow from its density: both in turn.
        for _ in range(TRIES if np.isfinite(min(asked.limits)) else 1):
            power = experiment.best(np.minimum(asked.limits / crest, rms), asked.spread)
            displacement, crest = asked.realise(power, rng)
        own, known = even.of_motion(displacement), experiment.here.values
        length = None
        if error is not None:
            length = error, asked.seconds * experiment.times_for(own.power, error)
        return DesignedInput(
            experiment.quantity,
            asked,
            own,
            even,
            displacement,
            values={n: value for n, (value, _) in known.items()},
            units={n: unit for n, (_, unit) in known.items()},
            prior=experiment.by_prior(),
            now=experiment.errors(None),
            flat=experiment.errors(even.power),
            stderr=experiment.errors(own.power),
            needed=length,
            notices=misfit_notices(result) if isinstance(result, FitResult) else (),
            masses=experiment.masses,
            held=experiment.held,
            moved=experiment.moved,
        )


def _full_name(name: str, known: Mapping[str, Any], targets: Iterable[str | None]) -> str:
    """A quantity by the name that it has in a fit of several targets, of the first that has it:
    "K_w_tangent@moved"."""
    return next(
        (n for n in (name, *(f"{name}@{target}" for target in targets)) if n in known), name
    )


class Experiment(NamedTuple):
    """What is known without the motion: by the `prior`, `start` of it and all data, information
    `apart` from the response; that of its lines."""

    here: Here
    quantity: tuple[str, ...]
    masses: dict[str, float]
    held: tuple[str, ...]
    prior: Theta
    start: Square
    apart: Square
    frequency: Lines
    lines: Float[np.ndarray, "lines free free"]
    moved: bool

    @classmethod
    def of(
        cls,
        given: FitResult | AbstractTask,
        quantity: Iterable[str],
        record: Lengthening,
        target: str | None,
    ) -> "Experiment":
        """Of a record, at the values of a fit or task. Needs double precision."""
        fitted, theta, derived = _problem(given)
        if without_noise(fitted):
            raise ValueError(f"result: {NO_NOISE}")
        fitted = dataclasses.replace(fitted, parts=tuple(map(_held_by_motor, fitted.parts)))
        problem = with_open_masses(fitted)
        theta = np.append(theta, np.zeros(len(problem.prior) - len(theta)))
        tangents = problem.by_name(
            [dict.fromkeys(TANGENTS if has_tangents(part.task) else ()) for part in problem.parts]
        )
        here = Here.of(problem, expansion_at(problem, theta), dict.fromkeys([*derived, *tangents]))
        moved = [part.name for part in fitted.parts if part.target.stiffness is not None]
        targets = [target, *moved, *(part.name for part in fitted.parts)]
        quantity = tuple(_full_name(name, here.gradients, targets) for name in quantity)
        for name in quantity:
            if name not in here.gradients:
                raise ValueError(f"quantity {name!r}{_unknown(name, problem, here)}")
        design = moved_insertion(
            record, problem.parts[0].target.settings, coefficient_of_variation=True, target=target
        )
        like = design.like(problem)
        task: Any = _with_motor(like.task).with_parts(settings=like.target.settings)
        # a response tells how the muscle is damped, so the ratio needs no prior of its own
        prior = problem.prior
        start = np.diag(prior) + (here.information if isinstance(given, FitResult) else 0.0)
        still = dataclasses.replace(design, task=task, lengthening=None)
        own, coordinates = coordinates_of(like, theta, task)
        lines = np.zeros((len(record.frequency), *start.shape))
        lines[:, own[:, None], own] = record.by_line(task, coordinates, theta[own])
        fixed = set(MASSES) - set(design.like(fitted).coordinates.names)
        masses = {n: float(task[n]) for n in MASSES if n in fixed and n in task.parameter_names}
        return cls(
            here,
            quantity,
            masses,
            tuple(name for name in masses if name not in coordinates.names),
            prior,
            start,
            start + design_information(problem, theta, still),
            record.frequency,
            lines,
            bool(moved),
        )

    @property
    def rows(self) -> Float[np.ndarray, "quantities free"]:
        """Relative slopes of the quantities; those of what has either sign in its unit."""
        rows = [self.here.gradients[n] / (self.here.values[n][0] or 1.0) for n in self.quantity]
        return np.stack(rows)

    def best(self, allowed: Largest, spread: float) -> Lines:
        """Mean square of every line [m²] such that the quantities become best known.

        `allowed`: largest rms of displacement [m], speed [m/s] and acceleration [m/s²]; that of the
        displacement is finite. Convex, in shares of steps of the density.
        """
        rms, omega = allowed[0], 2 * np.pi * self.frequency
        steps = steps_of(self.frequency)
        steps = (1 - spread) * steps + spread / len(self.frequency)
        each = rms**2 * np.tensordot(steps, self.lines, 1)
        used = [
            (rms / most) ** 2 * steps @ omega ** (2 * order) for order, most in enumerate(allowed)
        ]

        def height(share: np.ndarray) -> tuple[float, np.ndarray]:
            """Logarithm of the sum of the variances, and its slopes: what is stiff or soft differs
            by its factor alone, so that one tolerance of the search serves all."""
            reached = np.linalg.solve(self.apart + np.tensordot(share, each, 1), self.rows.T)
            variances = np.sum(self.rows.T * reached)
            slopes = np.einsum("iq,kij,jq->k", reached, each, reached)
            return np.log(variances), -slopes / variances

        within = [scipy.optimize.LinearConstraint(row, -np.inf, 1.0) for row in used]
        begin = np.full(len(steps), 1 / len(steps)) / max(map(np.mean, used))
        if np.max(-height(begin)[1]) < NOTHING:
            raise ValueError(
                f"quantity: no motion within these limits tells of {' and '.join(self.quantity)}:"
                " raise rms, or choose another band"
            )
        found = scipy.optimize.minimize(
            height,
            begin,
            jac=True,
            method="SLSQP",
            bounds=[(0, 1)] * len(steps),
            constraints=within,
            options={"maxiter": 500, "ftol": 1e-12},
        )
        return rms**2 * np.maximum(found.x, 0) @ steps

    def errors(self, power: Lines | None, times: float = 1.0) -> dict[str, float]:
        """Standard errors of all quantities with a motion, if the record is so many `times` as
        long; without it if None."""
        record: Any = 0.0
        if power is not None:
            record = self.apart - self.start + np.tensordot(power, self.lines, 1)
        after = np.linalg.pinv(self.start + times * record, hermitian=True)
        return {name: float(np.sqrt(g @ after @ g)) for name, g in self.here.gradients.items()}

    def by_prior(self) -> dict[str, float]:
        """Standard errors of all quantities without any data."""
        before = 1 / np.maximum(self.prior, LEAST_PRIOR)
        gradients = self.here.gradients.items()
        return {name: float(np.sqrt(np.sum(before * g**2))) for name, g in gradients}

    def times_for(self, power: Lines, error: float) -> float:
        """How many times as long a record must be for a relative error of every quantity; infinite
        where none is."""
        values = {n: abs(self.here.values[n][0] or 1.0) for n in self.quantity}

        def above(log_times: float) -> float:
            found = self.errors(power, np.exp(log_times))
            return float(np.log(max(found[n] / value for n, value in values.items()) / error))

        shortest, longest = np.log(1 / LONGEST), np.log(LONGEST)
        if above(longest) > 0:
            return np.inf
        if above(shortest) <= 0:
            return 0.0
        return float(np.exp(scipy.optimize.brentq(above, shortest, longest)))


def _unknown(name: str, problem: FitProblem, here: Here) -> str:
    """Why no motion can be designed for a quantity."""
    base = name.partition("@")[0]
    if base in TANGENTS:
        return (
            ": fits of a held or a moved insertion have it (Isometric, PrescribedLength, with the"
            " paper's muscle)"
        )
    if base in (*problem.parts[0].task.parameter_names, *BASE.values()):
        return " is fixed: leave its parameter free"
    return f" is unknown: {choices(name, here.gradients)}"


def steps_of(frequency: Lines) -> Float[np.ndarray, "steps lines"]:
    """Where the density may be raised: neighbouring lines, each with an equal share."""
    starts, n = [0], len(frequency)
    while True:
        wide = np.searchsorted(frequency, (1 + WIDTH) * frequency[starts[-1]])
        following = max(starts[-1] + FEWEST, int(wide))
        if following >= n:
            break
        starts.append(following)
    if n - starts[-1] < FEWEST and len(starts) > 1:
        starts.pop()
    counts = np.diff([*starts, n])
    step = np.repeat(np.arange(len(starts)), counts)
    return (step == np.arange(len(starts))[:, None]) / counts[:, None]


def _held_by_motor(part: Part) -> Part:
    """A part whose insertion is held as one in which a motor holds it: its stiffness as stretched
    there can be asked for."""
    held = isinstance(part.task, Isometric)
    return dataclasses.replace(part, task=_with_motor(part.task)) if held else part


def _with_motor(task: Any) -> AbstractTask:
    """The experiment with the muscle of a task, at the same P_w and x_z."""
    if type(task) is PrescribedLength:
        return task
    inputs = {name: getattr(task, name) for name in ("P_w", "x_z") if hasattr(task, name)}
    return task.as_task(PrescribedLength, **inputs)


def _problem(
    given: FitResult | AbstractTask,
) -> tuple[FitProblem, Theta, Iterable[str]]:
    """A fit's problem, or that of a task with the data that it would give; θ, and what can be
    derived."""
    if isinstance(given, FitResult):
        return *fitted_problem(given, None), given.derived_names
    task = as_numbers(_with_motor(given))
    power = np.asarray(expected_spectrum(task).proportional)
    target = Target(type(task).__name__, power, segments=1, settings=task.settings)
    problem = planned(task, target, FitOptions(coefficient_of_variation=False)).problem
    return problem, np.zeros(len(problem.coordinates.names)), derived_names(task)
