"""Names out of data as names of files: they stay in their folder, on any system, and no two are
one."""

import ntpath
from pathlib import PurePosixPath, PureWindowsPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmuscle._common.names import LONGEST, file_name, file_names, name_of_all

NAMES = {
    "anna": "anna",
    "Anna, slow": "Anna, slow",
    "Größe µ": "Größe µ",
    "26 % MVC (left)": "26 % MVC (left)",
    "../../x": "___.._x",
    "/etc/passwd": "_etc_passwd",
    "C:\\x": "C__x",
    "..": "_",
    ".": "_",
    "": "_",
    " ": "_",
    ".hidden": "_hidden",
    "-rf": "_rf",
    "--out": "__out",
    "~root": "_root",
    "a\0b": "a_b",
    "a\nb\x1b[2J": "a_b_[2J",
    "half\udc80": "half_",
    "right\u202eleft": "right_left",
    "end. .": "end",
    "con": "_con",
    "NUL.txt": "_NUL.txt",
    "lpt1": "_lpt1",
    "con .txt": "_con .txt",
    "console": "console",
    'a*b?"<c>|': "a_b___c__",
    "x" * 300: "x" * LONGEST,
    "e\u0301": "\u00e9",
}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_becomes_the_name_of_a_file(name):
    assert file_name(name) == NAMES[name]


def is_reserved(name):
    """By Windows; the method of paths is deprecated from Python 3.13 on."""
    found = getattr(ntpath, "isreserved", None)
    return PureWindowsPath(name).is_reserved() if found is None else found(name)


@pytest.mark.slow
@given(st.text(st.characters(exclude_categories=()), max_size=300))
def test_any_name_stays_in_its_folder(name):
    made = file_name(name)
    assert PurePosixPath(made).parts == PureWindowsPath(made).parts == (made,)
    assert made[0] not in ".-~ " and made[-1] not in ". " and made.isprintable()
    assert len(made.encode()) <= LONGEST and not is_reserved(made)
    assert file_name(made) == made


def test_clashes_are_numbered_in_their_order_and_good_names_come_first():
    found = file_names(
        ["x/y", "Anna", "anna", "x_y", "ANNA", "anna-2", "Cohort.csv"], taken=["cohort.csv"]
    )
    assert found == {
        "x/y": "x_y-2",
        "Anna": "Anna",
        "anna": "anna-2",
        "x_y": "x_y",
        "ANNA": "ANNA-3",
        "anna-2": "anna-2-2",
        "Cohort.csv": "Cohort.csv-2",
    }


@given(st.lists(st.text("aA/._-ß", max_size=4), max_size=20, unique=True))
def test_no_two_are_one(names):
    found = file_names(names)
    assert list(found) == names and len({place.casefold() for place in found.values()}) == len(
        names
    )


@pytest.mark.parametrize(
    ("names", "together"),
    [
        (["S07_hold20_1", "S07_hold20_2"], "S07_hold20"),
        (["S07_hold20", "S07_hold25"], "S07_hold"),
        (["trial1", "trial2"], "trial"),
        (["trial", "trial"], "trial"),
        (["anna 9", "anna 10"], "anna"),
        (["a", "b"], "2 trials"),
        (["alone_7"], "alone_7"),
    ],
)
def test_the_name_of_trials_keeps_the_condition_and_leaves_the_number_out(names, together):
    assert name_of_all(names) == together
