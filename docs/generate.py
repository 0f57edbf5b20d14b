"""Writes docs/reference/parameters.md and files.md from the tables in the code: `python
docs/generate.py`."""

import math
import re
import types
import typing
from pathlib import Path

import msgspec

from jaxmuscle.data._frequency_response import ResponseTable
from jaxmuscle.data._study_table import ReadingTable, RecordingTable, StudyFile
from jaxmuscle.data._target_fields import TargetFile
from jaxmuscle.fits import _result
from jaxmuscle.model._parameters import DEFAULT_FREE, PARAMETERS, Parameter
from jaxmuscle.response._presets import PresetFile

PAGE = Path(__file__).parent / "reference" / "parameters.md"
HEAD = """# Parameters and units

Look here for the name, unit, default and limits of a parameter. In Python `jm.model.PARAMETERS[name]` is the same row.
`docs/generate.py` writes this page from the code.

## One name everywhere

A parameter has the name of this table wherever you write it:

| to | write |
|---|---|
| make a task with it | `jm.Isometric(k_w=4e5, noise="pink")` |
| read it | `task["k_w"]`, `task.k_w`, `result.parameters["k_w"]` |
| change it | `task.replace(k_w=4e5)` |
| say how it is fitted | `free=("k_w",)`, `fix={"k_w": 4e5}`, `priors={"k_w": 0.5}`, `bounds={"k_w": (1e5, 1e6)}` |
| do the same on the command line | `--free k_w`, `--fix k_w=4e5` |

(In `priors` the number is the standard deviation of the prior, of a positive parameter that of its logarithm: 0.5 means a
factor of 1.6 either way.)

- The letter at the end says which tissue is meant: `_w` the active one, `_z` the passive one. A small letter is a factor
  (`k_w`, `c_w`), a capital the stiffness or damping itself (`K_w0`). `noise_K_w` is the noise on the stiffness K_w.
- `activation_time` has a second name, the one that motor control uses: `contraction_time`. Both names work everywhere.
- `K_w0`, `K_z0`, `C_w0` and `C_z0` are stiffness and damping at rest. They follow from the parameters. You can read them
  (`task["K_w0"]`, `result["K_w0"]`), but not set or fit them.
- `harmonic_amplitude` is a fraction of K_w0 and of K_z0: the harmonic acts on both.
- `P_w`, `F_ext` and `x_z` are inputs over time. `task["P_w"]` is the level that is held, and
  `task.P_w` is the whole signal. `P_w` is larger than the force that one measures: the spring of the active tissue (K_w)
  takes its share. At the defaults P_w = 5 N gives F_ext = 2.2 N.
- In a [joint fit](../identifiability.md#a-joint-fit) `c_w@high` is the `c_w` of the target "high" alone.
- A wrong name is an error that says which one you may have meant.

## Values

*Bounds* say which values are physically possible. (For a mass, a cut-off, a correlation time and the frequency of the
harmonic 0 itself is refused.) A name with a dot (●) is free in a default fit: the fit looks for its value. If
the task has them, `noise_correlation_time`, `activation_time` and all `resonance_` and `resonance_2_` are free, too. So are
`m_w` and `m_z` where a motor moved the insertion. (If a target has no spectrum, only `k_w`, `k_z`, `c_w`, `c_z`, `m_w`
and `m_z` are free.)

A default task has no activation, no resonance, no second resonance and no other noise on the drive. For the first three the
column *default* says with which value they begin when you add them (`jm.model.on_rung`, `jm.Activation()`, `jm.ResonantNoise()`).
Noise on the drive you add with a value of your own: `task.replace(noise_P_w=0.02)` (0.02 in the
table is a usual size). In
`PrescribedMotion` `F_ext` is 10 N by default.

| name | symbol | unit | default | bounds | meaning |
|---|---|---|---|---|---|
"""
FIT = """
## In a fit

A fit has a [prior](../glossary.md#the-fit) for every free parameter. The prior is centred on the value that the parameter
has in the task which you pass in. *Prior sd* is the standard deviation of the prior. A positive parameter is fitted in *log
space*: its *prior sd* is that of the logarithm. For the other parameters it is in their own unit. *Reached by a fit* are the
bounds of the search. In models with activation or resonance the *prior sd* of k_w, k_z, c_w and c_z is 0.5, unless a motor
moved the insertion ([why](../force.md)). *The paper* is the one from which [the model](../model.md) comes.

| name | log space | prior sd | reached by a fit | source of the default |
|---|---|---|---|---|
"""
TAIL = """
## Units

All units are SI: masses in kg, lengths in m, forces in N, times in s, frequencies in Hz, angles in rad. `k` [N/m³] times a
squared length is a stiffness [N/m]. `c` [N s³/m³] times a squared velocity is a damping coefficient [N s/m]. The unit 1
means a ratio: amplitudes of noise and harmonic are fractions of the stiffness or damping at rest, or of P_w.

::: jaxmuscle.model.PARAMETERS

The table by name, a dictionary of `Parameter`.

::: jaxmuscle.model.Parameter
"""
FILES = Path(__file__).parent / "reference" / "files.md"
FILES_HEAD = """# Files, key by key

Look here if you write one of these files by hand, or read one with your own program. For each kind of file there is
a table of its keys. The fields of [`SpectrumSettings`](spectra.md) and of a task have pages of their own and are not
repeated here. Let `task.save` write the table of a task.

**Columns.** *If missing* says what a file means that lacks the key; *error* means that such a file is refused. *Since* is
the first version of the format that has the key. Presets of format 1 are read, too.

**Types.** A *table* is what Python calls a dict: an object in JSON, a `[table]` in TOML. The keys of a *table by name* are
not fixed: they are, for example, the names of parameters. Brackets hold the type of one entry: in a *list of (number or
null)* each entry may be null, and a *(list of number) or null* is a list of numbers, or null in its place. In a fit.json
null stands for a number that is not finite or could not be computed, where the row says nothing else.

**Mistakes.** Files are checked when they are read. If a key is unknown, there twice, of a wrong type or out of range,
an error names the file and the key. Numbers must be finite. `true` is not 1, and `1.0` is not a whole number.

`docs/generate.py` writes this page from the code that checks the files.
"""
FIT_FILE = """JSON, format 6. `FitResult.save` writes it and `load_result` reads it. `load_preset` reads its
`task_table` alone. A fit of one target has the keys of the first two tables side by side. In a
[joint fit](../identifiability.md#a-joint-fit) (*several targets* below)
the keys of the second table stand under `parts`, by the name of the target. What the file says twice must agree: the
value of a parameter with the `task_table`, the spectrum with the `target_table`. What was measured without the model
stands under `measured` in the `target_table`. Earlier formats are not read: fit again."""
PRESET = """TOML, format 2. `task.save` writes it and `load_preset` reads it. The `task_table` has every field of
the task and of its parts. `type` is the class of a part. What a task does not have (`activation`; `initial`, the state
from which a simulation begins; in its spectrum settings `filter_cutoff`, the low-pass) is written as `"none"`."""
TARGET = """TOML, format 1. `Target.save` writes it and `load_target` reads it. The `target_table` of a fit.json has
the same keys without `format`, and `null` for what is not stated. *If missing* is for the .toml."""
STUDY = """A study is a table of recordings with options ([a study](../study.md)). `run_study` reads it. You can write it in
two ways:

- a study.csv that has the keys of the first two tables as its columns. An empty cell counts as missing. If you like, write
  a study.toml, too, which names it as its `table`;
- or a study.toml alone. It has an entry `[[recordings]]`, with the keys of the first two tables, for each recording.

At its top a study.toml may have the keys of the second and the third table. What it says there about reading holds for every
recording that does not say it itself."""
F = _result
SECTIONS = (
    (
        "fit.json",
        FIT_FILE,
        5,
        (
            F.FitTable,
            F.PartTable,
            F.EstimateTable,
            F.Adequacy,
            F.Rung,
            F.Start,
            F.CorrelationTable,
            F.ProfileTable,
            F.SettingsTable,
            F.SpectrumTable,
            F.StretchTable,
        ),
    ),
    ("Preset", PRESET, 1, (PresetFile,)),
    ("Target", TARGET, 1, (TargetFile, ResponseTable)),
    ("Study", STUDY, 1, (RecordingTable, ReadingTable, StudyFile)),
)
NAMES = {
    float: "number",
    int: "whole number",
    str: "text",
    bool: "true or false",
    dict: "table",
    type(None): "null",
}
LATER = {
    ("PresetFile", "format"): 2,
}
POWERS = str.maketrans("23", "²³")


def number(value: float) -> str:
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.4g}".replace("e+0", "e").replace("e-0", "e-")


def interval(low: float, high: float) -> str:
    left = "(" if math.isinf(low) else "["
    right = ")" if math.isinf(high) else "]"
    return f"{left}{number(low)}, {number(high)}{right}"


def unit(row: Parameter) -> str:
    """With powers as a reader writes them; a unit is not broken between lines."""
    text = row.unit.replace("^", "").translate(POWERS) if "^" in row.unit else row.unit
    return text.replace(" ", "&nbsp;")


def page() -> str:
    """The text of the page."""
    values, fits = [], []
    for row in PARAMETERS.values():
        name = f"`{row.name}`" + (" ●" if row.name in DEFAULT_FREE else "")
        bounds = interval(row.lower, row.upper)
        values.append(
            f"| {name} | {row.symbol} | {unit(row)} | {number(row.default)} | {bounds} |"
            f" {row.meaning} |\n"
        )
        reached = interval(row.fit_lower, row.fit_upper)
        log = "yes" if row.positive else "no"
        source = row.source.replace("^2", "²")
        fits.append(f"| `{row.name}` | {log} | {number(row.prior_sd)} | {reached} | {source} |\n")
    return HEAD + "".join(values) + FIT + "".join(fits) + TAIL


def kind(given: typing.Any) -> str:
    """A type in words."""
    origin, inside = typing.get_origin(given), typing.get_args(given)
    if origin is typing.Annotated:
        about = inside[1]
        limits = (
            (about.gt, "above"),
            (about.ge, "at least"),
            (about.lt, "below"),
            (about.le, "at most"),
        )
        said = [f"{word} {limit}" for limit, word in limits if limit is not None]
        return " ".join([kind(inside[0]), ", ".join(said)]).strip()
    if origin in (types.UnionType, typing.Union):
        kinds = dict.fromkeys(
            kind(each) for each in inside if not (each is int and float in inside)
        )
        return " or ".join(bracketed(each, " of ") if len(kinds) > 1 else each for each in kinds)
    if origin is typing.Literal:
        return ", ".join(f"`{each}`" for each in inside)
    if origin in (list, tuple):
        each = bracketed(kind(inside[0]), " of ", " or ")
        return (
            f"list of {each}"
            if origin is list or ... in inside
            else f"list of {len(inside)}: {each}"
        )
    if origin is dict:
        each = bracketed(kind(inside[1]), " of ", " or ")
        return f"table by name, each: {each}" if inside[1] is not typing.Any else "table"
    return NAMES.get(
        given, "table" if isinstance(given, type) and issubclass(given, msgspec.Struct) else "any"
    )


def bracketed(text: str, *marks: str) -> str:
    """A type of several words in brackets."""
    return f"({text})" if any(mark in text for mark in marks) else text


def files_page() -> str:
    """The text of the page of files."""
    text = FILES_HEAD
    for title, said, since, tables in SECTIONS:
        text += f"\n## {title}\n\n{said}\n"
        for table in tables:
            hints = typing.get_type_hints(table, include_extras=True)
            heading = " ".join((table.__doc__ or "").split()).rstrip(".")
            text += f"\n### {heading}\n\n"
            text += (
                "| key | meaning | type and range | if missing | since |\n|---|---|---|---|---|\n"
            )
            inherited = [name for base in table.__bases__ for name in base.__annotations__]
            for field in (
                field for field in msgspec.structs.fields(table) if field.name not in inherited
            ):
                given, *limits, about = typing.get_args(hints[field.name])
                # an Annotated within one is flattened
                given = typing.Annotated[given, *limits] if limits else given
                missing = about.extra["missing"] or "error"
                if field.required != (missing == "error"):
                    raise ValueError(
                        f"{table.__name__}.{field.name}: say what it means that the key is missing"
                    )
                first = LATER.get((table.__name__, field.name), since)
                told = about.extra["kind"] or kind(given)
                if said == STUDY:
                    # which neither TOML nor CSV has
                    told = re.sub(r"^\((.*)\)$", r"\1", told.removesuffix(" or null"))
                text += f"| `{field.name}` | {about.description} | {told} | {missing} | {first} |\n"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    FILES.write_text(files_page(), encoding="utf-8")
