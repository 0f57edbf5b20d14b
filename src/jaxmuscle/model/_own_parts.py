"""Parts that a user writes: muscle, material law, noise. What is wrong is said when a task is made
of them."""

import warnings
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxmuscle._common.arrays import as_arrays, as_doubles, is_concrete, require
from jaxmuscle._common.errors import FirstOrderWarning

from ._muscle import AbstractLaw, AbstractMuscle, Muscle
from ._noise import AbstractNoise, Recursion, ShapingFilter
from ._parameters import muscle_paths

# What is asked of a muscle: the arguments of a method, in words, the shape of what it returns, and
# what that is.
ASKED: dict[str, tuple[tuple[str, ...], tuple[int, ...], str]] = {
    "base": (
        (),
        (4,),
        "an array of four floating-point numbers, K_w0, K_z0 [N/m], C_w0, C_z0 [N s/m]",
    ),
    "drive": (("force", "u"), (), "one floating-point number [N]"),
    "active_force": (("x_w", "v_w", "u"), (), "one floating-point number [N]"),
    "passive_force": (("x_w", "v_w", "x_z", "v_z", "u"), (), "one floating-point number [N]"),
    "contraction_velocity": (
        ("x_w", "x_z", "v_z", "force", "u"),
        (),
        "one floating-point number [m/s]",
    ),
}
TAKEN = (
    "P_w",
    "F_ext",
    "x_z",
    "activation_time",
    "muscle",
    "noise",
    "harmonic",
    "settings",
    "initial",
    "observe",
)
TAKEN_BEFORE = ("noise_", "harmonic_", "resonance_")
INVERSE = "contraction_velocity"
SMALL = 1e-6  # m, m/s, N, N/m: a step from rest
_SEEN: set[type] = set()


def check_muscle(muscle: AbstractMuscle) -> None:
    """Refuse a muscle whose fields hide other parameters of a task, or whose methods do not return
    what is asked.

    **Raises:** `ValueError` that names the method, what it returns and what is asked. A class is
    looked at once.
    """
    kind = type(muscle)
    if isinstance(muscle, Muscle):
        laws = (muscle.stiffness_w, muscle.stiffness_z, muscle.damping_w, muscle.damping_z)
        fresh = [type(law) for law in laws if type(law) not in _SEEN and not _ours(law)]
        for law in laws:
            _check_law(law)
        if fresh and all(is_concrete(leaf) for leaf in jax.tree.leaves(muscle)):
            _check_slopes(muscle)
            _SEEN.update(fresh)
    if kind is Muscle or kind in _SEEN:
        return
    for name in muscle_paths(muscle):
        require(
            name not in TAKEN and not name.startswith(TAKEN_BEFORE),
            f"{kind.__name__}.{name}: a task has something of "
            "this name itself. Give the field of your muscle another name",
        )
    for mass in (muscle.m_w, muscle.m_z):
        require(
            jnp.ndim(mass) == 0,
            f"{kind.__name__}: a mass of shape {jnp.shape(mass)}; m_w and m_z are one number each",
        )
    for method, (arguments, shape, what) in ASKED.items():
        _check_method(muscle, method, arguments, shape, what)
    if all(is_concrete(leaf) for leaf in jax.tree.leaves(muscle)):
        _check_inverse(muscle)
        _check_slopes(muscle)
        _SEEN.add(kind)


def _check_law(law: AbstractLaw) -> None:
    """A material law must be one number at one number."""
    require(
        isinstance(law, AbstractLaw),
        f"{law!r} stands for a material law: give one made from AbstractLaw, as "
        "jaxmuscle.model.QuadraticStiffness()",
    )
    if type(law) not in _SEEN and not _ours(law):
        _check_method(law, "__call__", ("q",), (), "one floating-point number [N/m or N s/m]")


def _ours(part: object) -> bool:
    return type(part).__module__.partition(".")[0] == "jaxmuscle"


def _check_method(
    part: eqx.Module, method: str, arguments: tuple[str, ...], shape: tuple[int, ...], what: str
) -> None:
    """Without computing anything: JAX follows the method with numbers of no value."""
    call = f"{type(part).__name__}.{method}({', '.join(arguments)})"
    part = as_arrays(part)  # a network may have another precision
    try:
        found = jax.eval_shape(
            getattr(part, method), *(jnp.zeros(5 if name == "u" else ()) for name in arguments)
        )
    except NotImplementedError:  # of contraction_velocity, for which few ask
        return
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise ValueError(
            f"{call} decides or computes by values, with `if`, float() or numpy. While it is"
            " compiled they are not known: use jax.numpy, and jnp.where(condition, a, b) instead"
            " of `if`"
        ) from error
    except Exception as error:
        raise ValueError(
            f"{call} cannot be computed: {type(error).__name__}: {error}. A task calls it with one"
            " number for each argument (u: the five perturbations): see docs/own-muscle.md"
        ) from error
    if not isinstance(found, jax.ShapeDtypeStruct):
        raise ValueError(f"{call} returns a {type(found).__name__}; it must return {what}")
    if found.shape != shape or not jnp.issubdtype(found.dtype, jnp.floating):
        raise ValueError(
            f"{call} returns {found.dtype} of shape {found.shape}; it must return {what}"
        )


def _check_inverse(muscle: AbstractMuscle) -> None:
    """`contraction_velocity` must be where `passive_force` is as given: at one point in numbers."""
    x_w, v_w, x_z, v_z = 1e-3, 0.02, 5e-4, 0.01
    muscle = as_doubles(muscle)
    with jax.enable_x64(True):
        here, moving, there, speed, still = (
            *(jnp.asarray(value) for value in (x_w, v_w, x_z, v_z)),
            jnp.zeros(5),
        )
        force = muscle.passive_force(here, moving, there, speed, still)
        try:
            found = float(muscle.contraction_velocity(here, there, speed, force, still))
        except NotImplementedError:
            return
    if not abs(found - v_w) <= 0.01 * v_w:
        where = f"x_w = {x_w} m, x_z = {x_z} m, v_z = {v_z} m/s"
        raise ValueError(
            f"{type(muscle).__name__}.contraction_velocity is not the inverse of passive_force: at"
            f" {where} and v_w = {v_w} m/s passive_force is {float(force):.4g} N, but for that"
            f" force contraction_velocity gives {found:.4g} m/s"
        )


def _check_slopes(muscle: AbstractMuscle) -> None:
    """The linear response takes JAX's derivatives at rest: they must be slopes of the methods.

    Where the slopes to the two sides differ, one of them; a warning says which. Differences over h
    and h / 2, extrapolated.
    """
    muscle = as_doubles(muscle)
    own = type(muscle).contraction_velocity is not AbstractMuscle.contraction_velocity
    methods = [m for m, (_, shape, _) in ASKED.items() if not shape and (own or m != INVERSE)]
    with jax.enable_x64(True):
        names = ("x_w", "v_w", "x_z", "v_z", "force", *(f"u[{i}]" for i in range(5)))
        at = np.array([1e-3, 0.0, 0.0, 0.0, 0.0, *np.zeros(5)])
        steps = SMALL * np.array([1.0, 0.5, -1.0, -0.5])[:, None, None]

        def values(x: Any) -> Any:
            given = {"u": x[5:]} | dict(zip(names[:5], x, strict=False))
            found = [getattr(muscle, m)(*(given[n] for n in ASKED[m][0])) for m in methods]
            return jnp.stack([jnp.asarray(y, float) for y in found])

        at[4] = float(
            values(jnp.asarray(at))[methods.index("passive_force")]
        )  # which the inverse must carry
        looked = jax.jit(
            lambda x: (
                values(x),
                jax.jacfwd(values)(x),
                jax.vmap(jax.vmap(values))(x + steps * np.eye(len(at))),
            )
        )
        here, slopes, near = map(np.asarray, looked(at))
    wide, right, far, left = (near - here) / steps
    sides = np.stack([2 * left - far, 2 * right - wide]).mT
    near_enough = 1e-3 * np.abs(sides).max(axis=0) + 1e-8 * (1 + np.abs(here))[:, None]
    fits = (np.abs(sides - slopes) <= near_enough) | ~np.all(np.isfinite(sides), axis=0)
    for i, k in np.argwhere(~np.all(fits, axis=0)):
        left, right = sides[:, i, k]
        said = (
            f"{type(muscle).__name__}.{methods[i]}: at rest its slope with {names[k]} is"
            f" {left:.4g} to the left and {right:.4g} to the right"
        )
        if not np.any(fits[:, i, k]):
            raise ValueError(
                f"{said}, but JAX's derivative, of which the linear response is made, is"
                f" {slopes[i, k]:.4g}. jnp.clip, jnp.maximum and jnp.abs take the mean of two"
                " sides: choose a side by jnp.where, also in the argument of each branch, see"
                " docs/own-muscle.md"
            )
        warnings.warn(
            f"{said}. The linear response, and so fits, take that to the"
            f" {'left' if fits[0, i, k] else 'right'}; a simulation has both",
            FirstOrderWarning,
            stacklevel=2,
        )


def check_noise(noise: AbstractNoise) -> None:
    """Refuse a noise of one's own whose three descriptions contradict one another. A class is
    looked at once.

    In the stationary state of `shaping_filter`, of covariance P with `F P + P Fᵀ + G Gᵀ = 0`, N has
    the variance H P Hᵀ, after a time t the covariance `H exp(F t) P Hᵀ`, and a slope of variance H
    F P Fᵀ Hᵀ. `recursion` must give the same of its states, whose covariance is 1. `density` is
    that of the filter's response. What a step adds to a state must keep its variance in single
    precision.

    **Raises:** `ValueError` that names the methods and both numbers.
    """
    kind = type(noise)
    if (
        kind in _SEEN
        or _ours(noise)
        or not all(is_concrete(leaf) for leaf in jax.tree.leaves(noise))
    ):
        return
    with jax.enable_x64(True):
        for ours, theirs, what, where in _descriptions(noise, 1e-3):
            if not np.isclose(
                ours, theirs, rtol=1e-3, atol=1e-3 if what.startswith("the correlation") else 0.0
            ):
                raise ValueError(
                    f"{kind.__name__}: {what} is {ours:.5g} by {where[0]}, but {theirs:.5g} by"
                    f" {where[1]}. They describe one noise: see docs/how-to/own-noise.md"
                )
        exact = _added(noise, 1e-3)
    with jax.enable_x64(False):
        single = _added(noise, 1e-3)
    for i, (found, right) in enumerate(zip(single, exact, strict=True)):
        if not np.isclose(found, right, rtol=0.05, atol=0.0):
            raise ValueError(
                f"{kind.__name__}.recursion(0.001): what a step adds to state {i} has the variance"
                f" {right:.4g} in double precision, but {found:.4g} in single precision, as most"
                " simulations compute. Compute L without subtracting nearly equal numbers:"
                " docs/how-to/own-noise.md"
            )
    _SEEN.add(kind)


def _added(noise: AbstractNoise, dt: float) -> np.ndarray:
    """The variance of what a step adds to each state."""
    return np.array(
        [sum(float(x) ** 2 for x in row if x is not None) for row in noise.recursion(dt).L]
    )


def _called(noise: AbstractNoise, method: str, kind: type, *arguments: float) -> Any:
    call = f"{type(noise).__name__}.{method}({', '.join(map(str, arguments))})"
    try:
        found = getattr(noise, method)(*arguments)
    except Exception as error:
        raise ValueError(f"{call} cannot be computed: {type(error).__name__}: {error}") from error
    require(
        isinstance(found, kind),
        f"{call} returns a {type(found).__name__}; it must return a {kind.__name__}",
    )
    return found


def _descriptions(
    noise: AbstractNoise, dt: float
) -> Iterator[tuple[Any, Any, str, tuple[str, str]]]:
    """Pairs of numbers that must agree, what they are, and by which methods."""
    pair, made = ("recursion(dt)", "shaping_filter()"), _called(noise, "recursion", Recursion, dt)
    filtered = _called(noise, "shaping_filter", ShapingFilter)
    F, G, H, direct = (
        np.asarray(x, float) for x in (filtered.F, filtered.G, filtered.H, filtered.L)
    )
    fit = F.shape == 2 * G.shape[:1] and H.shape == G.shape[:1] and direct.shape == G.shape[1:]
    shapes = f"{F.shape}, {G.shape}, {H.shape} and {direct.shape}"
    require(
        fit,
        f"{type(noise).__name__}.shaping_filter(): F, G, H and L have the shapes {shapes}; for n"
        " states and m inputs they are (n, n), (n, m), (n,) and (m,)",
    )
    for f in (0.3, 3.0, 30.0):
        response = (
            direct + H @ np.linalg.solve(2j * np.pi * f * np.eye(len(F)) - F, G)
            if len(F)
            else direct
        )
        yield (
            float(np.sum(np.abs(response) ** 2)),
            float(_called(noise, "density", object, f)),
            f"the density at {f:g} Hz",
            ("shaping_filter()", "density(f)"),
        )
    if made.direct is not None:
        yield (
            float(made.direct) ** 2,
            float(direct @ direct) * dt,
            f"the variance of an increment in {dt:g} s",
            pair,
        )
        return
    A, L = (
        np.array([[0.0 if x is None else float(x) for x in row] for row in rows])
        for rows in (made.A, made.L)
    )
    h = np.array([0.0 if x is None else float(x) for x in made.H])
    for i, (kept, new) in enumerate(zip(np.diag(A @ A.T), np.diag(L @ L.T), strict=True)):
        yield (
            kept + new,
            1.0,
            f"the variance of state {i} after a step",
            ("recursion(dt), A Aᵀ + L Lᵀ", "definition"),
        )
    P = scipy.linalg.solve_continuous_lyapunov(F, -G @ G.T)
    yield h @ h, H @ P @ H, "the variance", pair
    for steps in (1, 30, 1000):
        later = (
            h @ np.linalg.matrix_power(A, steps) @ h,
            H @ scipy.linalg.expm(F * steps * dt) @ P @ H,
        )
        yield (
            later[0] / (h @ h),
            later[1] / (h @ h),
            f"the correlation after {steps * dt:g} s",
            pair,
        )
    if noise.smoothness > 1:
        require(
            made.S is not None,
            f"{type(noise).__name__}: smoothness = {noise.smoothness}, so recursion(dt) must give "
            "S, with dN/dt = S q",
        )
        slope = np.array([0.0 if x is None else float(x) for x in made.S or ()])
        yield slope @ slope, H @ F @ P @ F.T @ H, "the variance of the slope", pair
