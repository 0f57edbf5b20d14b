"""Options that no call has are refused by name, with the nearest one."""

import re

import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.data import FrequencyResponse, PerturbedRecording

X = np.sin(np.arange(400.0))
CALLS = {
    "load_recording": (lambda **said: jm.load_recording("a.csv", **said), "colum", "column"),
    "Recording": (lambda **said: jm.Recording(X, 100, **said), "windw", "window"),
    "from_array": (
        lambda **said: PerturbedRecording.from_array(X, X, 100, **said),
        "positiv",
        "positive",
    ),
    "Target": (lambda **said: jm.Target("a", np.ones(30), **said), "segment", "segments"),
    "from_gain": (
        lambda **said: FrequencyResponse.from_gain([1.0], [2.0], [3.0], **said),
        "notice",
        "notices",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_an_unknown_option_is_refused_with_the_nearest(name):
    call, wrong, near = CALLS[name]
    words = rf"{name}\(\) has no option '{wrong}': did you mean {re.escape(repr(near))}\?"
    with pytest.raises(TypeError, match=words):
        call(**{wrong: 1})
