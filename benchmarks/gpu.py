"""A GPU against the processor of the same machine: `python benchmarks/gpu.py --out out/gpu.json`.

Each platform runs in a process of its own. Ensembles have single precision, fits double precision,
as they always do.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measure import Row

WIDTHS = (4096, 16_384, 65_536, 262_144)
SECONDS, SEEDS = 15.0, 262_144
SHORT = 1_048_576


def timed(work: Callable[[], Any], repetitions: int = 1) -> dict[str, float]:
    """Seconds of the `first` call, which compiles, and the median of the `later` ones."""
    taken = []
    for _ in range(1 + repetitions):
        begun = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begun)
    return {"first": taken[0], "later": float(np.median(taken[1:]))}


def worker(small: bool) -> None:
    """What this process's device takes, as JSON on the last line of its output."""
    import jax

    import jaxmuscle as jm
    from jaxmuscle.ensembles import _layout

    scale, wide, kind = (
        64 if small else 1,
        jax.default_backend() == "gpu",
        jax.devices()[0].device_kind,
    )
    found: dict[str, Any] = {"device": kind, "jax": jax.__version__}
    key, task, white = jax.random.key(0), jm.Isometric(), jm.PrescribedForce(noise=jm.WhiteNoise())

    def say(name: str, value: Any) -> None:
        found[name] = value
        print(name, value, file=sys.stderr, flush=True)

    def pace(name: str, seeds: int, *given: Any, **options: Any) -> None:
        taken = timed(lambda: jm.ensemble(*given, key, seeds=seeds, reduce=True, **options))
        say(name, taken | {"seeds per second": seeds / taken["later"]})

    pace("reduced", (SEEDS if wide else SEEDS // 4) // scale, task, duration=SECONDS)
    say(
        "power",
        np.asarray(
            jm.ensemble(task, key, seeds=1024 // scale, reduce=True).spectrum.power, float
        ).tolist(),
    )
    pace("short", (SHORT if wide else SHORT // 4) // scale, white, duration=1.0, control=False)
    for lanes in WIDTHS if wide else ():
        _layout.WIDE_LANES, _layout.WIDE_STEPS_AT_ONCE = (
            lanes // scale,
            round(lanes // scale * SECONDS * 1000),
        )
        pace(
            f"width {lanes // scale}", SEEDS // scale, task, duration=SECONDS, chunk=lanes // scale
        )
    target, results = jm.load_target("vastus-lateralis-26mvc"), []
    taken = timed(lambda: results.append(jm.fit(jm.Isometric(), target)))
    say(
        "fit",
        taken | {"cost": min(start.cost for start in results[0].starts if start.cost is not None)},
    )
    with jax.enable_x64(True):
        power = jax.jit(lambda k: jm.expected_spectrum(jm.Isometric(k_w=k)).power)
        slopes = jax.jit(jax.jacrev(lambda k: jm.expected_spectrum(jm.Isometric(k_w=k)).power))
        for name, function in (("expected", power), ("slopes", slopes)):
            say(name, timed(lambda f=function: jax.block_until_ready(f(4e5)), 20))
    print(json.dumps(found))


def measured(platform: str, small: bool) -> dict[str, Any]:
    """The worker on a platform; an empty name stands for what JAX prefers."""
    command = [sys.executable, __file__, "--worker", *(["--small"] if small else [])]
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=os.environ | {"JAX_PLATFORMS": platform, "JAXMUSCLE_CACHE": "off"},
    )
    return json.loads(done.stdout.splitlines()[-1])


def rows(processor: dict[str, Any], device: dict[str, Any]) -> list[Row]:
    """Speeds and their ratios, device over processor."""
    found, names = (
        [],
        {"reduced": "15 s of the isometric task, reduced", "short": "1 s, white noise, reduced"},
    )
    for name, said in names.items():
        pair = [each[name]["seeds per second"] for each in (processor, device)]
        found += [
            Row(f"{said}: processor", pair[0], "seeds/s"),
            Row(f"{said}: device", pair[1], "seeds/s"),
            Row(f"{said}: speed of the device", pair[1] / pair[0], "times", "the processor"),
        ]
    found += [
        Row(
            f"{names['reduced']}, {key.split()[1]} seeds side by side",
            each["seeds per second"],
            "seeds/s",
        )
        for key, each in device.items()
        if key.startswith("width")
    ]
    for name in ("fit", "expected", "slopes"):
        for when in ("first", "later"):
            ratio = processor[name][when] / device[name][when]
            found += [
                Row(f"{name}, {when} call: device", device[name][when], "s"),
                Row(f"{name}, {when} call: speed of the device", ratio, "times", "the processor"),
            ]
    here, there = np.array(processor["power"]), np.array(device["power"])
    far, costs = (
        float(np.abs(there / here - 1).max()),
        device["fit"]["cost"] / processor["fit"]["cost"],
    )
    return [
        *found,
        Row("power of a bin, device against processor", far, "largest relative error"),
        Row("cost of the fit, device against processor", costs - 1, "relative error"),
    ]


def main() -> int:
    """Both platforms in turn, rows, file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/gpu.json"))
    parser.add_argument(
        "--small", action="store_true", help="a 64th of the seeds: only to try this program"
    )
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options.small)
        return 0
    device, processor = (measured(platform, options.small) for platform in ("", "cpu"))
    print(*rows(processor, device), sep="\n")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(
        json.dumps({"processor": processor, "device": device}, indent=1), encoding="utf-8"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
