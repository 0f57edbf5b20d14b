"""A GPU gives what the processor gives: random numbers, paths and moments to single precision."""

import os
import subprocess
import sys

import numpy as np
import pytest

pytestmark = pytest.mark.gpu

PROGRAM = """
import sys
import jax
import numpy as np
import jaxmuscle as jm
from jaxmuscle.model._stream import Stream

stream = Stream.of(jax.random.key(3))
normals = np.stack(stream.normals(np.arange(10_000, dtype=np.uint32), 0, 4))
path = jm.simulate(jm.Isometric(), jax.random.key(3), duration=2.0).output
reduced = jm.ensemble(jm.Isometric(), seeds=64, duration=15.0, key=jax.random.key(3), reduce=True)
np.savez(sys.argv[1], normals=normals, path=path, mean=reduced.mean, power=reduced.spectrum.power)
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What the program gives on the processor and on the device, each in a process of its own."""
    found = {}
    for platform in ("cpu", ""):
        path = tmp_path_factory.mktemp("gpu") / "made.npz"
        subprocess.run(
            [sys.executable, "-c", PROGRAM, str(path)],
            env=os.environ | {"JAX_PLATFORMS": platform},
            check=True,
        )
        with np.load(path) as data:
            found[platform or "device"] = dict(data)
    return found


@pytest.mark.parametrize(
    ("name", "bound"), [("normals", 1e-6), ("path", 1e-5), ("mean", 1e-5), ("power", 1e-3)]
)
def test_a_device_gives_what_the_processor_gives(made, name, bound):
    here, there = made["cpu"][name], made["device"][name]
    assert here.shape == there.shape and np.isfinite(here).all()
    np.testing.assert_allclose(there, here, rtol=bound, atol=bound * np.abs(here).max())
