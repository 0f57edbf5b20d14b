"""The table of a study: what it may look like, and what it says of a mistake."""

import numpy as np
import pytest

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


TABLE = "file,person,group,trial,rate\na1.npy,anna,old,1,100\na2.npy,anna,old,2,100\nb1.npy,bea,young,1,100\n"


def test_a_table_and_what_is_made_of_it(folder):
    table = read_study(written(folder, TABLE))
    assert [(row.person, row.group, row.trial) for row in table.rows] == [
        ("anna", "old", "1"), ("anna", "old", "2"), ("bea", "young", "1"),
    ]  # fmt: skip
    assert all(row.reading == {"rate": 100.0} for row in table.rows) and table.options == {}
    anna, bea = cells_of_study(table.rows, {"units": "N", "window": (0, 8)})
    assert (anna.trials, bea.trials, anna.rates) == (2, 1, (100.0, 100.0))
    assert anna.target.name == "anna" and len(anna.target.segments) == 2 and anna.target.unit == "N"
    assert "0 s to 8 s" in anna.target.source or "0.00 s to 8.00 s" in anna.target.source, anna.target.source


def test_semicolons_comments_windows_and_tabs(folder):
    text = "# pilot\nFile;Person;window_start;window_stop\n\na1.npy;anna;0,5;9\nb1.npy;bea;;\n"
    rows = read_study(written(folder, text)).rows
    assert rows[0].reading == {"window": (0.5, 9.0)} and rows[1].reading == {}
    assert read_study(written(folder, text.replace(";", "\t"), "study.tsv")).rows[0].reading == rows[0].reading


def test_toml_with_a_table_and_with_recordings(folder):
    written(folder, TABLE)
    named = read_study(written(folder, 'table = "study.csv"\nalpha = 0.01\ncorrection = "fdr"\n', "study.toml"))
    assert len(named.rows) == 3 and named.options == {"alpha": 0.01, "correction": "fdr"}
    lines = "".join(f'[[recordings]]\nfile = "{p}1.npy"\nperson = "{p}"\ncolumn = 0\n' for p in "ab")
    listed = read_study(written(folder, "rate = 100\n" + lines, "study.toml"))
    assert [row.person for row in listed.rows] == ["a", "b"] and listed.rows[0].reading == {"column": 0}
    rows = [{"file": folder / f"{p}1.npy", "person": p} for p in "ab"]
    assert [row.file for row in read_study(rows).rows] == [folder / "a1.npy", folder / "b1.npy"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,group\na1.npy,old\n", r"study.csv: line 1: no column person"),
        ("file,persn\na1.npy,anna\n", r"line 1: unknown column 'persn'; did you mean 'person'\?"),
        ("file,person,file\na1.npy,anna,b\n", r"line 1: two columns are called file"),
        ("file,person\na1.npy\n", r"line 2: has 1 cells, the header 2"),
        ("file,person\na1.npy,\n", r"line 2: no person"),
        ("file,person,rate\na1.npy,anna,fast\n", r"line 2: rate = 'fast' is not a number"),
        ("file,person,window_start\na1.npy,anna,3\n", r"line 2: give window_start and window_stop, or neither"),
        ("file,person\na1.npy,anna\nc1.npy,bea\n", r"line 3: .*c1.npy: no such file"),
        ("file,person,group\na1.npy,anna,old\na2.npy,anna,young\n",
         r"line 3: anna is in group young here and in group old at .*line 2"),
        ("file,person,group\na1.npy,anna,old\nb1.npy,bea,\n", r"line 3: has no group, others do"),
        ("file,person\na1.npy,anna\na1.npy,bea\n", r"line 3: the same recording as at .*line 2"),
        ("file,person,trial\na1.npy,anna,1\na2.npy,anna,1\n", r"line 3: trial 1 of anna is there already, at .*line 2"),
        ("file,person\na1.npy,anna\na2.npy,anna\n", r"study.csv: holds 1 people; a study needs at least 2"),
    ],
)  # fmt: skip
def test_mistakes_in_a_table(text, message, folder):
    with pytest.raises(ValueError, match=message):
        read_study(written(folder, text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('table = "no.csv"', r"no.csv: no such file"),
        ('table = "study.csv"\nrungs = 2', r"unknown option 'rungs'; did you mean 'rung'\?"),
        ("alpha = 0.05", r"give either table"),
        ("alpha = ", r"study.toml: is not TOML"),
        ('[[recordings]]\nfile = "a1.npy"\nperson = "a"\nunit = "N"', r"recording 1: unknown column 'unit'"),
    ],
)
def test_mistakes_in_a_toml(text, message, folder):
    with pytest.raises(ValueError, match=message):
        read_study(written(folder, text, "study.toml"))


def test_a_file_that_cannot_be_read_is_named_by_its_line(folder):
    rows = read_study(written(folder, "file,person\na1.npy,anna\nb1.npy,bea\n")).rows
    with pytest.raises(ValueError, match=r"study.csv: line 2: .*rate"):
        cells_of_study(rows, {})
