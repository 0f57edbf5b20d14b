"""Digitised figures: the CSV of WebPlotDigitizer, points beside the bins, files that are wrong."""

import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pages
import pytest
from recorded import noticed
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle._common.errors import TargetError
from jaxmuscle.commands import fit as _cli_fit
from jaxmuscle.commands.main import app
from jaxmuscle.data._target import load_target

GRID = 0.390625 * np.arange(1, 31)
DOCS = Path(__file__).parents[2] / "docs" / "digitise.md"


def spectrum(f):
    """A slow part and a peak at 4.3 Hz."""
    return 1 / (1 + (f / 1.2) ** 2) + 0.08 * np.exp(-(((f - 4.3) / 0.6) ** 2)) + 0.004


SHARES = spectrum(GRID) / spectrum(GRID).sum()


def write(folder, text, name="figure.csv"):
    path = folder / name
    path.write_text(text)
    return path


def pairs(x, y, sign=","):
    return "".join(f"{a}{sign}{b}\n" for a, b in zip(x, y, strict=True))


# --- one curve without a header


def test_decades_as_values_are_log_log(tmp_path):
    f = np.append(GRID, 1.0)  # whose logarithm is 0, and which is no mean
    for path, axis in (
        (write(tmp_path, pairs(f, spectrum(f))), "linear"),
        (write(tmp_path, pairs(*np.log10([f, spectrum(f)])), "decades.csv"), "log-log"),
    ):
        target = load_target(path, segments=6, axis=axis)
        assert len(target.proportional_power) == 30 and "interpolated" in target.notices[1]
        np.testing.assert_allclose(target.proportional_power, SHARES, rtol=1e-12)
        assert (target.provenance, target.segments) == ("digitised", (6,))
        assert ("log10 of frequency in Hz and of power" in target.notices[0]) == (axis != "linear")


def test_power_law_is_straight_between_points_of_a_log_log_figure(tmp_path):
    f = np.array([0.3, 2.0, 13.0])
    path = write(tmp_path, pairs(*np.log10([f, 0.2 / f**1.7]), ";"))
    target = load_target(path, axis="log-log")
    # three points are not thirty: the bins nearest to them
    np.testing.assert_array_equal(target.bins, [1, 5])
    law = target.frequency**-1.7
    np.testing.assert_allclose(target.proportional_power, law / law.sum(), rtol=1e-6)
    assert noticed(target, "the log power was interpolated over log frequency (widest gap 11 Hz)")


def test_ends_within_a_pixel_are_not_lost(tmp_path):
    rows = pairs(GRID + 0.03, spectrum(GRID))
    target = load_target(write(tmp_path, rows))
    np.testing.assert_array_equal(target.bins, np.arange(1, 31))
    assert (
        target.notices[1]
        == "some frequencies lie up to 0.077 bins beside a bin, and count as that bin: a figure"
        " cannot be read more finely"
    )
    stated = write(tmp_path, "frequency_hz,proportional_power\n" + rows, "stated.csv")
    np.testing.assert_array_equal(load_target(stated).bins, np.arange(1, 31))


# --- several datasets


def wide(names=("a", "b"), delimiter=",", decimal="."):
    """What "Export All Data" writes: the second dataset is shorter."""
    lines = [
        delimiter.join(f"{name}{delimiter}" for name in names),
        delimiter.join(["X", "Y"] * len(names)),
    ]
    for k, f in enumerate(GRID):
        cells = [f, spectrum(f), *([f, 2 + f] if k < 10 else ["", ""])][: 2 * len(names)]
        lines.append(delimiter.join(str(cell).replace(".", decimal) for cell in cells))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", ","), ("\t", ",")])
def test_export_of_all_datasets(delimiter, decimal, tmp_path):
    text = "# from a figure\n" + wide(delimiter=delimiter, decimal=decimal)
    path = write(tmp_path, text, "all.csv")
    target = load_target(path, dataset="a")
    np.testing.assert_allclose(target.proportional_power, SHARES, rtol=1e-12)
    source = "WebPlotDigitizer export all.csv, dataset 'a'"
    assert (target.name, target.provenance, target.source) == ("all", "digitised", source)
    assert target.notices[0].startswith("dataset 'a': read as points of a figure, frequency in Hz")
    np.testing.assert_array_equal(load_target(path, dataset="b").bins, np.arange(1, 11))
    assert load_target(write(tmp_path, wide(["only"]), "one.csv")).bins.size == 30
    target.save(tmp_path / "copy.toml")
    assert load_target(tmp_path / "copy.toml") == target


# --- files that are wrong


BAD_FILES = {
    "choose": (
        "f.csv",
        wide(),
        {},
        "holds several datasets, choose one with dataset= (--dataset): 'a', 'b'",
    ),
    "unknown": ("f.csv", wide(), {"dataset": "c"}, "no dataset 'c'"),
    "comma in a name": (
        "f.csv",
        wide(["a, mean", "b"]),
        {"dataset": "b"},
        "line 1: 5 cells above 4 columns; a comma in",
    ),
    "half a point": ("f.csv", wide(["a"]) + "13,\n", {}, "line 33: Y '' is not a number"),
    "text": ("f.csv", wide(["a"]) + "13,high\n", {}, "line 33: Y 'high' is not a number"),
    "names only": ("f.csv", "a,\nX,Y\n", {}, "holds no points"),
    "negative": (
        "f.csv",
        "a,\nX,Y\n0.4,0.5\n0.8,-0.1\n",
        {},
        "line 4: proportional_power -0.1 must be finite",
    ),
    "log10 not said": (
        "f.csv",
        "-0.4,-0.5\n0.3,-1.1\n",
        {},
        "give axis='log-log' (--axis log-log)",
    ),
    "log10 not said, of a power of 1": (
        "f.csv",
        "0.4,0\n0.8,-0.5\n",
        {},
        "give axis='log-log' (--axis log-log)",
    ),
    "no log10": (
        "f.csv",
        "0.4,0.5\n600,0.1\n",
        {"axis": "log-log"},
        "line 2: log10 of the frequency is 600",
    ),
    "header": (
        "f.csv",
        "frequency_hz,proportional_power\n0.4,1\n",
        {"axis": "log-log"},
        "states frequency in Hz and power",
    ),
    "no datasets": ("f.csv", "0.4,1\n0.8,1\n", {"dataset": "a"}, "has no named datasets"),
    "unknown axis": ("f.csv", wide(), {"axis": "loglog"}, "did you mean 'log-log'?"),
    "name twice": ("f.csv", wide("aa"), {"dataset": "a"}, "2 datasets are called 'a'; rename them"),
    "empty dataset": (
        "f.csv",
        "a,,b,\nX,Y,X,Y\n0.4,1,,\n0.8,1,,\n",
        {"dataset": "b"},
        "dataset 'b' holds no points",
    ),
    "zip": ("f.zip", "PK", {}, "a target is a .toml or .csv file, not .zip"),
    "project": ("f.tar", "...", {}, "not .tar. Export the points of a WebPlotDigitizer project"),
    "fit": ("fit.json", "{}", {}, "`jaxmuscle compare` takes the spectrum of a fit.json"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files(case, tmp_path):
    name, content, options, message = BAD_FILES[case]
    path = write(tmp_path, content, name)
    with pytest.raises(TargetError) as caught:
        load_target(path, **options)
    assert message in str(caught.value)
    assert case == "unknown axis" or str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("option", "word"), [({"dataset": "a"}, "dataset='a'"), ({"axis": "log-log"}, "axis='log-log'")]
)
def test_bundled_targets_are_no_figures(option, word):
    with pytest.raises(TargetError, match=f"^hamilton-2004: .*leave {word}"):
        load_target("hamilton-2004", **option)


# --- command and how-to


def test_command_passes_dataset_and_axis_on(tmp_path, monkeypatch):
    path, seen = write(tmp_path, wide()), []
    monkeypatch.setattr(jm, "fit", lambda _, target, **__: seen.append(target))
    monkeypatch.setattr(_cli_fit, "_fit_one", lambda fit, *_, **__: fit() is None)
    result = CliRunner().invoke(app, ["fit", str(path), "--dataset", "b", "--segments", "6"])
    assert result.exit_code == 0 and seen[0] == load_target(path, dataset="b", segments=6)
    table = write(tmp_path, pairs(*np.log10([GRID, spectrum(GRID)])), "decades.csv")
    result = CliRunner().invoke(app, ["fit", str(table), "--axis", "log-log"])
    assert result.exit_code == 0 and seen[1] == load_target(table, axis="log-log")
    assert CliRunner().invoke(app, ["fit", str(path)]).exit_code == 2


def test_worked_example_of_the_how_to(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert pages.run("docs/digitise.md")["result"].success
    plt.close("all")
    printed = capsys.readouterr().out
    shown = re.search(r"which prints\n\n((?:    .*\n)+)", DOCS.read_text(encoding="utf-8"))
    assert shown is not None and printed.split()[: len(shown[1].split())] == shown[1].split()
    assert load_target("figure.toml").provenance == "digitised"
