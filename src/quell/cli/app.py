"""The command ``quell``: its commands, and what it does with errors."""

from __future__ import annotations

import sys
import warnings
from typing import Any, Literal

from cyclopts import App, CycloptsError

from quell import __version__
from quell.cli.compare import compare
from quell.cli.doctor import doctor
from quell.cli.examples import USAGES
from quell.cli.exit_codes import ExitCode
from quell.cli.identify import b0, excite, identify
from quell.cli.monitor import rank, watch
from quell.cli.pages import docs
from quell.cli.reproduce import acc, torsional, two_mass
from quell.cli.rig import proxy, replay, rig, run_rig
from quell.cli.run import export, run, studio, sweep
from quell.cli.setup import setup
from quell.cli.stress import stress
from quell.cli.tune import tune

# A shorter time of compiling is not worth a line [s].
_LONG = 1.0

app = App(
    name="quell",
    help="Disturbance-rejection control that learns.",
    help_epilogue="Pages: quell docs WORDS. Exit codes: quell help exit-codes.",
    version=__version__,
    help_format="plaintext",  # to import what renders Markdown takes a fifth of the time
    print_error=False,
    exit_on_error=False,
)
reproduce = App(
    name="reproduce",
    help="Run a published experiment again and judge its claims.",
    help_format="markdown",
)
app.command(reproduce)


_completion_of, _print_help = app.generate_completion, app.help_print


def completion(shell: Literal["bash", "zsh", "fish"]) -> None:
    """Print the program with which a shell completes commands, options and files.

    `quell completion bash >> ~/.bashrc`, or source it; of zsh a file `_quell` in a folder of
    `fpath`, of fish `~/.config/fish/completions/quell.fish`.

    Parameters
    ----------
    shell
        The shell.
    """
    print(_completion_of(prog_name="quell", shell=shell), end="")


def help_of(topic: str) -> None:
    """Explain the exit codes, or a command, as `quell COMMAND --help` does.

    Parameters
    ----------
    topic
        `exit-codes`, or the name of a command.
    """
    if topic == "exit-codes":
        for code in ExitCode:
            print(f"{code.value:>3}  {code.about}")
        return
    known = ["exit-codes", *dict.fromkeys(name.split()[0] for name in USAGES)]
    if topic not in known:
        from quell.checks import nearest

        raise ValueError(f"topic = {topic!r}: unknown; {nearest(topic, known)}")
    _print_help([topic])


def _add(where: App, function: Any, path: str) -> None:
    """Add a command whose name is the last word of ``path``, with its examples and page."""
    usage = USAGES[path]
    how: dict[str, Any] = {"usage": usage.text(path), "help_epilogue": usage.end}
    where.command(function, name=path.split()[-1], help_format="markdown", **how)


_studies: tuple[Any, ...] = (two_mass, torsional, acc)
for _each in _studies:
    _add(reproduce, _each, f"reproduce {_each.__name__.replace('_', '-')}")
_commands: tuple[Any, ...] = (
    stress,
    compare,
    identify,
    tune,
    b0,
    excite,
    rank,
    watch,
    rig,
    proxy,
    setup,
    run,
    run_rig,
    replay,
    sweep,
    export,
    studio,
    docs,
    doctor,
    completion,
)
for _each in _commands:
    _add(app, _each, _each.__name__.replace("_", "-"))
_add(app, help_of, "help")


def main() -> None:
    """Run the command line; print one line for each error of the user's, and exit with its code."""
    format_before, compiled_before = warnings.formatwarning, _compile_time()
    warnings.formatwarning = _warning_line
    try:
        app()
    except (CycloptsError, ValueError, ImportError) as error:
        for line in getattr(error, "mistakes", (str(error),)):
            _print_error(line)
        sys.exit(ExitCode.ERROR)
    except BrokenPipeError:  # the reader of the output, head for instance, has closed the pipe
        sys.stdout = None
        sys.exit(ExitCode.DONE)
    except (OSError, MemoryError) as error:
        _print_error(f"{type(error).__name__}: {error}")
        sys.exit(ExitCode.ERROR)
    except KeyboardInterrupt:
        _print_error("interrupted")
        sys.exit(ExitCode.INTERRUPTED)
    finally:
        warnings.formatwarning = format_before
        if (seconds := _compile_time() - compiled_before) >= _LONG:
            print(f"quell: compiled code for {seconds:.1f} s; later runs load it", file=sys.stderr)


def _compile_time() -> float:
    """Return how long this process has compiled unannounced [s]; import no compiler for that."""
    module = sys.modules.get("quell.kernels.cache")
    if module is None:
        return 0.0
    return float(module.compile_time.seconds - module.compile_time.told)


def _warning_line(message: Warning | str, *_: Any, **__: Any) -> str:
    return f"quell: warning: {' '.join(str(message).split())}\n"


def _print_error(text: str) -> None:
    print(f"quell: {' '.join(text.split())}", file=sys.stderr)
