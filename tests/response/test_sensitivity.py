"""The sensitivity table against finite differences of the expected spectrum, and its heat map."""

import functools

import numpy as np
import pytest

import jaxmuscle as jm

TASK = jm.Isometric()


@functools.cache
def whole():
    """That of all parameters: half a minute of compiling."""
    return jm.response.sensitivity(TASK)


def test_every_entry_is_a_difference_quotient(x64):
    names = ("k_w", "c_z", "noise_K_w", "harmonic_frequency", "x_z")
    found = jm.response.sensitivity(TASK, names)
    for row, name in enumerate(names):
        value = float(TASK[name])
        h = 1e-5 * (value or 1e-2)
        up, down = (
            np.asarray(jm.expected_spectrum(TASK.replace(**{name: value + side * h})).power)
            for side in (1, -1)
        )
        factor = value if found.relative[row] else 1.0
        absolute = factor * (np.log(up) - np.log(down)) / (2 * h)
        share = factor * (np.log(up / up.sum()) - np.log(down / down.sum())) / (2 * h)
        # Rounding 1e-13 / 1e-5 and truncation h² times the third derivative, largest for a line
        # that crosses a bin.
        np.testing.assert_allclose(
            found.power[row], absolute, rtol=1e-5, atol=1e-6 * np.abs(absolute).max()
        )
        np.testing.assert_allclose(
            found.proportional[row], share, rtol=1e-5, atol=1e-6 * np.abs(share).max()
        )
    assert list(found.relative) == [True, True, True, True, False]


def test_the_scale_of_all_perturbations_moves_power_alone():
    """Power goes with the square of noise and harmonic together; its proportions do not change."""
    names = ("noise_K_w", "noise_K_z", "noise_C_w", "noise_C_z", "harmonic_amplitude")
    rows = [whole().names.index(name) for name in names]
    np.testing.assert_allclose(whole().power[rows].sum(axis=0), 2.0, rtol=1e-9)
    np.testing.assert_allclose(whole().proportional[rows].sum(axis=0), 0.0, atol=1e-9)


def test_the_table_has_its_labels():
    table = whole().to_xarray()
    assert table["proportional"].dims == ("parameter", "frequency")
    assert list(table["parameter"].values) == list(TASK.parameter_names)
    assert table["unit"].sel(parameter="k_w") == "N/m^3"
    assert float(table["value"].sel(parameter="c_w")) == float(TASK["c_w"])
    np.testing.assert_allclose(table["frequency"], TASK.settings.frequency)
    said = {name: value for name, value, _ in whole()._card().rows}
    # a share has no unit
    assert said["x_ref_w"] == "0.02 m" and said["noise_K_w"] == f"{float(TASK['noise_K_w']):.4g}"


def test_the_heat_map_names_what_matters():
    ax = whole().plot()
    labels = [text.get_text() for text in ax.get_yticklabels()]
    assert "k_w" in labels and "x_z *" in labels
    assert "m_z" not in labels  # the insertion is held: its mass does nothing
    assert ax.get_xlabel() == "Frequency (Hz)"


def test_an_unknown_parameter_is_named():
    with pytest.raises(ValueError, match=r"unknown parameter 'k_x': did you mean 'k_"):
        jm.response.sensitivity(TASK, ("k_x",))
