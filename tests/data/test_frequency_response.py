"""Published frequency responses: their errors, tables and files."""

import json
import tomllib

import numpy as np
import pytest
import tomli_w

import jaxmuscle as jm

F = np.array([0.5, 1.0, 2.0, 5.0])
GAIN = np.array([1500.0, 1490.0, 1450.0, 1300.0])
PHASE = np.array([3.0, 6.0, 12.5, 40.0])
COHERENCE = np.array([0.9, 0.95, 0.5, 0.2])
FIELDS = {"name": "anna", "source": "figure 3", "notices": ["read by eye"]}


def equal(a, b):
    for field in ("frequency", "value", "stderr", "coherence"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    assert (a.name, a.source, a.notices) == (b.name, b.source, b.notices)


def test_error_by_coherence_is_that_of_a_regression():
    """The formula against drawn ordinates F = H X + N: K of them, known H, coherence of the
    density."""
    rng, k, h = np.random.default_rng(0), 20, 3 - 2j
    x, n = rng.standard_normal((2, 20_000, k, 2)) @ [1, 1j]
    noise = 4.0
    found = np.sum(x.conj() * (h * x + noise * n), axis=1) / np.sum(np.abs(x) ** 2, axis=1)
    coherence = abs(h) ** 2 / (abs(h) ** 2 + noise**2)
    stated = jm.data.FrequencyResponse.from_gain(
        [1.0], [abs(h)], [0.0], coherence=[coherence], segments=k
    ).stderr[0]
    # Given X the variance is S / Σ|X|², on the average K / (K - 1) times S / (K S_X).
    expected = stated * np.sqrt(k / (k - 1))
    spread = 3.9 / np.sqrt(2 * found.size)
    assert np.std(found.real) == pytest.approx(expected, rel=spread)
    assert np.std(found.imag) == pytest.approx(expected, rel=spread)


def test_gain_phase_and_back():
    response = jm.data.FrequencyResponse.from_gain(
        F, GAIN, PHASE, coherence=COHERENCE, segments=[10, 20, 30, 40], **FIELDS
    )
    np.testing.assert_allclose(response.gain, GAIN)
    np.testing.assert_allclose(response.phase, PHASE)
    np.testing.assert_allclose(response.averages, [10, 20, 30, 40])
    np.testing.assert_allclose(response.phase_stderr, np.degrees(response.stderr / GAIN))
    assert "4 frequencies from 0.5 to 5 Hz" in str(response)


def test_no_coherence_no_error():
    response = jm.data.FrequencyResponse.from_gain(
        F, GAIN, PHASE, coherence=[0.9, 0.9, 0.0, 0.9], segments=10
    )
    assert np.isinf(response.stderr[2])
    assert np.isfinite(response.stderr[[0, 1, 3]]).all()


def test_no_response_is_told_from_a_small_one():
    """Errors alone are called a response as often as stated, and hardly less; 48 frequencies that
    add up are one."""
    f, sd, rng = np.linspace(0.5, 12.0, 48), np.linspace(5.0, 20.0, 48), np.random.default_rng(3)
    errors = sd * (rng.standard_normal((2000, 48, 2)) @ [1, 1j])
    p = np.array([jm.data.FrequencyResponse(f, error, sd).p_none for error in errors])
    for level in (0.05, 0.2):
        spread = 4 * np.sqrt(level / p.size)
        assert 0.6 * level - spread < np.mean(p <= level) < level + spread
    # A spring below the error of most points; all of them together know it to a sixth.
    spring = 6 / np.sqrt(np.sum(1 / sd**2))
    assert spring < np.median(sd)
    assert (
        np.mean(
            [
                jm.data.FrequencyResponse(f, error + spring, sd).p_none <= 1e-3
                for error in errors[:200]
            ]
        )
        > 0.9
    )
    assert "does not follow the displacement" in str(
        jm.data.FrequencyResponse(f, errors[np.argmax(p)], sd)
    )
    assert "does not follow" not in str(jm.data.FrequencyResponse(f, errors[0] + 10 * spring, sd))
    # A point without error counts for nothing.
    assert jm.data.FrequencyResponse(
        f, errors[0], np.where(f < 0.6, np.inf, sd)
    ).p_none == pytest.approx(
        jm.data.FrequencyResponse(f[1:], errors[0][1:], sd[1:]).p_none, rel=1e-9
    )


def test_tables_are_exact():
    for coherence in (COHERENCE, None):
        response = jm.data.FrequencyResponse(
            F, GAIN * np.exp(1j * PHASE), [1.5, np.inf, 0.1, 1 / 3], coherence, **FIELDS
        )
        table = response.to_table()
        equal(response, jm.data.FrequencyResponse.from_table(table))
        equal(
            response,
            jm.data.FrequencyResponse.from_table(json.loads(json.dumps(table, allow_nan=False))),
        )
        equal(response, jm.data.FrequencyResponse.from_table(tomllib.loads(tomli_w.dumps(table))))


def test_saved_and_loaded(tmp_path):
    for coherence in (COHERENCE, None):
        response = jm.data.FrequencyResponse.from_gain(
            F, GAIN, PHASE, coherence=coherence, stderr=[1.5, np.inf, 0.1, 1 / 3]
        )
        response.save(tmp_path / "response.csv")
        again = jm.data.load_frequency_response(tmp_path / "response.csv")
        np.testing.assert_allclose(again.value, response.value, rtol=1e-14)
        np.testing.assert_array_equal(again.stderr, response.stderr)
        np.testing.assert_array_equal(again.coherence, response.coherence)
        assert again.name == "response"
    with pytest.raises(ValueError, match=r"ends in \.csv"):
        response.save(tmp_path / "response.txt")


HEADERS = {
    "frequency_hz,gain,phase_deg,coherence": (1.0, 1.0),
    "Frequency [Hz],Gain [N/mm],Phase [rad],Coherence": (1e-3, np.pi / 180),
    "freq,gain_kN/m,phase,coherence": (1e-3, 1.0),
    "f (Hz),gain_N/cm,phase_rad,coherence": (1e-2, np.pi / 180),
    "f,gain_Nm/rad,phase,coherence": (0.04**2, 1.0),
    "f,gain (N·m/deg),phase,coherence": (0.04**2 * np.pi / 180, 1.0),
}


@pytest.mark.parametrize("header", HEADERS)
def test_units_in_headers(header, tmp_path):
    scale, turn = HEADERS[header]
    rows = np.c_[F, GAIN * scale, PHASE * turn, COHERENCE]
    path = tmp_path / "figure.csv"
    path.write_text(
        f"# Smith 1999\n{header}\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    )
    found = jm.data.load_frequency_response(
        path, segments=12, lever_arm=0.04 if "Nm" in header or "·" in header else None
    )
    wanted = jm.data.FrequencyResponse.from_gain(F, GAIN, PHASE, coherence=COHERENCE, segments=12)
    np.testing.assert_allclose(found.value, wanted.value, rtol=1e-12)
    np.testing.assert_allclose(found.stderr, wanted.stderr, rtol=1e-12)


def test_decibel_and_errors_in_the_unit_of_the_gain(tmp_path):
    path = tmp_path / "figure.csv"
    path.write_text("coherence;gain_dB;phase;f;stderr_N/m\n0,9;60;3;0,5;12,5\n0,8;40;4;1;1,5\n")
    found = jm.data.load_frequency_response(path)
    np.testing.assert_allclose(found.gain, [1000, 100])
    np.testing.assert_array_equal(found.stderr, [12.5, 1.5])
    path.write_text("stderr,frequency_hz,gain_N/mm,phase_deg\n0.1,1,5,3\n0.2,2,5,3\n")
    np.testing.assert_allclose(jm.data.load_frequency_response(path).stderr, [100, 200])


def test_a_table_that_a_fit_wrote_is_read_without_what_was_fitted(tmp_path):
    path = tmp_path / "stiffness.csv"
    path.write_text(
        "frequency_hz,real,imaginary,stderr,fitted_real,fitted_imaginary\n1,100,-20,3,90,1\n2,80,5,inf,90,1\n"
    )
    found = jm.data.load_frequency_response(path, name="own")
    np.testing.assert_allclose(found.value, [100 - 20j, 80 + 5j], rtol=1e-12)
    np.testing.assert_array_equal(found.stderr, [3, np.inf])
    assert (found.name, found.source) == ("own", "stiffness.csv")


@pytest.mark.parametrize("spectrum", [False, True])
def test_a_target_with_a_stiffness_is_saved_and_read_back_equal(spectrum, tmp_path):
    """Also one that has a stiffness and no spectrum, whose frequencies and powers are empty
    lists."""
    measured = jm.data.FrequencyResponse(
        F,
        GAIN * np.exp(1j * np.radians(PHASE)),
        [3.0, 4.0, np.inf, 5.0],
        coherence=COHERENCE,
        **FIELDS,
    )
    power = np.arange(1.0, 31) if spectrum else None
    target = jm.Target("anna", power, segments=12 if spectrum else None, stiffness=measured)
    target.save(tmp_path / "anna.toml")
    found = jm.load_target(tmp_path / "anna.toml")
    np.testing.assert_array_equal(found.bins, target.bins)
    np.testing.assert_array_equal(found.proportional_power, target.proportional_power)
    equal(found.stiffness, measured)
    assert (found.name, found.segments, found.settings) == (
        target.name,
        target.segments,
        target.settings,
    )


def test_a_mean_without_a_spectrum_is_known_to_two_percent():
    """Its density at low frequencies is not known: the error is that of a target without
    segments."""
    measured = jm.data.FrequencyResponse(F, GAIN, 5.0 * np.ones(4))
    stated = {"mean": 20.0, "unit": "N", "stiffness": measured}
    with_all = jm.Target("anna", None, segments=12, coefficient_of_variation=0.02, **stated)
    assert (
        with_all.mean_force
        == jm.Target("anna", None, **stated).mean_force
        == pytest.approx((20.0, 0.4))
    )


def test_a_target_without_spectrum_needs_a_stiffness(tmp_path):
    table = {
        "name": "a",
        "quantity": "force",
        "provenance": "user",
        "source": "b",
        "frequency_hz": [],
        "proportional_power": [],
    }
    (tmp_path / "a.toml").write_text(tomli_w.dumps(table))
    with pytest.raises(ValueError, match="frequency_hz must be a list of numbers"):
        jm.load_target(tmp_path / "a.toml")


HEAD = "frequency_hz,gain,phase_deg,coherence\n"
FITTED = "frequency_hz,real,imaginary,stderr,fitted_real,fitted_imaginary\n1,100,-20,3,90,1\n"
DAMAGED = {
    "fitted, unsorted": (FITTED + "0.5,80,5,2,90,1\n", "frequency, line 3: 0.5: give rising"),
    "fitted, no error": (FITTED + "2,80,5,0,90,1\n", "stderr, line 3: 0"),
    "fitted, empty": (FITTED + "2,80,,2,90,1\n", "line 3: imaginary is missing or not finite"),
    "word": (HEAD + "1,2,3,0.9\n2,many,3,0.9\n", "line 3: gain 'many' is not a number"),
    "empty cell": (HEAD + "1,2,3,0.9\n2,,3,0.9\n", "line 3: gain is missing or not finite"),
    "short line": (HEAD + "1,2,3,0.9\n2,2,3\n3,2,3,0.9\n", "line 3: 3 of 4 columns found"),
    "unsorted": ("# a\n" + HEAD + "2,2,3,0.9\n1,2,3,0.9\n", "frequency, line 4: 1: give rising"),
    "coherence above 1": (HEAD + "1,2,3,0.9\n2,2,3,90\n", "coherence, line 3: 90"),
    "coherence of 1": (
        HEAD + "1,2,3,1\n2,2,3,0.9\n",
        "of 1 the formula has no error",
    ),
    "gain below 0": (HEAD + "1,2,3,0.9\n2,-2,3,0.9\n", "gain, line 3: -2"),
    "frequency 0": (HEAD + "0,2,3,0.9\n2,2,3,0.9\n", "frequency, line 2: 0"),
    "unknown column": (
        "frequency_hz,gain,phase,power\n1,2,3,4\n2,2,3,4\n",
        "unknown column 'power'",
    ),
    "unknown unit": ("frequency_hz,gain_lb/in,phase\n1,2,3\n2,2,3\n", "unknown unit 'lb/in'"),
    "no phase": ("frequency_hz,gain,coherence\n1,2,0.3\n2,2,0.3\n", "no column 'phase'"),
    "twice": (
        "frequency_hz,gain,phase,gain_N/mm\n1,2,3,4\n2,2,3,4\n",
        "are both the gain; keep one",
    ),
    "two units": (
        "frequency_hz,gain_Nm/rad,phase,stderr_N/m\n1,2,3,0.4\n2,2,3,0.4\n",
        "one is torque over angle, give both alike",
    ),
    "no error": (
        "frequency_hz,gain,phase\n1,2,3\n2,2,3\n",
        "stderr: is not known; give it, or the coherence",
    ),
    "empty": ("", "is empty"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_files(case, tmp_path):
    text, words = DAMAGED[case]
    path = tmp_path / "figure.csv"
    path.write_text(text)
    with pytest.raises(ValueError) as error:
        jm.data.load_frequency_response(path, segments=10)
    assert words in str(error.value)
    assert str(path) in str(error.value)


def test_refused():
    for change, words in (
        ({"stderr": [1, 2, 0, 1]}, "stderr, entry 3: 0"),
        ({"stderr": [np.inf] * 4}, "give one that is finite"),
        ({"frequency": [1, 1, 2, 3]}, "frequency, entry 2: 1"),
        ({"value": [1, np.nan, 2, 3]}, "value, entry 2"),
        ({"coherence": [1, 0, -0.1, 1]}, "coherence, entry 3"),
        ({"value": [1, 2, 3]}, "give 4 values, one for each frequency"),
        ({"value": ["a"] * 4}, "value: give numbers"),
    ):
        with pytest.raises(ValueError) as error:
            jm.data.FrequencyResponse(
                **({"frequency": F, "value": GAIN + 0j, "stderr": GAIN} | change)
            )
        assert words in str(error.value)


def test_figure_has_errors():
    figure = jm.data.FrequencyResponse.from_gain(
        F, GAIN, PHASE, coherence=COHERENCE, segments=10
    ).plot()
    assert [len(ax.containers) for ax in figure.axes] == [1, 1, 1]
    assert figure.axes[0].get_yscale() == "log"
    without = jm.data.FrequencyResponse.from_gain(F, GAIN, PHASE, stderr=GAIN / 10).plot()
    assert [len(ax.containers) for ax in without.axes] == [1, 1, 0]
