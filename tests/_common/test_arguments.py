"""A wrong argument in Python is an error that names it, before anything is compiled."""

import subprocess
import sys

import numpy as np

import jaxmuscle as jm
from jaxmuscle._common import programs

TASK, TARGET = jm.Isometric(), jm.Target("made", 1 / (1 + np.arange(1, 31) ** 2), segments=12)
COUNTS = (-1, 1.5, True, "x", 10**12, [1])
FIT = {
    "starts": (0, *COUNTS),
    "seeds": COUNTS,
    "check_seeds": COUNTS,
    "max_steps": (0, *COUNTS),
    "rungs": COUNTS,
    "dt": (0, -1, np.nan, np.inf, "x", True),
    "free": ("k_w", 3, ["k_w", 3], []),
    "fix": (3, {"k_w": "x"}, {"k_w": np.nan}, {"k_w": True}, {3: 1.0}, [("k_w", 1)]),
    "bounds": (
        3,
        {"k_w": 3},
        {"k_w": (2, 1)},
        {"k_w": (np.nan, 1)},
        {"k_w": ("a", "b")},
        {"nope": (1, 2)},
    ),
    "priors": (
        3,
        {"k_w": "x"},
        {"k_w": -1.0},
        {"k_w": 0.0},
        {"k_w": np.nan},
        {"k_w": True},
        {"nope": 1.0},
    ),
    "noise": (3, "nope", True, ["pink"]),
    "method": (3, "x", None, ["linear"]),
    "mean_force": (3, True, (1,), ("a", 1), (1, -1), (np.nan, 1), (1, 0)),
    "coefficient_of_variation": (3, "x", None),
}
ENSEMBLE = {
    "chunk": (0, 1.5, True, "x"),
    "sampling": (3, "x", ["instant"]),
    "reduce": (0.5, (2.0,), ("a",), 3, []),
    "store": (3, True),
    "increments": (3, "x", None),
    "generator": (3, "x"),
    "control": ("x",),
}
SETTINGS = {
    "rate": (0, -1, np.nan, "x", True, 1e300, None),
    "length": (0, 7, 1.5, 10**12, "x", True, None),
    "first_bin": (-1, True, 1.5, 99),
    "last_bin": (0, True, 1e3),
    "window": (3, "x", None, []),
    "overlap": (1, -0.1, np.nan, "x", True),
    "detrend": (3,),
    "filter_order": (0, 10**6, True),
    "filter_cutoff": (0, 60, np.nan),
    "tapers": (0, 2, True),
}


TASKS = (3, "x", None, jm.Muscle())
PARAMETERS = {"k_w": (np.nan, -1, "x", True, None, float("inf")), "nope": (1,)}


def calls():
    """Name of the argument, value, and the call that has to refuse it."""
    for name, values in FIT.items():
        yield from (
            (name, value, lambda n=name, v=value: jm.fit(TASK, TARGET, **{n: v}))
            for value in values
        )
    for name, values in ENSEMBLE.items():
        yield from (
            (name, value, lambda n=name, v=value: jm.ensemble(TASK, 0, seeds=2, **{n: v}))
            for value in values
        )
    for name, values in SETTINGS.items():
        yield from (
            (name, value, lambda n=name, v=value: jm.SpectrumSettings(**{n: v})) for value in values
        )
    for name, values in PARAMETERS.items():
        yield from (
            (name, value, lambda n=name, v=value: TASK.replace(**{n: v})) for value in values
        )
    for value in TASKS:
        yield "task", value, lambda v=value: jm.fit(v, TARGET)
        yield "task", value, lambda v=value: jm.simulate(v, 0)
        yield "task", value, lambda v=value: jm.ensemble(v, 0, seeds=2)
        yield "task", value, lambda v=value: jm.expected_spectrum(v)
    for value in (3, "x", []):
        yield "settings", value, lambda v=value: jm.expected_spectrum(TASK, v)
    for value in ("x", None, True, [1]):
        yield "input", value, lambda v=value: jm.Isometric(P_w=v)


def refused():
    """How many were refused as they should be; prints the others."""
    run = programs.Kept.__call__

    def call(self, *arguments, **keywords):
        if self.function.__module__ == "jaxmuscle._common.keys":
            return run(self, *arguments, **keywords)
        raise AssertionError(f"{self.function.__name__} was compiled")

    programs.Kept.__call__ = call  # pyright: ignore[reportAttributeAccessIssue]
    count = 0
    for name, value, made in calls():
        try:
            made()
            print(f"{name} = {value!r}: accepted")
        except ValueError as error:
            right = name in str(error) and "\n" not in str(error)
            count += right
            if not right:
                print(f"{name} = {value!r}: {error}")
        except Exception as error:
            print(f"{name} = {value!r}: {type(error).__name__}: {error}")
    return count


def test_wrong_arguments_are_sentences():
    """In a process without the checks of types that tests have."""
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"{sum(1 for _ in calls())} refused"], done.stdout


if __name__ == "__main__":
    print(f"{refused()} refused")
