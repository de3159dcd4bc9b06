"""``quell studio``."""

from __future__ import annotations

from pathlib import Path

from quell.cli.options import Trust, Whole


def studio(
    setup: Path | None = None, *, port: Whole = 8770, browser: bool = True, trust: Trust = False
) -> None:
    """Open a page in the browser that simulates a setup while its sliders move.

    The page shows response, estimates, Bode and Nyquist diagrams and margins, tunes, compares,
    exports, and watches a running quell run-rig. It is served at this computer only, at an address
    with a random token, until Ctrl-C.

    Parameters
    ----------
    setup
        A setup file in TOML to begin with; an example by default.
    port
        TCP port; 0 takes a free one.
    browser
        Open the page in the browser; otherwise only print its address.
    """
    from quell.setup import read
    from quell.studio.messages import Granted, checked, files_of
    from quell.studio.runs import Maker
    from quell.studio.server import serve

    tables = None
    if setup is not None:
        name, data = read(setup)
        tables = checked(data, Granted(files_of(data), trust))
        tables.setdefault("title", name.removesuffix(".toml").replace("_", " "))
        Maker(name, trust)(tables)

    def ready(url: str) -> None:
        print(f"Studio: {url} (Ctrl-C ends it)", flush=True)
        if browser:
            import webbrowser

            webbrowser.open(url)

    serve(tables, port, ready, trust)
