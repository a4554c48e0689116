"""A local page that shows a sweep while it runs: served on the loopback address under a path that nobody can guess.

The state is in this process: a page that is loaded again shows it. The page asks once a second for the part that
changes.
When the command ends the server ends, and the last page stays as a file in the folder of results.
"""

from __future__ import annotations

import errno
import hmac
import secrets
import threading
import time
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Any

from quadexp.errors import QuadexpError, UsageError
from quadexp.files.writer import write_text
from quadexp.report.live import Live, fragment, page

HOST = "127.0.0.1"
FILE = "watch.html"  # in the folder of results
RENEWED = 1000  # ms between two questions of a page
LINGER = 3.0  # s that the end waits for a page that is open, so that it shows the end
SCRIPT = """
const part = document.getElementById("live"), gone = document.getElementById("gone");
let version = "", failed = 0;
async function renew() {
  try {
    const answer = await fetch("part?" + version, {cache: "no-store"});
    if (answer.status === 200) {
      version = answer.headers.get("X-Version");
      const x = [...part.querySelectorAll(".scroll")].map(e => e.scrollLeft);
      part.innerHTML = await answer.text();
      part.querySelectorAll(".scroll").forEach((e, i) => { e.scrollLeft = x[i] || 0; });
    }
    failed = 0;
    if (part.querySelector("[data-state]").dataset.state !== "running") return;
  } catch (error) {
    if (++failed >= 3) {
      gone.textContent = "The command has ended. The page as it was last is FILE in the folder of results.";
      gone.hidden = false;
      return;
    }
  }
  setTimeout(renew, RENEWED);
}
renew();
""".replace("RENEWED", str(RENEWED)).replace("FILE", FILE)


class Watch:
    """with Watch(out, metric, port) as watch: run_sweep(..., landed=watch.landed, progress=watch.progress)

    port: 0 for any that is free. `url`: of the page, inside the context.
    Raises UsageError where the port is in use.
    """

    def __init__(self, out: Path, metric: str, port: int = 0) -> None:
        self.live = Live(title=str(out), metric=metric)
        self._out, self._port, self._began = out, port, time.monotonic()
        self._lock = threading.Lock()
        self._version = 0
        self._asked, self._seen = 0.0, -1  # when a page last asked, and for which version
        self._token = secrets.token_urlsafe(18)
        self._nonce = secrets.token_urlsafe(12)
        self.url = ""

    def __enter__(self) -> Watch:
        watch = self

        class Handler(_Handler):
            answers = watch

        try:
            self._server = ThreadingHTTPServer((HOST, self._port), Handler)
        except OSError as error:
            why = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise UsageError(f"--port {self._port}: {why}; give another one, or none for any that is free") from None
        self._server.daemon_threads = True
        self._port = self._server.server_address[1]
        self.url = f"http://{HOST}:{self._port}/{self._token}/"
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        state = "finished" if kind is None else "interrupted" if kind is KeyboardInterrupt else f"ended: {error}"
        if isinstance(error, QuadexpError) and "run the same command to continue" in str(error):
            state = "interrupted: run the same command to continue"
        with self._lock:
            self.live.elapsed, self.live.state = time.monotonic() - self._began, state
            self._version += 1
        try:
            if (self._out / "cells").is_dir():  # a sweep that was refused leaves nothing
                write_text(self._out / FILE, page(self.live))
            self._let_see_the_end()
        finally:
            self._server.shutdown()
            self._server.server_close()

    def landed(self, row: Mapping[str, Any]) -> None:
        """A flight is there."""
        with self._lock:
            self.live.rows.append(dict(row))
            self._version += 1

    def progress(self, done: float, total: float) -> None:
        """The first call says how many flights were there already."""
        with self._lock:
            if not self.live.total:
                self.live.before = int(done)
            self.live.total = int(total)
            self._version += 1

    def shot(self) -> Live:
        """The state now, which nothing changes any more."""
        with self._lock:
            if self.live.state == "running":
                self.live.elapsed = time.monotonic() - self._began
            now = Live(**{**vars(self.live), "rows": [*self.live.rows]})
        return now

    def answer(self, path: str, host: str) -> tuple[int, str, Mapping[str, str]]:
        """Status, text and headers of the answer to a request. host: that was asked, so that no other name leads
        here."""
        asked, _, query = path.partition("?")
        token, _, rest = asked.removeprefix("/").partition("/")
        here = host in (f"{HOST}:{self._port}", f"localhost:{self._port}")
        if not here or not hmac.compare_digest(token.encode(), self._token.encode()) or rest not in ("", "part"):
            return 404, "nothing here\n", {"Content-Type": "text/plain"}
        version = self._version
        ended = self.live.state != "running"
        headers = {
            "Content-Type": "text/html; charset=utf-8",
            "X-Version": str(version),
            "Content-Security-Policy": f"default-src 'none'; style-src 'unsafe-inline'; img-src data:;"
            f" script-src 'nonce-{self._nonce}'; connect-src 'self'; base-uri 'none'; form-action 'none'",
        }
        self._asked = time.monotonic()
        if rest == "" and asked.endswith("/"):
            return 200, page(self.shot(), script=SCRIPT, nonce=self._nonce), headers
        if rest == "":
            return 404, "nothing here\n", {"Content-Type": "text/plain"}
        if ended:
            self._seen = version
        if query == str(version) and ended:
            return 304, "", headers
        return 200, fragment(self.shot()), headers

    def _let_see_the_end(self) -> None:
        """Wait until a page that was open a moment ago has got the end, at most LINGER."""
        until = time.monotonic() + LINGER
        while time.monotonic() - self._asked < 2e-3 * RENEWED and time.monotonic() < until:
            if self._seen == self._version:
                time.sleep(0.05)  # for the answer to leave
                return
            time.sleep(0.02)


class _Handler(BaseHTTPRequestHandler):
    """GET and HEAD of the page and of its part; nothing else, and no word on the terminal."""

    answers: Watch
    server_version, sys_version = "quadexp", ""
    timeout = 10  # s for a request that does not come

    def do_GET(self) -> None:
        self._reply(body=True)

    def do_HEAD(self) -> None:
        self._reply(body=False)

    def _reply(self, *, body: bool) -> None:
        status, text, headers = self.answers.answer(self.path, self.headers.get("Host", ""))
        content = text.encode()
        self.send_response(status)
        for name, value in {**headers, **_ALWAYS, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            try:
                self.wfile.write(content)
            except OSError:  # the reader has left
                self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:
        pass


_ALWAYS = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}
