"""Random numbers of a seed: their law, their independence, and that they are the same wherever they
are made."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.special
import scipy.stats
from compiled import at_once

from jaxmuscle.model._stream import APART, START, Draws, Stream, _normal, _weak

KEY = jax.random.key(21)
SEEDS, STEPS, CHANNELS = 256, 2048, 4
P_LEAST = 1e-4  # of every test of a fixed stream: about forty of them


def streams(seeds=SEEDS, key=KEY, draws=Draws()):  # noqa: B008
    return jax.vmap(lambda i: Stream.of(jax.random.fold_in(key, i), draws))(jnp.arange(seeds))


def of_every(function, seeds=SEEDS, key=KEY, draws=Draws()):  # noqa: B008
    """What a function makes of the stream of every seed."""
    made = at_once(
        lambda key: jax.vmap(lambda one: jnp.stack(function(one), axis=-1))(
            streams(seeds, key, draws)
        ),
        key,
    )
    return np.asarray(made)


def normals_of(steps=STEPS, first=0, count=CHANNELS, **streams):
    """Normals of every seed, step and number."""
    return of_every(lambda one: one.normals(jnp.arange(steps), first, count), **streams).astype(
        float
    )


@pytest.fixture(scope="module")
def words():
    return of_every(lambda one: one._words(jnp.arange(STEPS), 0, CHANNELS))


@pytest.fixture(scope="module")
def normals():
    return normals_of()


def test_weak_numbers_have_seven_moments_of_a_normal():
    values = np.asarray(_weak(jnp.arange(256, dtype=jnp.uint32)), float)
    found = [np.mean(values**n) for n in range(1, 8)]
    np.testing.assert_allclose(found, [0, 1, 0, 3, 0, 15, 0], rtol=1e-6, atol=1e-6)
    assert abs(np.mean(values**8) - 105) > 1  # 105 is that of a normal


def test_only_the_last_byte_of_a_word_makes_a_weak_number():
    word = jnp.arange(256, dtype=jnp.uint32)
    np.testing.assert_array_equal(_weak(word), _weak(word + jnp.uint32(0xABCDEF00)))


def grid_of_words():
    """Two-sided tails from 2^-32 to 1, each with both signs."""
    ends = np.concatenate([np.arange(64), 2 ** np.arange(6, 31), 2**31 - 1 - np.arange(64)])
    spread = np.linspace(0, 2**31 - 1, 100_001).astype(np.int64)
    return np.unique(np.concatenate([ends, spread]))


def test_the_normal_of_a_word_is_the_inverse_of_the_distribution():
    halves = grid_of_words()
    tail = (halves + 0.5) * 2.0**-31
    exact = -scipy.special.ndtri(tail / 2)
    up, down = (
        np.asarray(_normal(jnp.asarray(halves * 2 + sign, jnp.uint32)), float) for sign in (0, 1)
    )
    np.testing.assert_array_equal(down, -up)
    # 31 bits are rounded to the 24 of single precision, which near 0 is 1.25 of 2^-24.
    assert np.all(np.abs(up - exact) <= 2e-5 * exact + 1.3 * 2.0**-24)
    seen = exact > 1e-2
    assert np.max(np.abs(up[seen] / exact[seen] - 1)) < 3e-5
    assert abs(up[0] - 6.34) < 0.01 and up.max() == up[0]
    # Single precision may turn neighbours round, by a few of its units.
    assert np.all(np.diff(up) <= 8 * np.finfo(np.float32).eps * np.maximum(up[1:], 1)) and np.all(
        up >= 0
    )


def test_normals_are_normal(normals):
    z = normals.ravel()
    assert scipy.stats.kstest(z, "norm").pvalue > P_LEAST
    moments = np.array([0, 1, 0, 3, 0, 15, 0, 105])
    spreads = np.sqrt(
        np.array([1, 3 - 1, 15, 105 - 9, 945, 10395 - 225, 135135, 2027025 - 105**2]) / z.size
    )
    found = np.array([np.mean(z**n) for n in range(1, 9)])
    assert np.all(np.abs(found - moments) < 4.5 * spreads), (found - moments) / spreads
    # The tails: expected counts beyond 3, 4 and 4.5 standard deviations are 5700, 133 and 14.
    for level in (3.0, 4.0, 4.5):
        expected = 2 * scipy.stats.norm.sf(level) * z.size
        assert (
            P_LEAST < scipy.stats.poisson.cdf(np.sum(np.abs(z) > level), expected) < 1 - P_LEAST
        ), level


def together(pairs):
    """Correlations of paired numbers and of their sizes, over the last axis, in standard errors.

    All that a test looks at in one array: a bound of 1 % is for the whole family. Not of squares,
    which are still far from normal after a thousand pairs.
    """
    size = lambda x: (np.abs(x) - np.sqrt(2 / np.pi)) / np.sqrt(1 - 2 / np.pi)  # noqa: E731
    found = [
        np.sum(f(a) * f(b), axis=-1) / np.sqrt(a.shape[-1])
        for a, b in pairs
        for f in (lambda x: x, size)
    ]
    return np.concatenate([np.ravel(each) for each in found])


def test_neighbouring_seeds_are_independent(normals):
    flat = normals.reshape(SEEDS, -1)
    references.assert_standard_normal(
        together((flat[:-apart], flat[apart:]) for apart in (1, 2, 128))
    )


def test_steps_are_independent(normals):
    rows = np.moveaxis(normals, 1, -1).reshape(-1, STEPS)
    references.assert_standard_normal(
        together((rows[:, :-k], rows[:, k:]) for k in (1, 2, 3, 7, 64, 1024))
    )


def test_channels_are_independent(normals):
    pairs = itertools.combinations(np.moveaxis(normals, -1, 0), 2)
    references.assert_standard_normal(together(pairs))


def test_parts_of_a_sum_and_the_start_are_independent(normals):
    later = normals_of(first=APART, count=1)[..., 0]
    references.assert_standard_normal(
        together((channel, later) for channel in np.moveaxis(normals, -1, 0))
    )
    begun = of_every(lambda one: one.normals(START, 0, CHANNELS), seeds=4096).astype(float)
    first = normals_of(1, seeds=4096)[:, 0]
    assert abs(np.mean(begun)) < 4 / np.sqrt(begun.size) and abs(np.var(begun) - 1) < 4 * np.sqrt(
        2 / begun.size
    )
    references.assert_standard_normal(together([(begun.T, first.T)]))


def test_different_keys_make_different_noise(normals):
    other = normals_of(key=jax.random.key(22))
    references.assert_standard_normal(
        together([(normals.reshape(SEEDS, -1), other.reshape(SEEDS, -1))])
    )


def test_every_bit_is_balanced_and_no_two_go_together(words):
    bits = 2.0 * ((words.ravel()[:, None] >> np.arange(32, dtype=np.uint32)) & 1) - 1
    references.assert_standard_normal(bits.sum(axis=0) / np.sqrt(len(bits)))
    pairs = (bits.T @ bits) / np.sqrt(len(bits))
    references.assert_standard_normal(pairs[np.triu_indices(32, 1)])


def equal_cells(counts):
    """p of χ² of cells that are equally likely; both tails are suspicious."""
    expected = counts.sum() / counts.size
    statistic = np.sum((counts - expected) ** 2) / expected
    p = scipy.stats.chi2.sf(statistic, counts.size - 1)
    return min(p, 1 - p)


@pytest.mark.parametrize("shift", [0, 8, 16, 24])
def test_bytes_are_equally_likely_alone_and_in_pairs(words, shift):
    byte = ((words >> np.uint32(shift)) & 255).astype(np.int64)
    assert equal_cells(np.bincount(byte.ravel(), minlength=256)) > P_LEAST
    neighbours = {
        "seeds": (byte[:-1:2], byte[1::2]),
        "steps": (byte[:, :-1:2], byte[:, 1::2]),
        "channels": (byte[..., 0::2], byte[..., 1::2]),
    }
    for name, (a, b) in neighbours.items():
        assert equal_cells(np.bincount((256 * a + b).ravel(), minlength=65536)) > P_LEAST, name


@pytest.mark.parametrize("order", ["seed by seed", "step by step"])
def test_birthday_spacings(words, order):
    """Marsaglia's test: of m birthdays in n days the equal spacings are Poisson with mean m³ /
    4n."""
    line = words if order == "seed by seed" else np.moveaxis(words, 0, 1)
    birthdays = np.sort(line.reshape(-1, 4096).astype(np.int64), axis=1)
    spacings = np.sort(np.diff(birthdays, axis=1), axis=1)
    repeated = np.sum(np.diff(spacings, axis=1) == 0)
    expected = len(birthdays) * 4096**3 / 2**34
    assert P_LEAST < scipy.stats.poisson.cdf(repeated, expected) < 1 - P_LEAST


def by_numpy(key, step, number):
    """The formula of `Stream`, in Python's integers."""
    cut = lambda x: x & 0xFFFFFFFF  # noqa: E731

    def mixed(x, rounds, last):
        for shift, factor in rounds:
            x = cut((x ^ (x >> shift)) * factor)
        return x ^ (x >> last)

    once = mixed(step ^ key[0], [(16, 0x7FEB352D), (15, 0x846CA68B)], 16) ^ key[1]
    golden = round(2**32 * (np.sqrt(5) - 1) / 2)
    return mixed(
        cut(once + (number + 1) * golden),
        [(17, 0xED5AD4BB), (11, 0xAC4C1B51), (15, 0x31848BAB)],
        14,
    )


@pytest.mark.parametrize(
    "key", [(0, 0), (1, 0), (0x243F6A88, 0x85A308D3), (0xFFFFFFFF, 0xFFFFFFFF)]
)
def test_words_are_those_of_the_formula(key):
    stream = Stream(KEY, jnp.array(key, jnp.uint32), Draws())
    steps = np.array([0, 1, 2, 14_999, 2**31 - 1, 2**32 - 1], np.uint32)
    for first, count in ((0, 5), (APART, 3)):
        found = np.stack(stream._words(jnp.asarray(steps), first, count), axis=-1)
        exact = [[by_numpy(key, int(k), first + j) for j in range(count)] for k in steps]
        np.testing.assert_array_equal(found, exact)


@pytest.mark.parametrize("generator", ["hash", "threefry"])
@pytest.mark.parametrize("increments", ["gaussian", "weak"])
def test_a_number_depends_on_seed_step_and_place_alone(generator, increments):
    draws, first, count = Draws.of(generator, increments), (0, APART), (6, 3)

    def of_step(stream, made):
        return [stream.numbers(made, part, first[part], count[part]) for part in (0, 1)]

    def batch(key, begin, seeds):
        def one(stream):
            return jax.lax.map(
                lambda made: of_step(stream, made),
                stream.ahead(begin + jnp.arange(20), first, count),
            )

        return jax.vmap(one)(streams(seeds, key, draws))

    found, later = (
        jax.tree.map(np.asarray, at_once(functools.partial(batch, seeds=seeds), KEY, begin))
        for begin, seeds in ((7, 5), (17, 3))
    )
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:3, 10:], b[:, :10]), found, later)

    def alone(key, step):
        stream = Stream.of(jax.random.fold_in(key, 2), draws)
        return of_step(stream, jax.tree.map(lambda x: x[0], stream.ahead(step, first, count)))

    for step in (7, 20):
        for part, single in enumerate(at_once(alone, KEY, np.array([step]))):
            assert len(single) == count[part]
            # A product and a sum may be fused or not: a few units in the last place.
            np.testing.assert_allclose(
                single, [x[2, step - 7] for x in found[part]], rtol=1e-6, atol=1e-7
            )


def test_both_precisions_have_the_same_numbers():
    for increments in ("gaussian", "weak"):

        def numbers(key, increments=increments):
            stream = Stream.of(jax.random.fold_in(key, 3), Draws.of("hash", increments))
            return jnp.stack(stream.numbers(stream.ahead(jnp.arange(50), (0,), (4,)), 0, 0, 4))

        made = []
        for double in (False, True):
            with jax.enable_x64(double):
                made.append(np.asarray(at_once(numbers, KEY)))
        assert (made[0].dtype, made[1].dtype) == (np.float32, np.float64)
        np.testing.assert_array_equal(made[0].astype(float), made[1])


def test_threefry_makes_other_numbers_of_the_same_law(normals):
    other = normals_of(512, seeds=64, draws=Draws.of("threefry", "gaussian"))
    assert scipy.stats.kstest(other.ravel(), "norm").pvalue > P_LEAST
    references.assert_standard_normal(
        together([(other.reshape(64, -1), normals[:64, :512].reshape(64, -1))])
    )
