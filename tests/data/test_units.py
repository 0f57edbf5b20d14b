"""Units in the names of columns and in what files state; what a name says that a column holds."""

import math

import numpy as np
import pytest
from recorded import noticed, save_columns
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.data._units import UNITS, known_unit, name_and_unit, named_quantity, scale_to_si

RATE = 100
X = 40 + np.random.default_rng(0).normal(size=600)


def write(folder, name, x=X):
    return save_columns(folder / "trial.csv", f"time_s,{name}", np.arange(len(x)) / RATE, x)


NAMES = {  # name of a column: what is left of it, its unit, what that measures
    "torque_nm": ("torque", "N m", "torque"),
    "Torque(N-m)": ("torque", "N m", "torque"),
    "Drehmoment [Nm]": ("drehmoment", "N m", "torque"),
    "Moment, N·m": ("moment", "N m", "torque"),
    "Torque Newton meters": ("torque", "N m", "torque"),
    "TORQUE (FT-LBS)": ("torque", "lbf ft", "torque"),
    "torque_ftlb": ("torque", "lbf ft", "torque"),
    "Torque [mNm]": ("torque", "mN m", "torque"),
    "acc_g": ("acc", "g", "acceleration"),
    "ACC X (G)": ("acc x", "g", "acceleration"),
    "accel_x_mg": ("accel_x", "mg", "acceleration"),
    "acc_ms2": ("acc", "m/s^2", "acceleration"),
    "acc_m_s2": ("acc", "m/s^2", "acceleration"),
    "Acc (ms-2)": ("acc", "m/s^2", "acceleration"),
    "Acceleration [m s\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT TWO}]": (
        "acceleration",
        "m/s^2",
        "acceleration",
    ),
    "acc m/s/s": ("acc", "m/s^2", "acceleration"),
    "gyro (deg/s)": ("gyro", "deg/s", "angular velocity"),
    "gyro_z_dps": ("gyro_z", "deg/s", "angular velocity"),
    "Gyro X [°/s]": ("gyro x", "deg/s", "angular velocity"),
    "gyro_x_rad_s": ("gyro_x", "rad/s", "angular velocity"),
    "Force %MVC": ("force", "% MVC", "force"),
    "Force (% MVC)": ("force", "% MVC", "force"),
    "acquired data [%(MVC)]": ("acquired data", "% MVC", "force"),
    "%MVC": ("%mvc", "% MVC", "force"),
    "MVC %": ("mvc %", "% MVC", "force"),
    "Nm": ("nm", "N m", "torque"),
    "N": ("n", None, None),  # a number of rows
    "force_pct": ("force_pct", None, None),
    "Fz (kg)": ("fz", "kgf", "force"),
    "load_kg": ("load", "kgf", "force"),
    "Force (g)": ("force", "gf", "force"),  # a scale
    "FORCE_LBS": ("force", "lbf", "force"),
    "FORCE(N)": ("force", "N", "force"),
    "force.N": ("force", "N", "force"),
    "Force, N": ("force", "N", "force"),
    "Right Force \N{EN DASH} N": ("right force", "N", "force"),
    "Kraft in N": ("kraft", "N", "force"),
    "force_n": ("force", "N", "force"),
    "Force (N) raw": ("force raw", "N", "force"),
    "Force [counts]": ("force", "a.u.", None),
    "Force (MN)": ("force", None, None),  # no muscle pulls with meganewtons
    "force_mn": ("force", "mN", "force"),
    "EMG (mV)": ("emg", "mV", None),
    "EMG \N{MICRO SIGN}V": ("emg", "uV", None),
    "POSITION (MM)": ("position", "mm", "displacement"),
    "position (nm)": ("position", None, None),  # nanometres
    "mag_x (G)": ("mag_x", None, None),  # gauss
    "Angle (deg)": ("angle", "deg", "angle"),
    "pos_px": ("pos_px", None, None),
    "trial_g": ("trial_g", None, None),
    "Elbow moment Nm/kg": ("elbow moment nm/kg", None, None),
    "Stiffness N/m": ("stiffness n/m", None, None),
}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_holds_its_unit(name):
    bare, unit, quantity = NAMES[name]
    found, stated = name_and_unit(name)
    known = None if stated is None else known_unit(stated, name)
    assert (found, known) == (bare, unit) and UNITS.get(known or "") == quantity


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_in_capitals_is_the_same_but_for_millions(unit):
    assert known_unit(unit) == known_unit(f" [{unit}] ") == unit
    assert known_unit(unit.upper()) == (None if unit in ("mN", "mN m") else unit)


def test_torques_of_a_country_in_newton_metres():
    """A pound-force is 4.4482216152605 N, a foot 0.3048 m."""
    for unit, newtons in (
        ("FT-LBS", 1.3558179483314),
        ("in-lb", 0.1129848290276),
        ("kg-m", 9.80665),
    ):
        assert scale_to_si(unit, "units", "force", 1.0)[0] == pytest.approx(newtons, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "quantity"),
    [
        ("Right Force", "force"),
        ("LoadCell2", "force"),
        ("raw_force", "force"),
        ("Force Plate 1 Moment", "torque"),
        ("accX", "acceleration"),
        ("angular velocity z", "angular velocity"),
        ("raw", "raw signal"),
        ("elapsed time", "time"),
        ("signal", None),
    ],
)
def test_a_name_says_what_it_holds(name, quantity):
    assert named_quantity(name) == quantity


@pytest.mark.parametrize("name", ["torque_nm", "TORQUE (N-M)", "Drehmoment Nm"])
def test_a_torque_is_no_force(name, tmp_path):
    found = jm.load_recording(write(tmp_path, name))
    assert (found.unit, found.quantity, found.notices) == ("N m", "torque", ())


@pytest.mark.parametrize(
    "name", ["Force", "Kraft", "Fz", "grip force (counts)", "signal", "force_raw"]
)
def test_a_force_without_a_unit_has_no_newtons(name, tmp_path):
    """Its numbers are relative to the mean, and it can be fitted; any other name than that of a
    force without a unit counts as one."""
    found = jm.load_recording(write(tmp_path, name))
    assert (found.unit, found.quantity) == ("a.u.", "force")
    assert noticed(found, "no unit stated") == ("counts" not in name)
    target = found.target()
    assert target.quantity == "force" and target.mean_force is None
    assert target.coefficient_of_variation == (found.summary().coefficient_of_variation,)
    assert jm.load_recording(write(tmp_path, name), units="N").target().mean_force is not None


WITHOUT = {  # name of a column: what the message says
    "Torque": "as units='N m' (or mN m,",
    "elbow moment": "as units='N m' (or mN m,",
    "acc_x": "as units='m/s^2' (or mm/s^2, g, mg)",
    "gyro_z": "as units='deg/s' (or rad/s)",
    "pos_px": "as units='m' (or cm, mm, um)",
    "knee angle": "as units='deg' (or rad)",
    "pressure_kPa": "of a pressure none is known here, so units='a.u.'",
    "Druck (mmHg)": "unknown unit 'mmHg'; give `units`: of a pressure none is known here",
    "raw": "as units='V' (or mV, uV), or units='a.u.'",
    "counts": "as units='V' (or mV, uV), or units='a.u.'",
    "EMG": "as units='V' (or mV, uV), or units='a.u.'",
    "Force (MN)": "unknown unit 'MN'; give `units`, as units='N' (or mN, kN,",
    "signal (bar)": "unknown unit 'bar'; give `units`, units='a.u.'",
}


@pytest.mark.parametrize("name", WITHOUT)
def test_another_quantity_without_a_unit_is_asked_for(name, tmp_path):
    path = write(tmp_path, name)
    with pytest.raises(ValueError) as caught:
        jm.load_recording(path)
    assert WITHOUT[name] in str(caught.value)
    assert "'N'" not in str(caught.value) or "Force" in name
    assert jm.load_recording(path, units="a.u.").unit == "a.u."


def test_grams_of_a_force_are_no_acceleration(tmp_path):
    found = jm.load_recording(write(tmp_path, "Force (g)"))
    assert (found.unit, found.quantity) == ("gf", "force")
    assert found.notices == ("g of Force (g) is taken as gf, since it is a force",)


def test_volts_are_what_is_said_of_them(tmp_path):
    path = write(tmp_path, "channel (V)")
    assert jm.load_recording(path).quantity is None
    held = jm.load_recording(path, quantity="force")
    assert held.quantity == "force" and held.target().quantity == "force"
    assert jm.load_recording(write(tmp_path, "Force (V)")).quantity == "force"
    with pytest.raises(ValueError, match="quantity='torque': the unit N is that of another"):
        jm.Recording(X, RATE, quantity="torque")
    with pytest.raises(ValueError, match="did you mean 'force'"):
        jm.Recording(X, RATE, unit="V", quantity="forse")


def test_commands_take_the_quantity(tmp_path):
    """`analyse` of volts says that it needs it; with the option it makes a target."""
    path, saved = write(tmp_path, "channel (V)"), tmp_path / "volts.toml"
    options = ["analyse", str(path), "--out", str(tmp_path / "out"), "--save-target", str(saved)]
    refused = CliRunner().invoke(app, options)
    assert refused.exit_code == 2 and "--quantity" in refused.output
    done = CliRunner().invoke(app, [*options, "--force", "--quantity", "force"])
    assert done.exit_code == 0, done.output
    assert jm.load_target(saved).quantity == "force"


@pytest.mark.parametrize("name", ["gyro (deg/s)", "gyro_z_dps", "Angular velocity [rad/s]"])
def test_an_angular_velocity_has_a_tremor_and_no_level(name, tmp_path):
    t = np.arange(3000) / RATE
    rng = np.random.default_rng(1)
    x = 20 + 5 * np.sin(2 * np.pi * 4.4 * t + np.cumsum(0.05 * rng.normal(size=t.size)))
    found = jm.load_recording(write(tmp_path, name, x + rng.normal(size=t.size)))
    assert found.quantity == "angular velocity"
    steady = jm.data.steadiness(found.steady())
    assert steady.band == (3.0, 20.0)
    assert steady["tremor_frequency"].value == pytest.approx(4.4, abs=0.2)
    assert math.isnan(steady["coefficient_of_variation"].value)
    assert "gravity or offset" in str(found.summary())
    with pytest.raises(ValueError, match=r"an angular velocity cannot be fitted.*steadiness"):
        found.target()


@pytest.mark.parametrize(("unit", "scale"), [("g", 1.0), ("m/s^2", 9.81), ("mg", 1000.0)])
def test_gravity_is_no_level(unit, scale):
    """A coefficient of variation about 1 g says nothing; the tremor is stated in the unit."""
    rng, t = np.random.default_rng(2), np.arange(3000) / RATE
    phase = 2 * np.pi * 5.2 * t + np.cumsum(0.05 * rng.normal(size=t.size))
    x = scale * (1 + 0.05 * np.sin(phase) + 0.005 * rng.normal(size=t.size))
    found = jm.data.steadiness(jm.Recording(x, RATE, unit=unit))
    names = ("coefficient_of_variation", "relative_power_4_8")
    assert all(math.isnan(found[name].value) for name in names)
    assert noticed(found, "gravity and offset of the sensor")
    assert found["tremor_size"].unit == unit
    assert found["tremor_size"].value == pytest.approx(0.05 * scale / math.sqrt(2), rel=0.1)


@pytest.mark.parametrize(("frequency", "unit"), [(5.2, "m/s^2"), (3.9, "g"), (11.0, "deg/s")])
def test_a_tremor_that_is_nearly_all_is_seen(frequency, unit):
    """A slow tremor with 99.9 % of the variance."""
    rng, t = np.random.default_rng(5), np.arange(6000) / RATE
    slow = np.cumsum(rng.normal(size=t.size)) * 0.02
    x = np.sin(2 * np.pi * frequency * t + slow) + 0.02 * rng.normal(size=t.size)
    found = jm.data.steadiness(jm.Recording(x, RATE, unit=unit).steady())
    assert found["tremor_frequency"].value == pytest.approx(frequency, abs=0.1)
    assert found["tremor_p"].value <= 0.001


@pytest.mark.parametrize("rate", [20, 16, 30])
def test_slow_recordings_have_a_steadiness(rate):
    """What lies above half of the rate is left out; a spectrum to 11.7 Hz is refused."""
    rng, t = np.random.default_rng(6), np.arange(60 * rate) / rate
    x = 40 + np.convolve(rng.normal(size=t.size + 40), np.ones(41) / 20, "valid")
    x += 0.3 * np.sin(2 * np.pi * 7 * t + np.cumsum(rng.normal(size=t.size)) * 0.05)
    recording = jm.Recording(x, rate).steady()
    found = jm.data.steadiness(recording)
    left_out = rate < 24
    assert math.isnan(found["power_8_12"].value) == left_out
    assert math.isnan(found["share_above_12"].value) == left_out
    assert noticed(found, "is left out") == left_out
    expected = np.std(x) / np.mean(x)
    assert found["coefficient_of_variation"].value == pytest.approx(expected, rel=0.02)
    assert found["tremor_frequency"].value == pytest.approx(7, abs=0.2)
    assert found.band[1] == pytest.approx(min(12, 0.45 * rate))
    if left_out:
        with pytest.raises(ValueError, match="jaxmuscle steadiness` takes this recording"):
            recording.spectrum()


def test_a_hold_without_tremor_band_says_so():
    x = 40 + np.random.default_rng(7).normal(size=600)
    found = jm.data.steadiness(jm.Recording(x, 12))
    assert math.isnan(found["tremor_p"].value)
    assert "a tremor was not looked for" in found.notices[-1]


def test_the_level_over_the_mvc(tmp_path):
    one = jm.data.steadiness(jm.Recording(X, RATE), mvc=400)
    assert one["level"].value == pytest.approx(np.mean(X) / 400, rel=1e-3)
    assert "\n    over the MVC              9.9" in str(one)
    assert "level" not in jm.data.steadiness(jm.Recording(X, RATE)).measures
    with pytest.raises(ValueError, match="mvc=30: give a force above the mean"):
        jm.data.steadiness(jm.Recording(X, RATE), mvc=30)


@pytest.mark.parametrize(("size", "moved"), [(1.5, True), (0.01, False)])
def test_analyse_says_that_a_record_is_moved(size, moved, tmp_path):
    rng, t = np.random.default_rng(8), np.arange(600) / RATE
    table = np.stack([t, X, 10 + size * rng.normal(size=t.size)], 1)
    path = tmp_path / "torque.csv"
    save_columns(path, "time_s,torque_Nm,angle_deg", *table.T)
    (notice,) = jm.load_recording(path).notices
    assert ("`jaxmuscle fit` takes it for a record of a moved insertion" in notice) == moved
    assert ("angle_deg rests" in notice) == (not moved)
    if moved:
        both = jm.load_recording(path, force="torque_Nm", displacement="angle_deg", lever_arm=0.1)
        assert isinstance(both, jm.data.PerturbedRecording)


def test_a_moved_record_needs_the_unit_of_the_force(tmp_path):
    length = np.random.default_rng(9).normal(size=600)
    table = np.stack([np.arange(600) / RATE, X, length], 1)
    path = tmp_path / "moved.csv"
    save_columns(path, "time_s,force,length_mm", *table.T)
    with pytest.raises(ValueError, match="in which unit force is; give `units`, as units='N'"):
        jm.load_recording(path, force="force", displacement="length_mm")
    assert jm.load_recording(path, force="force", displacement="length_mm", units="N").rate == RATE
