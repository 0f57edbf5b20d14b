"""Many targets fitted together, and what differs between groups of them: `jm.fit_cohort`. It
gives all of them to `search_together` of `_search.py`; `_study.py` calls it.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Unpack

import equinox as eqx
import numpy as np

from jaxmuscle import plot
from jaxmuscle._common.cards import Card, Result
from jaxmuscle._common.environment import fitting
from jaxmuscle._common.executors import AnyExecutor
from jaxmuscle._common.progress import told
from jaxmuscle._common.tables import frame
from jaxmuscle._common.upward import load_above
from jaxmuscle.data._measure import Measure
from jaxmuscle.data._target import Target
from jaxmuscle.model._noises import with_noise
from jaxmuscle.model._rungs import on_rung
from jaxmuscle.model._tasks import AbstractTask, PrescribedLength
from jaxmuscle.objective._arguments import Plan, at_mean, planned
from jaxmuscle.objective._options import FitOptions, SearchOptions
from jaxmuscle.spectra._bin_law import trial_samples
from jaxmuscle.spectra._fluctuations import BANDS

from ._differences import Difference, between_groups
from ._model_choice import options_for
from ._perturbed import aimed
from ._result import FitResult
from ._search import search_in_blocks

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


class CohortResult(Result, eqx.Module):
    """`results` by target name; `groups`, the group of each (empty without); `failed`, why others
    were not fitted."""

    results: dict[str, FitResult]
    groups: dict[str, str]
    failed: dict[str, str]

    @property
    def success(self) -> bool:
        """Whether every target could be read and its fit succeeded."""
        return not self.failed and all(result.success for result in self.results.values())

    @property
    def verdict(self) -> str:
        """How many of the fits describe their data, and which do not."""
        judged = {
            name: result.adequate
            for name, result in self.results.items()
            if result.adequate is not None
        }
        if not judged and not any(result.success for result in self.results.values()):
            return "no target could be fitted"
        if not judged:
            return (
                "whether the model describes the targets cannot be judged: they state neither"
                " segments nor sigma (--segments)"
            )
        bad = [name for name, adequate in judged.items() if not adequate]
        said = f"the model describes {len(judged) - len(bad)} of {len(judged)} targets"
        return said + (
            f"; it does not describe {'; '.join(bad)}, so the model's numbers of these are left"
            " out of comparisons"
            if bad
            else ""
        )

    def _card(self) -> Card:
        return load_above("reports").cohort_card(self)

    def table(self) -> list[dict[str, Any]]:
        """Tidy rows, one per target and quantity (measured ones, free parameters, derived ones),
        with the columns that *Results as numbers* lists (docs/reference/index.md).

        `low` and `high` are the ends of the 95 % interval.
        """
        rows = []
        for name, result in self.results.items():
            judged = result.adequacy
            for quantity, e in _quantities(result).items():
                low, high = (None, None) if e.interval is None else e.interval
                rows.append(
                    {
                        "target": name,
                        "group": self.groups.get(name, ""),
                        "quantity": quantity,
                        "kind": "measured" if isinstance(e, Measure) else "model",
                        "value": e.value,
                        "stderr": e.stderr,
                        "low": low,
                        "high": high,
                        "unit": e.unit,
                        "determined": e.stderr is not None,
                        "mvc_fraction": result.target.mvc_fraction,
                        "chi2_per_bin": None if judged is None else judged.chi2 / result.data,
                        "chi2_expected": None if judged is None else judged.expected / result.data,
                        "adequate": result.adequate,
                        "adequacy_p": result.adequacy_p,
                        "success": result.success,
                    }
                )
        return rows

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows of `table`."""
        return frame(self.table())

    def differences(self) -> tuple[Difference, ...]:
        """Every quantity that is measured or determined, every two groups: difference of the means
        and its interval.

        Members whose data do not determine the quantity, and of the model's those that it does not
        describe, are `left_out`.
        """
        known = {
            name: (self.groups.get(name, ""), comparable(result))
            for name, result in self.results.items()
        }
        groups = dict.fromkeys(group for group, _ in known.values())
        found = []
        for quantity in dict.fromkeys(q for _, table in known.values() for q in table):
            numbers = [(group, table.get(quantity)) for group, table in known.values()]
            found += between_groups(quantity, groups, numbers, single=True)
        return tuple(found)

    def plot(self, by: str = "person", ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Determined quantities with their standard errors, by "person", "group" or "level"
        (fraction of MVC)."""
        return plot.cohort(self, by, ax)


def _quantities(result: FitResult) -> dict[str, Any]:
    """What is measured; free parameters and derived quantities, as they are shown, what is both
    once."""
    return result.measured | result.as_shown(result.found)


def comparable(result: FitResult) -> dict[str, Any]:
    """What may be compared with another fit: what is measured and exists (but the p-value of the
    tremor); and what the data determine, if the model describes them."""
    known = {
        name: m
        for name, m in result.measured.items()
        if math.isfinite(m.value) and name != "tremor_p"
    }
    if result.adequate is False:
        return known
    # the bands of the fit repeat the measured shares
    of_model = {n: e for n, e in result.as_shown(result.determined).items() if n not in BANDS}
    return known | of_model


def fit_cohort(
    targets: Iterable[Any],
    *,
    groups: Mapping[str, str] | None = None,
    task: type[AbstractTask] | None = None,
    rung: int = 0,
    progress: bool | Callable[[str, float], None] = False,
    executor: AnyExecutor | None = None,
    **options: Unpack[SearchOptions],
) -> CohortResult:
    """Fit many targets, in linear response, all starts of four targets in one batch.

        names = "vastus-lateralis-26mvc", "fdi-abduction-45mvc"
        targets = [jm.load_target(name) for name in names]
        jm.fit_cohort(targets).to_dataframe()

    As `fit` with `method="linear"` for each, without its last steps: no nonlinear correction (which
    usually changes a bin by 0.2 %), no check on simulated seeds, no profile over the harmonic's
    frequency; fit a target alone for those. Targets that can share a batch are those of the same
    task, bins and settings.

    **Arguments:**

    - `targets`: one of each person, in any form that `fit` takes (a list is the trials of one)
    - `groups` {target name: group}
    - `task`: the same kind for all (by default what each measured)
    - `free`, `fix`, `noise`, `bounds`, `priors`, `coefficient_of_variation`, `max_steps`, `key`: as
      in `fit`
    - `starts` for each target (32)
    - `rung`: the model of all of them (`on_rung`: 0 the base model, 1 with activation, 2 with
      resonance, 3 with a second one), so that their numbers can be compared
    - `progress`: True or a function of (text, share)
    - `executor`: who fits the batches, an executor of `concurrent.futures` (whose processes are not
      forked) or a Dask client; by default this process, one after the other. The results are the
      same to the last bit.

    **Returns:** a `CohortResult`. A target that cannot be read, or not be fitted with these
    options, is listed in `failed` with the reason and does not stop the rest.

    **Raises:** `ValueError` for no targets, equal names and a group of an unknown target;
    `WorkersLostError` for an executor whose workers or scheduler are lost.
    """
    asked = FitOptions.of(fit_cohort, SearchOptions, {"starts": 32, **options})
    loaded, failed = _loaded(targets, on_rung(PrescribedLength(), rung) if rung else None)
    unknown = set(groups or {}) - set(loaded) - set(failed)
    if unknown:
        raise ValueError(
            f"groups: no target is called {', '.join(sorted(unknown))}; there are"
            f" {', '.join(loaded)}"
        )
    with told(progress, f"fitting {len(loaded)} targets") as tell, fitting():
        batches: dict[Any, dict[str, Plan]] = {}
        for name, target in loaded.items():
            model = with_noise(target.task(task), asked.noise, asked.fix)
            try:
                model, given = at_mean(on_rung(model, rung) if rung else model, target, asked)
                plan = planned(model, target, options_for(model, given))
            except ValueError as error:
                failed[name] = str(error)
                continue
            batches.setdefault(_alike(plan), {})[name] = plan
        names = [name for batch in batches.values() for name in batch]
        plans = [list(batch.values()) for batch in batches.values()]
        results = dict(zip(names, search_in_blocks(executor, plans, tell, rung), strict=True))
    ordered = {name: results[name] for name in loaded if name in results}
    return CohortResult(
        ordered, {name: (groups or {})[name] for name in ordered if name in (groups or {})}, failed
    )


def _loaded(
    targets: Iterable[Any], moved: AbstractTask | None
) -> tuple[dict[str, Target], dict[str, str]]:
    """Targets by name, and why others could not be read; `moved`, the model by which a moved
    record's response is taken off."""
    loaded: dict[str, Target] = {}
    failed: dict[str, str] = {}
    for given in targets:
        try:
            target = aimed(given, moved)
        except (ValueError, OSError) as error:
            failed[str(given)] = str(error)
            continue
        if target.name in loaded:
            raise ValueError(f"two targets are called {target.name!r}: rename one")
        loaded[target.name] = target
    if not loaded and not failed:
        raise ValueError("no targets: give at least one")
    return loaded, failed


def _alike(plan: Plan) -> Any:
    """Equal for fits that differ in their data only, and in the length of their recordings by less
    than a half."""
    (part,) = plan.problem.parts
    target, task = part.target, part.task
    length = round(2 * np.log2(trial_samples(target)))
    present = part.variation is not None, part.mean is not None
    kind = type(task), task.quantity, type(task.noise), tuple(task.parameters.items())
    return *kind, target.settings, tuple(target.bins), present, length
