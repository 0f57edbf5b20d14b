"""The table of a study: what it may look like, and what it says of a mistake."""

import numpy as np
import pytest
from elsewhere import Pickled

import jaxmuscle as jm
from jaxmuscle.data._study_table import cells_of_study, read_study

RATE, SECONDS = 100, 12


@pytest.fixture
def folder(tmp_path):
    """Short recordings of two people, in newtons."""
    rng = np.random.default_rng(1)
    for name in ("a1", "a2", "b1", "b2"):
        np.save(tmp_path / f"{name}.npy", 10 + rng.standard_normal(RATE * SECONDS))
    return tmp_path


def written(folder, text, name="study.csv"):
    path = folder / name
    path.write_text(text)
    return path


TABLE = """file,person,group,trial,rate
a1.npy,anna,old,1,100
a2.npy,anna,old,2,100
b1.npy,bea,young,1,100
"""


def test_a_table_and_what_is_made_of_it(folder):
    table = read_study(written(folder, TABLE))
    assert [(row.person, row.group, row.trial) for row in table.rows] == [
        ("anna", "old", "1"),
        ("anna", "old", "2"),
        ("bea", "young", "1"),
    ]
    assert all(row.reading == {"rate": 100.0} for row in table.rows) and table.options == {}
    anna, bea = cells_of_study(table.rows, {"units": "N", "window": (0, 8)})
    assert (anna.trials, bea.trials) == (2, 1)
    assert [(r.file, r.trial, r.rate) for r in anna.recordings] == [
        ("a1.npy", "1", 100.0),
        ("a2.npy", "2", 100.0),
    ]
    # over the squared mean, of one trial as of several
    power = jm.load_recording(folder / "b1.npy", rate=100).steady((0, 8)).spectrum().power
    mean = np.mean(np.load(folder / "b1.npy")[:800])
    np.testing.assert_allclose(bea.power, power / mean**2, rtol=0.01)  # low-passed
    assert anna.target.name == "anna" and len(anna.target.segments) == 2 and anna.target.unit == "N"
    assert "0 s to 8 s" in anna.target.source or "0.00 s to 8.00 s" in anna.target.source, (
        anna.target.source
    )


def test_semicolons_comments_windows_and_tabs(folder):
    text = "# pilot\nFile;Person;window_start;window_stop\n\na1.npy;anna;0,5;9\nb1.npy;bea;;\n"
    rows = read_study(written(folder, text)).rows
    assert rows[0].reading == {"window": (0.5, 9.0)} and rows[1].reading == {}
    assert (
        read_study(written(folder, text.replace(";", "\t"), "study.tsv")).rows[0].reading
        == rows[0].reading
    )


def test_toml_with_a_table_and_with_recordings(folder):
    written(folder, TABLE)
    named = read_study(
        written(folder, 'table = "study.csv"\nalpha = 0.01\ncorrection = "fdr"\n', "study.toml")
    )
    assert len(named.rows) == 3 and named.options == {"alpha": 0.01, "correction": "fdr"}
    lines = "".join(
        f'[[recordings]]\nfile = "{p}1.npy"\nperson = "{p}"\ncolumn = 0\n' for p in "ab"
    )
    listed = read_study(written(folder, "rate = 100\n" + lines, "study.toml"))
    assert [row.person for row in listed.rows] == ["a", "b"] and listed.rows[0].reading == {
        "column": 0
    }
    rows = [{"file": folder / f"{p}1.npy", "person": p} for p in "ab"]
    assert [row.file for row in read_study(rows).rows] == [folder / "a1.npy", folder / "b1.npy"]


OPTIONS = {"column": "force", "reference": "rest", "time": "clock", "skip_rows": 2, "max_gap": 0.05}


@pytest.fixture
def exported(folder):
    """Texts with two lines above the header, a second column that could be the time, and a force to
    subtract."""
    rng = np.random.default_rng(2)
    for name in ("a1", "b1"):
        rows = (
            f"{i},{i / RATE},{10 + x},{x / 2}" for i, x in enumerate(rng.standard_normal(25 * RATE))
        )
        written(
            folder,
            "\n".join(("made by,us", "for,you", "count,clock,force,rest", *rows)),
            f"{name}.csv",
        )
    return folder


@pytest.mark.parametrize(
    "where", ["rows of a CSV", "keys of a TOML", "recordings of a TOML", "rows in memory"]
)
def test_every_way_to_read_a_file_can_be_stated(where, exported):
    said = OPTIONS | {"spectrum": "slow", "mvc": 50.0}
    names, cells = ",".join(said), ",".join(str(value) for value in said.values())
    keys = "".join(
        f'{name} = "{v}"\n' if isinstance(v, str) else f"{name} = {v}\n" for name, v in said.items()
    )
    people = [{"file": f"{p}1.csv", "person": p} for p in "ab"]
    lines = ["".join(f'{name} = "{value}"\n' for name, value in row.items()) for row in people]
    study = {
        "rows of a CSV": lambda: written(
            exported, f"file,person,{names}\na1.csv,a,{cells}\nb1.csv,b,{cells}\n"
        ),
        "keys of a TOML": lambda: written(
            exported, keys + "".join(f"[[recordings]]\n{x}" for x in lines), "study.toml"
        ),
        "recordings of a TOML": lambda: written(
            exported, "".join(f"[[recordings]]\n{x}{keys}" for x in lines), "study.toml"
        ),
        "rows in memory": lambda: [row | said | {"file": exported / row["file"]} for row in people],
    }[where]()
    table = read_study(study)
    found = cells_of_study(table.rows, {"window": "all"} | table.options)
    for cell in found:
        same = jm.data.Trials([jm.load_recording(exported / f"{cell.person}1.csv", **OPTIONS)])
        wanted = same.target(cell.person, mvc=50.0, settings="slow")
        assert (
            cell.target.settings == wanted.settings
            and cell.target.mvc_fraction == wanted.mvc_fraction
        )
        np.testing.assert_array_equal(cell.target.proportional_power, wanted.proportional_power)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "file,person,spectrum\na1.npy,a,slo\nb1.npy,b,slow\n",
            r"line 2: spectrum='slo': did you mean 'slow'\?",
        ),
        (
            "file,person,spectrum\na1.npy,a,pwelch\nb1.npy,b,\n",
            r"line 3: spectrum = 'standard' here, 'pwelch' at .*line 2: give all rows the same",
        ),
        (
            "file,person,mvc\na1.npy,a,50\na2.npy,a,\nb1.npy,b,60\n",
            r"line 3: mvc = None here, 50.0 at .*line 2: give all trials of a person",
        ),
        (
            "file,person,mvc\na1.npy,a,5\nb1.npy,b,60\n",
            r"line 2: a: mvc=5.0: give a force above the mean, (9\.9|10)",
        ),
        ("file,person,time\na1.npy,a,\nb1.npy,b,clock\n", r"line 3: .*time"),
        ("file,person,axis\na1.npy,a,\nb1.npy,b,q\n", r"line 3: axis='q': choose one of x, y, z"),
        (
            "file,person,skip_rows\na1.npy,a,\nb1.npy,b,2\n",
            r"line 3: skip_rows=2: leave it out: \.npy has no lines",
        ),
    ],
)
def test_a_mistake_in_how_a_file_is_read_names_row_and_column(text, message, folder):
    rows = read_study(written(folder, text)).rows
    with pytest.raises(ValueError, match=message):
        cells_of_study(rows, {"rate": RATE, "window": "all"})


@pytest.mark.parametrize(
    ("name", "value"),
    [("skip_rows", "2.5"), ("skip_rows", "two"), ("max_gap", "short"), ("mvc", "big")],
)
def test_cells_that_are_no_numbers(name, value, folder):
    with pytest.raises(
        ValueError, match=rf"study.csv: line 2: {name} = '{value}' is not a (whole )?number"
    ):
        read_study(written(folder, f"file,person,{name}\na1.npy,a,{value}\nb1.npy,b,\n"))


def test_an_mvc_that_is_no_number(folder):
    rows = [{"file": folder / f"{p}1.npy", "person": p, "mvc": "strong"} for p in "ab"]
    with pytest.raises(
        ValueError, match="row 1: mvc='strong': give a number in the unit of the recording"
    ):
        cells_of_study(read_study(rows).rows, {"rate": RATE})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# pilot\n", r"study.csv: holds no data, only comments"),
        ("file,group\na1.npy,old\n", r"study.csv: line 1: needs a column person; the header"),
        (
            "file,subject,group\na1.npy,anna,old\n",
            r"line 1: needs a column person \(found: subject\)",
        ),
        (
            "file,person,grup\na1.npy,anna,old\n",
            r"line 1: unknown column 'grup'; did you mean 'group'\?",
        ),
        ("file,person,file\na1.npy,anna,b\n", r"line 1: two columns are called file"),
        ("file,person\na1.npy\n", r"line 2: has 1 cells, the header 2"),
        ("file,person\na1.npy,\n", r"line 2: no person"),
        ("file,person,rate\na1.npy,anna,fast\n", r"line 2: rate = 'fast' is not a number"),
        (
            "file,person,window_start\na1.npy,anna,3\n",
            r"line 2: give window_start and window_stop, or neither",
        ),
        ("file,person\na1.npy,anna\nc1.npy,bea\n", r"line 3: .*c1.npy: no such file"),
        (
            "file,person,group\na1.npy,anna,old\na2.npy,anna,young\n",
            r"line 3: anna is in group young here and in group old at .*line 2",
        ),
        ("file,person,group\na1.npy,anna,old\nb1.npy,bea,\n", r"line 3: has no group, others do"),
        ("file,person\na1.npy,anna\na1.npy,bea\n", r"line 3: the same recording as at .*line 2"),
        (
            "file,person,trial\na1.npy,anna,1\na2.npy,anna,1\n",
            r"line 3: trial 1 of anna is there already, at .*line 2",
        ),
        (
            "file,person\na1.npy,anna\na2.npy,anna\n",
            r"study.csv: holds 1 people; a study needs at least 2",
        ),
    ],
)
def test_mistakes_in_a_table(text, message, folder):
    with pytest.raises(ValueError, match=message):
        read_study(written(folder, text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('table = "no.csv"', r"no.csv: no such file"),
        ('table = "study.csv"\nrungs = 2', r"unknown key 'rungs'; did you mean 'rung'\?"),
        ("alpha = 0.05", r"give either table"),
        ("alpha = ", r"study.toml: is not valid TOML"),
        (
            '[[recordings]]\nfile = "a1.npy"\nperson = "a"\nunit = "N"',
            r"recordings\[0\] has the unknown key 'unit'",
        ),
    ],
)
def test_mistakes_in_a_toml(text, message, folder):
    with pytest.raises(ValueError, match=message):
        read_study(written(folder, text, "study.toml"))


def test_a_file_that_cannot_be_read_is_named_by_its_line(folder):
    rows = read_study(written(folder, "file,person\na1.npy,anna\nb1.npy,bea\n")).rows
    with pytest.raises(ValueError, match=r"study.csv: line 2: .*rate"):
        cells_of_study(rows, {})


def test_files_are_read_elsewhere_from_any_folder_with_the_same_numbers_and_errors(
    folder, monkeypatch
):
    monkeypatch.chdir(folder)
    told, executor = [], Pickled()
    rows = read_study(written(folder, TABLE).name).rows
    here = cells_of_study(rows, {"units": "N"})
    there = cells_of_study(rows, {"units": "N"}, executor, lambda *each: told.append(each))
    assert repr([cell.target.to_table() for cell in here]) == repr(
        [cell.target.to_table() for cell in there]
    )
    assert repr([cell[:4] for cell in here]) == repr([cell[:4] for cell in there])
    assert told == [("reading recordings", 0.5), ("reading recordings", 1.0)]
    assert executor.count == 2  # one for each person
    (folder / "b1.npy").write_bytes(b"no array")
    for row, units in ((3, "V"), (4, None)):
        given = [dict(r.reading, file=r.file, person=r.person) for r in rows]
        given = [
            g | ({"units": units} if i == row - 2 and units else {}) for i, g in enumerate(given)
        ]
        messages = []
        for who in (None, executor):
            with pytest.raises(ValueError) as error:
                cells_of_study(read_study(given).rows, {"units": "N"}, who)
            messages.append(str(error.value).replace(str(folder) + "/", ""))
        assert messages[0] == messages[1] and f"row {row - 1}: " in messages[0], messages
