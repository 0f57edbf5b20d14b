"""The programs of the design document run as written."""

import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxmuscle as jm


@pytest.mark.slow
def test_fit_and_what_it_predicts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    program = """
import jax, jaxmuscle as jm
target = jm.load_target("vastus-lateralis-26mvc")
result = jm.fit(jm.task_for(target), target)
print(result); result.plot(); result.save("fit.json")
runs = jm.ensemble(result.task, jax.random.key(0), seeds=1000)
runs.spectrum().plot(); runs.to_xarray()
assert jm.load_result("fit.json").message == result.message
assert result.success and result.chi2_per_bin <= 1.3
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "vastus-lateralis-26mvc" in done.stdout
    assert (tmp_path / "fit.json").exists()


@pytest.mark.slow
def test_own_recording(tmp_path, monkeypatch):
    """A trial as a force sensor writes it: 2048 Hz, rest, ramp, hold of a known task, release."""
    monkeypatch.chdir(tmp_path)
    truth = jm.Isometric().replace(harmonic_frequency=6.0, harmonic_amplitude=0.012)
    run = jm.simulate(jm.settled(truth), jax.random.key(5), duration=40.0, rate=1000.0)
    held = np.interp(np.arange(40 * 2048) / 2048, run.time, np.asarray(run.output, dtype=float))
    level = held.mean()
    force = np.concatenate([np.zeros(4096), level * np.linspace(0, 1, 4096), held, level * np.linspace(1, 0, 2048)])
    rows = "".join(f"{k / 2048:.6f},{f:.6f}\n" for k, f in enumerate(force))
    (tmp_path / "trial.csv").write_text("time,force\n" + rows)

    recording = jm.load_recording("trial.csv", column="force", rate=2048, units="N")
    result = jm.fit(jm.Isometric(), recording.steady().target())

    assert result.success and result.target.segments is not None
    assert abs(result.parameters["harmonic_frequency"].value - 6.0) < 0.25 * 0.390625
    variation = result.derived["coefficient_of_variation"]
    expected = jm.ensemble(jm.settled(truth), jax.random.key(0), seeds=32).between()
    spread = np.mean(np.std(np.asarray(expected), axis=1)) / np.mean(expected)
    assert variation.stderr is not None and abs(variation.value - spread) < 3 * variation.stderr


def test_the_papers_tasks():
    task1 = jm.load_preset("zagrodny-slifkin")
    ax = jm.simulate(task1, jax.random.key(1)).plot()
    task2 = task1.as_task(jm.PrescribedForce)
    assert "P" in ax.get_ylabel()
    assert task2.muscle is task1.muscle and task2.noise is task1.noise and task2.harmonic is task1.harmonic


def test_gradients_by_natural_name():
    task1 = jm.load_preset("zagrodny-slifkin")
    power = lambda k: jm.expected_spectrum(task1.replace(k_w=k)).proportional[10]  # noqa: E731
    slope = float(jax.grad(power)(task1["k_w"]))
    k = float(task1["k_w"])
    difference = float(power(1.01 * k) - power(0.99 * k)) / (0.02 * k)
    assert slope == pytest.approx(difference, rel=0.01)  # 1 % steps in single precision


def test_a_users_own_muscle_has_noise_spectra_and_gradients():
    from jaxmuscle import AbstractMuscle

    class Linear(AbstractMuscle):
        m_w: float = 0.5
        m_z: float = 0.5
        stiffness: float = 300.0
        damping: float = 40.0

        def base(self):
            return jax.numpy.stack([jax.numpy.asarray(v) * 1.0 for v in (self.stiffness, 200.0, self.damping, 5.0)])

        def active_force(self, x_w, v_w, u):
            return (self.stiffness + u[0]) * x_w + (self.damping + u[2]) * v_w

        def passive_force(self, x_w, v_w, x_z, v_z, u):
            return (200.0 + u[1]) * (x_z - x_w) + (5.0 + u[3]) * (v_z - v_w)

        def contraction_velocity(self, x_w, x_z, v_z, force, u):
            return v_z - (force - (200.0 + u[1]) * (x_z - x_w)) / (5.0 + u[3])

    for kind in (jm.Isometric, jm.PrescribedForce, jm.PrescribedMotion):
        task = kind(muscle=Linear())
        assert task["stiffness"] == 300.0
        power = jm.ensemble(task, jax.random.key(0), seeds=8).spectrum().mean().proportional
        assert np.all(np.isfinite(power))

    def floor(stiffness):
        moved = jm.simulate(jm.Isometric(muscle=Linear()).replace(stiffness=stiffness), jax.random.key(0))
        return moved.spectrum().power[10]

    assert np.isfinite(jax.grad(floor)(300.0))


@pytest.mark.slow
def test_how_sure_and_which_noise():
    program = """
import jax, jaxmuscle as jm
target = jm.load_target("vastus-lateralis-26mvc")
result = jm.fit(jm.task_for(target), target)
found = jm.posterior(result, target, key=jax.random.key(2)); summary = found.summary()
comparison = jm.compare_noise(jm.Isometric(), target)
assert "white" in comparison.left_out
assert found.divergences == 0
for name, derived in result.derived.items():
    if derived.stderr is not None:  # the least-squares estimate lies in the bulk of the posterior
        assert summary[name]["low"] < derived.value < summary[name]["high"], name
        assert summary[name]["r_hat"] <= 1.01, name
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
