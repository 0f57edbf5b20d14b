"""A headless Chromium, spoken to through a pipe by the DevTools protocol: no driver, no further
package, no port."""

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-component-update",
    "--disable-background-networking",
    "--disable-sync",
    "--remote-debugging-pipe",
    "--hide-scrollbars",
    "--disable-dev-shm-usage",
    "--allow-pre-commit-input",
)
FOUND = next((path for path in map(shutil.which, NAMES) if path), None)


class Browser:
    """One page. `run` evaluates JavaScript in it and returns what that gives."""

    def __init__(self):
        (self.hear, theirs), (mine, self.tell) = os.pipe(), os.pipe()
        self.profile, self.count, self.events, self.session = tempfile.mkdtemp(), 0, [], None
        line = f'exec "$0" "$@" 3<&{mine} 4>&{theirs}'
        command = [
            "bash",
            "-c",
            line,
            FOUND or "chromium",
            *FLAGS,
            f"--user-data-dir={self.profile}",
            "about:blank",
        ]
        self.process = subprocess.Popen(
            command, pass_fds=(mine, theirs), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(mine), os.close(theirs)
        self.rest = b""
        (page,) = (t for t in self.send("Target.getTargets")["targetInfos"] if t["type"] == "page")
        found = self.send("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self.session = found["sessionId"]
        for domain in ("Page", "Runtime", "Network"):
            self.send(f"{domain}.enable")
        self.send("Page.setLifecycleEventsEnabled", enabled=True)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a command; what happens meanwhile is kept in `events`."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        message |= {} if self.session is None else {"sessionId": self.session}
        os.write(self.tell, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.rest:
            more = os.read(self.hear, 1 << 16)
            assert more, "the browser has ended"
            self.rest += more
        text, _, self.rest = self.rest.partition(b"\0")
        return json.loads(text)

    def open(self, url: str) -> None:
        """Opens a page and waits until it is loaded, its script has run and it is on the screen.

        What is asked before it is loaded would go to the page before it. Keys before it is on the
        screen would be lost.
        """
        self.send("Page.navigate", url="about:blank")
        loader = self.send("Page.navigate", url=url)["loaderId"]
        self.hear_of("Page.lifecycleEvent", loaderId=loader, name="load")
        self.wait("window.explorer && window.explorer.state")
        self.run("new Promise((yes) => requestAnimationFrame(() => requestAnimationFrame(yes)))")

    def hear_of(self, method: str, **parameters: Any) -> None:
        """Waits until an event with these parameters has come."""
        while not any(
            e.get("method") == method and parameters.items() <= e["params"].items()
            for e in self.events
        ):
            self.events.append(self._next())

    def run(self, code: str) -> Any:
        """The value of an expression, waited for if it is a promise."""
        found = self.send(
            "Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, code: str) -> None:
        """Until an expression is true."""
        self.run(
            f"new Promise((yes) => {{ const look = () => (({code}) ? yes() : setTimeout(look, 20));"
            " look(); })"
        )

    def press(self, key: str, times: int = 1) -> None:
        """Keys as a keyboard sends them."""
        for _ in range(times):
            for kind in ("keyDown", "keyUp"):
                self.send(
                    "Input.dispatchKeyEvent",
                    type=kind,
                    key=key,
                    code=key,
                    windowsVirtualKeyCode=CODES[key],
                )

    def screen(self, width: int, height: int, *, dark: bool = False) -> None:
        """The size of the window, and what the reader prefers."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        wanted = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.send("Emulation.setEmulatedMedia", features=wanted)

    def requests(self) -> list[str]:
        """What the page has asked for."""
        return [
            e["params"]["request"]["url"]
            for e in self.events
            if e.get("method") == "Network.requestWillBeSent"
        ]

    def faults(self) -> list[Any]:
        """Errors that nobody caught."""
        return [e for e in self.events if e.get("method") == "Runtime.exceptionThrown"]

    def close(self) -> None:
        """Ends it."""
        self.process.terminate()
        try:
            self.process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(Path(self.profile), ignore_errors=True)


CODES = {"Tab": 9, "ArrowRight": 39, "ArrowLeft": 37, "PageUp": 33}
