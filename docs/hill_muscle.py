"""A Hill-type muscle for jaxmuscle, written outside the package with its public names alone;
derived in own-muscle.md.

`python docs/hill_muscle.py` draws docs/hill.png.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxmuscle as jm

WIDTH = 0.45
CURVATURE = 0.25
PLATEAU = 1.4
PASSIVE_SHAPE, PASSIVE_STRAIN = 5.0, 0.6
LINEAR_SLOPE, TOE = 1.712, 0.09
# The weight of the toe that makes the tendon carry F_max at its reference strain.
TOE_WEIGHT = float(
    np.expm1(1 / (LINEAR_SLOPE * TOE)) / (np.exp(1 / TOE) - np.exp(1 / (LINEAR_SLOPE * TOE)))
)
NEWTON_STEPS = 6


def force_length(length):
    """Active force over its maximum: `f_L = exp(-(λ - 1)² / 0.45)`, λ the fibre length in optimal
    lengths.

    **Source:** Thelen 2003, doi:10.1115/1.1531112.
    """
    return jnp.exp(-((length - 1) ** 2) / WIDTH)


def force_velocity(velocity):
    """Active force over the isometric one; ν, the fibre's velocity in maximal ones, is positive in
    lengthening.

        f_V = 1 + (1 + g) ν / (1 - g ν)    ν < 0: Hill's (1 + ν) / (1 - g ν), g = 1/A
        f_V = 1 + (1 + g) w / (1 + e w)    ν ≥ 0: w = ν + (g + e) ν²,  e = (1 + g) / (f_max - 1)

    Value, slope 1 + g and curvature 2 g (1 + g) are continuous at ν = 0; f_max = 1.4 is the limit
    of fast lengthening.

    **Source:** Hill 1938, doi:10.1098/rspb.1938.0050, with A = a/F₀ = 0.25; f_max: Thelen 2003; the
    branch for lengthening is derived in own-muscle.md.
    """
    g = 1 / CURVATURE
    e = (1 + g) / (PLATEAU - 1)
    # Each branch is evaluated on its own side only, so that neither's pole reaches a derivative of
    # the other.
    short, long = jnp.where(velocity < 0, velocity, 0.0), jnp.where(velocity < 0, 0.0, velocity)
    w = long + (g + e) * long**2
    return 1 + (1 + g) * jnp.where(velocity < 0, short / (1 - g * short), w / (1 + e * w))


def passive_length(length):
    """Force of the parallel elastic element over F_max: `f_P = (exp(5 (λ - 1) / 0.6) - 1) /
    (exp(5) - 1)`.

    **Source:** Thelen 2003, young adults.
    """
    return jnp.expm1(PASSIVE_SHAPE * (length - 1) / PASSIVE_STRAIN) / np.expm1(PASSIVE_SHAPE)


def tendon(strain):
    """Tendon force over F_max at a strain η in units of the strain ε₀ that F_max causes; the toe is
    exponential.

        f_T = k s ln((1 + q exp(η / s)) / (1 + q)),     f_T(0) = 0,   f_T(1) = 1
        slope k q exp(η/s) / (1 + q exp(η/s))

    k = 1.712 is the slope of the linear region; s = 0.09 makes it the nearest to Thelen's
    exponential toe with a linear region (within 0.023), whose curvature jumps between them; q
    follows from f_T(1) = 1.

    **Source:** Thelen 2003 (k and the curve that is smoothed); q and s: own-muscle.md.
    """
    log_q = np.log(TOE_WEIGHT)
    return LINEAR_SLOPE * TOE * (jax.nn.softplus(log_q + strain / TOE) - np.log1p(TOE_WEIGHT))


def tendon_strain(force):
    """The inverse of `tendon`: η at which the tendon carries `force` (over F_max)."""
    carried = jnp.expm1(force / (LINEAR_SLOPE * TOE)) * (1 + TOE_WEIGHT) / TOE_WEIGHT
    return TOE * jnp.log1p(carried)


class HillMuscle(jm.model.AbstractMuscle):
    """Contractile and parallel elastic element (the active tissue) in series with a tendon (the
    passive tissue).

        active_force  = P_0 - [a (1 + ΔP_w/P_w) F_max f_L(λ) f_V(ν) + F_max f_P(λ)] cos α
                        + ΔK_w x_w + ΔC_w x_w'
        passive_force = -F_max f_T(η) + (c_T + ΔC_z) (x_z' - x_w') + ΔK_z (x_z - x_w)

    x_w is how far the belly has shortened along the tendon, x_z how far the insertion has come;
    x_w = x_z = 0 is the fibre at its optimal length and the tendon just slack. P_w is the
    contractile force that the drive would give there; its value for the muscle's activation is
    P_0 = a F_max cos α₀ (`held_force`): `at_activation` sets both. Noise of the drive multiplies
    the activation.

        λ = ℓ / ℓ₀,   ℓ² = (ℓ₀ cos α₀ - x_w)² + (ℓ₀ sin α₀)²         constant thickness
        cos α = (ℓ₀ cos α₀ - x_w) / ℓ
        ν = -x_w' cos α / (v_max ℓ₀),   η = (x_w - x_z) / (ε₀ ℓ_T)

    **Arguments:** `activation` a >= 0 [1]; `force_max` F_max [N]; `optimal_length` ℓ₀ [m];
    `slack_length` ℓ_T [m] of the tendon; `velocity_max` v_max, fastest shortening in optimal
    lengths per second [1/s]; `pennation` α₀ [rad] at the optimal length, 0 for parallel fibres;
    `tendon_strain` ε₀ [1] at F_max; `tendon_damping` c_T [N s/m]; `m_w`, `m_z` [kg]. The defaults
    are a first dorsal interosseus pressing lightly.

    **Raises:** `ValueError` for a value that is not positive (activation, pennation and
    tendon_damping: negative) and for a pennation of π/2 or more.

    **Source:** Zajac 1989, Crit Rev Biomed Eng 17:359-411 (structure); Thelen 2003,
    doi:10.1115/1.1531112 (curves); the values' sources are in own-muscle.md.
    """

    activation: jax.typing.ArrayLike = 0.15
    force_max: jax.typing.ArrayLike = 33.75
    optimal_length: jax.typing.ArrayLike = 0.032
    slack_length: jax.typing.ArrayLike = 0.05
    velocity_max: jax.typing.ArrayLike = 3.6
    pennation: jax.typing.ArrayLike = 0.16
    tendon_strain: jax.typing.ArrayLike = 0.04
    tendon_damping: jax.typing.ArrayLike = 10.0
    m_w: jax.typing.ArrayLike = 0.15
    m_z: jax.typing.ArrayLike = 0.15

    def __check_init__(self):
        positive = (
            "force_max",
            "optimal_length",
            "slack_length",
            "velocity_max",
            "tendon_strain",
            "m_w",
            "m_z",
        )
        for name in (*positive, "activation", "pennation", "tendon_damping"):
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer):
                continue
            if not (value > 0 or (value == 0 and name not in positive)):
                raise ValueError(
                    f"{name} = {value} must"
                    f" {'be positive' if name in positive else 'not be negative'}"
                )
            if name == "pennation" and not value < np.pi / 2:
                raise ValueError(f"pennation = {value} rad must be below π/2: an angle in degrees?")

    @property
    def held_force(self):
        """P_0 = a F_max cos α₀ [N], the P_w that holds the activation."""
        return self.activation * self.force_max * jnp.cos(self.pennation)

    def fibre(self, x_w):
        """Length of the fibre in optimal lengths and the cosine of its pennation."""
        along = jnp.cos(self.pennation) - x_w / self.optimal_length
        length = jnp.sqrt(along**2 + jnp.sin(self.pennation) ** 2)
        return length, along / length

    def belly_force(self, x_w, v_w, surge=0.0):
        """Pull [N] of the contractile and the parallel elastic element along the tendon; the drive
        is 1 + `surge`."""
        length, cosine = self.fibre(x_w)
        lengthening = -v_w * cosine / (self.velocity_max * self.optimal_length)
        active = self.activation * (1 + surge) * force_length(length) * force_velocity(lengthening)
        return self.force_max * (active + passive_length(length)) * cosine

    def tendon_force(self, stretch):
        """Pull [N] of the tendon stretched by `stretch` [m] beyond its slack length."""
        return self.force_max * tendon(stretch / (self.tendon_strain * self.slack_length))

    def shortening(self):
        """x_w [m] at which the belly balances the tendon, at rest with the insertion at 0; by
        Newton's method."""
        x = self.tendon_strain * self.slack_length * tendon_strain(self.held_force / self.force_max)

        def step(_, x):
            surplus, slope = _slope(
                lambda x: self.tendon_force(x) - self.belly_force(x, jnp.zeros_like(x)), x
            )
            return x - surplus / slope

        # as a loop it is compiled once, not step by step
        return jax.lax.fori_loop(0, NEWTON_STEPS, step, x)

    def base(self):
        """Slopes of both forces in isometric equilibrium at x_z = 0: what small fluctuations see as
        K_w, K_z, C_w, C_z."""
        x = self.shortening()
        still, none = jnp.zeros_like(x), jnp.zeros(4, x.dtype)
        _, K_w = _slope(lambda x: self.active_force(x, still, none), x)
        _, K_z = _slope(self.tendon_force, x)
        _, C_w = _slope(lambda v: self.active_force(x, v, none), still)
        return jnp.stack([K_w, K_z, C_w, jnp.asarray(self.tendon_damping, x.dtype)])

    def drive(self, force, u):
        return force

    def active_force(self, x_w, v_w, u):
        surge = u[4] if len(u) > 4 else 0.0
        return self.held_force - self.belly_force(x_w, v_w, surge) + u[0] * x_w + u[2] * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        return (
            (self.tendon_damping + u[3]) * (v_z - v_w)
            + u[1] * (x_z - x_w)
            - self.tendon_force(x_w - x_z)
        )

    def contraction_velocity(self, x_w, x_z, v_z, force, u):
        elastic = u[1] * (x_z - x_w) - self.tendon_force(x_w - x_z)
        return v_z - (force - elastic) / (self.tendon_damping + u[3])


def _slope(function, at):
    """Value and derivative."""
    return jax.jvp(function, (at,), (jnp.ones_like(at),))


def at_activation(task, activation):
    """The task of a `HillMuscle` at another activation, with the P_w (where one is prescribed) that
    holds it."""
    held = eqx.tree_at(lambda muscle: muscle.activation, task.muscle, activation).held_force
    return task.replace(
        activation=activation, **({"P_w": held} if "P_w" in task.parameter_names else {})
    )


def held_task(**parts):
    """A light contraction on the ascending limb, the insertion held 5 mm towards the muscle's
    origin."""
    return at_activation(jm.Isometric(muscle=HillMuscle(), x_z=0.005, **parts), 0.15)


@jm.plot.styled
def figure(seeds=64):
    """The muscle's three curves, and the spectrum of its isometric force: simulated and in linear
    response."""
    fig, axes = plt.subplots(2, 2, figsize=(8.0, 5.8), layout="constrained")
    task = held_task()
    x_w = float(jm.response.equilibrium(task)[0])
    _draw_length(axes[0, 0], task.muscle, x_w)
    _draw_velocity(axes[0, 1])
    _draw_tendon(axes[1, 0], task.muscle, x_w - task.x_z)
    _draw_spectra(axes[1, 1], seeds)
    for ax, title in zip(
        axes.flat, ("Force-length", "Force-velocity", "Tendon", "Isometric force"), strict=True
    ):
        ax.set_title(title)
    return fig


def _draw_length(ax, muscle, x_w):
    length = np.linspace(0.4, 1.65, 300)
    active, passive = np.asarray(force_length(length)), np.asarray(passive_length(length))
    a, (here, _) = muscle.activation, muscle.fibre(x_w)
    ax.plot(length, active, color=jm.plot.BLUE, label=r"active $f_\mathrm{L}$")
    ax.plot(length, passive, color=jm.plot.VERMILLION, label=r"passive $f_\mathrm{P}$")
    ax.plot(
        length, active + passive, color=jm.plot.GREY, lw=0.8, ls="--", label="both, activation 1"
    )
    ax.plot(
        length, a * active + passive, color=jm.plot.BLACK, lw=0.8, label=f"both, activation {a:g}"
    )
    ax.plot(
        here,
        a * force_length(here) + passive_length(here),
        "o",
        color=jm.plot.BLACK,
        ms=5,
        label="operating point",
    )
    ax.set(xlim=(0.4, 1.65), ylim=(-0.03, 1.75))
    ax.set_xlabel(f"Fibre length (optimal lengths of {1e3 * muscle.optimal_length:g} mm)")
    ax.set_ylabel(_over_maximum(muscle))
    ax.legend(loc="upper left")


def _draw_velocity(ax):
    velocity = np.linspace(-1.0, 0.6, 641)
    short = velocity <= 0
    curve = np.asarray(force_velocity(velocity))
    ax.axhline(PLATEAU, color=jm.plot.GREY, lw=0.6, ls=":")
    ax.axhline(1.0, color=jm.plot.GREY, lw=0.6, ls=":")
    ax.axvline(0.0, color=jm.plot.GREY, lw=0.6, ls=":")
    ax.plot(velocity[short], curve[short], color=jm.plot.BLUE, label="shortening (Hill)")
    ax.plot(velocity[~short], curve[~short], color=jm.plot.VERMILLION, label="lengthening")
    slope = 1 + (1 + 1 / CURVATURE) * velocity
    near = np.abs(velocity) < 0.1
    ax.plot(
        velocity[near],
        slope[near],
        color=jm.plot.BLACK,
        lw=0.8,
        ls="--",
        label=r"slope $1 + 1/A$ at rest",
    )
    ax.set(xlim=(-1.0, 0.55), ylim=(0.0, 1.75))
    ax.set_xlabel(r"Fibre velocity (fraction of $v_\mathrm{max}$, positive in lengthening)")
    ax.set_ylabel("Active force (fraction of isometric)")
    ax.legend(loc="upper left")


def _draw_tendon(ax, muscle, stretch):
    eta = np.linspace(-0.3, 1.25, 400)
    percent = 100 * muscle.tendon_strain
    ax.plot(
        percent * eta,
        thelen_tendon(eta),
        color=jm.plot.GREY,
        lw=1.0,
        ls="--",
        label="Thelen 2003: exponential, then line",
    )
    ax.plot(
        percent * eta, tendon(eta), color=jm.plot.BLUE, label=r"$f_\mathrm{T}$, smooth throughout"
    )
    here = stretch / (muscle.tendon_strain * muscle.slack_length)
    ax.plot(percent * here, tendon(here), "o", color=jm.plot.BLACK, ms=5, label="operating point")
    ax.set_xlim(-0.3 * percent, 1.25 * percent)
    ax.set_xlabel(f"Tendon strain (% of {1e3 * muscle.slack_length:g} mm)")
    ax.set_ylabel(_over_maximum(muscle))
    ax.legend(loc="upper left")


def thelen_tendon(eta):
    """Thelen's tendon: an exponential toe up to 0.609 ε₀, straight beyond; its curvature jumps
    there."""
    toe = 0.33 * np.expm1(3 * np.minimum(eta, 0.609) / 0.609) / np.expm1(3)
    return toe + LINEAR_SLOPE * np.maximum(eta - 0.609, 0.0)


def _draw_spectra(ax, seeds):
    noises = {
        "band-limited noise": (jm.BandLimitedNoise(), jm.plot.BLUE),
        "Ornstein-Uhlenbeck noise, τ = 0.1 s": (
            jm.OrnsteinUhlenbeckNoise({"K_w": 0.15, "K_z": 0.005}),
            jm.plot.VERMILLION,
        ),
    }
    for name, (noise, colour) in noises.items():
        task = held_task(noise=noise, harmonic=jm.Harmonic(0.01)).settled()
        expected = jm.expected_spectrum(task)
        seen = jm.ensemble(task, jax.random.key(0), seeds=seeds, control=False).mean_spectrum()
        ax.plot(expected.frequency, expected.power, color=colour, label=name)
        ax.errorbar(
            seen.frequency,
            seen.power,
            2 * seen.stderr,
            fmt="o",
            ms=3,
            lw=0.8,
            color=colour,
            mfc="white",
        )
    ax.plot([], [], color=jm.plot.GREY, label="linear response")
    ax.errorbar(
        [],
        [],
        [],
        fmt="o",
        ms=3,
        lw=0.8,
        color=jm.plot.GREY,
        mfc="white",
        label=f"simulated, {seeds} seeds, ± 2 SE",
    )
    ax.set(xscale="log", yscale="log", xlim=(0.35, 13.0), ylim=(2.5e-5, 7e-2))
    ax.set_xticks([0.5, 1, 2, 5, 10], ["0.5", "1", "2", "5", "10"])
    ax.set_xticks([], minor=True)
    ax.set_xlabel("Frequency (Hz)")
    ax.set_ylabel(r"Power of $F_\mathrm{ext}$ (N²/Hz)")
    ax.legend(loc="upper right")


def _over_maximum(muscle):
    return rf"Force (fraction of $F_\mathrm{{max}}$ = {muscle.force_max:.3g} N)"


if __name__ == "__main__":
    figure().savefig(Path(__file__).with_name("hill.png"))
