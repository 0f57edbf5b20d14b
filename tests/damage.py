"""Files that were damaged or changed by hand: read cleanly, or refused with one sentence that names
the file.

    python tests/damage.py --count 5000   # of every format; prints how many were read

A mutant is a valid file with one change: in its text (bytes, lines, numbers) or in its structure (a
key dropped, renamed or there twice, another value, type or nesting). What is read must be what the
file says, by a reader of its own here.
"""

import argparse
import collections
import copy
import csv
import io
import json
import random
import re
import sys
import tempfile
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

import jaxmuscle as jm
from jaxmuscle._common.errors import PresetError, ResultError, TargetError
from jaxmuscle.data._study_table import read_study
from jaxmuscle.fits._result import to_table
from jaxmuscle.model._task_tables import task_to_table

VALUES: tuple[Any, ...] = (
    0,
    1,
    -1,
    2,
    3.5,
    1e-320,
    1e308,
    -1e308,
    float("nan"),
    float("inf"),
    10**30,
    2**32,
    True,
    False,
    None,
    "",
    "x",
    "1",
    "none",
    "inf",
    "../../x",
    "\x00",
    "\n",
    "\u00e9\U0001f600",
    [],
    [1],
    [None],
    ["x"],
    [[1.0]],
    {},
    {"a": 1},
    {"type": "Muscle"},
)
WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e400",
    "1e308",
    "-0.5",
    "9" * 400,
    "9" * 5000,
    "true",
    '"x"',
    "[]",
    "null",
    "",
    "1_0",
    "0x1f",
    "½",
)
DEEP = 5000


class Format(NamedTuple):
    """A kind of file: a valid one, how it is read, the errors that may come, and whether what was
    read is what it says."""

    name: str
    text: str
    read: Callable[[Path], Any]
    errors: tuple[type[ValueError], ...]
    same: Callable[[Any, str], bool]


# --- what a file says, read by other means


def _close(a: Any, b: Any) -> bool:
    """Nested lists and tables: same keys, same kinds, same numbers."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_close(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(_close, a, b))
    if (
        isinstance(a, bool)
        or isinstance(b, bool)
        or not (isinstance(a, int | float) and isinstance(b, int | float))
    ):
        return type(a) is type(b) and a == b
    return bool(np.isclose(a, b, rtol=1e-8, atol=0))


def _same_fit(result: jm.fits.FitResult, text: str) -> bool:
    made, said = json.loads(json.dumps(to_table(result))), json.loads(text)
    ignored = ("format", "verdict")
    return _close(
        {k: v for k, v in made.items() if k not in ignored},
        {k: v for k, v in said.items() if k not in ignored},
    )


def _same_preset(task: Any, text: str) -> bool:
    said = tomllib.loads(text)["task_table"]
    # one number is that of all four coefficients
    if not isinstance(said["noise"]["amplitude"], list):
        said["noise"]["amplitude"] = 4 * [said["noise"]["amplitude"]]
    return _close(json.loads(json.dumps(task_to_table(task))), said)


def _same_target(target: jm.Target, text: str) -> bool:
    said = tomllib.loads(text)
    power = np.array(said["proportional_power"], float)
    frequency = np.array(said["frequency_hz"], float)
    settings = target.settings.to_dict()
    if any(not _close(settings[key], value) for key, value in said.get("settings", {}).items()):
        return False
    for key in ("name", "quantity", "provenance", "source", "mvc_fraction", "unit", "reason"):
        if getattr(target, key) != said.get(key):
            return False
    if not _close(target.to_table().get("measured"), said.get("measured")):
        return False
    for key in ("segments", "coefficient_of_variation", "mean"):
        value = said.get(key)
        value = value if value is None or isinstance(value, list) else [value]
        if not _close(None if getattr(target, key) is None else list(getattr(target, key)), value):
            return False
    position = frequency / target.settings.resolution
    bins = np.rint(position).astype(int)
    if np.any(np.abs(position - bins) > 0.02) or len(set(bins)) < len(bins):
        return any("interpolated" in notice for notice in target.notices)
    kept = (bins >= target.settings.first_bin) & (bins <= target.settings.last_bin)
    ratio = (
        target.proportional_power / power[kept] if np.sum(kept) == len(target.bins) else np.zeros(2)
    )
    return bool(np.ptp(ratio) <= 1e-8 * abs(ratio[0]) and ratio[0] > 0)


def _rows(text: str) -> list[list[str]] | None:
    """Cells of a text of commas; None for one in another dialect."""
    lines = [line.partition("#")[0] for line in re.split("\r\n|\r|\n", text.removeprefix("\ufeff"))]
    lines = [line for line in lines if line.strip()]
    if not lines or any(sign in line for line in lines for sign in ';\t"'):
        return None
    return [[cell.strip() for cell in row] for row in csv.reader(io.StringIO("\n".join(lines)))]


def _same_csv(target: jm.Target, text: str) -> bool:
    rows = _rows(text)
    if rows is None:
        return True
    if rows[0][0].replace(".", "").isdigit():  # without its header it is a figure's
        return target.provenance == "digitised"
    names = [cell.lower() for cell in rows[0]]
    # a changed letter may leave a name that other programs give
    at = next(i for i, name in enumerate(names) if name.startswith(("f", "hz")))
    of = next(i for i, name in enumerate(names) if i != at and name != "sigma")
    power = {round(min(float(row[at]), 1e9) / 0.390625, 6): float(row[of]) for row in rows[1:]}
    if any(abs(bin - round(bin)) > 0.02 for bin in power):
        return any("interpolated" in notice for notice in target.notices)
    stated = {round(bin): value for bin, value in power.items() if 1 <= round(bin) <= 30}
    if list(stated) != target.bins.tolist():
        return False
    ratio = target.proportional_power / np.array(list(stated.values()))
    return bool(np.ptp(ratio) <= 1e-8 * ratio[0])


def _same_study(study: Any, text: str) -> bool:
    rows = _rows(text)
    if rows is None:
        return True
    names = [name.casefold() for name in rows[0]]
    said = [dict(zip(names, row, strict=True)) for row in rows[1:]]
    if len(said) != len(study.rows):
        return False
    for row, cells in zip(study.rows, said, strict=True):
        if any(getattr(row, key) != cells.get(key, "") for key in ("person", "group", "condition")):
            return False
        if row.reading.get("rate") != (float(cells["rate"]) if cells.get("rate") else None):
            return False
    return True


def _same_recording(recording: jm.Recording, text: str) -> bool:
    rows = _rows(text)
    if rows is None or len({len(row) for row in rows}) > 1:
        return True
    try:
        column = [name.lower() for name in rows[0]].index("force_n")
        force = np.array([float(row[column]) for row in rows[1:]])
    except (ValueError, IndexError):
        return True
    made = np.asarray(recording.samples)
    return (
        made.shape != force.shape
        or bool(np.allclose(made, force, rtol=1e-9, equal_nan=True))
        or bool(recording.notices)
    )


# --- valid files


def formats(folder: Path, result: jm.fits.FitResult) -> list[Format]:
    """Valid files of every kind; what they name lies in the folder."""
    grid = 0.390625 * np.arange(1, 31)
    power = 1 / (1 + (grid / 1.2) ** 2) + 0.01
    result.save(folder / "valid.json")
    result.task.save(folder / "valid.toml", description="a preset")
    target = jm.Target(
        "made",
        power,
        segments=[6, 7],
        coefficient_of_variation=[0.02, 0.03],
        mean=[2.0, 2.1],
        unit="N",
        sigma=0.1 * power,
        source="here",
        settings=jm.SpectrumSettings(filter_direction="both"),
    )
    target.with_measures().save(folder / "target.toml")
    rng = np.random.default_rng(0)
    samples = 5 + 0.1 * rng.standard_normal(200)
    recording = "# a trial\ntime_s,force_N\n" + "".join(
        f"{k / 100:.2f},{x:.6f}\n" for k, x in enumerate(samples)
    )
    people = [
        (person, group, trial)
        for person, group in (("anna", "a"), ("ben", "b"), ("eva", "a"))
        for trial in (1, 2)
    ]
    study = "file,person,group,condition,trial,rate\n"
    for person, group, trial in people:
        (folder / f"{person}{trial}.csv").write_text(recording)
        study += f"{person}{trial}.csv,{person},{group},rest,{trial},100\n"
    listed = {
        "rung": 1,
        "alpha": 0.05,
        "recordings": [
            {
                "file": f"{person}{trial}.csv",
                "person": person,
                "group": group,
                "trial": trial,
                "rate": 100.0,
            }
            for person, group, trial in people
        ],
    }
    spectrum = "# made\nfrequency_hz,proportional_power\n" + "".join(
        f"{f:.6f},{p:.6f}\n" for f, p in zip(grid, power, strict=True)
    )
    clean = lambda *_: True  # noqa: E731
    return [
        Format(
            "fit.json",
            (folder / "valid.json").read_text(),
            jm.load_result,
            (ResultError,),
            _same_fit,
        ),
        Format(
            "preset.toml",
            (folder / "valid.toml").read_text(),
            jm.load_preset,
            (PresetError,),
            _same_preset,
        ),
        Format(
            "target.toml",
            (folder / "target.toml").read_text(),
            jm.load_target,
            (TargetError,),
            _same_target,
        ),
        Format("target.csv", spectrum, jm.load_target, (TargetError,), _same_csv),
        Format("study.csv", study, read_study, (ValueError,), _same_study),
        Format("study.toml", tomli_w.dumps(listed), read_study, (ValueError,), clean),
        Format("recording.csv", recording, jm.load_recording, (ValueError,), _same_recording),
    ]


# --- mutants


def _places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inside = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value[:40])
        if isinstance(value, list)
        else ()
    )
    return [place for key, entry in inside for place in ((*at, key), *_places(entry, (*at, key)))]


def _changed(table: Any, rng: random.Random) -> tuple[Any, str | None]:
    """One change of structure; the key that is to be written twice, if that is the change."""
    table = copy.deepcopy(table)
    holder, (*way, last) = table, rng.choice(_places(table))
    for step in way:
        holder = holder[step]
    value = holder[last]
    kind = rng.choice(
        ("drop", "rename", "value", "value", "nest", "deep", "scale", "text", "twice")
    )
    if kind == "drop":
        del holder[last]
    elif kind == "rename" and isinstance(holder, dict):
        holder[rng.choice((f"{last}s", str(last).upper(), "", " ", f" {last}"))] = holder.pop(last)
    elif kind == "twice" and isinstance(holder, dict):
        return table, last
    elif kind == "nest":
        holder[last] = rng.choice(([value], {"value": value}, {str(last): value}))
    elif kind == "deep":
        for _ in range(rng.choice((5, 50, 300))):
            value = [value]
        holder[last] = value
    elif kind == "scale" and isinstance(value, int | float) and not isinstance(value, bool):
        holder[last] = value * rng.choice((-1, 0.9, 1.0001, 10, 1e6, 0))
    elif kind == "text":
        holder[last] = str(value)
    else:
        holder[last] = copy.deepcopy(rng.choice(VALUES))
    return table, None


def parsed_as(text: str, kind: str) -> dict[str, Any]:
    """The table of a text of that kind."""
    return json.loads(text) if kind == "json" else tomllib.loads(text)


def keys_of(table: dict[str, Any]) -> list[tuple[Any, ...]]:
    """Where keys stand, not the entries of lists."""
    return [place for place in _places(table) if not isinstance(place[-1], int)]


def without(table: dict[str, Any], place: tuple[Any, ...], kind: str) -> bytes:
    """The file with a key left out."""
    table = copy.deepcopy(table)
    holder = table
    for step in place[:-1]:
        holder = holder[step]
    del holder[place[-1]]
    return (json.dumps(table) if kind == "json" else tomli_w.dumps(table)).encode()


def _structured(text: str, kind: str, rng: random.Random) -> str | None:
    table, twice = _changed(parsed_as(text, kind), rng)
    if kind == "json":
        text = json.dumps(table)
        return (
            text
            if twice is None
            else text.replace(
                f'"{twice}":', f'"{twice}": {rng.choice(("1", "null"))}, "{twice}":', 1
            )
        )
    try:
        text = tomli_w.dumps(table)
    except (TypeError, ValueError, RecursionError):  # TOML has no word for it
        return None
    return (
        text
        if twice is None
        else re.sub(rf"(?m)^({re.escape(str(twice))} = .*)$", r"\1\n\1", text, count=1)
    )


def _texted(text: str, rng: random.Random) -> bytes:
    """One change of bytes, of a line, or of a number."""
    data = text.encode()
    at = rng.randrange(len(data))
    kind = rng.choice(
        (
            "flip",
            "flip",
            "insert",
            "delete",
            "cut",
            "line gone",
            "line twice",
            "swap",
            "number",
            "number",
            "deep",
        )
    )
    lines = text.split("\n")
    row = rng.randrange(len(lines))
    numbers = list(re.finditer(r"-?\d+(\.\d+)?(e-?\d+)?", text))
    if kind == "flip":
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == "insert":
        return (
            data[:at]
            + rng.choice((b"\x00", b"\xff", b",", b'"', b"\n", b"#", b"[", b"\xef\xbb\xbf", b"1"))
            + data[at:]
        )
    if kind == "delete":
        return data[:at] + data[at + rng.choice((1, 2, 30)) :]
    if kind == "cut":
        return data[:at]
    if kind == "deep":
        return data[:at] + rng.choice((b"[", b'{"a":')) * DEEP + data[at:]
    if kind == "number" and numbers:
        found = rng.choice(numbers)
        return (text[: found.start()] + rng.choice(WORDS) + text[found.end() :]).encode()
    if kind == "line gone":
        del lines[row]
    elif kind == "line twice":
        lines.insert(row, lines[row])
    else:
        other = rng.randrange(len(lines))
        lines[row], lines[other] = lines[other], lines[row]
    return "\n".join(lines).encode()


def mutant(of: Format, rng: random.Random) -> bytes:
    """A valid file with one change."""
    kind = of.name.rpartition(".")[2]
    if kind in ("json", "toml") and rng.random() < 0.6:
        text = _structured(of.text, kind, rng)
        if text is not None:
            return text.encode("utf-8", errors="surrogatepass")
    return _texted(of.text, rng)


def fault(of: Format, data: bytes, path: Path) -> str | None:
    """What is wrong with how a mutant was met: "" if it was read, None if it was refused as it
    should be."""
    path.write_bytes(data)
    try:
        found = of.read(path)
    except Exception as error:
        said = str(error)
        if type(error) not in of.errors:
            return f"{type(error).__name__}: {said[:200]}"
        if "\n" in said or not said.strip():
            return f"not one sentence: {said[:200]!r}"
        return None if path.name in said else f"names no file: {said[:200]}"
    return (
        ""
        if of.same(found, data.decode("utf-8-sig", errors="replace"))
        else "read as something else than it says"
    )


def tried(
    of: Format, count: int, folder: Path
) -> tuple[collections.Counter, list[tuple[str, bytes]]]:
    """How many mutants were read and refused, and those that were met wrongly."""
    rng, counts, wrong = random.Random(f"{of.name} 0"), collections.Counter(), []
    path = folder / f"mutant.{of.name.rpartition('.')[2]}"
    for _ in range(count):
        data = mutant(of, rng)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = fault(of, data, path)
        counts["refused" if found is None else "wrong" if found else "read"] += 1
        if found:
            wrong.append((found, data))
    return counts, wrong


def main() -> None:
    """Print counts, and the first mutants that were met wrongly."""
    from test_result import made_result

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=5000)
    count = parser.parse_args().count
    with tempfile.TemporaryDirectory() as name:
        for of in formats(Path(name), made_result())[1:]:  # a fit.json is written by us alone
            counts, wrong = tried(of, count, Path(name))
            print(
                f"{of.name:<14} {count} mutants: {counts['read']} read as they say,"
                f" {counts['refused']} refused, {counts['wrong']} wrong",
                flush=True,
            )
            for found, data in wrong[:12]:
                print(f"    {found[:110]}: {data[:200]!r}")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent / "fits"))
    main()
