"""The paper's Figure 4a: Task 1 with the paper's noise and harmonic frequency, reconstructed from
the text.

This is the fit behind the preset `zagrodny-slifkin`; `--preset FILE` writes it (four significant
digits). The masses, reference displacements and the starting values come from an earlier search by
hand; noise amplitudes and harmonic frequency are the paper's and stay fixed.
"""

import jaxmuscle as jm
from common import arguments, distance, load, report, rounded

NAME = "zagrodny-fig4a"
OTHER = "slifkin-newell-1999-95mvc"
FREE = ("k_w", "k_z", "c_w", "c_z", "harmonic_amplitude")
START = {
    "m_w": 0.1,
    "k_w": 1.25e6,
    "k_z": 1.25e6,
    "c_w": 2.0,
    "c_z": 130.0,
    "F_ext": 10.0,
    "x_z": 0.0,
    "harmonic_amplitude": 4e-4,
    "harmonic_frequency": 4.25,
}
PAPER_NOISE = {"K_w": 0.0016, "K_z": 0.0016, "C_w": 1e-4, "C_z": 1e-4}


def fit(target: jm.Target, seed: int = 0) -> jm.fits.FitResult:
    """Stiffness, damping and harmonic amplitude free."""
    task = jm.PrescribedMotion(
        noise=jm.BandLimitedNoise(PAPER_NOISE), settings=target.settings
    ).replace(**START)
    return jm.fit(task, target, free=FREE, key=seed)


if __name__ == "__main__":
    options = arguments((__doc__ or "").splitlines()[0], csv=True, preset=True)
    target = load(NAME, options)
    result = fit(target, options.seed)
    report(result, NAME, options.out)
    task = rounded(result.task, FREE)
    near, far = distance(task, target), distance(task, jm.load_target(OTHER))
    print(f"rms log distance of the preset: {near:.3f} to {NAME}, {far:.3f} to {OTHER}")
    if options.preset:
        description = (
            "Task 1 with the paper's noise (0.16 %, 0.01 %) and 4.25 Hz harmonic, fitted to"
            " zagrodny-fig4a"
        )
        made = {
            "target": target.name,
            "command": "python fitting/zagrodny_fig4a.py",
            "seed": options.seed,
            "rms_log_distance": {NAME: round(near, 3), OTHER: round(far, 3)},
            "jaxmuscle": result.versions["jaxmuscle"],
        }
        task.save(options.preset, description=description, fit=made)
