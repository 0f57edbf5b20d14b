"""A study: trials of people in conditions and groups; what is measured of them, one model fitted to
all, what differs, one folder of results."""

import contextlib
import dataclasses
import itertools
import math
import os
import tempfile
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import equinox as eqx
import numpy as np

from jaxmuscle import plot
from jaxmuscle._common.arguments import check_options
from jaxmuscle._common.cards import Card, Result
from jaxmuscle._common.environment import versions
from jaxmuscle._common.executors import AnyExecutor
from jaxmuscle._common.figures import remove_figures, write_figure
from jaxmuscle._common.files import nulled, remove, write_json, write_text
from jaxmuscle._common.keys import check_key
from jaxmuscle._common.progress import Tell, told
from jaxmuscle._common.tables import csv_of, frame
from jaxmuscle._common.text import WIDTH, choices
from jaxmuscle._common.types import Key
from jaxmuscle._common.upward import load_above
from jaxmuscle.data._measured import MEASURES
from jaxmuscle.data._recording_choice import ReadingOptions
from jaxmuscle.data._study_table import ORDERS, READING, Cell, cells_of_study, read_study
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._rungs import RUNGS
from jaxmuscle.objective._derived import DERIVED

from ._cohort import CohortResult, fit_cohort
from ._differences import CORRECTIONS, Difference, Number, between_groups, change, corrected, paired
from ._result import ALIASES

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

AUTO = "auto"
USUAL = {
    "rung": None,
    "noise": None,
    "quantities": None,
    "alpha": 0.05,
    "correction": "holm",
    **dict.fromkeys(ORDERS),
}
FORMAT = 2
# What is compared: measured quantities, and the frequencies of the model's two resonances.
MEASURED = (
    "mean",
    "coefficient_of_variation",
    "coefficient_of_variation_without_drift",
    "relative_power_4_8",
    "relative_power_8_12",
    "median_frequency",
    "sample_entropy",
    "tremor_frequency",
)
RESONANCES = ("resonance_frequency", "resonance_2_frequency")
TRIALS_OF_TWO = 5  # in every condition of everybody, for a model with two resonances
READ = 0.1  # of the work, all files
NAMES = ("person", "group", "condition", "trials")
DROPPED = ("target", "group", "mvc_fraction")
Whose = tuple[str, str]  # a person in a condition
Numbers = Mapping[Whose, Number | None]


class StudyResult(Result, eqx.Module):
    """What a study found.

    `cells`, one for each person in each condition: `person`, `group`, `condition`, the
    `recordings` (rows of `trials`), and the `target` made of them, whose `measured` is what needs
    no model; `cohort`, the fits, one of each cell, none where only measured was asked for;
    `aic`, the summed AIC of every model that was tried (by rung), of which the lowest was taken;
    the `options` as they were used; the `source` of the table.
    """

    cohort: CohortResult
    cells: tuple[Cell, ...]
    aic: dict[int, float]
    options: dict[str, Any]
    source: str

    @property
    def success(self) -> bool:
        """Whether every fit succeeded."""
        return self.cohort.success

    @property
    def rung(self) -> int:
        """The model of all people: which rung of the ladder. Raises `ValueError` where none was
        fitted."""
        return min(self.aic, key=lambda number: self.aic[number])

    @property
    def people(self) -> dict[str, str]:
        """The group of every person."""
        return {cell.person: cell.group for cell in self.cells}

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups, as `options` orders them, else the table."""
        return self._ordered("groups", (cell.group for cell in self.cells))

    @property
    def conditions(self) -> tuple[str, ...]:
        """The conditions, as `options` orders them, else the table."""
        return self._ordered("conditions", (cell.condition for cell in self.cells))

    def _ordered(self, what: str, names: Iterable[str]) -> tuple[str, ...]:
        return tuple(dict.fromkeys([*(self.options.get(what) or ()), *names]))

    @property
    def quantities(self) -> tuple[str, ...]:
        """What is compared: what was asked for, else eight measured quantities and the frequencies
        of the two resonances.

        Of these, the ones that are known of at least one person.
        """
        return self._compared_names(self._known())

    def _compared_names(self, known: Mapping[Any, Mapping[str, Any]]) -> tuple[str, ...]:
        asked = self.options["quantities"]
        seen = {name for table in known.values() for name in table}
        return tuple(n for n in ((*MEASURED, *RESONANCES) if asked is None else asked) if n in seen)

    def _known(self) -> dict[Whose, dict[str, Number]]:
        """What may be compared, of every person in every condition: what is measured, and what the
        fit determines if its model describes the data."""
        found = {}
        for cell in self.cells:
            result = self.cohort.results.get(cell.target.name)
            measured = {n: m for n, m in cell.target.measured.items() if math.isfinite(m.value)}
            of_model = {}
            if result is not None and result.adequate is not False:
                of_model = result.as_shown(result.determined)
            found[cell.person, cell.condition] = measured | of_model
        return found

    def missing(self) -> dict[str, int]:
        """Of how many people and conditions a compared quantity is not known: they show no tremor,
        or the data do not determine it, or the model does not describe them. Only quantities that
        miss some."""
        known = self._known()
        counts = {
            name: sum(name not in table for table in known.values())
            for name in self._compared_names(known)
        }
        return {name: count for name, count in counts.items() if count}

    def table_1(self) -> list[dict[str, Any]]:
        """Mean and standard deviation over people of every measured quantity (but the p-value of
        the tremor), by group and condition: the table that a paper begins with.

        Rows `group`, `condition`, `quantity`, `mean`, `sd` (of n - 1 degrees of freedom, NaN of a
        single person), `n`, how many people have it, of `people`, and the `unit`.
        """
        rows = []
        for (group, condition), people in self._parts().items():
            tables = [cell.target.measured for cell in people]
            for quantity in dict.fromkeys(n for t in tables for n in t if n != "tremor_p"):
                known = [table[quantity] for table in tables if quantity in table]
                each = np.array([m.value for m in known if math.isfinite(m.value)])
                said = {
                    "mean": float(np.mean(each)) if each.size else math.nan,
                    "sd": float(np.std(each, ddof=1)) if each.size > 1 else math.nan,
                    "n": each.size,
                    "people": len(tables),
                    "unit": known[0].unit,
                }
                rows.append({"group": group, "condition": condition, "quantity": quantity} | said)
        return rows

    def _parts(self) -> dict[tuple[str, str], list[Cell]]:
        """The people of every group in every condition."""
        parts = {
            (group, condition): [
                cell for cell in self.cells if (cell.group, cell.condition) == (group, condition)
            ]
            for group in self.groups
            for condition in self.conditions
        }
        return {key: people for key, people in parts.items() if people}

    def table(self) -> list[dict[str, Any]]:
        """Tidy rows, one for each person, condition and quantity; `kind` "measured" or "model";
        `stderr` None where there is none, of the model where the data do not determine it."""
        asked = self.options["quantities"]
        fitted = {name: [] for name in self.cohort.results}
        for row in self.cohort.table():
            if row["kind"] == "model":
                fitted[row["target"]].append(row)
        rows = []
        for cell in self.cells:
            own = {name: getattr(cell, name) for name in NAMES}
            rows += [
                own | {"quantity": name, "kind": "measured", **m.row()}
                for name, m in cell.target.measured.items()
            ]
            rows += [
                own | {name: value for name, value in row.items() if name not in DROPPED}
                for row in fitted.get(cell.target.name, [])
            ]
        return [row for row in rows if asked is None or row["quantity"] in asked]

    def trials(self) -> list[dict[str, Any]]:
        """What was analysed of every recording: rows `person`, `group`, `condition`, `trial`,
        `file`, `column`, `rate_hz`, `start_s` and `stop_s` of the part, and how this was `chosen`
        ("found" as the steady part, "given", "all")."""
        return [
            {
                "person": cell.person,
                "group": cell.group,
                "condition": cell.condition,
                "trial": r.trial,
                "file": r.file,
                "column": r.column,
                "rate_hz": r.rate,
                "start_s": r.start,
                "stop_s": r.stop,
                "chosen": r.chosen,
            }
            for cell in self.cells
            for r in cell.recordings
        ]

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows of `table`."""
        return frame(self.table())

    def differences(self) -> tuple[Difference, ...]:
        """Every comparison of `quantities` with at least two people on each side.

        Groups in each condition by Welch's t, conditions within people by the paired t, their
        interaction (the change from one condition to the other in one group against that in the
        other) by Welch's t. `p_corrected` is for all comparisons of its kind, measured quantities
        and those of the model apart. People of whom a quantity is not known are `left_out` of it, a
        selection: of a tremor those who show none, of the model's numbers those whom it does not
        describe or whose data do not determine it.
        """
        known = self._known()
        families: dict[Any, list[Difference]] = {}
        for quantity in self._compared_names(known):
            numbers = {whose: table.get(quantity) for whose, table in known.items()}
            for found in (
                *self._between_groups(quantity, numbers),
                *self._within_people(quantity, numbers),
            ):
                families.setdefault((quantity in MEASURES, found.kind), []).append(found)
        correction = self.options["correction"]
        return tuple(each for family in families.values() for each in corrected(family, correction))

    def _between_groups(self, quantity: str, numbers: Numbers) -> Iterable[Difference]:
        level = 1 - self.options["alpha"]
        for condition in self.conditions:
            known = [
                (cell.group, numbers[cell.person, condition])
                for cell in self.cells
                if cell.condition == condition
            ]
            yield from between_groups(quantity, self.groups, known, level, where=condition)

    def _within_people(self, quantity: str, numbers: Numbers) -> Iterable[Difference]:
        level = 1 - self.options["alpha"]
        for a, b in itertools.combinations(self.conditions, 2):
            changes = []
            for person, group in self.people.items():
                if (person, a) in numbers and (person, b) in numbers:
                    x, y = numbers[person, a], numbers[person, b]
                    changes.append((group, None if x is None or y is None else change(x, y)))
            known = [each for _, each in changes if each is not None]
            if len(known) > 1:
                found = paired(quantity, a, b, known, level)
                yield dataclasses.replace(found, left_out=len(changes) - len(known))
            where = f"{b} - {a}"
            yield from between_groups(
                quantity, self.groups, changes, level, kind="interaction", where=where
            )

    def methods(self) -> str:
        """A paragraph for the methods section of a paper: people, recordings, spectra, model,
        statistics, versions."""
        return load_above("reports").study_methods(self)

    def plot(self, ax: "Axes | None" = None, *, proportional: bool = False) -> "Figure | SubFigure":
        """Spectra of people and means of conditions, a panel for each group; see
        `jaxmuscle.plot.study`."""
        return plot.study(self, ax, proportional=proportional)

    def figures(self) -> dict[str, Any]:
        """`spectra`, as `plot` draws them; `quantities`, what is compared, not these where nothing
        is known of half of the people; `trials`, every recording with the part that was
        analysed."""
        found = {"spectra": self.plot()}
        p = {
            (d.quantity, d.a, d.b): d.p_corrected
            for d in self.differences()
            if d.kind == "conditions"
        }
        with contextlib.suppress(ValueError):
            found["quantities"] = plot.cohort(
                self._drawn(), "group", quantities=self.quantities, p=p
            )
        return found | {"trials": plot.study_trials(self)}

    def save(self, folder: str | os.PathLike[str], formats: Sequence[str] = ("png",)) -> None:
        """Write table1.csv, people.csv, differences.csv, trials.csv, study.json, spectra.png,
        quantities.png, trials.png and methods.txt into `folder`.

        They are made beside it first and then moved: a save that is interrupted changes nothing.
        Without a comparison there is no differences.csv. `formats` of the figures: "png", "pdf",
        "svg"; raises `ValueError` for another.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".study-", dir=folder) as made:
            new = Path(made)
            self._write(new, formats)
            remove(folder, *FILES)
            # an earlier study may have had more of them
            remove_figures(folder, "spectra", "quantities", "trials")
            for path in sorted(new.iterdir()):
                os.replace(path, folder / path.name)

    def _write(self, folder: Path, formats: Sequence[str]) -> None:
        tables = {
            "table1.csv": self.table_1(),
            "people.csv": self.table(),
            "differences.csv": [_row(d) for d in self.differences()],
            "trials.csv": self.trials(),
        }
        for name, rows in tables.items():
            if rows:
                write_text(folder / name, csv_of(frame(rows)))
        write_json(folder / "study.json", to_table(self))
        write_text(folder / "methods.txt", textwrap.fill(self.methods(), WIDTH) + "\n")
        for name, figure in self.figures().items():
            write_figure(figure, folder, name, formats)

    def _drawn(self) -> "_Drawn":
        """What the figure of the quantities shows."""
        known = self._known()
        groups = {cell.target.name: cell.group for cell in self.cells}
        in_order = sorted(self.cells, key=lambda cell: self.conditions.index(cell.condition))
        rows = [
            {
                "target": cell.target.name,
                "person": cell.person,
                "condition": cell.condition,
                "group": cell.group,
                "quantity": name,
                "value": e.value,
                "stderr": e.stderr,
                "unit": e.unit,
            }
            for cell in in_order
            for name, e in known[cell.person, cell.condition].items()
        ]
        by_group = sorted(self.cells, key=lambda cell: self.groups.index(cell.group))
        return _Drawn({cell.target.name: cell for cell in by_group}, groups, rows)

    def _card(self) -> Card:
        return load_above("reports").study_card(self)


FILES = ("table1.csv", "people.csv", "differences.csv", "trials.csv", "study.json", "methods.txt")


class _Drawn(NamedTuple):
    """What `plot.cohort` reads of a cohort."""

    results: dict[str, Cell]
    groups: dict[str, str]
    rows: list[dict[str, Any]]

    def table(self) -> list[dict[str, Any]]:
        return self.rows


def _group_of(cell: Cell) -> str:
    return ", ".join(filter(None, (cell.group, cell.condition)))


def _row(difference: Difference) -> dict[str, Any]:
    names = (
        "kind",
        "quantity",
        "where",
        "a",
        "b",
        "difference",
        "low",
        "high",
        "unit",
        "p",
        "p_corrected",
    )
    people = dict(zip(("people_a", "people_b"), difference.members, strict=True))
    return (
        {name: getattr(difference, name) for name in names}
        | people
        | {"left_out": difference.left_out}
    )


def to_table(study: StudyResult) -> dict[str, Any]:
    """What study.json holds."""
    table = {
        "format": FORMAT,
        "source": study.source,
        "options": study.options,
        "model": {"rung": study.rung, "name": RUNGS[study.rung]} if study.aic else None,
        "aic": {str(number): aic for number, aic in study.aic.items()},
        "table_1": study.table_1(),
        "fits": [_fit_to_table(cell, study.cohort) for cell in study.cells],
        "differences": [_row(d) for d in study.differences()],
        "trials": study.trials(),
        "methods": study.methods(),
        "versions": versions(),
    }
    return nulled(table)


def _fit_to_table(cell: Cell, cohort: CohortResult) -> dict[str, Any]:
    target, result = cell.target, cohort.results.get(cell.target.name)
    own = {
        "person": cell.person,
        "group": cell.group,
        "condition": cell.condition,
        "segments": target.segments or (),
        "source": target.source,
        "notices": target.notices,
        "dispersion": None if target.dispersion is None else target.dispersion[0],
        "unit": target.unit,
        "measured": {name: m.row() for name, m in target.measured.items()},
        "frequency_hz": target.frequency,
        "proportional_power": target.proportional_power,
    }
    if result is None:
        return own | {"failed": cohort.failed.get(target.name)}
    return own | {
        "success": result.success,
        "verdict": result.verdict,
        "adequate": result.adequate,
        "adequacy_p": result.adequacy_p,
        "fitted": result.fitted,
        "estimates": {name: vars(p) for name, p in result.as_shown(result.found).items()},
    }


class StudyOptions(ReadingOptions, total=False):
    """What a study's table may also say: the model and the statistics, and how files are read where
    a row does not say it (None: as if left out)."""

    rung: int | str | None
    noise: str | None
    quantities: Iterable[str] | None
    alpha: float | None
    correction: str | None
    groups: Sequence[str] | None
    conditions: Sequence[str] | None
    window: Sequence[float | int] | str | None
    skip_rows: int | None
    sheet: str | int | None
    spectrum: str | None
    mvc: float | int | None


def run_study(
    study: "str | os.PathLike[str] | Iterable[Mapping[str, Any]]",
    *,
    fit: bool = True,
    starts: int = 32,
    key: Key = 0,
    progress: bool | Tell = False,
    executor: AnyExecutor | None = None,
    **options: Unpack[StudyOptions],
) -> StudyResult:
    """Measure the recordings of a whole study, fit them with one model, and compare groups and
    conditions.

        found = jm.run_study("study.csv")
        print(found)
        found.save("results")

    The trials of a person in a condition make one target (`Trials.target`), each in its steady
    part. What is measured of it is what `steadiness` measures. All targets are fitted by
    `fit_cohort` with the same model, so that their numbers can be compared.

    **Arguments:**

    - `study`: one of three things. A table (.csv, .tsv, .txt) with a line for each recording. It
      has the columns file (relative to the table) and person; it may have group, condition, trial,
      window_start, window_stop and those of the last item but window. Or a .toml with `table =
      "study.csv"` or `[[recordings]]` of the same fields, and any of the options below but `fit`,
      `starts`, `key`, `progress` and `executor`. Or rows, as dictionaries.
    - `fit`: False for the measured part alone, without any model.
    - `rung`: the model of all people (`on_rung`), 0 to 3. By default 3, whose second resonance is
      the slower rhythm, where everybody has five trials or more in every condition, else 2, with
      activation and one resonance. "auto" fits several and takes the one whose AIC, summed over all
      targets, is lowest; that is three or four times as long.
    - `noise`: as in `fit`; `starts` of each fit; `key` of its random numbers.
    - `quantities`: what is reported and compared. By default all are reported, and compared are
      eight measured ones (mean, coefficient of variation with and without drift, power over the
      squared mean from 4 to 8 and from 8 to 12 Hz, median frequency, sample entropy, tremor
      frequency) and the frequencies of the model's resonances. The fewer, the less the correction
      costs.
    - `alpha`: level of the tests, by default 0.05. Intervals hold 1 - alpha.
    - `correction` for many comparisons: "holm" (default), "fdr" or "none". All comparisons of one
      kind (groups, conditions, interaction) are corrected together, measured quantities and those
      of the model apart.
    - `groups`, `conditions`: all of them, in the order in which they are shown and compared (the
      second less the first); by default as the table first names them.
    - `progress`: True or a function of (text, share).
    - `executor`: who reads the files and fits, an executor of `concurrent.futures` (whose processes
      are not forked) or a Dask client; by default this process. The results are the same to the
      last bit. Its workers must find the files by the same paths.
    - How files are read where a row does not say it: `window` (start, stop) [s] or "all" (by
      default the steady part); `column`, `rate`, `units`, `axis`, `reference`, `time`, `skip_rows`,
      `sheet`, `max_gap`, `outliers`, `lever_arm`, `quantity`, `baseline`, `detrend` as in
      `load_recording`; `spectrum`, a name of settings, the same for all; `mvc` as in
      `Trials.target`.

    An option that is given here replaces that of the .toml; what a row says about its own file
    stays.

    **Returns:** a `StudyResult`.

    **Raises:** `ValueError` naming file, line and column, or the argument, and the remedy;
    `WorkersLostError` for an executor whose workers or scheduler are lost.
    """
    check_key(key)
    check_options(run_study, StudyOptions, options)
    table = read_study(study)
    given = {name: value for name, value in options.items() if value is not None}
    used = _checked(USUAL | table.options | given)
    usual = {name: used.pop(name) for name in READING if name in used}
    used = used | {"starts": starts, "key": key}
    for name in ORDERS:
        there = list(dict.fromkeys(getattr(row, name[:-1]) for row in table.rows))
        if used[name] is not None and sorted(used[name]) != sorted(there):
            raise ValueError(f"{name} = {list(used[name])}: give all of {', '.join(there)}, once")
    with told(progress, f"study of {len({row.person for row in table.rows})} people") as tell:
        tell("reading recordings", 0.0)
        most = READ if fit else 1.0
        cells = cells_of_study(
            table.rows, usual, executor, lambda text, share: tell(text, most * share)
        )
        if used["rung"] is None:
            fewest = min(cell.trials for cell in cells)
            used["rung"] = 3 if fewest >= TRIALS_OF_TWO else 2
        cohort, aic = CohortResult({}, {}, {}), {}
        if fit:
            cohort, aic = _fitted(
                cells, used, lambda text, share: tell(text, READ + (1 - READ) * share), executor
            )
    return StudyResult(cohort, tuple(cells), aic, used | {"reading": usual}, table.source)


def _checked(options: dict[str, Any]) -> dict[str, Any]:
    """The options, of whichever origin, fit for use."""
    rung, alpha, names = (options[name] for name in ("rung", "alpha", "quantities"))
    if rung not in (AUTO, None) and (isinstance(rung, bool) or rung not in range(len(RUNGS))):
        raise ValueError(
            f'rung = {rung!r}: give a rung of the ladder, 0 to {len(RUNGS) - 1}, or "auto"'
        )
    if isinstance(options.get("window"), str) and options["window"] != "all":
        raise ValueError(f'window = {options["window"]!r}: give (start, stop) in s, or "all"')
    if isinstance(alpha, bool | str) or not 0 < alpha < 1:
        raise ValueError(f"alpha = {alpha!r}: give a share between 0 and 1, as 0.05")
    if options["correction"] not in CORRECTIONS:
        raise ValueError(
            f"correction = {options['correction']!r}:"
            f" {choices(str(options['correction']), CORRECTIONS)}"
        )
    names = None if names is None else list(names)
    for name in names or ():
        known = (*MEASURES, *DERIVED, *PARAMETERS)
        if name not in known:
            raise ValueError(f"quantities: unknown {name!r}; {choices(str(name), known)}")
    return options | {
        "quantities": (
            None if names is None else list(dict.fromkeys(ALIASES.get(n, n) for n in names))
        )
    }


def _fitted(
    cells: list[Cell], options: dict[str, Any], tell: Tell, executor: AnyExecutor | None
) -> tuple[CohortResult, dict[int, float]]:
    """The fits on the rung that is asked for, or on that of lowest AIC; and the AIC of each that
    was tried.

    What no model can be fitted to has no part in the choice. After the tremor, the first rung that
    gains nothing ends it.
    """
    numbers = range(len(RUNGS)) if options["rung"] == AUTO else (options["rung"],)
    labels = {cell.target.name: _group_of(cell) for cell in cells}
    tried: dict[int, CohortResult] = {}
    aic: dict[int, float] = {}
    for number in numbers:
        first, which = (
            len(tried),
            f"model {number} (of models 0 to {numbers[-1]}): " * (len(numbers) > 1),
        )
        tried[number] = fit_cohort(
            [cell.target for cell in cells],
            groups=labels,
            noise=options["noise"],
            rung=number,
            starts=options["starts"],
            key=options["key"],
            progress=lambda text, share, which=which, i=first: tell(
                which + text, (i + share) / len(numbers)
            ),
            executor=executor,
        )
        table = np.array([[_aic(cohort, cell) for cell in cells] for cohort in tried.values()])
        table = table[:, np.isfinite(table).any(axis=0)]
        aic = dict(zip(tried, map(float, table.sum(axis=1)), strict=True))
        if number >= 2 and min(aic, key=lambda n: aic[n]) != number:
            break
    return tried[min(aic, key=lambda n: aic[n])], aic


def _aic(cohort: CohortResult, cell: Cell) -> float:
    result = cohort.results.get(cell.target.name)
    return result.ladder[0].aic if result is not None and result.ladder else np.inf
