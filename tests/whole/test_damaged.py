"""Files that were damaged or changed by hand: read as they say, or refused with one sentence that
names the file."""

import collections

import damage
import pytest
from test_result import made_result

COUNT = 250  # of every format; `python tests/damage.py --count 5000` tries more
# tables whose keys are free
FREE = {"components", "check", "further", "explained", "derived", "measured", "bounds", "versions"}
NAMES = (
    "fit.json",
    "preset.toml",
    "target.toml",
    "target.csv",
    "study.csv",
    "study.toml",
    "recording.csv",
)


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    folder = tmp_path_factory.mktemp("valid")
    return {of.name: of for of in damage.formats(folder, made_result())}, folder


def test_valid_files_are_read_as_they_say(valid):
    formats, folder = valid
    assert tuple(formats) == NAMES
    for of in formats.values():
        path = folder / f"mutant.{of.name.rpartition('.')[2]}"
        assert damage.fault(of, of.text.encode(), path) == "", of.name


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES[1:])  # a result is written by us alone
def test_mutants_are_read_as_they_say_or_refused(name, valid):
    formats, folder = valid
    counts, wrong = damage.tried(formats[name], COUNT, folder)
    told = collections.Counter(found for found, _ in wrong)
    assert not wrong, (
        f"{len(wrong)} of {COUNT}: {told.most_common(5)}; the first: {wrong[0][1][:300]!r}"
    )
    assert min(counts["read"], counts["refused"]) > COUNT / 50  # neither refuses all nor takes all


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fit.json", "preset.toml"])
def test_a_key_that_is_not_there_gets_no_default(name, valid):
    """Without any key that a file of its kind has, it is refused: but for what is no number of a
    preset's task."""
    formats, folder = valid
    of, kind = formats[name], name.rpartition(".")[2]
    table = damage.parsed_as(of.text, kind)
    path = folder / f"mutant.{kind}"
    for place in (place for place in damage.keys_of(table) if not FREE & set(place[:-1])):
        text = damage.without(table, place, kind)
        if place in (("format",), ("description",)) and kind == "toml":
            assert damage.fault(of, text, path) == "", place
        else:
            assert damage.fault(of, text, path) is None, place
