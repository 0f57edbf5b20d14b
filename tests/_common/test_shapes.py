"""Wrong shapes are noticed while tests run, although not every call of a function is looked at."""

import beartype
import jaxtyping
import numpy as np
import pytest
import shapes
from jaxtyping import Float

import jaxmuscle as jm
from jaxmuscle.objective._coordinates import Coordinates


def looked_at(calls):
    """Which of so many calls find that an argument has one dimension too many."""

    @jaxtyping.jaxtyped(typechecker=beartype.beartype)
    def given(x: Float[np.ndarray, " bins"]) -> None:
        return None

    found = []
    for call in range(1, calls + 1):
        try:
            given(np.zeros((2, 2)))
        except jaxtyping.TypeCheckError:
            found.append(call)
    return found


def test_the_first_calls_in_each_test_and_some_of_the_others():
    most = shapes.FIRST + 3 * shapes.EVERY
    expected = [
        call for call in range(1, most + 1) if call <= shapes.FIRST or call % shapes.EVERY == 0
    ]
    assert looked_at(most) == expected
    assert looked_at(1) == []  # the same function, made again within the test
    shapes.begin_anew()
    assert looked_at(1) == [1]


def test_functions_methods_properties_and_classes_of_the_package():
    with pytest.raises(jaxtyping.TypeCheckError):
        jm.spectra.spectrum_of(np.zeros(300, dtype=complex), "default")
    with pytest.raises(jaxtyping.TypeCheckError):  # no arrays, no sizes
        jm.SpectrumSettings().segments("many")
    with pytest.raises(jaxtyping.TypeCheckError):
        jm.fits.Estimate("much", "N")
    with pytest.raises(jaxtyping.TypeCheckError):  # arrays by way of a type variable
        Coordinates.of({"k_w": 5e5}, {}, {"k_w": 1.0}).theta("much")
