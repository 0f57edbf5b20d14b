"""The numbers of docs/limits.md on the scale of force, from the fits and the model itself."""

import json

import jax
import numpy as np
import pages
import pytest
from compiled import kept_jit

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.response._linearised import linearise
from jaxmuscle.spectra._settings import WINDOW

TEXT = " ".join((pages.ROOT / "docs" / "limits.md").read_text(encoding="utf-8").split())
KNEE, FINGER = "vastus-lateralis-26mvc", "fdi-abduction-45mvc"
RECONSTRUCTED = ("slifkin-newell-1999-35mvc", "slifkin-newell-1999-95mvc", "hamilton-2004")
PAPER = 0.0016
QUIET = {"noise_K_z": 0.0, "noise_C_w": 0.0, "noise_C_z": 0.0, "harmonic_amplitude": 0.0}
STATED = 0.05  # the page gives two digits


def fitted(name):
    """The isometric muscle of fitting/expected."""
    values = json.loads(
        (pages.ROOT / "fitting" / "expected" / f"{name}.json").read_text(encoding="utf-8")
    )["values"]
    return jm.Isometric().replace(
        **{key: row["value"] for key, row in values.items() if key in jm.model.PARAMETERS}
    )


def variation(task):
    return float(expected_moments(task, task.settings, WINDOW)[0].variation)


def damping_ratio(task):
    """C / (2 √(K m)) of `x'' = -K/m x - C/m x'`, the linearised isometric muscle."""
    A = np.asarray(linearise(as_arrays(task)).A)
    return -A[1, 1] / (2 * np.sqrt(-A[1, 0]))


def says(*words):
    assert all(word in TEXT for word in words), [word for word in words if word not in TEXT]


@pytest.mark.slow
def test_the_force_read_is_less_than_the_force_of_the_muscle(x64):
    mean = kept_jit(jax.vmap(lambda v: linearise(jm.Isometric().replace(**v)).rest))
    rng, n = np.random.default_rng(0), 2000
    drawn = {
        name: jm.model.PARAMETERS[name].default * np.exp(rng.normal(size=n))
        for name in ("k_w", "k_z")
    }
    share = np.asarray(mean(drawn | {"x_z": np.zeros(n), "P_w": np.full(n, 5.0)})) / 5.0
    assert share.max() < 1 and (share.min(), share.max()) == pytest.approx(
        (0.005, 0.99), rel=STATED + 0.02
    )
    assert float(linearise(as_arrays(jm.Isometric())).rest) / 5.0 == pytest.approx(0.44, rel=STATED)
    says("44 % of P_w is left at the defaults, 0.5 to 99 % over 2000 draws")
    drawn_out = np.asarray(mean(drawn | {"x_z": np.full(n, -0.01), "P_w": np.full(n, 5.0)})) / 5.0
    assert drawn_out.max() > 1


@pytest.mark.slow
def test_noise_against_the_papers(x64):
    knee, finger = fitted(KNEE), fitted(FINGER)
    found = [float(task["noise_K_w"]) for task in (knee, finger)]
    assert found == pytest.approx([0.27, 0.46], rel=STATED)
    assert np.array(found) / PAPER == pytest.approx([170, 290], rel=STATED)
    assert [variation(task) for task in (knee, finger)] == pytest.approx(
        [0.013, 0.018], rel=STATED + 0.02
    )
    alone = [variation(task.replace(**QUIET, noise_K_w=PAPER)) for task in (knee, finger)]
    assert alone == pytest.approx([8e-5, 7e-5], rel=0.1)  # one digit
    everything = QUIET | {
        "noise_K_w": PAPER,
        "noise_K_z": PAPER,
        "noise_C_w": 1e-4,
        "noise_C_z": 1e-4,
    }
    assert [variation(task.replace(**everything)) for task in (knee, finger)] == pytest.approx(
        [0.0013] * 2, rel=STATED
    )
    says("noise of 27 %", "and 46 %", "170 and 290 times", "0.008 and 0.007 %", "0.13 %")


@pytest.mark.slow
def test_damping_ratios(x64):
    ratios = {name: damping_ratio(fitted(name)) for name in (KNEE, FINGER, *RECONSTRUCTED)}
    assert (ratios[KNEE], ratios[FINGER]) == pytest.approx((3.3, 6.5), rel=STATED)
    reconstructed = [ratios[name] for name in RECONSTRUCTED]
    assert (min(reconstructed), max(reconstructed)) == pytest.approx((1.8, 6.4), rel=STATED)
    assert damping_ratio(jm.Isometric()) == pytest.approx(1.9, rel=STATED)
    says(
        "is 3.3 and 6.5 in those fits, 1.8 to 6.4 in those of the reconstructed spectra, 1.9 at the"
        " defaults"
    )


@pytest.mark.slow
def test_a_quick_muscle_with_slow_noise_fits_as_well(x64):
    """Of one target; the other's numbers were found in the same way."""
    target = jm.load_target(FINGER)
    quick = {"m_w": 0.05, "c_w": 5.0, "c_z": 5.0}
    result = jm.fit(
        jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise()), target, fix=quick, check_seeds=0
    )
    assert result.success
    A = np.asarray(linearise(as_arrays(result.task)).A)
    assert damping_ratio(result.task) == pytest.approx(1.1, rel=STATED)
    assert 9 < np.abs(np.linalg.eigvals(A).real).min() / (2 * np.pi) < 13
    assert 1 / (2 * np.pi * float(result.task["noise_correlation_time"])) == pytest.approx(
        0.33, rel=STATED
    )
    expected = json.loads(
        (pages.ROOT / "fitting" / "expected" / f"{FINGER}.json").read_text(encoding="utf-8")
    )
    assert result.chi2_per_bin == pytest.approx(0.91, rel=STATED)
    assert result.chi2_per_bin < expected["values"]["chi2_per_bin"]["value"]
    says(
        "corner at 0.91 and 0.33 Hz",
        "per bin 1.18 and 0.91, the default muscle with band-limited noise 1.18 and 0.98",
    )
