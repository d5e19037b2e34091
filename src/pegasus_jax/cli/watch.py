"""The command pegasus-watch: the report of a run that is learning, in a browser."""

from collections.abc import Sequence

from pegasus_jax.checks import ConfigError, check_range
from pegasus_jax.cli.main import main
from pegasus_jax.cli.report import on_cpu
from pegasus_jax.cli.runs import paths_and
from pegasus_jax.cli.words import OF_RUN

WATCH = """\
pegasus-watch RUN|FOLDER ... [port=8765]     the report of a run while it learns

Serves the page of pegasus-report at http://127.0.0.1:8765, to this machine only. A new trial appears by itself, and
what you opened on the page stays open. Ctrl-C ends the server; the run goes on. port=0 takes any port that is free.

examples
  pegasus-watch runs/cartpole-seed0
  ssh -L 8765:127.0.0.1:8765 HOST       on your machine, to see what HOST serves
"""


def watch() -> None:
    """Entry point of pegasus-watch."""
    main(handle, WATCH, stopped="the run goes on")


def handle(words: Sequence[str]) -> None:
    """Serve the page until a signal ends it. Raises ConfigError for words, and a port, that cannot be."""
    paths, options = paths_and(words, OF_RUN["pegasus-watch"])
    if not options["port"].isdecimal():
        raise ConfigError(f"port={options['port']} is not a whole number; for example port=8765")
    check_range("port", port := int(options["port"]), 0, 65535)
    on_cpu()
    from pegasus_jax.report import serve
    from pegasus_jax.runs import groups

    groups.found(paths)
    with serve.server(paths, port) as server:
        print(
            f"http://{serve.HOST}:{server.server_port} shows {', '.join(map(str, paths))}; Ctrl-C ends it", flush=True
        )
        server.serve_forever(poll_interval=0.1)


if __name__ == "__main__":
    watch()
