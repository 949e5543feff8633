# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The command ``pkm-twin``. Exit codes: 0 good, 1 rejected, 2 usage, 3 damaged, 4 no verdict."""

import gc
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import click

from pkm_twin.apps.groups import Tasks, commands
from pkm_twin.apps.options import REFUSED
from pkm_twin.console import flush_output, silence_output, system_error, tell
from pkm_twin.errors import PkmTwinError, plain_warnings
from pkm_twin.files import open_standard_streams
from pkm_twin.ros.signals import INTERRUPTED, first_signal
from pkm_twin.threads import one_blas_thread

NAME: Final = "pkm-twin"
STARTS: Final = {
    "bash": (".bashrc", "source ~/.pkm-twin-complete.bash"),
    "zsh": (".zshrc", "autoload -Uz compinit; compinit; source ~/.pkm-twin-complete.zsh"),
    "fish": (".config/fish/config.fish", "source ~/.pkm-twin-complete.fish"),
}
"""By shell: the file below home that it starts with, and the line there that adds completion."""


def _print_version(context: click.Context, _option: click.Parameter, asked: bool) -> None:
    if asked and not context.resilient_parsing:
        from importlib.metadata import PackageNotFoundError, version

        try:
            click.echo(f"{NAME} {version('pkm_twin')}")
        except PackageNotFoundError:
            click.echo(f"{NAME}, version unknown (not installed, runs from its sources)")
        context.exit()


def _complete(context: click.Context, option: click.Parameter, asked: bool) -> None:
    """Print or install the completion of the shell that this program was called from."""
    if not asked or context.resilient_parsing:
        return
    from click.shell_completion import get_completion_class

    # The shell that calls may be another one than the user's usual one.
    parent = Path(f"/proc/{os.getppid()}/comm")
    names = [parent.read_text().strip()] if parent.exists() else []
    names.append(Path(os.environ.get("SHELL", "")).name)
    shell = next((name for name in names if name in STARTS), None)
    if shell is None:
        raise click.UsageError(f"shell {names[-1]!r}; expected {' or '.join(STARTS)}", context)
    kind: Any = get_completion_class(shell)
    script = kind(context.command, {}, NAME, "_PKM_TWIN_COMPLETE").source()
    if option.name == "install_completion":
        file, line = STARTS[shell]
        start, target = Path.home() / file, Path.home() / f".pkm-twin-complete.{shell}"
        start.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(script, encoding="utf-8")
        text = start.read_text(encoding="utf-8") if start.exists() else ""
        if line not in text.splitlines():
            start.write_text(f"{text}\n{line}\n", encoding="utf-8")
        script = f"{shell} completion installed in {target}; it works in a new terminal"
    click.echo(script)
    context.exit()


def _ask(
    name: str, call: Callable[[click.Context, click.Parameter, bool], None], text: str
) -> click.Option:
    """Return an option that runs a function in place of a command."""
    return click.Option(
        [name], is_flag=True, is_eager=True, expose_value=False, callback=call, help=text
    )


app = Tasks(
    """Compute torques and stiffness of parallel robots, and compare recordings with the model.

    Start with `pkm-twin robots`, then `pkm-twin info delta_cu`; or check a recording with
    `pkm-twin check BAG`. SI units unless an option states others, world z up. Only play,
    monitor-torques and view --live need ROS.

    Exit codes: 0 good, 1 bad or invalid, 2 wrong usage, 3 damaged file (`recover` can save a
    part), 4 not judged (`check`). An error is one line on stderr. Results go to stdout, with --json
    as JSON only.
    """,
    commands(),
    metavar="COMMAND [ARGS]...",
    params=[
        _ask("--version", _print_version, "Show the version and exit."),
        _ask("--install-completion", _complete, "Install completion for the current shell."),
        _ask(
            "--show-completion", _complete,
            "Show completion for the current shell, to copy it or customize the installation.",
        ),
    ],
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: errors are one line on stderr and exit code 1, Ctrl-C is code 130."""
    # What is loaded stays: to look at it while it is loaded is a tenth of a short command's time.
    gc.disable()
    open_standard_streams()
    one_blas_thread()
    try:
        with first_signal(lambda: SystemExit(INTERRUPTED)), plain_warnings():
            app(arguments, prog_name=NAME)
    except SystemExit:
        failed = flush_output()
        if failed and not isinstance(failed, BrokenPipeError):
            _end(f"cannot write the output: {system_error(failed)}")
        raise
    except BrokenPipeError:
        # Whoever read the output has seen enough.
        silence_output()
        sys.exit(REFUSED)
    except PkmTwinError as error:
        _end(str(error))
    except OSError as error:
        flush_output()
        # Every file that a command opens has a name, the output has none.
        _end(f"{'' if error.filename else 'cannot write the output: '}{system_error(error)}")


def _end(text: str) -> NoReturn:
    tell(text)
    sys.exit(REFUSED)


if __name__ == "__main__":
    main()
