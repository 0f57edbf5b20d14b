"""What a file holds, by its ending and its first lines: one table of names and texts."""

import gzip

import numpy as np
import pytest
from recorded import write

import jaxmuscle as jm
from jaxmuscle.data import as_target, kind_of_file

RECORDING, SPECTRUM = "recording", "spectrum"
RESPONSE, STUDY = "frequency response", "study"
TEXTS = ("txt", "tsv", "dat", "asc")
POWERS = "frequency_hz,proportional_power\n" + "\n".join(
    f"{0.390625 * k},{1 / k}" for k in range(1, 31)
)
TABS, BLANKS = (POWERS.replace(",", sign) for sign in "\t ")
HELD = "time,force\n" + "\n".join(f"{k / 100},{k % 7}" for k in range(500))
STIFF = "0.5,1.5,4,0.93\n1,1.5,7,0.95\n"
TRIALS = '[[recordings]]\nfile = "a.csv"\nperson = "anna"\n'
KINDS = {  # text; endings; kind
    "spectrum": (POWERS, ["csv"], SPECTRUM),
    "spectrum, tabs": (TABS, TEXTS, SPECTRUM),
    "spectrum, blanks": (BLANKS, TEXTS, SPECTRUM),
    "spectrum behind a mark": ("\ufeff" + POWERS, ["csv"], SPECTRUM),
    "short spectrum": ("frequency_hz,power\n0.5,1\n1,2\n", ["csv"], SPECTRUM),
    "misspelt": ("freq,power\n" + "1,2\n" * 100, ["csv"], SPECTRUM),
    "misspelt text": ("freq;power\n" + "1;2\n" * 100, TEXTS, SPECTRUM),
    "points of a figure": (
        "\n".join(f"{0.1 * k},{1 / (1 + k)}" for k in range(120)),
        ["csv"],
        SPECTRUM,
    ),
    "figure's data sets": ("old,,young,\nX,Y,X,Y\n" + "1,2,3,4\n" * 200, ["csv"], SPECTRUM),
    "few numbers": (TABS.partition("\n")[2], TEXTS, SPECTRUM),
    "nothing": ("", ["csv"], SPECTRUM),
    "nothing in a text": ("", TEXTS, RECORDING),
    "recording": (HELD, ["csv", "log", "prn", "tab", "xls", "out", ""], RECORDING),
    "recording, tabs": (HELD.replace(",", "\t"), TEXTS, RECORDING),
    "German": (
        HELD.replace("time,force", "Zeit [s];Kraft [N]").replace(",", ";"),
        ["csv"],
        RECORDING,
    ),
    "many numbers": ("\n".join(f"{k / 100},{k % 7}" for k in range(2000)), ["csv"], RECORDING),
    "numbers in a text": ("\n".join(f"{k % 7}" for k in range(300)), TEXTS, RECORDING),
    "short": ("time\tforce\n0.0\t1\n0.1\t2\n", TEXTS, RECORDING),
    "a force called f": (HELD.replace("force", "f"), ["csv"], RECORDING),
    "laboratory's header": (
        "Frequency:\t1000\nPower line:\toff\n" + "1\n" * 300,
        TEXTS,
        RECORDING,
    ),
    "laboratory's name of the file": (
        "File\tx.dat\nDate\t2026.12.01\n" + "1\t2\n" * 300,
        TEXTS,
        RECORDING,
    ),
    "header of one cell": (
        "Frequency 1000 Hz\ntime\tforce\n" + "1\t2\n" * 300,
        TEXTS,
        RECORDING,
    ),
    "response": ("frequency_hz,gain_N/mm,phase_deg,coherence\n" + STIFF, ["csv"], RESPONSE),
    "response, short names": ("f;gain;phase;coherence\n" + STIFF, TEXTS, RESPONSE),
    "fitted response": ("frequency_hz,real,imaginary,stderr\n" + STIFF, ["csv"], RESPONSE),
    "study": ("# pilot\nFile,Person\na.csv,anna\n", ["csv", "txt"], STUDY),
    "study, person called otherwise": ("file,subject\na1.csv,anna\n", ["csv", "txt"], STUDY),
    "study, semicolons": ("person;group;file\nanna;old;a.csv\n", ["csv"], STUDY),
    "study in TOML": ('table = "study.csv"\n', ["toml"], STUDY),
    "recordings in TOML": ("rate = 100\n" + TRIALS, ["toml"], STUDY),
    "target in TOML": ('name = "table"\nfrequency_hz = [1, 2]\n', ["toml"], SPECTRUM),
    "packed": (gzip.compress(HELD.encode()), ["csv.gz"], RECORDING),
}
CASES = [(case, ending) for case, (_, endings, _) in KINDS.items() for ending in endings]


@pytest.mark.parametrize(("case", "ending"), CASES)
def test_kind_of_file(case, ending, tmp_path):
    text, _, kind = KINDS[case]
    assert kind_of_file(write(tmp_path, text, f"x.{ending}".rstrip("."))) == kind


@pytest.mark.parametrize(
    ("name", "kind"),
    [("none.csv", SPECTRUM), ("none.txt", RECORDING), ("a.smrx", RECORDING), ("anna", SPECTRUM)],
)
def test_kind_of_a_name(name, kind, tmp_path):
    assert kind_of_file(tmp_path / name) == kind


@pytest.mark.parametrize("ending", TEXTS)
@pytest.mark.parametrize("text", [TABS, BLANKS], ids=["tabs", "blanks"])
def test_a_spectrum_is_the_same_in_any_text(text, ending, tmp_path):
    same = as_target(write(tmp_path, POWERS, "x.csv"))
    target = as_target(write(tmp_path, text, f"x.{ending}"))
    np.testing.assert_array_equal(target.proportional_power, same.proportional_power)
    assert (target.provenance, target.quantity) == ("user", "force")


@pytest.mark.parametrize("case", ["study", "study in TOML"])
def test_a_study_is_no_target(case, tmp_path):
    text, (ending, *_), _ = KINDS[case]
    with pytest.raises(jm.errors.TargetError, match=f"x.{ending}: is the table of a study"):
        as_target(write(tmp_path, text, f"x.{ending}"))
