"""Digitised figures: rendered curves recovered from pixels, the forms of WebPlotDigitizer's files,
files that are wrong."""

import io
import json
import re
import tarfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pages
import pytest
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle._common.errors import TargetError
from jaxmuscle.commands import fit as _cli_fit
from jaxmuscle.commands.main import app
from jaxmuscle.data._digitised import read_project
from jaxmuscle.data._target import load_target

GRID = 0.390625 * np.arange(1, 31)
DOCS = Path(__file__).parents[2] / "docs" / "digitise.md"
# Half a pixel for the click and half for each of the two calibration points of an axis.
PIXELS = 1.5


def spectrum(f):
    """A slow part and a peak at 4.3 Hz."""
    return 1 / (1 + (f / 1.2) ** 2) + 0.08 * np.exp(-(((f - 4.3) / 0.6) ** 2)) + 0.004


class Drawn:
    """A figure of known curves: `pixels` of data in its image, and `axes` as WebPlotDigitizer would
    calibrate them."""

    def __init__(self, scale, x_ticks, y_ticks):
        self.figure, self.ax = plt.subplots(figsize=(8, 6), dpi=100)
        self.ax.set(
            xscale=scale, yscale=scale, xlim=x_ticks, ylim=y_ticks, xlabel="Hz", ylabel="power"
        )
        self.x_ticks, self.y_ticks, self.log = x_ticks, y_ticks, scale == "log"

    def pixels(self, x, y, *, whole=True):
        """Positions from the upper left corner, as in an image; `whole` for those that somebody
        clicks."""
        self.figure.canvas.draw()
        found = self.ax.transData.transform(np.column_stack(np.broadcast_arrays(x, y)))
        found[:, 1] = self.figure.bbox.height - found[:, 1]
        return np.round(found) if whole else found

    def axes(self, name="XY", *, values=lambda tick: tick, **changes):
        """Calibrated on the outer ticks, their values typed as texts."""
        (x1, x2), (y1, y2) = self.x_ticks, self.y_ticks
        corners = [(x1, y1), (x2, y1), (x1, y1), (x1, y2)]
        points = [
            {"px": px, "py": py, "dx": f"{values(x):.12g}", "dy": f"{values(y):.12g}", "dz": None}
            for (x, y), (px, py) in zip(corners, self.pixels(*np.array(corners).T), strict=True)
        ]
        axes = {
            "name": name,
            "type": "XYAxes",
            "isLogX": self.log,
            "isLogY": self.log,
            "calibrationPoints": points,
        }
        return axes | changes

    def error(self, f, p):
        """What PIXELS are worth in p, along its axis and, by the slope of the curve, across it."""
        box = self.ax.bbox
        per_pixel = [
            (np.log(b / a) if self.log else b - a) for a, b in (self.x_ticks, self.y_ticks)
        ]
        x, y = PIXELS * per_pixel[0] / box.width, PIXELS * per_pixel[1] / box.height
        if self.log:
            slope = np.abs(np.log(spectrum(f * np.exp(x)) / spectrum(f * np.exp(-x)))) / 2
            return p * np.expm1(y + slope)
        return y + np.abs(spectrum(f + x) - spectrum(f - x)) / 2


def dataset(pixels, name="curve", axes="XY"):
    return {
        "name": name,
        "axesName": axes,
        "data": [{"x": float(x), "y": float(y)} for x, y in pixels],
    }


def project(*datasets, axes, version=(4, 2)):
    return {
        "version": list(version),
        "axesColl": [axes],
        "datasetColl": list(datasets),
        "measurementColl": [],
    }


def write(folder, content, name="figure.json"):
    path = folder / name
    content = json.dumps(content) if isinstance(content, dict) else content
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def tarred(files, root="wpd_project/"):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, content in files.items():
            entry = tarfile.TarInfo(root + name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


@pytest.fixture
def linear():
    yield Drawn("linear", (0, 12), (0, 1.2))
    plt.close("all")


@pytest.fixture
def loglog():
    yield Drawn("log", (0.1, 100), (1e-3, 10))
    plt.close("all")


def assert_recovered(target, error):
    """Up to the error in p and in the sum it is divided by."""
    expected, total = spectrum(GRID), spectrum(GRID).sum()
    np.testing.assert_array_equal(target.bins, np.arange(1, 31))
    bound = (error + expected * error.sum() / total) / total
    assert np.all(np.abs(target.proportional_power - expected / total) <= bound)


# --- figures of known curves


@pytest.mark.parametrize("name", ["linear", "loglog"])
def test_clicked_figure_gives_its_spectrum(name, request, tmp_path):
    drawn = request.getfixturevalue(name)
    clicks = drawn.pixels(GRID, spectrum(GRID))
    path = write(
        tmp_path, project(dataset(np.random.default_rng(0).permutation(clicks)), axes=drawn.axes())
    )
    target = load_target(path, segments=6)
    assert_recovered(target, drawn.error(GRID, spectrum(GRID)))
    assert (target.name, target.provenance, target.segments) == ("figure", "digitised", (6,))
    assert target.source == "WebPlotDigitizer project figure.json, dataset 'curve'"
    assert target.notices[0].startswith(
        "dataset 'curve': read as points of a figure, frequency in Hz"
    )
    target.save(tmp_path / "copy.toml")
    assert load_target(tmp_path / "copy.toml") == target


def test_extracted_image_gives_its_spectrum(linear, tmp_path):
    f = np.linspace(0.3, 12, 2000)
    linear.ax.plot(f, spectrum(f), color="red", linewidth=2)
    linear.figure.canvas.draw()
    image = np.asarray(linear.figure.canvas.buffer_rgba()).astype(int)
    red = (image[..., 0] > 200) & (image[..., 1] < 100) & (image[..., 2] < 100)
    columns = np.flatnonzero(red.any(axis=0))[3:]
    # The centre of a pixel is half a pixel from its corner.
    pixels = [(column + 0.5, np.flatnonzero(red[:, column]).mean() + 0.5) for column in columns]
    target = load_target(write(tmp_path, project(dataset(pixels), axes=linear.axes())))
    # The line is 3 pixels wide where it is level, as wide as it is high where it is steep: one
    # pixel more.
    assert_recovered(target, linear.error(GRID, spectrum(GRID)) * (1 + 1 / PIXELS))
    assert "so the log power was interpolated (widest gap" in target.notices[1]


def test_decades_as_values_are_log_log(loglog, tmp_path):
    """Log axes calibrated as logarithmic, and as linear in decades with axis="log-log", are the
    same points."""
    clicks = dataset(loglog.pixels(GRID, spectrum(GRID)))
    decades = loglog.axes(values=np.log10, isLogX=False, isLogY=False)
    one = load_target(write(tmp_path, project(clicks, axes=loglog.axes())))
    other = load_target(
        write(tmp_path, project(clicks, axes=decades), "decades.json"), axis="log-log"
    )
    np.testing.assert_allclose(one.proportional_power, other.proportional_power, rtol=1e-9)
    assert "log10 of frequency in Hz and of power" in other.notices[0]
    rows = "".join(
        f"{np.log10(f)}, {np.log10(p)}\n" for f, p in zip(GRID, spectrum(GRID), strict=True)
    )
    table = load_target(write(tmp_path, rows, "decades.csv"), axis="log-log")
    np.testing.assert_allclose(
        table.proportional_power, spectrum(GRID) / spectrum(GRID).sum(), rtol=1e-12
    )
    assert table.provenance == "digitised"


@pytest.mark.parametrize("kind", ["project", "table"])
def test_power_law_is_straight_between_points_of_a_log_log_figure(kind, loglog, tmp_path):
    f = np.array([0.3, 2.0, 13.0])
    if kind == "project":
        pixels = loglog.pixels(f, 0.2 / f**1.7, whole=False)
        axes = loglog.axes()
        corners = loglog.pixels([0.1, 100, 0.1, 0.1], [1e-3, 1e-3, 1e-3, 10], whole=False)
        for point, (px, py) in zip(axes["calibrationPoints"], corners, strict=True):
            point |= {"px": px, "py": py}
        target = load_target(write(tmp_path, project(dataset(pixels), axes=axes)))
    else:
        rows = "".join(f"{np.log10(x)};{np.log10(0.2 / x**1.7)}\n" for x in f)
        target = load_target(write(tmp_path, rows, "points.csv"), axis="log-log")
    # three points are not thirty: the bins nearest to them
    np.testing.assert_array_equal(target.bins, [1, 5])
    law = target.frequency**-1.7
    np.testing.assert_allclose(target.proportional_power, law / law.sum(), rtol=1e-6)
    assert any(
        "the log power was interpolated over log frequency (widest gap 11 Hz)" in notice
        for notice in target.notices
    )


def test_ends_within_a_pixel_are_not_lost(tmp_path):
    rows = "".join(f"{f + 0.03},{p}\n" for f, p in zip(GRID, spectrum(GRID), strict=True))
    target = load_target(write(tmp_path, rows, "points.csv"))
    np.testing.assert_array_equal(target.bins, np.arange(1, 31))
    assert (
        target.notices[1]
        == "some frequencies lie up to 0.077 bins beside a bin, and count as that bin: a figure"
        " cannot be read more finely"
    )
    stated = "frequency_hz,proportional_power\n" + rows
    np.testing.assert_array_equal(
        load_target(write(tmp_path, stated, "stated.csv")).bins, np.arange(1, 31)
    )


# --- calibration: any affine map of the image, as of a scan that lies askew


def turned(axes, points, matrix, shift):
    def moved(x, y):
        return (matrix @ np.array([x, y]) + shift).tolist()

    calibration = []
    for point in axes["calibrationPoints"]:
        px, py = moved(point["px"], point["py"])
        calibration.append(point | {"px": px, "py": py})
    return axes | {"calibrationPoints": calibration}, [moved(*point) for point in points]


@pytest.mark.parametrize("angle", [2.0, 90.0, -45.0])
def test_a_turned_and_stretched_scan_changes_nothing(angle, loglog):
    pixels = loglog.pixels(GRID, spectrum(GRID), whole=False)
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    matrix = np.array([[cos, -sin], [sin, cos]]) @ np.array([[1.3, 0.1], [0.0, 0.8]])
    axes, moved = turned(loglog.axes(), pixels, matrix, np.array([70.0, -20.0]))
    one = read_project(json.dumps(project(dataset(pixels), axes=loglog.axes())), "f", None)
    other = read_project(json.dumps(project(dataset(moved), axes=axes)), "f", None)
    np.testing.assert_allclose(one.x, other.x, atol=1e-10)
    np.testing.assert_allclose(one.y, other.y, atol=1e-10)


@pytest.mark.parametrize("quarter", [0, 1])
def test_no_rotation_takes_off_what_is_askew(quarter, linear):
    """X2 clicked 5 pixels off the axis: points on a level line share y if WebPlotDigitizer was told
    not to rotate."""
    points, axes = [(200.0, 300.0), (500.0, 300.0)], linear.axes()
    axes["calibrationPoints"][1]["py"] += 5.0
    if quarter:
        axes, points = turned(
            axes, points, np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([600.0, 0.0])
        )
    askew = 5.0 * 300.0 / linear.ax.bbox.width * 1.2 / linear.ax.bbox.height
    for flag, expected in ((True, 0.0), (False, askew)):
        text = json.dumps(project(dataset(points), axes=axes | {"noRotation": flag}))
        # 1 %: the calibration points are whole pixels, here of 600 and 460.
        assert np.diff(read_project(text, "f", None).y)[0] == pytest.approx(
            expected, rel=0.01, abs=1e-12
        )


# --- the forms of the files


@pytest.fixture
def made(linear):
    """A project of two curves and an empty dataset, with stale values."""
    first, second = (
        dataset(linear.pixels(GRID, a * spectrum(GRID)), name)
        for a, name in ((1, "35 MVC"), (0.5, "95 MVC"))
    )
    second["data"] = second["data"][:20]
    for entry in first["data"]:
        entry["value"] = [1.0, 1.0]
    return project(first, dataset([], "Default Dataset"), second, axes=linear.axes())


def test_dataset_is_chosen_by_name(made, tmp_path):
    path = write(tmp_path, made)
    assert load_target(path, dataset="35 MVC").bins.size == 30
    assert load_target(path, dataset="95 MVC").bins.size == 20
    with pytest.raises(
        TargetError, match=re.escape("choose one with dataset= (--dataset): '35 MVC', '95 MVC'")
    ):
        load_target(path)
    made["datasetColl"].pop(0)
    assert load_target(write(tmp_path, made)).bins.size == 20


def test_tar_and_version_3_hold_the_same(made, tmp_path):
    expected = load_target(write(tmp_path, made), dataset="35 MVC").proportional_power
    files = {"info.json": b"{}", "wpd.json": json.dumps(made).encode(), "image.png": b"\x89PNG\0"}
    tar = load_target(write(tmp_path, tarred(files), "figure.tar"), dataset="35 MVC")
    axes = made["axesColl"][0]
    old = {
        "version": [3, 8],
        "axesType": "XYAxes",
        "axesParameters": {"isLogX": False, "isLogY": False},
        "calibration": axes["calibrationPoints"],
        "dataSeries": [{key: d[key] for key in ("name", "data")} for d in made["datasetColl"]],
    }
    three = load_target(write(tmp_path, {"wpd": old}, "old.json"), dataset="35 MVC")
    for target in (tar, three):
        np.testing.assert_array_equal(target.proportional_power, expected)
    assert tar.name == "figure"


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
    path = write(
        tmp_path, "# from a figure\n" + wide(delimiter=delimiter, decimal=decimal), "all.csv"
    )
    target = load_target(path, dataset="a")
    np.testing.assert_allclose(
        target.proportional_power, spectrum(GRID) / spectrum(GRID).sum(), rtol=1e-12
    )
    assert (target.provenance, target.source) == (
        "digitised",
        "WebPlotDigitizer export all.csv, dataset 'a'",
    )
    np.testing.assert_array_equal(load_target(path, dataset="b").bins, np.arange(1, 11))
    assert load_target(write(tmp_path, wide(["only"]), "one.csv")).bins.size == 30


# --- files that are wrong


def broken(change):
    """A sound project of one dataset, then changed."""

    def make(linear):
        content = project(dataset(linear.pixels(GRID, spectrum(GRID))), axes=linear.axes())
        change(content)
        return content

    return make


def point(number, **changes):
    return broken(lambda p: p["axesColl"][0]["calibrationPoints"][number].update(changes))


def axes(**changes):
    return broken(lambda p: p["axesColl"][0].update(changes))


BAD_PROJECTS = {
    "empty": (lambda _: "", {}, "is empty"),
    "no JSON": (lambda _: "{'version'", {}, "is not valid JSON: Expecting property name"),
    "nested": (lambda _: "[" * 100000, {}, "is nested too deeply"),
    "binary": (lambda _: b"\x89PNG\r\n\0", {}, "is not UTF-8 text"),
    "other JSON": (
        lambda _: '{"success": true}',
        {},
        "is not a WebPlotDigitizer project (it has no axesColl)",
    ),
    "a list": (lambda _: "[]", {}, "holds no table, but a list"),
    "newer": (
        broken(lambda p: p.update(version=[9, 0])),
        {},
        "version [9, 0] is not known (3 and 4 are); export",
    ),
    "older": (lambda _: {"wpd": {"version": [2, 0]}}, {}, "project version [2, 0] is not known"),
    "version 3 without axes": (
        lambda _: {"wpd": {"version": [3, 8]}},
        {},
        "'axesParameters' is missing",
    ),
    "no datasets": (
        broken(lambda p: p.pop("datasetColl")),
        {},
        "'datasetColl' is missing or no list",
    ),
    "dataset no table": (
        broken(lambda p: p.update(datasetColl=[3])),
        {},
        "is damaged: 3 should be a table",
    ),
    "dataset without data": (
        broken(lambda p: p["datasetColl"][0].pop("data")),
        {},
        "dataset 'curve': is damaged: 'data'",
    ),
    "no points": (
        broken(lambda p: p["datasetColl"][0].update(data=[])),
        {},
        "holds no points; add points",
    ),
    "point without pixel": (
        broken(lambda p: p["datasetColl"][0]["data"][4].pop("x")),
        {},
        "dataset 'curve', point 5: x None is not a number",
    ),
    "infinite pixel": (
        broken(lambda p: p["datasetColl"][0]["data"][0].update(y=1e999)),
        {},
        "is not valid JSON: Infinity is no number in JSON",
    ),
    "unknown axes": (axes(name="other"), {}, "belongs to axes 'XY', of which the project has 0"),
    "bar axes": (
        axes(type="BarAxes"),
        {},
        "axes 'XY': of type 'BarAxes'; calibrate the figure as '2D (X-Y) Plot'",
    ),
    "three points": (
        broken(lambda p: p["axesColl"][0]["calibrationPoints"].pop()),
        {},
        "3 calibration points, 4 are needed (X1, X2, Y1, Y2)",
    ),
    "date": (point(1, dx="2013/10"), {}, "axes 'XY', X2: dx '2013/10' is not a number"),
    "power of ten": (
        point(3, dy="10^-3"),
        {},
        "Y2: dy '10^-3' is not a number; write 0.001 or 1e-3",
    ),
    "decimal comma": (
        point(3, dy="0,5"),
        {},
        "Y2: dy '0,5' is not a number; write 0.001 or 1e-3, with a decimal point",
    ),
    "same value": (point(1, dx="0"), {}, "two calibration points of an axis have the same value"),
    "zero on a log axis": (
        axes(isLogX=True),
        {},
        "X1: value 0 on a logarithmic axis; it must be larger than 0",
    ),
    "one line": (
        broken(lambda p: [c.update(py=100.0) for c in p["axesColl"][0]["calibrationPoints"]]),
        {},
        "coincide or lie on one line",
    ),
    "below zero": (
        broken(lambda p: p["datasetColl"][0]["data"][2].update(y=1000.0)),
        {},
        "dataset 'curve', point 3: proportional_power -",
    ),
    "unknown dataset": (
        broken(lambda p: None),
        {"dataset": "curv"},
        "no dataset 'curv'; did you mean 'curve'? Known: curve",
    ),
    "empty dataset": (
        broken(lambda p: p["datasetColl"].append(dataset([], "b"))),
        {"dataset": "b"},
        "dataset 'b' holds no points",
    ),
    "name twice": (
        broken(lambda p: p["datasetColl"].append(p["datasetColl"][0])),
        {"dataset": "curve"},
        "2 datasets are called 'curve'; rename them",
    ),
    "log already": (axes(isLogY=True), {"axis": "log-log"}, "Y1: value 0 on a logarithmic axis"),
    "unknown axis": (
        broken(lambda p: None),
        {"axis": "loglog"},
        "unknown axis 'loglog'; did you mean 'log-log'?",
    ),
}


@pytest.mark.parametrize("case", BAD_PROJECTS)
def test_bad_projects(case, linear, tmp_path):
    make, options, message = BAD_PROJECTS[case]
    path = write(tmp_path, make(linear))
    with pytest.raises(TargetError) as caught:
        load_target(path, **options)
    assert message in str(caught.value)
    assert case == "unknown axis" or str(caught.value).startswith(str(path))


def test_log_log_twice_is_refused(loglog, tmp_path):
    path = write(
        tmp_path, project(dataset(loglog.pixels(GRID, spectrum(GRID))), axes=loglog.axes())
    )
    with pytest.raises(
        TargetError, match="calibrated with a logarithmic axis already; leave axis='log-log' out"
    ):
        load_target(path, axis="log-log")


BAD_FILES = {
    "not a tar": ("f.tar", b"plain text", {}, "is not a tar archive"),
    "tar cut short": (
        "f.tar",
        tarred({"wpd.json": b"{}" * 5000})[:1500],
        {},
        "is not a tar archive",
    ),
    "empty tar": ("f.tar", b"", {}, "is empty"),
    "tar of something": ("f.tar", tarred({"a.txt": b"a"}), {}, "holds no wpd.json"),
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
    "zip": ("f.zip", b"PK", {}, "not .zip; a WebPlotDigitizer project ends in .json or .tar"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files(case, tmp_path):
    name, content, options, message = BAD_FILES[case]
    path = write(tmp_path, content, name)
    with pytest.raises(TargetError) as caught:
        load_target(path, **options)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("option", "word"), [({"dataset": "a"}, "dataset='a'"), ({"axis": "log-log"}, "axis='log-log'")]
)
def test_bundled_targets_are_no_figures(option, word):
    with pytest.raises(TargetError, match=f"^hamilton-2004: .*leave {word}"):
        load_target("hamilton-2004", **option)


# --- command and how-to


def test_command_passes_dataset_and_axis_on(made, tmp_path, monkeypatch):
    path, seen = write(tmp_path, made), []
    monkeypatch.setattr(jm, "fit", lambda _, target, **__: seen.append(target))
    monkeypatch.setattr(_cli_fit, "_fit_one", lambda fit, *_, **__: fit(None, None) is None)
    result = CliRunner().invoke(app, ["fit", str(path), "--dataset", "95 MVC", "--segments", "6"])
    assert result.exit_code == 0 and seen[0] == load_target(path, dataset="95 MVC", segments=6)
    rows = "".join(
        f"{np.log10(f)},{np.log10(p)}\n" for f, p in zip(GRID, spectrum(GRID), strict=True)
    )
    table = write(tmp_path, rows, "decades.csv")
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
