"""Several recordings of one person in one condition: together they make one target."""

import os
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Unpack, overload

import numpy as np

from jaxmuscle import plot
from jaxmuscle._common.arguments import check_options, require
from jaxmuscle._common.cards import Card, Shown
from jaxmuscle._common.names import name_of_all
from jaxmuscle._common.text import folded
from jaxmuscle.spectra._settings import SpectrumSettings
from jaxmuscle.spectra._welch import Spectrum

from ._recording import Recording, notices_of, pooled_target, recorded_settings
from ._recording_choice import ReadingOptions
from ._recording_files import load_columns, load_recording, read_tables
from ._recording_table import Table
from ._target import Target


class Trials(Shown, Sequence[Recording]):
    """Trials of one person in one condition: a sequence of `Recording`s, which together give one
    `Target`.

        trials = jm.load_recordings(["trial1.csv", "trial2.csv"]).steady()
        result = jm.fit(jm.Isometric(), trials)

    **Arguments:** `recordings`, one or more of the same unit. Their rates, lengths and windows may
    differ.

    **Raises:** `ValueError` for none, for something else than recordings, and for different units.
    """

    recordings: tuple[Recording, ...]

    def __init__(self, recordings: Iterable[Recording]):
        self.recordings = tuple(recordings)
        require(len(self.recordings) > 0, "recordings", [], "give at least one")
        remedy = "give Recordings; load_recording(...) reads a file"
        for other in self.recordings:
            require(isinstance(other, Recording), "recordings", other, remedy)
        units = dict.fromkeys(recording.unit for recording in self.recordings)
        if len(units) > 1:
            raise ValueError(
                f"recordings: the units {' and '.join(units)} cannot be averaged; bring all trials"
                " to one unit (nothing is converted by itself)"
            )

    def __len__(self) -> int:
        return len(self.recordings)

    def __iter__(self) -> Iterator[Recording]:
        return iter(self.recordings)

    @overload
    def __getitem__(self, index: int) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> "Trials": ...
    def __getitem__(self, index: int | slice) -> "Recording | Trials":
        return (
            Trials(self.recordings[index]) if isinstance(index, slice) else self.recordings[index]
        )

    @property
    def name(self) -> str:
        """What the names of the recordings have in common, or how many there are."""
        return name_of_all([recording.name for recording in self.recordings])

    def steady(self, window: Sequence[float | int] | str | None = None) -> "Trials":
        """Every recording with its steady part as window, see `Recording.steady`."""
        return Trials(recording.steady(window) for recording in self.recordings)

    def target(
        self,
        name: str | None = None,
        *,
        quantity: str | None = None,
        provenance: str = "measured",
        mvc: float | int | None = None,
        settings: SpectrumSettings | str | None = None,
    ) -> Target:
        """One target: the absolute spectra P_i of the trials averaged, weighted with their Welch
        segments K_i, which add up.

            p_k ∝ Σ_i K_i P_ik / Σ_i K_i

        The target states the segments of every trial; of a force or torque also its mean and
        coefficient of variation. It keeps the spectra of several trials. Their scatter gives the
        dispersion: how much more the trials differ than their segments explain
        (`Target.dispersion`).

        **Arguments:**

        - `name`: or what the trials' names have in common
        - `quantity`: or that of the unit
        - `provenance`
        - `mvc` [`unit`]: the maximal voluntary contraction, for the level (recordings in % MVC need
          none)
        - `settings`: by default those of `Recording.spectrum`

        **Raises:** `ValueError` if the unit (V, a.u.) does not say what was measured, and as
        `Recording.spectrum` does.
        """
        called = self.name if name is None else name
        return pooled_target(
            self.recordings, called, quantity, provenance, mvc, recorded_settings(settings)
        )

    def spectrum(self, settings: SpectrumSettings | str | None = None) -> Spectrum:
        """The mean of the recordings' spectra (`Recording.spectrum`), weighted with their Welch
        segments."""
        each, weights = [r.spectrum(settings) for r in self], [r.segments(settings) for r in self]
        power = np.average([one.power for one in each], axis=0, weights=weights)
        return Spectrum(each[0].frequency, power, each[0].settings, each[0].unit)

    def _notices(self, settings: SpectrumSettings | str | None = None) -> tuple[str, ...]:
        """What to mind of the recordings and their windows."""
        chosen, quantity = recorded_settings(settings), self.recordings[0].quantity
        signals = [recording.filtered(chosen) for recording in self]
        return notices_of(self.recordings, signals, chosen.rate, quantity)

    def plot(self, settings: SpectrumSettings | str | None = None, ax: Any = None) -> Any:
        """Draw the windows and the spectra of the recordings; a single one as by `Recording.plot`.
        Returns the figure."""
        return plot.trials(self, settings, ax)

    def _card(self) -> Card:
        head = f"{self.name}: {len(self)} recordings [{self.recordings[0].unit}]"
        rows = tuple(
            (r.name, r.window_in_words, f"{np.mean(r.samples):.4g} {r.unit}")
            for r in self.recordings
        )
        lines = [f"  {name}: {window}, mean {mean}" for name, window, mean in rows]
        return Card(folded([head, *lines]), head, ("recording", "window", "mean"), rows)


def load_recordings(
    paths: "Iterable[str | os.PathLike[str] | Table] | str | os.PathLike[str] | Table",
    *,
    columns: Iterable[str | int] | None = None,
    skip_rows: int = 0,
    sheet: str | int | None = None,
    **options: Unpack[ReadingOptions],
) -> Trials:
    """Load the trials of one person in one condition.

        target = jm.load_recordings(["trial1.csv", "trial2.csv"]).steady().target("anna")

    **Arguments:**

    - `paths`: a list of files, or the path of one file that has a column for each trial (or what
      `jaxmuscle.data.read_table` read of them)
    - `columns`: which columns of this one file are trials (by default all with numbers but the
      time)
    - `skip_rows`, `sheet`, and the `options` for one column (`column`, `rate`, `units`, `axis`,
      `reference`, `time`, `max_gap`, `outliers`, `lever_arm`, `quantity`, `baseline`, `detrend`):
      as in `load_recording`, the same for all files. Several sheets of one layout in a workbook are
      trials, unless `sheet` names one

    **Returns:** `Trials`, in the order given. **Raises:** `ValueError` as `load_recording` does,
    and for different units.
    """
    check_options(load_recordings, ReadingOptions, options)
    if isinstance(paths, str | os.PathLike | Table):
        column = options.pop("column", None)
        remedy = "one file holds all trials here; name several with `columns`"
        require(column is None, "column", column, remedy)
        return Trials(load_columns(paths, columns, skip_rows=skip_rows, sheet=sheet, **options))
    files = list(paths)
    if columns is not None:
        raise ValueError(
            "columns: these are for one file that holds all trials; give its path alone, as a text"
        )
    tables = [table for path in files for table in read_tables(path, skip_rows, sheet)]
    return Trials(load_recording(table, **options) for table in tables)
