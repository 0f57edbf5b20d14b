"""What the data of a fit determine, and which further measurement would determine the rest."""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

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
    Square,
    Theta,
    design_information,
    expansion_at,
    information_of,
    with_open_masses,
    without_scalars,
)
from ._designs import Design, designs_for, without_noise
from ._identifiability_report import (
    NO_NOISE,
    UNDESCRIBED,
    IdentifiabilityReport,
    Known,
    Outlook,
)

LEAST_PRIOR = 1e-6  # precision of what has no prior, which would have no variance before the data
MISSED = (
    UNDESCRIBED + " (chi2 {0.chi2:.3g}, expected {0.expected:.3g}). What follows assumes that the"
    " model holds. The errors here are not widened; those of the fit are, by a factor of"
    " {0.widening:.2g}. What to do: find a model that describes the data first"
)


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
            else any(design.moves for design in tried)
        )
        problem = with_open_masses(fitted) if moves else fitted
        theta = np.append(at, np.zeros(len(problem.prior) - len(at)))
        seen = expansion_at(problem, theta)
        tried = designs_for(fitted, seen) if tried is None else tried
        names = [design.name for design in tried]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"designs: two are called {name!r}: rename one")
        here = Here.of(problem, seen, result.derived_names, len(at))
        added = [_information_in(problem, theta, design) for design in tried]
    present = here.outlook(0.0, name="the present data")
    alone = [
        here.outlook(
            more, present, design.moves, name=design.name, separate=design.separate, failed=failed
        )
        for design, (more, failed) in zip(tried, added, strict=True)
    ]
    notices = tuple(n for n in result.unstated if " ambiguous: " in n)
    notices += (NO_NOISE,) * (designs is None and without_noise(fitted))
    # Of another target the fit has said nothing.
    found = result.found if target is None else {}
    known = {n for n, k in present.quantities.items() if k.determined}
    first, names = fitted.parts[0].task, fitted.coordinates.names
    return IdentifiabilityReport(
        fitted.title,
        names,
        present,
        tuple(alone),
        (misfit_notices(result) if target is None else ()) + notices,
        result.derived[MEAN].value if result.per_newton else None,
        tuple(n for n, p in found.items() if n in known and p.stderr is None),
        {n: float(first[n]) for n in MASSES if n in first.parameter_names and n not in names},
    )


def misfit_notices(result: FitResult) -> tuple[str, ...]:
    """What has to be said before a plan that stands on a fit whose model misses the data."""
    found = result.adequacy
    if found is None or found.adequate:
        return ()
    return (MISSED.format(found),)


def standard_designs(result: FitResult, target: Target | None = None) -> tuple[Design, ...]:
    """The designs that `identifiability(result, target)` tries by default, to be extended or
    changed.

        designs = jm.uncertainty.standard_designs(result)
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
        return designs_for(problem, expansion_at(problem, theta))


def fitted_problem(result: FitResult, target: Target | None) -> tuple[FitProblem, Theta]:
    """The fit's problem with the fitted tasks in it, and θ."""
    problem, tasks = reopened(result, target), tuple(result.tasks.values())
    parts = (
        dataclasses.replace(part, task=task)
        for part, task in zip(problem.parts, tasks, strict=True)
    )
    return dataclasses.replace(problem, parts=tuple(parts)), problem.theta_of(tasks)


def _information_in(problem: FitProblem, theta: Theta, design: Design) -> tuple[Square, str | None]:
    """What a design tells, or why it is impossible."""
    try:
        return design_information(problem, theta, design), None
    except OperatingPointError as error:
        return np.zeros((len(theta), len(theta))), str(error)


class Here(NamedTuple):
    """The fit: information of its data, its prior, values and gradients of what can be known.

    The first `free` of the coordinates are those that the fit has free; the others are masses, see
    `with_open_masses`.
    """

    coordinates: Coordinates
    information: Square
    prior: Square
    values: dict[str, tuple[float, str]]
    gradients: dict[str, Theta]
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
        rows = jax.tree.map(lambda x: np.asarray(x)[None], seen)
        tables = quantities(without_scalars(problem).linear(), rows)
        free = len(c.names) if free is None else free
        for name in derived:
            part, quantity = problem.where(name)
            value, g = (table[part][quantity][0] for table in tables)
            finite = np.isfinite(value) and np.all(np.isfinite(g))
            if name not in values and finite and np.any(g[:free] != 0):
                unit = unit_of(name, problem.parts[part].task.output_unit)
                values[name], gradients[name] = (float(value), unit), g
        return cls(c, information_of(problem, seen), problem.precision, values, gradients, free)

    def outlook(
        self, more: Any, present: Outlook | None = None, masses: bool = False, **about: Any
    ) -> Outlook:
        """What is known with `more` information; the further masses are known, too, unless they are
        asked to be open. `about`, further fields."""
        size, free, c = len(self.prior) if masses else self.free, self.free, self.coordinates
        own = np.s_[:size, :size]
        after = np.linalg.pinv((self.information + more + self.prior)[own], hermitian=True)
        before = np.linalg.inv(self.prior[own] + LEAST_PRIOR * np.eye(size))
        every, found = (Identifiability.of_covariance(after[:n, :n]) for n in (size, free))
        known = {}
        for n in self.gradients:
            if n not in c.names[free:]:
                g = self.gradients[n][:size]
                left, had = (float(np.sqrt(g @ each @ g)) for each in (after, before))
                known[n] = Known(*self.values[n], left, had, every.determines(g))
        had = known if present is None else present.quantities
        names, inner = c.names[:free], after[:free, :free]
        products = known_products(names, c.positive[:free], c.sd[:free], found)
        return Outlook(
            singular_values=found.singular_values,
            determined=int(found.determined.sum()),
            undetermined=common_scales(names, found),
            products={n: float(np.sqrt(g @ inner @ g)) for n, g in products.items()},
            quantities=known,
            gained=tuple(n for n, k in known.items() if k.determined and not had[n].determined),
            masses_open=masses,
            **about,
        )
