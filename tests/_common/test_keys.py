"""Seeds are whole numbers from 0 to 2^32 - 1, each once; keys of every documented kind mean the
same everywhere."""

import jax
import numpy as np
import pytest
from test_result import made_result

import jaxmuscle as jm
from jaxmuscle._common.keys import key_of, seed_of, seeds_of

LAST = 2**32 - 1
KEYS = {
    "number": 7,
    "NumPy's number": np.int64(7),
    "unsigned": np.uint32(7),
    "array": np.array(7),
    "JAX's array": jax.numpy.asarray(7),
    "key": jax.random.key(7),
    "words": jax.random.PRNGKey(7),
    "NumPy's words": np.asarray(jax.random.PRNGKey(7)),
}
WRONG_KEYS = {
    "negative": -1,
    "too large": 2**32,
    "huge": 10**40,
    "fraction": 1.5,
    "whole float": 1.0,
    "switch": True,
    "text": "0",
    "nothing": None,
    "list": [0, 1],
    "words of another type": np.array([0, 1]),
    "two keys": jax.random.split(jax.random.key(0)),
}
WRONG_SEEDS = {
    "none": 0,
    "negative": -1,
    "too many": 2**32,
    "fraction": 2.0,
    "switch": True,
    "text": "ab",
    "empty": [],
    "two dimensions": [[0, 1]],
    "fractions": [0.0, 1.0],
    "switches": [True, False],
    "twice": [3, 1, 3],
    "below": [0, -1],
    "above": np.array([0, 2**32]),
    "ragged": [[0], [1, 2]],
    "nothing": None,
}


@pytest.mark.parametrize("kind", KEYS)
def test_every_kind_of_key_is_the_same_key(kind):
    words = jax.random.key_data(key_of(KEYS[kind]))
    np.testing.assert_array_equal(words, jax.random.key_data(jax.random.key(7)))


@pytest.mark.parametrize("number", [0, 1, 2**31 - 1, 2**31, LAST])
def test_a_number_is_the_key_of_jax(number):
    np.testing.assert_array_equal(
        jax.random.key_data(key_of(number)), jax.random.key_data(jax.random.key(np.uint32(number)))
    )
    assert seed_of(np.uint32(number)) == number


def test_a_traced_key_passes():
    made = jax.jit(lambda key: jax.random.key_data(key_of(key)))
    np.testing.assert_array_equal(made(jax.random.key(7)), jax.random.key_data(jax.random.key(7)))


def public_calls(key):
    """Every public function that takes a key, with that one."""
    task, result = jm.Isometric(), made_result()
    target = result.only.target
    return {
        "simulate": lambda: jm.simulate(task, key),
        "ensemble": lambda: jm.ensemble(task, key, seeds=2),
        "sweep": lambda: jm.ensemble(jm.ensembles.Sweep.grid(task, k_w=[4e5, 5e5]), key, seeds=2),
        "store": lambda: jm.ensemble(task, key, seeds=2, store="never.zarr"),
        "fit": lambda: jm.fit(task, target, key=key),
        "fit of several": lambda: jm.fit(None, {"a": target}, key=key),
        "Monte Carlo": lambda: jm.fit(task, target, key=key, method="montecarlo"),
        "fit_cohort": lambda: jm.fit_cohort([target], key=key),
        "posterior": lambda: jm.posterior(result, key=key),
        "goodness": lambda: jm.checks.goodness(result, key=key),
        "bootstrap": lambda: jm.checks.bootstrap(result, key=key),
        "compare_noise": lambda: jm.comparison.compare_noise(task, target, key=key),
        "design_input": lambda: jm.uncertainty.design_input(
            task, "K_w0", rms=1e-3, band=(0.1, 5.0), seconds=60.0, key=key
        ),
        "run_study": lambda: jm.run_study("never.csv", key=key),
    }


@pytest.mark.parametrize("call", public_calls(0))
@pytest.mark.parametrize("kind", ["negative", "fraction", "list"])
def test_a_wrong_key_is_an_error_of_every_function(kind, call):
    with pytest.raises(
        ValueError,
        match=r"key = .*: give a whole number from 0 to 2.32 - 1 = 4294967295, or a key, as jax",
    ):
        public_calls(WRONG_KEYS[kind])[call]()


@pytest.mark.parametrize("kind", WRONG_KEYS)
def test_a_wrong_key_is_refused(kind):
    with pytest.raises(
        ValueError, match=r"^key (= .*: give a whole number|has shape \(2,\): give one key)"
    ):
        key_of(WRONG_KEYS[kind])


@pytest.mark.parametrize("kind", WRONG_SEEDS)
def test_wrong_seeds_are_refused_and_never_cut(kind):
    with pytest.raises(ValueError, match=r"^seeds"):
        jm.ensemble(jm.Isometric(), 0, seeds=WRONG_SEEDS[kind])


@pytest.mark.parametrize("seed", [-1, 2**32, 1.0, True, "0", None, [0]])
def test_a_wrong_seed_is_refused(seed):
    with pytest.raises(ValueError, match=r"^seed = "):
        jm.simulate(jm.Isometric(), 0, seed=seed)


@pytest.mark.parametrize(
    "given",
    [3, np.int64(3), [0, 1, 2], (0, 1, 2), range(3), np.arange(3), np.arange(3, dtype=np.uint8)],
)
def test_seeds_that_are_right(given):
    np.testing.assert_array_equal(list(seeds_of(given)), [0, 1, 2])


def test_the_last_seed_is_one_of_its_own():
    np.testing.assert_array_equal(seeds_of([LAST, 0]), [LAST, 0])
    task = jm.Isometric(P_w=jm.model.Constant(5.0))
    runs = jm.ensemble(task, np.int64(5), seeds=[LAST, 0], duration=0.1, control=False)
    one = jm.simulate(task, jax.random.key(5), seed=LAST, duration=0.1)
    np.testing.assert_allclose(runs.output[0], one.output, rtol=1e-5)
    assert not np.allclose(runs.output[0], runs.output[1], rtol=1e-5)


ARGUMENTS = {
    "substeps": [0, -1, 1.5, True, 10**6],
    "duration": [0.0, -1.0, np.inf, np.nan, "1", True, 1e300, None],
    "dt": [0.0, -1e-3, np.nan, np.inf, "x"],
    "rate": [0.0, np.inf, np.nan, "x"],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in ARGUMENTS.items() for value in values]
)
def test_a_wrong_grid_names_its_argument(name, value):
    with pytest.raises((ValueError, TypeError), match=name):
        jm.ensemble(jm.Isometric(), 0, seeds=2, **{name: value})
