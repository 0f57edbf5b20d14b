"""The paper's model tuned to [12]: Task 1 with the paper's noise and a smaller harmonic whose
amplitude changes in time.

This is the fit behind the preset `zagrodny-hamilton`; `--preset FILE` writes it (four significant
digits). Stated: noise amplitudes, a harmonic smaller than for [30], smoother, its amplitude
changing, one maximum, 0.391 Hz. Assumed: that the harmonic is that 0.391 Hz (at 4.25 Hz, too small
for a maximum of its own, its envelope would show nowhere), the envelope's form and times, the range
of linearity x_ref_w. K_z0 is that of `zagrodny-slifkin`; the bound on c_z keeps K_z0/C_z0 above
3/s, so that the input's rise is forgotten when the analysed window begins, that on the harmonic
keeps it smaller.
"""

import jaxmuscle as jm
from common import arguments, distance, load, report, rounded

NAME = "hamilton-2004"
BESIDE = "zagrodny-slifkin"
FREE = ("k_w", "c_w", "c_z", "harmonic_amplitude")
BOUNDS = {"c_z": (10.0, 100.0), "harmonic_amplitude": (1e-5, 5e-4)}
START = {"x_ref_w": 0.005, "k_w": 2e6, "c_z": 80.0, "harmonic_amplitude": 4e-4}
ENVELOPE = jm.model.Decay(level=1.0, final=0.3, start=5.0, time_constant=3.0)


def fit(target: jm.Target, seed: int = 0) -> jm.fits.FitResult:
    """Active stiffness, damping and harmonic amplitude free; masses, noise and load those of
    `zagrodny-slifkin`."""
    task = jm.load_preset(BESIDE).with_parts(
        harmonic=jm.Harmonic(frequency=0.391, envelope=ENVELOPE)
    )
    return jm.fit(task.replace(**START), target, free=FREE, bounds=BOUNDS, key=seed)


if __name__ == "__main__":
    options = arguments((__doc__ or "").splitlines()[0], csv=True, preset=True)
    target = load(NAME, options)
    result = fit(target, options.seed)
    report(result, "zagrodny-hamilton", options.out)
    task = rounded(result.task, FREE)
    ratio = float(task["harmonic_amplitude"] / jm.load_preset(BESIDE)["harmonic_amplitude"])
    near = distance(task, target)
    print(
        f"rms log distance of the preset: {near:.3f} to {NAME}; harmonic {ratio:.2f} times that of"
        f" {BESIDE}"
    )
    if options.preset:
        description = (
            "Task 1 with the paper's noise and a smaller 0.391 Hz harmonic that fades, fitted to"
            " hamilton-2004"
        )
        made = {
            "target": target.name,
            "command": "python fitting/zagrodny_hamilton.py",
            "seed": options.seed,
            "rms_log_distance": {NAME: round(near, 3)},
            "harmonic_over_zagrodny_slifkin": round(ratio, 3),
            "jaxmuscle": result.versions["jaxmuscle"],
        }
        task.save(options.preset, description=description, fit=made)
