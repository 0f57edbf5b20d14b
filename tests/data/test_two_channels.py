"""Files of force and displacement are recognised by their columns, those of a frequency response by
theirs."""

import numpy as np
import pytest
from recorded import save_columns

import jaxmuscle as jm
from jaxmuscle.data import as_target
from jaxmuscle.data._recording_files import read_table
from jaxmuscle.data._two_channels import movement, perturbed_recordings, two_channels

ROWS = 3000
FORCE = 40 + np.sin(np.arange(ROWS) / 7.0)
MOVED = 1e-3 * np.sin(np.arange(ROWS) / 7.0)


def written(folder, *names, name="x.csv"):
    """A file with a time and these columns: force where a name begins so, else displacement."""
    columns = [
        np.arange(ROWS) / 100,
        *(FORCE if n.casefold().startswith(("f", "t", "k", "b")) else MOVED for n in names),
    ]
    return save_columns(folder / name, ",".join(("time_s", *names)), *columns, fmt="%.6g")


@pytest.mark.parametrize(
    "names",
    [
        ("force_N", "displacement_mm"),
        ("displacement_mm", "force_N"),
        ("Force [N]", "Length [mm]"),
        ("Torque_Nm", "angle_deg"),
        ("Kraft / N", "Weg / mm"),
        ("F", "x_z"),
        ("board_N", "motor_mm"),
        ("force_N", "position", "battery_V"),
        ("force_N", "board_kN", "pos_mm"),
    ],
)
def test_columns_are_found_by_name_and_by_unit(tmp_path, names):
    found = two_channels(written(tmp_path, *names))
    moved = {
        "Length [mm]",
        "displacement_mm",
        "angle_deg",
        "Weg / mm",
        "x_z",
        "motor_mm",
        "position",
        "pos_mm",
    }
    pulled = next(n for n in names if n not in moved)
    assert found == {"force": pulled, "displacement": next(n for n in names if n in moved)}


@pytest.mark.parametrize(
    "names", [("force_N",), ("force_N", "battery_V"), ("displacement_mm", "angle_deg")]
)
def test_a_file_without_both_is_none(tmp_path, names):
    path = written(tmp_path, *names)
    assert two_channels(path) == {}
    assert perturbed_recordings(path, files=True) == ()


def test_several_that_may_be_meant_are_named(tmp_path):
    path = written(tmp_path, "force_N", "motor_mm", "target_mm")
    with pytest.raises(
        ValueError, match=r"displacement columns='motor_mm, target_mm'.*give `displacement`"
    ):
        two_channels(path)
    assert two_channels(path, displacement="motor_mm") == {
        "force": "force_N",
        "displacement": "motor_mm",
    }
    with pytest.raises(ValueError, match="no displacement 'rod'"):
        two_channels(path, displacement="rod")


def test_what_was_read_stands_for_its_path(tmp_path):
    table = read_table(written(tmp_path, "force_N", "displacement_mm"))
    assert two_channels(table) == {"force": "force_N", "displacement": "displacement_mm"}
    both, pulled = (
        jm.load_recording(table, **two_channels(table)),
        jm.load_recording(table, column="force_N"),
    )
    np.testing.assert_allclose(both.displacement.whole, 1e-3 * MOVED, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(pulled.whole, FORCE, rtol=1e-4)
    assert jm.load_recordings(table, columns=["force_N"])[0].name == "x force_N"
    assert jm.load_recordings([table], column="force_N")[0].name == "x"


def test_paths_are_read_as_what_they_are(tmp_path):
    path = written(tmp_path, "force_N", "displacement_mm")
    (found,) = perturbed_recordings(str(path), files=True)
    assert found.window is not None
    np.testing.assert_allclose(found.displacement.whole, 1e-3 * MOVED, rtol=1e-4, atol=1e-9)
    assert perturbed_recordings([found, found], files=False) == (found, found)
    assert len(perturbed_recordings([path, path], files=True)) == 2
    assert perturbed_recordings(path, files=False) == ()
    assert perturbed_recordings("vastus-lateralis-26mvc", files=True) == ()


def test_an_angle_needs_its_lever_arm(tmp_path):
    with pytest.raises(ValueError, match="lever_arm"):
        perturbed_recordings(written(tmp_path, "force_N", "angle_deg"), files=True)


def test_a_frequency_response_is_recognised(tmp_path):
    path = tmp_path / "figure.csv"
    path.write_text(
        "frequency_hz,gain_N/mm,phase_deg,coherence\n0.5,1.5,4,0.93\n1,1.5,7,0.95\n",
        encoding="utf-8",
    )
    target = as_target(path, segments=40)
    assert target.stiffness is not None and len(target.proportional_power) == 0
    np.testing.assert_allclose(target.stiffness.gain, [1500, 1500])
    with pytest.raises(ValueError, match="segments=40"):
        as_target(path)


@pytest.mark.parametrize(
    ("column", "factor", "size", "unit", "rests"),
    [
        ("displacement_mm", 1e3, 1 / np.sqrt(2), "mm", False),
        ("displacement_mm", 30.0, 0.03 / np.sqrt(2), "mm", True),
        ("displacement_m", 0.1, 0.1 / np.sqrt(2), "mm", False),
        ("angle_deg", 150.0, 0.15 / np.sqrt(2), "deg", False),
        ("angle_deg", 130.0, 0.13 / np.sqrt(2), "deg", True),
        ("angle_rad", 1.0, 0.18 / np.pi / np.sqrt(2), "deg", True),
        ("position", 1.0, 1e-3 / np.sqrt(2), "", False),
        ("position", 0.0, 0.0, "", True),
    ],
)
def test_how_much_the_insertion_moves(tmp_path, column, factor, size, unit, rests):
    """The sine of 1e-3 by its rms; what happens before and after the middle half, and gaps, do not
    count."""
    moved = 7.0 + factor * MOVED
    moved[: ROWS // 5], moved[-ROWS // 5 :], moved[ROWS // 2] = -20.0, 50.0, np.nan
    header = f"time_s,force_N,{column}"
    path = save_columns(tmp_path / "x.csv", header, np.arange(ROWS) / 100, FORCE, moved)
    found = movement(path, column)
    assert found.size == pytest.approx(size, rel=0.02, abs=1e-12)
    assert (found.unit, found.rests) == (unit, rests)
    if unit and rests:
        assert perturbed_recordings(path, files=True, held=True) == ()
