"""One name for a parameter everywhere, and tasks that print as tables of them."""

import copy
import pickle
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.model import TASKS
from jaxmuscle.objective._arguments import free_names
from jaxmuscle.objective._options import FitOptions

TREMOR = jm.model.on_rung(jm.Isometric(), 2)
KINDS = list(TASKS.values())


def rows_of(task):
    """Cells of the table: name, value with unit, and whether a fit moves it."""
    return dict(re.findall(r"^  (\w+) .*? (free|fixed)(?: |$)", str(task), re.MULTILINE))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_parameter_is_an_argument_an_attribute_and_an_item(kind):
    plain = kind()
    for name in plain.parameter_names:
        value = 1.5 * float(plain[name]) + 0.01 * (float(plain[name]) == 0)
        made = kind(**{name: value})
        assert eqx.tree_equal(made, plain.replace(**{name: value})) and float(made[name]) == value
        if name not in ("P_w", "F_ext", "x_z"):  # fields: there an attribute is the signal
            assert float(getattr(made, name)) == value and name in dir(made)


def test_what_follows_from_parameters_can_be_read_only():
    task = jm.Isometric(k_w=4e5, x_ref_w=0.03, c_z=7.0)
    assert float(task["K_w0"]) == pytest.approx(4e5 * 0.03**2) and float(
        task.C_z0
    ) == pytest.approx(7.0)
    for change in (lambda: task.replace(K_w0=1.0), lambda: jm.Isometric(K_w0=1.0)):
        with pytest.raises(ValueError, match=r"K_w0 is not a parameter.*Give k_w instead"):
            change()


def test_names_that_results_use_are_taken_too():
    task = TREMOR.replace(contraction_time=0.05)
    assert task["activation_time"] == task.contraction_time == task.activation_time == 0.05
    same = "contraction_time and activation_time are the same parameter"
    with pytest.raises(ValueError, match=same):
        TREMOR.replace(contraction_time=0.05, activation_time=0.06)
    options = FitOptions(
        free=["contraction_time"],
        priors={"contraction_time": 0.5},
        bounds={"contraction_time": (0.01, 0.1)},
    )
    assert options.free == ("activation_time",) and options.priors == {"activation_time": 0.5}
    assert options.bounds == {"activation_time": (0.01, 0.1)}


def test_a_tremor_is_measured_and_the_model_has_a_resonance():
    """`tremor_frequency` is of the recording: no parameter has that name."""
    for name in ("tremor_frequency", "tremor_width"):
        with pytest.raises(ValueError, match=f"unknown parameter '{name}'"):
            TREMOR.replace(**{name: 2.0})


@pytest.mark.parametrize(
    ("wrong", "near"), [("kw", "k_w"), ("K_w", "k_w"), ("noise_k_z", "noise_K_z")]
)
def test_a_wrong_name_is_told_the_near_one(wrong, near):
    task = jm.Isometric()
    told = rf"unknown parameter '{wrong}' of Isometric: did you mean '{near}"
    for use in (
        lambda: task[wrong],
        lambda: task.replace(**{wrong: 1.0}),
        lambda: jm.Isometric(**{wrong: 1.0}),
    ):
        with pytest.raises(ValueError, match=told):
            use()
    with pytest.raises(AttributeError, match=told):
        getattr(task, wrong)
    assert not hasattr(task, wrong)


def test_a_task_can_be_copied_and_pickled():
    task = jm.Isometric(k_w=4e5)
    assert eqx.tree_equal(copy.deepcopy(task), task) and eqx.tree_equal(
        pickle.loads(pickle.dumps(task)), task
    )


def test_a_noise_by_its_name_is_on_what_the_task_can_have_it_on():
    """White noise has no value, and the measured force contains the noise on K_z and C_z
    directly."""
    task = jm.Isometric(k_w=4e5, noise="white")
    assert isinstance(task.noise, jm.WhiteNoise)
    assert [float(task[f"noise_{c}"]) for c in ("K_w", "K_z", "C_w", "C_z")] == [
        0.15,
        0.0,
        1e-4,
        0.0,
    ]
    assert float(jm.PrescribedForce(noise="white").noise_K_z) == 0.005
    assert isinstance(jm.Isometric().with_parts(noise="pink").noise, jm.PinkNoise)
    with pytest.raises(ValueError, match="WhiteNoise on K_z cannot be used in Isometric"):
        jm.Isometric(noise="white", noise_K_z=0.01)
    with pytest.raises(ValueError, match="cannot be used in PrescribedMotion"):
        jm.PrescribedMotion(noise="white")
    with pytest.raises(ValueError, match="noise = 'pnk': did you mean 'pink'"):
        jm.Isometric(noise="pnk")


def test_arguments_by_name_go_through_jax():
    made = jax.vmap(lambda k: jm.Isometric(k_w=k, noise_K_w=2 * k))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(made.muscle.stiffness_w.k, [0.1, 0.2])
    np.testing.assert_allclose(np.asarray(made.noise.amplitude)[:, 0], [0.2, 0.4], rtol=1e-6)
    assert float(jax.grad(lambda k: jm.Isometric(k_w=k).k_w ** 2)(3.0)) == 6.0
    with pytest.raises(ValueError, match="outside"):
        jm.Isometric(k_w=-1.0)


@pytest.mark.parametrize(
    "task", [*(kind() for kind in KINDS), TREMOR], ids=lambda task: type(task).__name__
)
def test_a_task_prints_as_a_table(task):
    text = str(task)
    assert repr(task) == text and max(map(len, text.splitlines())) <= 80
    assert set(rows_of(task)) == set(task.parameter_names)
    assert re.search(r"\n  k_w +5e\+05 +N/m\^3 +free +active stiffness factor\n", text)


def test_what_the_table_calls_free_a_fit_moves():
    """Also where an amplitude is 0: nothing shows the frequency then."""
    target = jm.Target("flat", np.ones(30), segments=12)
    for task in (jm.Isometric(), jm.Isometric(harmonic_amplitude=0.0), TREMOR):
        free = {name for name, state in rows_of(task).items() if state == "free"}
        assert free == set(free_names(task, None, {}, target))


def test_a_task_prints_while_jax_traces_it():
    """With kinds in place of values, and without a computation of its own."""
    printed = []

    def seen(task):
        printed.append(repr(task))
        return task.k_w

    arrays = jax.tree.map(jnp.asarray, jm.Isometric())
    silent, loud = jax.make_jaxpr(lambda task: task.k_w)(arrays), jax.make_jaxpr(seen)(arrays)
    assert len(loud.eqns) == len(silent.eqns) and re.search(
        r"\n  k_w +\S*f32\[\] +N/m\^3 ", printed[0]
    )
    many = jax.vmap(lambda k: jm.Isometric(k_w=k))(jnp.array([1e5, 2e5]))
    assert "1e+05 to 2e+05" in repr(many) and "2 of 60" in repr(many)
    numbers, rest = eqx.partition(arrays, eqx.is_array)
    assert repr(numbers) and repr(rest) and repr(jax.tree.map(lambda _: None, arrays))
    assert repr(eqx.tree_at(lambda t: t.noise, arrays, None)).startswith("Isometric(")


def test_a_notebook_shows_a_table_and_escapes_what_files_said():
    html = jm.Isometric()._repr_html_()
    assert html.count("<tr>") == 1 + len(jm.Isometric().parameter_names) and "<td" in html
    wild = "<script>alert(1)</script> & co"
    recording = jm.Recording(np.sin(np.arange(3000.0)) + 3, 100.0, name=wild)
    for shown in (
        recording,
        jm.data.Trials([recording]),
        jm.Target(wild, np.ones(30), segments=12),
    ):
        html = shown._repr_html_()
        assert (
            "<script" not in html
            and "&lt;script&gt;alert(1)&lt;/script&gt; &amp; co" in html
            and "<table>" in html
        )
        assert repr(shown) == str(shown) and wild in str(shown)


@pytest.mark.parametrize("several", [np.array([1e5, 2e5]), jnp.ones((1,))])
def test_a_parameter_is_one_number(several):
    with pytest.raises(
        ValueError,
        match=r"k_w has the shape \(.*,\): a parameter is one number.*Sweep\.grid\(task, k_w=",
    ):
        jm.Isometric().replace(k_w=several)


def test_spectra_sweeps_and_sensitivities_say_what_they_are():
    """As text where they are printed; taken apart, or while JAX traces them, as their trees."""
    spectrum = jm.expected_spectrum(jm.Isometric())
    k = int(np.argmax(spectrum.power))
    assert (
        f"bin at {spectrum.frequency[k]:.3g} Hz, {100 * spectrum.proportional[k]:.3g} % of the"
        " power" in repr(spectrum)
    )
    assert "density [N^2/Hz]" in str(spectrum) and "30, 0.391 to 11.7 Hz" in str(spectrum)
    assert "[(m/s^2)^2/Hz]" in str(jm.expected_spectrum(jm.PrescribedForce(observe="acceleration")))
    several = jm.spectra.spectrum_of(
        np.random.default_rng(0).normal(size=(3, 1500)), jm.SpectrumSettings()
    )
    assert "spectra   3; below, their mean" in str(several) and "<table>" in several._repr_html_()
    sweep = jm.ensembles.Sweep.grid(jm.Isometric(), k_w=[4e5, 5e5], noise_K_w=[0.1, 0.2, 0.3])
    assert str(sweep).splitlines()[
        0
    ] == "sweep of Isometric: 6 points" and "0.1 to 0.3, 3 values" in str(sweep)
    assert "k_w        4e+05 to 5e+05 N/m^3, 2 values" in str(sweep)
    table = jm.response.sensitivity(jm.Isometric(), ("c_w", "harmonic_phase", "harmonic_frequency"))
    lines, slopes = str(table).splitlines(), np.abs(table.proportional)
    assert [line.split()[0] for line in lines[2:]] == [
        "harmonic_frequency",
        "c_w",
        "harmonic_phase",
    ]  # by size; no relative last
    assert f"{slopes[0].max():.3g} % for 1 % more" in lines[3] and " % per rad, " in lines[4]
    for shown in (spectrum, sweep):
        assert repr(jax.tree.map(lambda _: None, shown)) and repr(
            eqx.partition(shown, eqx.is_array)[1]
        )
    mapped = jax.vmap(lambda k: jm.expected_spectrum(jm.Isometric(k_w=k)))(jnp.array([4e5, 5e5]))
    assert "spectra   2; below, their mean" in repr(mapped)
