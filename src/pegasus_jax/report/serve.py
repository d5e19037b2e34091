"""The report of a run on localhost, which renews itself in the browser whenever the run's folder changes."""

from __future__ import annotations

import errno
import json
import os
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from hashlib import sha256
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.report import build
from pegasus_jax.report.page import Section, content, page
from pegasus_jax.report.progress import state
from pegasus_jax.runs import groups

HOST = "127.0.0.1"  # nobody else's machine
WATCHED = ("config.yaml", "run.json", "trials.jsonl", "play.mp4", "episodes", "imagined", "driven")

# Asks once a second whether the page has changed, and if so puts the new one in its place: what was open stays open.
SCRIPT = """
let tag = null
const note = document.body.appendChild(Object.assign(document.createElement('div'), {id: 'live'}))
async function renew() {
  try {
    const answer = await fetch('content', {headers: tag ? {'If-None-Match': tag} : {}, cache: 'no-store'})
    if (answer.status === 200) {
      const open = [...document.querySelectorAll('details')].map(one => [one.id, one.open])
      const first = tag === null, [x, y] = [scrollX, scrollY]
      tag = answer.headers.get('ETag')
      document.getElementById('content').innerHTML = await answer.text()
      if (!first) for (const [id, was] of open) { const now = document.getElementById(id); if (now) now.open = was }
      document.title = document.querySelector('h1').textContent
      scrollTo({left: x, top: y, behavior: 'instant'})
    }
    note.textContent = (await (await fetch('state', {cache: 'no-store'})).json()).words
  } catch { note.textContent = 'pegasus-watch has ended; the page stays as it was' }
  setTimeout(renew, 1000)
}
renew()
"""


class Watched:
    """The page of some folders, made again when their files change."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = paths
        self.lock = threading.Lock()  # one page is made at a time, however many browsers look
        self.seen: object = None
        self.html, self.tag = "", ""

    def content(self) -> tuple[str, str]:
        """The page's content, and a tag that changes with it."""
        with self.lock:
            if (now := fingerprint(self.paths)) != self.seen:
                self.html = _content(self.paths)
                self.seen, self.tag = now, f'"{sha256(self.html.encode()).hexdigest()[:16]}"'
            return self.html, self.tag


def fingerprint(paths: Sequence[Path]) -> list[tuple[str, int, int]]:
    """What changes when a run's files do: when each was written, and how large it is."""
    try:
        files = [run / name for run in groups.found(paths) for name in WATCHED]
        return [(str(file), found.st_mtime_ns, found.st_size) for file in files if (found := _stat(file))]
    except (RunError, OSError):
        return []


def _stat(file: Path) -> os.stat_result | None:
    try:
        return file.stat()
    except OSError:
        return None


def _content(paths: Sequence[Path]) -> str:
    try:
        made = build.report(paths)
    except (ConfigError, RunError) as error:  # a run that has just begun, or that a person is moving away
        names = " ".join(map(str, paths))
        return content(names, "", [Section("waiting", "Nothing to show yet", f"<p>{escape(str(error))}</p>")])
    return content(made.title, made.lead, made.sections)


def server(paths: Sequence[Path], port: int) -> ThreadingHTTPServer:
    """A server of the page, which listens already. Raises ConfigError for a port that cannot be had."""
    watched = Watched(paths)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if not _from_here(self.headers.get("Host", "")):
                self.send_error(403)
            elif self.path == "/":
                self._send("text/html; charset=utf-8", page("pegasus-watch", "", [], SCRIPT))
            elif self.path == "/state":
                self._send("application/json", json.dumps({"words": state(paths)}))
            elif self.path == "/content":
                html, tag = watched.content()
                self._send("text/html; charset=utf-8", html, tag)
            else:
                self.send_error(404)

        def _send(self, kind: str, text: str, tag: str = "") -> None:
            same = bool(tag) and self.headers.get("If-None-Match") == tag
            body = b"" if same else text.encode()
            self.send_response(304 if same else 200)
            headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"}
            for name, value in (headers | ({"ETag": tag} if tag else {})).items():
                self.send_header(name, value)
            with suppress(ConnectionError):  # a tab that was closed meanwhile
                self.end_headers()
                self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: a terminal is for what the person should know."""

    ThreadingHTTPServer.daemon_threads = True
    ThreadingHTTPServer.allow_reuse_address = sys.platform != "win32"  # there it lets two programs have one port
    try:
        return ThreadingHTTPServer((HOST, port), Handler)
    except OSError as error:
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        reason = "is used by another program" if error.errno == errno.EADDRINUSE else "needs rights that you lack"
        raise ConfigError(
            f"port={port} {reason}; for example port={port % 60_000 + 1024}, or port=0 for any"
        ) from error


def _from_here(host: str) -> bool:
    """Whether a browser asked for this machine by name: a foreign page's name for 127.0.0.1 is not answered."""
    return host.partition(":")[0] in (HOST, "localhost")
