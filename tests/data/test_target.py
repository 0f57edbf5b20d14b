"""Targets: the bundled numbers against their formulas and sources, files good and bad, grids, round
trips."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st
from recorded import noticed

from jaxmuscle._common import bundled as _bundled
from jaxmuscle._common.bundled import describe_targets, list_targets
from jaxmuscle._common.errors import TargetError
from jaxmuscle.data import Recording
from jaxmuscle.data._target import Target, load_target
from jaxmuscle.spectra._settings import SpectrumSettings

GRID = 0.390625 * np.arange(1, 31)
MEASURED = ("fdi-abduction-45mvc", "vastus-lateralis-26mvc")
# Half a unit in the sixth digit, relative to the smallest mantissa 1.00000, and again in the sum.
SIX_DIGITS = 2 * 5e-6


def slifkin_95(f):
    return 0.64 / (0.64 + (f - 1.24) ** 2)


def slifkin_35(f):
    return slifkin_95(f) + np.exp(-4 * (f - 7) ** 2) / 4


def hann_lobe(f, f0):
    """|Σ_n w_n exp(-2πi (f - f0) n / 100 Hz)|² of the window itself; the formula is its limit."""
    window, n = np.asarray(scipy.signal.get_window("hann", 256)), np.arange(256)
    response = (
        np.abs(np.exp(-2j * np.pi * np.outer(f - f0, n) / 100) @ window) ** 2 / window.sum() ** 2
    )
    return np.where(np.abs(f - f0) < 2 * 0.390625, response, 0)


def zagrodny(f):
    return 0.36 / (0.36 + f**2) + 0.3 * hann_lobe(f, 4.251) + 0.02


def hamilton(f):
    return 0.391**3 / (0.391**3 + f**3)


FORMULAS = {
    "slifkin-newell-1999-95mvc": slifkin_95,
    "slifkin-newell-1999-35mvc": slifkin_35,
    "zagrodny-fig4a": zagrodny,
    "hamilton-2004": hamilton,
}


def write(folder, text, name="target.csv"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def csv_text(frequency, power, header="frequency_hz,proportional_power\n"):
    return header + "".join(f"{f!r},{p!r}\n" for f, p in zip(frequency, power, strict=True))


def toml_text(**changes):
    lines = {
        "name": '"t"',
        "quantity": '"force"',
        "provenance": '"measured"',
        "source": '"here"',
        "frequency_hz": "[0.390625, 0.78125, 1.171875]",
        "proportional_power": "[0.5, 0.25, 0.25]",
    } | changes
    return "".join(f"{key} = {value}\n" for key, value in lines.items() if value is not None)


def test_bundled_names_and_descriptions():
    assert set(list_targets()) == {*MEASURED, *FORMULAS}
    for entry in describe_targets():
        target = load_target(entry.name)
        assert tuple(entry) == (target.name, target.provenance, target.quantity, target.source)


def test_listing_needs_neither_jax_nor_numpy():
    # The file alone: what the package imports besides is its own affair.
    code = f"import runpy, sys; runpy.run_path({_bundled.__file__!r})"
    code += "; assert not {'jax', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", FORMULAS)
def test_reconstructed_is_its_formula(name):
    target = load_target(name)
    expected = FORMULAS[name](GRID)
    np.testing.assert_allclose(
        target.proportional_power, expected / expected.sum(), rtol=SIX_DIGITS
    )
    assert target.sigma is not None
    np.testing.assert_allclose(target.sigma, 0.5 * target.proportional_power, rtol=1e-12)
    assert target.provenance == "reconstructed"
    assert target.settings == SpectrumSettings()
    assert target.notices == (
        f"reconstructed from what the text states, not measured: {target.reason}",
    )


@pytest.mark.parametrize(
    ("name", "maxima"),
    [
        ("slifkin-newell-1999-95mvc", [3]),
        ("slifkin-newell-1999-35mvc", [3, 18]),
        ("zagrodny-fig4a", [1, 11]),
        ("hamilton-2004", [1]),
    ],
)
def test_reconstructed_has_the_stated_maxima(name, maxima):
    target = load_target(name)
    peaks, _ = scipy.signal.find_peaks(np.concatenate([[0], target.proportional_power, [1]]))
    assert list(peaks) == maxima


@pytest.mark.parametrize("name", MEASURED)
def test_measured(name):
    target = load_target(name)
    np.testing.assert_array_equal(target.frequency, GRID)
    np.testing.assert_array_equal(target.bins, np.arange(1, 31))
    assert target.proportional_power.sum() == pytest.approx(1, abs=1e-12)
    assert (target.provenance, target.quantity, target.sigma) == ("measured", "force", None)
    # So a fit of one leaves the programs that a fit of a recording of your own asks for.
    recorded = Recording(np.arange(1.0, 20001.0) % 97, 2048.0).target()
    assert (target.settings, target.recorded_at) == (recorded.settings, recorded.recorded_at)
    assert target.notices == ()


def test_measured_facts():
    vastus, fdi = load_target("vastus-lateralis-26mvc"), load_target("fdi-abduction-45mvc")
    assert (vastus.segments, vastus.coefficient_of_variation, vastus.mvc_fraction) == (
        (12,),
        (0.0133,),
        0.2598,
    )
    assert (fdi.segments, fdi.coefficient_of_variation, fdi.mvc_fraction) == (
        (2, 2),
        (0.0337, 0.0132),
        0.45,
    )
    assert "ApEn(2, 0.2 SD) 0.70" in vastus.source
    # The printed bins sum to 0.999998 and 0.999999.
    assert vastus.proportional_power[1] == pytest.approx(0.283833 / 0.999998, rel=1e-12)
    assert fdi.proportional_power[0] == pytest.approx(0.324362 / 0.999999, rel=1e-12)


def test_degrees_of_freedom_add_over_trials():
    nu = lambda K: 2 * K / (1 + 2 * (1 - 1 / K) / 36)  # noqa: E731
    assert load_target("vastus-lateralis-26mvc").degrees_of_freedom == pytest.approx(
        nu(12), rel=1e-4
    )
    assert load_target("fdi-abduction-45mvc").degrees_of_freedom == pytest.approx(
        2 * nu(2), rel=1e-4
    )
    assert load_target("hamilton-2004").degrees_of_freedom is None


def test_immutable():
    target = load_target("zagrodny-fig4a")
    for array in (target.frequency, target.bins, target.proportional_power, target.sigma):
        assert array is not None and not array.flags.writeable
    with pytest.raises(AttributeError):
        target.name = "other"  # pyright: ignore[reportAttributeAccessIssue]


def test_text_tells_what_it_is():
    text = str(load_target("vastus-lateralis-26mvc"))
    for part in (
        "vastus-lateralis-26mvc",
        "measured",
        "openhdemg",
        "0.781 Hz",
        "12 (",
        "1.33 %",
        "25.98 % MVC",
    ):
        assert part in text
    assert "not measured" in str(load_target("hamilton-2004"))


@pytest.mark.parametrize("name", [*MEASURED, *FORMULAS])
def test_saved_target_is_read_back_equal(name, tmp_path):
    target = load_target(name)
    target.save(tmp_path / "copy.toml")
    assert load_target(tmp_path / "copy.toml") == target
    assert [file.name for file in tmp_path.iterdir()] == ["copy.toml"]


def test_history_survives_saving(tmp_path):
    frequency = np.linspace(0.5, 6, 20)
    target = load_target(
        write(tmp_path, csv_text(frequency.tolist(), (3 / frequency).tolist())), segments=[3, 4]
    )
    assert len(target.notices) == 3
    target.save(tmp_path / "copy.toml")
    assert load_target(str(tmp_path / "copy.toml")) == target


def test_settings_without_filter_survive_saving(tmp_path):
    settings = SpectrumSettings(rate=50.0, length=64, last_bin=4, filter_cutoff=None)
    target = Target("mine", [4.0, 3.0, 2.0, 1.0], settings=settings, sigma=[1.0, 1.0, 1.0, 1.0])
    assert target.sigma is not None
    np.testing.assert_allclose(target.sigma, 0.1)
    target.save(tmp_path / "copy.toml")
    assert load_target(tmp_path / "copy.toml") == target


@pytest.mark.parametrize("wrong", [0.0, -0.1, np.nan, np.inf])
@pytest.mark.parametrize("name", ["proportional_power", "sigma"])
def test_one_value_that_no_spectrum_has_is_refused(name, wrong):
    settings = SpectrumSettings(rate=50.0, length=64, last_bin=4, filter_cutoff=None)
    fields = {"proportional_power": [4.0, 3.0, 2.0, 1.0], "sigma": [1.0, 1.0, 1.0, 1.0]}
    fields[name][2] = wrong
    with pytest.raises(TargetError, match=f"{name}: every value must be finite and larger than 0"):
        Target("mine", fields["proportional_power"], settings=settings, sigma=fields["sigma"])


@pytest.mark.parametrize(
    ("path", "message"), [("copy.csv", ".toml"), ("missing/copy.toml", "written")]
)
def test_save_refuses(path, message, tmp_path):
    with pytest.raises(TargetError, match=message):
        load_target("hamilton-2004").save(tmp_path / path)
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(TargetError, match="cannot be written"):
        load_target("hamilton-2004").save(tmp_path / "folder.toml")
    assert [file.name for file in tmp_path.iterdir()] == ["folder.toml"]


def test_plain_csv(tmp_path):
    power = load_target("vastus-lateralis-26mvc").proportional_power
    text = "# my recording\n" + csv_text(GRID.tolist(), power.tolist())
    target = load_target(write(tmp_path, text, "mine.csv"))
    np.testing.assert_allclose(target.proportional_power, power, rtol=1e-12)
    assert (target.name, target.quantity, target.provenance) == ("mine", "force", "user")
    assert (target.source, target.segments, target.notices) == ("my recording", None, ())


def test_two_decimals_are_on_the_grid(tmp_path):
    text = csv_text(np.round(GRID, 2).tolist(), [1 / 30] * 30)
    target = load_target(write(tmp_path, text))
    np.testing.assert_array_equal(target.frequency, GRID)
    assert target.notices == ()


def test_arguments_replace_what_the_file_says(tmp_path):
    path = write(tmp_path, csv_text(GRID.tolist(), [1 / 30] * 30))
    target = load_target(path, quantity="displacement", segments=6)
    assert (target.quantity, target.segments, target.notices) == ("displacement", (6,), ())
    assert load_target("vastus-lateralis-26mvc", segments=12).notices == ()
    changed = load_target("vastus-lateralis-26mvc", quantity="torque", segments=[5, 7])
    assert (changed.quantity, changed.segments) == ("torque", (5, 7))
    assert changed.notices == (
        "quantity torque as asked; the file says force",
        "segments 5 + 7 as asked; the file says 12",
    )


def test_interpolation_is_linear_in_log_power(tmp_path):
    frequency = np.array([0.3, 1.0, 2.2, 5.0, 9.0, 12.5])
    text = "frequency_hz,proportional_power,sigma\n"
    text += "".join(f"{f},{np.exp(-f)},{0.1 * np.exp(-f)}\n" for f in frequency)
    target = load_target(write(tmp_path, text))
    # six numbers do not become thirty: the bins nearest to them
    np.testing.assert_array_equal(target.bins, [1, 3, 6, 13, 23])
    expected = np.exp(-GRID)[target.bins - 1]
    expected /= expected.sum()
    np.testing.assert_allclose(target.proportional_power, expected, rtol=1e-12)
    assert target.sigma is not None
    np.testing.assert_allclose(target.sigma, 0.1 * expected, rtol=1e-12)
    assert "so the log power was interpolated (widest gap 4 Hz)" in " ".join(target.notices)


def test_no_extrapolation(tmp_path):
    target = load_target(write(tmp_path, csv_text([1.0, 2.0, 4.0], [3.0, 2.0, 1.0])))
    np.testing.assert_array_equal(target.bins, [3, 5, 10])
    np.testing.assert_array_equal(target.frequency, GRID[[2, 4, 9]])
    assert target.proportional_power.sum() == pytest.approx(1, abs=1e-12)
    assert noticed(
        target, "no value in the bins 1 to 2, 4, 6 to 9, 11 to 30, so these are left out"
    )


def test_bins_missing_on_the_grid_stay_missing(tmp_path):
    bins = np.array([1, 2, 3, 7, 9, 40])
    text = csv_text((0.390625 * bins).tolist(), [0.4, 0.2, 0.2, 0.1, 0.1, 0.5])
    target = load_target(write(tmp_path, text))
    np.testing.assert_array_equal(target.bins, bins[:-1])
    np.testing.assert_allclose(target.proportional_power, [0.4, 0.2, 0.2, 0.1, 0.1], rtol=1e-12)
    assert target.notices == (
        "1 row lies outside bins 1 to 30 and is left out",
        (
            "the spectrum has no value in the bins 4 to 6, 8, 10 to 30, so these are left out "
            "(bin k lies at k times 0.390625 Hz)"
        ),
    )


def test_trials_that_scatter_more_than_their_segments_explain_are_told():
    now = Target(
        "now",
        np.full(29, 1 / 29),
        bins=np.delete(np.arange(1, 31), 1),
        segments=(6, 6),
        dispersion=(3.0, 0.5),
    )
    assert now.notices[0].startswith("the spectrum has no value in bin 2, so it is left out")
    assert now.notices[1].startswith(
        "the spectra of the trials differ 3.00 ± 0.50 times as much as by chance"
    )


@pytest.mark.parametrize(("scale", "count"), [(1.0005, 0), (0.9995, 0), (1.002, 1), (100.0, 1)])
def test_rescaling_is_told_unless_it_is_rounding(scale, count, tmp_path):
    target = load_target(write(tmp_path, csv_text(GRID.tolist(), [scale / 30] * 30)))
    assert sum("rescaled to 1" in notice for notice in target.notices) == count
    np.testing.assert_allclose(target.proportional_power, 1 / 30, rtol=1e-12)


def test_digitised_without_header_is_sorted_and_averaged(tmp_path):
    text = "1.171875, 0.2\n0.391, 0.5\n0.78125, 0.2\n0.78525, 0.4\n"
    target = load_target(write(tmp_path, text))
    np.testing.assert_allclose(target.proportional_power, [0.5, 0.3, 0.2], rtol=1e-12)
    assert target.notices[0].endswith("sorted by frequency, 1 near-duplicates averaged")


def test_average_of_equal_frequencies_does_not_depend_on_their_order(tmp_path):
    rows = ["0.390625,0.1\n", "0.390625,0.2\n", "0.390625,0.3\n"]
    assert 0.1 + 0.2 + 0.3 != 0.3 + 0.2 + 0.1
    targets = [
        load_target(write(tmp_path, "".join(order) + "0.78125,1\n")) for order in (rows, rows[::-1])
    ]
    assert targets[0] == targets[1]


@pytest.mark.parametrize(
    "text",
    [
        "frequency_hz;proportional_power\n0,390625;0,75\n0,78125;0,25\n",
        "frequency_hz\tproportional_power\n0.390625\t0.75\n0.78125\t0.25\n",
        "proportional_power,frequency_hz\r\n0.75,0.390625\r\n0.25,0.78125\r\n",
        '\ufeff"frequency_hz", "proportional_power"  # names\n\n 0.390625 , 7.5e-1\n0.78125,.25',
    ],
)
def test_dialects(text, tmp_path):
    target = load_target(write(tmp_path, text))
    np.testing.assert_array_equal(target.bins, [1, 2])
    np.testing.assert_array_equal(target.proportional_power, [0.75, 0.25])


FREQUENCY = 0.390625 * np.arange(60)
POWER = 1 / (1 + (FREQUENCY / 3) ** 2)


def spectrum_text(header, frequency=FREQUENCY, power=POWER, sign=","):
    rows = zip(frequency, power, strict=True)
    return header + "\n" + "".join(f"{f:.10g}{sign}{p:.10g}\n" for f, p in rows)


@pytest.mark.parametrize(
    "header",
    [
        "frequency,power",
        "f,Pxx",
        "Frequency (Hz),PSD (N^2/Hz)",
        "Hz,Leistungsdichte",
        "freq,power spectrum",
    ],
)
def test_names_that_programs_give_and_a_row_at_0_hz(header, tmp_path):
    path = write(tmp_path, spectrum_text(header))
    target = load_target(path)
    np.testing.assert_allclose(target.proportional_power, POWER[1:31] / POWER[1:31].sum())
    assert "the row at 0 Hz is the mean, and is left out" in target.notices


@pytest.mark.parametrize(
    ("header", "scaled", "scale"),
    [
        ("Frequency [Hz],PSD [dB/Hz]", 10 * np.log10(POWER), "dB"),
        ("freq,power_dB", 10 * np.log10(POWER), "dB"),
        ("f,dB", 10 * np.log10(POWER), "dB"),
        ("f,log10(Pxx)", np.log10(POWER), "log10"),
        ("f,ln_power", np.log(POWER), "ln"),
    ],
)
def test_decibels_and_logarithms(header, scaled, scale, tmp_path):
    target = load_target(write(tmp_path, spectrum_text(header, power=scaled)))
    np.testing.assert_allclose(target.proportional_power, POWER[1:31] / POWER[1:31].sum())
    assert f"the powers are in {scale}, and were converted" in target.notices


def test_a_first_frequency_near_bin_1_is_not_lost(tmp_path):
    near = 0.4 * np.arange(1, 30)
    text = spectrum_text("frequency,power", near, 1 / (1 + (near / 3) ** 2))
    target = load_target(write(tmp_path, text))
    np.testing.assert_array_equal(target.bins, np.arange(1, 30))
    expected = POWER[1:30] / POWER[1:30].sum()
    np.testing.assert_allclose(target.proportional_power, expected, rtol=3e-3)


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_coarse_frequencies_are_not_thirty_numbers(step, tmp_path):
    coarse = step * np.arange(1, 26)
    text = spectrum_text("frequency,power", coarse, 1 / (1 + (coarse / 3) ** 2))
    target = load_target(write(tmp_path, text))
    inside = coarse[(coarse > 0.35) & (coarse < 11.8)]
    assert len(target.bins) <= inside.size
    off = np.abs(target.frequency[:, None] - inside).min(axis=1)
    assert np.all(off <= 0.5 * 0.390625 + 1e-9)
    assert noticed(target, "interpolated powers are no measurements")


HEADER = "frequency_hz,proportional_power\n"
BAD_CSV = {
    "dB without a name": ("frequency,power\n0.4,-3\n0.8,-7\n", "name the column power_dB"),
    "dB without a header": ("0.4,-3\n0.8,-7\n", "in a first line frequency_hz,power_dB"),
    "log of which base": ("f,log power\n0.4,-3\n0.8,-7\n", "(log10_power, ln_power)"),
    "amplitudes": ("f,amplitude\n0.4,3\n0.8,7\n", "square them"),
    "kHz": ("frequency_kHz,power\n0.4,3\n0.8,7\n", "give frequencies in Hz"),
    "logarithm of the frequency": ("log10_f,power\n0.4,3\n0.8,7\n", "give frequencies in Hz"),
    "sigma of dB": ("f,power_dB,sigma\n0.4,3,1\n0.8,7,1\n", "sigma belongs to a power as it is"),
    "no logarithm": ("f,power_dB\n0.4,3\n0.8,inf\n", "line 3: inf is no power in dB"),
    "empty": ("", "is empty"),
    "blank": (" \n\n", "is empty"),
    "comments only": ("# nothing\n", "holds no data"),
    "header only": (HEADER, "header but no data"),
    "binary": (b"\x89PNG\r\n\x1a\n\x00\x00", "not UTF-8 text"),
    "zeros": (b"0.39,0.5\n\x00\n", "not UTF-8 text"),
    "text in a number column": (
        HEADER + "# c\n0.4,0.5\n0.8,high\n",
        "line 4: proportional_power 'high' is not",
    ),
    "zero power": (
        HEADER + "0.4,0.5\n0.8,0\n",
        "line 3: proportional_power 0 must be finite and larger than 0",
    ),
    "negative power": ("0.4,0.5\n0.8,-0.1\n", "line 2: proportional_power -0.1 must"),
    "nan power": (HEADER + "0.4,nan\n0.8,0.2\n", "line 2: proportional_power nan must"),
    "infinite power": (HEADER + "0.4,0.1\n0.8,inf\n", "line 3: proportional_power inf must"),
    "negative frequency": (HEADER + "-0.4,0.1\n0.8,0.2\n", "line 2: frequency -0.4 must"),
    "nan frequency": ("nan,0.1\n0.8,0.2\n", "line 1: frequency nan must"),
    "no force has it": (
        HEADER + "0.4,0.1\n0.8,0.2\n4294967296,0.2\n",
        "line 4: frequency 4.29497e+09 Hz is above 5e+08 Hz",
    ),
    "unsorted": (
        HEADER + "0.4,0.1\n1.2,0.2\n0.8,0.2\n",
        "line 4: frequency 0.8 Hz is out of order",
    ),
    "duplicate": (HEADER + "0.4,0.1\n0.4,0.2\n", "line 3: frequency 0.4 Hz appears twice"),
    "sigma": ("frequency_hz,proportional_power,sigma\n0.4,0.1,0\n", "line 2: sigma 0 must"),
    "missing cell": (HEADER + "0.4,0.1\n0.8\n", "line 3: 1 of 2 columns"),
    "third column": (
        "0.4,0.1,0.05\n",
        "line 1: 3 of 2 columns found; a third column needs a header",
    ),
    "decimal comma": ("0,4,0,1\n0,8,0,2\n", "decimal commas need a semicolon or tab"),
    "one column": ("0.4\n0.8\n", "line 1: one column"),
    "tab and semicolon": ("0.4;\t0.1\n", "line 1: holds tabs and semicolons"),
    "unknown column": (
        "frequency_hz,proportional_powr\n0.4,0.1\n",
        "did you mean 'proportional_power'?",
    ),
    "no power column": ("frequency_hz,sigma\n0.4,0.1\n", "line 1: no column 'proportional_power'"),
    "column twice": ("frequency_hz,sigma,sigma\n0.4,0.1,1\n", "column 'sigma' appears twice"),
    "one bin": (HEADER + "0.390625,1\n", "covers 1 of the bins 1 to 30"),
    "off grid, one bin": (HEADER + "0.5,1\n0.9,1\n", "covers 1 of the bins 1 to 30"),
    "beyond the grid": (
        HEADER + "20,1\n30,1\n",
        "covers 0 of the bins 1 to 30 (0.3906 to 11.72 Hz)",
    ),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_bad_csv(case, tmp_path):
    text, message = BAD_CSV[case]
    path = write(tmp_path, text)
    with pytest.raises(TargetError) as caught:
        load_target(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(path))


BAD_TOML = {
    "syntax": (dict(name='"t'), "not valid TOML: Illegal character '\\n' (at line 1"),
    "unknown key": (dict(segment="3"), "unknown key 'segment'; did you mean 'segments'?"),
    "missing key": (dict(source=None), "the key 'source' is missing"),
    "unknown provenance": (
        dict(provenance='"mesured"'),
        "provenance 'mesured'; did you mean 'measured'?",
    ),
    "unknown quantity": (dict(quantity='"forces"'), "quantity 'forces'; did you mean 'force'?"),
    "quantity no text": (dict(quantity="3"), "unknown quantity 3"),
    "lengths": (
        dict(proportional_power="[0.5, 0.5]"),
        "proportional_power has 2 entries, frequency_hz 3",
    ),
    "sigma length": (dict(sigma="[0.5, 0.5]"), "sigma has 2 entries, frequency_hz 3"),
    "sigma zero": (
        dict(sigma="[0.5, 0, 0.5]"),
        "entry 2: sigma 0 must be finite and larger than 0",
    ),
    "power zero": (dict(proportional_power="[0.5, 0.5, 0]"), "entry 3: proportional_power 0 must"),
    "power nan": (
        dict(proportional_power="[nan, 0.5, 0.5]"),
        "proportional_power[0] = nan is not finite",
    ),
    "power text": (
        dict(proportional_power='[1, "a", 1]'),
        "entry 2: proportional_power 'a' is not a number",
    ),
    "power true": (
        dict(proportional_power="[1, true, 1]"),
        "entry 2: proportional_power True is not a number",
    ),
    "power no list": (
        dict(proportional_power="0.5"),
        "proportional_power must be a list of numbers",
    ),
    "huge integer": (
        dict(proportional_power=f"[1, 1{'0' * 400}, 1]"),
        "proportional_power[1] is too large a number",
    ),
    "unsorted": (dict(frequency_hz="[1, 0.5, 2]"), "entry 2: frequency 0.5 Hz is out of order"),
    "segments zero": (dict(segments="0"), "segments 0: give whole numbers of at least 1"),
    "segments fraction": (dict(segments="[2, 2.5]"), "segments 2.5: give whole numbers"),
    "segments empty": (dict(segments="[]"), "segments is an empty list"),
    "percent": (
        dict(coefficient_of_variation="1.33"),
        "coefficient_of_variation 1.33: give a fraction",
    ),
    "level": (dict(mvc_fraction="26"), "mvc_fraction 26: give a fraction"),
    "name": (dict(name='""'), "name '': give a text"),
    "no reason": (dict(provenance='"reconstructed"'), "a reconstructed target needs a reason"),
    "settings": (dict(settings="3"), "settings must be a table"),
    "unknown setting": (dict(settings="{windw = 'hann'}"), "did you mean 'window'?"),
    "among the settings": (
        dict(settings="{mean = [12.0]}"),
        "[settings]: mean: of the target, not of its settings",
    ),
    "above half the rate": (
        dict(frequency_hz="[0.390625, 0.78125, 50.390625]", settings="{rate = 100.0}"),
        "entry 3: frequency 50.3906 Hz is above 50 Hz, half of the rate in [settings]",
    ),
    "wrong setting": (dict(settings="{overlap = 2.0}"), "[settings]: overlap=2.0"),
}


@pytest.mark.parametrize("case", BAD_TOML)
def test_bad_toml(case, tmp_path):
    changes, message = BAD_TOML[case]
    path = write(tmp_path, toml_text(**changes), "target.toml")
    with pytest.raises(TargetError) as caught:
        load_target(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "vastus-lateralis",
            "did you mean 'vastus-lateralis-26mvc'? Known: fdi-abduction-45mvc, ham",
        ),
        ("vastus-lateralis", "`jaxmuscle targets`"),
        ("", "no bundled target ''"),
        ("nowhere.csv", "nowhere.csv: no such file"),
        ("folder/hamilton-2004", "the bundled target is called 'hamilton-2004'"),
        ("hamilton-2004.toml", "; the bundled target is called 'hamilton-2004'"),
        (".", "is a folder"),
        ("a\0.csv", "embedded null"),
        ("x" * 5000 + ".csv", "cannot be read: File name too long"),
        ("plain", "a target is a .toml or .csv file, not one without ending"),
        ("table.xlsx", "a target is a .toml or .csv file, not .xlsx"),
    ],
)
def test_bad_names(given, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "0.4,0.5\n", "plain")
    write(tmp_path, "0.4,0.5\n", "table.xlsx")
    with pytest.raises(TargetError) as caught:
        load_target(given)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(proportional_power=[1.0] * 29), "one number for each of at least 2 bins (30 here)"),
        (dict(proportional_power=["a"] * 30), "proportional_power: give numbers"),
        (dict(proportional_power=[0.0] * 30), "finite and larger than 0"),
        (dict(proportional_power=[1e308] * 30), "finite and larger than 0"),
        (dict(bins=[0, 1], proportional_power=[1.0, 1.0]), "increasing whole numbers from 1 to 30"),
        (dict(bins=[2, 1], proportional_power=[1.0, 1.0]), "increasing whole numbers from 1 to 30"),
        (dict(bins=[3], proportional_power=[1.0]), "at least 2 bins"),
        (dict(proportional_power=[1.0] * 30, sigma=[1.0]), "sigma has shape (1,)"),
        (dict(proportional_power=[1.0] * 30, segments=[1, 0]), "segments 0"),
    ],
)
def test_constructor_names_argument_and_remedy(arguments, message):
    with pytest.raises(TargetError) as caught:
        Target("mine", **arguments)
    assert message in str(caught.value)


POINT = st.tuples(st.floats(0.0, 30.0), st.floats(1e-9, 1e9))
# Two points off the grid, so that all of them are interpolated and some bins are covered.
POINTS = st.lists(POINT, max_size=40).map(lambda points: [(5.05, 2.0), *points, (6.05, 1.0)])


@given(points=POINTS, data=st.data())
def test_valid_csv_loads_whatever_the_order(points, data, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "points.csv"
    path.write_text(csv_text(*zip(*points, strict=True), header=""))
    target = load_target(path)
    assert target.proportional_power.sum() == pytest.approx(1, abs=1e-12)
    assert np.all(target.proportional_power > 0) and np.all(np.diff(target.bins) > 0)
    path.write_text(csv_text(*zip(*data.draw(st.permutations(points)), strict=True), header=""))
    assert load_target(path) == target
    target.save(path.with_suffix(".toml"))
    assert load_target(path.with_suffix(".toml")) == target


@given(points=POINTS)
def test_sorted_csv_with_header_stays_between_its_points(points, tmp_path_factory):
    frequency, power = np.array(sorted(dict(points).items())).T
    path = tmp_path_factory.mktemp("csv") / "points.csv"
    path.write_text(csv_text(frequency.tolist(), power.tolist()))
    p = load_target(path).proportional_power
    # Interpolation cannot leave the range of the points; 1e-9 is for the rounding of exp(log(p)).
    assert p.max() / p.min() <= power.max() / power.min() * (1 + 1e-9)
