"""What the data of a fit determine, and which further measurement would determine the rest."""

import dataclasses
import itertools
from collections.abc import Iterable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle._common.environment import fitting
from jaxmuscle._common.errors import OperatingPointError
from jaxmuscle.data._target import Target
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.fits._result import FitResult
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.objective._arguments import MASSES
from jaxmuscle.objective._consequences import Expansion, quantities
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._covariance import Identifiability, common_scales, known_products
from jaxmuscle.objective._derived import MEAN, unit_of
from jaxmuscle.objective._problem import FitProblem

from ._design_information import (
    design_information,
    information_of,
    opened,
    seen_here,
    without_further,
)
from ._designs import Design, designs_for, told_data, without_noise
from ._identifiability_report import (
    NO_NOISE,
    TOGETHER,
    UNDESCRIBED,
    IdentifiabilityReport,
    Known,
    Outlook,
)

LEAST_PRIOR = 1e-6


def identifiability(
    result: FitResult, target: Target | None = None, *, designs: Iterable[Design] | None = None
) -> IdentifiabilityReport:
    """Which parameters the data of a fit determine, and which further measurements would determine
    the rest.

        print(jm.identifiability(result))

    By the Fisher information of the data at the fit, `F = Jᵀ C⁻¹ J`, with the covariance C of the
    bins' logarithms, the unknown total of a proportional spectrum eliminated, the prior left out; a
    further measurement adds its own. A direction of θ is determined if its singular value, the root
    of the eigenvalue of F, is at least 3; a quantity with gradient g if `gᵀ (F + Λ)⁻¹ g <= 0.1 gᵀ
    Λ⁻¹ g`, Λ the prior's precision: the data leave at most a tenth of its prior variance.

    **Arguments:**

    - `result` of a fit whose task has a linear response
    - `target`: instead of the fit's own
    - `designs` to be tried (default: `standard_designs(result)`)

    **Returns:** an `IdentifiabilityReport`: print it, `plot()` it, `save(path)` it.

    **Raises:** `ValueError` for a fit that failed, a target that states neither segments nor sigma,
    two designs of one name, a design that names unknown parameters. A design without stable
    equilibrium is reported as impossible.
    """
    with fitting():
        fitted, at = fitted_problem(result, target)
        tried = None if designs is None else tuple(designs)
        moves = (
            any(isinstance(p.task, PrescribedLength) for p in fitted.parts)
            if tried is None
            else any(map(_moved, tried))
        )
        problem = opened(fitted) if moves else fitted
        theta = np.append(at, np.zeros(len(problem.prior) - len(at)))
        seen = seen_here(problem, theta)
        tried = designs_for(fitted, seen) if tried is None else tried
        names = [design.name for design in tried]
        if len(set(names)) < len(names):
            raise ValueError(
                f"designs: two are called {next(n for n in names if names.count(n) > 1)!r}:"
                " rename one"
            )
        here = Here.of(problem, seen, result.derived_names, len(at))
        added = [_added(problem, theta, design) for design in tried]
    present = here.outlook("the present data", here.information, *told_data(fitted))
    alone = tuple(
        here.outlook(
            d.name,
            here.information + more,
            *d.told(fitted),
            d.separate,
            failed,
            present,
            masses=_moved(d),
        )
        for d, (more, failed) in zip(tried, added, strict=True)
    )
    possible = [
        (d.name, _moved(d), more)
        for d, (more, failed) in zip(tried, added, strict=True)
        if failed is None
    ]
    pairs = [
        here.outlook(a + TOGETHER + b, here.information + x + y, present=present, masses=m or n)
        for (a, m, x), (b, n, y) in itertools.combinations(possible, 2)
    ]
    pairs.sort(key=lambda pair: (-len(pair.gained), pair.log_left))
    notices = tuple(n for n in result.notices if " ambiguous: " in n)
    if designs is None and without_noise(fitted):
        notices += (NO_NOISE,)
    if target is None:
        notices = missed(result) + notices
    mean_force = result.derived[MEAN].value if result.per_newton else None
    # Of another target the fit has said nothing.
    found = {} if target is not None else result.found
    known = {n for n, k in present.quantities.items() if k.determined}
    doubted = tuple(n for n, p in found.items() if n in known and p.stderr is None)
    first, names = fitted.parts[0].task, fitted.coordinates.names
    masses = {n: float(first[n]) for n in MASSES if n in first.parameter_names and n not in names}
    return IdentifiabilityReport(
        fitted.title, names, present, alone, tuple(pairs), notices, mean_force, doubted, masses
    )


def _moved(design: Design) -> bool:
    return design.lengthening is not None


def missed(result: FitResult) -> tuple[str, ...]:
    """What has to be said before a plan that stands on a fit whose model misses the data."""
    found = result.adequacy
    if found is None or found.adequate:
        return ()
    return (
        (
            f"{UNDESCRIBED} (chi2 {found.chi2:.3g}, expected {found.expected:.3g}). What follows"
            " assumes that the model holds. The errors here are not widened; those of the fit are,"
            f" by a factor of {found.widening:.2g}. What to do: find a model that describes the"
            " data first"
        ),
    )


def standard_designs(result: FitResult, target: Target | None = None) -> tuple[Design, ...]:
    """The designs that `identifiability(result, target)` tries by default, to be extended or
    changed.

        designs = jm.standard_designs(result)
        print(jm.identifiability(result, designs=designs))

    The coefficient of variation and the mean (to 2 %) of the same recording, if the fit does not
    have them; of an `Isometric` fit the displacement under the load that the sensor had held
    (`PrescribedForce` at the same operating point, with the same noise and harmonic), of a
    `PrescribedForce` fit the force of `Isometric`; 60 s in which a motor moves the insertion, by
    0.1 mm rms to 10 Hz and by 1 mm rms to 5 Hz, both from 0.5 Hz on (`Lengthening`); twice and half
    the force (none above 100 % MVC where the target states its level), where noise and harmonic
    have other, unknown amplitudes and the muscle is as before; a recording ten times as long. None
    knows fatigue.
    """
    with fitting():
        problem, theta = fitted_problem(result, target)
        return designs_for(problem, seen_here(problem, theta))


def fitted_problem(
    result: FitResult, target: Target | None
) -> tuple[FitProblem, Float[np.ndarray, " free"]]:
    """The fit's problem with the fitted tasks in it, and θ."""
    problem, tasks = reopened(result, target), tuple(result.tasks.values())
    parts = (
        dataclasses.replace(part, task=task)
        for part, task in zip(problem.parts, tasks, strict=True)
    )
    return dataclasses.replace(problem, parts=tuple(parts)), problem.theta_of(tasks)


def _added(problem: FitProblem, theta: np.ndarray, design: Design) -> tuple[np.ndarray, str | None]:
    """What a design tells, or why it is impossible."""
    try:
        return design_information(problem, theta, design), None
    except OperatingPointError as error:
        return np.zeros((len(theta), len(theta))), str(error)


class Here(NamedTuple):
    """The fit: information of its data, its prior, values and gradients of what can be known.

    The first `free` of the coordinates are those that the fit has free; the others are masses, see
    `opened`.
    """

    coordinates: Coordinates
    information: np.ndarray
    prior: np.ndarray
    values: dict[str, tuple[float, str]]
    gradients: dict[str, np.ndarray]
    free: int

    @classmethod
    def of(
        cls, problem: FitProblem, seen: Expansion, derived: Iterable[str], free: int | None = None
    ) -> "Here":
        """At the θ where the model was seen, with these derived quantities."""
        c = problem.coordinates
        natural = c.values_of(np.asarray(seen.theta)[None])[0]
        values = {n: (float(v), unit_of(n)) for n, v in zip(c.names, natural, strict=True)}
        gradients = dict(zip(c.names, np.diag(c.slope(natural)), strict=True))
        tables = quantities(
            without_further(problem).linear(), jax.tree.map(lambda x: np.asarray(x)[None], seen)
        )
        free = len(c.names) if free is None else free
        for name in derived:
            part, quantity = problem.where(name)
            value, g = (table[part][quantity][0] for table in tables)
            if (
                name not in values
                and np.all(np.isfinite(g))
                and np.any(g[:free] != 0)
                and np.isfinite(value)
            ):
                unit = unit_of(name, problem.parts[part].task.output_unit)
                values[name], gradients[name] = (float(value), unit), g
        return cls(c, information_of(problem, seen), problem.precision, values, gradients, free)

    def outlook(
        self,
        name: str,
        information: np.ndarray,
        task: str = "",
        data: str = "",
        separate: tuple[str, ...] = (),
        failed: str | None = None,
        present: Outlook | None = None,
        *,
        masses: bool = False,
    ) -> Outlook:
        """What is known with that information; the further masses are known, too, unless they are
        asked to be open."""
        size = len(self.prior) if masses else self.free
        after = np.linalg.pinv(information[:size, :size] + self.prior[:size, :size], hermitian=True)
        every, found = (Identifiability.of_covariance(after[:n, :n]) for n in (size, self.free))
        before = np.linalg.inv(self.prior[:size, :size] + LEAST_PRIOR * np.eye(size))
        c, known = self.coordinates, {}
        for n in (n for n in self.gradients if n not in c.names[self.free :]):
            g = self.gradients[n][:size]
            left, had = g @ after @ g, g @ before @ g
            known[n] = Known(
                *self.values[n], float(np.sqrt(left)), float(np.sqrt(had)), every.determines(g)
            )
        gained = (
            ()
            if present is None
            else tuple(
                n for n, k in known.items() if k.determined and not present.quantities[n].determined
            )
        )
        names, after = c.names[: self.free], after[: self.free, : self.free]
        products = known_products(names, c.positive[: self.free], c.sd[: self.free], found)
        errors = {n: float(np.sqrt(g @ after @ g)) for n, g in products.items()}
        return Outlook(
            name,
            task,
            data,
            separate,
            found.singular_values,
            int(found.determined.sum()),
            common_scales(names, found),
            errors,
            known,
            gained,
            failed,
        )
