"""Fit results and presets: what is saved is read back equal, files are whole or not there, errors
name the remedy."""

import dataclasses
import json
import os
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w

import jaxmuscle as jm
from jaxmuscle._common.errors import PresetError, ResultError
from jaxmuscle._common.files import replacing, write_json, write_text
from jaxmuscle.fits import Estimate
from jaxmuscle.fits._report import may_be_elsewhere
from jaxmuscle.fits._result import FORMAT, Adequacy, Rung, Start
from jaxmuscle.model._task_tables import task_from_table, task_to_table

POWER = 1 / (1 + np.arange(1, 31) ** 2)
TARGET = jm.Target(
    "made", POWER, segments=[6, 7], coefficient_of_variation=0.02, notices=["a notice"]
).with_measures()  # as a fit keeps it


PART = [field.name for field in dataclasses.fields(jm.fits.FittedPart)]


def made_result(**changes: Any) -> jm.fits.FitResult:
    """A result with a value in every field, as a fit would give; nothing is simulated."""
    task = jm.Isometric().replace(c_w=50.0 / 3, harmonic_phase=-0.1)
    parameters = {
        name: Estimate(
            float(value),
            "N",
            0.1 / 3 if name == "c_w" else None,
            name in ("c_w", "k_w"),
            name != "k_w",
        )
        for name, value in task.parameters.items()
    }
    rng = np.random.default_rng(0)
    fields: dict[str, Any] = {
        "success": True,
        "message": "converged: 1 of 2 starts reach a fit as good as this (cost within 5 %)",
        "adequacy": Adequacy(
            26.1,
            25.0,
            0.4,
            "the data have more power than the model at 4.3 Hz (1.2 standard errors)",
        ),
        "task": task,
        "target": TARGET,
        "method": "montecarlo",
        "parameters": parameters,
        "derived": {
            "corner_frequency": Estimate(1 / 3, "Hz", 0.01, interval=(0.31, None)),
            "K_w0": Estimate(200.0, "N/m", None, False, None),
            "model_mean": Estimate(2.5, "N", None, True, False),
        },
        "correlation": {"parameters": ["k_w", "c_w"], "matrix": [[1.0, -0.5], [-0.5, 1.0]]},
        "undetermined": ("all stiffness and damping can be multiplied by one number",),
        "singular_values": np.array([12.0, 1 / 3]),
        "chi2_per_bin": 0.9,
        "rms_log_error": 0.2,
        "fitted": np.asarray(TARGET.proportional_power) * rng.uniform(0.9, 1.1, 30),
        "harmonic_share": rng.uniform(0, 1, 30),
        "residual": rng.standard_normal(30),
        "deviation": rng.uniform(0.1, 0.3, 30),
        "components": {"relaxation": rng.uniform(0, 1, 30), "resonance": rng.uniform(0, 1, 30)},
        "ladder": (
            Rung(0, "slow part + regular rhythm", -250.1, 6.5, 1.9, 0.002, False),
            Rung(1, "slow part + twitch + regular rhythm", -260.0, 7.1, 0.9, 0.3, True),
        ),
        "starts": (
            Start(1.5, True, 12, (4e5, 50 / 3), "spread"),
            Start(None, False, 3, (), "spread"),
        ),
        "stretch": (np.arange(10.0, 15.0, 0.01), rng.standard_normal(500)),
        "recorded": (np.arange(400) / 100, rng.standard_normal(400)),
        "profile": (np.linspace(0.4, 11.7, 64), rng.uniform(0, 9, 64)),
        "harmonic_p_value": 0.08,
        "check": {
            "seeds": 64,
            "largest_deviation": 0.002,
            "largest_deviation_se": 2.1,
            "largest_deviation_sd": 0.01,
        },
        "further": {"coefficient_of_variation": -1.5},
        "explained": {},
        "stiffness": None,
        "notices": ("a notice",),
        "unstated": ("why a number is not stated",),
        "seed": 3,
        "settings": {
            "free": ["k_w", "c_w"],
            "prior_centre": {"k_w": 5e5, "c_w": 60.0},
            "prior_sd": {"k_w": 1.0, "c_w": None},
            "bounds": {"k_w": [None, 2e6], "c_w": [1.0, None]},
            "starts": 2,
            "seeds": 32,
            "check_seeds": 64,
            "max_steps": 40,
            "dt": 2.5e-3,
            "coefficient_of_variation": True,
            "mean_force": None,
            "carried": None,
            "spectrum": TARGET.settings.to_dict(),
            "steps_per_sample": 4,
        },
        "versions": {"jaxmuscle": "0.1", "jax": "0.8"},
    } | changes
    own = {name: fields.pop(name) for name in PART}
    return jm.fits.FitResult(parts={own["target"].name: jm.fits.FittedPart(**own)}, **fields)


def failed_result():
    """What a fit gives whose every start explodes."""
    nothing = np.full(30, np.nan)
    return made_result(
        success=False,
        message="no start has a finite spectrum",
        derived={"model_mean": Estimate(np.nan, "N")},
        adequacy=None,
        further={},
        correlation={},
        undetermined=(),
        singular_values=np.full(2, np.nan),
        chi2_per_bin=None,
        rms_log_error=None,
        fitted=nothing,
        harmonic_share=nothing,
        residual=nothing,
        deviation=None,
        components={},
        ladder=(),
        stretch=(np.zeros(0), np.zeros(0)),
        profile=None,
        harmonic_p_value=None,
        check={},
        seed=None,
        starts=(Start(None, False, 0, (), "spread"),),
    )


def assert_equal(a, b):
    """Field by field, NaN equal to NaN; numbers to the last digit."""
    assert type(a) is type(b)
    if isinstance(a, eqx.Module):
        for field in dataclasses.fields(a):
            assert_equal(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, tuple | list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    else:
        assert a == b or (a != a and b != b)


# --- by name, and as a table


def test_every_number_by_its_name():
    result = made_result()
    corner = result["corner_frequency"]
    assert (corner.value, corner.stderr, corner.unit, corner.interval) == (
        1 / 3,
        0.01,
        "Hz",
        (0.31, None),
    )
    # newtons are unknown: damping and masses per newton of the model's mean force, 2.5 N
    assert result["c_w"].value == pytest.approx(float(result.task["c_w"]) / 2.5)
    assert result.parameters["c_w"].value == result.task["c_w"] and result["m_w"].stderr is None
    with pytest.raises(
        ValueError,
        match="unknown quantity 'corner_frequenzy' of the fit of made: did you mean 'corner_f",
    ):
        result["corner_frequenzy"]


def test_the_numbers_of_several_targets_by_name():
    mean, other = Estimate(2.5, "N", 0.1), Estimate(3.5, "N", 0.2)
    result = made_result(derived={"model_mean@a": mean, "model_mean@b": other})
    assert result["model_mean@b"].value == 3.5
    unknown = "quantity 'model_mean' of the fit of made: did you mean 'model_mean@"
    with pytest.raises(ValueError, match=unknown):
        result["model_mean"]


def test_a_result_as_a_table():
    result = made_result()
    table = result.to_dataframe().set_index("quantity")
    assert list(table.columns) == [
        "kind",
        "value",
        "stderr",
        "low",
        "high",
        "unit",
        "error_from",
        "free",
        "determined",
    ]
    assert table.index.is_unique
    known = {*result.measured, *result.parameters, *result.derived}
    assert set(table.index) == known - {"model_mean"}  # which is 1 N per newton
    count = len(result.measured)
    assert list(table.index[:count]) == list(result.measured)
    assert set(table["kind"][:count]) == {"measured"} and "measured" not in set(
        table["kind"][count:]
    )
    median = result.measured["median_frequency"]
    columns = ["value", "stderr", "low", "high", "unit", "error_from", "free", "determined"]
    assert list(table.loc["median_frequency", columns]) == [
        median.value,
        median.stderr,
        *median.interval,
        "Hz",
        "bins",
        False,
        True,
    ]
    assert list(table.loc["corner_frequency", ["kind", "value", "stderr", "low"]]) == [
        "derived",
        1 / 3,
        0.01,
        0.31,
    ]
    assert np.isnan(table["high"]["corner_frequency"]) and np.isnan(table["stderr"]["k_w"])
    assert list(table.loc["k_w", ["kind", "free", "determined"]]) == ["parameter", True, False]
    of_model = table[table["kind"] != "measured"]
    assert set(of_model.index[of_model["determined"]]) == {"c_w", "corner_frequency"}
    bins = result.only.to_dataframe()
    np.testing.assert_array_equal(bins["fitted"], result.fitted)
    np.testing.assert_array_equal(bins["frequency_hz"], TARGET.frequency)


# --- fit.json


@pytest.mark.parametrize("result", [made_result(), failed_result()], ids=["fitted", "failed"])
def test_a_saved_result_is_read_back_equal(result, tmp_path):
    path = tmp_path / "new folder" / "fit.json"
    result.save(path)
    assert_equal(jm.load_result(path), result)


def test_the_file_has_the_entries_of_the_design(tmp_path):
    path = tmp_path / "fit.json"
    made_result().save(path)
    table = json.loads(path.read_text())
    assert (
        table["task"] == "isometric" and table["target"] == "made" and table["provenance"] == "user"
    )
    for key in (
        "success",
        "message",
        "method",
        "chi2_per_bin",
        "rms_log_error",
        "seed",
        "settings",
        "versions",
    ):
        assert table[key] == getattr(made_result(), key)
    c_w = {
        "value": 50 / 3,
        "unit": "N",
        "stderr": 0.1 / 3,
        "free": True,
        "identifiable": True,
        "interval": None,
    }
    assert table["parameters"]["c_w"] == c_w
    assert table["derived"]["corner_frequency"]["interval"] == [0.31, None]
    assert table["derived"]["K_w0"]["identifiable"] is None  # fixed: neither
    assert table["adequate"] is True and table["adequacy_p"] == 0.4
    assert table["per_newton"] == {"K_w0": 80.0}
    assert (
        table["parameters"]["k_w"]["stderr"] is None
        and not table["parameters"]["k_w"]["identifiable"]
    )
    assert set(table["spectrum"]) >= {"frequency_hz", "target", "fitted"}
    assert table["starts"] == [
        {"cost": 1.5, "success": True, "steps": 12, "values": [4e5, 50 / 3], "kind": "spread"},
        {"cost": None, "success": False, "steps": 3, "values": [], "kind": "spread"},
    ]


def test_a_fit_json_is_a_preset(tmp_path):
    result = made_result()
    result.save(tmp_path / "fit.json")
    assert_equal(jm.load_preset(tmp_path / "fit.json"), result.task)


def fail(*arguments, **keywords):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("call", [(os, "replace"), (json, "dumps")], ids=["rename", "write"])
@pytest.mark.parametrize("exists", [False, True])
def test_a_result_is_never_half_written(call, exists, tmp_path, monkeypatch):
    path = tmp_path / "fit.json"
    if exists:
        path.write_text("before")
    monkeypatch.setattr(*call, fail)
    with pytest.raises(OSError, match="No space left"):
        made_result().save(path)
    assert [p.name for p in tmp_path.iterdir()] == (["fit.json"] if exists else [])
    assert not exists or path.read_text() == "before"


def test_an_interrupted_writer_leaves_nothing(tmp_path):
    path = tmp_path / "figure.png"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), replacing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["figure.png"] and path.read_text() == "before"


def test_written_files_have_the_rights_of_the_user(tmp_path):
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "a.txt", "text")
    finally:
        os.umask(before)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "a.txt").read_text() == "text"


def test_json_refuses_what_it_has_no_word_for(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "fit.json: no such file"),
        ("{", "fit.json: is not valid JSON"),
        ("", "fit.json: is empty"),
        (b"\xff\xfe\x00", "fit.json: is not UTF-8 text"),
        ("[1, 2]", "fit.json: holds no table, but a list"),
        ("{}", f"is not a fit result of format {FORMAT}: fit again, FitResult.save writes it"),
        (
            f'{{"format": {FORMAT}, "format": {FORMAT}}}',
            "is not valid JSON: the key 'format' is there twice",
        ),
        ('{"format": true}', "is not a fit result of format"),
        ('{"a": ' + "[" * 100_000, "fit.json: is nested too deeply"),
        ('{"format": 99}', "is not a fit result of format"),
        (f'{{"format": {FORMAT - 1}}}', f"is not a fit result of format {FORMAT}: fit again"),
        (f'{{"format": {FORMAT}, "message": "m"}}', "the key '.*' is missing; needed are"),
    ],
)
def test_what_is_not_a_result(text, message, tmp_path):
    path = tmp_path / "fit.json"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ResultError, match=message):
        jm.load_result(path)


@pytest.mark.parametrize(
    "entry", ["success", "parameters", "starts", "versions", "task_table", "target_table"]
)
def test_a_missing_entry_is_named(entry, tmp_path):
    path = tmp_path / "fit.json"
    made_result().save(path)
    table = json.loads(path.read_text())
    del table[entry]
    path.write_text(json.dumps(table))
    with pytest.raises(ResultError, match=f"fit.json: the key '{entry}' is missing"):
        jm.load_result(path)


def changed(path, key, value):
    """The file with one entry changed, "a.b.c" by name."""
    table = json.loads(path.read_text())
    *way, last = key.split(".")
    holder = table
    for step in way:
        holder = holder[step]
    holder[last] = value
    path.write_text(json.dumps(table))


WRONG_KINDS = {
    "a type": ("parameters.k_w.value", "200", "value must be a number or nothing, not a text"),
    "a switch": ("success", 1, "success must be true or false, not a whole"),
    "a range": ("seed", -1, "seed must be a whole number >= 0"),
}


@pytest.mark.parametrize("case", WRONG_KINDS)
def test_a_value_of_a_wrong_kind_is_refused(case, tmp_path):
    key, value, message = WRONG_KINDS[case]
    path = tmp_path / "fit.json"
    made_result().save(path)
    changed(path, key, value)
    with pytest.raises(ResultError, match=f"fit.json: .*{message}"):
        jm.load_result(path)


# --- presets

TASKS = (jm.Isometric, jm.PrescribedForce, jm.PrescribedMotion)
NOISES = {
    "white": jm.WhiteNoise({"K_w": 0.1 / 3, "C_w": 1e-4}, rate=200.0),
    "band-limited": jm.BandLimitedNoise(0.1 / 3, cutoff=40.0, shared=True),
    "ornstein-uhlenbeck": jm.OrnsteinUhlenbeckNoise([1.0, 2.0, 0.0, 0.0], 0.07, relative=False),
}
ENVELOPES = {
    "constant": jm.model.Constant(1.0),
    "step": jm.model.SmoothStep(0.5, start=6.0, initial=1.0),
    "ramp": jm.model.RampHold(0.5, 6.0, 4.0, 0.5, 1.0),
    "decay": jm.model.Decay(1.0, 0.2, 7.0, 2.0),
    "sampled": jm.model.Sampled.through(np.linspace(0, 15, 7), np.array([1.0, 2, 1, 2, 1, 2, 1])),
}


@pytest.mark.parametrize("envelope", ENVELOPES)
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("kind", TASKS)
def test_every_task_survives_saving(kind, noise, envelope, tmp_path):
    parts: dict[str, Any] = {
        "harmonic": jm.Harmonic(0.02 / 3, 7.1, 0.2, ENVELOPES[envelope]),
        "settings": jm.SpectrumSettings(detrend="linear", filter_cutoff=None, sampling="average"),
        "muscle": jm.Muscle(m_w=0.3),
        "noise": NOISES[noise],
    }
    if kind is jm.PrescribedMotion and noise != "band-limited":
        with pytest.raises(ValueError, match="cannot be used in PrescribedMotion"):
            kind(**parts)
        parts["noise"] = eqx.tree_at(lambda n: n.amplitude, NOISES[noise], np.zeros(4))
    task = kind(**parts)
    task.save(tmp_path / "task.toml", description='with "quotes" and σ')
    assert_equal(jm.load_preset(tmp_path / "task.toml"), task)


def test_laws_initial_state_and_inputs_survive_saving(tmp_path):
    task = jm.PrescribedForce(
        P_w=jm.model.RampHold(4.0),
        F_ext=jm.model.Sampled.through(np.linspace(0, 15, 7), np.arange(7.0)),
        initial=(1 / 3, 0.0, 0.0, -0.1),
        muscle=jm.Muscle(argument="elongation"),
    )
    task.save(tmp_path / "task.toml")
    assert_equal(jm.load_preset(tmp_path / "task.toml"), task)


def test_arrays_of_jax_are_saved_as_numbers(tmp_path, x64):
    task = jm.Isometric().replace(k_w=jnp.asarray(1e6 / 3), noise_K_w=jnp.asarray(0.2))
    task.save(tmp_path / "task.toml")
    loaded = jm.load_preset(tmp_path / "task.toml")
    assert type(loaded["k_w"]) is float and loaded["k_w"] == 1e6 / 3
    assert isinstance(loaded.noise.amplitude, np.ndarray) and loaded["noise_K_w"] == 0.2


def test_a_preset_holds_description_and_fit(tmp_path):
    import tomllib

    jm.Isometric().save(tmp_path / "a.toml", description="what", fit={"target": "t", "seed": 1})
    table = tomllib.loads((tmp_path / "a.toml").read_text())
    assert table["description"] == "what" and table["fit"] == {"target": "t", "seed": 1}


class Own(jm.model.AbstractLaw):
    k: float = 1.0
    smoothness = 9

    def __call__(self, x):
        return self.k * x

    def base(self):
        return self.k


class BandLimitedNoise(eqx.Module):
    """A class of another package that has the name of one of jaxmuscle's."""

    amplitude: float = 0.1


class OwnTask(jm.PrescribedForce):
    """A task of the user."""


def test_a_law_of_the_user_is_saved_by_its_name(tmp_path):
    own_law = eqx.tree_at(lambda t: t.muscle.stiffness_w, jm.Isometric(), Own())
    own_law.save(tmp_path / "a.toml")
    assert jm.load_preset(tmp_path / "a.toml") == own_law


def test_what_could_not_be_read_again_is_not_saved(tmp_path):
    """A class that has the name of another, a task of the user's own."""
    path = tmp_path / "a.toml"
    same_name = eqx.tree_at(lambda t: t.noise, jm.Isometric(), BandLimitedNoise())
    for task, name in ((same_name, "BandLimitedNoise"), (OwnTask(), "OwnTask")):
        with pytest.raises(
            PresetError, match=f"{name} is not one of jaxmuscle's own classes.*keep the code"
        ):
            task_to_table(task)
    with pytest.raises(PresetError):
        same_name.save(path)
    assert not path.exists()


def test_bundled_presets_load():
    names = jm.list_presets()
    assert names == tuple(sorted(names))
    for name in names:
        task = jm.load_preset(name)
        assert_equal(task_from_table(task_to_table(task)), task)


PRESET = task_to_table(jm.Isometric())
NOISE, SETTINGS = PRESET["noise"], PRESET["settings"]


def preset_text(**changes):
    return tomli_w.dumps({"task_table": PRESET | changes})


WRONG = {
    "unknown.toml": (None, "unknown.toml: no such file"),
    "broken.toml": ("[task_table", "broken.toml: is not valid TOML"),
    "broken.json": ("{", "broken.json: is not valid JSON"),
    "binary.toml": (b"\xff\xfe\x00", "binary.toml: is not UTF-8 text"),
    "list.json": ("[]", "list.json: holds no table, but a list"),
    "empty.toml": ("", "empty.toml: is empty"),
    "target.toml": ('name = "t"', r"has no \[task_table\]: is it a preset"),
    "task.toml": (
        preset_text(task="isometrics"),
        "task.toml: task = 'isometrics': did you mean 'isometric'",
    ),
    "key.toml": (
        preset_text(muscles=1),
        "key.toml: unknown key task.muscles: did you mean 'muscle'",
    ),
    "kind.toml": (
        preset_text(noise={"type": "WhiteNoises"}),
        "task.noise.type = 'WhiteNoises': did you mean 'WhiteNoise'",
    ),
    "value.toml": (preset_text(noise=NOISE | {"rate": -1.0}), "task.noise: .*rate = -1.0 Hz"),
    "missing.toml": (
        preset_text(noise={"type": "BandLimitedNoise", "rate": 1.0}),
        "task.noise has no key 'amplitude'",
    ),
    "entry.toml": (
        preset_text(harmonic={"type": "Harmonic", "amplitudes": 1}),
        "task.harmonic.amplitudes: did you mean",
    ),
    "setting.toml": (
        preset_text(settings=SETTINGS | {"overlap": 1.5}),
        "setting.toml: task.settings: overlap=1.5: give",
    ),
    "initial.toml": (preset_text(initial=[1.0]), "initial has 1 entries"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_presets(name, tmp_path):
    text, message = WRONG[name]
    if text is not None:
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(PresetError, match=message):
        jm.load_preset(tmp_path / name)


NOT_TABLES = {
    "a number for a table": {"muscle": 1.0},
    "a table for a number": {"x_z": {"type": "Constant", "level": 1.0}},
    "a number for yes or no": {"noise": NOISE | {"shared": 1}},
    "a text for a number": {"x_z": "far"},
    "a ragged list": {"noise": NOISE | {"amplitude": [[1], 1, 1, 1]}},
}


@pytest.mark.parametrize("case", NOT_TABLES)
def test_values_of_the_wrong_kind(case, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(preset_text(**NOT_TABLES[case]))
    with pytest.raises(PresetError, match=r"a\.toml: "):
        jm.load_preset(path)


def test_an_unknown_preset_names_the_nearest(monkeypatch):
    from jaxmuscle.response import _presets as _preset

    monkeypatch.setattr(_preset, "list_presets", lambda: ("zagrodny-hamilton", "zagrodny-slifkin"))
    with pytest.raises(
        PresetError, match=r"'zagrodny-slifki': did you mean 'zagrodny-slifkin'.*or give a path"
    ):
        jm.load_preset("zagrodny-slifki")


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ((11.968, 12.0628), "11.968 to 12.063"),  # three digits of each would say 12 to 12.1
        ((0.6381, 1.2812), "0.64 to 1.28"),  # as many places as 1.00 ± 0.10
        ((-0.0004, 0.0), "-0.00040 to 0.00000"),
        ((1e5, 1e5), "100000 to 100000"),
        ((0.3112, None), "above 0.31"),
        ((None, 12.0628), "below 12.06"),
        ((None, None), "open"),
    ],
)
def test_the_ends_of_an_interval_can_be_told_apart(ends, words):
    assert Estimate(1.0, "N", 0.1, interval=ends).interval_in_words() == words


@pytest.mark.parametrize(("share", "words"), [(0.0031, "0.3 %"), (0.35, "35 %"), (0.999, "100 %")])
def test_a_harmonic_that_may_be_elsewhere_says_with_which_probability(share, words):
    """A small one is not rounded to nothing, and the limit stands beside it."""
    said = may_be_elsewhere(share)
    assert f"a probability of {words} it is more than a bin" in said
    stated = "So no standard errors are stated for the harmonic"
    assert said.endswith(
        f"{stated} (a probability above 0.1 % is enough for that)" if share < 0.1 else stated
    )
