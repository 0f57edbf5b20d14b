"""Levels of contraction and sizes: what similarity makes exact, and what is published about the
variation of force."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import at_once

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.response._scaling import relative_variation
from jaxmuscle.spectra._settings import WINDOW

LEVELS = np.array([5, 10, 20, 25, 30, 35, 40, 60, 80, 90, 95]) / 100  # the range of [30]
SIZES = (0.5, 0.8, 1.0, 1.25, 2.0)
TASKS = {
    "isometric": jm.Isometric(),
    "ornstein-uhlenbeck": jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise(), P_w=8.0),
    "absolute noise": jm.Isometric(
        noise=jm.BandLimitedNoise([20.0, 1.0, 0.1, 0.1], relative=False)
    ),
    "prescribed-force": jm.PrescribedForce(F_ext=jm.model.Constant(1.0)),
    "prescribed-motion": jm.load_preset("zagrodny-slifkin"),
}
EXACT = 1e-10  # float64, through a root search to 1e-12


def moments(task):
    return expected_moments(as_arrays(task), task.settings, WINDOW)[0]


def variation(task):
    return float(moments(task).variation)


def assert_same(one, other, rtol=EXACT):
    assert one.parameter_names == other.parameter_names
    for name in one.parameter_names:
        np.testing.assert_allclose(one[name], other[name], rtol=rtol, err_msg=name)


# --- level of contraction


def test_the_law_of_variation_has_its_extremes_where_people_have_them():
    fine = np.arange(50, 951) / 1000
    law = np.array([float(relative_variation(level)) for level in fine])
    assert fine[law.argmin()] == 0.3 and law.min() == 1.0
    assert fine[law.argmax()] == 0.95
    at = 0.2, 0.6
    deviation = [level * relative_variation(level) for level in at]
    # A standard deviation exponential in force (Slifkin & Newell 1999), growing by e per steadiest
    # level.
    assert np.log(deviation[1] / deviation[0]) == pytest.approx((at[1] - at[0]) / 0.3, rel=1e-12)


def test_the_steadiest_level_and_the_contrast_are_free():
    law = [float(relative_variation(level, steadiest=0.35, contrast=0.5)) for level in LEVELS]
    assert LEVELS[np.argmin(law)] == pytest.approx(0.35)
    assert law[0] == pytest.approx(relative_variation(0.05, steadiest=0.35) ** 0.5)
    assert relative_variation(0.9, contrast=0.0) == 1.0


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_variation_of_the_output_is_smallest_near_30_and_largest_at_95_percent(x64, task):
    seen = np.array([variation(task.at_level(level, resting=0.1)) for level in LEVELS])
    assert LEVELS[seen.argmin()] == pytest.approx(0.3)
    assert LEVELS[seen.argmax()] == pytest.approx(0.95)
    law = [relative_variation(level) for level in LEVELS]
    np.testing.assert_allclose(seen / seen.min(), law, rtol=1e-8)


def test_simulated_variation_follows_the_law(x64):
    steady, weak, strong = (jm.Isometric().at_level(level).settled() for level in (0.3, 0.05, 0.95))
    seen = []
    for task in (steady, weak, strong):
        force = np.asarray(jm.ensemble(task, jax.random.key(4), seeds=64).between(), dtype=float)
        seen.append(np.sqrt(force.var(axis=1).mean()) / force.mean())
    # A seed's variance scatters by 0.2, so the root over 64 seeds by about 1.3 %, a ratio of two by
    # 2 %; three of these.
    assert seen[1] / seen[0] == pytest.approx(relative_variation(0.05), rel=0.06)
    assert seen[2] / seen[0] == pytest.approx(relative_variation(0.95), rel=0.06)


def test_one_and_seven_tenths_percent_at_the_steadiest_level_stay_within_what_people_show(x64):
    # Taylor, Christou & Enoka 2003: 1.7 % near 30 % MVC; bundled recordings: 1.3 % at 26 % MVC, 1.3
    # and 3.4 % at 45 % MVC.
    at = {level: 1.7 * relative_variation(level) for level in (0.05, 0.26, 0.45, 0.95)}
    assert 1.3 < at[0.26] < at[0.45] < 3.4
    assert 1.3 < at[0.95] < 5.0 and 1.3 < at[0.05] < 5.0


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_reference_is_the_task_itself_and_steps_add_up(x64, task):
    assert_same(task.at_level(0.4, reference=0.4), task)
    law = {"steadiest": 0.33, "resting": 0.2, "damping": 0.7}
    there = task.at_level(0.9, reference=0.25, **law)
    assert_same(
        task.at_level(0.5, reference=0.25, **law).at_level(0.9, reference=0.5, **law),
        there,
        rtol=1e-8,
    )


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_without_resting_stiffness_forces_follow_the_level_and_nothing_moves(x64, task):
    high = task.at_level(0.9)
    np.testing.assert_allclose(
        jm.response.equilibrium(high), jm.response.equilibrium(task), rtol=1e-9, atol=1e-12
    )
    ratio = float(moments(high).mean / moments(task).mean)
    assert ratio == pytest.approx(3.0 if task.output_unit == "N" else 1.0, rel=1e-9)


def test_the_spectrum_keeps_its_maximum_at_every_level(x64):
    """[30]: the maximum of power is at the same frequency at every level, proportional power varies
    slightly."""
    spectra = [
        np.asarray(jm.expected_spectrum(jm.Isometric().at_level(level)).proportional)
        for level in LEVELS[1:]
    ]
    assert len({int(p.argmax()) for p in spectra}) == 1
    steady = spectra[4]
    # Half the summed difference is the share of power that moves to other bins: less than a tenth
    # from 10 to 95 % MVC.
    assert max(0.5 * np.abs(p - steady).sum() for p in spectra) < 0.1


def test_damping_keeps_the_corner_or_the_damping_ratio(x64):
    task = jm.Isometric()
    for exponent, kept in ((1.0, 1.0), (0.5, 0.5)):
        before, after = task.muscle.base(), task.at_level(0.6, damping=exponent).muscle.base()
        np.testing.assert_allclose(after[2:] / before[2:], (after[:2] / before[:2]) ** kept)


def test_every_size_of_an_input_follows_and_its_times_stay():
    task = jm.Isometric(P_w=jm.model.RampHold(4.0, start=1.0, ramp=3.0, initial=2.0))
    moved = task.at_level(0.6).P_w
    assert (moved.level, moved.initial) == (8.0, 4.0)
    assert (moved.start, moved.ramp, moved.corner) == (1.0, 3.0, 0.2)


# --- size


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_variation_falls_with_strength(x64, task):
    seen = np.array([variation(task.scaled(size)) for size in SIZES])
    assert np.all(np.diff(seen) < 0)
    slope = np.polyfit(np.log(np.square(SIZES)), np.log(seen), 1)[0]
    assert slope == pytest.approx(-0.25, abs=1e-8)
    assert variation(task.scaled(2.0, strength_exponent=0.5)) == pytest.approx(variation(task) / 2)


@pytest.mark.parametrize("exponent", [1.0, 0.0])
def test_similar_muscles_have_similar_equilibria_and_rates(x64, exponent):
    task = jm.PrescribedForce(F_ext=1.0)
    large = task.scaled(2.0, time_exponent=exponent)
    np.testing.assert_allclose(
        jm.response.equilibrium(large), 2 * jm.response.equilibrium(task), rtol=1e-9, atol=1e-15
    )
    base = np.asarray(large.muscle.base() / task.muscle.base())
    np.testing.assert_allclose(base, [2.0, 2.0, 2.0 ** (1 + exponent), 2.0 ** (1 + exponent)])
    if exponent == 1.0:
        slopes = (jm.response.linearise(each).A for each in (task, large))
        rates, slower = (np.sort_complex(np.linalg.eigvals(A)) for A in slopes)
        np.testing.assert_allclose(slower, rates / 2, rtol=1e-6)


@pytest.mark.slow
def test_dynamic_similarity_is_exact_far_from_linear(x64):
    """Twice the size, times stretched by two: x ∝ s, force ∝ s², along the whole nonlinear run."""
    size = 2.0
    still = {f"noise_{c}": 0.0 for c in ("K_w", "K_z", "C_w", "C_z")} | {"harmonic_amplitude": 0.0}
    small = jm.PrescribedForce(
        P_w=jm.model.SmoothStep(40.0, rise=0.05), F_ext=2.0, initial=(0.002, 0.1, 0.0, -0.1)
    ).replace(**still)
    large = small.scaled(size)
    stretched = {
        n: type(s)(s.level, s.start * size, s.rise * size)
        for n, s in (("P_w", large.P_w), ("F_ext", large.F_ext))
    }
    here = np.asarray(jm.simulate(small, jax.random.key(0)).states)[:401]
    there = jm.simulate(
        large.with_parts(**stretched), jax.random.key(0), duration=8.0, dt=2e-3, rate=50.0
    )
    factors = np.array([size, 1.0, size, 1.0])
    np.testing.assert_allclose(there.states, here * factors, rtol=1e-8, atol=1e-12)
    assert np.abs(here[:, 0]).max() > 2 * float(small["x_ref_w"])


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_sizes_multiply(x64, task):
    assert_same(task.scaled(1.0), task)
    assert_same(task.scaled(1.5).scaled(1.2), task.scaled(1.8), rtol=1e-8)


# --- both


def test_derivatives_and_batches_go_through(x64):
    def change(level, size):
        task = jm.Isometric().at_level(level).scaled(size)
        return task["noise_K_w"] * task["k_w"]

    slopes = at_once(jax.jacfwd(change, argnums=(0, 1)), jnp.asarray(0.6), jnp.asarray(1.2))
    step = 1e-5
    for i, slope in enumerate(slopes):
        up, down = ([0.6, 1.2] for _ in range(2))
        up[i], down[i] = up[i] + step, down[i] - step
        assert slope == pytest.approx(float(change(*up) - change(*down)) / (2 * step), rel=1e-5)
    levels = jnp.asarray([0.1, 0.3, 0.9])
    several = at_once(jax.vmap(lambda level: jm.Isometric().at_level(level)["noise_K_w"]), levels)
    np.testing.assert_allclose(
        several,
        [jm.Isometric().at_level(float(level))["noise_K_w"] for level in levels],
        rtol=1e-8,
    )


def test_a_task_without_perturbation_stays_without(x64):
    task = jm.Isometric(noise=jm.BandLimitedNoise(0.0)).replace(harmonic_amplitude=0.0)
    for moved in (task.at_level(0.9), task.scaled(2.0)):
        assert moved["noise_K_w"] == 0.0 and moved["harmonic_amplitude"] == 0.0


def test_single_precision_gives_the_same_numbers():
    single = jm.Isometric().at_level(0.5)
    with jax.enable_x64(True):
        double = jm.Isometric().at_level(0.5)
    assert_same(single, double, rtol=1e-12)


class Toe(jm.model.AbstractLaw):
    k: float = 100.0

    def __call__(self, q):
        return self.k * (1 + q**2)


BAD = {
    "percent": (lambda: jm.Isometric().at_level(30.0), r"mvc_fraction = 30.0 .* 30 % is 0.3"),
    "zero": (lambda: jm.Isometric().at_level(0.0), "mvc_fraction = 0.0"),
    "reference": (lambda: jm.Isometric().at_level(0.3, reference=1.2), "reference = 1.2"),
    "steadiest": (lambda: jm.Isometric().at_level(0.3, steadiest=0.0), "steadiest = 0.0"),
    "contrast": (lambda: relative_variation(0.3, contrast=-1.0), "contrast = -1.0"),
    "resting": (
        lambda: jm.Isometric().at_level(0.3, resting=1.0),
        r"resting = 1.0 must be in \[0, 1\)",
    ),
    "no force": (
        lambda: jm.PrescribedMotion(F_ext=0.0).at_level(0.3),
        "F_ext of this PrescribedMotion = 0.*give F_ext",
    ),
    "size": (lambda: jm.Isometric().scaled(0.0), "size = 0.0 must be positive"),
    "law": (
        lambda: jm.Isometric(muscle=jm.Muscle(stiffness_z=Toe())).scaled(2.0),
        "quadratic laws.*replace",
    ),
    "undamped": (
        lambda: jm.Isometric().replace(v_ref_w=0.0, v_ref_z=0.0).at_level(0.5),
        "undamped",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_has_no_meaning_is_refused(case):
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        call()


# --- the preset tuned to [12]


@pytest.fixture(scope="module")
def hamilton():
    return jm.load_preset("zagrodny-hamilton")


def test_the_preset_has_the_papers_noise_and_a_smaller_changing_harmonic(hamilton):
    beside = jm.load_preset("zagrodny-slifkin")
    assert "zagrodny-hamilton" in jm.list_presets()
    assert isinstance(hamilton, jm.PrescribedMotion)
    assert [hamilton[f"noise_{c}"] for c in ("K_w", "K_z", "C_w", "C_z")] == [
        0.0016,
        0.0016,
        1e-4,
        1e-4,
    ]
    assert hamilton["harmonic_amplitude"] <= 0.7 * beside["harmonic_amplitude"]
    envelope = hamilton.harmonic.envelope
    assert isinstance(envelope, jm.model.Decay)
    assert float(envelope(15.0)) < 0.5 * float(envelope(5.0))


def test_the_only_maximum_of_the_expected_force_is_bin_1(x64, hamilton):
    found = jm.spectra.peaks(jm.expected_spectrum(hamilton), min_prominence=0.0)
    assert found.maximum.bin == 1 and found.maximum.frequency == 0.390625
    assert not found.local_maxima


# --- another mean force


@pytest.mark.parametrize(
    "name", ["isometric", "ornstein-uhlenbeck", "absolute noise", "prescribed-motion"]
)
def test_a_muscle_carried_to_another_force_has_the_same_spectrum(name, x64):
    """Every force, mass, stiffness and damping times one number: the equations divided by it are
    the same."""
    before = moments(TASKS[name])
    mean = 40.0 * float(before.mean)
    after = moments(TASKS[name].at_force(mean))
    assert float(after.mean) == pytest.approx(mean, rel=EXACT)
    np.testing.assert_allclose(after.proportional, before.proportional, rtol=1e-8)
    np.testing.assert_allclose(after.variation, before.variation, rtol=1e-8)


def test_carrying_back_is_the_task_and_a_displacement_cannot_be_carried(x64):
    task = TASKS["isometric"]
    there = task.at_force(100.0)
    assert_same(there.at_force(float(moments(task).mean)), task)
    with pytest.raises(ValueError, match="the output of PrescribedForce is x_z in m, not a force"):
        TASKS["prescribed-force"].at_force(10.0)
    felt = TASKS["prescribed-force"].with_parts(observe="acceleration")
    for move in (lambda: felt.at_level(0.5), lambda: felt.scaled(2.0)):
        with pytest.raises(
            ValueError,
            match=r"an acceleration has no coefficient of variation, .* observe='displacement'",
        ):
            move()
    with pytest.raises(ValueError, match=r"of the same sign, not -3\.0 N"):
        task.at_force(-3.0)
    for still in (jm.Isometric(P_w=0.0), jm.PrescribedMotion(F_ext=0.0)):
        with pytest.raises(ValueError, match="mean force of this task is zero"):
            still.at_force(3.0)


def test_a_held_force_tells_no_length():
    """What the printed fit says: half of both x_ref, twice the stiffness k x_ref², damping and
    masses, the same force."""
    task = jm.Isometric(noise_K_w=0.2, noise_K_z=0.01)
    factors = {
        "x_ref_w": 0.5,
        "x_ref_z": 0.5,
        "k_w": 8,
        "k_z": 8,
        "c_w": 2,
        "c_z": 2,
        "m_w": 2,
        "m_z": 2,
    }
    half = task.replace(**{name: factor * task[name] for name, factor in factors.items()})
    one, other = (jm.expected_spectrum(each).power for each in (task, half))
    np.testing.assert_allclose(other, one, rtol=2e-4)  # single precision


class Held(jm.model.AbstractTask):
    """A task of the user's own: the isometric one, written anew."""

    P_w: jm.model.Constant = eqx.field(default_factory=lambda: jm.model.Constant(5.0))
    state_names = ("x_w", "v_w")
    state_units = ("m", "m/s")
    output_name = "F_ext"
    output_unit = "N"
    smoothness_needed = (0, 1, 0, 1, 0)

    def vector_field(self, t, y, u):
        force = self.muscle.drive(self.P_w(t), u) - self.muscle.active_force(y[0], y[1], u)
        return jnp.stack([y[1], (force - self.output(t, y, u, u)) / self.muscle.m_w])

    def output(self, t, y, u, du):
        return -self.muscle.passive_force(y[0], y[1], 0.0, 0.0, u)


def test_a_task_of_ones_own_has_the_methods(x64):
    own, ours = Held(), jm.Isometric(jm.model.Constant(5.0))
    for change in (
        lambda task: task.at_force(40.0),
        lambda task: task.at_level(0.6),
        lambda task: task.scaled(1.2),
        lambda task: task.settled(),
    ):
        moved, expected = change(own), change(ours)
        assert type(moved) is Held
        np.testing.assert_allclose(
            [*moved.parameters.values()], [expected[n] for n in moved.parameters]
        )
        np.testing.assert_allclose(moved.initial or 0.0, expected.initial or 0.0)
