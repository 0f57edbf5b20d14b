"""Task 2 by numba and by C: what a machine can do, to compare ensembles with."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numba
import numpy as np
from batched import BAND, DT, SEEDS, STEPS, grid_inputs, numbers
from handwritten import filter_matrices

import jaxmuscle as jm

ANCHOR = "C with SIMD"


@numba.njit(fastmath=True)
def _by_numba(rng, p, scale, inputs, steps, dt, out):
    m_w, m_z, k_w, k_z, c_w, c_z, xw2, xz2, vw2, vz2 = p
    P_w, F_ext, harmonic_w, harmonic_z = inputs
    for seed in range(out.size):
        y, moved, first = np.zeros(4, np.float32), np.zeros(4, np.float32), np.zeros(4, np.float32)
        for k in range(steps):
            n0, n1 = scale[0] * rng.standard_normal(), scale[1] * rng.standard_normal()
            n2, n3 = scale[2] * rng.standard_normal(), scale[3] * rng.standard_normal()
            moved[:] = y
            for half in range(2):
                x_w, v_w, x_z, v_z = moved
                K_w = dt * (k_w * (xw2 + x_w * x_w) + harmonic_w[k + half]) + n0
                K_z = dt * (k_z * (xz2 + x_z * x_z) + harmonic_z[k + half]) + n1
                C_w, C_z = dt * c_w * (vw2 + v_w * v_w) + n2, dt * c_z * (vz2 + v_z * v_z) + n3
                passive = C_z * (v_z - v_w) + K_z * (x_z - x_w)
                a_w = (dt * P_w[k + half] - C_w * v_w - K_w * x_w + passive) / m_w
                a_z = -(dt * F_ext[k + half] + passive) / m_z
                if half == 0:
                    first[0], first[1], first[2], first[3] = dt * v_w, a_w, dt * v_z, a_z
                    moved[:] = y + first
                else:
                    y[0] += 0.5 * (first[0] + dt * v_w)
                    y[1] += 0.5 * (first[1] + a_w)
                    y[2] += 0.5 * (first[2] + dt * v_z)
                    y[3] += 0.5 * (first[3] + a_z)
        out[seed] = y[2]


def anchors(task: Any) -> dict[str, Any]:
    """The last x_z of every seed by C, if there is a compiler, and, with white noise, by numba with
    PCG64."""
    inputs = tuple(np.ascontiguousarray(row, np.float32) for row in grid_inputs(task))
    p, found, compiler = tuple(np.float32(v) for v in numbers(task)), {}, shutil.which("gcc")
    white = isinstance(task.noise, jm.WhiteNoise)
    f, root, deviation = filter_matrices(*BAND, DT)
    size = np.sqrt(DT / float(task.noise.rate)) if white else DT * deviation
    scale, row = np.asarray(task.noise_scale() * size, np.float32), np.array(p, np.float32)

    def by_numba():
        out = np.empty(SEEDS, np.float32)
        rng = np.random.Generator(np.random.PCG64(1))
        _by_numba(rng, p, scale, inputs, STEPS, np.float32(DT), out)
        return out

    if white:
        found["numba, PCG64"] = by_numba
    if compiler is not None:
        folder = Path(tempfile.mkdtemp())
        source = Path(__file__).with_name("anchor.c")
        flags = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
        subprocess.run(
            [compiler, *flags, str(source), "-o", str(folder / "anchor.so"), "-lm"], check=True
        )
        library = ctypes.CDLL(str(folder / "anchor.so"))
        given = [] if white else [np.ascontiguousarray(matrix, np.float32) for matrix in (f, root)]
        program = library.simulate if white else library.filtered
        program.argtypes = [
            ctypes.c_int,
            ctypes.c_int,
            ctypes.c_float,
            *[ctypes.c_void_p] * (7 + len(given)),
        ]

        def by_c():
            out = np.empty(SEEDS, np.float32)
            arrays = [array.ctypes.data for array in (row, scale, *inputs, out, *given)]
            program(SEEDS, STEPS, DT, *arrays)
            return out

        found[ANCHOR] = by_c
    return found
