"""Static characteristics against the laws in closed form, for the paper's muscle and for a
user's."""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.response._characteristics import StaticCharacteristics, static_characteristics

EXACT = {"rtol": 1e-12, "atol": 1e-12}


class Tendon(jm.model.AbstractMuscle):
    """A user's muscle: linear active spring with an offset, exponential passive one, linear
    dampers."""

    m_w: float = 0.5
    m_z: float = 0.5
    stiffness: float = 300.0
    damping: float = 40.0

    def base(self):
        return np.array([self.stiffness, 200.0, self.damping, 5.0])

    def active_force(self, x_w, v_w, u):
        return 1.0 + (self.stiffness + u[0]) * x_w + (self.damping + u[2]) * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        stretch = x_z - x_w
        return (
            2.0 * (1.0 - 2.718281828459045 ** (-100.0 * stretch))
            + u[1] * stretch
            + (5.0 + u[3]) * (v_z - v_w)
        )

    def contraction_velocity(self, x_w, x_z, v_z, force, u):
        return v_z - (
            force - 2.0 * (1.0 - 2.718281828459045 ** (-100.0 * (x_z - x_w))) - u[1] * (x_z - x_w)
        ) / (5.0 + u[3])


@pytest.mark.parametrize("argument", ["literal", "elongation"])
def test_the_papers_laws_are_found(argument):
    task = jm.Isometric(muscle=jm.Muscle(argument=argument)).replace(
        k_z=3e5, c_w=50.0, x_ref_w=0.01
    )
    seen = static_characteristics(task, span=0.03, speed=2.0)
    x, v = seen.displacement, seen.velocity
    np.testing.assert_allclose(x, np.linspace(-0.03, 0.03, 201), **EXACT)
    np.testing.assert_allclose(v, np.linspace(-2, 2, 201), **EXACT)
    np.testing.assert_allclose(seen.K_w, 5e5 * (0.01**2 + x**2), **EXACT)
    np.testing.assert_allclose(seen.K_z, 3e5 * (0.02**2 + x**2), **EXACT)
    np.testing.assert_allclose(seen.K_w_tangent, 5e5 * (0.01**2 + 3 * x**2), **EXACT)
    np.testing.assert_allclose(seen.C_w, 50 * (1 + v**2), **EXACT)
    np.testing.assert_allclose(seen.C_z_tangent, 5 * (1 + 3 * v**2), **EXACT)
    np.testing.assert_allclose(seen.F_z, seen.K_z * x, **EXACT)


def test_force_at_the_insertion_solves_the_statics():
    seen = static_characteristics(jm.Isometric(), points=41)
    for x, force, P in [
        *zip(seen.displacement, seen.F_ext, [0.0] * 41, strict=True),
        *zip(seen.displacement, seen.F_ext_active, [5.0] * 41, strict=True),
    ]:
        # k (x_ref² + x_w²) x_w + K_z(x) (x_w - x) = P with the paper's K_z at x_z = x
        k, ref = 5e5, 0.02
        K_z = k * (ref**2 + x**2)
        roots = np.roots([k, 0.0, k * ref**2 + K_z, -P - K_z * x])
        x_w = float(roots[np.abs(roots.imag) < 1e-9].real[0])
        assert force == pytest.approx(K_z * (x_w - x), abs=1e-9)


@pytest.mark.parametrize("kind", [jm.Isometric, jm.PrescribedForce, jm.PrescribedMotion])
def test_the_operating_point_is_the_tasks(kind):
    task = kind()
    seen = static_characteristics(task)
    middle = np.interp(seen.x_z, seen.displacement, seen.F_ext_active)
    load = {"Isometric": middle, "PrescribedForce": 0.0, "PrescribedMotion": 10.0}[kind.__name__]
    # that one in single precision
    assert seen.x_w == pytest.approx(float(jm.response.equilibrium(task)[0]), rel=1e-4)
    # Straight lines between 201 points of a curve that bends by 1e5 N/m² over steps of 2e-4 m.
    assert middle == pytest.approx(load, abs=2e-3)


def test_a_users_muscle_is_seen_through_its_methods():
    seen = static_characteristics(jm.Isometric(muscle=Tendon()), span=0.02)
    x = seen.displacement
    np.testing.assert_allclose(seen.K_w, 300.0, rtol=1e-10)
    np.testing.assert_allclose(seen.F_w, 1.0 + 300.0 * x, rtol=1e-12)
    np.testing.assert_allclose(seen.F_z, 2 * (1 - np.exp(-100 * x)), atol=1e-12)
    np.testing.assert_allclose(seen.K_z_tangent, 200 * np.exp(-100 * x), rtol=1e-10)
    assert seen.K_z[100] == pytest.approx(200.0)  # the limit at zero displacement
    np.testing.assert_allclose(seen.C_w, 40.0, rtol=1e-10)
    np.testing.assert_allclose(seen.C_z, 5.0, rtol=1e-10)
    assert np.all(np.isfinite(seen.F_ext))
    assert len(seen.plot()) == 3
    plt.close("all")


def test_every_field_has_a_unit_and_the_range_contains_the_operating_point():
    seen = static_characteristics(jm.load_preset("zagrodny-slifkin"))
    assert set(seen.units) == {field.name for field in dataclasses.fields(seen)}
    assert seen.displacement[-1] == pytest.approx(2 * seen.x_w)


def test_the_figure_has_units_a_legend_and_the_callers_axes():
    seen = static_characteristics(jm.Isometric())
    figure, given = plt.subplots(1, 3)
    axes = seen.plot(given)
    assert list(axes) == list(given)
    assert [ax.get_xlabel() for ax in axes] == [
        "Displacement (mm)",
        "Velocity (m/s)",
        "Displacement (mm)",
    ]
    assert [ax.get_ylabel() for ax in axes] == ["Stiffness (N/m)", "Damping (N s/m)", "Force (N)"]
    np.testing.assert_allclose(axes[0].lines[0].get_ydata(), seen.K_w)
    assert all(ax.get_legend() is not None for ax in axes)
    with pytest.raises(ValueError, match="ax has 2 axes: give three"):
        seen.plot(given[:2])
    plt.close(figure)


@pytest.mark.parametrize(("P_w", "count"), [(0.0, 1), (1.0, 2), (float("nan"), 1)])
def test_the_force_under_a_drive_is_drawn_where_there_is_one(P_w, count):
    x = np.linspace(0.0, 0.01, 5)
    names = {field.name for field in dataclasses.fields(StaticCharacteristics)}
    seen = StaticCharacteristics(**dict.fromkeys(names, x) | {"P_w": P_w, "x_w": 0.002, "x_z": 0.0})
    figure, given = plt.subplots(1, 3)
    seen.plot(given)
    assert (
        sum(str(line.get_label()).startswith("$F_\\mathrm{ext}$") for line in given[2].lines)
        == count
    )
    plt.close(figure)


@pytest.mark.parametrize(("name", "value"), [("span", 0.0), ("speed", -1.0), ("points", 2)])
def test_bad_ranges_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} = {value}"):
        static_characteristics(jm.Isometric(), **{name: value})
