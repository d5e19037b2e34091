"""A headless browser for tests: QtWebEngine, which pip installs, in a process of its own.

`opened` loads a page and says what a script finds there, what the console said, and which addresses the page asked for.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SECONDS = 120  # until a page is given up
WITHOUT = {
    "QT_QPA_PLATFORM": "offscreen",
    "QTWEBENGINE_DISABLE_SANDBOX": "1",  # a container's root has none
    "QTWEBENGINE_CHROMIUM_FLAGS": "--disable-gpu",
    "QT_LOGGING_RULES": "*=false",
}


def opened(
    url: str, script: str, *, until: str = "true", png: Path | None = None, dark: bool = False
) -> dict[str, Any]:
    """{"found": what `script` is, "console": [...], "asked": [...]} of a page, once `until` is true there.

    Skips the test where the browser or a library of its system is missing.
    """
    asked = {"url": url, "script": script, "until": until, "png": png and str(png), "dark": dark}
    flags = WITHOUT["QTWEBENGINE_CHROMIUM_FLAGS"] + " --blink-settings=preferredColorScheme=0" * dark
    command = [sys.executable, __file__, json.dumps(asked)]
    done = subprocess.run(
        command,
        env=os.environ | WITHOUT | {"QTWEBENGINE_CHROMIUM_FLAGS": flags},
        capture_output=True,
        text=True,
        timeout=SECONDS + 30,
    )
    if "ImportError" in done.stderr or "ModuleNotFoundError" in done.stderr:
        pytest.skip(f"no browser here: {done.stderr.splitlines()[-1]}")
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def main(asked: dict[str, Any]) -> None:
    """Open the page in this process, and print what was found."""
    from PyQt6.QtCore import QTimer, QUrl
    from PyQt6.QtWebEngineCore import QWebEnginePage, QWebEngineUrlRequestInterceptor
    from PyQt6.QtWebEngineWidgets import QWebEngineView
    from PyQt6.QtWidgets import QApplication

    console: list[str] = []
    requests: list[str] = []

    class Page(QWebEnginePage):
        def javaScriptConsoleMessage(self, level, message, line, source):
            console.append(str(message))

    class Listener(QWebEngineUrlRequestInterceptor):
        def interceptRequest(self, info):
            requests.append(info.requestUrl().toString()[:200])

    app = QApplication(sys.argv[:1])
    view, listener = QWebEngineView(), Listener()
    page = Page(view)
    page.profile().setUrlRequestInterceptor(listener)
    view.setPage(page)
    view.resize(1280, 900)
    view.show()

    def answer(found: Any) -> None:
        if asked["png"]:
            view.grab().save(asked["png"])
        print(json.dumps({"found": found, "console": console, "asked": requests}), flush=True)
        os._exit(0)  # Qt's own end complains of pages that are still there

    def look(ready: Any) -> None:
        if ready is not True:
            QTimer.singleShot(100, lambda: page.runJavaScript(asked["until"], look))
            return
        wait = 2000 if asked["png"] else 0  # [ms] until a larger window is drawn
        QTimer.singleShot(wait, lambda: page.runJavaScript(asked["script"], answer))

    def tall(height: Any) -> None:
        view.resize(1280, min(int(height or 900), 8_000))
        page.runJavaScript(asked["until"], look)

    def loaded(ok: bool) -> None:
        if not ok:
            print(f"{asked['url']} did not load", file=sys.stderr, flush=True)
            os._exit(1)
        page.runJavaScript("document.documentElement.scrollHeight" if asked["png"] else "900", tall)

    page.loadFinished.connect(loaded)
    QTimer.singleShot(SECONDS * 1000, lambda: os._exit(3))
    view.load(QUrl(asked["url"]))
    app.exec()


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
